"""Whole files: real crashes, real full disks, real second processes."""

import contextlib
import json
import os
import pickle
import signal
import stat
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch as th
from file_helpers import Touch, files_of_at_most

from sb3_cpm import files
from sb3_cpm.files import Archive, DamagedFileError, GrowingFile, LockedError, NotFiniteError, NotWrittenError
from sb3_cpm.packing import pack, unpack

ROOT = Path(__file__).parents[1]


def python(code: str, *arguments: object, **options: object) -> "subprocess.Popen[str]":
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    return subprocess.Popen(command, text=True, env=environment, **pipes, **options)  # type: ignore[call-overload,no-any-return]


# ---------------------------------------------------------------------- writing


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a [1].txt"
    files.write_text(path, "old")
    with pytest.raises(RuntimeError), files.replacing(path) as temporary:
        assert temporary.suffix == ".txt" and temporary.parent == path.parent and temporary != path
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old" and list(path.parent.iterdir()) == [path]
    files.write_text(path, "new")
    assert path.read_text() == "new" and list(path.parent.iterdir()) == [path]
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask, "as any other file"


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("target")
    files.write_text(tmp_path / "link", "text")
    assert (tmp_path / "target").read_text() == "text" and (tmp_path / "link").is_symlink()
    for path, kind in ((tmp_path, "folder"), (Path(os.devnull), "device")):
        with pytest.raises(ValueError, match=f"is a {kind}: expected the name of a file"):
            files.write_text(path, "text")
    assert stat.S_ISCHR(Path(os.devnull).stat().st_mode)


KILLED = """
import os, signal, sys
from sb3_cpm.files import replacing
with replacing(sys.argv[1]) as temporary:
    temporary.write_text("half")
    if len(sys.argv) > 2:
        print("writing", flush=True)
        sys.stdin.readline()
    else:
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_leaves_is_swept_and_what_a_living_one_writes_is_not(tmp_path: Path) -> None:
    path, other = tmp_path / "model.zip", tmp_path / "model.zip.zip"
    files.write_text(path, "old")
    for target in (path, other):
        with python(KILLED, target) as child:
            assert child.wait() == -signal.SIGKILL
    (killed,) = tmp_path.glob(".model.zip.????????.tmp.zip")
    assert path.read_text() == "old"
    with python(KILLED, path, "wait") as writer:
        assert writer.stdout is not None and writer.stdout.readline() == "writing\n"
        files.write_text(path, "new")
        assert not killed.exists() and path.read_text() == "new"
        assert len(list(tmp_path.glob(".model.zip.????????.tmp.zip"))) == 1, "the one that is being written"
        assert len(list(tmp_path.glob(".model.zip.zip.*"))) == 1, "of another file"
        writer.communicate("\n")
    assert path.read_text() == "half", "its turn came later"


def test_a_full_disk_is_named_and_the_old_file_stays(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    files.write_archive(path, {"a": 1}, {})
    before = path.read_bytes()
    with files_of_at_most(10_000):
        for write in (
            lambda: files.write_bytes(path, bytes(20_000)),
            lambda: files.write_archive(path, {}, {"zeros": np.zeros(5000)}),
            lambda: files.write_sealed(path, lambda file: th.save(th.zeros(5000), file)),
        ):
            with pytest.raises(
                NotWrittenError, match=r"^\S+a\.npz cannot be written: File too large \([\d.,]+ MB free there\)$"
            ):
                write()
            assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_a_disk_that_is_really_full(tmp_path: Path) -> None:
    """On a file system of its own, where mounting is allowed."""
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)], capture_output=True).returncode:
        pytest.skip("mounting is not allowed here; test_a_full_disk_is_named_and_the_old_file_stays does without")
    try:
        files.write_text(place / "a.txt", "old")
        with pytest.raises(NotWrittenError, match=r"a\.txt cannot be written: No space left on device"):
            files.write_bytes(place / "a.txt", bytes(100_000))
        table = GrowingFile(place / "table.csv")
        (place / "filler").write_bytes(bytes(56 * 1024))
        rows = [f"{i},{'x' * 1000}\r\n" for i in range(20)]
        for row in rows:
            table.append(row)
        with pytest.raises(NotWrittenError, match="No space left"):
            table.sync()
        (place / "filler").unlink()
        table.append("20,last\r\n")
        assert (place / "table.csv").read_bytes().decode() == "".join(rows) + "20,last\r\n"
        table.close()
        subprocess.run(["mount", "-o", "remount,ro", str(place)], check=True)
        with pytest.raises(NotWrittenError, match="Read-only file system"):
            files.write_text(place / "a.txt", "new")
        with pytest.raises(NotWrittenError, match="Read-only file system"), files.locked(place / "new"):
            pass
        assert (place / "a.txt").read_text() == "old"
    finally:
        subprocess.run(["umount", str(place)], check=True)


# ---------------------------------------------------------------------- files that grow


def test_a_growing_file_goes_on_where_the_checkpoint_was(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    table = GrowingFile(path)
    table.append("a,b\r\n")
    table.append("1,2\r\n")
    size, digest = table.size, table.digest
    table.append("later\r\n")
    table.close()
    table.close()
    assert path.read_bytes() == b"a,b\r\n1,2\r\nlater\r\n"
    with pytest.raises(FileExistsError):
        GrowingFile(path)
    again = GrowingFile(path, size, digest)
    assert path.read_bytes() == b"a,b\r\n1,2\r\n" and (again.size, again.digest) == (size, digest)
    again.append("3,4\r\n")
    again.close()
    assert path.read_bytes() == b"a,b\r\n1,2\r\n3,4\r\n"
    path.write_bytes(b"a,b\r\n1,3\r\n3,4\r\n")
    with pytest.raises(DamagedFileError, match="is not what it was when the checkpoint"):
        GrowingFile(path, size, digest)
    with pytest.raises(DamagedFileError, match="has 15 bytes, it had 99 when the checkpoint"):
        GrowingFile(path, 99)
    assert path.stat().st_size == 15, "nothing is cut off from what is refused"
    path.unlink()
    with pytest.raises(DamagedFileError, match="is gone, it had 10 bytes"):
        GrowingFile(path, size, digest)
    assert not path.exists()


def test_rows_wait_for_a_full_disk(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    table = GrowingFile(tmp_path / "t.csv")
    with files_of_at_most(25):
        for _ in range(3):
            table.append("0123456789\n")
        assert table.size == 33 and (tmp_path / "t.csv").stat().st_size == 25
        with pytest.raises(NotWrittenError, match="t.csv cannot be written"):
            table.sync()
    assert len(caplog.records) == 1 and "t.csv cannot be written: File too large" in caplog.text and "goes on" in caplog.text
    table.append("end\n")
    assert (tmp_path / "t.csv").read_text() == "0123456789\n" * 3 + "end\n"
    table.close()


# ---------------------------------------------------------------------- reading


def test_an_archive_comes_back_as_it_went_in(tmp_path: Path) -> None:
    record = np.zeros((3, 2), dtype=[("cloud", "<f2", (3, 4)), ("colour", "u1", (2,))])
    record["cloud"] = np.arange(12).reshape(3, 4)
    arrays = {
        "a/b%2F": np.arange(6.0).reshape(2, 3),
        "record": record,
        "none": np.zeros((0, 3), np.uint8),
        "one": np.float32(2),
    }
    path = tmp_path / "a.npz"
    files.write_archive(path, {"nan": float("nan"), "large": 2**70}, arrays)
    with Archive(path, "thing") as archive:
        assert sorted(archive.names) == sorted(arrays) and archive.content["large"] == 2**70
        for name, array in arrays.items():
            found = archive.array(name)
            assert found.dtype == np.asarray(array).dtype and found.tobytes() == np.asarray(array).tobytes()
        into = np.memmap(tmp_path / "map", record.dtype, "w+", shape=(5, 2))
        archive.read_into("record", into[:3])
        assert into[:3].tobytes() == record.tobytes() and not into[3:]["cloud"].any()
        for name, out in (("missing", record), ("a/b%2F", np.zeros((3, 2))), ("a/b%2F", np.zeros((2, 3), np.float32))):
            with pytest.raises(DamagedFileError):
                archive.read_into(name, out)
    with np.load(path) as other:  # of NumPy alone
        assert np.array_equal(other["a/b%2F"], arrays["a/b%2F"])
    with pytest.raises(ValueError, match="Object arrays"):
        files.write_archive(path, {}, {"objects": np.array([{}])})
    with Archive(path, "thing") as archive:
        assert "record" in archive.names, "the last good one stays"


def test_flipped_bits_are_refused(tmp_path: Path) -> None:
    """Every one of them: benchmarks/flipped_bits.py does this to what a run saves."""
    path = tmp_path / "a.npz"
    files.write_archive(path, {"a": [1, 2]}, {"numbers": np.arange(20.0)})
    whole = path.read_bytes()
    assert files.verify(path)
    for place in range(0, 8 * len(whole), 29):
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(DamagedFileError, match=r"a\.npz .*is damaged"):
            files.verify(path)
    for size in range(0, len(whole), 11):
        path.write_bytes(whole[:size])
        with pytest.raises(DamagedFileError):
            files.verify(path)


def test_archives_of_others_are_checked_as_far_as_they_allow(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("member", bytes(1000))
    assert not files.verify(path)
    with pytest.raises(DamagedFileError, match="no saved thing: it has no digest"):
        Archive(path, "thing")
    path.write_bytes(path.read_bytes().replace(bytes(1000), bytes(999) + b"x"))
    with pytest.raises(DamagedFileError, match="its member has changed"):
        files.verify(path)
    path.write_text("no archive")
    with pytest.raises(DamagedFileError, match="damaged or no saved model"):
        files.verify(path, "model")


def test_a_pickle_within_an_archive_is_not_read(tmp_path: Path) -> None:
    done, path = tmp_path / "executed", tmp_path / "a.npz"
    np.savez(path, objects=np.array([Touch(done)], dtype=object))
    files.seal(path)
    with zipfile.ZipFile(path) as archive, contextlib.suppress(ValueError):
        pickle.loads(archive.read("objects.npy")[128:])
    assert done.exists(), "that is how dangerous it is"
    done.unlink()
    with pytest.raises(DamagedFileError, match="no saved thing"):
        Archive(path, "thing")
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        with zipfile.ZipFile(path) as source:
            archive.writestr("objects.npy", source.read("objects.npy"))
        archive.writestr(files.CONTENT, "{}")
    files.seal(tmp_path / "b.npz")
    with Archive(tmp_path / "b.npz", "thing") as opened:
        with pytest.raises(DamagedFileError, match="Object arrays cannot be loaded"):
            opened.array("objects")
        with pytest.raises(DamagedFileError):
            opened.read_into("objects", np.zeros(1))
    assert not done.exists()


def test_packing_is_exact() -> None:
    from collections import OrderedDict, deque

    from sb3_cpm.buffers import ChallengeCounters, Episode

    value = {
        "numbers": [1, 2**80, -0.1, float("inf"), True, None, np.float32(0.1), np.int64(3)],
        "tuple": (1, ("a", b"\x00\xff")),
        "deque": deque([Episode(0, 1, 2, 3)], maxlen=4),
        "dict": {1: {"$": "tuple"}, (0, 1): []},
        "ordered": OrderedDict(b=1, a=2),
        "array": np.arange(4, dtype=">i2").reshape(2, 2),
        "counters": ChallengeCounters(proposed=3),
    }
    classes = (Episode, ChallengeCounters)
    found = unpack(json.loads(json.dumps(pack(value, classes))), classes)
    assert repr(found) == repr(value) and found["deque"].maxlen == 4
    assert found["array"].dtype == np.dtype(">i2") and type(found["numbers"][6]) is np.float32
    for bad, told in (({"a": [Touch(Path())]}, r"infos\['a'\]\[0\] is a Touch"), (Episode(0, 0, 0, 0), "is a Episode")):
        with pytest.raises(ValueError, match=told):
            pack(bad, name="infos")
    with pytest.raises(ValueError, match="There is no 'Episode' to be read here"):
        unpack(pack(value, classes), (ChallengeCounters,))


def test_numbers_that_are_none_are_found_anywhere() -> None:
    moments = {"step": th.tensor(3), "exp_avg": th.ones(2)}
    adam = {"state": {0: dict(moments), 1: dict(moments)}, "param_groups": [{"lr": 1e-3, "params": [0, 1]}]}
    state = {"net": {"weight": th.ones(2, dtype=th.bfloat16)}, "adam": adam, "array": np.ones(2), "names": ["a"]}
    assert files.first_not_finite(state) is None
    for value in (th.nan, th.inf, -th.inf):
        moments["exp_avg"][1] = value
        assert files.first_not_finite(state) == "adam.state.0.exp_avg"
    state["net"]["weight"][0] = th.nan  # type: ignore[index]
    assert files.first_not_finite(state) == "net.weight"
    del state["net"]
    state["array"][0] = np.inf
    del state["adam"]
    with pytest.raises(
        NotFiniteError, match=r"model is not saved: its weight array is not finite. If m\.zip exists, it is kept"
    ):
        files.check_finite("m.zip", "model", state)


# ---------------------------------------------------------------------- folders

HOLD = """
import pathlib, sys
if sys.argv[2] == "without fcntl":
    sys.modules["fcntl"] = None
from sb3_cpm import files
try:
    with files.locked(pathlib.Path(sys.argv[1])):
        print("held", flush=True)
        sys.stdin.readline()
except files.LockedError as error:
    print(error)
"""


@pytest.mark.parametrize("how", ["with fcntl", "without fcntl"])
def test_one_process_per_folder(how: str, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with python(HOLD, folder, how) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        before = sorted(folder.iterdir())
        with python(HOLD, folder, how) as second:
            told, _ = second.communicate("")
            assert told == f"{folder} is being written by another process. Wait for it, or choose another folder.\n"
        assert sorted(folder.iterdir()) == before
        holder.kill()
    with python(HOLD, folder, how) as third:  # the lock went with its process
        assert third.communicate("\n")[0] == "held\n"


def test_a_lock_holds_within_the_process_too(tmp_path: Path) -> None:
    with files.locked(tmp_path), pytest.raises(LockedError), files.locked(tmp_path):
        pass
    with files.locked(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_locking_costs_next_to_nothing(tmp_path: Path) -> None:
    started = time.process_time()
    for _ in range(20):
        with files.locked(tmp_path):
            files.write_text(tmp_path / "a", "b")
    assert time.process_time() - started < 1.0
