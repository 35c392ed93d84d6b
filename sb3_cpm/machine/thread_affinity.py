"""
The renderer's thread stays where its process works.

A software renderer draws in a thread of its own, and the simulation waits for it: of the two only one works at a time. Left to
the operating system, each is woken on whatever core is free at that moment, and with several worker processes they push each
other from core to core: two processes on two cores were 1.3 times as fast as one. So before each step the renderer's thread
is bound to the core on which the simulation is just then; the simulation itself is bound to nothing, and the operating system
moves it as ever. Like this two processes are 1.8 times as fast as one, and on a machine that is busy otherwise several times
faster than before.
"""

import ctypes
import functools
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_threads: set[int] = set()
_process = 0
_core = -1


@contextmanager
def renderer_threads() -> Iterator[None]:
    """Threads that begin within this context, and are there at its end, are the renderer's from now on; on Linux."""
    global _threads, _process, _core
    before = _tasks()
    yield
    now = _tasks()
    _threads, _process, _core = (_threads & now) | (now - before), os.getpid(), -1


def follow_simulation() -> None:
    """Bind the renderer's threads to the core on which this thread is running. Costs a microsecond where nothing has moved."""
    global _core, _threads
    if not _threads:
        return
    core = _running_on()()
    if core == _core or core < 0:
        return
    _core = core
    if _process != os.getpid():  # a fork has no threads but its own
        _threads = set()
    for thread in tuple(_threads):
        try:
            os.sched_setaffinity(thread, {core})
        except OSError:  # it ended, or the process may not use the core any more
            _threads.discard(thread)


def _tasks() -> set[int]:
    return {int(name) for name in os.listdir("/proc/self/task")} if sys.platform == "linux" else set()


@functools.cache
def _running_on() -> Callable[[], int]:
    try:
        return ctypes.CDLL(None).sched_getcpu
    except AttributeError:
        return lambda: -1
