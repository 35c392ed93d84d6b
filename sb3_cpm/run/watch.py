"""
Watching the world model: what ``python -m sb3_cpm watch RUN_FOLDER`` does.

Episodes out of the run's replay buffer are shown to the saved challenger for a few frames; from there on it draws what it
believes it would see, knowing only the actions. Pictures and animations go to ``RUN_FOLDER/watch``, and with the numbers to
TensorBoard (``tensorboard --logdir RUN_FOLDER/tensorboard``, run "watch").

These are episodes that the model may have learnt from; errors on new ones are higher.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
import yaml

from sb3_cpm.buffers import CPMBuffer, Episode
from sb3_cpm.challenger import Challenger
from sb3_cpm.files import write_bytes
from sb3_cpm.run import watch_pictures as pictures
from sb3_cpm.run.tables import read_diagnostics
from sb3_cpm.type_aliases import Evaluation

MOST_FRAMES = 64
BUFFER = "replay_buffer.npz"


class Dream(NamedTuple):
    """
    One episode as it was and as the world model draws it; ``rows`` states.

    :param name: which episode
    :param truth: per key, images channel-last in [0, 1], vectors as they are, shape ``(rows, ...)``
    :param model: the same, drawn
    :param context: the model has seen the rows before this one
    :param rewards: received for arriving in the states 1.., shape ``(rows - 1,)``
    :param drawn_rewards: predicted
    :param opinion: KL and disagreement of the transitions, seen whole
    """

    name: str
    truth: dict[str, np.ndarray]
    model: dict[str, np.ndarray]
    context: int
    rewards: np.ndarray
    drawn_rewards: np.ndarray
    opinion: Evaluation

    @property
    def images(self) -> list[str]:
        return [key for key, value in self.truth.items() if value.ndim == 4]

    @property
    def vectors(self) -> list[str]:
        return [key for key, value in self.truth.items() if value.ndim == 2]

    def errors(self, key: str) -> np.ndarray:
        """Mean absolute error of every row, shape ``(rows,)``."""
        return _mean_error(self.truth[key], self.model[key])

    def errors_of_standing_still(self, key: str) -> np.ndarray:
        """The same for keeping the last state that was seen: what a model has to beat."""
        truth = self.truth[key]
        return _mean_error(truth, truth[np.minimum(np.arange(len(truth)), self.context - 1)])


class Watched(NamedTuple):
    """
    :param files: what was drawn
    :param text: the numbers, for the terminal
    """

    files: list[Path]
    text: str


def watch(run_folder: str | Path, episodes: int = 2, context: int = 5, frames: int = 50, device: str = "auto") -> Watched:
    """
    Draw what the world model of a run believes it would see.

    :param run_folder: of a run, with ``challenger.pt`` and ``replay_buffer.npz``, neither of which can execute anything
    :param episodes: how many episodes, spread over the replay buffer, the newest first
    :param context: states that the model is shown at first
    :param frames: states in all, 16 to 64; episodes may be shorter
    :param device: PyTorch device
    :raises ValueError: for folders without these files, and arguments out of range
    """
    folder = Path(run_folder)
    if episodes < 1:
        raise ValueError(f"episodes={episodes}: expected 1 or more")
    check_frames(context, frames)
    challenger, buffer = _load(folder, device)
    chosen = _choose(buffer.episodes, episodes, context)
    dreams = [dream_of(challenger, buffer, episode, context, frames) for episode in chosen]
    return Watched(_write(folder, challenger, dreams), _describe(folder, challenger, dreams))


def check_frames(context: int, frames: int) -> None:
    """
    :raises ValueError: unless there is something to see and something to imagine
    """
    if not 1 <= context < frames <= MOST_FRAMES:
        raise ValueError(f"context={context}, frames={frames}: expected 1 <= context < frames <= {MOST_FRAMES}")


def _load(folder: Path, device: str) -> tuple[Challenger, CPMBuffer]:
    if not folder.is_dir():
        raise ValueError(f"There is no run folder {folder}: expected one that `sb3_cpm train` left")
    for name in ("challenger.pt", BUFFER):
        if name == BUFFER and not (folder / name).is_file() and (folder / "replay_buffer.pkl").is_file():
            raise ValueError(
                f"{folder} is of an earlier version, which pickled its replay buffer, and a pickle can execute anything when "
                f"it is read. If you trust it: python -c \"from sb3_cpm import CPMBuffer; CPMBuffer.load('{folder}/"
                f"replay_buffer.pkl', allow_pickle=True).save('{folder}/{BUFFER}')\""
            )
        if not (folder / name).is_file():
            raise ValueError(
                f"{folder} has no {name}: `watch` needs the folder of a run that has ended, and whose challenger was trained"
            )
    challenger = Challenger.load(folder / "challenger.pt", device)
    buffer = CPMBuffer.load(folder / BUFFER)
    missing = [key for key in challenger.keys if key not in buffer.observations]
    if missing:
        raise ValueError(f"The challenger reads {list(challenger.keys)}, the replay buffer of {folder} lacks {missing}")
    return challenger, buffer


def _choose(episodes: Sequence[Episode], wanted: int, context: int) -> list[Episode]:
    """Spread over the buffer, the newest first, among those that are longer than the context."""
    long_enough = sorted((one for one in episodes if one.length >= context), key=lambda one: (one.ordinal, one.env_idx))
    if not long_enough:
        longest = max((one.length for one in episodes), default=0)
        raise ValueError(
            f"No episode in the replay buffer is longer than context={context} states: it has {len(episodes)}, the longest of "
            f"{longest} steps. Choose a smaller context."
        )
    places = np.linspace(len(long_enough) - 1, 0, min(wanted, len(long_enough))).round().astype(int)
    return [long_enough[place] for place in places]


def dream_of(challenger: Challenger, buffer: CPMBuffer, episode: Episode, context: int, frames: int) -> Dream:
    """
    :param challenger: who dreams
    :param buffer: where the episode is
    :param episode: of at least ``context`` transitions
    :param context: states that the model is shown at first
    :param frames: states in all
    """
    rows = min(frames, episode.length + 1)
    observations = {key: value[:rows] for key, value in buffer.episode_observations(episode, challenger.keys).items()}
    actions = buffer.episode_actions(episode)[: rows - 1]
    rewards = buffer.rewards[episode.slots(buffer.buffer_size), episode.env_idx][: rows - 1]
    drawn = challenger.open_loop(observations, actions, context)
    name = f"episode {episode.ordinal}" + (f" of environment {episode.env_idx}" if buffer.n_envs > 1 else "")
    return Dream(
        name,
        {key: _readable(challenger, key, value) for key, value in observations.items()},
        {key: _readable(challenger, key, value) for key, value in drawn.observations.items()},
        context,
        rewards,
        drawn.rewards,
        challenger.evaluate(observations, actions),
    )


def _readable(challenger: Challenger, key: str, values: np.ndarray) -> np.ndarray:
    """Images channel-last in [0, 1]; all else flat."""
    spec = challenger.spec
    if key not in spec.image_keys:
        return values.reshape(len(values), -1).astype(np.float32)
    low, high = spec.ranges[key]
    images = spec.channels_last(key, th.as_tensor(np.array(values))).numpy().astype(np.float32)
    return (images - low) / (high - low)


def _mean_error(truth: np.ndarray, model: np.ndarray) -> np.ndarray:
    return np.abs(truth - model).reshape(len(truth), -1).mean(1)


# ---------------------------------------------------------------------- what is left behind


def _write(folder: Path, challenger: Challenger, dreams: Sequence[Dream]) -> list[Path]:
    target = folder / "watch"
    target.mkdir(exist_ok=True)
    title, files = _title(folder, challenger), []
    for number, dream in enumerate(dreams, start=1):
        files.append(target / f"open_loop_{number}.png")
        pictures.draw_strip(files[-1], dream, f"{title}, {dream.name}")
        if dream.images:
            files.append(target / f"open_loop_{number}.gif")
            write_bytes(files[-1], pictures.animation(dream))
    files.append(target / "training.png")
    pictures.draw_training(files[-1], read_diagnostics(folder), title)
    _log(folder / "tensorboard" / "watch", challenger, dreams, files)
    return files


def _title(folder: Path, challenger: Challenger) -> str:
    config = folder / "config.yml"
    stored = yaml.safe_load(config.read_text(encoding="utf-8")) if config.is_file() else {}
    env = ((stored or {}).get("run") or {}).get("env_id", folder.name)
    return f"World model of {env} after {challenger.trained_updates} updates"


def _log(folder: Path, challenger: Challenger, dreams: Sequence[Dream], files: Sequence[Path]) -> None:
    """Pictures, animations and numbers to TensorBoard, at the challenger's number of updates."""
    from torch.utils.tensorboard import SummaryWriter

    step = challenger.trained_updates
    with SummaryWriter(str(folder)) as writer:
        for name, value in numbers(challenger, dreams).items():
            writer.add_scalar(f"watch/{name}", value, step)
        for file in files:
            _log_picture(writer, f"watch/{file.name}", file.read_bytes(), step)


def log_animation(writer: Any, tag: str, dream: Dream, step: int) -> None:
    """
    :param writer: TensorBoard's
    :param tag: how TensorBoard shall call it
    :param dream: an episode with images
    :param step: when
    """
    _log_picture(writer, tag, pictures.animation(dream), step)


def _log_picture(writer: Any, tag: str, content: bytes, step: int) -> None:
    """TensorBoard plays an animated GIF where it expects a picture; its ``add_video`` would need moviepy."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    picture = Summary.Image(encoded_image_string=content, colorspace=3)
    writer._get_file_writer().add_summary(Summary(value=[Summary.Value(tag=tag, image=picture)]), step)


def numbers(challenger: Challenger, dreams: Sequence[Dream]) -> dict[str, float]:
    """
    :param challenger: who dreamt
    :param dreams: episodes
    :return: mean absolute errors per key (seen, imagined, of standing still), KL, novelty and its scale
    """
    found = {}
    for key in challenger.keys:
        errors = [(dream.errors(key), dream.errors_of_standing_still(key), dream.context) for dream in dreams]
        found[f"reconstruction_error_{key}"] = _mean([model[:context] for model, _, context in errors])
        found[f"open_loop_error_{key}"] = _mean([model[context:] for model, _, context in errors])
        found[f"standing_still_error_{key}"] = _mean([still[context:] for _, still, context in errors])
    found["open_loop_error_reward"] = _mean(
        [np.abs(dream.rewards - dream.drawn_rewards)[dream.context - 1 :] for dream in dreams]
    )
    found["kl"] = _mean([dream.opinion.kl for dream in dreams])
    found["disagreement"] = _mean([dream.opinion.disagreement for dream in dreams])
    scale = getattr(challenger.uncertainty, "k", None)
    return found if scale is None else {**found, "exp_scale": float(scale)}


def _mean(parts: Sequence[np.ndarray]) -> float:
    values = np.concatenate(parts)
    return float(values.mean()) if len(values) else float("nan")


def _describe(folder: Path, challenger: Challenger, dreams: Sequence[Dream]) -> str:
    found = numbers(challenger, dreams)
    rows = ", ".join(str(len(dream.drawn_rewards) + 1) for dream in dreams)
    lines = [
        f"{_title(folder, challenger)}: {len(dreams)} episode(s) of {rows} states, {dreams[0].context} of them shown",
        "",
        f"{'mean absolute error':<22}{'seen':>10}{'imagined':>10}{'standing still':>16}",
    ]
    for key in challenger.keys:
        kinds = ("reconstruction", "open_loop", "standing_still")
        seen, imagined, still = (found[f"{kind}_error_{key}"] for kind in kinds)
        lines.append(f"{key:<22}{seen:>10.4f}{imagined:>10.4f}{still:>16.4f}")
    lines.append(f"{'reward':<22}{'':>10}{found['open_loop_error_reward']:>10.4f}")
    lines += ["", f"KL {found['kl']:.2f} nats, disagreement {found['disagreement']:.2f} (mean over all steps)"]
    return "\n".join(lines)
