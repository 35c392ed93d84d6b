"""
How well the world model learns PickCube-v1 from its images: errors on held-out episodes while it trains (report, Fig. 10).

::

    OMP_NUM_THREADS=1 python benchmarks/world_model_pickcube.py                         # preset "default", 3 seeds, 10 minutes
    OMP_NUM_THREADS=1 python benchmarks/world_model_pickcube.py --preset report --seeds 0 --updates 400
    OMP_NUM_THREADS=1 python benchmarks/world_model_pickcube.py --recorded episodes.npz     # records them the first time only

On a machine with a GPU it trains there, with CUDA graphs; with ``--recorded`` that machine needs no simulator.

Records episodes of the simulator with two cameras of 32 x 32 and the state vector: a third random actions, a third the
scripted grasp, a third that with noise, so that rewards vary. Trains the world model only, and writes to ``--folder``

* ``pickcube_heldout.csv``: a row per preset, seed and number of updates; rows of other presets and seeds stay,
* ``pickcube_PRESET.png``: a held-out episode as it is, as reconstructed, and as imagined after five states; and the curves.

Pixel errors are mean absolute errors over all pixels of both cameras on the scale of [-0.5, 0.5]. Most of a picture never
changes, so the errors of two predictors that learn nothing of the dynamics stand beside them: the mean image of the training
episodes, and for the open loop the last image that was shown. "Moving" counts only pixels that are more than 0.1 away from the
mean image. The reward error is the mean absolute one; beside it stand that of always predicting the training episodes' mean,
and the mean reward.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import matplotlib as mpl
import numpy as np
import torch
from gymnasium import spaces

from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.challenger import Challenger
from sb3_cpm.files import replacing
from sb3_cpm.run.plots import BLUE, GREY, ORANGE, STYLE, save_figure
from sb3_cpm.type_aliases import SequenceBatch

mpl.use("Agg")
import matplotlib.pyplot as plt

if TYPE_CHECKING:
    from sb3_cpm.envs import ManiSkillEnv

CAMERAS = ("base_camera", "hand_camera")
KEYS = (*CAMERAS, "state")
STEPS = 50
CONTEXT = 5
KINDS = ("random", "scripted", "noisy")
MEASURES = (
    "pixel_error",
    "pixel_error_mean_image",
    "pixel_error_moving",
    "pixel_error_moving_mean_image",
    "open_loop_pixel_error",
    "open_loop_pixel_error_last_image",
    "reward_error",
    "open_loop_reward_error",
    "reward_error_constant",
    "mean_reward",
    "kl",
)


class Recorded(NamedTuple):
    """
    One episode.

    :param observations: of the states 0..T, per key of shape ``(T + 1, *observation_shape)``
    :param actions: shape ``(T, action_dim)``
    :param rewards: for arriving in the states 1..T, shape ``(T,)``
    """

    observations: dict[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray


# ---------------------------------------------------------------------- episodes
def record(env: "ManiSkillEnv", seed: int, rng: np.random.Generator) -> Recorded:
    """One episode of the kind that its seed says, in turns."""
    kind = KINDS[seed % len(KINDS)]
    seen, actions, rewards = [env.reset(seed=seed)[0]], [], []
    for _ in range(STEPS):
        action = env.action_space.sample() if kind == "random" else env.expert_action()
        if kind == "noisy":
            action = np.clip(action + rng.normal(scale=0.3, size=action.shape), -1, 1).astype(np.float32)
        observation, reward, *_ = env.step(action)
        seen.append(observation)
        actions.append(action)
        rewards.append(reward)
    observations = {key: np.stack([one[key] for one in seen]) for key in KEYS}
    return Recorded(observations, np.stack(actions), np.array(rewards, np.float32))


def record_all(n_training: int, n_held_out: int) -> list[Recorded]:
    """Episodes to learn from, then held-out ones."""
    from sb3_cpm.envs import make_maniskill_env

    env = make_maniskill_env("PickCube-v1", n_points=0, goal_points=0, ignore_terminations=True)
    env.action_space.seed(0)
    rng = np.random.default_rng(0)
    seeds = [*range(n_training), *range(1_000_000, 1_000_000 + n_held_out)]
    recorded = [record(env, seed, rng) for seed in seeds]
    env.close()
    return recorded


def save_recorded(path: Path, episodes: list[Recorded]) -> None:
    """As arrays of shape ``(n_episodes, ...)``."""
    arrays = {key: np.stack([one.observations[key] for one in episodes]) for key in KEYS}
    others = {name: np.stack([getattr(one, name) for one in episodes]) for name in ("actions", "rewards")}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays, **others)


def load_recorded(path: Path) -> list[Recorded]:
    """What :func:`save_recorded` wrote."""
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files}
    return [
        Recorded({key: arrays[key][i] for key in KEYS}, arrays["actions"][i], arrays["rewards"][i])
        for i in range(len(arrays["rewards"]))
    ]


def fill(buffer: CPMBuffer, episode: Recorded) -> None:
    """As SB3 does it while it collects."""
    for t in range(STEPS):
        before, after = ({key: value[i][None] for key, value in episode.observations.items()} for i in (t, t + 1))
        last = t == STEPS - 1
        infos = [{"TimeLimit.truncated": last}]
        buffer.add(before, after, episode.actions[t][None], episode.rewards[t][None], np.array([last]), infos)


# ---------------------------------------------------------------------- measuring
class Judge:
    """
    Errors on held-out episodes.

    :param held_out: the episodes
    :param training: those that trivial predictors know
    """

    def __init__(self, held_out: list[Recorded], training: list[Recorded]) -> None:
        self.held_out = held_out
        self.mean_image = {key: np.mean([one.observations[key].mean(0) for one in training], axis=0) for key in CAMERAS}
        self.mean_reward = float(np.mean([one.rewards for one in training]))
        self.trivial = self._trivial()

    def _trivial(self) -> dict[str, float]:
        """What can be had without learning anything of the dynamics."""
        found: dict[str, list[float]] = {}
        for episode in self.held_out:
            for key in CAMERAS:
                truth = episode.observations[key].astype(np.float32)
                away = np.abs(truth - self.mean_image[key]) / 255
                found.setdefault("pixel_error_mean_image", []).append(away.mean())
                found.setdefault("pixel_error_moving_mean_image", []).append(away[away > 0.1].mean())
                last = np.abs(truth[CONTEXT:] - truth[CONTEXT - 1]).mean() / 255
                found.setdefault("open_loop_pixel_error_last_image", []).append(last)
            found.setdefault("reward_error_constant", []).append(np.abs(episode.rewards - self.mean_reward).mean())
            found.setdefault("mean_reward", []).append(np.abs(episode.rewards).mean())
        return {key: float(np.mean(values)) for key, values in found.items()}

    def measure(self, challenger: Challenger) -> dict[str, float]:
        """Errors of a world model, and beside them the trivial ones."""
        found: dict[str, list[float]] = {}
        for episode in self.held_out:
            inputs = {key: episode.observations[key] for key in challenger.keys}
            seen = challenger.open_loop(inputs, episode.actions, STEPS + 1)
            dreamt = challenger.open_loop(inputs, episode.actions, CONTEXT)
            for key in CAMERAS:
                truth = episode.observations[key].astype(np.float32)
                error = np.abs(seen.observations[key] - truth) / 255
                moving = np.abs(truth - self.mean_image[key]) / 255 > 0.1
                blind = np.abs(dreamt.observations[key] - truth)[CONTEXT:] / 255
                found.setdefault("pixel_error", []).append(error.mean())
                found.setdefault("pixel_error_moving", []).append(error[moving].mean())
                found.setdefault("open_loop_pixel_error", []).append(blind.mean())
            found.setdefault("reward_error", []).append(np.abs(seen.rewards - episode.rewards).mean())
            blind = np.abs(dreamt.rewards - episode.rewards)[CONTEXT - 1 :]
            found.setdefault("open_loop_reward_error", []).append(blind.mean())
        errors = {key: float(np.mean(values)) for key, values in found.items()}
        return {**errors, **self.trivial, "kl": self._kl(challenger)}

    @torch.no_grad()
    def _kl(self, challenger: Challenger) -> float:
        """KL of posterior and prior, nats, mean over all states."""
        rows = STEPS + 1, len(self.held_out)
        is_first = np.zeros(rows, bool)
        is_first[0] = True
        batch = SequenceBatch(
            {key: np.stack([one.observations[key] for one in self.held_out], axis=1) for key in challenger.keys},
            np.stack([np.concatenate((np.zeros_like(one.actions[:1]), one.actions)) for one in self.held_out], axis=1),
            np.stack([np.concatenate((np.zeros_like(one.rewards[:1]), one.rewards)) for one in self.held_out], axis=1),
            is_first,
            np.zeros(rows, bool),
            np.ones(rows, bool),
        )
        return float(challenger.world_model.loss(challenger.learner.to_device(batch)).metrics["kl"])


# ---------------------------------------------------------------------- training
def train(buffer: CPMBuffer, judge: Judge, preset: str, seed: int, updates: int) -> tuple[Challenger, list[dict[str, Any]]]:
    """
    Train a world model and measure it at 0, 1, 2, 5, 10, ... updates.

    :return: its challenger, rows of the CSV
    """
    np.random.seed(seed)
    torch.manual_seed(seed)
    options: dict[str, Any] = {"train_exploration_behavior": False, "train_task_behavior": False}
    options["compile"] = torch.cuda.is_available()
    space, action_space = buffer.observation_space, buffer.action_space
    assert isinstance(space, spaces.Dict) and isinstance(action_space, spaces.Box)
    challenger = Challenger(space, action_space, "auto", preset, KEYS, **options)
    marks = {factor * 10**power for factor in (1, 2, 5) for power in range(1, 6)} | {0, updates}
    rows, spent = [], 0.0
    for update in range(updates + 1):
        if update:
            start = time.process_time()
            challenger.train(buffer.sample_sequences(challenger.batch_size, challenger.sequence_length, challenger.keys))
            spent += time.process_time() - start
        if update in marks:
            row = {"preset": preset, "seed": seed, "updates": update, "cpu_seconds": round(spent, 1)}
            row |= {key: round(value, 5) for key, value in judge.measure(challenger).items()}
            rows.append(row)
            shown = ", ".join(f"{key} {row[key]:.4f}" for key in ("pixel_error", "open_loop_pixel_error", "reward_error"))
            print(f"{preset}, seed {seed}, {update} updates, {spent:.0f} CPU s: {shown}", flush=True)
    return challenger, rows


def write_rows(path: Path, new: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Replace the rows of the same presets and seeds; :return: all rows, as they are in the file."""
    kept = []
    if path.exists():
        done = {(row["preset"], str(row["seed"])) for row in new}
        kept = [row for row in _read_rows(path) if (row["preset"], row["seed"]) not in done]
    rows = sorted([*kept, *new], key=lambda row: (row["preset"], int(row["seed"]), int(row["updates"])))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["preset", "seed", "updates", "cpu_seconds", *MEASURES], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return _read_rows(path)


def _read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


# ---------------------------------------------------------------------- figure
def draw(path: Path, challenger: Challenger, episode: Recorded, rows: list[dict[str, str]]) -> None:
    """The strip of pictures, and below it the curves of all seeds."""
    inputs = {key: episode.observations[key] for key in challenger.keys}
    seen = challenger.open_loop(inputs, episode.actions, STEPS + 1).observations
    dreamt = challenger.open_loop(inputs, episode.actions, CONTEXT).observations
    columns = [0, CONTEXT - 1, *range(8, STEPS + 1, 6)]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(3, 1, figsize=(11, 9.6), height_ratios=(6.0, 2.2, 2.2), layout="constrained")
        films = [pictures[key] for key in CAMERAS for pictures in (episode.observations, seen, dreamt)]
        strip = [np.concatenate([np.clip(film[t], 0, 255).astype(np.uint8) for t in columns], axis=1) for film in films]
        axes[0].imshow(np.concatenate(strip), interpolation="nearest")
        axes[0].set_yticks(16 + 32 * np.arange(6), ["truth", "reconstruction", "open loop"] * 2)
        axes[0].set_xticks(16 + 32 * np.arange(len(columns)), [str(t) for t in columns])
        axes[0].grid(False)
        axes[0].set_title(f"A held-out episode, preset {rows[0]['preset']}; open loop: {CONTEXT} states seen, then actions")
        curves = ("pixel_error", "open_loop_pixel_error"), ("pixel_error_mean_image", "open_loop_pixel_error_last_image")
        _curves(axes[1], rows, *curves, "absolute pixel error")
        axes[1].axhline(0.1, color=GREY, lw=1)
        _curves(axes[2], rows, ("reward_error", "open_loop_reward_error"), ("reward_error_constant",), "absolute reward error")
        axes[2].set_xlabel("updates of the world model")
        save_figure(figure, path)


def _curves(axis: Any, rows: list[dict[str, str]], learnt: tuple[str, ...], trivial: tuple[str, ...], what: str) -> None:
    for number, (key, colour) in enumerate(zip(learnt, (BLUE, ORANGE), strict=True)):
        for seed in sorted({row["seed"] for row in rows}):
            mine = [row for row in rows if row["seed"] == seed]
            label = key.replace("_", " ") if seed == rows[0]["seed"] else None
            axis.plot([int(row["updates"]) for row in mine], [float(row[key]) for row in mine], color=colour, label=label)
        if number < len(trivial):
            name = trivial[number].replace("_", " ")
            axis.axhline(float(rows[0][trivial[number]]), color=colour, ls="--", lw=1.2, label=name)
    axis.set_xscale("symlog", linthresh=10)
    axis.set_xlim(left=0)
    axis.set_yscale("log")
    axis.set_title(f"Held-out {what}")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="default", choices=["default", "report"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--updates", type=int, default=3000)
    parser.add_argument("--episodes", type=int, default=150, help="to learn from")
    parser.add_argument("--held-out", type=int, default=18)
    parser.add_argument("--recorded", type=Path, help="file of the episodes, which is made if it is not there")
    parser.add_argument("--folder", type=Path, default=Path("results/world_model"))
    options = parser.parse_args()
    torch.set_num_threads(1)

    if options.recorded is not None and options.recorded.exists():
        episodes = load_recorded(options.recorded)
        if len(episodes) != options.episodes + options.held_out:
            parser.error(
                f"{options.recorded} holds {len(episodes)} episodes, not {options.episodes} to learn from and "
                f"{options.held_out} held-out ones: give these numbers, or remove it to record it anew."
            )
    else:
        episodes = record_all(options.episodes, options.held_out)
        if options.recorded is not None:
            save_recorded(options.recorded, episodes)
    training, held_out = episodes[: options.episodes], episodes[options.episodes :]
    images = {key: spaces.Box(0, 255, training[0].observations[key].shape[1:], np.uint8) for key in CAMERAS}
    state = spaces.Box(-np.inf, np.inf, training[0].observations["state"].shape[1:])
    actions = spaces.Box(-1.0, 1.0, training[0].actions.shape[1:])
    space = spaces.Dict({**images, "state": state})
    buffer = CPMBuffer(STEPS * (options.episodes + 1), space, actions, challenge_ratio=0.0)
    for episode in training:
        fill(buffer, episode)

    options.folder.mkdir(parents=True, exist_ok=True)
    judge = Judge(held_out, training)
    for seed in options.seeds:
        challenger, rows = train(buffer, judge, options.preset, seed, options.updates)
        everything = write_rows(options.folder / "pickcube_heldout.csv", rows)
        # a scripted grasp, of which there is most to see
        shown = next(one for number, one in enumerate(held_out) if KINDS[(1_000_000 + number) % len(KINDS)] == "scripted")
        mine = [row for row in everything if row["preset"] == options.preset]
        draw(options.folder / f"pickcube_{options.preset}.png", challenger, shown, mine)


if __name__ == "__main__":
    main()
