"""``python -m sb3_cpm export``: the player of a run as an ONNX graph."""

import pickle
from pathlib import Path
from typing import Any

from sb3_cpm.agents.algorithms import algorithms
from sb3_cpm.export import export_onnx
from sb3_cpm.run.folder import CONFIG, NORMALIZATION, read_yaml


def export_run(folder: str | Path, path: str | Path | None = None) -> tuple[Path, dict[str, tuple[int, ...]]]:
    """
    The player of a run that ``python -m sb3_cpm train`` has left.

    :param folder: of the run
    :param path: of the file to write; None: ``player.onnx`` in the folder
    :return: the file, and its inputs with the shape of one observation
    :raises ValueError: for a folder that holds no trained player
    """
    folder = Path(folder)
    for needed in (CONFIG, "model.zip"):
        if not (folder / needed).is_file():
            raise ValueError(f"{folder} holds no player that was trained: there is no {needed}. Expected the folder of a run.")
    algorithm = algorithms()[read_yaml(folder / CONFIG)["protocol"]["algo"]]
    without_buffer: dict[str, Any] = {
        "replay_buffer_class": None,
        "replay_buffer_kwargs": {},
    }  # which would want an environment
    model = algorithm.load(folder / "model.zip", device="cpu", custom_objects=without_buffer)
    normalize = None
    if (folder / NORMALIZATION).is_file():
        with (folder / NORMALIZATION).open("rb") as file:
            normalize = pickle.load(file)  # as VecNormalize.load does
    path = folder / "player.onnx" if path is None else Path(path)
    return path, export_onnx(model, path, normalize)
