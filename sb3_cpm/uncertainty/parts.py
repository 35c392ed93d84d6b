"""
What several measures need: running normalisation, and an embedding for states that nobody observed.

Why a dreamt embedding: measures of novelty that were invented for observations have none in imagination. The world model
could decode each imagined latent to pixels and encode those again; that costs a decoder and an encoder per imagined step, and
the encoder has never seen decoded pictures. A small head that reads the embedding off the latent is learnt from real states
on the side, and differentiable, so that the actor's gradient passes through it.
"""

import torch as th
from torch import nn

from sb3_cpm.world_model.networks import MLP


class RunningNorm(nn.Module):
    """
    Standardises with running mean and variance, softly bounded to +-``bound`` (Burda et al. 2018, 2.4 clip at 5; a soft bound
    keeps the gradient).

    A plain average over the first updates, then an exponential one: latents drift while the world model learns.

    :param size: of the last dimension
    :param bound: nothing gets larger than that
    :param memory: updates that the exponential average reaches back
    """

    mean: th.Tensor
    variance: th.Tensor
    updates: th.Tensor

    def __init__(self, size: int, bound: float = 5.0, memory: int = 100) -> None:
        super().__init__()
        self.bound, self.memory = bound, memory
        self.register_buffer("mean", th.zeros(size))
        self.register_buffer("variance", th.ones(size))
        self.register_buffer("updates", th.zeros((), dtype=th.long))

    def forward(self, values: th.Tensor) -> th.Tensor:
        standard = (values - self.mean) / (self.variance + 1e-6).sqrt()
        return self.bound * th.tanh(standard / self.bound)

    @th.no_grad()
    def update(self, values: th.Tensor) -> None:
        """
        :param values: shape ``(n, size)``; a batch without any or with infinite ones changes nothing
        """
        if not len(values) or not bool(th.isfinite(values).all()):
            return
        self.updates += 1
        weight = 1.0 / min(int(self.updates), self.memory)
        delta = values.mean(0) - self.mean
        self.mean += weight * delta
        # within the batch, and between its mean and the running one
        spread = values.var(0, correction=0) + (1.0 - weight) * delta.square()
        self.variance.copy_(spread if int(self.updates) == 1 else th.lerp(self.variance, spread, weight))


class DreamtEmbedding(nn.Module):
    """
    Standardised embeddings: of real states those that the encoder gave, of imagined ones those that their latents suggest.

    :param feat_dim: size of the latent
    :param embed_dim: size of the embedding
    :param units: size of its hidden layer
    """

    def __init__(self, feat_dim: int, embed_dim: int, units: int) -> None:
        super().__init__()
        self.norm = RunningNorm(embed_dim)
        self.head = MLP(feat_dim, 1, units, embed_dim)

    def forward(self, feat: th.Tensor, embed: th.Tensor | None) -> th.Tensor:
        """
        :param feat: latents, shape ``(*batch, feat_dim)``
        :param embed: what the encoder gave, shape ``(*batch, embed_dim)``; None in imagination
        :return: shape ``(*batch, embed_dim)``
        """
        return self.head(feat) if embed is None else self.norm(embed)

    def loss(self, feat: th.Tensor, standard: th.Tensor) -> th.Tensor:
        """
        :param feat: latents, shape ``(n, feat_dim)``
        :param standard: standardised embeddings, shape ``(n, embed_dim)``
        :return: squared error of dreaming real states, summed over the dimensions
        """
        return 0.5 * (self.head(feat) - standard).square().sum(-1).mean()
