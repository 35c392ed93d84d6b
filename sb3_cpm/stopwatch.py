"""Where the time of a run goes: exclusive wall-clock seconds per named section."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """
    Nested sections, each charged only for the time that is not spent in a section inside it.

    >>> watch = Stopwatch()
    >>> with watch.section("P trains"):
    ...     with watch.section("buffer"):  # not counted as "P trains"
    ...         pass
    >>> sorted(watch.seconds)
    ['P trains', 'buffer']
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open: list[str] = []
        self._mark = time.perf_counter()

    def start(self, name: str) -> None:
        """Open a section; the one that was open waits."""
        self._charge()
        self._open.append(name)

    def stop(self, name: str) -> None:
        """Close a section, and whatever an exception left open inside it. A section that is not open is ignored."""
        self._charge()
        if name in self._open:
            while self._open.pop() != name:
                pass

    @contextmanager
    def section(self, name: str) -> Iterator[None]:
        self.start(name)
        try:
            yield
        finally:
            self.stop(name)

    def _charge(self) -> None:
        now = time.perf_counter()
        if self._open:
            self.seconds[self._open[-1]] += now - self._mark
        self._mark = now
