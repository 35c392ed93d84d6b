"""
What the benchmarks that train have in common: fixed evaluation episodes, one CSV per run that appears only when the run is
complete, means with 95% confidence intervals over seeds.
"""

import csv
import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy import stats
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_cpm.files import replacing
from sb3_cpm.seeds import FIRST_SEED


class FixedEpisodes(BaseCallback):
    """
    Evaluates before the first step, every ``every`` steps, and at the end, on one and the same episode per environment.

    :param env: as many environments as episodes; environment i starts with seed ``FIRST_SEED + i``
    :param every: steps between two evaluations
    :param record: called with the step, the returns and the lengths
    """

    def __init__(self, env: VecEnv, every: int, record: Callable[[int, list[float], list[int]], None]) -> None:
        super().__init__()
        self.env, self.every, self.record = env, every, record

    def _on_training_start(self) -> None:
        self.evaluate(self.model, 0)

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every == 0:
            self.evaluate(self.model, self.num_timesteps)
        return True

    def evaluate(self, model: BaseAlgorithm, step: int) -> None:
        self.env.seed(FIRST_SEED)
        returns, lengths = evaluate_policy(
            model, self.env, self.env.num_envs, deterministic=True, return_episode_rewards=True, warn=False
        )
        self.record(step, returns, lengths)


class Table:
    """
    Rows of one run; the file gets its name when the run is complete.

    :param path: of the file
    """

    def __init__(self, path: Path) -> None:
        self.path, self.rows = path, []

    def add(self, **row: Any) -> None:
        self.rows.append(row)

    def complete(self) -> None:
        with replacing(self.path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(self.rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(self.rows)


def missing(
    folder: Path, agents: Iterable[str], envs: Iterable[str], seeds: Iterable[int]
) -> Iterator[tuple[str, str, int, Path]]:
    """:return: agent, environment, seed and file of the runs that are not complete; those that are, are told"""
    for seed, env, agent in itertools.product(seeds, envs, agents):
        path = folder / agent / env / f"seed{seed}.csv"
        if path.exists():
            print(f"{path} is there already")
        else:
            yield agent, env, seed, path


def write_summary(
    path: Path,
    data: dict[tuple[str, str], dict[int, np.ndarray]],
    numbers: dict[str, Callable[[np.ndarray], float]],
    digits: int,
) -> None:
    """
    One row per environment, agent and step.

    :param path: of the CSV file
    :param data: from :func:`curves`
    :param numbers: columns, and what stands in them of the values of all seeds
    :param digits: after the point
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["env", "agent", "step", "seeds", *numbers])
        for (env, agent), steps in sorted(data.items()):
            for step, values in steps.items():
                row = (round(float(number(values)), digits) for number in numbers.values())
                writer.writerow([env, agent, step, len(values), *row])


def read(folder: Path) -> list[dict[str, str]]:
    """:return: rows of all complete runs below a folder"""
    rows = []
    for path in sorted(folder.glob("*/*/seed*.csv")):
        with path.open(newline="", encoding="utf-8") as file:
            rows += list(csv.DictReader(file))
    return rows


def curves(rows: Iterable[dict[str, str]], value: str) -> dict[tuple[str, str], dict[int, np.ndarray]]:
    """:return: by (env, agent) and step: the mean over episodes of every seed, in the order of the seeds"""
    per_seed: dict[tuple[str, str], dict[int, dict[int, list[float]]]] = defaultdict(
        lambda: defaultdict(lambda: defaultdict(list))
    )
    for row in rows:
        per_seed[row["env"], row["agent"]][int(row["step"])][int(row["seed"])].append(float(row[value]))
    return {
        key: {step: np.array([np.mean(seeds[seed]) for seed in sorted(seeds)]) for step, seeds in sorted(steps.items())}
        for key, steps in per_seed.items()
    }


def interval(values: np.ndarray) -> float:
    """:return: half of the 95% confidence interval of a mean over seeds, by Student's t; nan for a single seed"""
    if len(values) < 2:
        return np.nan
    return float(stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))


def draw(
    path: Path,
    data: dict[tuple[str, str], dict[int, np.ndarray]],
    envs: Sequence[str],
    label: str,
    names: dict[str, str],
    lines: dict[str, float] | None = None,
) -> None:
    """
    One panel per environment; one line per agent with its confidence interval, and a thin one per seed. The y axis has room
    for every seed, not for the whole of an interval, which is very wide where two or three seeds differ.

    :param path: of the picture
    :param data: from :func:`curves`
    :param envs: those to draw
    :param label: of the y axis
    :param names: agents and how the legend calls them
    :param lines: by environment, a value to mark
    """
    figure, axes = plt.subplots(1, len(envs), figsize=(4.6 * len(envs), 4.0), squeeze=False, layout="constrained")
    for axis, env in zip(axes[0], envs, strict=True):
        low, high = np.inf, -np.inf
        for index, (agent, name) in enumerate(names.items()):
            steps = data.get((env, agent))
            if not steps:
                continue
            x, mean = list(steps), np.array([values.mean() for values in steps.values()])
            half = np.array([interval(values) for values in steps.values()])
            n_seeds = max(len(values) for values in steps.values())
            colour = f"C{index}"  # an agent's in all panels
            axis.plot(x, mean, label=f"{name} ({n_seeds} seeds)", linewidth=1.8, color=colour)
            axis.fill_between(x, mean - half, mean + half, alpha=0.15, color=colour, linewidth=0)
            for seed in range(n_seeds):
                one = [values[seed] if seed < len(values) else np.nan for values in steps.values()]
                axis.plot(x, one, color=colour, linewidth=0.7, alpha=0.6)
            low, high = min(low, *(values.min() for values in steps.values())), max(high, *(v.max() for v in steps.values()))
        if lines and env in lines:
            axis.axhline(lines[env], color="grey", linestyle=":", linewidth=1)
        axis.set(title=env, xlabel="environment steps", ylabel=label)
        axis.set_ylim(low - 0.08 * (high - low), high + 0.08 * (high - low))
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(0.0, -0.2))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)
