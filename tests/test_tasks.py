"""
The tasks of the report: with their objects in processes of their own (tasks_on_assets.py), the check of those objects, and
states on a machine that cannot draw.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import standin_assets

from sb3_cpm.__main__ import main
from sb3_cpm.envs import assets, make_maniskill_env

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
        ("PickSingleEGAD-v1", f"{EGAD}/egad_train_set/A0_0.obj", Path.unlink, "egad_train_set/A0_0.obj is missing"),
        ("TurnFaucet-v1", f"{PARTNET}/5004/mobility_cvx.urdf", Path.unlink, "5004 is not there"),
        ("TurnFaucet-v1", f"{PARTNET}/5004/mobility_cvx.urdf", cut_off, "is damaged"),
        ("OpenCabinetDoor-v1", f"{PARTNET}/../shapes/ball.obj", Path.unlink, "shapes/ball.obj is missing"),
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


def test_a_failed_download_leaves_nothing(asset_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mani_skill.utils import download_asset

    folder = asset_dir / EGAD
    (folder / "info_pick_train_v0.json").unlink()

    def fail(source: Any, **_: Any) -> None:
        assert source.url.endswith(".zip")
        raise OSError("no network")

    monkeypatch.setattr(download_asset, "download", fail)
    with pytest.raises(RuntimeError, match=r"egad could not be downloaded: no network.*by hand"):
        list(assets.download(["PickSingleEGAD-v1"]))
    assert not folder.exists()

    def succeed(source: Any, **_: Any) -> None:
        standin_assets.make_egad(folder)

    monkeypatch.setattr(download_asset, "download", succeed)
    assert len(list(assets.download(["PickSingleEGAD-v1"]))) == 1
    assert list(assets.download(["PickSingleEGAD-v1"])) == []  # what is there is not fetched again


BROKEN = """
from sb3_cpm.envs import make_maniskill_env
for env_id in ("PickSingleYCB-v1", "PickSingleEGAD-v1", "TurnFaucet-v1"):
    try:
        make_maniskill_env(env_id).reset(seed=0)
    except RuntimeError as error:
        assert "ailed to load" in str(error) and f"assets --download {env_id}" in str(error), error
        print("refused")
"""


def test_a_file_with_the_wrong_contents_is_an_error_with_the_cure(tmp_path: Path) -> None:
    standin_assets.make_all(tmp_path)
    for pattern in (f"{YCB}/models/*/textured.obj", f"{EGAD}/egad_train_set_coacd/*.obj", "partnet_mobility/shapes/*.obj"):
        for file in (tmp_path / "data").glob(pattern):
            file.write_text("hello")
    child = run(["-c", BROKEN], MS_ASSET_DIR=str(tmp_path))
    assert child.stdout.count("refused") == 3, child.stdout + child.stderr


# ---------------------------------------------------------------------- states without a renderer
STATES = """
import hashlib
import numpy as np
from sb3_cpm.envs import make_maniskill_env
from sb3_cpm.envs.tasks import REPORT_TASKS
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
