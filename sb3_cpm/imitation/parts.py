"""
Clouds of labelled points to a token per part, and attention among the tokens (Shen et al. 2022, section 4.1: a policy and a
discriminator for objects that differ, whose parts do not).
"""

from collections.abc import Sequence
from itertools import pairwise

import torch as th
import torch.nn.functional as F
from torch import nn


def mlp(sizes: Sequence[int], last_activation: bool = False) -> nn.Sequential:
    """:return: linear layers of these sizes with ReLU in between"""
    layers: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        layers += [nn.Linear(size_in, size_out), nn.ReLU()]
    return nn.Sequential(*(layers if last_activation else layers[:-1]))


class PartPointNet(nn.Module):
    """
    The points of one part, with what the whole state and the action say, to a token: a shared MLP per point, half of whose
    channels are pooled by maximum and half by mean.

    :param n_features: of a point beside xyz, colours for instance
    :param n_context: numbers of state and action together
    :param sizes: of the layers that points share; the last one is even
    :param embed: size of the token
    """

    def __init__(self, n_features: int, n_context: int, sizes: Sequence[int], embed: int) -> None:
        super().__init__()
        self.n_largest = sizes[-1] // 2
        self.points = mlp([3 + 3 + n_features + n_context, *sizes], last_activation=True)
        self.token = mlp([sizes[-1], embed, embed])

    def forward(self, xyz: th.Tensor, features: th.Tensor, context: th.Tensor, mask: th.Tensor) -> th.Tensor:
        """
        :param xyz: shape ``(batch, n_points, 3)``
        :param features: shape ``(batch, n_points, n_features)``
        :param context: shape ``(batch, n_context)``
        :param mask: which points belong to the part, shape ``(batch, n_points)``
        :return: shape ``(batch, embed)``; of a part without points that of zeros
        """
        weight = mask.unsqueeze(-1).to(xyz.dtype)  # (batch, n_points, 1)
        n = weight.sum(1, keepdim=True).clamp(min=1.0)  # (batch, 1, 1)
        centre = (weight * xyz).sum(1, keepdim=True) / n  # of the part, (batch, 1, 3)
        points = xyz.shape[1]
        inputs = (xyz - centre, centre.expand_as(xyz), features, context.unsqueeze(1).expand(-1, points, -1))
        values = self.points(th.cat(inputs, dim=-1))  # (batch, n_points, sizes[-1]), at least 0
        largest = (values[..., : self.n_largest] * weight).amax(1)  # zeros stand in for points of other parts: none is smaller
        mean = (values[..., self.n_largest :] * weight).sum(1) / n.squeeze(1)
        return self.token(th.cat((largest, mean), dim=-1))


class Attention(nn.Module):
    """
    Attention of queries to tokens, with as many heads of their own size.

    :param embed: size of a token
    :param heads: number of heads
    :param head_size: of each
    :param dropout: of the weights, in training
    """

    def __init__(self, embed: int, heads: int, head_size: int, dropout: float) -> None:
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.query = nn.Linear(embed, heads * head_size)
        self.key_value = nn.Linear(embed, 2 * heads * head_size)
        self.out = nn.Linear(heads * head_size, embed)

    def forward(self, queries: th.Tensor, tokens: th.Tensor, mask: th.Tensor) -> th.Tensor:
        """
        :param queries: shape ``(batch, q, embed)``
        :param tokens: shape ``(batch, t, embed)``
        :param mask: which tokens count, at least one, shape ``(batch, t)``
        :return: shape ``(batch, q, embed)``
        """
        batch, q = queries.shape[:2]
        query = self.query(queries).view(batch, q, self.heads, -1).transpose(1, 2)  # (batch, heads, q, head_size)
        key, value = self.key_value(tokens).view(batch, -1, 2, self.heads, query.shape[-1]).permute(2, 0, 3, 1, 4)
        dropout = self.dropout if self.training else 0.0
        found = F.scaled_dot_product_attention(query, key, value, mask[:, None, None], dropout)
        return self.out(found.transpose(1, 2).reshape(batch, q, -1))


class Block(nn.Module):
    """Self-attention and an MLP of four times the width, each with a residual and a layer normalisation after it."""

    def __init__(self, embed: int, heads: int, head_size: int, dropout: float) -> None:
        super().__init__()
        self.attention = Attention(embed, heads, head_size, dropout)
        self.mlp = nn.Sequential(nn.Linear(embed, 4 * embed), nn.ReLU(), nn.Linear(4 * embed, embed), nn.Dropout(dropout))
        self.norms = nn.ModuleList(nn.LayerNorm(embed) for _ in range(2))

    def forward(self, tokens: th.Tensor, mask: th.Tensor) -> th.Tensor:
        tokens = self.norms[0](tokens + self.attention(tokens, tokens, mask))
        return self.norms[1](tokens + self.mlp(tokens))


class StrongHead(nn.Module):
    """
    Tokens to one vector: a trainable token in front, blocks of self-attention, and pooling by attention with a learnt query.

    :param embed: size of a token and of the result
    :param heads: of attention
    :param head_size: of each
    :param blocks: of self-attention
    :param dropout: in training
    """

    def __init__(self, embed: int, heads: int, head_size: int, blocks: int, dropout: float) -> None:
        super().__init__()
        self.first = nn.Parameter(0.02 * th.randn(1, 1, embed))
        self.query = nn.Parameter(0.02 * th.randn(1, 1, embed))  # one, which each head projects for itself
        self.blocks = nn.ModuleList(Block(embed, heads, head_size, dropout) for _ in range(blocks))
        self.pool = Attention(embed, heads, head_size, dropout)

    def forward(self, tokens: th.Tensor, mask: th.Tensor) -> th.Tensor:
        """
        :param tokens: shape ``(batch, t, embed)``
        :param mask: which of them count, shape ``(batch, t)``
        :return: shape ``(batch, embed)``
        """
        batch = len(tokens)
        tokens = th.cat((self.first.expand(batch, -1, -1), tokens), dim=1)
        mask = F.pad(mask, (1, 0), value=True)
        for block in self.blocks:
            tokens = block(tokens, mask)
        return self.pool(self.query.expand(batch, -1, -1), tokens, mask).squeeze(1)
