"""One torch thread (spinning threads on a loaded machine are slow), no windows, and the same seed before every test."""

import os

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch as th
from stable_baselines3.common.utils import set_random_seed

from sb3_cpm.envs import vulkan

th.set_num_threads(1)
vulkan.activate_private()  # SAPIEN's and OpenCV's libraries, where there is a private installation: tests import them directly


@pytest.fixture(autouse=True)
def _same_seed() -> None:
    set_random_seed(0)
