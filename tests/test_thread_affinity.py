"""The renderer's thread is bound to the core of the simulation, nothing else is, and a fork leaves its parent's alone."""

import os
import sys
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from sb3_cpm.envs import make_maniskill_env
from sb3_cpm.machine import thread_affinity

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="cores are chosen on Linux only")

CORES = sorted(os.sched_getaffinity(0)) if sys.platform == "linux" else []


@pytest.fixture
def thread(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A thread of the renderer that waits."""
    for name, value in (("_threads", set()), ("_process", 0), ("_core", -1)):
        monkeypatch.setattr(thread_affinity, name, value)
    done = threading.Event()
    waiting = threading.Thread(target=done.wait)
    with thread_affinity.renderer_threads():
        waiting.start()
    assert waiting.native_id in thread_affinity._threads
    yield int(waiting.native_id or 0)
    done.set()
    waiting.join()


def test_it_follows(thread: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for core in (CORES[0], CORES[-1]):
        monkeypatch.setattr(thread_affinity, "_running_on", lambda core=core: lambda: core)
        thread_affinity.follow_simulation()
        assert os.sched_getaffinity(thread) == {core}
    assert sorted(os.sched_getaffinity(0)) == CORES


def test_a_thread_that_ended_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread_affinity, "_threads", {2**30})
    monkeypatch.setattr(thread_affinity, "_process", os.getpid())
    monkeypatch.setattr(thread_affinity, "_core", -1)
    thread_affinity.follow_simulation()
    assert thread_affinity._threads == set()


def test_a_fork_leaves_the_threads_of_its_parent(thread: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread_affinity, "_process", os.getppid())
    thread_affinity.follow_simulation()
    assert sorted(os.sched_getaffinity(thread)) == CORES


def test_where_nobody_knows_the_core_nothing_is_bound(thread: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread_affinity, "_running_on", lambda: lambda: -1)
    thread_affinity.follow_simulation()
    assert sorted(os.sched_getaffinity(thread)) == CORES


@pytest.mark.maniskill
@pytest.mark.skipif(os.environ.get("LP_NUM_THREADS", "0") != "0", reason="the renderer shares its work among threads")
def test_the_thread_of_the_real_renderer() -> None:
    env = make_maniskill_env("PickCube-v1")
    env.reset(seed=0)
    env.step(np.zeros(7))
    if env.batch.env.backend.render_device.is_cuda():
        pytest.skip("a graphics card draws")
    assert thread_affinity._threads
    cores = {frozenset(os.sched_getaffinity(thread)) for thread in thread_affinity._threads}
    assert len(cores) == 1 and len(next(iter(cores))) == 1
    assert sorted(os.sched_getaffinity(0)) == CORES
    env.close()
