"""
CPM for Stable-Baselines3: a challenger explores beside the player and turns what it finds into challenges.

Algorithm 1 of the report, with the place where each line lives::

    for all rounds:                                                       callbacks.ChallengerCallback
        generate a trajectory with P and, epsilon-greedily, C             exploration
        store it in D                                                     buffers.CPMBuffer
        for all its transitions, C estimates
            the epistemic uncertainty u                                   challenger, uncertainty
            the embedding e                                               challenger, world_model
            the score S(r, u)                                             challenges.quality
        the best one is the goal; cut the trajectory there                challenges.curator
        keep it if the filter F does                                      challenges.filters
        replace its rewards by R(r, u, progress toward the goal)          challenges.rewards
            with all coefficients following their targets                 challenges.targeting
        store it in I                                                     buffers.CPMBuffer
        train world model, encoder and C on D                             challenger, world_model
        train P on D and I                                                Stable-Baselines3
"""

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_cpm.buffers import CPMBuffer
    from sb3_cpm.callbacks import ChallengerCallback
    from sb3_cpm.challenge_env import ChallengeVecEnv
    from sb3_cpm.checkpoint_callback import CheckpointCPMCallback, resume
    from sb3_cpm.extractors import PointNetExtractor, PointNetPolicy
    from sb3_cpm.policies import LayerNormPolicy, RLPDPolicy, SimbaPolicy

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

__all__ = [
    "CPMBuffer",
    "ChallengeVecEnv",
    "ChallengerCallback",
    "CheckpointCPMCallback",
    "LayerNormPolicy",
    "PointNetExtractor",
    "PointNetPolicy",
    "RLPDPolicy",
    "SimbaPolicy",
    "__version__",
    "resume",
]

_HOMES = {
    "CPMBuffer": "sb3_cpm.buffers",
    "ChallengeVecEnv": "sb3_cpm.challenge_env",
    "ChallengerCallback": "sb3_cpm.callbacks",
    "CheckpointCPMCallback": "sb3_cpm.checkpoint_callback",
    "LayerNormPolicy": "sb3_cpm.policies",
    "PointNetExtractor": "sb3_cpm.extractors",
    "PointNetPolicy": "sb3_cpm.extractors",
    "RLPDPolicy": "sb3_cpm.policies",
    "SimbaPolicy": "sb3_cpm.policies",
    "resume": "sb3_cpm.checkpoint_callback",
}


def __getattr__(name: str) -> Any:
    """Imported when asked for: ``doctor`` and ``--help`` have to work where torch does not."""
    if name in _HOMES:
        globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
        return globals()[name]
    if f"sb3_cpm.{name}" in _HOMES.values():  # `import sb3_cpm; sb3_cpm.buffers`
        return importlib.import_module(f"sb3_cpm.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
