"""Learning curve, and everything dynamic over time: drawn from the CSV files of a run folder, so also long afterwards."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_cpm.files import replacing, write_text
from sb3_cpm.run.tables import read_csv

BLUE, ORANGE, GREEN, RED, GREY, PURPLE = "#2b6cb0", "#dd6b20", "#2f855a", "#c53030", "#718096", "#6b46c1"
PINK, BLACK, TEAL = "#d53f8c", "#1a202c", "#319795"
STYLE: dict[str, Any] = {
    "figure.dpi": 110,
    "font.size": 10,
    "axes.grid": True,
    "grid.color": "#e2e8f0",
    "axes.edgecolor": "#a0aec0",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "lines.linewidth": 1.8,
}


def save_figure(figure: Figure, path: Path) -> None:
    with replacing(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:], facecolor="white")
    plt.close(figure)


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """:return: mean of the last ``window`` values (of fewer at the start, nan left out), shape ``(len(values),)``"""
    known = np.isfinite(values)
    sums = np.cumsum(np.where(known, values, 0.0))
    counts = np.cumsum(known)
    earlier = np.arange(len(values)) - window  # last index that is too old
    dropped = np.maximum(earlier, 0)
    sums = sums - np.where(earlier >= 0, sums[dropped], 0.0)
    counts = counts - np.where(earlier >= 0, counts[dropped], 0)
    return sums / np.maximum(counts, 1)


def learning_curve(folder: Path, title: str) -> None:
    """
    Draw ``learning_curve.png`` and write ``learning_curve.csv``: training episodes and evaluations in one table.

    :param folder: the run folder, with training.csv and evaluations.csv
    :param title: what was trained
    """
    episodes, evaluations = read_csv(folder / "training.csv"), _per_evaluation(read_csv(folder / "evaluations.csv"))
    episodes = episodes if len(episodes.get("step", ())) else {}
    _write_learning_csv(folder / "learning_curve.csv", episodes, evaluations)
    with plt.rc_context(STYLE):
        figure, (top, bottom) = plt.subplots(2, 1, figsize=(9, 6.5), sharex=True, height_ratios=[3, 2], layout="constrained")
        figure.suptitle(title, fontweight="bold")
        _draw_returns(top, episodes, evaluations)
        _draw_success(bottom, episodes, evaluations)
        bottom.set_xlabel("environment steps")
        save_figure(figure, folder / "learning_curve.png")


def _per_evaluation(episodes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """
    :return: mean, worst and best return and share of successes at the end, for every step with an evaluation
    """
    if not len(episodes.get("step", ())):
        return {}
    steps = np.unique(episodes["step"])
    groups = [episodes["step"] == step for step in steps]
    returns = [episodes["return"][group] for group in groups]
    successes = [episodes["success_at_end"][group] for group in groups]
    return {
        "step": steps,
        "mean_return": np.array([one.mean() for one in returns]),
        "min_return": np.array([one.min() for one in returns]),
        "max_return": np.array([one.max() for one in returns]),
        "success_rate": np.array([one[np.isfinite(one)].mean() if np.isfinite(one).any() else np.nan for one in successes]),
    }


def _window(table: dict[str, np.ndarray]) -> int:
    return int(np.clip(len(table["step"]) // 8, 3, 50))


def _draw_returns(axes: Axes, episodes: dict[str, np.ndarray], evaluations: dict[str, np.ndarray]) -> None:
    axes.set_title("Return")
    if episodes:
        window = _window(episodes)
        axes.plot(episodes["step"], episodes["return"], ".", color=GREY, alpha=0.45, ms=5, label="training episode (P and C)")
        axes.plot(
            episodes["step"], running_mean(episodes["return"], window), color=BLUE, label=f"mean of the last {window} of them"
        )
    if evaluations:
        mean = evaluations["mean_return"]
        axes.errorbar(
            evaluations["step"],
            mean,
            np.stack([mean - evaluations["min_return"], evaluations["max_return"] - mean]),
            color=ORANGE,
            fmt="o-",
            ms=6,
            capsize=3,
            lw=1.2,
            label="evaluation of P: mean, worst, best",
        )
    _legend_above(axes)
    axes.set_ylabel("sum of task rewards of an episode")


def _legend_above(axes: Axes) -> None:
    """Beside the title, where it covers no data."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3, fontsize=9)


def _draw_success(axes: Axes, episodes: dict[str, np.ndarray], evaluations: dict[str, np.ndarray]) -> None:
    axes.set_title("Success")
    if episodes and np.isfinite(episodes["success_at_end"]).any():
        axes.plot(episodes["step"], running_mean(episodes["success_at_end"], _window(episodes)), color=BLUE, label="training")
    if evaluations and np.isfinite(evaluations["success_rate"]).any():
        axes.plot(evaluations["step"], evaluations["success_rate"], "o-", color=ORANGE, ms=6, lw=1.2, label="evaluation")
    if axes.lines:
        _legend_above(axes)
    else:
        axes.text(0.5, 0.5, "this environment reports no is_success", ha="center", transform=axes.transAxes, color=GREY)
    axes.set_ylim(-0.05, 1.05)
    axes.set_ylabel("share of episodes\nthat end in success")


def _write_learning_csv(path: Path, episodes: dict[str, np.ndarray], evaluations: dict[str, np.ndarray]) -> None:
    rows: list[tuple[float, str, float, float]] = []
    if episodes:
        columns = (episodes["step"], episodes["return"], episodes["success_at_end"])
        rows += [(step, "train", total, success) for step, total, success in zip(*columns, strict=True)]
    if evaluations:
        columns = (evaluations["step"], evaluations["mean_return"], evaluations["success_rate"])
        rows += [(step, "eval", total, success) for step, total, success in zip(*columns, strict=True)]
    lines = ["step,kind,return,success"]
    for step, kind, total, success in sorted(rows, key=lambda row: row[0]):
        lines.append(f"{int(step)},{kind},{total:.6g},{'' if np.isnan(success) else f'{success:.6g}'}")
    write_text(path, "\n".join(lines) + "\n")


def coefficients(folder: Path, title: str) -> None:
    """
    Draw ``coefficients.png``: epsilon, coefficients, tolerances, reward memory and the count of challenges over time.

    :param folder: the run folder, with coefficients.csv and proposals.csv
    :param title: what was trained
    """
    table, proposals = _settled(read_csv(folder / "coefficients.csv")), read_csv(folder / "proposals.csv")
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(3, 2, figsize=(11, 9), sharex=True, layout="constrained")
        figure.suptitle(title, fontweight="bold")
        panels = list(grid.flat)
        _draw_epsilon(panels[0], table)
        _lines(panels[1], table, "Challenges, counted", [("proposed", GREY), ("kept", GREEN), ("in_buffer", BLUE)])
        panels[1].set_ylabel("challenges")
        _lines(panels[2], table, "Coefficients of the score  S = c r + c1 KL + DISAG", [("c", BLUE), ("c1", ORANGE)], True)
        if table and np.isfinite(table["k"]).any():
            _lines(panels[2], table, "", [("k", PURPLE)], True, {"k": "k in DISAG = exp(k d) - 1"})
        _lines(
            panels[3],
            table,
            "Coefficients of the artificial reward",
            [("c_expl", BLUE), ("c_emb", ORANGE), ("c_step", GREEN)],
            log=True,
        )
        _lines(
            panels[4],
            table,
            "Tolerances of the filter",
            [("w1", BLUE), ("w2", ORANGE), ("w3", GREEN)],
            names={"w1": "w1 novel enough", "w2": "w2 relevant", "w3": "w3 a highlight (smaller is looser)"},
        )
        _draw_rewards(panels[5], table, proposals)
        for axes in grid[-1]:
            axes.set_xlabel("environment steps")
        save_figure(figure, folder / "coefficients.png")


def _settled(table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Coefficients mean nothing before the first proposal (or challenge) has set their magnitude: left out until then."""
    if table:
        for count, names in (("proposed", ("c", "c1", "k")), ("kept", ("c_expl", "c_emb", "c_step"))):
            for name in names:
                table[name] = np.where(table[count] > 0, table[name], np.nan)
    return table


def _draw_epsilon(axes: Axes, table: dict[str, np.ndarray]) -> None:
    _lines(axes, table, "Exploration: who acts", [("epsilon", BLUE)], names={"epsilon": "epsilon, probability that C acts"})
    if table:
        share = running_mean(table["explored_share"], _window(table))
        axes.plot(table["step"], share, ":", color=ORANGE, label="share of actions that C gave (running mean)")
        axes.legend(loc="best", fontsize=9)
    axes.set_ylim(0, 1)


def _draw_rewards(axes: Axes, table: dict[str, np.ndarray], proposals: dict[str, np.ndarray]) -> None:
    if proposals:
        axes.plot(proposals["step"], proposals["mean_reward"], ".", color=GREY, alpha=0.5, label="r of the trajectory")
        axes.plot(proposals["step"], proposals["artificial_total"], ".", color=PURPLE, label="r' of the kept challenge")
    _lines(axes, table, "Mean reward per step", [("reward_memory", RED)], names={"reward_memory": "reward memory"})


def _lines(
    axes: Axes,
    table: dict[str, np.ndarray],
    title: str,
    columns: Sequence[tuple[str, str]],
    log: bool = False,
    names: dict[str, str] | None = None,
) -> None:
    if title:
        axes.set_title(title)
    for name, colour in columns:
        if name in table and np.isfinite(table[name]).any():
            axes.plot(table["step"], table[name], color=colour, label=(names or {}).get(name, name.replace("_", " ")))
    if not axes.lines:
        axes.text(0.5, 0.5, "nothing yet", ha="center", transform=axes.transAxes, color=GREY)
        return
    if log:
        axes.set_yscale("log")
    axes.legend(loc="best", fontsize=9)
