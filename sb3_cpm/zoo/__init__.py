"""
The bridge to rl_zoo3. Importing it is all that rl_zoo3's commands need::

    python -m rl_zoo3.train --gym-packages sb3_cpm.zoo --algo sac --conf-file zoo_configs/cpm_sac.yml --env CPM/PickCube-v1

=================  ================================================================================================
``bridge``         what is put into rl_zoo3: names, algorithms, search spaces (``search``), and four methods of its
                   experiment manager (``manager``) that check configurations and continue runs (``resume``)
``policies``       PPO's policies for point clouds and RGB-D
``wrappers``       environment wrappers that configurations name
``pink_noise``     SAC's policy with pink noise
``__main__``       rl_zoo3's commands with our algorithms among the choices of ``--algo``
=================  ================================================================================================
"""

import importlib.util

from sb3_cpm.agents.tasks import register_tasks
from sb3_cpm.zoo.bridge import install

register_tasks()
if importlib.util.find_spec("rl_zoo3") is not None:  # the ids are of use without it
    install()
