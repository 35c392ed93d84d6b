"""One file per challenger: replaced only by a complete one, read without executing anything in it."""

import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

FILE_FORMAT = "sb3_cpm challenger"
FILE_VERSION = 1


def write_file(path: str | os.PathLike, content: Mapping[str, Any]) -> None:
    """
    Write ``content`` beside the file and move it there when it is complete: a crash leaves the old file as it was.

    :param path: of the file; its folder is made if need be
    :param content: tensors and plain data
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = target.with_name(f"{target.name}.{os.getpid()}.tmp")
    try:
        with open(unfinished, "wb") as file:
            torch.save({"format": FILE_FORMAT, "version": FILE_VERSION, **content}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, target)
    finally:
        unfinished.unlink(missing_ok=True)


def read_file(path: str | os.PathLike, device: torch.device) -> dict[str, Any]:
    """
    Content of a saved challenger, checked.

    :raises ValueError: for files that are missing, damaged or something else
    """
    if not Path(path).is_file():
        raise ValueError(f"There is no file {path}.")
    if is_model(path):
        raise ValueError(
            f"{path} is a model that SB3 has saved; the challenger has a file of its own, which ChallengerCallback.save(path) "
            "writes (rl_zoo3 with sb3_cpm.zoo and `sb3-cpm train` write it beside the model)."
        )
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # an unpickler that reads something else fails in any way there is
        raise ValueError(f"{path} is damaged or no saved challenger ({type(error).__name__}: {error}).") from error
    if not isinstance(content, dict) or content.get("format") != FILE_FORMAT:
        raise ValueError(f"{path} is no saved challenger.")
    if content.get("version") != FILE_VERSION:
        raise ValueError(f"{path} has file version {content.get('version')}, this package reads {FILE_VERSION}.")
    return content


def is_model(path: str | os.PathLike) -> bool:
    """Whether a file is a model of SB3. torch's own files are zip archives too, with other members."""
    if not Path(path).is_file() or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return {"data", "policy.pth"} <= set(archive.namelist())


def check_storable(name: str, values: Mapping[str, Any]) -> None:
    """
    :param name: how the user calls them
    :param values: by name
    :raises ValueError: for one that could be written to a file but not read from it, which allows plain types and tensors only
    """
    for key, value in values.items():
        file = io.BytesIO()
        try:
            torch.save(value, file)
            file.seek(0)
            torch.load(file, weights_only=True)
        except Exception as error:  # picklers raise what they like
            raise ValueError(
                f"{name}[{key!r}] is of {type(value)}, which cannot be read from a saved challenger. Give numbers, strings, "
                "tensors (torch.as_tensor(array)), or lists, tuples and dicts of them."
            ) from error


def check_finite(path: str | os.PathLike, name: str, weights: Mapping[str, Any]) -> None:
    """
    :raises RuntimeError: naming the first weight that is not finite: a file with it would only replace a better one
    """
    for key, value in weights.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise RuntimeError(
                f"The challenger is not saved: its weight {name}.{key} is not finite. If {path} exists, it is kept as it was."
            )


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
