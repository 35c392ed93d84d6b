"""
Plan2Explore (Sekar et al. 2020, section 3; report, B.2): disagreement of an ensemble that predicts the next latent.

All K heads see the same transitions and converge to the same mean where data are plentiful, however noisy the transitions
are; where data are scarce they still say what their different initial weights say.
"""

from typing import Any

import torch as th

from sb3_cpm.uncertainty.base import LatentSizes, Transitions
from sb3_cpm.uncertainty.ensemble import Ensemble, EnsembleUncertainty, ensemble_loss
from sb3_cpm.uncertainty.scale import ExpScale

__all__ = ["TARGETS", "Ensemble", "ExpScale", "LatentDisagreement"]

TARGETS = ("feat", "stoch", "deter", "embed")


class LatentDisagreement(EnsembleUncertainty):
    """
    In imagination it computes exactly what it computes on real transitions: a disagreement needs no outcome.

    :param sizes: sizes of latents and actions
    :param heads: K; the report gives no number
    :param layers: hidden layers of each head
    :param units: size of each of them
    :param target: what the heads predict of state t+1: "feat" (the whole latent, the report's choice), "stoch", "deter" or
        "embed" (the paper's choice)
    :param scale: metric and dynamic scale, see :class:`~sb3_cpm.uncertainty.scale.ScaledUncertainty`
    :raises ValueError: for unknown targets and metrics, fewer than two heads
    """

    def __init__(
        self,
        sizes: LatentSizes,
        heads: int = 10,
        layers: int = 4,
        units: int = 400,
        target: str = "feat",
        **scale: Any,
    ) -> None:
        super().__init__(sizes, **scale)
        if target not in TARGETS:
            raise ValueError(f"`target` must be one of {TARGETS}, got {target!r}.")
        self.target = target
        output_dim = {"feat": sizes.feat, "stoch": sizes.stoch, "deter": sizes.deter, "embed": sizes.embed}[target]
        self.ensemble = Ensemble(heads, sizes.feat + sizes.action, output_dim, layers, units, sizes.one_hot)

    def inputs(self, transitions: Transitions) -> th.Tensor:
        return th.cat((transitions.feat, transitions.action), dim=-1)

    def loss(self, transitions: Transitions) -> th.Tensor:
        predictions = self.predict(transitions)
        self.remember(transitions, predictions)
        return ensemble_loss(predictions, self.targets(transitions))

    def targets(self, transitions: Transitions) -> th.Tensor:
        """What the heads shall predict, shape ``(*batch, target_dim)``."""
        if self.target == "feat":
            return transitions.next_feat
        if self.target == "embed":
            assert transitions.next_embed is not None, "only real transitions have an embedding"
            return transitions.next_embed
        return transitions.next_stoch if self.target == "stoch" else transitions.next_deter
