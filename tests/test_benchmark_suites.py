"""
Tasks of the suites in the extra `benchmarks` can be made, and stepped: which versions of MuJoCo and of the suites go together
is a matter of trying, and constraints.txt names a set that does.
"""

import importlib.util
import warnings

import gymnasium as gym
import numpy as np
import pytest

from sb3_cpm.extras import install_command

#: One task of every kind, as far as suites differ in how they use MuJoCo.
SUITES = {
    "gymnasium_robotics": (
        "FetchReach-v4",
        "FetchPush-v4",
        "HandReach-v3",
        "HandManipulateBlockRotateZ-v1",
        "FrankaKitchen-v1",
        "AdroitHandDoorSparse-v1",
        "PointMaze_UMaze-v3",
        "AntMaze_UMaze-v5",
    ),
    "dm_control": (
        "dm_control/cartpole-swingup_sparse-v0",
        "dm_control/finger-turn_hard-v0",
        "dm_control/reacher-hard-v0",
        "dm_control/dog-run-v0",  # flexible parts
    ),
    "metaworld": ("pick-place-v3", "door-open-v3"),
}


def make(suite: str, task: str) -> gym.Env:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # theirs, of one another's versions
        if suite == "metaworld":
            import metaworld  # noqa: F401  (registers Meta-World/MT1)

            return gym.make("Meta-World/MT1", env_name=task, seed=0)
        if suite == "gymnasium_robotics":
            import gymnasium_robotics

            gym.register_envs(gymnasium_robotics)
        else:
            import shimmy

            gym.register_envs(shimmy)
        return gym.make(task)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suite, task", [(suite, task) for suite, tasks in SUITES.items() for task in tasks])
def test_tasks_of_the_suites_can_be_made(suite: str, task: str) -> None:
    for package in (suite, *(["shimmy"] if suite == "dm_control" else [])):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed: {install_command('benchmarks')}")
    env = make(suite, task)
    try:
        env.reset(seed=0)
        _, reward, _, _, _ = env.step(env.action_space.sample())
        assert np.isfinite(float(reward))
    finally:
        env.close()
