"""Which measures of novelty there are, and who is meant by a name, a class and a preset."""

from collections.abc import Mapping
from typing import Any

from sb3_cpm.arguments import check_arguments, check_names, nearest
from sb3_cpm.presets import Preset, plain
from sb3_cpm.uncertainty.base import Uncertainty
from sb3_cpm.uncertainty.latent_disagreement import LatentDisagreement
from sb3_cpm.uncertainty.observation_ensemble import ObservationEnsemble
from sb3_cpm.uncertainty.prediction_error import PredictionError
from sb3_cpm.uncertainty.rnd import RandomNetworkDistillation

UNCERTAINTY_CLASSES: dict[str, type[Uncertainty]] = {
    "plan2explore": LatentDisagreement,
    "rnd": RandomNetworkDistillation,
    "prediction_error": PredictionError,
    "observation_ensemble": ObservationEnsemble,
}


def check_uncertainties(preset: Preset) -> None:
    """
    :param preset: has arguments of them
    :raises ValueError: for classes and arguments in its entry 'uncertainty' that there are not, with the nearest
    """
    where = "Preset entry 'uncertainty'"
    # a class of one's own has its module in its name, and may take its arguments in any way
    known = {name: arguments for name, arguments in preset.uncertainty.items() if "." not in name}
    check_names(where, known, UNCERTAINTY_CLASSES)
    for name, arguments in known.items():
        check_arguments(f"{where}, {name}", arguments, UNCERTAINTY_CLASSES[name], excluded=("sizes",))


def choose_uncertainty(
    kind: str | type[Uncertainty] | None, kwargs: Mapping[str, Any] | None, preset: Preset
) -> tuple[str, type[Uncertainty], dict[str, Any]]:
    """
    :param kind: ``uncertainty_class`` of :class:`~sb3_cpm.challenger.Challenger`; None: the preset's
    :param kwargs: ``uncertainty_kwargs``
    :param preset: has arguments of them
    :return: its name in checkpoints, the class, and its arguments: the preset's with ``kwargs`` on top
    :raises ValueError: for names that there are not, with the nearest, also of arguments in the preset
    """
    check_uncertainties(preset)
    kind = preset.uncertainty_class if kind is None else kind
    if isinstance(kind, str):
        if kind not in UNCERTAINTY_CLASSES:
            raise ValueError(
                f"Unknown uncertainty class {kind!r}.{nearest(kind, UNCERTAINTY_CLASSES)} Valid: "
                f"{sorted(UNCERTAINTY_CLASSES)} or a class."
            )
        check_arguments("uncertainty_kwargs", kwargs, UNCERTAINTY_CLASSES[kind], excluded=("sizes",))
        return kind, UNCERTAINTY_CLASSES[kind], plain({**preset.uncertainty.get(kind, {}), **(kwargs or {})})
    if not (isinstance(kind, type) and issubclass(kind, Uncertainty)):
        raise ValueError(f"`uncertainty_class` must be a name or a subclass of Uncertainty, got {kind!r}.")
    return f"{kind.__module__}.{kind.__qualname__}", kind, plain(dict(kwargs or {}))
