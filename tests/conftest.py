"""
One torch thread (spinning threads on a loaded machine are slow), no windows, and the same seed before every test; and who runs
what where several processes share the tests (pytest-xdist, ``-n auto``).
"""

import os

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium.utils import seeding
from stable_baselines3.common.utils import set_random_seed

from sb3_cpm.machine import vulkan

th.set_num_threads(1)
vulkan.activate_private()  # SAPIEN's and OpenCV's libraries, where there is a private installation: tests import them directly

#: Files of more than 30 CPU seconds, the longest first: begun at the end, one of them would keep a single core busy alone.
LONGEST = (
    "test_notebooks.py",
    "test_zoo.py",
    "test_tasks.py",
    "test_gail.py",
    "test_behavior.py",
    "test_experiments.py",
    "test_callback.py",
    "test_sb3_own_tests.py",
    "test_uncertainty_classes.py",
    "test_run.py",
    "test_wheel.py",
    "test_rendering.py",
    "test_docs.py",
    "test_examples.py",
    "test_cloning.py",
)


@pytest.fixture(autouse=True)
def _same_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    """
    What is drawn is the same in every run. Gymnasium's spaces and environments draw from generators of their own, which take
    their seed from the operating system unless they are given one: here from NumPy's global generator.
    """
    set_random_seed(0)

    def np_random(seed: int | None = None) -> tuple[np.random.Generator, int]:
        return unseeded(int(np.random.randint(2**31)) if seed is None else seed)

    unseeded = seeding.np_random
    monkeypatch.setattr(seeding, "np_random", np_random)


# ---------------------------------------------------------------------- several processes
@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """
    What ``-n auto`` means: a worker per core, but no more than there are files to share out.

    Not pytest-xdist's own answer: it counts physical cores, and starts a worker (10 CPU seconds of imports) even where there
    is nothing to share. 0, for a single file or a single core, is no worker at all.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    paths = [Path(argument.split("::")[0]) for argument in config.args]
    files = cores if any(path.is_dir() for path in paths) else len(set(paths))
    workers = min(cores, files)
    return workers if workers > 1 else 0


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Whole files, since the tests of one share what is costly (a trained model, a simulation), in the order of collection."""
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False  # else by the number of tests, which says nothing of how long they take
    return LoadFileScheduling(config, log)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """In a worker: long files first."""
    if hasattr(config, "workerinput"):
        rank = {name: index for index, name in enumerate(LONGEST)}
        items.sort(key=lambda item: rank.get(item.path.name, len(rank)))
