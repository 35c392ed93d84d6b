"""
How much of an environment is seen without any reward: share of the cells of a state grid that were visited.

::

    python benchmarks/coverage.py run --env mountaincar maze_medium --seed 10 11 12 13 14 15 16 17 18 19
    python benchmarks/coverage.py run --agent plan2explore --env maze_medium --seed 100 --preset '{horizon: 15}' --name h15
    python benchmarks/coverage.py plot

The cells are position x velocity on MountainCarContinuous-v0, positions in the free part of the two mazes, where every episode
begins in the same corner, and positions of the puck on CPMToy-v0, which is seen by a camera and has to be pushed. All agents
have the same episodes (of the same length, without an early end) and the same first random steps, and never see a reward.
``plan2explore`` explores as the challenger of ``ChallengerCallback()`` does: its default preset, an update every 8 steps.
``observation_ensemble`` and ``rnd`` are the same with the uncertainty class of that name; ``pink`` is pink noise
(pink-noise-rl).
Every run writes ``results/coverage/AGENT/ENV/seedN.csv`` when it is complete;
complete runs are skipped. ``plot`` draws ``results/coverage/coverage.png`` and writes ``results/coverage/summary.csv``, means
over seeds with 95% confidence intervals. With ``--preset`` (entries as YAML) and ``--name`` an agent of another preset is
tried, whose results lie in ``results/coverage-trials/NAME``.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
import yaml
from learning_curves import Table, curves, draw, interval, missing, read, write_summary
from pink import PinkActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_cpm.dreamer import Plan2Explore
from sb3_cpm.envs.toy import ToyEnv
from sb3_cpm.uncertainty import UNCERTAINTY_CLASSES

FOLDER = Path(__file__).parents[1] / "results" / "coverage"
TRIALS = FOLDER.with_name("coverage-trials")
NAMES = {
    "plan2explore": "Plan2Explore (default)",
    "observation_ensemble": "ensemble of embeddings",
    "rnd": "RND",
    "pink": "pink noise",
    "random": "random actions",
}
LEARNING_STARTS, TRAIN_FREQ = 500, 8
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
    # 26 free squares of 1 m x 1 m, 2 x 2 cells each
    "maze_medium": Task("PointMaze_Medium-v3", 5000, 600, (-4.0, -4.0), (4.0, 4.0), (16, 16), 104),
    "toy": Task("CPMToy-v0", 5000, 50, (-1.0, -1.0), (1.0, 1.0), (20, 20), 400),
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
        elif task.env_id == "CPMToy-v0":
            env = ToyEnv(keys=("camera",), task="push")
        else:
            env = gym.make(task.env_id, max_episode_steps=10**9).unwrapped
        super().__init__(env)
        self.task, self.visited, self.step_count, self.history = task, set(), 0, []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        corner = np.array([1, 1])
        options = {"reset_cell": corner, "goal_cell": corner} if self.task.env_id.startswith("PointMaze") else options
        seed = 0 if self.task.env_id == "CPMToy-v0" else seed  # puck and robot begin in the same places
        return self.env.reset(seed=seed, options=options)

    def step(self, action: np.ndarray):
        observation, _, _, _, info = self.env.step(action)
        state = self.env._positions[2] if self.task.env_id == "CPMToy-v0" else observation[:2]
        self.visited.add(self.task.cell(state))
        self.step_count += 1
        if self.step_count % RECORD_EVERY == 0:
            self.history.append((self.step_count, len(self.visited)))
        return observation, 0.0, False, False, info


def explore(model_env: VecEnv, agent: str, task: Task, seed: int, preset: dict[str, Any], train_freq: int) -> None:
    """Let an agent act for all of a task's steps; the environment counts what it sees."""
    if agent == "pink":
        space = model_env.action_space
        noise = PinkActionNoise(1.0, task.episode, space.shape[0], np.random.default_rng(seed))
        model_env.seed(seed)
        model_env.reset()
        for _ in range(task.steps):
            model_env.step(np.clip(noise(), -1.0, 1.0)[None] * space.high)
        return
    policy = "MultiInputPolicy" if isinstance(model_env.observation_space, gym.spaces.Dict) else "MlpPolicy"
    model = Plan2Explore(
        policy, model_env, seed=seed, device="cpu", preset=preset,
        learning_starts=task.steps if agent == "random" else LEARNING_STARTS, train_freq=train_freq,
        uncertainty_class=agent if agent in UNCERTAINTY_CLASSES else "plan2explore",
    )  # fmt: skip
    model.learn(task.steps, log_interval=None)


def run(agent: str, name: str, seed: int, path: Path, preset: dict[str, Any], train_freq: int = TRAIN_FREQ) -> None:
    task, start = TASKS[name], time.process_time()
    inner = Unrewarded(task)
    env = DummyVecEnv([lambda: gym.wrappers.TimeLimit(inner, task.episode)])
    explore(env if name == "toy" else VecNormalize(env, norm_reward=False), agent, task, seed, preset, train_freq)
    table, seconds = Table(path), time.process_time() - start
    for step, cells in inner.history:
        share = round(cells / task.reachable, 5)
        table.add(agent=agent, env=name, seed=seed, step=step, cells=cells, share=share, cpu_seconds=round(seconds, 1))
    table.complete()
    print(f"{path.parts[-3]} {name} seed {seed}: {inner.history[-1][1]} of {task.reachable} cells after {task.steps} steps, "
          f"{seconds:.0f} CPU s", flush=True)  # fmt: skip


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
    parser.add_argument("--preset", type=yaml.safe_load, default={}, help="entries of the challenger's preset, as YAML")
    parser.add_argument("--train-freq", type=int, default=TRAIN_FREQ, help="steps between two updates")
    parser.add_argument("--name", default="", help="of a trial with another preset")
    args = parser.parse_args()
    if args.command == "plot":
        plot()
        return
    if bool(args.name) != bool(args.preset or args.train_freq != TRAIN_FREQ):
        parser.error("--preset and --train-freq make a trial, which needs a --name of its own")
    th.set_num_threads(1)
    th.set_flush_denormal(True)
    for agent, env, seed, path in missing(TRIALS / args.name if args.name else FOLDER, args.agent, args.env, args.seed):
        run(agent, env, seed, path, args.preset, args.train_freq)


if __name__ == "__main__":
    main()
