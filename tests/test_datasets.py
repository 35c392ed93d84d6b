"""Data sets of Minari and LeRobot, written here in their formats, are read as they are, or refused in words."""

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

pytest.importorskip("pyarrow", reason="the extra `datasets`")

import imageio.v3 as iio
import pyarrow as pa
import pyarrow.parquet as pq
from stable_baselines3.common.env_util import make_vec_env

from sb3_cpm import CPMBuffer
from sb3_cpm.buffers.demonstrations import as_arrays
from sb3_cpm.imitation import load_demonstrations
from sb3_cpm.imitation.datasets import read_lerobot, read_minari

SPACE = spaces.Dict(
    {"state": spaces.Box(-np.inf, np.inf, (3,), np.float32), "camera": spaces.Box(0, 255, (16, 16, 3), np.uint8)}
)
STATE = spaces.Dict({"state": SPACE["state"]})
LENGTHS = (4, 6, 5)


def episodes_of(rng: np.random.Generator) -> list[dict[str, np.ndarray]]:
    """With the observation after the last action."""
    return [
        {
            "state": rng.normal(size=(length + 1, 3)).astype(np.float32),
            "camera": rng.integers(0, 256, (length + 1, 16, 16, 3), dtype=np.uint8),
            "action": rng.uniform(-1, 1, (length, 2)).astype(np.float32),
            "reward": rng.normal(size=length).astype(np.float32),
        }
        for length in LENGTHS
    ]


EPISODES = episodes_of(np.random.default_rng(0))


# ---------------------------------------------------------------------- Minari


@pytest.fixture
def minari_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes a data set in a folder of its own; the second of its episodes terminates."""
    minari = pytest.importorskip("minari", reason="the extra `datasets`")
    from minari.data_collector.episode_buffer import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def make(name: str, space: spaces.Space, observe: Any) -> Any:
        buffers = []
        for number, one in enumerate(EPISODES):
            last = np.arange(len(one["reward"])) == len(one["reward"]) - 1
            buffers.append(
                EpisodeBuffer(
                    id=number,
                    observations=observe(one),
                    actions=one["action"],  # type: ignore[arg-type]
                    rewards=one["reward"],  # type: ignore[arg-type]
                    terminations=list(last & (number == 1)),
                    truncations=list(last & (number != 1)),
                    infos={},
                )
            )
        arguments = dict(action_space=spaces.Box(-1, 1, (2,), np.float32), observation_space=space, data_format="hdf5")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that nobody is named as its author, and so on
            return minari.create_dataset_from_buffers(name, buffers, jpeg_encoding=False, **arguments)  # type: ignore

    return make


def assert_equal(found: Any, keys: tuple[str, ...] = ("state", "camera"), n: int = 3) -> None:
    assert len(found) == n
    for number, (one, source) in enumerate(zip(found, EPISODES, strict=False)):
        assert one.observations.keys() == set(keys)
        for key in keys:
            np.testing.assert_array_equal(one.observations[key], source[key])
            assert one.observations[key].dtype == SPACE[key].dtype
        np.testing.assert_array_equal(one.actions, source["action"])
        np.testing.assert_array_equal(one.rewards, source["reward"])
        assert one.terminated == (number == 1)


def test_minari_by_name_by_folder_and_as_it_is(minari_names: Any, tmp_path: Path) -> None:
    dataset = minari_names("test/toy-v0", SPACE, lambda one: {key: one[key] for key in SPACE.spaces})
    for source in ("test/toy-v0", tmp_path / "test" / "toy-v0", dataset):
        assert_equal(read_minari(source, SPACE))
    assert_equal(read_minari(dataset, STATE, n_episodes=2), ("state",), n=2)
    with pytest.raises(ValueError, match=r"no data set test/toi-v0 on this machine \(test/toy-v0\).*minari download"):
        read_minari("test/toi-v0", SPACE)
    with pytest.raises(ValueError, match=r"test/toy-v0: it has no observation 'cloud', but \['camera', 'state'\]"):
        read_minari(dataset, STATE, keys={"state": "cloud"})
    with pytest.raises(ValueError, match="unknown key 'stat'. Did you mean 'state'"):
        read_minari(dataset, STATE, keys={"stat": "state"})
    with pytest.raises(ValueError, match="'camera' are float32, the environment's uint8"):
        read_minari(dataset, SPACE, keys={"camera": "state"})


def test_minari_with_other_names_and_none(minari_names: Any) -> None:
    nested = spaces.Dict({"robot": STATE, "eye": SPACE["camera"]})
    dataset = minari_names("nested-v0", nested, lambda one: {"robot": {"state": one["state"]}, "eye": one["camera"]})
    assert_equal(read_minari(dataset, SPACE, keys={"state": "robot/state", "camera": "eye"}))
    flat = minari_names("flat-v0", SPACE["state"], lambda one: one["state"])
    assert_equal(read_minari(flat, STATE), ("state",))
    with pytest.raises(ValueError, match="no observation 'camera', but a single one"):
        read_minari(flat, SPACE)


# ---------------------------------------------------------------------- LeRobot


def write_lerobot(folder: Path, version: str, pictures: str = "image", **columns: bool) -> Path:
    """
    Frames without the observation after the last action, as LeRobot's.

    :param pictures: "image" or "video"
    :param columns: whether there are a ``reward`` and a ``success``, which is the second episode's
    """
    columns = {"reward": True, "success": True, **columns}
    data = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    video = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    if version == "v3.0":
        data = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        video = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": [3]},
        "observation.images.camera": {"dtype": pictures, "shape": [16, 16, 3]},
        "action": {"dtype": "float32", "shape": [2]},
        "episode_index": {"dtype": "int64", "shape": [1]},
        "frame_index": {"dtype": "int64", "shape": [1]},
    }
    tables, places, start = [], [], 0
    for number, one in enumerate(EPISODES):
        n = len(one["action"])
        rows: dict[str, Any] = {
            "observation.state": list(one["state"][:n]),
            "action": list(one["action"]),
            "episode_index": np.full(n, number),
            "frame_index": np.arange(n),
        }
        if pictures == "image":
            encoded = [iio.imwrite("<bytes>", picture, extension=".png") for picture in one["camera"][:n]]
            rows["observation.images.camera"] = [{"bytes": picture, "path": ""} for picture in encoded]
        if columns["reward"]:
            features["next.reward"] = {"dtype": "float32", "shape": [1]}
            rows["next.reward"] = one["reward"]
        if columns["success"]:
            features["next.success"] = {"dtype": "bool", "shape": [1]}
            rows["next.success"] = (np.arange(n) == n - 1) & (number == 1)
        tables.append(pa.table(rows))
        place = {f"videos/observation.images.camera/{part}": 0 for part in ("chunk_index", "file_index")}
        places.append({"episode_index": number, **place, "videos/observation.images.camera/from_timestamp": start / 10})
        start += n
    if version == "v3.0":
        tables = [pa.concat_tables(tables)]
        (folder / "meta/episodes/chunk-000").mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(places), folder / "meta/episodes/chunk-000/file-000.parquet")
    for number, table in enumerate(tables):
        names = dict.fromkeys(("episode_chunk", "chunk_index"), 0) | dict.fromkeys(("episode_index", "file_index"), number)
        file = folder / data.format(**names)
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, file)
    if pictures == "video":
        write_videos(folder, video, together=version == "v3.0")
    info = {"codebase_version": version, "features": features, "chunks_size": 1000, "fps": 10, "video_path": video}
    (folder / "meta").mkdir(exist_ok=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


def grey(episode: int, frame: int) -> int:
    """What all pixels of a frame of the videos have: compression leaves that nearly as it is."""
    return 20 + 60 * episode + 8 * frame


def write_videos(folder: Path, template: str, together: bool) -> None:
    clips = [
        np.stack([np.full((16, 16, 3), grey(episode, frame), np.uint8) for frame in range(length)])
        for episode, length in enumerate(LENGTHS)
    ]
    for number, clip in enumerate([np.concatenate(clips)] if together else clips):
        names = dict.fromkeys(("episode_chunk", "chunk_index"), 0) | dict.fromkeys(("episode_index", "file_index"), number)
        file = folder / template.format(video_key="observation.images.camera", **names)
        file.parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(file, clip, plugin="FFMPEG", fps=10, macro_block_size=16)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_lerobot(version: str, tmp_path: Path) -> None:
    found = read_lerobot(write_lerobot(tmp_path, version), SPACE)
    assert len(found) == 3
    for number, (one, source) in enumerate(zip(found, EPISODES, strict=True)):
        n = len(source["action"])
        succeeded = number == 1
        steps = n if succeeded else n - 1
        for key in SPACE.spaces:
            np.testing.assert_array_equal(one.observations[key][:n], source[key][:n])
            assert len(one.observations[key]) == steps + 1
        np.testing.assert_array_equal(one.actions, source["action"][:steps])
        np.testing.assert_array_equal(one.rewards, source["reward"][:steps])
        assert one.terminated is succeeded
    assert len(as_arrays(found, SPACE, spaces.Box(-1, 1, (2,), np.float32))) == 3
    assert len(read_lerobot(tmp_path, STATE, n_episodes=2)) == 2


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_videos_of_lerobot(version: str, tmp_path: Path) -> None:
    folder = write_lerobot(tmp_path, version, "video")
    for episode, one in enumerate(read_lerobot(folder, SPACE)):
        for frame, picture in enumerate(one.observations["camera"][: LENGTHS[episode]]):
            assert np.abs(picture.astype(int) - grey(episode, frame)).max() <= 3, (episode, frame)
    file = next(folder.glob("videos/**/*.mp4"))
    file.unlink()
    with pytest.raises(ValueError, match="no video videos.*not downloaded whole"):
        read_lerobot(folder, SPACE)


def test_lerobot_without_rewards_and_with_other_names(tmp_path: Path) -> None:
    folder = write_lerobot(tmp_path, "v2.1", reward=False)
    with pytest.raises(ValueError, match=r"no column for 'reward' \(next.reward\).*missing_reward=0"):
        read_lerobot(folder, STATE)
    assert not any(one.rewards.any() for one in read_lerobot(folder, STATE, missing_reward=0))
    joints = spaces.Dict({"joints": STATE["state"]})
    with pytest.raises(ValueError, match="no column for 'joints'.*observation.images.joints.*, but observation.state"):
        read_lerobot(folder, joints, missing_reward=0)
    found = read_lerobot(folder, joints, keys={"joints": "observation.state", "reward": "frame_index"})
    np.testing.assert_array_equal(found[0].observations["joints"], EPISODES[0]["state"][:4])
    assert found[0].rewards.tolist() == [0, 1, 2]


@pytest.mark.parametrize("damage", ["no info", "old", "no data", "frames", "short"])
def test_damaged_lerobot(damage: str, tmp_path: Path) -> None:
    folder = write_lerobot(tmp_path, "v2.1")
    file, info = folder / "data/chunk-000/episode_000001.parquet", folder / "meta/info.json"
    if damage == "no info":
        info.unlink()
    elif damage == "old":
        info.write_text(info.read_text().replace("v2.1", "v1.6"))
    elif damage == "no data":
        for one in file.parent.iterdir():
            one.unlink()
    else:
        table = pq.read_table(file)
        pq.write_table(table.slice(1) if damage == "frames" else table.slice(0, 1), file)
    messages = {
        "no info": "info.json cannot be read",
        "old": "format v1.6; 2 and 3 are read",
        "no data": "no data.*not downloaded whole",
        "frames": "rows of episode 1 are not all its frames",
        "short": "single row",
    }
    with pytest.raises(ValueError, match=messages[damage]):
        read_lerobot(folder, STATE)


# ---------------------------------------------------------------------- where they are asked for


def test_sources_with_arguments_of_their_own(tmp_path: Path) -> None:
    env = make_vec_env("CPMToy-v0", 1, env_kwargs={"keys": ("state",), "task": "push"})
    folder = write_lerobot(tmp_path / "hub", "v3.0")
    source = {"source": f"lerobot:{folder}", "keys": {"state": "observation.state"}}
    (found,) = load_demonstrations([source], env, n_episodes=1)
    assert found.actions.shape == (3, 2)
    assert len(load_demonstrations(folder, env, keys={"state": "observation.state"})) == 3
    buffer = CPMBuffer(100, env.observation_space, env.action_space, device="cpu", challenge_ratio=0)  # type: ignore
    with pytest.raises(ValueError, match=r"observations 'state' of shape \(4, 6\)"):
        buffer.add_demonstrations([found])
    with pytest.raises(ValueError, match="unknown key 'key'. Did you mean 'keys'"):
        load_demonstrations({"source": str(folder), "key": {}}, env)
    with pytest.raises(ValueError, match="neither Minari.*nor LeRobot"):
        load_demonstrations(tmp_path, env)
    with pytest.raises(ValueError, match="a .h5 file has our names"):
        load_demonstrations("some.h5", env, keys={"state": "x"})
