"""
The tasks of the report: with their objects in processes of their own (tasks_on_assets.py), the check of those objects, and
states on a machine that cannot draw.
"""

import dataclasses
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import standin_assets

from sb3_cpm.__main__ import main
from sb3_cpm.envs import make_maniskill_env
from sb3_cpm.envs.maniskill import assets
from sb3_cpm.machine import vulkan

pytestmark = pytest.mark.maniskill

NOWHERE = {"VK_DRIVER_FILES": "/nonexistent.json", "VK_ICD_FILENAMES": "/nonexistent.json"}
"""A machine without Vulkan, as far as Vulkan's loader can tell."""

WITH_FILES = ("PickSingleYCB-v1", "PickSingleEGAD-v1", "TurnFaucet-v1", "OpenCabinetDrawer-v1", "OpenCabinetDoor-v1")


@pytest.fixture(scope="module")
def standins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("assets")
    standin_assets.make_all(folder)
    return folder


def run(arguments: list[str], **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "ignore", *arguments]
    return subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=900, stdin=subprocess.DEVNULL
    )


# ---------------------------------------------------------------------- all tasks, on stand-ins and on the real objects
@pytest.mark.slow
def test_tasks_on_standins(standins: Path) -> None:
    here = Path(__file__).parent
    child = run(["-m", "pytest", "-q", "-p", "no:cacheprovider", str(here / "tasks_on_assets.py")], MS_ASSET_DIR=str(standins))
    assert child.returncode == 0 and "skipped" not in child.stdout, child.stdout[-6000:]


@pytest.mark.slow
def test_tasks_on_the_real_objects() -> None:
    present = [env_id for env_id in WITH_FILES if all(ready for ready, _ in assets.report([env_id]))]
    if not present:
        pytest.skip("none of the objects that tasks download is here (python -m sb3_cpm assets --download)")
    here = Path(__file__).parent
    child = run(["-m", "pytest", "-q", "-p", "no:cacheprovider", str(here / "tasks_on_assets.py"), "-k", " or ".join(present)])
    assert child.returncode == 0, child.stdout[-6000:]


# ---------------------------------------------------------------------- requests that cannot be fulfilled
@pytest.mark.parametrize(
    ("env_id", "kwargs", "message"),
    [
        ("TurnFaucet-v1", {"reward_mode": "dens"}, "it has: normalized_dense, dense, sparse, none"),
        ("PickCube-v1", {"robot_uids": "anymal_c"}, "not made for robot 'anymal_c'. It takes: fetch, panda, panda_wristcam"),
        ("OpenCabinetDrawer-v1", {"robot_uids": "panda"}, "It takes: fetch"),
        ("LiftCube-v1", {"control_mode": "pd_ee_delta"}, "Did you mean pd_ee_delta"),
    ],
)
def test_bad_requests_name_what_there_is(env_id: str, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_maniskill_env(env_id, **kwargs)


# ---------------------------------------------------------------------- assets
@pytest.fixture
def asset_dir(standins: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand-ins of the test's own, to be damaged; ManiSkill in this process is told of them."""
    standin_assets.make_all(tmp_path)
    folder = assets._folder

    def moved(source_id: str) -> Path:
        from mani_skill import ASSET_DIR

        return tmp_path / "data" / folder(source_id).relative_to(ASSET_DIR)

    monkeypatch.setattr(assets, "_folder", moved)
    return tmp_path / "data"


def test_assets_lists_all_tasks(asset_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["assets"]) == 0
    output = capsys.readouterr().out
    assert output.count("ready") == 8 and "needs no files" in output and "mani_skill2_ycb" in output
    assert main(["assets", "NoTask-v1"]) == 1
    assert "Unknown task 'NoTask-v1'" in capsys.readouterr().err


YCB, EGAD, PARTNET = "assets/mani_skill2_ycb", "mani_skill2_egad", "partnet_mobility/dataset"


def cut_off(file: Path) -> None:
    file.write_text("{")


def half(file: Path) -> None:
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])


def most(file: Path) -> None:
    """Cut off in one of the last lines, after its second number."""
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:-3], " ".join(lines[-3].split()[:3])]))


def empty(file: Path) -> None:
    file.write_text("")


@pytest.mark.parametrize(
    ("env_id", "file", "damage", "message"),
    [
        ("PickSingleYCB-v1", f"{YCB}/info_pick_v0.json", Path.unlink, "info_pick_v0.json"),
        ("PickSingleYCB-v1", f"{YCB}/info_pick_v0.json", cut_off, "missing or damaged (JSONDecodeError)"),
        ("PickSingleYCB-v1", f"{YCB}/models/002_can/collision.ply", Path.unlink, "002_can/collision.ply is missing"),
        ("PickSingleYCB-v1", f"{YCB}/models/002_can/textured.obj", empty, "002_can/textured.obj is empty"),
        ("PickSingleYCB-v1", f"{YCB}/models/002_can/collision.ply", cut_off, "002_can/collision.ply is damaged"),
        ("PickSingleYCB-v1", f"{YCB}/models/002_can/collision.ply", half, "can/collision.ply is damaged (it ends early)"),
        ("PickSingleYCB-v1", f"{YCB}/models/002_can/collision.ply", most, "can/collision.ply is damaged (it ends early)"),
        ("PickSingleYCB-v1", f"{YCB}/models/002_can/textured.obj", most, "can/textured.obj is damaged (it ends early)"),
        ("PickSingleEGAD-v1", f"{EGAD}/egad_train_set_coacd/A0_0.obj", half, "A0_0.obj is damaged (it ends early)"),
        ("PickSingleEGAD-v1", f"{EGAD}/egad_train_set/A0_0.obj", Path.unlink, "egad_train_set/A0_0.obj is missing"),
        ("TurnFaucet-v1", f"{PARTNET}/5004/mobility_cvx.urdf", Path.unlink, "5004 is not there"),
        ("TurnFaucet-v1", f"{PARTNET}/5004/mobility_cvx.urdf", cut_off, "is damaged"),
        ("OpenCabinetDoor-v1", f"{PARTNET}/../shapes/ball.obj", Path.unlink, "shapes/ball.obj is missing"),
        ("OpenCabinetDoor-v1", f"{PARTNET}/../shapes/ball.obj", most, "shapes/ball.obj is damaged (it ends early)"),
    ],
)
def test_what_is_missing_or_damaged_is_named(
    asset_dir: Path,
    capsys: pytest.CaptureFixture[str],
    env_id: str,
    file: str,
    damage: Callable[[Path], Any],
    message: str,
) -> None:
    damage(asset_dir / file)
    assert main(["assets", env_id]) == 1
    output = capsys.readouterr().out
    assert message in output and f"get it: python -m sb3_cpm assets --download {env_id}" in output
    with pytest.raises(RuntimeError, match="MS_ASSET_DIR moves that") as error:
        make_maniskill_env(env_id)
    assert message in str(error.value)
    assets.require_assets.cache_clear()


@pytest.mark.parametrize("text", ["v 0 0 0\nf 1 2 3", "v 0 0 0\nf 1//1 2//2 3//3 4//4\r\n# the end\r\n\r\n", "g a\n"])
def test_unusual_ends_of_whole_files(tmp_path: Path, text: str) -> None:
    file = tmp_path / "mesh.obj"
    file.write_bytes(text.encode())
    assert assets._absent([file]) == []


def test_a_failed_download_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mani_skill.utils.assets import DATA_SOURCES

    list(assets.report(["PickSingleEGAD-v1"]))  # makes the task known
    standin_assets.make_all(tmp_path / "assets")
    data, archive = tmp_path / "assets/data", tmp_path / "egad"
    folder = data / EGAD
    # ManiSkill's own download, from a file
    source = dataclasses.replace(DATA_SOURCES["egad"], url=f"file://{archive}.zip", output_dir=data, checksum=None)
    monkeypatch.setitem(DATA_SOURCES, "egad", source)

    def names() -> list[str]:
        return sorted(str(file.relative_to(data)) for file in data.rglob("*") if EGAD in str(file))

    assert list(assets.download(["PickSingleEGAD-v1"])) == []  # what is there is not fetched again
    whole = names()
    (folder / "egad_train_set/B1_2.obj").unlink()
    before = names()

    def fails(message: str, error: type[BaseException] = RuntimeError) -> None:
        with pytest.raises(error, match=message):
            list(assets.download(["PickSingleEGAD-v1"]))
        assert names() == before

    fails(r"egad could not be downloaded: .*by hand")  # no such archive
    shutil.make_archive(str(archive), "zip", data, f"{EGAD}/egad_train_set")
    fails("egad could not be downloaded: what came is not complete: info_pick_train_v0.json")

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt("Ctrl-C")

    with monkeypatch.context() as patch:
        patch.setattr("urllib.request.urlretrieve", interrupted)
        fails("Ctrl-C", KeyboardInterrupt)
    # an attempt that was killed: half of the new, and the old one still out of the way
    folder.rename(folder.with_name(f"{EGAD}.before"))
    (folder / "half").mkdir(parents=True)
    fails("could not be downloaded")
    # nothing was there
    shutil.rmtree(folder)
    before = names()
    fails("could not be downloaded")
    standin_assets.make_egad(tmp_path / EGAD)
    shutil.make_archive(str(archive), "zip", tmp_path, EGAD)
    content = archive.with_suffix(".zip").read_bytes()
    (line,) = assets.download(["PickSingleEGAD-v1"])
    assert names() == whole and line.endswith("egad.zip (UNCHECKED: ManiSkill knows no digest of it) ...")
    # where it knows one, it compares it
    (folder / "egad_train_set/B1_2.obj").unlink()
    before = names()
    for digest in ("0" * 64, hashlib.sha256(content).hexdigest()):
        archive.with_suffix(".zip").write_bytes(content)  # ManiSkill removes what it has unpacked
        monkeypatch.setitem(DATA_SOURCES, "egad", dataclasses.replace(source, checksum=digest))
        if digest == "0" * 64:
            fails("SHA-256 hash does not match")
    (line,) = assets.download(["PickSingleEGAD-v1"])
    assert names() == whole and line.endswith("(its SHA-256 is checked) ...")


BROKEN = """
from sb3_cpm.envs import make_maniskill_env
for env_id in ("PickSingleYCB-v1", "PickSingleEGAD-v1", "TurnFaucet-v1"):
    try:
        make_maniskill_env(env_id).reset(seed=0)
    except RuntimeError as error:
        assert "ailed to load" in str(error) and f"assets --download {env_id}" in str(error), error
        print("refused")
"""


@pytest.mark.slow
def test_a_file_with_the_wrong_contents_is_an_error_with_the_cure(tmp_path: Path) -> None:
    standin_assets.make_all(tmp_path)
    for pattern in (f"{YCB}/models/*/textured.obj", f"{EGAD}/egad_train_set_coacd/*.obj", "partnet_mobility/shapes/*.obj"):
        for file in (tmp_path / "data").glob(pattern):
            file.write_text("hello")
    child = run(["-c", BROKEN], MS_ASSET_DIR=str(tmp_path))
    assert child.stdout.count("refused") == 3, child.stdout + child.stderr


LATER = """
import sys
from sb3_cpm.envs import make_maniskill_env
env_id, file, size = sys.argv[1:]
env = make_maniskill_env(env_id, obs_mode="state")
whole = open(file, "rb").read()
open(file, "wb").write(whole[: int(size)])
try:
    for seed in range(30):
        env.reset(seed=seed)
except RuntimeError as error:
    assert f"assets --download {env_id}" in str(error), error
    print("explained")
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "file"),
    [
        ("PickSingleYCB-v1", f"{YCB}/models/003_ball/collision.ply"),
        ("PickSingleEGAD-v1", f"{EGAD}/egad_train_set_coacd/A0_0.obj"),
    ],
)
def test_a_file_that_turns_out_to_be_damaged_at_a_reset(tmp_path: Path, env_id: str, file: str) -> None:
    """Tasks that choose an object per episode read its file then."""
    standin_assets.make_all(tmp_path)
    child = run(["-c", LATER, env_id, str(tmp_path / "data" / file), "40"], MS_ASSET_DIR=str(tmp_path))
    assert "explained" in child.stdout, child.stdout + child.stderr


# ---------------------------------------------------------------------- states without a renderer
STATES = """
import hashlib
import numpy as np
from sb3_cpm.envs import make_maniskill_env
from sb3_cpm.envs.maniskill.tasks import REPORT_TASKS
for env_id in REPORT_TASKS:
    try:
        env = make_maniskill_env(env_id, obs_mode="state")
    except RuntimeError as error:
        print(env_id, "refused:", error)
        continue
    digest = hashlib.sha256()
    for seed in range(2):
        digest.update(env.reset(seed=seed)[0]["state"].tobytes())
        for action in np.random.default_rng(0).uniform(-1, 1, (8, *env.action_space.shape)):
            observation, reward, *_ = env.step(action)
            digest.update(observation["state"].tobytes() + np.float64(reward).tobytes())
    print(env_id, digest.hexdigest())
    assert not DRAWS or env.render() is not None
    assert DRAWS or env.render() is None
    env.close()
"""


@pytest.mark.slow
@pytest.mark.skipif(vulkan.private_in_use(), reason="without its private installation SAPIEN lacks other libraries here, too")
def test_states_without_a_vulkan_driver_are_the_same(standins: Path) -> None:
    with_driver = run(["-c", STATES.replace("DRAWS", "True")], MS_ASSET_DIR=str(standins))
    without = run(["-c", STATES.replace("DRAWS", "False")], MS_ASSET_DIR=str(standins), **NOWHERE)
    assert with_driver.returncode == without.returncode == 0, with_driver.stderr + without.stderr
    expected, found = (dict(line.split(" ", 1) for line in c.stdout.splitlines()) for c in (with_driver, without))
    cabinets = [env_id for env_id in expected if env_id.startswith("OpenCabinet")]
    assert len(expected) == 8 and len(cabinets) == 2
    for env_id, digest in expected.items():
        if env_id in cabinets:
            assert len(digest) == 64
            assert "needs a renderer even with obs_mode='state'" in found[env_id] and "unset VK_" in found[env_id]
        else:
            assert found[env_id] == digest, env_id
