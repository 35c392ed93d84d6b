"""
Does the challenger see what is new, and does it go there? On PointMaze_Medium-v3 without reward, while it explores.

::

    python benchmarks/novelty.py run --seed 100 101
    python benchmarks/novelty.py plot

Every 500 steps, for each measure of novelty that the challenger may have (all else is the default preset):

* novelty of transitions into cells that it has not visited, as a multiple of that of transitions into cells that it has. They
  are of episodes of pink noise that it never learns from;
* imagined novelty of what its actor does, as a multiple of that of uniformly random actions, from the same states of its
  buffer over the preset's horizon.

Every run writes ``results/novelty/MEASURE/maze_medium/seedN.csv``; ``plot`` draws ``results/novelty/novelty.png``.
"""

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from coverage import LEARNING_STARTS, TASKS, TRAIN_FREQ, Unrewarded
from learning_curves import Table, missing, read
from pink import PinkActionNoise
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cpm.dreamer import Plan2Explore
from sb3_cpm.uncertainty.base import Transitions

FOLDER = Path(__file__).parents[1] / "results" / "novelty"
MEASURES = {
    "plan2explore": "ensemble of latents (default)",
    "observation_ensemble": "ensemble of embeddings",
    "rnd": "RND",
}
TASK = TASKS["maze_medium"]
EVERY, HELD_OUT = 500, 8


def play_pink(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """:return: an episode's observations, shape ``(n + 1, dim)``, and actions, ``(n, 2)``"""
    env, noise = Unrewarded(TASK), PinkActionNoise(1.0, TASK.episode, 2, np.random.default_rng(seed))
    observations, actions = [env.reset(seed=seed)[0]], []
    for _ in range(TASK.episode):
        actions.append(np.clip(noise(), -1, 1).astype(np.float32))
        observations.append(env.step(actions[-1])[0])
    return np.array(observations, np.float32), np.array(actions)


class Judge(BaseCallback):
    """
    :param task: the environment that counts cells
    :param env: normalizes observations
    :param table: where the numbers go
    :param facts: of the run
    """

    def __init__(self, task: Unrewarded, env: VecNormalize, table: Table, facts: dict) -> None:
        super().__init__()
        self.task, self.normalize, self.table, self.facts = task, env, table, facts
        self.episodes = [play_pink(1000 + index) for index in range(HELD_OUT)]

    def _on_step(self) -> bool:
        if self.num_timesteps % EVERY == 0 and self.model.challenger.trained_updates:
            new, known = self.of_real_transitions()
            self.table.add(
                **self.facts, step=self.num_timesteps, cells=len(self.task.visited), new=round(new, 4), known=round(known, 4),
                imagined=round(self.of_imagined_ones(), 4),
            )  # fmt: skip
        return True

    def of_real_transitions(self) -> tuple[float, float]:
        """:return: mean novelty of transitions into cells not visited, and into those visited; nan where there are none"""
        novelty: dict[bool, list[float]] = {False: [np.nan], True: [np.nan]}
        challenger = self.model.challenger
        for observations, actions in self.episodes:
            judged = challenger.evaluate({challenger.keys[0]: self.normalize.normalize_obs(observations)}, actions)
            for t in range(5, len(actions)):
                novelty[TASK.cell(observations[t + 1, :2]) in self.task.visited].append(float(judged.disagreement[t]))
        return float(np.nanmean(novelty[False])), float(np.nanmean(novelty[True]))

    @th.no_grad()
    def of_imagined_ones(self) -> float:
        """:return: imagined novelty of the actor's actions over that of random ones"""
        challenger = self.model.challenger
        state = th.random.get_rng_state()
        batch = self.model.replay_buffer.sample_sequences(32, challenger.sequence_length, challenger.keys)
        sequences = challenger.learner.to_device(batch)
        start = challenger.world_model.loss(sequences).posterior.flatten()
        means = []
        for act in (lambda feat: challenger.exploration.actor(feat).rsample(), lambda feat: th.rand(len(feat), 2) * 2 - 1):
            latent, total = start, []
            for _ in range(challenger.preset.horizon):
                action = act(latent.feat)
                after = challenger.world_model.rssm.imagine_step(latent, action)
                total.append(challenger.uncertainty.novelty(Transitions(latent.feat, action, after.stoch, after.deter)).mean())
                latent = after
            means.append(float(th.stack(total).mean()))
        th.random.set_rng_state(state)
        return means[0] / means[1]


def run(measure: str, seed: int, path: Path) -> None:
    task, table = Unrewarded(TASK), Table(path)
    env = VecNormalize(DummyVecEnv([lambda: gym.wrappers.TimeLimit(task, TASK.episode)]), norm_reward=False)
    model = Plan2Explore(
        "MlpPolicy", env, seed=seed, device="cpu", learning_starts=LEARNING_STARTS, train_freq=TRAIN_FREQ,
        uncertainty_class=measure,
    )  # fmt: skip
    model.learn(TASK.steps, Judge(task, env, table, {"agent": measure, "env": "maze_medium", "seed": seed}), log_interval=None)
    table.complete()
    print(f"{measure} seed {seed}: {table.rows[-1]}", flush=True)


def plot() -> None:
    import matplotlib.pyplot as plt

    from sb3_cpm.run.plots import BLUE, GREY, ORANGE, STYLE, save_figure

    rows = read(FOLDER)
    panels = (
        (
            "real transitions: novelty into new cells\nas a multiple of that into known ones",
            lambda row: float(row["new"]) / float(row["known"]),
        ),
        (
            "imagination: novelty of the actor's actions\nas a multiple of that of random ones",
            lambda row: float(row["imagined"]),
        ),
        ("cells visited, of 104", lambda row: float(row["cells"])),
    )
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
        for axis, (title, value) in zip(axes, panels, strict=True):
            for colour, (measure, name) in zip((BLUE, ORANGE, GREY), MEASURES.items(), strict=True):
                steps = sorted({int(row["step"]) for row in rows if row["agent"] == measure})
                of_step = [[value(row) for row in rows if row["agent"] == measure and int(row["step"]) == s] for s in steps]
                axis.plot(steps, [np.mean(one) for one in of_step], color=colour, label=name)
                for index in range(max(map(len, of_step), default=0)):
                    axis.plot(steps, [one[index] for one in of_step], color=colour, alpha=0.25, lw=1)
            axis.set_title(title)
            axis.set_xlabel("environment steps")
        for axis, upper in zip(axes[:2], (2.5, 1.25), strict=True):
            axis.axhline(1.0, color=GREY, lw=1, ls=":")
            axis.set_ylim(0.75, upper)
        axes[0].legend(fontsize=9)
        save_figure(figure, FOLDER / "novelty.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["run", "plot"])
    parser.add_argument("--measure", nargs="+", choices=list(MEASURES), default=list(MEASURES))
    parser.add_argument("--seed", nargs="+", type=int, default=[100, 101])
    args = parser.parse_args()
    if args.command == "plot":
        plot()
        return
    th.set_num_threads(1)
    th.set_flush_denormal(True)
    for measure, _, seed, path in missing(FOLDER, args.measure, ["maze_medium"], args.seed):
        run(measure, seed, path)


if __name__ == "__main__":
    main()
