"""
What ``import sb3_cpm.zoo`` changes in rl_zoo3, all of it here and in the two modules that are called from here.

* Names that YAML files may use in ``replay_buffer_class``, ``replay_buffer_kwargs`` and ``policy_kwargs``, which rl_zoo3
  evaluates in the namespace of its experiment manager (:data:`NAMES`).
* Our algorithms beside rl_zoo3's (:data:`ALGORITHMS`). ``--algo`` fixes its choices before it imports ``--gym-packages``, so
  only ``python -m sb3_cpm.zoo train`` can offer them.
* Search spaces for ``--optimize``, see :mod:`sb3_cpm.zoo.search`.
* Four methods of rl_zoo3's ``ExperimentManager``, see :mod:`sb3_cpm.zoo.manager`. They are replaced on the class, since
  ``rl_zoo3.train`` holds the class before it imports ``--gym-packages``.
"""

from typing import Any

from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.dreamer import Dreamer, Plan2Explore
from sb3_cpm.extractors import PointNetExtractor, PointNetPolicy
from sb3_cpm.zoo.manager import install as wrap_manager
from sb3_cpm.zoo.search import install as add_search_spaces

NAMES: dict[str, Any] = {
    "CPMBuffer": CPMBuffer,
    # `enjoy` passes an environment to `load`, without which SB3 makes no such buffer, only if it reads "HerReplayBuffer"
    "CPMHerReplayBuffer": CPMBuffer,
    "PointNetExtractor": PointNetExtractor,
    "PointNetPolicy": PointNetPolicy,
}

ALGORITHMS: dict[str, Any] = {"dreamer": Dreamer, "plan2explore": Plan2Explore}


def install() -> None:
    """
    Make all of the above so. Can be repeated.

    :raises ImportError: if rl_zoo3 is not installed
    """
    import rl_zoo3.exp_manager
    from rl_zoo3.utils import ALGOS

    vars(rl_zoo3.exp_manager).update(NAMES)
    ALGOS.update(ALGORITHMS)
    add_search_spaces()
    wrap_manager()
