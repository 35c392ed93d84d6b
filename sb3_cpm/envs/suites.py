"""Suites of benchmark tasks in packages of their own, which register their ids when they are asked for."""

import importlib

import gymnasium as gym

from sb3_cpm.extras import needed

#: What their ids begin with, and the modules that register them.
SUITES: dict[tuple[str, ...], tuple[str, ...]] = {
    ("PointMaze", "AntMaze", "Fetch", "Hand", "AdroitHand", "FrankaKitchen"): ("gymnasium_robotics",),
    ("dm_control/",): ("dm_control", "shimmy"),
    ("Meta-World/",): ("metaworld",),
}


def register_suite(env_id: str) -> None:
    """
    Import the suite that an environment is of. Not before: it takes a quarter of a second and MuJoCo.

    :param env_id: one that nobody has registered, or any other
    :raises ValueError: if a package of it is missing
    """
    if env_id in gym.registry:
        return
    for beginnings, modules in SUITES.items():
        if env_id.startswith(beginnings):
            for name in modules:
                with needed(f"Tasks such as {env_id}", "benchmarks"):
                    gym.register_envs(importlib.import_module(name))
