"""A clock for benchmarks that interleave contestants: CPU and wall seconds of the phases of an update."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch


class Lap(NamedTuple):
    """Seconds between two looks at a :class:`Clock`; CPU seconds are those of all threads."""

    cpu: float
    wall: float

    def __add__(self, other: "Lap") -> "Lap":  # type: ignore[override]
        return Lap(self.cpu + other.cpu, self.wall + other.wall)


class Clock:
    """
    :param device: waited for at every look
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.last = self._now()

    def _now(self) -> Lap:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return Lap(time.process_time(), time.perf_counter())

    def lap(self) -> Lap:
        """:return: seconds since the last look"""
        last, self.last = self.last, self._now()
        return Lap(self.last.cpu - last.cpu, self.last.wall - last.wall)


class Enough(Exception):
    """Ends an update early, see :func:`clocked`."""


def clocked(function: Callable, clock: Clock, laps: list[Lap], stop_after: int | None = None) -> Callable:
    """
    The same function, with a look at the clock after each call.

    :param function: marks the end of a phase
    :param clock: to look at
    :param laps: a lap is appended to it after each call
    :param stop_after: raise :class:`Enough` when there are so many laps
    """

    def call(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        laps.append(clock.lap())
        if len(laps) == stop_after:
            raise Enough
        return result

    return call


def timed(function: Callable[[], Any], device: torch.device | str = "cpu") -> Lap:
    """What one call costs."""
    clock = Clock(device)
    function()
    return clock.lap()


def median(laps: Sequence[Lap]) -> Lap:
    """Of each column on its own."""
    return Lap(*(statistics.median(column) for column in zip(*laps, strict=True)))
