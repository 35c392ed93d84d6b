"""
Prediction error in the manner of the intrinsic curiosity module (Pathak et al. 2017, section 2): a transition is new where a
forward model predicts its outcome badly.

It cannot tell "not yet known" from "not knowable": on a noisy television it stays high for ever. It is here for comparison.

As in the paper the error may be measured on features that an inverse model shapes: they have to tell the action from what it
led to, and need not hold what the action cannot change (``features="inverse"``). Two differences. State t enters as the world
model's latent, which remembers what an observation alone does not show; otherwise whatever is hidden would be an error for
ever. And the features learn from the inverse model only: learning also from the forward model (the paper's joint loss)
they can shrink until everything is predictable.

**What it rates in imagination**, where nothing was observed: the world model's dream stands in for the outcome. Its next
latent, or the embedding which that suggests (see :mod:`sb3_cpm.uncertainty.parts`), is what the forward model should have
predicted. The error has two parts then: how random the world model believes the outcome to be, since the dreamt latent is a
sample; and where two models learnt from the same data, this one and the world model, contradict each other, which is an
ensemble of two. So an actor that follows it seeks noise as well, which is what prediction error is known for.
"""

from typing import Any

import torch as th
import torch.nn.functional as F

from sb3_cpm.uncertainty.base import LatentSizes, Transitions
from sb3_cpm.uncertainty.parts import DreamtEmbedding, RunningNorm
from sb3_cpm.uncertainty.scale import ScaledUncertainty, root
from sb3_cpm.world_model.networks import MLP

TARGETS = ("embed", "stoch")
FEATURES = ("raw", "inverse")


class PredictionError(ScaledUncertainty):
    """
    :param sizes: sizes of latents and actions
    :param target: what is predicted of state t+1, "embed" (the encoder's output) or "stoch". The deterministic part is no
        choice: it is computed from latent and action, so that there is nothing in it to be surprised by
    :param features: "raw" takes the standardised target as it is, "inverse" features of it that an inverse model shapes
    :param feature_dim: size of those
    :param layers: hidden layers of forward and inverse model
    :param units: size of each of them
    :param forward_share: beta of the paper, weight of the forward loss beside the inverse one
    :param scale: metric and dynamic scale, see :class:`~sb3_cpm.uncertainty.scale.ScaledUncertainty`
    :raises ValueError: for unknown targets, features and metrics
    """

    def __init__(
        self,
        sizes: LatentSizes,
        target: str = "embed",
        features: str = "raw",
        feature_dim: int = 32,
        layers: int = 2,
        units: int = 400,
        forward_share: float = 0.2,
        **scale: Any,
    ) -> None:
        super().__init__(sizes, **scale)
        if target not in TARGETS:
            raise ValueError(f"`target` must be one of {TARGETS}, got {target!r}.")
        if features not in FEATURES:
            raise ValueError(f"`features` must be one of {FEATURES}, got {features!r}.")
        if not 0.0 < forward_share <= 1.0:
            raise ValueError(f"`forward_share` must lie in (0, 1], got {forward_share}.")
        self.target, self.forward_share = target, forward_share
        size = sizes.embed if target == "embed" else sizes.stoch
        self.dream = DreamtEmbedding(sizes.feat, sizes.embed, units) if target == "embed" else None
        self.norm = RunningNorm(sizes.stoch)
        self.encode = MLP(size, 1, units, feature_dim) if features == "inverse" else None
        output_dim = size if self.encode is None else feature_dim
        self.forward_model = MLP(sizes.feat + sizes.action, layers, units, output_dim)
        self.inverse_model = MLP(sizes.feat + feature_dim, layers, units, sizes.action) if self.encode is not None else None

    def raw(self, transitions: Transitions) -> th.Tensor:
        """Root mean square error over the features, shape ``(*batch,)``."""
        return root((self._predict(transitions) - self._features(transitions)).square().mean(-1))

    def loss(self, transitions: Transitions) -> th.Tensor:
        features = self._features(transitions)
        loss = 0.5 * (self._predict(transitions) - features.detach()).square().sum(-1).mean()
        if self.inverse_model is not None:
            action = self.inverse_model(th.cat((transitions.feat, features), dim=-1))
            inverse = 0.5 * (action - transitions.action).square().sum(-1).mean()
            loss = self.forward_share * loss + (1.0 - self.forward_share) * inverse
        if self.dream is not None:
            assert transitions.next_embed is not None, "only real transitions have an embedding"
            loss = loss + self.dream.loss(transitions.next_feat, self.dream.norm(transitions.next_embed))
        return loss

    def _predict(self, transitions: Transitions) -> th.Tensor:
        return self.forward_model(th.cat((transitions.feat, transitions.action), dim=-1))

    def _features(self, transitions: Transitions) -> th.Tensor:
        """What shall be predicted: of the real outcome or, in imagination, of the dreamt one. Shape ``(*batch, dim)``."""
        if self.dream is not None:
            outcome = self.dream(transitions.next_feat, transitions.next_embed)
        else:
            outcome = self.norm(transitions.next_stoch)
        if self.encode is None:
            return outcome
        features = self.encode(outcome)
        return F.layer_norm(features, features.shape[-1:])  # else their size alone could grow or shrink the error

    @th.no_grad()
    def adapt(self, transitions: Transitions) -> dict[str, th.Tensor]:
        if self.dream is not None:
            assert transitions.next_embed is not None
            self.dream.norm.update(transitions.next_embed)
        else:
            self.norm.update(transitions.next_stoch)
        return super().adapt(transitions)
