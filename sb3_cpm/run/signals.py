"""What signals do to a run."""

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

#: Exit status of a process that SIGTERM has ended, as shells count it.
TERMINATED = 128 + signal.SIGTERM


@contextlib.contextmanager
def sigterm_raises() -> Iterator[None]:
    """
    Within it SIGTERM, by which schedulers end jobs, is an exception as Ctrl-C is: files and environments are closed.

    :raises SystemExit: with status 143 when the signal comes
    """

    def end(number: int, frame: FrameType | None) -> NoReturn:
        raise SystemExit(TERMINATED)

    try:
        previous = signal.signal(signal.SIGTERM, end)
    except ValueError:  # not in the main thread, where no signal arrives
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """An impatient second Ctrl-C or SIGTERM must not spoil what is being written."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    try:
        previous = [signal.signal(number, signal.SIG_IGN) for number in numbers]
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)
