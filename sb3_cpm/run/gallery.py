"""
The challenge gallery: for several trajectories what the cameras saw, what the challenger thought of it, and the verdict.

Film strip and curves share their time axis: frame ``t`` is the state *in* which transition ``t`` starts, so the goal of a
challenge with index g is the state after transition g, drawn at g + 1.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpecFromSubplotSpec, SubplotSpec
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from sb3_cpm.challenges import Proposal
from sb3_cpm.run.plots import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, RED, STYLE, save_figure
from sb3_cpm.run.recorder import Shot

CRITERION_NAMES = {
    "novel": "F1 novel enough",
    "relevant": "F2 relevant to the task",
    "highlight": "F3 a highlight",
    "sane": "F4 sane",
    "not_first": "F5 not the first",
}
#: Frames of a film strip.
N_FRAMES = 12
FIGURE_WIDTH = 13.0
EXPLANATION = (
    "Each row is one trajectory: camera frames along the time axis; below them what the challenger thought of every step. "
    "The goal is the state with the highest score.\nShaded: the part up to the goal. The filter keeps it as a challenge if at "
    "least two of F1 to F3 hold, and F4 and F5; then r' replaces its rewards r."
)
CURVES_HEIGHT = 1.9
#: Part of the figure's width that film strip and curves have; the verdict has the rest.
STRIP_SHARE = 0.74
#: Where the text of the verdict starts within its part.
LEFT = 0.2
SIDE_TEXT: dict[str, Any] = {"ha": "right", "va": "center", "fontsize": 8, "color": "#4a5568"}


def challenge_gallery(path: Path, shots: Sequence[Shot], title: str) -> None:
    """
    Draw the gallery.

    :param path: the PNG to write
    :param shots: proposals with their frames
    :param title: what was trained
    """
    with plt.rc_context({**STYLE, "axes.grid": False}):
        if not shots:
            save_figure(_nothing_yet(title), path)
            return
        strip_height = FIGURE_WIDTH * STRIP_SHARE / N_FRAMES * max(1, max(len(shot.frames) for shot in shots))
        row_height = strip_height + CURVES_HEIGHT + 0.75
        height = row_height * len(shots) + 1.55
        figure = plt.figure(figsize=(FIGURE_WIDTH, height))
        figure.suptitle(title, fontweight="bold", fontsize=13, x=0.03, ha="left", y=1 - 0.2 / height, va="top")
        figure.text(0.03, 1 - 0.52 / height, EXPLANATION, fontsize=9.5, color="#4a5568", va="top", linespacing=1.4)
        figure.legend(handles=_legend(), loc="upper left", bbox_to_anchor=(0.022, 1 - 0.93 / height), ncols=7, fontsize=9.5)
        rows = figure.add_gridspec(
            len(shots),
            1,
            hspace=0.75 / (row_height - 0.75),
            left=0.055,
            right=0.99,
            top=1 - 1.55 / height,
            bottom=0.5 / height,
        )
        for row, shot in enumerate(shots):
            _draw_shot(figure, rows[row], shot, strip_height)
        save_figure(figure, path)


def _legend() -> list[Artist]:
    """One legend for all rows."""
    return [
        Line2D([], [], color=BLUE, label="c r"),
        Line2D([], [], color=ORANGE, label="u"),
        Line2D([], [], color=BLACK, lw=2.2, label="score S = c r + u"),
        Line2D([], [], color=ORANGE, mec=BLACK, marker="*", ms=13, ls="", label="goal"),
        Line2D([], [], color=BLUE, lw=1, ls=":", label="r (right axis)"),
        Line2D([], [], color=PURPLE, lw=2, ls="--", label="r' (right axis)"),
        Patch(facecolor="none", edgecolor="#cbd5e0", hatch="///", label="warm-up, never counts"),
    ]


def _nothing_yet(title: str) -> Figure:
    figure, axes = plt.subplots(figsize=(FIGURE_WIDTH, 2.5))
    axes.axis("off")
    axes.set_title(title)
    text = "No challenge was proposed: the challenger proposes from the first episode after its first update."
    axes.text(0.5, 0.5, text, ha="center", va="center", color=GREY, fontsize=11)
    return figure


def _draw_shot(figure: Figure, place: SubplotSpec, shot: Shot, strip_height: float) -> None:
    grid = GridSpecFromSubplotSpec(
        2,
        2,
        place,
        width_ratios=[STRIP_SHARE, 1 - STRIP_SHARE],
        height_ratios=[strip_height, CURVES_HEIGHT],
        hspace=0.06,
        wspace=0.03,
    )
    strip, curves = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    verdict = figure.add_subplot(grid[:, 1])
    strip.set_title(
        f"Challenge {shot.number}, proposed at step {shot.step}"
        if shot.proposal.accepted
        else f"Candidate {shot.number}, at step {shot.step}: dropped",
        color=GREEN if shot.proposal.accepted else RED,
        pad=4,
    )
    _draw_strip(strip, shot)
    _draw_curves(curves, shot.proposal)
    _draw_verdict(verdict, shot.proposal)


def _draw_strip(axes: Axes, shot: Shot) -> None:
    """Cameras below each other, frames side by side; the frame of the goal has a frame of its own colour."""
    proposal = shot.proposal
    n_steps = len(proposal.rewards)
    axes.set_xlim(0, n_steps)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_frame_on(False)
    if not shot.frames:
        axes.text(0.5, 0.5, "no cameras", ha="center", va="center", transform=axes.transAxes, color=GREY)
        return
    axes.set_ylim(len(shot.frames), 0)
    width = n_steps / N_FRAMES
    for column in range(N_FRAMES):
        left = column * width
        state = round(left + width / 2)
        holds_goal = left <= proposal.goal + 1 < left + width or (column == N_FRAMES - 1 and proposal.goal + 1 >= n_steps)
        if holds_goal:
            state = proposal.goal + 1
        for row, frames in enumerate(shot.frames.values()):
            extent = (left + 0.03 * width, left + 0.97 * width, row + 0.97, row + 0.03)
            after_cut = left > proposal.goal + 1
            axes.imshow(
                _rgb(frames[state]), extent=extent, aspect="auto", interpolation="nearest", alpha=0.35 if after_cut else 1
            )
        if holds_goal:
            frame = Rectangle((left, 0), width, len(shot.frames), fill=False, ec=ORANGE, lw=3, clip_on=False, zorder=5)
            axes.add_patch(frame)
    for row, key in enumerate(shot.frames):
        axes.text(-0.006, 1 - (row + 0.5) / len(shot.frames), key.replace("_", "\n"), transform=axes.transAxes, **SIDE_TEXT)
    axes.set_xlim(0, n_steps)
    axes.set_ylim(len(shot.frames), 0)


def _rgb(frame: np.ndarray) -> np.ndarray:
    """Three colours, whatever the number of channels."""
    return frame[..., :3] if frame.shape[-1] >= 3 else np.repeat(frame[..., :1], 3, axis=-1)


def _draw_curves(axes: Axes, proposal: Proposal) -> None:
    n_steps = len(proposal.rewards)
    arrival = np.arange(1, n_steps + 1)  # transition t is about arriving in state t + 1
    first, goal = proposal.first, proposal.goal
    scaled_rewards = proposal.score - proposal.uncertainty  # c r, r measured from its origin
    axes.axvspan(first, goal + 1, color=GREEN if proposal.accepted else RED, alpha=0.10, lw=0)
    axes.axvspan(0, first, facecolor="none", edgecolor="#cbd5e0", hatch="///", lw=0)
    axes.plot(arrival, scaled_rewards, color=BLUE)
    axes.plot(arrival, proposal.uncertainty, color=ORANGE)
    axes.plot(arrival, proposal.score, color=BLACK, lw=2.2)
    axes.plot(goal + 1, proposal.score[goal], "*", color=ORANGE, mec=BLACK, ms=16, zorder=6, clip_on=False)
    # what the warm-up says is meaningless and often huge: the scale is that of what counts
    shown = np.concatenate([curve[first:] for curve in (proposal.score, proposal.uncertainty, scaled_rewards)])
    low, high = min(0.0, float(shown.min())), float(shown.max())
    axes.set_ylim(low, high + 0.12 * max(high - low, 1e-9))
    axes.set_xlim(0, n_steps)
    axes.set_ylabel("score")
    axes.set_xlabel("step of the episode", labelpad=1)
    axes.grid(axis="y")
    if proposal.artificial is not None:
        _draw_artificial(axes.twinx(), arrival, proposal.rewards, arrival[first : goal + 1], proposal.artificial.total)


def _draw_artificial(axes: Axes, steps: np.ndarray, rewards: np.ndarray, kept: np.ndarray, artificial: np.ndarray) -> None:
    axes.plot(steps, rewards, color=BLUE, lw=1, ls=":")
    axes.plot(kept, artificial, color=PURPLE, lw=2, ls="--")
    axes.spines["right"].set_visible(True)
    axes.set_ylabel("reward", color=PURPLE)
    axes.tick_params(axis="y", colors=PURPLE)
    axes.margins(y=0.15)


def _draw_verdict(axes: Axes, proposal: Proposal) -> None:
    axes.axis("off")
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    word, colour = ("KEPT", GREEN) if proposal.accepted else ("DROPPED", RED)
    axes.text(
        0.14, 0.97, word, color="white", fontsize=13, fontweight="bold", va="top", bbox={"fc": colour, "ec": colour, "pad": 4}
    )
    for row, (name, text) in enumerate(CRITERION_NAMES.items()):
        y = 0.78 - 0.095 * row
        holds = proposal.verdicts[name]
        axes.text(
            0.14, y, "yes" if holds else "no", color=GREEN if holds else RED, fontweight="bold", fontsize=10, va="center"
        )
        axes.text(0.29, y, text, fontsize=10, va="center", color=BLACK if holds else GREY)
    axes.text(LEFT, 0.27, _numbers(proposal), fontsize=9, va="top", color="#4a5568", linespacing=1.5)


def _numbers(proposal: Proposal) -> str:
    counted = slice(proposal.first, None)
    lines = [
        f"mean r {proposal.rewards[counted].mean():.3f}   memory {proposal.coefficients['reward_memory']:.3f}",
        f"mean u {proposal.uncertainty[counted].mean():.3f}   S at goal {proposal.score[proposal.goal]:.2f}",
    ]
    if proposal.artificial is not None:
        lines.append(f"steps {proposal.first} to {proposal.goal} kept   mean r' {proposal.artificial.total.mean():.3f}")
    return "\n".join(lines)
