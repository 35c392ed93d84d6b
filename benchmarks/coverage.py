"""
How much of an environment is seen without any reward: share of the cells of a state grid that were visited.

::

    python benchmarks/coverage.py run --agent random plan2explore rnd --env mountaincar --seed 0 1 2 3 4
    python benchmarks/coverage.py plot

The cells are position x velocity on MountainCarContinuous-v0, and positions in the free part of PointMaze_Large-v3, where
every episode begins in the same corner. All agents have the same episodes (of the same length, without an early end) and the
same first random steps, and never see a reward. ``plan2explore`` and ``rnd`` are :class:`~sb3_cpm.dreamer.Plan2Explore` with
the uncertainty class of that name, alike in all else. Every run writes ``results/coverage/AGENT/ENV/seedN.csv`` when it is
complete; complete runs are skipped. ``plot`` draws ``results/coverage/coverage.png`` and writes
``results/coverage/summary.csv``, means over seeds with 95% confidence intervals.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from learning_curves import Table, curves, draw, interval, missing, read, write_summary
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cpm.dreamer import Plan2Explore

FOLDER = Path(__file__).parents[1] / "results" / "coverage"
NAMES = {"plan2explore": "Plan2Explore", "rnd": "RND", "random": "random actions"}
LEARNING_STARTS, TRAIN_FREQ = 500, 10
RECORD_EVERY = 250


class Task:
    """
    :param env_id: gymnasium's name
    :param steps: environment steps of a run
    :param episode: steps of an episode
    :param low: lower corner of the grid
    :param high: upper corner
    :param cells: per dimension
    :param reachable: number of cells that can be reached at all
    """

    def __init__(self, env_id: str, steps: int, episode: int, low: Any, high: Any, cells: tuple[int, int], reachable: int):
        self.env_id, self.steps, self.episode = env_id, steps, episode
        self.low, self.high, self.cells, self.reachable = np.array(low), np.array(high), np.array(cells), reachable

    def cell(self, state: np.ndarray) -> tuple[int, ...]:
        index = (state - self.low) / (self.high - self.low) * self.cells
        return tuple(np.clip(index.astype(int), 0, self.cells - 1).tolist())


TASKS = {
    "mountaincar": Task("MountainCarContinuous-v0", 5000, 200, (-1.2, -0.07), (0.6, 0.07), (30, 30), 900),
    # 46 free squares of 1 m x 1 m, 3 x 3 cells each
    "maze": Task("PointMaze_Large-v3", 5000, 300, (-6.0, -4.5), (6.0, 4.5), (36, 27), 414),
}


class Unrewarded(gym.Wrapper):
    """
    Reward is always 0 and no episode ends before its time; counts the visited cells.

    :param task: what to make
    """

    def __init__(self, task: Task) -> None:
        if task.env_id.startswith("PointMaze"):
            import gymnasium_robotics

            gym.register_envs(gymnasium_robotics)
            env = gym.make(task.env_id, continuing_task=True, max_episode_steps=10**9)
            env = gym.wrappers.TransformObservation(env, lambda obs: obs["observation"], env.observation_space["observation"])
        else:
            env = gym.make(task.env_id, max_episode_steps=10**9).unwrapped
        super().__init__(env)
        self.task, self.visited, self.step_count, self.history = task, set(), 0, []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        corner = np.array([1, 1])
        options = {"reset_cell": corner, "goal_cell": corner} if self.task.env_id.startswith("PointMaze") else options
        return self.env.reset(seed=seed, options=options)

    def step(self, action: np.ndarray):
        observation, _, _, _, info = self.env.step(action)
        self.visited.add(self.task.cell(observation[:2]))
        self.step_count += 1
        if self.step_count % RECORD_EVERY == 0:
            self.history.append((self.step_count, len(self.visited)))
        return observation, 0.0, False, False, info


def run(agent: str, name: str, seed: int, path: Path) -> None:
    task, start = TASKS[name], time.process_time()
    inner = Unrewarded(task)
    env = VecNormalize(DummyVecEnv([lambda: gym.wrappers.TimeLimit(inner, task.episode)]), norm_reward=False)
    model = Plan2Explore(
        "MlpPolicy", env, seed=seed, device="cpu",
        learning_starts=task.steps if agent == "random" else LEARNING_STARTS, train_freq=TRAIN_FREQ,
        uncertainty_class="plan2explore" if agent == "random" else agent,
    )  # fmt: skip
    model.learn(task.steps, log_interval=None)
    table = Table(path)
    for step, cells in inner.history:
        table.add(agent=agent, env=name, seed=seed, step=step, cells=cells, share=round(cells / task.reachable, 5))
    table.complete()
    print(f"{agent} {name} seed {seed}: {inner.history[-1][1]} of {task.reachable} cells after {task.steps} steps, "
          f"{time.process_time() - start:.0f} CPU s", flush=True)  # fmt: skip


def plot() -> None:
    data = curves(read(FOLDER), "share")
    draw(FOLDER / "coverage.png", data, [env for env in TASKS if any(key[0] == env for key in data)], "share of cells", NAMES)
    numbers = {"mean_share": np.mean, "ci95": interval, "lowest": np.min, "highest": np.max}
    write_summary(FOLDER / "summary.csv", data, numbers, digits=4)
    for (env, agent), steps in sorted(data.items()):
        step, values = max(steps.items())
        share = f"{values.mean():.1%} +- {interval(values):.1%}"
        print(f"{env} {agent} after {step} steps: {share} of the cells, {len(values)} seeds")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["run", "plot"])
    parser.add_argument("--agent", nargs="+", choices=list(NAMES), default=list(NAMES))
    parser.add_argument("--env", nargs="+", choices=list(TASKS), default=["mountaincar"])
    parser.add_argument("--seed", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    args = parser.parse_args()
    if args.command == "plot":
        plot()
        return
    th.set_num_threads(1)
    for agent, env, seed, path in missing(FOLDER, args.agent, args.env, args.seed):
        run(agent, env, seed, path)


if __name__ == "__main__":
    main()
