"""
Disagreement of dynamics models in observation space (Pathak et al. 2019, section 3): K networks predict the embedding of the
next observation from the embedding of this one and the action. They never see the world model's latent.

Beside Plan2Explore it shows what the latent is good for: a model without memory takes whatever an observation hides for
noise. It averages over that and does not disagree about it, so novelty that depends on the past goes unnoticed; in exchange
its inputs do not change with the world model's memory. Embeddings are standardised with running statistics.

**What it rates in imagination.** A disagreement needs no outcome, only the observation that is left; where nothing was
observed, that is the one which the imagined latent suggests, see :mod:`sb3_cpm.uncertainty.parts`. The actor's gradient comes
through the action at once, and through the latent behind the dreamt embedding.
"""

from typing import Any

import torch as th

from sb3_cpm.uncertainty.base import LatentSizes, Transitions
from sb3_cpm.uncertainty.ensemble import Ensemble, ensemble_loss
from sb3_cpm.uncertainty.parts import DreamtEmbedding
from sb3_cpm.uncertainty.scale import ScaledUncertainty


class ObservationEnsemble(ScaledUncertainty):
    """
    :param sizes: sizes of latents and actions
    :param heads: K
    :param layers: hidden layers of each head
    :param units: size of each of them
    :param scale: metric and dynamic scale, see :class:`~sb3_cpm.uncertainty.scale.ScaledUncertainty`
    :raises ValueError: for unknown metrics, fewer than two heads
    """

    def __init__(self, sizes: LatentSizes, heads: int = 5, layers: int = 2, units: int = 400, **scale: Any) -> None:
        super().__init__(sizes, **scale)
        self.dream = DreamtEmbedding(sizes.feat, sizes.embed, units)
        self.ensemble = Ensemble(heads, sizes.embed + sizes.action, sizes.embed, layers, units)

    def predict(self, transitions: Transitions) -> list[th.Tensor]:
        """Predicted standardised embeddings of all heads, each of shape ``(*batch, embed_dim)``."""
        return self.ensemble.predictions(self._inputs(transitions))

    def raw(self, transitions: Transitions) -> th.Tensor:
        return self.ensemble.disagreement(self._inputs(transitions))

    def _inputs(self, transitions: Transitions) -> th.Tensor:
        return th.cat((self.dream(transitions.feat, transitions.embed), transitions.action), dim=-1)

    def loss(self, transitions: Transitions) -> th.Tensor:
        assert transitions.embed is not None and transitions.next_embed is not None, "only real transitions have embeddings"
        loss = ensemble_loss(self.predict(transitions), self.dream.norm(transitions.next_embed))
        return loss + self.dream.loss(transitions.feat, transitions.embed)

    @th.no_grad()
    def adapt(self, transitions: Transitions) -> dict[str, th.Tensor]:
        assert transitions.next_embed is not None
        self.dream.norm.update(transitions.next_embed)
        return super().adapt(transitions)
