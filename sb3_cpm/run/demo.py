"""
``python -m sb3_cpm demo``: one task, the same player with and without the challenger, one picture. Two minutes on two cores,
without ManiSkill and a renderer.
"""

import json
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch as th
from matplotlib.axes import Axes
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cpm.agents import load_agent
from sb3_cpm.arguments import check, integer
from sb3_cpm.files import disk_errors_named, write_text
from sb3_cpm.run.evaluation import evaluate, means
from sb3_cpm.run.plots import BLUE, GREY, ORANGE, STYLE, save_figure
from sb3_cpm.seeds import check_seed

ENV_ID = "MountainCarContinuous-v0"
#: What is shown, and the file in ``zoo_configs/`` that it is.
AGENTS: Mapping[str, str] = {"SAC alone": "sac", "the same SAC with a challenger": "cpm_sac"}
#: Of gymnasium's task: what it can be in, and where it pays.
POSITIONS, VELOCITIES, GOAL = (-1.2, 0.6), (-0.07, 0.07), 0.45
EVAL_EPISODES = 10
BEHIND_TEXT = {"facecolor": "white", "alpha": 0.8, "linewidth": 0}


@dataclass(frozen=True)
class Shown:
    """
    What one agent did.

    :param name: as the picture names it
    :param states: position and velocity after every step, shape ``(steps, 2)``
    :param goals: steps at which the goal was reached
    :param success: share of evaluation episodes that end at the goal
    :param mean_return: of these episodes
    :param seconds: that it took
    """

    name: str
    states: np.ndarray
    goals: list[int]
    success: float
    mean_return: float
    seconds: float

    def __str__(self) -> str:
        found = f"reached the goal first at step {self.goals[0]}" if self.goals else "never reached the goal"
        return (
            f"{self.name}: {found}; afterwards it gets there in {self.success:.0%} of {EVAL_EPISODES} episodes "
            f"(mean return {self.mean_return:.0f}, {self.seconds:.0f} s)."
        )


class _Trace(BaseCallback):
    """Where the car was, and when it arrived."""

    def __init__(self) -> None:
        super().__init__()
        self.states: list[np.ndarray] = []
        self.goals: list[int] = []

    def _on_step(self) -> bool:
        self.states.append(np.asarray(self.training_env.get_attr("state")[0]))
        if self.locals["infos"][0].get("is_success"):
            self.goals.append(self.num_timesteps)
        return True


def show(name: str, agent: str, steps: int, seed: int) -> Shown:
    """
    Train and evaluate one agent.

    :param name: as the picture names it
    :param agent: a file of ``zoo_configs/``
    :param steps: environment steps
    :param seed: of environment and networks
    """
    th.set_num_threads(1)  # the other agent has the other core
    began, trace = time.perf_counter(), _Trace()
    built = load_agent(agent, ENV_ID).build(seed, device="cpu")
    evaluation = built.make_eval_env()
    try:
        built.model.learn(steps, callback=[*built.callbacks, trace])
        mean_return, success = means(evaluate(built.model, evaluation, EVAL_EPISODES))
    finally:
        built.env.close()
        evaluation.close()
    assert success is not None, "a wrapper of the agents says it"
    return Shown(name, np.array(trace.states), trace.goals, success, mean_return, time.perf_counter() - began)


def demo(
    folder: str | Path = "runs/demo",
    steps: int = 5000,
    seed: int = 0,
    tell: Callable[[str], None] = lambda news: None,
    status: Callable[[str], AbstractContextManager[object]] = lambda news: nullcontext(),
) -> list[Shown]:
    """
    Train plain SAC and the same SAC with a challenger on ``MountainCarContinuous-v0``, each in a process of its own, and draw
    where they have been: ``demo.png``. Numbers: ``demo.json``.

    :param folder: for both files
    :param steps: environment steps of each agent
    :param seed: of both
    :param tell: is given a line per agent, as soon as it is known, and one at the end
    :param status: a context manager that shows what is waited for, as rich's ``Console.status``
    :return: what they did, plain SAC first
    :raises ValueError: for steps or a seed that cannot work, before anything is trained
    """
    check("steps", steps, integer(1))
    check_seed(seed, 1)
    folder = Path(folder)
    with disk_errors_named(folder):
        folder.mkdir(parents=True, exist_ok=True)
    found: dict[str, Shown] = {}
    with (
        status(f"{steps} steps of {ENV_ID} by {' and by '.join(AGENTS)}: about {max(steps // 40, 10)} s on two cores"),
        ProcessPoolExecutor(len(AGENTS), get_context("spawn")) as pool,
    ):
        for future in as_completed([pool.submit(show, name, agent, steps, seed) for name, agent in AGENTS.items()]):
            one = future.result()
            found[one.name] = one
            tell(str(one))
    shown = [found[name] for name in AGENTS]
    draw(shown, folder / "demo.png")
    numbers = [{key: value for key, value in asdict(one).items() if key != "states"} for one in shown]
    write_text(
        folder / "demo.json", json.dumps({"env": ENV_ID, "steps": steps, "seed": seed, "agents": numbers}, indent=2) + "\n"
    )
    tell(f"Drawn: {folder / 'demo.png'}")
    return shown


def draw(shown: list[Shown], path: Path) -> None:
    """
    :param shown: what the agents did, a panel for each
    :param path: of the picture
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, len(shown), figsize=(11, 4.2), sharey=True, layout="constrained", squeeze=False)
        for one, ax in zip(shown, axes[0], strict=True):
            points = _draw_states(one, ax)
        axes[0, 0].set_ylabel("velocity")
        figure.colorbar(points, ax=axes[0].tolist(), label="step")
        figure.suptitle(
            f"Where they have been: every step of training on {ENV_ID}, whose only reward is at the flag", fontsize=10
        )
        save_figure(figure, path)


def _draw_states(one: Shown, ax: Axes) -> "plt.cm.ScalarMappable":
    points = ax.scatter(one.states[:, 0], one.states[:, 1], c=np.arange(len(one.states)), s=3, cmap="viridis", linewidths=0)
    ax.axvspan(GOAL, POSITIONS[1], color=ORANGE, alpha=0.25, linewidth=0)
    ax.text(GOAL + 0.01, VELOCITIES[0] * 0.98, "goal", color=ORANGE, va="bottom")
    ax.set(xlim=POSITIONS, ylim=VELOCITIES, xlabel="position")
    ax.set_title(one.name, color=BLUE if one.goals else GREY)
    told = f"goal reached in {one.success:.0%} of evaluation episodes"
    first = f"first at step {one.goals[0]}, {len(one.goals)} times in training" if one.goals else "never in training"
    ax.text(0.02, 0.98, f"{told}\n{first}", transform=ax.transAxes, va="top", bbox=BEHIND_TEXT)
    return points
