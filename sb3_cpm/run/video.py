"""A video of one episode."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_cpm.files import replacing


def write_video(folder: Path, name: str, frames: Sequence[np.ndarray], fps: int = 10) -> Path:
    """
    Write ``<name>.mp4``, or ``<name>.gif`` where no MP4 can be made (no ffmpeg on this platform).

    :param folder: where to
    :param name: of the file, without its suffix
    :param frames: pictures, each of shape ``(height, width, 3)``, uint8
    :param fps: pictures per second
    :return: the file
    :raises ValueError: when there are no frames
    """
    import imageio.v2 as imageio

    if len(frames) == 0:
        raise ValueError("A video needs at least one frame")
    images = [_even(frame) for frame in frames]
    try:
        path = folder / f"{name}.mp4"
        with replacing(path) as temporary:
            imageio.mimwrite(temporary, images, format="FFMPEG", fps=fps, codec="libx264", quality=8, macro_block_size=2)
    except (ImportError, OSError, RuntimeError, ValueError):
        path = folder / f"{name}.gif"
        with replacing(path) as temporary:
            imageio.mimwrite(temporary, images, format="GIF", duration=1000 / fps, loop=0)
    return path


def _even(frame: np.ndarray) -> np.ndarray:
    """H.264 wants an even number of rows and columns; small pictures are enlarged so that one can see something."""
    frame = np.asarray(frame, dtype=np.uint8)[..., :3]
    factor = max(1, -(-256 // max(frame.shape[0], 1)))
    frame = frame.repeat(factor, axis=0).repeat(factor, axis=1)
    return frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
