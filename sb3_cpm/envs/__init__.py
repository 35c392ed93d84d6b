"""
Environments. The only place that imports ManiSkill or SAPIEN, and only when an environment is made: importing
``sb3_cpm.envs`` works without them.
"""

from sb3_cpm.envs.maniskill import ManiSkillEnv, make_maniskill_env
from sb3_cpm.envs.vec_env import ManiSkillVecEnv, make_maniskill_vec_env
from sb3_cpm.envs.vulkan import forget_failed_opencv

forget_failed_opencv()

__all__ = ["ManiSkillEnv", "ManiSkillVecEnv", "make_maniskill_env", "make_maniskill_vec_env"]
