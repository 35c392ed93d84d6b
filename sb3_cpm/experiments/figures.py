"""
Figures of the experiments, from their CSV files alone.

Lines are interquartile means over seeds, bands 95% stratified bootstrap intervals (see :mod:`sb3_cpm.experiments.statistics`).
"""

import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sb3_cpm.experiments.collect import Data, collect
from sb3_cpm.experiments.specification import Experiment
from sb3_cpm.experiments.statistics import binned, estimate, per_seed
from sb3_cpm.run.plots import BLACK, BLUE, GREEN, GREY, ORANGE, PINK, PURPLE, RED, STYLE, TEAL

COLOURS = (BLUE, ORANGE, GREEN, PURPLE, RED, GREY, PINK, BLACK, TEAL)
#: Agents of several experiments look alike in all of them; the others take what is left.
USUAL_COLOURS = {
    "SAC": BLUE,
    "CPM-SAC": ORANGE,
    "CPM tuned": GREEN,
    "CPM, weak challenges": GREEN,
    "Plan2Explore": PURPLE,
    "SAC+HER": RED,
    "CPM high exploration": BLUE,
    "CPM simple": ORANGE,
    "Dreamer": GREEN,
    "PPO point cloud": PURPLE,
    "PPO RGBD": RED,
    "SAC point cloud": GREY,
    "CPM report": PINK,
}
LEGEND_COLUMNS = 4
#: Columns of evaluations.csv with the words for them.
SCORES = {
    "success_at_end": "success at the end of the episode",
    "success_once": "success at any moment",
    "return": "return",
}


class Panel(NamedTuple):
    """
    Logged numbers in one axis.

    :param title: of the axis
    :param names: what is drawn, by its name in diagnostics.csv; of alternatives in a tuple the first that was logged
    :param log: logarithmic axis
    """

    title: str
    names: tuple[str | tuple[str, ...], ...]
    log: bool = False


def _model(name: str) -> tuple[str, ...]:
    """A loss of the world model: logged by the challenger, and by Dreamer as its own."""
    return (f"challenger/{name}", f"train/{name}")


PANELS: dict[str, tuple[Panel, ...]] = {
    "quality": (
        Panel("u, mean of a trajectory", ("challenge/uncertainty",), True),
        Panel("r, mean of a trajectory", ("challenge/mean_reward",)),
        Panel("c, coefficient of r in the score S = c r + u", ("challenge/c",), True),
    ),
    "filters": (
        Panel("w1, novel enough (larger is looser)", ("challenge/w1",)),
        Panel("w2, relevant to the task (larger is looser)", ("challenge/w2",)),
        Panel("w3, a highlight (smaller is looser)", ("challenge/w3",)),
        Panel(
            "share accepted so far: F1, F2 (dashed), F3 (dotted)",
            ("challenge/acceptance_novel", "challenge/acceptance_relevant", "challenge/acceptance_highlight"),
        ),
    ),
    "rewards": (
        Panel("epsilon, probability that C acts", ("rollout/exploration_rate",)),
        Panel("u, exploration reward before scaling", ("challenge/uncertainty",), True),
        Panel("c_expl", ("challenge/c_expl",), True),
        Panel("c_step", ("challenge/c_step",), True),
        Panel("c_emb", ("challenge/c_emb",), True),
        Panel("r', mean artificial reward", ("challenge/reward",)),
    ),
    "plan2explore": (
        Panel("ensemble loss", (_model("uncertainty_loss"),)),
        Panel("k, scale before the exponential function", (_model("exp_scale"),), True),
        Panel("d, disagreement of the ensemble", (_model("raw_disagreement"),), True),
        Panel("novelty: exp(k d) - 1, or log(d)", (_model("disagreement"),)),
    ),
    "world_model": (
        Panel("image loss", (_model("image_loss"),)),
        Panel("pixel error, mean absolute, scale of [-0.5, 0.5]", (_model("pixel_error"),)),
        Panel("KL of posterior and prior, nats", (_model("kl"),)),
        Panel("reward loss", (_model("reward_loss"),)),
        Panel("reward error, mean absolute", (_model("reward_error"),)),
        Panel("reward error over mean absolute reward", (_model("relative_reward_error"),)),
    ),
    "player": (
        Panel("Q values (dashed: on I)", ("player/q_D", "player/q_I")),
        Panel("critic loss (dashed: on I)", ("player/critic_loss_D", "player/critic_loss_I"), True),
        Panel("actor loss (dashed: on I)", ("player/actor_loss_D", "player/actor_loss_I")),
    ),
}


def draw_experiment(
    experiment: Experiment,
    results: str | Path,
    version: str = "full",
    source: Experiment | None = None,
    task: str | None = None,
) -> tuple[Figure, list[str]]:
    """
    :param experiment: what is drawn
    :param results: folder of all results
    :param version: which of the experiment's versions
    :param source: another experiment whose runs are drawn in the same way
    :param task: only the runs on this one
    :return: the figure, and notes about its data
    :raises ValueError: where there is no data, with the command that makes it
    """
    drawn = source or experiment
    data = collect(drawn, results, version, task)
    tasks = ", ".join(dict.fromkeys(data.tables["evaluations"]["env"]))
    with plt.rc_context(STYLE):
        figure = DRAWINGS[experiment.drawing](drawn, data)
        write_title(figure, _title(experiment, version, source, tasks))
    return figure, data.notes


def write_title(figure: Figure, text: str) -> None:
    """
    :param figure: gets the title, in as many lines as its width asks for
    :param text: of the title; its lines stay lines
    """
    title = figure.suptitle(text, fontweight="bold")
    share = 0.95 * figure.bbox.width / title.get_window_extent().width
    if share < 1.0:
        columns = int(share * max(len(line) for line in text.splitlines()))
        title.set_text("\n".join(textwrap.fill(line, columns) for line in text.splitlines()))


def _title(experiment: Experiment, version: str, source: Experiment | None, tasks: str) -> str:
    number = f"Figure {experiment.figure}: " if experiment.figure else ""
    told = "" if version == "full" else f"{version} version, on {tasks}"
    if source is not None:
        return f"{number}{experiment.title}\nruns of {source.name}, {told or tasks}"
    return f"{number}{experiment.title}" + (f" ({told})" if told else "")


def _agents(experiment: Experiment, table: pd.DataFrame) -> list[str]:
    """In the catalog's order, those that there is data of."""
    there = set(table["agent"])
    return [contender.name for contender in experiment.contenders if contender.name in there]


def _colours(experiment: Experiment) -> dict[str, str]:
    """An agent has the same colour in all panels, whether or not the others have data."""
    agents = [contender.name for contender in experiment.contenders]
    if len(agents) > len(COLOURS):
        raise ValueError(f"{experiment.name} has {len(agents)} agents: expected at most {len(COLOURS)}, one per colour")
    usual = {name: USUAL_COLOURS[name] for name in agents if name in USUAL_COLOURS}
    left = iter([colour for colour in COLOURS if colour not in usual.values()])
    return {name: usual.get(name) or next(left) for name in agents}


def _line(axes: Axes, scores: pd.DataFrame, colour: str, label: str | None, style: str = "-", bands: bool = True) -> None:
    curve = estimate(scores)
    if not len(curve.steps):
        return
    axes.plot(curve.steps, curve.iqm, style, color=colour, label=label and f"{label} ({_seeds(curve.n_seeds)})")
    if bands and curve.n_seeds > 1:
        axes.fill_between(curve.steps, curve.low, curve.high, color=colour, alpha=0.15, lw=0)


def _seeds(*numbers: int) -> str:
    """:param numbers: in ascending order; panels may differ"""
    if numbers == (1,):
        return "1 seed"
    return f"{numbers[0]} seeds" if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]} seeds"


def _grid(rows: int, columns: int, share: Literal["col", "none"] = "none") -> tuple[Figure, np.ndarray]:
    """:param share: "col" where the axes of a column show the same of several tasks"""
    size = 4.6 * columns, 3.2 * rows + 0.6
    return plt.subplots(rows, columns, figsize=size, squeeze=False, sharey=share, layout="constrained")


def _nothing(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes, color=GREY)


# ---------------------------------------------------------------------- scores of episodes


def _draw_scores(experiment: Experiment, table: pd.DataFrame) -> Figure:
    tasks = list(dict.fromkeys(table["env"]))
    figure, grid = _grid(len(tasks), len(SCORES), share="col")
    for task, row in zip(tasks, grid, strict=True):
        of_task = table[table["env"] == task]
        for (score, words), axes in zip(SCORES.items(), row, strict=True):
            _draw_score(axes, score, experiment, of_task)
            axes.set_title(f"{task}\n{words}" if len(tasks) > 1 else words)
            if score != "return":
                axes.set_ylim(-0.05, 1.05)
    return _finished(figure, grid)


def _draw_score(axes: Axes, score: str, experiment: Experiment, table: pd.DataFrame, bands: bool = True) -> None:
    """One score of all agents on one task."""
    colours = _colours(experiment)
    for agent in _agents(experiment, table):
        of_agent = table[table["agent"] == agent]
        if of_agent[score].notna().any():
            _line(axes, per_seed(of_agent, score), colours[agent], agent, bands=bands)
    if not axes.lines:
        _nothing(axes, "this task says nothing about success")


def _finished(figure: Figure, grid: np.ndarray) -> Figure:
    """With the x axis' name and a few ticks, and one legend below that has every agent once."""
    for axes in grid[-1]:
        axes.set_xlabel("environment steps")
    for axes in grid.flat:
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    handles: dict[str, Artist] = {}
    numbers: dict[str, set[int]] = {}
    for axes in grid.flat:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            told = re.fullmatch(r"(.*) \((\d+) seeds?\)", label)
            name = label if told is None else told[1]
            handles.setdefault(name, handle)
            numbers.setdefault(name, set()).update([] if told is None else [int(told[2])])
    if handles:
        labels = [f"{name} ({_seeds(*sorted(numbers[name]))})" if numbers[name] else name for name in handles]
        columns = min(len(handles), LEGEND_COLUMNS)
        figure.legend(handles.values(), labels, loc="outside lower center", ncols=columns, fontsize=9)
    return figure


def add_note(figure: Figure, text: str) -> None:
    """Small print below everything else."""
    rows = sum(-(-len(legend.get_texts()) // LEGEND_COLUMNS) for legend in figure.legends)
    # the layout makes room for this and for the legend, but at the same place: the empty lines are the legend's
    figure.supxlabel(text + (1 + 2 * rows) * "\n", fontsize=7, wrap=True)


def _draw_curves(experiment: Experiment, data: Data) -> Figure:
    return _draw_scores(experiment, data.tables["evaluations"])


def _draw_training(experiment: Experiment, data: Data) -> Figure:
    return _draw_scores(experiment, binned(data.tables["training"]))


# ---------------------------------------------------------------------- logged numbers


def _draw_panels(panels: Sequence[Panel], experiment: Experiment, data: Data) -> Figure:
    table = data.tables["diagnostics"]
    tasks = sorted(set(table["env"]))
    if len(tasks) > 1:
        raise ValueError(f"Logged numbers are drawn of one task: choose task= one of {', '.join(map(repr, tasks))}.")
    columns = 2 if len(panels) == 4 else min(3, len(panels))
    figure, grid = _grid(-(-len(panels) // columns), columns)
    for axes, panel in zip(grid.flat, panels, strict=False):
        _draw_panel(axes, panel, experiment, table)
    for axes in list(grid.flat)[len(panels) :]:
        axes.axis("off")
    return _finished(figure, grid)


def _draw_panel(axes: Axes, panel: Panel, experiment: Experiment, table: pd.DataFrame) -> None:
    axes.set_title(panel.title, fontsize=9.5)
    colours = _colours(experiment)
    for agent in _agents(experiment, table):
        of_agent = table[table["agent"] == agent]
        for style, names in zip(("-", "--", ":"), panel.names, strict=False):
            alternatives = (names,) if isinstance(names, str) else names
            logged = [name for name in alternatives if (of_agent["name"] == name).any()]
            if logged:
                numbers = binned(of_agent[of_agent["name"] == logged[0]])
                _line(axes, per_seed(numbers, "value"), colours[agent], agent if style == "-" else None, style)
    if not axes.lines:
        _nothing(axes, "nothing was logged")
    elif panel.log and all((np.asarray(line.get_ydata(), dtype=float) > 0).all() for line in axes.lines):
        axes.set_yscale("log")


def _draw_decays(experiment: Experiment, data: Data) -> Figure:
    """The schedules, and what became of them: return while training, return and success at the end."""
    evaluations, diagnostics = data.tables["evaluations"], data.tables["diagnostics"]
    figure, grid = _grid(2, 2)
    _draw_panel(grid[0, 0], PANELS["rewards"][0], experiment, diagnostics)
    grid[0, 1].set_title("return, without intervals", fontsize=9.5)
    _draw_score(grid[0, 1], "return", experiment, evaluations, bands=False)
    for axes, score in zip(grid[1], ("return", "success_once"), strict=True):
        axes.set_title(f"last evaluation: {SCORES[score]}", fontsize=9.5)
        _draw_ends(axes, score, experiment, evaluations)
    return _finished(figure, grid[:1])


def _draw_ends(axes: Axes, score: str, experiment: Experiment, table: pd.DataFrame) -> None:
    """Where so many curves end: bands of all would cover each other."""
    colours, agents = _colours(experiment), _agents(experiment, table)
    for place, agent in enumerate(agents):
        scores = per_seed(table[table["agent"] == agent], score)
        if len(scores):
            curve = estimate(scores)
            axes.plot([curve.low[-1], curve.high[-1]], [place, place], color=colours[agent], lw=2)
            axes.plot(curve.iqm[-1], place, "o", color=colours[agent])
    axes.set(yticks=range(len(agents)), yticklabels=agents, ylim=(len(agents) - 0.5, -0.5))


def _panels(name: str) -> Callable[[Experiment, Data], Figure]:
    return lambda experiment, data: _draw_panels(PANELS[name], experiment, data)


DRAWINGS: dict[str, Callable[[Experiment, Data], Figure]] = {
    "curves": _draw_curves,
    "training": _draw_training,
    "decays": _draw_decays,
    **{name: _panels(name) for name in PANELS},
}
"""How an experiment is drawn, by the name that the catalog has for it."""
