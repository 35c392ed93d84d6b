"""
Disagreement of dynamics models in observation space (Pathak et al. 2019, section 3): K networks predict the embedding of the
next observation from the embedding of this one and the action. They never see the world model's latent.

What the latent of a world model does not know, because it was never trained on it, it maps to what it knows; an ensemble that
reads latents then hardly tells new states from known ones (docs/world_model.md), and this one does. What a latent is good for
is memory: a model without one takes whatever an observation hides for noise. It averages over that and does not disagree about
it, so novelty that depends on the past goes unnoticed. Embeddings are standardised with running statistics.

**What it rates in imagination.** A disagreement needs no outcome, only the observation that is left; where nothing was
observed, that is the one which the imagined latent suggests, see :mod:`sb3_cpm.uncertainty.parts`. The actor's gradient comes
through the action at once, and through the latent behind the dreamt embedding.
"""

from typing import Any

import torch as th

from sb3_cpm.uncertainty.base import LatentSizes, Transitions
from sb3_cpm.uncertainty.ensemble import Ensemble, EnsembleUncertainty, ensemble_loss
from sb3_cpm.uncertainty.parts import DreamtEmbedding


class ObservationEnsemble(EnsembleUncertainty):
    """
    :param sizes: sizes of latents and actions
    :param heads: K
    :param layers: hidden layers of each head
    :param units: size of each of them
    :param dims: embeddings with more dimensions are projected to so many by a random rotation, which keeps distances; None:
        never. Images have embeddings of thousands, which every head would have to predict
    :param scale: metric and dynamic scale, see :class:`~sb3_cpm.uncertainty.scale.ScaledUncertainty`
    :raises ValueError: for unknown metrics, fewer than two heads
    """

    rotation: th.Tensor | None

    def __init__(
        self, sizes: LatentSizes, heads: int = 5, layers: int = 2, units: int = 400, dims: int | None = None, **scale: Any
    ) -> None:
        super().__init__(sizes, **scale)
        projected = dims is not None and dims < sizes.embed
        embed = dims if projected else sizes.embed
        assert embed is not None
        rotation = th.linalg.qr(th.randn(sizes.embed, embed))[0] if projected else None
        self.register_buffer("rotation", rotation)  # (sizes.embed, dims), orthonormal columns
        self.dream = DreamtEmbedding(sizes.feat, embed, units)
        self.ensemble = Ensemble(heads, embed + sizes.action, embed, layers, units)

    def inputs(self, transitions: Transitions) -> th.Tensor:
        embed = None if transitions.embed is None else self._projected(transitions.embed)
        return th.cat((self.dream(transitions.feat, embed), transitions.action), dim=-1)

    def _projected(self, embed: th.Tensor) -> th.Tensor:
        """
        :param embed: shape ``(*batch, sizes.embed)``
        :return: shape ``(*batch, dims)``
        """
        return embed if self.rotation is None else embed @ self.rotation

    def loss(self, transitions: Transitions) -> th.Tensor:
        assert transitions.embed is not None and transitions.next_embed is not None, "only real transitions have embeddings"
        embed, targets = (self.dream.norm(self._projected(one)) for one in (transitions.embed, transitions.next_embed))
        predictions = self.ensemble.predictions(th.cat((embed, transitions.action), dim=-1))
        self.remember(transitions, predictions)
        return ensemble_loss(predictions, targets) + self.dream.loss(transitions.feat, embed)

    @th.no_grad()
    def adapt(self, transitions: Transitions) -> dict[str, th.Tensor]:
        assert transitions.next_embed is not None
        self.dream.norm.update(self._projected(transitions.next_embed))
        return super().adapt(transitions)
