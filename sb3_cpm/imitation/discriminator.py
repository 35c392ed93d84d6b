"""
Who tells an expert's transitions from the player's: the discriminator of GAIL (Ho & Ermon 2016), on vectors, or on clouds of
labelled parts, where it grows from a simple head to one with attention (Shen et al. 2022, section 4.2).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim
from torch import nn

from sb3_cpm.arguments import AT_LEAST_0, SHARE, check, check_each, integer, nearest, number
from sb3_cpm.imitation.parts import PartPointNet, StrongHead, mlp
from sb3_cpm.spaces import is_vector, looks_like_cloud

Observations = Mapping[str, th.Tensor]


class Discriminator(nn.Module, ABC):
    """
    Logits f of transitions, large for the expert's. Subclasses take the two spaces first and their own keyword arguments after
    them. Everything that has to survive a checkpoint is a parameter or a registered buffer.

    :param observation_space: Dict space
    :param action_space: Box space
    :param keys: observation keys that it reads
    """

    updates: th.Tensor

    def __init__(self, observation_space: spaces.Dict, action_space: spaces.Box, keys: Sequence[str]) -> None:
        super().__init__()
        self.keys = tuple(keys)
        self.register_buffer("updates", th.zeros((), dtype=th.long))

    @abstractmethod
    def forward(self, observations: Observations, actions: th.Tensor) -> th.Tensor:
        """
        :param observations: by key, each of shape ``(n, *shape)``
        :param actions: within [-1, 1], shape ``(n, action_dim)``
        :return: logits, shape ``(n,)``
        """

    @abstractmethod
    def observe(self, observations: Observations) -> None:
        """
        Take the scale of its inputs from the first expert rows that it learns from; never again, or rewards would drift.

        :param observations: by key, of the expert
        """

    def plan(self, n_updates: int) -> None:
        """:param n_updates: that ``learn()`` will make, of which growth may be a share"""

    @property
    def alpha(self) -> float:
        """How much of it has grown; 1 for one that does not."""
        return 1.0


class _Standardised(nn.Module):
    """
    Subtracts a mean and divides by a standard deviation that were observed once.

    :param size: of the last dimension
    """

    mean: th.Tensor
    std: th.Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", th.zeros(size))
        self.register_buffer("std", th.ones(size))

    def observe(self, rows: th.Tensor) -> None:
        """:param rows: shape ``(n, size)``"""
        if len(rows) > 1:
            self.mean.copy_(rows.mean(0))
            self.std.copy_(rows.std(0).clamp(min=1e-3))  # what never changed says nothing of its scale

    def forward(self, values: th.Tensor) -> th.Tensor:
        return ((values - self.mean) / self.std).clamp(-10.0, 10.0)


def _vectors_of(space: spaces.Dict, keys: Sequence[str] | None) -> list[str]:
    return [key for key, part in space.spaces.items() if is_vector(part) and (keys is None or key in keys)]


def _check_keys(space: spaces.Dict, keys: Sequence[str] | None) -> None:
    for key in keys or ():
        if key not in space.spaces:
            raise ValueError(f"`keys` names {key!r}, which is not among the observations.{nearest(key, space.spaces)}")


class VectorDiscriminator(Discriminator):
    """
    An MLP of all vectors and the action. It does not grow.

    :param observation_space: Dict space
    :param action_space: Box space
    :param keys: vectors to read; None: all
    :param sizes: hidden layers
    :raises ValueError: without a vector to read
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        keys: Sequence[str] | None = None,
        sizes: Sequence[int] = (256, 256),
    ) -> None:
        _check_keys(observation_space, keys)
        vectors = _vectors_of(observation_space, keys)
        if not vectors:
            raise ValueError(f"VectorDiscriminator reads vectors, and there are none among {list(observation_space.spaces)}.")
        super().__init__(observation_space, action_space, vectors)
        n_state = sum(flatdim(observation_space[key]) for key in vectors)
        self.scale = _Standardised(n_state)
        self.net = mlp([n_state + flatdim(action_space), *sizes, 1])

    def forward(self, observations: Observations, actions: th.Tensor) -> th.Tensor:
        return self.net(th.cat((self.scale(self._state(observations)), actions), dim=1)).squeeze(1)

    def observe(self, observations: Observations) -> None:
        self.scale.observe(self._state(observations))

    def _state(self, observations: Observations) -> th.Tensor:
        return th.cat([observations[key].float() for key in self.keys], dim=1)


class ProgressiveDiscriminator(Discriminator):
    """
    Reads a cloud of labelled points: xyz, further features, and the part that a point belongs to in its last column. Each part
    has a PointNet of its own; so have the points of no part, and all together. State and action are the last token. A simple
    head takes the maximum over the tokens; a strong one attends among them. ``alpha`` goes from the one to the other.

    :param observation_space: Dict space with a cloud, and vectors
    :param action_space: Box space
    :param keys: of the cloud and the vectors to read; None: the first cloud and all vectors
    :param parts: labels of the parts that get a token of their own
    :param sizes: layers that points share
    :param embed: size of a token
    :param heads: of attention
    :param head_size: of each
    :param blocks: of self-attention
    :param dropout: in training
    :param grow: the simple head alone for so many updates, and so many more until it is the strong one alone; as floats shares
        of all updates of ``learn()``. The paper's are updates of a run of 3 million steps
    :raises ValueError: without a labelled cloud, and for arguments that cannot work
    """

    limits: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        keys: Sequence[str] | None = None,
        parts: Sequence[int] = (0, 1, 2),
        sizes: Sequence[int] = (192, 192),
        embed: int = 192,
        heads: int = 4,
        head_size: int = 32,
        blocks: int = 2,
        dropout: float = 0.1,
        grow: tuple[float, float] = (2000, 3000),
    ) -> None:
        check_each(integer(1), embed=embed, heads=heads, head_size=head_size)
        check("blocks", blocks, integer(0))
        check("dropout", dropout, number("a number from 0 up to, but without 1", lambda value: 0.0 <= value < 1.0))
        self.grow = _checked_growth(grow)
        _check_keys(observation_space, keys)
        cloud = _cloud_of(observation_space, keys)
        vectors = _vectors_of(observation_space, keys)
        super().__init__(observation_space, action_space, [cloud, *vectors])
        self.cloud, self.vectors, self.parts = cloud, tuple(vectors), tuple(int(part) for part in parts)
        n_features = observation_space[cloud].shape[1] - 4  # type: ignore[index]  # without xyz and label
        n_state = sum(flatdim(observation_space[key]) for key in vectors)
        n_context = n_state + flatdim(action_space)
        self.of_points, self.of_state = _Standardised(3), _Standardised(n_state)
        self.pointnets = nn.ModuleList(PartPointNet(n_features, n_context, sizes, embed) for _ in range(len(self.parts) + 2))
        self.context = mlp([n_context, embed, embed])
        self.strong = StrongHead(embed, heads, head_size, blocks, dropout)
        self.out = mlp([embed, max(embed * 2 // 3, 1), 1])
        self.register_buffer("limits", th.tensor([float(value) for value in self.grow]))

    @property
    def alpha(self) -> float:
        """Share of the strong head: 0, then linear to 1, then 1."""
        alone, growing = self.limits.tolist()
        beyond = float(self.updates) - alone
        return min(max(beyond / growing, 0.0), 1.0) if growing else float(beyond >= 0)

    def plan(self, n_updates: int) -> None:
        if isinstance(self.grow[0], float):
            self.limits.copy_(th.tensor([float(round(share * n_updates)) for share in self.grow]))

    def forward(self, observations: Observations, actions: th.Tensor) -> th.Tensor:
        cloud = observations[self.cloud].float()  # (n, points, 3 + features + 1)
        labels = cloud[..., -1].round().long()
        xyz, features = self.of_points(cloud[..., :3]), cloud[..., 3:-1]
        context = th.cat((self.of_state(self._state(observations)), actions), dim=1)
        of_parts = [labels == part for part in self.parts]
        rest = ~th.stack(of_parts).any(0) if of_parts else th.ones_like(labels, dtype=th.bool)
        masks = [*of_parts, rest, th.ones_like(rest)]
        of_masks = [net(xyz, features, context, mask) for net, mask in zip(self.pointnets, masks, strict=True)]
        tokens = th.stack((*of_masks, self.context(context)), dim=1)  # (n, parts + 3, embed)
        counts = th.stack([*(mask.any(1) for mask in masks), th.ones_like(rest[:, 0])], dim=1)  # which tokens there are
        simple = tokens.masked_fill(~counts.unsqueeze(-1), -th.inf).amax(1)
        alpha = self.alpha
        if alpha > 0.0:
            simple = (1.0 - alpha) * simple + alpha * self.strong(tokens, counts)
        return self.out(simple).squeeze(1)

    def observe(self, observations: Observations) -> None:
        """
        :raises ValueError: for a part that no point of the expert belongs to
        """
        labels = observations[self.cloud][..., -1].round().unique().long().tolist()
        strange = [part for part in self.parts if part not in labels]
        if strange:
            raise ValueError(
                f"parts={list(self.parts)}: no point of the demonstrations has the label {strange[0]}, theirs are {labels}. "
                "Name parts among those in discriminator_kwargs."
            )
        self.of_points.observe(observations[self.cloud].float()[..., :3].flatten(0, 1))
        self.of_state.observe(self._state(observations))

    def _state(self, observations: Observations) -> th.Tensor:
        cloud = observations[self.cloud]
        return th.cat([observations[key].float() for key in self.vectors] or [cloud.new_zeros(len(cloud), 0)], dim=1)


def _checked_growth(grow: Any) -> tuple[float, float]:
    if not isinstance(grow, Sequence) or len(grow) != 2 or any(isinstance(one, bool) for one in grow):
        raise ValueError(f"grow={grow!r}: expected two numbers, updates (2000, 3000) or shares of all of them (0.2, 0.3).")
    if not (all(isinstance(one, int) for one in grow) or all(isinstance(one, float) for one in grow)):
        raise ValueError(f"grow={grow!r} mixes updates and shares: two integers, (2000, 3000), or two floats, (0.2, 0.3).")
    for one in grow:
        check("grow", one, SHARE if isinstance(one, float) else AT_LEAST_0)
    return tuple(grow)


def _cloud_of(space: spaces.Dict, keys: Sequence[str] | None) -> str:
    clouds = [key for key, part in space.spaces.items() if looks_like_cloud(part) and (keys is None or key in keys)]
    if not clouds:
        raise ValueError(
            f"ProgressiveDiscriminator reads a point cloud, and there is none among {list(keys or space.spaces)}. For "
            "vectors: discriminator_class='vector'."
        )
    n_columns = space[clouds[0]].shape[1]  # type: ignore[index]
    if n_columns not in (4, 7):  # xyz and label, with or without colours
        raise ValueError(
            f"The points of {clouds[0]!r} have {n_columns} numbers, without the label of their part: xyz and label, or xyz, "
            "rgb and label are expected. Make the environment with env_kwargs=dict(point_labels=True) (ManiSkill: 'roles')."
        )
    return clouds[0]


DISCRIMINATORS: dict[str, type[Discriminator]] = {"progressive": ProgressiveDiscriminator, "vector": VectorDiscriminator}


def softplus_reward(logits: th.Tensor) -> th.Tensor:
    """
    ``-log D`` with D the probability of "player", which is ``softplus(f)``: at least 0, and finite for any logit.

    :param logits: of :class:`Discriminator`, shape ``(n,)``
    """
    return F.softplus(logits)
