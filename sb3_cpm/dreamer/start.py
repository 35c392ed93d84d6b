"""Where a model may start from: what another one, or a challenger beside a player, has learnt already."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch as th
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_cpm.challenger import Challenger
from sb3_cpm.challenger.file import is_model
from sb3_cpm.files import verify
from sb3_cpm.presets import Preset
from sb3_cpm.uncertainty import UNCERTAINTY_CLASSES


class HasChallenger(Protocol):
    """A Dreamer, a Plan2Explore or a ChallengerCallback."""

    @property
    def challenger(self) -> Challenger | None: ...


StartFrom = str | os.PathLike | Challenger | HasChallenger


def read_challenger(source: StartFrom, device: th.device) -> Challenger:
    """
    :param source: a model saved by :class:`~sb3_cpm.dreamer.Plan2Explore` or :class:`~sb3_cpm.dreamer.Dreamer`, a challenger
        saved by ``ChallengerCallback.save`` or ``Challenger.save``, or one of these objects
    :param device: PyTorch device
    :raises ValueError: for anything else, and for damaged files
    """
    if isinstance(source, Challenger):
        return source
    if not isinstance(source, (str, os.PathLike)):
        challenger = getattr(source, "challenger", None)
        if not isinstance(challenger, Challenger):
            raise ValueError(
                f"`start_from` must be a file, a Dreamer, a Plan2Explore or a Challenger, got {source!r}"
                + (", which has no challenger yet." if hasattr(source, "challenger") else ".")
            )
        return challenger
    path = model_file(source)
    return _from_model(path, device) if is_model(path) else Challenger.load(path, device)


def model_file(path: str | os.PathLike) -> Path:
    """:return: the file that SB3 means by a path, which may lack its ``.zip``"""
    given = Path(path)
    zipped = given.with_name(f"{given.name}.zip")
    return zipped if not given.exists() and zipped.exists() else given


def take_over_uncertainty(source: Challenger | None, preset: Preset, given: Mapping[str, Any]) -> dict[str, Any]:
    """
    Uncertainty class and arguments: those of the one to start from, but for what is given.

    :param source: the one to start from
    :param preset: of the new one
    :param given: may have "uncertainty_class" and "uncertainty_kwargs", None where the user gave none
    :return: the same two entries, to build the new one with
    """
    kind, kwargs = given.get("uncertainty_class"), given.get("uncertainty_kwargs")
    if source is None or not source.explores:
        return {"uncertainty_class": kind or "plan2explore", "uncertainty_kwargs": kwargs}
    name = source.uncertainty_name
    theirs: str | type = name if name in UNCERTAINTY_CLASSES else type(source.uncertainty)
    if kind not in (None, theirs):
        return {"uncertainty_class": kind, "uncertainty_kwargs": kwargs}
    # what the source was built with has its preset's arguments in it already; those of another preset are newer
    changed = preset.uncertainty.get(name, {}) if preset.uncertainty != source.preset.uncertainty else {}
    return {"uncertainty_class": theirs, "uncertainty_kwargs": {**source.uncertainty_kwargs, **changed, **(kwargs or {})}}


def _from_model(path: Path, device: th.device) -> Challenger:
    verify(path, "model")
    data, params, _ = load_from_zip_file(path, device=device)
    if data is None or "behavior" not in data.get("policy_kwargs", {}):
        raise ValueError(f"{path} is a model of another algorithm: `start_from` takes those of Dreamer and Plan2Explore.")
    arguments: dict[str, Any] = {**data["policy_kwargs"], "device": device}
    policy = data["policy_class"](data["observation_space"], data["action_space"], **arguments)
    for name, state in params.items():
        owner = policy if name == "policy" else getattr(policy, name.removeprefix("policy."))
        owner.load_state_dict(state)
    return policy.challenger
