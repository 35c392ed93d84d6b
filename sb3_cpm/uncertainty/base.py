"""
The seam for novelty measures (report, section 4.4.1: DISAG in u_t; also the reward of C's exploration actor).

A measure sees transitions between latent states. It may learn from real ones (:meth:`Uncertainty.loss`), must rate real and
imagined ones (:meth:`Uncertainty.novelty`), and may adjust its scale to what it sees (:meth:`Uncertainty.adapt`). In
imagination nothing was observed, so there are no embeddings; every measure says in its docstring what it rates there instead.
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_cpm.world_model.fast.one_hot import OneHot


class Transitions(NamedTuple):
    """
    Transitions t -> t+1 between latent states, any batch dimensions.

    :param feat: whole latent of state t, shape ``(*batch, feat_dim)``
    :param action: the action taken *in state t*, shape ``(*batch, action_dim)``. In a
        :class:`~sb3_cpm.type_aliases.SequenceBatch` that is the action stored in row t+1; the one in row t led to state t
        and says nothing about state t+1
    :param next_stoch: stochastic part of state t+1, its expectation (a sample in imagination), ``(*batch, stoch_size)``
    :param next_deter: deterministic part of state t+1, shape ``(*batch, deter_size)``
    :param next_embed: encoder output of state t+1, shape ``(*batch, embed_dim)``; None in imagination
    :param embed: encoder output of state t, shape ``(*batch, embed_dim)``; None in imagination
    """

    feat: th.Tensor
    action: th.Tensor
    next_stoch: th.Tensor
    next_deter: th.Tensor
    next_embed: th.Tensor | None = None
    embed: th.Tensor | None = None

    @property
    def next_feat(self) -> th.Tensor:
        """Whole latent of state t+1, shape ``(*batch, feat_dim)``."""
        return th.cat((self.next_stoch, self.next_deter), dim=-1)

    def flatten(self) -> "Transitions":
        """All batch dimensions in one."""
        return Transitions(*(None if part is None else part.flatten(0, -2) for part in self))  # type: ignore[arg-type]

    def select(self, index: th.Tensor | slice) -> "Transitions":
        """Those that an index, a mask or a slice picks."""
        return Transitions(*(None if part is None else part[index] for part in self))  # type: ignore[arg-type]


class LatentSizes(NamedTuple):
    """Sizes of what a measure reads and predicts, and which of the latent's first numbers are one-hot vectors, if any."""

    feat: int
    action: int
    stoch: int
    deter: int
    embed: int
    one_hot: OneHot | None = None


class Uncertainty(nn.Module, ABC):
    """
    Abstract novelty measure. Subclasses take ``sizes`` first and their own keyword arguments after it (they come from
    ``uncertainty_kwargs``). Everything that has to survive a checkpoint is a parameter or a registered buffer.
    """

    #: novelty is at least 0 by construction, which S, F and R may rely on; checked at every evaluation
    nonnegative: bool = True

    def __init__(self, sizes: LatentSizes) -> None:
        super().__init__()
        self.sizes = sizes

    @abstractmethod
    def novelty(self, transitions: Transitions) -> th.Tensor:
        """
        How new each transition is, differentiable with respect to all that it reads of a transition: the exploration actor
        climbs along this gradient, through the action and through the imagined states.

        :param transitions: real or imagined
        :return: shape ``(*batch,)``
        """

    @abstractmethod
    def loss(self, transitions: Transitions) -> th.Tensor:
        """
        What one update minimises, a scalar. Transitions across episode boundaries and into padding are already left out.

        :param transitions: real ones without gradients, batch dimension ``(n,)``
        """

    def adapt(self, transitions: Transitions) -> dict[str, th.Tensor]:
        """
        Adjust whatever is adjusted by rule instead of by gradient; called once after each update.

        :param transitions: those of the update
        :return: numbers worth logging, detached scalars
        """
        return {"disagreement": self.novelty(transitions).mean().detach()}


def checked_novelty(uncertainty: Uncertainty, transitions: Transitions) -> th.Tensor:
    """
    :param uncertainty: who says what is new, perhaps a class of the user's own
    :param transitions: real or imagined
    :return: how new each of them is, shape ``(*batch,)``
    :raises ValueError: unless it gives a number per transition: others might be broadcast unnoticed
    """
    novelty, expected = uncertainty.novelty(transitions), transitions.feat.shape[:-1]
    if novelty.shape != expected:
        raise ValueError(
            f"The uncertainty {type(uncertainty).__qualname__} gave a novelty of shape {tuple(novelty.shape)} for transitions "
            f"of shape {tuple(expected)}: it must be one number for each."
        )
    return novelty
