"""
Environments: a toy, wrappers, worker processes that may die, suites of benchmark tasks, and ManiSkill.

Importing it works without ManiSkill and SAPIEN, which are imported when an environment of theirs is made.
"""

from sb3_cpm.envs.maniskill import (
    GoalVecEnv,
    GoalView,
    ManiSkillEnv,
    ManiSkillVecEnv,
    make_maniskill_env,
    make_maniskill_vec_env,
)
from sb3_cpm.envs.robust import RobustSubprocVecEnv
from sb3_cpm.envs.toy import ToyEnv
from sb3_cpm.envs.wrappers import DictObservation
from sb3_cpm.machine.vulkan import forget_failed_opencv

forget_failed_opencv()

__all__ = [
    "DictObservation",
    "GoalVecEnv",
    "GoalView",
    "ManiSkillEnv",
    "ManiSkillVecEnv",
    "RobustSubprocVecEnv",
    "ToyEnv",
    "make_maniskill_env",
    "make_maniskill_vec_env",
]
