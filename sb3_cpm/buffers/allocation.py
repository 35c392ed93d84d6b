"""Where a replay buffer's arrays live: in memory or in files, asked for before they are made and refused with the numbers."""

import logging
import os
import shutil
import tempfile
import warnings
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

logger = logging.getLogger(__name__)

#: Makes an array of zeros from a name, a shape and a dtype.
Allocate = Callable[[str, tuple[int, ...], Any], np.ndarray]


def in_memory(name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array of zeros; the system gives it memory as it is written to."""
    return np.zeros(shape, dtype=dtype)


class InFolder:
    """
    Arrays in files of a folder of their own, which is removed with the last reference to this object.

    :param directory: where to make that folder; created if need be
    :raises ValueError: if it cannot be
    """

    def __init__(self, directory: str | Path):
        self.directory = Path(directory)
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self.folder = Path(tempfile.mkdtemp(prefix="cpm_buffer_", dir=self.directory))
        except OSError as error:
            raise ValueError(f"memmap_dir={str(directory)!r} is not a folder that can be written to: {error}") from error
        self._remove = weakref.finalize(self, shutil.rmtree, str(self.folder), ignore_errors=True)
        self._n_files = 0

    def __call__(self, name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """
        :raises ValueError: if the disk is full
        """
        n_bytes = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if n_bytes == 0:
            return np.zeros(shape, dtype=dtype)
        path = self.folder / f"{quote(name, '')}.{self._n_files}"  # keys of observations may hold slashes
        self._n_files += 1
        try:
            _reserve(path, n_bytes)
        except OSError as error:
            path.unlink(missing_ok=True)
            raise ValueError(
                f"Cannot reserve {_gb(n_bytes)} for {name!r} in {self.directory} ({error.strerror}); "
                f"{_gb(free_on_disk(self.directory))} are free there. Use a smaller buffer_size or another memmap_dir."
            ) from error
        array = np.memmap(path, dtype=dtype, mode="r+", shape=shape)
        path.unlink()  # the map keeps the blocks; nothing is left behind if the process is killed
        return array

    def __reduce__(self) -> tuple[Any, ...]:
        return InFolder, (self.directory,)


def _reserve(path: Path, n_bytes: int) -> None:
    """
    Really take the blocks of a file. A sparse file would do until the disk is full, and writing to its map then kills the
    process with SIGBUS instead of raising anything.
    """
    with path.open("wb") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, n_bytes)
        else:  # macOS, Windows
            zeros = bytes(1 << 24)
            for start in range(0, n_bytes, len(zeros)):
                file.write(zeros[: n_bytes - start])


def check_space(n_bytes: Mapping[str, int], n_in_files: int, directory: str | Path | None, what: str) -> None:
    """
    Say how much memory something will take when it is full (at level INFO, or WARNING if it is much for this machine).

    :param n_bytes: bytes by name, for the message
    :param n_in_files: how many of them are in files
    :param directory: where the files are
    :param what: what takes the memory
    :raises ValueError: if that is more than the machine has
    """
    total = sum(n_bytes.values())
    needed = total - n_in_files
    largest = ", ".join(f"{name} {_gb(size)}" for name, size in sorted(n_bytes.items(), key=lambda item: -item[1])[:4])
    place = f", {_gb(n_in_files)} of it in files in {directory}" if directory is not None else ""
    message = f"{what} will take {_gb(total)}{place} when it is full ({largest})"
    advice = "Use a smaller buffer_size, images or clouds, storage_dtypes (float16, uint8) or memmap_dir."

    if directory is not None and n_in_files > free_on_disk(directory):
        raise ValueError(f"{message}, but only {_gb(free_on_disk(directory))} are free there. {advice}")
    memory = memory_of_machine()
    if memory is None:
        logger.info(message)
        return
    installed, available = memory
    if needed > installed:
        raise ValueError(f"{message}, but this machine has {_gb(installed)} of memory. {advice}")
    if needed > available:
        warnings.warn(f"{message}, but only {_gb(available)} of memory are available now. {advice}")
    logger.log(logging.WARNING if needed > installed / 10 else logging.INFO, message)


def memory_of_machine() -> tuple[int, int] | None:
    """:return: bytes of memory that there are and that are available, within the limits of a container; None if unknown"""
    try:
        import psutil
    except ImportError:  # as in SB3, the check is made where psutil is there
        return None
    memory = psutil.virtual_memory()
    installed, available = memory.total, memory.available
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            limit = int(Path(path).read_text())
        except (OSError, ValueError):  # not there, or "max"
            continue
        installed, available = min(installed, limit), min(available, limit)
    return installed, available


def free_on_disk(directory: str | Path) -> int:
    """Bytes free for a folder that need not exist yet."""
    path = Path(directory).absolute()
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path).free


def _gb(n_bytes: float) -> str:
    return f"{n_bytes / 1e9:.2f} GB" if n_bytes >= 1e7 else f"{n_bytes / 1e6:.2f} MB"
