"""
What a saved challenger looks like: one file, whole or not written, checked before it is read, and read without executing
anything in it.
"""

import io
import os
import zipfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_cpm.files import DamagedFileError, first_not_finite, verify, write_sealed
from sb3_cpm.world_model.observations import ObservationSpec

FILE_FORMAT = "sb3_cpm challenger"
#: 2: with a digest. 1, which is read as well, had none.
FILE_VERSION = 2


def write_file(path: str | os.PathLike, content: Mapping[str, Any]) -> None:
    """
    :param path: of the file; its folder is made if need be
    :param content: tensors and plain data
    :raises NotWrittenError: if the disk does not take it; a file that is there already stays as it was
    """
    write_sealed(path, partial(th.save, {"format": FILE_FORMAT, "version": FILE_VERSION, **content}))


def read_file(path: str | os.PathLike, device: th.device) -> dict[str, Any]:
    """
    Content of a saved challenger, checked.

    :raises ValueError: for files that are missing, damaged or something else, and for weights that are not finite
    """
    if not Path(path).is_file():
        raise ValueError(f"There is no file {path}.")
    if is_model(path):
        raise ValueError(
            f"{path} is a model that SB3 has saved; the challenger has a file of its own, which ChallengerCallback.save(path) "
            "writes (rl_zoo3 with sb3_cpm.zoo and `sb3-cpm train` write it beside the model)."
        )
    has_digest = verify(path, "challenger")
    try:
        content = th.load(path, map_location=device, weights_only=True)
    except Exception as error:  # an unpickler that reads something else fails in any way there is
        raise DamagedFileError(f"{path} is damaged or no saved challenger ({type(error).__name__}: {error}).") from error
    if not isinstance(content, dict) or content.get("format") != FILE_FORMAT:
        raise DamagedFileError(f"{path} is no saved challenger.")
    version = content.get("version")
    if version not in (1, FILE_VERSION):
        raise ValueError(f"{path} has file version {version}, this package reads 1 to {FILE_VERSION}.")
    if version == FILE_VERSION and not has_digest:
        raise DamagedFileError(
            f"{path} is damaged or was changed by others: it has no digest of its bytes. Take an earlier one."
        )
    broken = first_not_finite(state_to_check(content["state"]))
    if broken is not None:
        raise DamagedFileError(f"{path} holds a challenger whose weight {broken} is not finite. Take an earlier one.")
    return content


def state_to_check(state: Mapping[str, Any]) -> dict[str, Any]:
    """:return: what must be finite of a challenger's state: weights, and the optimizers' averages of their gradients"""
    return {**state["networks"], "optimizers": state["optimizers"]}


def is_model(path: str | os.PathLike) -> bool:
    """Whether a file is a model of SB3. torch's own files are zip archives too, with other members."""
    if not Path(path).is_file() or not zipfile.is_zipfile(path):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return {"data", "policy.pth"} <= set(archive.namelist())
    except zipfile.BadZipFile:  # damaged, whatever it was
        return False


def check_storable(name: str, values: Mapping[str, Any]) -> None:
    """
    :param name: how the user calls them
    :param values: by name
    :raises ValueError: for one that could be written to a file but not read from it, which allows plain types and tensors only
    """
    for key, value in values.items():
        file = io.BytesIO()
        try:
            th.save(value, file)
            file.seek(0)
            th.load(file, weights_only=True)
        except Exception as error:  # picklers raise what they like
            raise ValueError(
                f"{name}[{key!r}] is of {type(value)}, which cannot be read from a saved challenger. Give numbers, strings, "
                "tensors (torch.as_tensor(array)), or lists, tuples and dicts of them."
            ) from error


def check_sizes(name: str, own: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    """
    :raises ValueError: naming the first weight that is missing, unknown or of another shape
    """
    for key, value in own.items():
        if key not in other:
            raise ValueError(f"The saved challenger has no weight {name}.{key}: it was built with another preset or space.")
        if tuple(other[key].shape) != tuple(value.shape):
            raise ValueError(
                f"The saved challenger has other sizes: {name}.{key} is {tuple(other[key].shape)} there and "
                f"{tuple(value.shape)} here. Build it with the preset and spaces it was saved with, or use Challenger.load."
            )
    for key in other:
        if key not in own:
            raise ValueError(f"The saved challenger has an additional weight {name}.{key}: it was built with another preset.")


def describe_observations(spec: ObservationSpec) -> dict[str, dict[str, Any]]:
    """:return: what is read of the observations, by key, as plain data: files are read without executing anything in them"""
    keys: dict[str, dict[str, Any]] = {
        key: {"shape": list(spec.shapes[key]), "image": key in spec.image_keys} for key in spec.keys
    }
    for key, limits in spec.ranges.items():
        if not spec.is_full_uint8(key):  # what is not written is uint8 from 0 to 255
            keys[key].update(range=list(limits), dtype=spec.dtypes[key])
    return keys


def same_observations(theirs: Mapping[str, Mapping[str, Any]], ours: Mapping[str, Mapping[str, Any]]) -> bool:
    """
    Whether two configurations read the same keys in the same way. Of dtypes only uint8 matters, everything else is read as
    float32: files from before the dtype was written, where it was none, fit as well.
    """

    def comparable(keys: Mapping[str, Mapping[str, Any]]) -> list[tuple[Any, ...]]:
        return [
            (
                key,
                tuple(entry["shape"]),
                entry["image"],
                entry.get("dtype") == "uint8",
                tuple(float(np.float32(limit)) for limit in entry.get("range", ())),
            )
            for key, entry in keys.items()
        ]

    return comparable(theirs) == comparable(ours)


def space_of(entry: Mapping[str, Any]) -> spaces.Box:
    """:return: the space of one key of :func:`describe_observations`"""
    if "range" in entry:
        low, high = entry["range"]
        return spaces.Box(low, high, tuple(entry["shape"]), np.dtype(entry.get("dtype", "float32")).type)
    if entry["image"]:
        return spaces.Box(0, 255, tuple(entry["shape"]), np.uint8)
    return spaces.Box(-np.inf, np.inf, tuple(entry["shape"]), np.float32)


def random_state() -> dict[str, Any]:
    """:return: state of torch's global random generators"""
    cuda = [rng.cpu() for rng in th.cuda.get_rng_state_all()] if th.cuda.is_available() else []
    return {"cpu": th.get_rng_state(), "cuda": cuda}


def restore_random_state(state: Mapping[str, Any]) -> None:
    """:param state: of :func:`random_state`; that of GPUs counts where there are as many of them"""
    th.set_rng_state(state["cpu"].cpu())
    if th.cuda.is_available() and len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all([rng.cpu() for rng in state["cuda"]])
