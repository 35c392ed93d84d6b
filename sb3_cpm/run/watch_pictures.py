"""
Pictures of dreams: film strips, animations, and how the world model learnt.

In all of them blue marks states that the model has seen before it draws them, orange those that it imagines.
"""

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from PIL import Image, ImageDraw, ImageFont

from sb3_cpm.run.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, STYLE, running_mean, save_figure

if TYPE_CHECKING:
    from sb3_cpm.run.watch import Dream

Drawer = Callable[[Axes, "Dream"], None]
N_COLUMNS = 16  # frames of a strip
WIDTH, LEFT, INNER = 14.0, 1.0, 11.6  # of a figure, left of its axes, and of them, inches
CURVE, SPACE = 1.15, 0.58  # height of a curve and of what stands above it, inches
HEADER = 0.42  # height of what stands above a strip, in frames
N_COMPONENTS = 4  # of a vector that are drawn
FULL_ERROR = 0.5  # an error of half the range is drawn in the brightest colour
COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, GREY)
ROWS = ("truth", "model", "error")
GAP = 0.06  # between frames of a strip, in frames
PANEL = 192  # pixels per frame of an animation, at least
MILLISECONDS = 180  # per frame of an animation
EXPLANATION = (
    "Blue: the model saw these states before drawing them. Orange: imagined, knowing only the actions. "
    "Error: black is none, bright half the range or more."
)


# ---------------------------------------------------------------------- film strip with curves


def draw_strip(path: Path, dream: "Dream", title: str) -> None:
    """
    One episode as a film strip per camera (truth, model, error), and below on the same time axis: errors beside those of
    standing still, components of the vectors, rewards, and the challenger's opinion.

    :param path: the PNG to write
    :param dream: the episode
    :param title: what this is
    """
    rows = len(dream.drawn_rewards) + 1
    columns = np.unique(np.linspace(0, rows - 1, min(rows, N_COLUMNS)).round().astype(int))
    frame = INNER / len(columns)
    heights = [(3 * _aspect(dream.truth[key]) + HEADER) * frame for key in dream.images]
    curves = [
        *([_error_drawer(dream.images, "images, in [0, 1]")] if dream.images else []),
        *([_error_drawer(dream.vectors, "vectors")] if dream.vectors else []),
        *[_vector_drawer(key) for key in dream.vectors],
        _draw_rewards,
        _draw_opinion,
    ]
    total = 1.0 + sum(heights) + len(curves) * (CURVE + SPACE) + 0.2 * len(heights) + 0.2
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(WIDTH, total))
        figure.text(0.01, 1 - 0.12 / total, title, ha="left", va="top", fontweight="bold", fontsize=13)
        figure.text(0.01, 1 - 0.42 / total, EXPLANATION, ha="left", va="top", fontsize=9.5, color=GREY)
        below = 0.75
        for key, height in zip(dream.images, heights, strict=True):
            below += height + 0.2
            _draw_frames(figure.add_axes(_box(below, height, total)), dream, key, columns)
        half = (rows - 1) / max(len(columns) - 1, 1) / 2
        for draw in curves:
            below += CURVE + SPACE
            axis = figure.add_axes(_box(below, CURVE, total))
            draw(axis, dream)
            axis.set_xlim(-half, rows - 1 + half)  # state t stands below its frame
            axis.axvspan(-half, dream.context - 0.5, color=BLUE, alpha=0.07, lw=0)
        axis.set_xlabel("step of the episode")
        save_figure(figure, path)


def _box(bottom: float, height: float, total: float) -> tuple[float, float, float, float]:
    """An axis whose lower edge is so many inches below the top of the figure."""
    return LEFT / WIDTH, 1 - bottom / total, INNER / WIDTH, height / total


def _aspect(images: np.ndarray) -> float:
    return images.shape[1] / images.shape[2]


def _draw_frames(axis: Axes, dream: "Dream", key: str, columns: np.ndarray) -> None:
    truth, model = dream.truth[key], dream.model[key]
    aspect = _aspect(truth)
    for place, row in enumerate(columns):
        shown = (_rgb(truth[row]), _rgb(model[row]), _error_rgb(truth[row], model[row]))
        for line, picture in enumerate(shown):
            top = -line * aspect
            extent = (place + GAP / 2, place + 1 - GAP / 2, top - aspect + GAP / 2, top - GAP / 2)
            axis.imshow(picture, extent=extent, interpolation="nearest")
        seen = row < dream.context
        axis.plot([place + GAP, place + 1 - GAP], [0.06, 0.06], color=BLUE if seen else ORANGE, lw=4, solid_capstyle="butt")
        axis.text(place + 0.5, 0.13, f"t={row}", ha="center", va="bottom", fontsize=8, color=GREY)
    for line, name in enumerate(ROWS):
        axis.text(-0.1, -(line + 0.5) * aspect, name, ha="right", va="center", fontsize=10)
    at_the_edge = axis.get_yaxis_transform()  # so that long names have room
    axis.text(-0.9 * LEFT / INNER, 0.2, key, ha="left", va="center", fontsize=9, fontweight="bold", transform=at_the_edge)
    axis.set(xlim=(0, len(columns)), ylim=(-3 * aspect, HEADER), aspect="auto")
    axis.axis("off")


def _rgb(image: np.ndarray) -> np.ndarray:
    """Three channels in [0, 1]; grey from one, the first three of more."""
    shown = np.clip(image, 0.0, 1.0)
    return shown[..., :3] if shown.shape[-1] >= 3 else shown[..., :1].repeat(3, axis=-1)


def _error_rgb(truth: np.ndarray, model: np.ndarray) -> np.ndarray:
    error = np.abs(truth - model).mean(-1) / FULL_ERROR
    return mpl.colormaps["inferno"](np.clip(error, 0.0, 1.0))[..., :3]


def _error_drawer(keys: list[str], what: str) -> Drawer:
    def draw(axis: Axes, dream: "Dream") -> None:
        axis.set_title(f"mean absolute error of {what}: the model, and standing still (dotted)")
        for colour, key in zip(COLOURS, keys, strict=False):
            axis.plot(dream.errors(key), color=colour, label=key)
            still = dream.errors_of_standing_still(key)
            axis.plot(np.arange(dream.context - 1, len(still)), still[dream.context - 1 :], ":", color=colour, lw=1.4)
        axis.set_ylim(bottom=0)
        _legend_beside(axis)

    return draw


def _vector_drawer(key: str) -> Drawer:
    def draw(axis: Axes, dream: "Dream") -> None:
        truth, model = dream.truth[key], dream.model[key]
        moving = np.sort(np.argsort(truth.std(0))[::-1][:N_COMPONENTS])
        axis.set_title(f"{key}: truth, and model (dashed); the {len(moving)} of {truth.shape[1]} components that move most")
        for colour, component in zip(COLOURS, moving, strict=False):
            axis.plot(truth[:, component], color=colour, label=f"{key}[{component}]")
            axis.plot(model[:, component], "--", color=colour, lw=1.4)
        _legend_beside(axis)

    return draw


def _draw_rewards(axis: Axes, dream: "Dream") -> None:
    axis.set_title("reward for arriving in a state: truth, and model (dashed)")
    steps = np.arange(1, len(dream.rewards) + 1)
    axis.plot(steps, dream.rewards, color=GREEN, label="reward")
    axis.plot(steps, dream.drawn_rewards, "--", color=GREEN, lw=1.4, label="model")
    _legend_beside(axis)


def _draw_opinion(axis: Axes, dream: "Dream") -> None:
    axis.set_title("what the challenger says to each step, having seen it: KL in nats (left), novelty (right)")
    steps = np.arange(1, len(dream.opinion.kl) + 1)
    axis.plot(steps, dream.opinion.kl, color=PURPLE, label="KL")
    axis.set_ylim(bottom=0)
    right = axis.twinx()
    right.plot(steps, dream.opinion.disagreement, color=ORANGE)
    right.set_ylim(bottom=0)
    right.grid(visible=False)
    axis.plot([], [], color=ORANGE, label="novelty")
    _legend_beside(axis, 1.04)


def _legend_beside(axis: Axes, x: float = 1.0) -> None:
    axis.legend(loc="upper left", bbox_to_anchor=(x, 1.05), fontsize=8, handlelength=1.2, borderaxespad=0.3)


# ---------------------------------------------------------------------- animation


def animation(dream: "Dream") -> bytes:
    """
    Truth, model and error side by side, one row per camera, as an animated GIF.

    :param dream: an episode with images
    :return: the file's content
    """
    frames = [_frame(dream, row) for row in range(len(dream.truth[dream.images[0]]))]
    file = io.BytesIO()
    pauses = [MILLISECONDS] * (len(frames) - 1) + [8 * MILLISECONDS]  # a moment at the end
    frames[0].save(file, format="GIF", save_all=True, append_images=frames[1:], duration=pauses, loop=0)
    return file.getvalue()


def _frame(dream: "Dream", row: int) -> Image.Image:
    height, width = dream.truth[dream.images[0]].shape[1:3]
    factor = max(1, -(-PANEL // width))
    panel, gap, line_height = (width * factor, height * factor), 8, 20
    block = line_height + panel[1]  # names of the panels, and the panels
    size = (3 * panel[0] + 4 * gap, 2 * gap + line_height + len(dream.images) * block + 14)
    canvas = Image.new("RGB", size, "white")
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=14)
    seen = row < dream.context
    words = "the model sees this state" if seen else f"imagined, {row - dream.context + 1} steps without looking"
    draw.text((gap, 4), f"t = {row}: {words}", fill=BLUE if seen else ORANGE, font=font)
    for line, key in enumerate(dream.images):
        truth, model = dream.truth[key][row], dream.model[key][row]
        top = gap + line_height + line * block
        for column, picture in enumerate((_rgb(truth), _rgb(model), _error_rgb(truth, model))):
            left = gap + column * (panel[0] + gap)
            draw.text((left, top), f"{key}: {ROWS[column]}" if column == 0 else ROWS[column], fill="black", font=font)
            pixels = Image.fromarray((picture * 255).round().astype(np.uint8))
            canvas.paste(pixels.resize(panel, Image.Resampling.NEAREST), (left, top + line_height))
    _draw_progress(draw, dream, row, (gap, size[1] - 12, size[0] - gap, size[1] - 6))
    return canvas.quantize(256, dither=Image.Dither.NONE)


def _draw_progress(draw: ImageDraw.ImageDraw, dream: "Dream", row: int, box: tuple[int, int, int, int]) -> None:
    """How far the episode is, the seen part in blue and the imagined in orange."""
    left, top, right, bottom = box
    rows = len(dream.drawn_rewards) + 1

    def place(state: int) -> int:
        return left + round((right - left) * state / rows)

    draw.rectangle(box, fill="#e2e8f0")
    draw.rectangle((left, top, place(min(row + 1, dream.context)), bottom), fill=BLUE)
    if row >= dream.context:
        draw.rectangle((place(dream.context), top, place(row + 1), bottom), fill=ORANGE)


# ---------------------------------------------------------------------- how it learnt


def draw_training(path: Path, diagnostics: Mapping[str, tuple[np.ndarray, np.ndarray]], title: str) -> None:
    """
    Reconstruction error per key, KL, ensemble spread and its scale, over the run.

    :param path: the PNG to write
    :param diagnostics: steps and values of what was logged, by name
    :param title: what was trained
    """
    prefix = "challenger/"
    known = {name.removeprefix(prefix): logged for name, logged in diagnostics.items() if name.startswith(prefix)}
    errors = [name for name in known if name.startswith("error_")] or [name for name in known if name == "pixel_error"]
    losses: list[str] = [name for name in ("image_loss", "vector_loss", "reward_loss", "continue_loss") if name in known]
    panels: list[tuple[str, list[str], bool]] = [
        ("mean absolute error of reconstructions, per key (images: scale of [-0.5, 0.5])", errors, False),
        ("KL of posterior and prior, nats", ["kl"], False),
        ("losses", losses, True),
        ("ensemble spread before scaling, and its scale k", ["raw_disagreement", "exp_scale"], True),
    ]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(2, 2, figsize=(WIDTH, 7.5), sharex=True, layout="constrained")
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=13)
        for axis, (name, columns, log) in zip(axes.flat, panels, strict=True):
            _draw_columns(axis, {column: known[column] for column in columns if column in known}, log)
            axis.set_title(name)
        for axis in axes[-1]:
            axis.set_xlabel("environment steps")
        save_figure(figure, path)


def _draw_columns(axis: Axes, columns: dict[str, tuple[np.ndarray, np.ndarray]], log: bool) -> None:
    for colour, (name, (steps, values)) in zip(COLOURS, columns.items(), strict=False):
        told = np.isfinite(values)
        axis.plot(steps[told], values[told], color=colour, alpha=0.3, lw=1)
        mean = running_mean(values[told], max(1, int(told.sum()) // 20))
        axis.plot(steps[told], mean, color=colour, label=name.removeprefix("error_").replace("_", " "))
    if not axis.lines:
        axis.text(0.5, 0.5, "nothing was logged", ha="center", transform=axis.transAxes, color=GREY)
        return
    if log:
        axis.set_yscale("log")
    else:
        axis.set_ylim(bottom=0)
    axis.legend(loc="best", fontsize=9)
