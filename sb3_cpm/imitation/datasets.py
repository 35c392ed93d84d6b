"""
Demonstrations from data sets of others: `Minari <https://minari.farama.org>`_ and
`LeRobot <https://github.com/huggingface/lerobot>`_ (formats 2 and 3, a folder on this machine).

What a data set calls an observation seldom is what the environment calls it: ``keys={"state": "observation.state"}`` says so.
Nothing is converted: units, order of numbers and controller must be the environment's; what does not fit in shape is refused.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_cpm.arguments import check_names, error_prefix
from sb3_cpm.buffers import Demonstration
from sb3_cpm.extras import needed

ACTION, REWARD = "action", "reward"
"""What ``keys`` may name beside the observations."""


def read_minari(
    source: Any, observation_space: spaces.Dict, n_episodes: int | None = None, keys: Mapping[str, str] | None = None
) -> list[Demonstration]:
    """
    :param source: a ``MinariDataset``, the name of one on this machine (``"D4RL/pen/human-v2"``), or its folder
    :param observation_space: the environment's
    :param n_episodes: the first so many; None: all
    :param keys: by the environment's names of observations the data set's, ``"a/b"`` for b within a; by default they are the
        same, and a single observation without a name is the environment's only one
    :return: its episodes, all steps of them
    :raises ValueError: if there is no such data set, or it lacks an observation
    """
    dataset = _minari_dataset(source) if isinstance(source, (str, Path)) else source
    names = _checked(keys, tuple(observation_space.spaces))
    only = len(observation_space.spaces) == 1
    episodes = []
    with error_prefix(f"Minari's {dataset.id}"):
        for episode in islice(dataset.iterate_episodes(), n_episodes):
            observations = {
                key: _fitting(_within(episode.observations, names.get(key, key), only), key, space)
                for key, space in observation_space.spaces.items()
            }
            terminated = bool(episode.terminations[-1])
            episodes.append(Demonstration(observations, np.asarray(episode.actions), np.asarray(episode.rewards), terminated))
    return episodes


def _minari_dataset(source: str | Path) -> Any:
    with needed("Data sets of Minari", "datasets"):
        import minari
    folder = Path(source)
    if (folder / "data").is_dir():
        return minari.MinariDataset(folder / "data")
    try:
        return minari.load_dataset(str(source))
    except FileNotFoundError as error:
        there = ", ".join(minari.list_local_datasets()) or "none"
        raise ValueError(
            f"Minari has no data set {source!s} on this machine ({there}). Get it with `minari download {source!s}`."
        ) from error


def _within(observations: Any, path: str, is_only: bool) -> Any:
    """What lies at a path in nested dicts and tuples; where there is none of either, all of it."""
    if is_only and not isinstance(observations, (dict, tuple)):
        return observations
    found = observations
    for part in path.split("/"):
        if isinstance(found, tuple):
            found = dict(zip(map(str, range(len(found))), found, strict=True))
        if not isinstance(found, dict) or part not in found:
            named = sorted(found) if isinstance(found, dict) else "a single one"
            raise ValueError(
                f"it has no observation {path!r}, but {named}. Say which is which: keys={{environment's name: its name}}."
            )
        found = found[part]
    return found


# ---------------------------------------------------------------------- LeRobot


def read_lerobot(
    folder: str | Path,
    observation_space: spaces.Dict,
    n_episodes: int | None = None,
    keys: Mapping[str, str] | None = None,
    missing_reward: float | None = None,
) -> list[Demonstration]:
    """
    A row of these data sets holds an observation and the action taken there; the observation after the last action is not in
    them. So the last action is left out, unless it succeeded (``next.success``): then it ends the episode, nobody asks what
    would have come after it, and the last observation stands there once more.

    :param folder: with ``meta/info.json``
    :param observation_space: the environment's
    :param n_episodes: the first so many; None: all
    :param keys: by the environment's names of observations, and by ``"action"`` and ``"reward"``, the names of columns; by
        default ``observation.NAME``, ``observation.images.NAME`` or ``NAME``; ``action``; ``next.reward``
    :param missing_reward: of every step, where the data set has none, for learners that read none, as ``clone``
    :return: its episodes
    :raises ValueError: if it is no such folder, lacks a column, or is damaged
    """
    with needed("Data sets of LeRobot", "datasets"):
        import pyarrow.parquet  # noqa: F401
    dataset = _LeRobot(Path(folder))
    names = _checked(keys, (*observation_space.spaces, ACTION, REWARD))
    with error_prefix(f"LeRobot's {folder}"):
        columns = {
            key: dataset.column(key, names, (key, f"observation.{key}", f"observation.images.{key}"))
            for key in observation_space.spaces
        }
        action = dataset.column(ACTION, names, (ACTION,))
        reward = None
        if missing_reward is None or REWARD in names or "next.reward" in dataset.features:
            reward = dataset.column(REWARD, names, ("next.reward",), "For clones, which read no rewards: missing_reward=0.")
        wanted = [*columns.values(), action, *([reward] if reward else [])]
        episodes = []
        for arrays, succeeded in islice(dataset.episodes(wanted), n_episodes):
            n_steps = len(arrays[action]) - (not succeeded)
            if n_steps < 1:
                raise ValueError("an episode has a single row: no action is followed by an observation.")
            observations = {}
            for key, column in columns.items():
                seen = arrays[column]
                seen = np.concatenate([seen, seen[-1:]]) if succeeded else seen
                observations[key] = _fitting(seen, key, observation_space.spaces[key])
            rewards = np.full(n_steps, missing_reward) if reward is None else arrays[reward].reshape(-1)[:n_steps]
            episodes.append(Demonstration(observations, arrays[action][:n_steps], rewards, succeeded))
    return episodes


class _LeRobot:
    """
    :param folder: of the data set
    :raises ValueError: if it is none, or of a format that is too old
    """

    def __init__(self, folder: Path):
        self.folder = folder
        try:
            self.info = json.loads((folder / "meta" / "info.json").read_text())
            self.version, self.features = str(self.info["codebase_version"]), self.info["features"]
        except (OSError, ValueError, KeyError) as error:
            raise ValueError(f"{folder} is no data set of LeRobot: its meta/info.json cannot be read ({error}).") from error
        if not self.version.startswith(("v2.", "v3.")):
            raise ValueError(
                f"{folder} has LeRobot's format {self.version}; 2 and 3 are read. Convert it with LeRobot's scripts."
            )
        self._videos: dict[str, tuple[Path, Iterator[np.ndarray], int]] = {}  # by column: the one that is open, and how far
        self._places: dict[int, dict[str, Any]] = {}

    def column(self, key: str, names: Mapping[str, str], usual: Sequence[str], cure: str = "") -> str:
        """:return: the column that is meant by one of our names"""
        for name in (names[key],) if key in names else usual:
            if name in self.features:
                return name
        raise ValueError(
            f"it has no column for {key!r} ({names.get(key) or ' or '.join(usual)}), but {', '.join(self.features)}. Say "
            f"which it is: keys={{{key!r}: its name}}. {cure}".rstrip()
        )

    def episodes(self, columns: Sequence[str]) -> Iterator[tuple[dict[str, np.ndarray], bool]]:
        """
        :param columns: what is wanted
        :return: of each episode these, of shape ``(n_rows, ...)``, and whether its last action succeeded
        """
        import pyarrow.parquet as pq

        files = sorted(self.folder.glob("data/**/*.parquet"))
        if not files:
            raise ValueError("there is no data/*/*.parquet in it: it was not downloaded whole, perhaps.")
        videos = [name for name in columns if self.features[name]["dtype"] == "video"]
        success = [name for name in ("next.success",) if name in self.features]
        stored = [name for name in dict.fromkeys([*columns, *success]) if name not in videos]
        for file in files:
            table = pq.read_table(file, columns=list(dict.fromkeys([*stored, "episode_index", "frame_index"])))
            numbers = table["episode_index"].to_numpy()
            starts = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
            for start, end in pairwise(starts):
                rows, number = table.slice(start, end - start), int(numbers[start])
                if (rows["frame_index"].to_numpy() != np.arange(end - start)).any():
                    raise ValueError(f"{file.name}: the rows of episode {number} are not all its frames in order.")
                arrays = {name: self._array(rows[name], name) for name in stored}
                arrays |= {name: self._frames(name, number, end - start) for name in videos}
                yield arrays, bool(success and arrays[success[0]][-1].all())

    def _array(self, column: Any, name: str) -> np.ndarray:
        feature = self.features[name]
        if feature["dtype"] == "image":
            return np.stack([self._picture(one) for one in column.to_pylist()])
        array = np.asarray(column.to_pylist(), dtype=feature["dtype"])
        return array.reshape(len(array), *feature["shape"])

    def _picture(self, stored: Mapping[str, Any]) -> np.ndarray:
        import imageio.v3 as iio

        return iio.imread(stored["bytes"] or self.folder / stored["path"])

    def _frames(self, name: str, episode: int, n_frames: int) -> np.ndarray:
        """Pictures of an episode, shape ``(n_frames, height, width, 3)``; videos are lossy, so these are not exact."""
        path, start = self._place(name, episode)
        if not path.is_file():
            raise ValueError(f"there is no video {path.relative_to(self.folder)}: it was not downloaded whole, perhaps.")
        opened, video, position = self._videos.get(name, (None, iter(()), 0))
        if opened != path or position > start:
            with needed("Videos of LeRobot", "run"):
                import imageio.v3 as iio
            video, position = iio.imiter(path, plugin="FFMPEG"), 0
        frames = list(islice(video, start - position, start - position + n_frames))
        if len(frames) < n_frames:
            raise ValueError(f"{path.relative_to(self.folder)} has {len(frames)} frames of episode {episode}, not {n_frames}.")
        self._videos[name] = path, video, start + n_frames
        return np.stack(frames)

    def _place(self, name: str, episode: int) -> tuple[Path, int]:
        """:return: the file of a video, and its first frame there"""
        if self.version.startswith("v2."):
            chunk = episode // int(self.info["chunks_size"])
            names = {"episode_chunk": chunk, "episode_index": episode, "video_key": name}
            return self.folder / self.info["video_path"].format(**names), 0
        if not self._places:
            import pyarrow.parquet as pq

            for file in sorted(self.folder.glob("meta/episodes/**/*.parquet")):
                self._places |= {row["episode_index"]: row for row in pq.read_table(file).to_pylist()}
        try:
            row = self._places[episode]
            names = {part: row[f"videos/{name}/{part}"] for part in ("chunk_index", "file_index")}
            start = round(row[f"videos/{name}/from_timestamp"] * self.info["fps"])
        except KeyError as error:
            raise ValueError(f"meta/episodes does not say where {name} of episode {episode} is ({error}).") from error
        return self.folder / self.info["video_path"].format(video_key=name, **names), start


# ---------------------------------------------------------------------- both


def _checked(keys: Mapping[str, str] | None, valid: Sequence[str]) -> Mapping[str, str]:
    check_names("keys (of demonstrations)", keys or {}, valid)
    return keys or {}


def _fitting(array: Any, key: str, space: spaces.Space) -> np.ndarray:
    """As the environment has it; floats are not rounded to integers."""
    array = np.asarray(array)
    if space.dtype is not None and array.dtype.kind != space.dtype.kind and space.dtype.kind in "iu":
        raise ValueError(
            f"observations {key!r} are {array.dtype}, the environment's {space.dtype}: convert them, and give Demonstrations."
        )
    return array.astype(space.dtype, copy=False)
