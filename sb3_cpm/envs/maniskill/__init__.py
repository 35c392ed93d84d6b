"""
ManiSkill 3 as environments of gymnasium and SB3. All that imports ManiSkill is in here, and imports it when an environment is
made.

================  ==============================================================================
``env``           one environment on the CPU, and the arguments of all
``vec_env``       a batch of them on a GPU, as SB3's VecEnv
``batch``         what both are made of
``observations``  what a robot knows of itself; ``clouds``: point clouds from pictures
``start_states``  episodes that begin where another one was
``goals``         tasks as goal environments, for HER
``checks``        arguments that do not fit, in words; ``simulation``: CPU or GPU
``visuals``       robots of few triangles for software renderers; ``meshes``: how they are made
``cpu_speedups``  the same numbers for less work
``tasks``         tasks of the report that ManiSkill lacks; ``assets``: their files
``experts``       controllers that solve tasks, for demonstrations
================  ==============================================================================
"""

from sb3_cpm.envs.maniskill.env import ManiSkillEnv, make_maniskill_env
from sb3_cpm.envs.maniskill.goals import GoalVecEnv, GoalView
from sb3_cpm.envs.maniskill.vec_env import ManiSkillVecEnv, make_maniskill_vec_env

__all__ = [
    "GoalVecEnv",
    "GoalView",
    "ManiSkillEnv",
    "ManiSkillVecEnv",
    "make_maniskill_env",
    "make_maniskill_vec_env",
]
