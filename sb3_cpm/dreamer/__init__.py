"""
Dreamer and Plan2Explore as SB3 algorithms: DreamerV2 (Hafner et al. 2021) and its curious sister (Sekar et al. 2020).

They hold the same :class:`~sb3_cpm.challenger.Challenger` that proposes challenges to a player in CPM, world model, behaviours
and optimizers included; here it plays itself. Its replay is the original buffer D of a :class:`~sb3_cpm.buffers.CPMBuffer`.
"""

from sb3_cpm.dreamer.dreamer import Dreamer
from sb3_cpm.dreamer.plan2explore import Plan2Explore
from sb3_cpm.dreamer.policies import CnnPolicy, DreamerPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CnnPolicy", "Dreamer", "DreamerPolicy", "MlpPolicy", "MultiInputPolicy", "Plan2Explore"]
