"""
Whole files: what this package writes and reads again goes through here.

* **Written whole or not at all**: under a name of its own, flushed to the disk, then renamed (:func:`replacing`). Names that a
  killed process has left are removed by the next one that writes the same file.
* **Read as written**: archives (all our binary files are zip archives) carry the SHA-256 of all their bytes as the comment
  that the format provides for (:func:`seal`, :func:`verify`). Everybody else who reads zip archives still can.
* **Nothing executes**: :func:`write_archive` holds arrays and JSON, no pickles.
* **One writer per folder** (:func:`locked`), also on systems without ``fcntl``.
* **A full disk** is an :class:`NotWrittenError` that names the file; what was there before stays.
"""

import contextlib
import errno
import glob
import hashlib
import io
import json
import logging
import os
import re
import secrets
import shutil
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

logger = logging.getLogger(__name__)

CONTENT = "content.json"
LOCK = ".lock"
"""A file in a locked folder, where the system cannot lock the folder itself."""

_MARK = b"sb3_cpm sha256:"
_SEAL = len(_MARK) + 64
_CHUNK = 1 << 24
#: What a disk says that is full, cannot be written, or is not ours to write.
_OF_DISK = {
    getattr(errno, name)
    for name in ("ENOSPC", "EDQUOT", "EFBIG", "EROFS", "EACCES", "EPERM", "EIO", "ENOTDIR", "EISDIR", "ENAMETOOLONG")
    if hasattr(errno, name)
}


class DamagedFileError(ValueError):
    """A file is not what was written: cut off, changed, or something else."""


class DamagedRunError(ValueError):
    """The files of a run are not what a run leaves."""


class NotFiniteError(RuntimeError):
    """Weights with NaN or infinity, which never replace a file with better ones."""


class LockedError(RuntimeError):
    """Another process is writing a folder."""


class NotWrittenError(OSError):
    """The disk is full, read-only or not ours. The message names the file; what it held before is still there."""

    def __str__(self) -> str:
        folder = Path(self.filename).absolute().parent
        free = ""
        with contextlib.suppress(OSError):
            while not folder.exists():
                folder = folder.parent
            free = f" ({shutil.disk_usage(folder).free / 1e6:,.1f} MB free there)"
        return f"{self.filename} cannot be written: {self.strerror}{free}"


@contextlib.contextmanager
def disk_errors_named(path: str | os.PathLike) -> Iterator[None]:
    """
    :param path: what is being written
    :raises NotWrittenError: in place of what the system says of a full or read-only disk
    """
    try:
        yield
    except NotWrittenError:
        raise
    except OSError as error:
        if error.errno not in _OF_DISK:
            raise
        raise NotWrittenError(error.errno, os.strerror(error.errno or 0), str(path)) from error


# ---------------------------------------------------------------------- writing


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """
    Give a temporary path beside ``path`` (with the same suffix); when everything is written, it takes the place of ``path``.

    :param path: the file to write or replace; its folder is made if need be
    :raises NotWrittenError: if the disk does not take it; the old file stays
    :raises ValueError: if there is something else than a file
    """
    target = Path(os.path.realpath(path))  # through a symbolic link, not in its place
    if target.exists() and not target.is_file():
        raise ValueError(f"{path} is a {'folder' if target.is_dir() else 'device'}: expected the name of a file to write.")
    with disk_errors_named(path):
        target.parent.mkdir(parents=True, exist_ok=True)
        _sweep(target)
        temporary, descriptor = _claim(target)
        try:
            yield temporary
            os.fsync(descriptor)
            if fcntl is None:  # there, a file that is open cannot be renamed
                os.close(descriptor)
                descriptor = -1
            os.replace(temporary, target)
            _sync_folder(target.parent)
        finally:
            temporary.unlink(missing_ok=True)
            if descriptor >= 0:
                os.close(descriptor)


def write_bytes(path: str | os.PathLike, content: bytes) -> None:
    """:raises NotWrittenError: see :func:`replacing`"""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | os.PathLike, text: str) -> None:
    """:raises NotWrittenError: see :func:`replacing`"""
    write_bytes(path, text.encode())


def write_sealed(path: str | os.PathLike, write: Callable[[io.BytesIO], Any]) -> None:
    """
    Write a zip archive that somebody else makes, with the digest of its bytes.

    :param path: of the file
    :param write: is given a file in memory (what torch says of a disk that is full does not name the disk)
    :raises NotWrittenError: see :func:`replacing`
    """
    file = io.BytesIO()
    write(file)
    with replacing(path) as temporary:
        temporary.write_bytes(file.getbuffer())
        seal(temporary)


def _claim(target: Path) -> tuple[Path, int]:
    """A new file that is locked while it is written, so that whoever sweeps can tell it from one that was left behind."""
    while True:
        temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp{target.suffix}")
        descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        with contextlib.suppress(FileNotFoundError):  # swept between these lines: another one then
            if _try_lock(descriptor) is not False and os.path.samestat(os.fstat(descriptor), os.stat(temporary)):
                return temporary, descriptor
        os.close(descriptor)


def _sweep(target: Path) -> None:
    """Remove what killed processes have left of earlier attempts to write ``target``."""
    name = f".{glob.escape(target.name)}.{'[0-9a-f]' * 8}.tmp{glob.escape(target.suffix)}"
    for leftover in target.parent.glob(name):
        with contextlib.suppress(OSError):
            if fcntl is None:  # there, one that is being written cannot be removed
                leftover.unlink()
                continue
            descriptor = os.open(leftover, os.O_RDWR)
            try:
                if _try_lock(descriptor):
                    leftover.unlink()
            finally:
                os.close(descriptor)


def _try_lock(descriptor: int) -> bool | None:
    """:return: whether it is ours now; None where this cannot be told (no ``fcntl``, some network file systems)"""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _sync_folder(folder: Path) -> None:
    """So that the new name, too, outlives a power cut; where the system does not do that, it does it by itself."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


class GrowingFile:
    """
    A text file that only grows. Every piece is with the system at once; what a full disk refuses is kept and written first
    when the next piece comes.

    :param path: the file; a new one, unless ``size`` says how much of it to keep
    :param size: bytes to keep of what is there, which may be more; None: the file must not exist
    :param digest: SHA-256 of these bytes as :attr:`digest` gave it; None: they are believed
    :raises FileExistsError: if it is there and ``size`` is None
    :raises DamagedFileError: if it holds fewer bytes or others
    """

    def __init__(self, path: Path, size: int | None = None, digest: str | None = None) -> None:
        self.path = path
        self._hash = hashlib.sha256()
        self._pending = b""
        self._size = 0
        self._told = False
        how = os.O_CREAT | os.O_EXCL if size is None else 0 if size else os.O_CREAT
        try:
            with disk_errors_named(path):
                self._descriptor = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0) | how, 0o666)
        except FileNotFoundError as error:
            if not size:
                raise
            raise DamagedFileError(f"{path} is gone, it had {size} bytes when the checkpoint beside it was made.") from error
        try:
            if size:
                self._keep(size, digest)
            with disk_errors_named(path):
                os.ftruncate(self._descriptor, self._size)
                os.lseek(self._descriptor, self._size, os.SEEK_SET)
        except BaseException:
            os.close(self._descriptor)
            raise

    def _keep(self, size: int, digest: str | None) -> None:
        there = os.fstat(self._descriptor).st_size
        if there < size:
            raise DamagedFileError(f"{self.path} has {there} bytes, it had {size} when the checkpoint beside it was made.")
        while self._size < size:
            piece = os.read(self._descriptor, min(_CHUNK, size - self._size))
            self._hash.update(piece)
            self._size += len(piece)
        if digest not in (None, self._hash.hexdigest()):
            raise DamagedFileError(f"{self.path} is not what it was when the checkpoint beside it was made.")

    @property
    def size(self) -> int:
        """Bytes so far, those that wait for the disk included."""
        return self._size + len(self._pending)

    @property
    def digest(self) -> str:
        """SHA-256 of what is on the disk."""
        return self._hash.hexdigest()

    def append(self, text: str) -> None:
        """:param text: what comes next; a disk that does not take it is told once, in the log, and asked again next time"""
        self._pending += text.encode()
        try:
            self._write()
        except NotWrittenError as error:
            if not self._told:
                logger.warning(f"{error}. The run goes on; what is missing is written as soon as there is room.")
            self._told = True

    def sync(self) -> None:
        """
        Everything is on the disk when this returns.

        :raises NotWrittenError: if it cannot be
        """
        self._write()
        with disk_errors_named(self.path):
            os.fsync(self._descriptor)

    def close(self) -> None:
        """:raises NotWrittenError: if something is still missing"""
        if self._descriptor < 0:
            return
        try:
            self._write()
        finally:
            os.close(self._descriptor)
            self._descriptor = -1

    def _write(self) -> None:
        with disk_errors_named(self.path):
            while self._pending:
                n = os.write(self._descriptor, self._pending)
                self._hash.update(self._pending[:n])
                self._size += n
                self._pending = self._pending[n:]
        self._told = False


# ---------------------------------------------------------------------- seals


def seal(path: Path) -> None:
    """
    Give a zip archive the digest of its bytes, as its comment.

    :param path: an archive without comment
    """
    with open(path, "r+b") as file:
        file.seek(-22, os.SEEK_END)  # the last record of an archive has 22 bytes, its last two say how long the comment is
        record = file.read()
        assert record.startswith(b"PK\5\6") and record.endswith(b"\0\0"), f"{path} is no archive without a comment"
        file.seek(-2, os.SEEK_END)
        file.write(_SEAL.to_bytes(2, "little"))
        file.flush()
        size = file.tell()
        digest = _digest(file, size)
        file.seek(size)
        file.write(_MARK + digest)


def verify(path: str | os.PathLike, what: str = "file") -> bool:
    """
    Whether a file is what was written, before anything reads it.

    :param path: of a zip archive
    :param what: what it should be, for the message
    :return: True: its digest says so; False: it has none, as archives of others and of earlier versions, and its members'
        checksums say so, which do not cover everything
    :raises DamagedFileError: if it is not
    """
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _SEAL))
        found = re.fullmatch(re.escape(_MARK) + b"([0-9a-f]{64})", file.read())
        if found is not None:
            if _digest(file, size - _SEAL) != found[1]:
                raise DamagedFileError(f"{path} is damaged: its bytes have changed since it was written. {_EARLIER}")
            return True
        try:
            with zipfile.ZipFile(file) as archive:
                broken = "digest" if _has_place_for_digest(file, size) else archive.testzip()
        except Exception as error:  # of damaged archives zipfile, zlib and struct each complain in their own way
            raise DamagedFileError(
                f"{path} ({size:,} bytes) is damaged or no saved {what} ({type(error).__name__}: {error}). {_EARLIER}"
            ) from error
    if broken is not None:
        raise DamagedFileError(f"{path} is damaged: its {broken} has changed since it was written. {_EARLIER}")
    return False


_EARLIER = "Take an earlier one."


def _has_place_for_digest(file: Any, size: int) -> bool:
    """Whether the last record of an archive announces a comment of the length of ours, whatever has become of that."""
    file.seek(max(0, size - 22 - _SEAL))
    record = file.read().rpartition(b"PK\5\6")[2]
    return record[16:18] == _SEAL.to_bytes(2, "little")


def _digest(file: Any, size: int) -> bytes:
    """SHA-256 of the first ``size`` bytes, in hexadecimal digits."""
    file.seek(0)
    digest = hashlib.sha256()
    while size > 0 and (piece := file.read(min(_CHUNK, size))):
        digest.update(piece)
        size -= len(piece)
    return digest.hexdigest().encode()


# ---------------------------------------------------------------------- arrays and JSON


def write_archive(path: str | os.PathLike, content: Any, arrays: Mapping[str, np.ndarray]) -> None:
    """
    Write arrays and JSON into one file; ``np.load`` reads the arrays, too.

    :param path: of the file
    :param content: what JSON can say
    :param arrays: by name, without objects
    :raises NotWrittenError: see :func:`replacing`
    """
    with replacing(path) as temporary:
        with zipfile.ZipFile(temporary, "w") as archive:
            archive.writestr(CONTENT, json.dumps(content))
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
        seal(temporary)


class Archive:
    """
    What :func:`write_archive` wrote, checked and open for reading; a context manager.

    :param path: of the file
    :param what: what it should be, for messages
    :raises DamagedFileError: if it is missing, damaged, or something else
    """

    def __init__(self, path: str | os.PathLike, what: str) -> None:
        self.path, self.what = Path(path), what
        if not self.path.is_file():
            raise DamagedFileError(f"There is no file {path}.")
        if not verify(path, what):
            raise DamagedFileError(f"{path} is no saved {what}: it has no digest.")
        self._zip = zipfile.ZipFile(self.path)
        if CONTENT not in self._zip.namelist():
            self._zip.close()
            raise DamagedFileError(f"{path} is no saved {what}: it has no {CONTENT}.")
        #: the JSON
        self.content: Any = json.loads(self._zip.read(CONTENT))

    def __enter__(self) -> "Archive":
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    @property
    def names(self) -> list[str]:
        """Of the arrays."""
        return [name.removesuffix(".npy") for name in self._zip.namelist() if name != CONTENT]

    def array(self, name: str) -> np.ndarray:
        """:raises DamagedFileError: if it has no such array, or one with objects"""
        with self._member(name) as member:
            return np.lib.format.read_array(member, allow_pickle=False)

    def read_into(self, name: str, out: np.ndarray) -> None:
        """
        Read an array piece by piece to where it belongs, which may be larger than memory.

        :param name: of the array
        :param out: contiguous, of the same shape and dtype
        :raises DamagedFileError: if it is another one
        """
        with self._member(name) as member:
            version = np.lib.format.read_magic(member)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, fortran, dtype = read(member)
            if (shape, dtype) != (out.shape, out.dtype) or fortran:
                raise DamagedFileError(f"{self.path}: {name} is {dtype} {shape}, expected {out.dtype} {out.shape}.")
            if not out.size:
                return
            target = memoryview(out.reshape(-1).view(np.uint8).data)
            while len(target):
                n = member.readinto(target[:_CHUNK])
                if n == 0:
                    raise EOFError("it ends early")
                target = target[n:]

    @contextlib.contextmanager
    def _member(self, name: str) -> Iterator[Any]:
        try:
            with self._zip.open(f"{name}.npy") as member:
                yield member
        except DamagedFileError:
            raise
        except (KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise DamagedFileError(f"{self.path} is no whole saved {self.what}: {name} ({error}).") from error


# ---------------------------------------------------------------------- numbers that are none


def first_not_finite(weights: Any, name: str = "") -> str | None:
    """
    :param weights: arrays or tensors, or dicts and lists of them, such as state dicts of networks and optimizers
    :param name: of all of them
    :return: the name of the first that holds NaN or infinity; None if there is none
    """
    if isinstance(weights, Mapping):
        parts: Any = weights.items()
    elif isinstance(weights, (list, tuple)):
        parts = enumerate(weights)
    else:
        return name if _is_broken(weights) else None
    found = (first_not_finite(part, f"{name}.{key}" if name else str(key)) for key, part in parts)
    return next((one for one in found if one is not None), None)


def _is_broken(value: Any) -> bool:
    """Of NumPy and torch alike, without importing torch, which whoever only reads tables can do without."""
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "fc" and not bool(np.isfinite(value).all())
    if hasattr(value, "is_floating_point") and value.is_floating_point():
        return not bool((value - value == 0).all())  # x - x is NaN for infinity and NaN
    return False


def check_finite(path: str | os.PathLike, what: str, weights: Any) -> None:
    """
    :param path: of the file that would be written
    :param what: what would be in it
    :param weights: see :func:`first_not_finite`
    :raises NotFiniteError: naming the first weight that is not finite: a file with it would only replace a better one
    """
    name = first_not_finite(weights)
    if name is not None:
        raise NotFiniteError(
            f"The {what} is not saved: its weight {name} is not finite. If {path} exists, it is kept as it was."
        )


# ---------------------------------------------------------------------- folders


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """
    Let nobody else write this folder, which is made if need be; the lock goes with the process, however that ends.

    :param folder: to be written
    :raises LockedError: while somebody else holds it; nothing is changed then
    :raises NotWrittenError: if it cannot be made
    """
    with disk_errors_named(folder):
        folder.mkdir(parents=True, exist_ok=True)
        release = _lock_folder(folder)
    try:
        yield
    finally:
        release()


def _lock_folder(folder: Path) -> Any:
    """:return: what gives the lock back"""
    if fcntl is not None:
        descriptor = os.open(folder, os.O_RDONLY)  # the folder itself: a lock file would have to be removed, which is a race
        held = _try_lock(descriptor)
        if held:
            return lambda: os.close(descriptor)
        os.close(descriptor)
        if held is False:
            raise _locked_error(folder)
    # Windows, and network file systems that lock no folders: SQLite has a lock for every system, which goes with the process
    import sqlite3

    connection = sqlite3.connect(folder / LOCK, timeout=0, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("BEGIN EXCLUSIVE")
    except sqlite3.OperationalError as error:
        connection.close()
        if "locked" in str(error):
            raise _locked_error(folder) from error
        raise NotWrittenError(errno.EACCES, str(error), str(folder / LOCK)) from error
    return connection.close


def _locked_error(folder: Path) -> LockedError:
    return LockedError(f"{folder} is being written by another process. Wait for it, or choose another folder.")
