"""CSV files that survive a killed run: every row is on disk at once; a resumed run cuts off what came after its checkpoint."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

EVALUATIONS = (
    "experiment",
    "agent",
    "env",
    "seed",
    "step",
    "episode",
    "return",
    "length",
    "success_once",
    "success_at_end",
)
TRAINING = ("step", "env_idx", "return", "length", "success_once", "success_at_end")
DIAGNOSTICS = ("step", "name", "value")
COLUMNS = {"evaluations": EVALUATIONS, "training": TRAINING, "diagnostics": DIAGNOSTICS}
"""Of the files of a run, by name."""


class Table:
    """
    A CSV file that rows are appended to.

    :param path: of the file, made with a header where there is none
    :param columns: its columns
    :param size: bytes to keep of a file that is there already; None: all
    :raises ValueError: if the file has fewer
    """

    def __init__(self, path: Path, columns: Sequence[str], size: int | None = None) -> None:
        self.path, self.columns = path, tuple(columns)
        there = path.stat().st_size if path.exists() else 0
        if size is not None and there < size:
            raise ValueError(
                f"{path} has {there} bytes, it had {size} when the checkpoint beside it was made: it was damaged. "
                "Remove the folder to run it again."
            )
        if there and size is not None:
            with path.open("rb+") as file:
                file.truncate(size)
        self._file: TextIO = path.open("a", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file)
        if self._file.tell() == 0:
            self._writer.writerow(self.columns)
            self._file.flush()

    def add(self, row: Sequence[Any]) -> None:
        """:param row: one value per column; None becomes an empty cell, a bool 0 or 1"""
        self._writer.writerow([_cell(value) for value in row])
        self._file.flush()

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self._file.tell()

    def close(self) -> None:
        self._file.close()


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    if isinstance(value, bool):
        return int(value)
    return f"{value:.6g}" if isinstance(value, float) else value
