"""
How fast Dreamer learns with the default preset: Pendulum-v1 from its state vector, and small tasks from 32x32 pictures alone.

::

    python benchmarks/dreamer_learning.py run --agent dreamer dreamer_categorical --env pendulum square_pixels
    python benchmarks/dreamer_learning.py run --agent sheeprl --env pendulum square_pixels --peer-python PATH
    python benchmarks/dreamer_learning.py plot

Every run writes ``results/dreamer/AGENT/ENV/seedN.csv`` when it is complete; complete runs are skipped. Each evaluation plays
the same ten episodes (seeds from 1,000,000 on) deterministically. ``plot`` draws ``results/dreamer/learning.png`` and writes
``results/dreamer/summary.csv``, means over seeds with 95% confidence intervals. sheeprl is run by
``peers/sheeprl_learning.py`` in an interpreter of its own, with the same sizes, environment steps and updates. Its latents are
categorical; ``dreamer_categorical`` is ours with latents of the same kind and size. Agents that end in ``_stopped`` are ours
whose gradient stops at the actor's input, as sheeprl's does.
"""

import argparse
import json
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from learning_curves import FixedEpisodes, Table, curves, draw, interval, missing, read, write_summary
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_cpm.dreamer import Dreamer
from sb3_cpm.presets import make_preset

FOLDER = Path(__file__).parents[1] / "results" / "dreamer"
EPISODES = 10
LEARNING_STARTS = 1000
NAMES = {
    "dreamer": "sb3_cpm Dreamer",
    "dreamer_stopped": "sb3_cpm Dreamer, gradient stopped",
    "dreamer_categorical": "sb3_cpm Dreamer, categorical",
    "dreamer_categorical_stopped": "sb3_cpm Dreamer, categorical, gradient stopped",
    "sheeprl": "sheeprl dreamer_v2",
}
PRESETS: dict[str, Any] = {
    "dreamer": "default",
    "dreamer_stopped": {"actor_input_gradient": False},
    "dreamer_categorical": {"latent": "categorical"},
    "dreamer_categorical_stopped": {"latent": "categorical", "actor_input_gradient": False},
}
TASKS: dict[str, dict[str, Any]] = {
    "pendulum": dict(id="Pendulum-v1", steps=8000, every=1000, train_freq=5, pretrain=0, last_rate=1e-4, solved=-200),
    "square_pixels": dict(
        id="pixels:SquareToCentre-v0", steps=4000, every=500, train_freq=5, pretrain=300, last_rate=3e-4, solved=-2
    ),
    "pendulum_pixels": dict(
        id="pixels:PendulumPixels-v0", steps=12_000, every=1000, train_freq=3, pretrain=300, last_rate=3e-4, solved=-200
    ),
}


def make_env(env: str, n_envs: int = 1, seed: int = 0) -> VecEnv:
    return make_vec_env(TASKS[env]["id"], n_envs, seed=seed)


def run_dreamer(agent: str, env: str, seed: int, path: Path) -> None:
    task, table, start = TASKS[env], Table(path), time.process_time()
    policy = "MultiInputPolicy" if isinstance(gym.make(task["id"]).observation_space, gym.spaces.Dict) else "MlpPolicy"
    model = Dreamer(
        policy, make_env(env, seed=seed), LinearSchedule(1e-3, task["last_rate"], 1.0), learning_starts=LEARNING_STARTS,
        train_freq=task["train_freq"], pretrain_steps=task["pretrain"], seed=seed, device="cpu",
        preset=PRESETS[agent],
    )  # fmt: skip

    def record(step: int, returns: list[float], lengths: list[int]) -> None:
        cpu = round(time.process_time() - start, 1)
        for episode, (value, length) in enumerate(zip(returns, lengths, strict=True)):
            table.add(agent=agent, env=env, seed=seed, step=step, episode=episode, **{"return": round(value, 4)},
                      length=length, updates=model._n_updates, cpu_seconds=cpu)  # fmt: skip
        print(f"{agent} {env} seed {seed} step {step}: {sum(returns) / len(returns):.1f} after {cpu} CPU s", flush=True)

    model.learn(task["steps"], callback=FixedEpisodes(make_env(env, EPISODES), task["every"], record), log_interval=None)
    table.complete()


def run_sheeprl(env: str, seed: int, path: Path, python: str) -> None:
    """In a process of its own, which writes the same table."""
    task = TASKS[env]
    settings = dict(
        env=env, id=task["id"], seed=seed, steps=task["steps"], every=task["every"], episodes=EPISODES, path=str(path),
        learning_starts=LEARNING_STARTS, train_freq=task["train_freq"], pretrain=task["pretrain"],
        last_rate=task["last_rate"], preset=asdict(make_preset(cnn_layers=3)),  # its decoder starts from 4x4, ours from 2x2
    )  # fmt: skip
    script = Path(__file__).parent / "peers" / "sheeprl_learning.py"
    subprocess.run([python, str(script), json.dumps(settings)], check=True)


def plot() -> None:
    data = curves(read(FOLDER), "return")
    draw(
        FOLDER / "learning.png", data, [env for env in TASKS if any(key[0] == env for key in data)],
        "return of 10 fixed episodes", NAMES, {env: task["solved"] for env, task in TASKS.items()},
    )  # fmt: skip
    numbers = {"mean_return": np.mean, "ci95": interval, "worst_seed": np.min}
    write_summary(FOLDER / "summary.csv", data, numbers, digits=2)
    for (env, agent), steps in sorted(data.items()):
        step, values = max(steps.items())
        print(f"{env} {agent} step {step}: {values.mean():.1f} +- {interval(values):.1f}, worst seed {values.min():.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["run", "plot"])
    parser.add_argument("--agent", nargs="+", choices=list(NAMES), default=["dreamer"])
    parser.add_argument("--env", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--seed", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--peer-python", default=sys.executable, help="interpreter that has sheeprl")
    args = parser.parse_args()
    if args.command == "plot":
        plot()
        return
    th.set_num_threads(1)
    for agent, env, seed, path in missing(FOLDER, args.agent, args.env, args.seed):
        if agent == "sheeprl":
            run_sheeprl(env, seed, path, args.peer_python)
        else:
            run_dreamer(agent, env, seed, path)


if __name__ == "__main__":
    main()
