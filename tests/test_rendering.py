"""Finding and curing the renderer: the real one in child processes, apt's and SAPIEN's texts by example."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_cpm.__main__ import main
from sb3_cpm.machine import rendering, vulkan, vulkan_install

NOWHERE = {"VK_DRIVER_FILES": "/nonexistent.json", "VK_ICD_FILENAMES": "/nonexistent.json"}
"""A machine without Vulkan, as far as Vulkan's loader can tell."""

NEEDS_SYSTEM = pytest.mark.skipif(
    vulkan.private_in_use(), reason="without its private installation SAPIEN lacks other libraries here, too"
)

DEB822 = """Types: deb
# http://snapshot.example/20250520
URIs: http://server.example/os
Suites: bookworm bookworm-updates
Components: main
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg

Types: deb
URIs: http://server.example/os-security
Suites: bookworm-security
Components: main
"""


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=600,
    )


# ---------------------------------------------------------------------- package sources
def test_backports_copy_mirror_and_key_of_the_release() -> None:
    made = vulkan_install.backports_source({"debian.sources": DEB822}, "bookworm")
    assert made == (
        "sb3-cpm-backports.sources",
        "Types: deb\nURIs: http://server.example/os\nSuites: bookworm-backports\nComponents: main\n"
        "Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg\n",
    )


def test_backports_from_the_old_format() -> None:
    text = "# deb http://old.example bookworm main\ndeb [signed-by=/key.gpg] http://server.example/os bookworm main contrib\n"
    made = vulkan_install.backports_source({"sources.list": text}, "bookworm")
    expected = "deb [signed-by=/key.gpg] http://server.example/os bookworm-backports main contrib\n"
    assert made == ("sb3-cpm-backports.list", expected)


@pytest.mark.parametrize(
    ("text", "codename"),
    [
        (DEB822, None),  # not Debian
        (DEB822, "trixie"),  # nothing to copy
        (DEB822 + "\nTypes: deb\nURIs: http://m/os\nSuites: bookworm-backports\nComponents: main\n", "bookworm"),
        (DEB822.replace("Types: deb\n#", "Types: deb\nEnabled: no\n#"), "bookworm"),
    ],
)
def test_no_backports_where_they_make_no_sense(text: str, codename: str | None) -> None:
    assert vulkan_install.backports_source({"debian.sources": text}, codename) is None


def test_newest_suite_wants_a_mesa_that_sapien_can_use() -> None:
    old = "mesa-vulkan-drivers | 22.3.6-1+deb12u1 | http://server.example/os bookworm/main amd64 Packages\n"
    new = "mesa-vulkan-drivers | 25.0.7-2~bpo12+1 | http://server.example/os bookworm-backports/main amd64 Packages\n"
    source = "mesa | 26.0.0-1 | http://server.example/os sid/main Sources\n"
    assert vulkan_install.newest_suite(old + new + source) == "bookworm-backports"
    assert vulkan_install.newest_suite(old + source) is None
    assert vulkan_install.newest_suite("") is None
    assert vulkan_install.newest_suite(old.replace("22.3.6", "1:24.3.0")) == "bookworm"


# ---------------------------------------------------------------------- what SAPIEN says
def test_device_names() -> None:
    summary = (
        "GPU: NVIDIA H200\n  Supported: 1\n  Present:   0\n  cudaId:    0\n  rayTrace:  1\n\n"
        "GPU: Old Card\n  Supported: 0\n  cudaId:    -1\n\n"
        "GPU: llvmpipe (LLVM 15.0.6, 256 bits)\n  Supported: 1\n  Present:   0\n  cudaId:    -1\n"
    )
    assert rendering.device_names(summary) == [("NVIDIA H200", True), ("llvmpipe (LLVM 15.0.6, 256 bits)", False)]
    assert rendering.device_names("") == []


def test_cache_folder_falls_back_to_the_temporary_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SB3_CPM_CACHE", str(tmp_path / "mine"))
    assert vulkan.cache_folder() == tmp_path / "mine" and (tmp_path / "mine").is_dir()
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.delenv("SB3_CPM_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert vulkan.cache_folder() == tmp_path / f"sb3_cpm-{os.getuid()}"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_what_others_could_have_planted_is_not_trusted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Native libraries are loaded from this folder, and its name in the temporary folder can be guessed."""
    blocked = tmp_path / "file"
    blocked.touch()
    monkeypatch.delenv("SB3_CPM_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    guessed = tmp_path / f"sb3_cpm-{os.geteuid()}"
    assert vulkan.cache_folder() == guessed and guessed.stat().st_mode & 0o777 == 0o700
    os.chown(guessed, 12345, 12345)
    with pytest.raises(RuntimeError, match=r"no folder to keep libraries in: .* belongs to another user \(number 12345\)"):
        vulkan.cache_folder()
    guessed.rename(tmp_path / "theirs")
    (tmp_path / "ours").mkdir()
    guessed.symlink_to(tmp_path / "ours")
    os.chown(guessed, 12345, 12345, follow_symlinks=False)
    with pytest.raises(RuntimeError, match="belongs to another user"):  # a link of theirs to a folder of ours
        vulkan.cache_folder()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    folder = vulkan.cache_folder()
    assert folder == tmp_path / "home/sb3_cpm", "another one will do"
    folder.chmod(0o775)  # made with a umask of 002
    assert vulkan.cache_folder() == folder and folder.stat().st_mode & 0o777 == 0o755
    for mode in (0o777, 0o1777):
        folder.chmod(mode)
        with pytest.raises(RuntimeError, match="can be written by others"):
            vulkan.cache_folder()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
@pytest.mark.parametrize("planted", ["", "vulkan", "vulkan/icd.json", "vulkan/root/usr/lib/x86_64-linux-gnu/libplanted.so"])
def test_a_planted_library_is_not_loaded(planted: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    library = tmp_path / "vulkan/root/usr/lib/x86_64-linux-gnu/libplanted.so"
    library.parent.mkdir(parents=True)
    library.touch()
    (tmp_path / "vulkan/icd.json").write_text("{}")
    monkeypatch.setenv("SB3_CPM_CACHE", str(tmp_path))
    for name in vulkan.DRIVER_VARIABLES:
        monkeypatch.setenv(name, "")  # and taken away again, what activation sets
    loaded: list[Path] = []
    monkeypatch.setattr(vulkan, "_loads", lambda path: loaded.append(path) or True)
    assert vulkan.activate_private() and loaded == [library]
    loaded.clear()
    os.chown(tmp_path / planted, 12345, 12345)
    with pytest.raises(RuntimeError, match="belongs to another user .*12345.*(native libraries are loaded|is not loaded)"):
        vulkan.activate_private()
    assert not loaded
    os.chown(tmp_path / planted, 0, 0)
    (tmp_path / planted).chmod(0o777)
    with pytest.raises(RuntimeError, match="can be written by others"):
        vulkan.activate_private()
    assert not loaded


def test_the_system_is_only_changed_on_demand(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Nobody is asked either: a batch job would wait for ever."""
    installed: list[str] = []
    broken = rendering.Probe(None, "", "no driver", 0.0)
    monkeypatch.setattr(rendering, "probe_renderer", lambda **_: broken)
    monkeypatch.setattr(vulkan, "named_drivers", lambda: "")
    monkeypatch.setattr(vulkan_install, "install_private", lambda say: installed.append("private"))
    monkeypatch.setattr(vulkan_install, "install_system", lambda say: installed.append("system"))
    for uid in (0, 1000):
        monkeypatch.setattr(os, "geteuid", lambda uid=uid: uid)
        for options in ([], ["--private"], ["--system"]):
            main(["setup-rendering", *options])
    assert installed == ["private", "private", "system", "private", "private"]
    assert "needs root: run it as root, or leave --system out" in capsys.readouterr().err


def test_publish_keeps_what_is_there(tmp_path: Path) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text(name)
        rendering.publish(tmp_path / name, tmp_path / "target")
    assert (tmp_path / "target" / "file").read_text() == "first"


def test_a_failed_import_of_opencv_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", ["/site-packages/cv2", "/site-packages"])
    monkeypatch.delitem(sys.modules, "cv2", raising=False)
    vars(sys)["OpenCV_LOADER"] = True
    vulkan.forget_failed_opencv()
    assert sys.path == ["/site-packages"] and not hasattr(sys, "OpenCV_LOADER")


@pytest.mark.slow
# ---------------------------------------------------------------------- the real renderer
@pytest.mark.maniskill
def test_probe_and_set_up_where_rendering_works(capsys: pytest.CaptureFixture[str]) -> None:
    probe = rendering.probe_renderer()
    assert probe.problem == "" and probe.renderer is not None
    assert probe.driver  # e.g. "Mesa 25.0.7 (LLVM 15.0.6)"
    assert rendering.setup_rendering() == 0  # nothing to do, nothing done
    assert "SAPIEN renders" in capsys.readouterr().out


@pytest.mark.slow
@NEEDS_SYSTEM
@pytest.mark.maniskill
def test_a_machine_without_vulkan_gets_the_cure(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name, value in NOWHERE.items():
        monkeypatch.setenv(name, value)
    probe = rendering.probe_renderer()
    assert probe.renderer is None and "No usable Vulkan driver" in probe.problem
    assert rendering.setup_rendering() == 1  # installing would not help, so nothing is installed
    assert "unset VK_DRIVER_FILES=/nonexistent.json" in capsys.readouterr().out
    code = "from sb3_cpm.envs import make_maniskill_env; make_maniskill_env('PickCube-v1')"
    child = python(code)
    assert child.returncode == 1 and "RuntimeError: No usable Vulkan driver" in child.stderr and "unset VK_" in child.stderr


@pytest.mark.maniskill
def test_a_crash_is_told_from_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/sh")  # a child that does not even know Python
    assert rendering.probe_renderer().renderer is None
    crash = "import os, signal; print('>draw a picture', flush=True); os.kill(os.getpid(), signal.SIGSEGV)"
    monkeypatch.undo()
    run = subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda command, **k: run([command[0], "-c", crash], **k))
    assert "died of SIGSEGV while it tried to draw a picture" in rendering.probe_renderer().problem
    hang = "import time; print('>draw a picture', flush=True); time.sleep(60)"
    monkeypatch.setattr(subprocess, "run", lambda command, **k: run([command[0], "-c", hang], **k))
    assert "hung for 3 s while it tried to draw a picture" in rendering.probe_renderer(timeout=3).problem


@pytest.mark.maniskill
def test_a_private_driver_is_used(tmp_path: Path) -> None:
    """The private installation, played by the machine's own driver: without the folder nothing would be found."""
    drivers = [p for folder in ("/usr/share", "/etc") for p in Path(folder, "vulkan/icd.d").glob("lvp_icd*.json")]
    private = vulkan.private_folder() / "icd.json"
    if drivers:
        description = json.loads(drivers[0].read_text())
        library = description["ICD"]["library_path"]
        found = [p for p in Path("/usr").glob(f"lib*/*/{Path(library).name}")] + [Path(library)]
        description["ICD"]["library_path"] = str(found[0])
    elif private.exists():
        description = json.loads(private.read_text())
    else:
        pytest.skip("this machine renders with a graphics card and has no software driver to play with")
    (tmp_path / "vulkan").mkdir()
    (tmp_path / "vulkan/icd.json").write_text(json.dumps(description))
    if (vulkan.private_folder() / "root").exists():  # with the other libraries that SAPIEN needs
        (tmp_path / "vulkan/root").symlink_to(vulkan.private_folder() / "root")
    code = """
import os
from sb3_cpm.machine import rendering
renderer = rendering.ensure_renderer()
assert renderer.software and os.environ["VK_DRIVER_FILES"] == os.environ["VK_ICD_FILENAMES"]
print(os.environ["VK_DRIVER_FILES"])
"""
    environment = {name: "" for name in vulkan.DRIVER_VARIABLES}
    child = python(code, SB3_CPM_CACHE=str(tmp_path), **environment)
    assert child.returncode == 0, child.stderr
    assert child.stdout.strip() == str(tmp_path / "vulkan/icd.json")


PICTURES = """
import sys
import numpy as np
from sb3_cpm.envs import make_maniskill_env
from sb3_cpm.machine import rendering
if sys.argv[1] == "stock":
    rendering.use_fast_shaders = lambda: False
env = make_maniskill_env("PickCube-v1", image_size=16, render_size=48, visuals="light")
frames = [env.reset(seed=0)[0]]
frames += [env.step(np.full(7, 0.5, dtype=np.float32))[0] for _ in range(3)]
np.savez(sys.argv[2], frame=env.render(), **{f"{k}{i}": v for i, f in enumerate(frames) for k, v in f.items()})
"""


@pytest.mark.maniskill
@pytest.mark.slow
def test_fast_shaders_draw_the_same_to_the_last_bit(tmp_path: Path) -> None:
    if not rendering.ensure_renderer().software:
        pytest.skip("only used with a software renderer")
    for kind in ("stock", "fast"):
        code = PICTURES.replace("sys.argv[1]", repr(kind)).replace("sys.argv[2]", repr(str(tmp_path / f"{kind}.npz")))
        child = python(code)
        assert child.returncode == 0, child.stderr
    stock, fast = (dict(np.load(tmp_path / f"{kind}.npz")) for kind in ("stock", "fast"))
    assert stock.keys() == fast.keys() and len(stock) == 4 * 4 + 1
    for key, value in stock.items():
        np.testing.assert_array_equal(value, fast[key], err_msg=key)
