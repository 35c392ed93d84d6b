"""
The bridge to rl_zoo3. Importing it is all that rl_zoo3's commands need::

    python -m rl_zoo3.train --gym-packages sb3_cpm.zoo --algo sac --conf-file zoo_configs/cpm_sac.yml --env CPM/PickCube-v1

=================  ================================================================================================
``registration``   ids of the tasks in gymnasium
``bridge``         what is put into rl_zoo3: names, algorithms, search spaces (``search``), and four methods of its
                   experiment manager (``manager``) that check configurations (``checks``) and continue runs (``resume``)
``agents``         the same configurations as Python objects
``policies``       PPO's policies for point clouds and RGB-D
``wrappers``       environment wrappers that configurations name
``__main__``       rl_zoo3's commands with our algorithms among the choices of ``--algo``
=================  ================================================================================================
"""

import importlib.util

from sb3_cpm.zoo.bridge import install
from sb3_cpm.zoo.registration import ENV_IDS, TASKS, env_id_of, register_tasks

register_tasks()
if importlib.util.find_spec("rl_zoo3") is not None:  # the ids are of use without it
    install()

__all__ = ["ENV_IDS", "TASKS", "env_id_of", "register_tasks"]
