"""
Environments. The only place that imports ManiSkill or SAPIEN, and only when an environment is made: importing
``sb3_cpm.envs`` works without them.
"""

from sb3_cpm.envs.goals import GoalVecEnv, GoalView
from sb3_cpm.envs.maniskill import ManiSkillEnv, make_maniskill_env
from sb3_cpm.envs.robust import RobustSubprocVecEnv
from sb3_cpm.envs.toy import ToyEnv
from sb3_cpm.envs.vec_env import ManiSkillVecEnv, make_maniskill_vec_env
from sb3_cpm.envs.vulkan import forget_failed_opencv
from sb3_cpm.envs.wrappers import DictObservation

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
