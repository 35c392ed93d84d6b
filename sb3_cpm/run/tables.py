"""CSV files that survive a killed run: every row is on disk at once; a resumed run cuts off what came after its checkpoint."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_cpm.files import GrowingFile

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
    :param size: bytes to keep of a file that is there already
    :param digest: SHA-256 of these; None: they are believed
    :raises DamagedFileError: if the file has fewer, or others
    """

    def __init__(self, path: Path, columns: Sequence[str], size: int = 0, digest: str | None = None) -> None:
        self.path, self.columns = path, tuple(columns)
        self._file = GrowingFile(path, size, digest)
        if size == 0:
            self._write([self.columns])

    def add(self, row: Sequence[Any]) -> None:
        """:param row: one value per column; None becomes an empty cell, a bool 0 or 1"""
        self.add_all([row])

    def add_all(self, rows: Iterable[Sequence[Any]]) -> None:
        """:param rows: as for :meth:`add`; they come to the disk together"""
        self._write([[_cell(value) for value in row] for row in rows])

    def _write(self, rows: Iterable[Sequence[Any]]) -> None:
        text = io.StringIO()
        csv.writer(text).writerows(rows)
        self._file.append(text.getvalue())

    def state(self) -> dict[str, Any]:
        """
        :return: size and digest, once everything so far is on the disk
        :raises NotWrittenError: if it cannot be
        """
        self._file.sync()
        return {"size": self._file.size, "digest": self._file.digest}

    def close(self) -> None:
        """:raises NotWrittenError: if rows are still missing on the disk"""
        self._file.close()


class GrownTable(Table):
    """
    A table whose columns are those of its first row, or of the rows that a resumed run keeps.

    :param path: of the file
    :param size: bytes to keep of a file that is there already
    :param digest: SHA-256 of these; None: they are believed
    :raises DamagedFileError: if the file has fewer, or others
    """

    def __init__(self, path: Path, size: int = 0, digest: str | None = None) -> None:
        self.path = path
        self._file = GrowingFile(path, size, digest)
        self.columns = tuple(path.read_text(encoding="utf-8").partition("\n")[0].strip().split(",")) if size else ()

    def add_row(self, row: dict[str, Any]) -> None:
        """:param row: by column"""
        if not self.columns:
            self.columns = tuple(row)
            self._write([self.columns])
        self.add([row[column] for column in self.columns])


def read_csv(path: Path) -> dict[str, np.ndarray]:
    """
    :param path: a table
    :return: one array per column, of numbers with nan where a cell is empty, or of texts; no columns where the file is missing
        or empty
    """
    if not path.exists():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        names = reader.fieldnames or []  # reads the first line if nobody has: not after the file is closed
        rows = list(reader)
    return {name: _column([row[name] for row in rows]) for name in names}


def _column(cells: list[str]) -> np.ndarray:
    try:
        return np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        return np.array(cells)


def read_diagnostics(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """
    :param folder: of a run
    :return: steps and values of everything that was logged, by name
    """
    table = read_csv(folder / "diagnostics.csv")
    if not table:
        return {}
    chosen = {name: table["name"] == name for name in np.unique(table["name"])}
    return {str(name): (table["step"][rows], table["value"][rows]) for name, rows in chosen.items()}


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    if isinstance(value, bool):
        return int(value)
    return f"{value:.6g}" if isinstance(value, float) else value
