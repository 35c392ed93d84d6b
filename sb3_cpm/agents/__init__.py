"""
What an agent is, said once for every command: a file of ``zoo_configs/`` is read, checked and made a model.

=================  ================================================================================================
``agent``          :func:`load_agent`: an agent's hyperparameters on a task, and the model that they make
``configs``        the files: where they are, their entries by environment, entries that override others
``algorithms``     names that a file may use: algorithms, and what stands in its Python expressions
``checks``         misspelt keys and values that nobody takes, before anything is built
``tasks``          gymnasium's ids of our tasks, and those that other packages register
=================  ================================================================================================
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_cpm.agents.agent import Agent, Built, load_agent

__all__ = ["Agent", "Built", "load_agent"]


def __getattr__(name: str) -> Any:
    """Imported when asked for: ids of tasks are of use where neither PyYAML nor rl_zoo3 is installed."""
    if name in __all__:
        return getattr(importlib.import_module("sb3_cpm.agents.agent"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
