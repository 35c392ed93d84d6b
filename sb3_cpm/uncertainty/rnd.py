"""
Random network distillation (Burda et al. 2018, section 2.2): a state is new where a trained network cannot yet say what a
fixed random network says about it.

It is about *states*, not transitions: how often something like the state arrived in has been seen. The random network is
deterministic, so noise in the dynamics does not keep the error up by itself; endless new states, noise among them, do.

**What it rates in imagination.** The next state's latent exists there as well, so with ``inputs="feat"`` (the default),
"stoch" or "deter" the same function is applied to real and imagined states, and the actor's gradient reaches it through the
dynamics. The difference that remains: a real state's stochastic part is the posterior's expectation, an imagined one's a
sample of the prior. With ``inputs="embed"`` (nearest to the paper, whose random network sees pixels) imagined states have no
embedding and are rated by the one that their latent suggests, see :mod:`sb3_cpm.uncertainty.parts`.

The world model keeps learning, so latents drift under the random network: what was familiar becomes slightly new again. Inputs
are standardised with running statistics, which takes the largest part of that away.
"""

from typing import Any

import torch as th

from sb3_cpm.uncertainty.base import LatentSizes, Transitions
from sb3_cpm.uncertainty.parts import DreamtEmbedding, RunningNorm
from sb3_cpm.uncertainty.scale import ScaledUncertainty, root
from sb3_cpm.world_model.networks import MLP

INPUTS = ("feat", "stoch", "deter", "embed")


class RandomNetworkDistillation(ScaledUncertainty):
    """
    :param sizes: sizes of latents and actions
    :param inputs: what of the next state both networks see, "feat", "stoch", "deter" or "embed"
    :param layers: hidden layers of the trained network; the random one has one less, as in the paper
    :param units: size of each of them
    :param output_dim: how many random features there are to learn
    :param scale: metric and dynamic scale, see :class:`~sb3_cpm.uncertainty.scale.ScaledUncertainty`
    :raises ValueError: for unknown inputs and metrics
    """

    def __init__(
        self,
        sizes: LatentSizes,
        inputs: str = "feat",
        layers: int = 3,
        units: int = 400,
        output_dim: int = 64,
        **scale: Any,
    ) -> None:
        super().__init__(sizes, **scale)
        if inputs not in INPUTS:
            raise ValueError(f"`inputs` must be one of {INPUTS}, got {inputs!r}.")
        if layers < 1:
            raise ValueError(f"`layers` must be at least 1, got {layers}.")
        self.inputs = inputs
        size = {"feat": sizes.feat, "stoch": sizes.stoch, "deter": sizes.deter, "embed": sizes.embed}[inputs]
        self.dream = DreamtEmbedding(sizes.feat, sizes.embed, units) if inputs == "embed" else None
        self.norm = RunningNorm(size)
        self.output_norm = RunningNorm(output_dim)  # random features differ in size; standardised, all count alike
        # keeps its initial weights, which are in the checkpoint and in no optimizer
        self.random = MLP(size, max(layers - 1, 1), units, output_dim).requires_grad_(False)
        self.trained = MLP(size, layers, units, output_dim)

    def raw(self, transitions: Transitions) -> th.Tensor:
        """Root mean square error over the random features, shape ``(*batch,)``."""
        return root(self._error(transitions).square().mean(-1))

    def loss(self, transitions: Transitions) -> th.Tensor:
        loss = 0.5 * self._error(transitions).square().sum(-1).mean()
        if self.dream is not None:
            assert transitions.next_embed is not None, "only real transitions have an embedding"
            loss = loss + self.dream.loss(transitions.next_feat, self.dream.norm(transitions.next_embed))
        return loss

    def _error(self, transitions: Transitions) -> th.Tensor:
        state = self._state(transitions)
        return self.trained(state) - self.output_norm(self.random(state))

    def _state(self, transitions: Transitions) -> th.Tensor:
        """The next state as both networks see it, shape ``(*batch, size)``."""
        if self.dream is not None:
            return self.dream(transitions.next_feat, transitions.next_embed)
        return self.norm(self._latent(transitions))

    def _latent(self, transitions: Transitions) -> th.Tensor:
        if self.inputs == "feat":
            return transitions.next_feat
        return transitions.next_stoch if self.inputs == "stoch" else transitions.next_deter

    @th.no_grad()
    def adapt(self, transitions: Transitions) -> dict[str, th.Tensor]:
        if self.dream is not None:
            assert transitions.next_embed is not None
            self.dream.norm.update(transitions.next_embed)
        else:
            self.norm.update(self._latent(transitions))
        # set once, after the inputs' first statistics: a target that moves would look new
        if int(self.output_norm.updates) == 0:
            self.output_norm.update(self.random(self._state(transitions)))
        return super().adapt(transitions)
