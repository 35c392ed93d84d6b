"""
The bridge to rl_zoo3: ``--gym-packages sb3_cpm.zoo`` is all that its commands need.
"""

from sb3_cpm.zoo.registration import ENV_IDS, TASKS, env_id_of, register_tasks

register_tasks()

__all__ = ["ENV_IDS", "TASKS", "env_id_of", "register_tasks"]
