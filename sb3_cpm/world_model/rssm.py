"""
The recurrent state-space model (report, B.1; Hafner et al. 2021, section 2): deterministic memory and stochastic state.

========= =====================================================
deter_t   GRU(deter_{t-1}, stoch_{t-1}, action_t)
prior     p(stoch_t | deter_t), what was predicted
posterior q(stoch_t | deter_t, embed_t), after seeing state t
========= =====================================================

``action_t`` is the action that *led to* state t (see :class:`sb3_cpm.type_aliases.SequenceBatch`). Only what depends on the
step before is computed step by step; projections of embeddings and actions, and the whole prior, see all steps at once.
States are float32 even where mixed precision computes them: a memory that is rounded at every step forgets.
"""

from typing import NamedTuple

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_cpm.world_model.by_hand.dream import Dynamics
from sb3_cpm.world_model.by_hand.scan import Scan, ScanSettings, Weights, rows_with_resets
from sb3_cpm.world_model.distributions import GaussianLatent, Latent
from sb3_cpm.world_model.fast.acceleration import is_compiled
from sb3_cpm.world_model.fast.linear import Linear
from sb3_cpm.world_model.fast.one_hot import OneHotLinear
from sb3_cpm.world_model.networks import MLP, GRUCell


class LatentState(NamedTuple):
    """
    What the world model believes about one state, for any batch dimensions.

    :param deter: deterministic part, shape ``(*batch, deter_size)``
    :param stoch: stochastic part, shape ``(*batch, stoch_size)``
    :param stats: parameters of the distribution that ``stoch`` was drawn from, shape ``(*batch, stats_size)``
    """

    deter: th.Tensor
    stoch: th.Tensor
    stats: th.Tensor

    @property
    def feat(self) -> th.Tensor:
        """The whole latent, what heads and actors read, shape ``(*batch, feat_dim)``."""
        return th.cat((self.stoch, self.deter), dim=-1)

    def detach(self) -> "LatentState":
        return LatentState(*(part.detach() for part in self))

    def flatten(self) -> "LatentState":
        """All batch dimensions in one."""
        return LatentState(*(part.flatten(0, -2) for part in self))

    def select(self, index: th.Tensor) -> "LatentState":
        """Rows of the first batch dimension."""
        return LatentState(*(part[index] for part in self))


class RSSM(nn.Module):
    """
    :param latent: kind of the stochastic state
    :param deter_size: size of the GRU (200 in the report)
    :param hidden_size: size of the layers around the GRU
    :param embed_dim: size of the encoder's output
    :param action_dim: number of action dimensions
    """

    def __init__(self, latent: Latent, deter_size: int, hidden_size: int, embed_dim: int, action_dim: int) -> None:
        super().__init__()
        self.latent = latent
        self.deter_size = deter_size
        self.feat_dim = latent.size + deter_size
        self.input_stoch = OneHotLinear(latent.size, hidden_size, latent.one_hot)
        self.input_action = Linear(action_dim, hidden_size, bias=False)
        self.gru = GRUCell(hidden_size, deter_size)
        self.prior_net = MLP(deter_size, 1, hidden_size, latent.stats_size)
        self.posterior_deter = Linear(deter_size, hidden_size)
        self.posterior_embed = Linear(embed_dim, hidden_size, bias=False)
        self.posterior_out = Linear(hidden_size, latent.stats_size)

    def forward(self, stoch: th.Tensor, action_in: th.Tensor, deter: th.Tensor) -> th.Tensor:
        """
        One step of the memory, what all sequences are made of (``torch.compile`` takes hold here).

        :param stoch: stochastic state before the step, shape ``(n, stoch_size)``
        :param action_in: projected action, shape ``(n, hidden_size)``
        :param deter: memory before the step, shape ``(n, deter_size)``
        :return: memory after it
        """
        return self.gru(F.elu(self.input_stoch(stoch) + action_in), deter)

    def initial_state(self, n: int) -> LatentState:
        """Zeros for ``n`` environments."""
        like = self.input_stoch.weight
        sizes = (self.deter_size, self.latent.size, self.latent.stats_size)
        return LatentState(*(th.zeros(n, size, device=like.device, dtype=like.dtype) for size in sizes))

    def observe(
        self,
        embed: th.Tensor,
        actions: th.Tensor,
        is_first: th.Tensor,
        mask: th.Tensor | None = None,
        state: LatentState | None = None,
        deterministic: bool = False,
    ) -> LatentState:
        """
        Posterior states along sequences of ``L`` rows and ``n`` columns.

        Where ``is_first`` is set, nothing from before enters: memory and action are zero there. Where ``mask`` is False,
        the column's state stays as it is.

        :param embed: encoder outputs, shape ``(L, n, embed_dim)``
        :param actions: the action that led to each row, shape ``(L, n, action_dim)``
        :param is_first: first row of an episode, shape ``(L, n)``, bool
        :param mask: rows that exist, shape ``(L, n)``, bool; None where all do (or where the caller masks the results)
        :param state: the state before the first row; zeros by default
        :param deterministic: take the mode instead of a sample
        :return: posteriors of all rows, batch dimensions ``(L, n)``
        """
        length, n = is_first.shape
        state = self.initial_state(n) if state is None else state
        first = is_first.unsqueeze(-1)
        actions_in = self.input_action(actions.masked_fill(first, 0.0))
        embed_in = self.posterior_embed(embed)
        noise = None if deterministic else self.latent.noise(length, n, like=state.deter)
        if noise is not None and mask is None and self._trains_by_hand(embed_in):
            return self._scan(state, noise, first, actions_in, embed_in)
        resets = rows_with_resets(is_first)
        gaps = None if mask is None else (~mask).any(dim=1).tolist()

        deter, stoch, stats = state
        rows: list[LatentState] = []
        for t in range(length):
            before = LatentState(deter, stoch, stats)
            if resets[t]:
                deter, stoch = deter.masked_fill(first[t], 0.0), stoch.masked_fill(first[t], 0.0)
            deter = self(stoch, actions_in[t], deter)
            stats = self.posterior_out(F.elu(self.posterior_deter(deter) + embed_in[t])).float()
            stoch = self.latent.mode(stats) if noise is None else self.latent.sample(stats, noise[t])
            if mask is not None and gaps is not None and gaps[t]:
                here = mask[t].unsqueeze(-1)
                deter, stoch, stats = (
                    th.where(here, new, old) for new, old in zip((deter, stoch, stats), before, strict=True)
                )
            rows.append(LatentState(deter, stoch, stats))
        return LatentState(*(th.stack(parts) for parts in zip(*rows, strict=True)))

    def _trains_by_hand(self, embed_in: th.Tensor) -> bool:
        """Where there is a gradient to compute, and torch.compile does not have the step."""
        return embed_in.requires_grad and not is_compiled(self)

    def _scan(
        self,
        state: LatentState,
        noise: th.Tensor,
        first: th.Tensor,
        actions_in: th.Tensor,
        embed_in: th.Tensor,
    ) -> LatentState:
        """
        What :meth:`observe` computes step by step, with the gradient by hand; in float32 also in mixed precision, since the
        products are too small for bfloat16 to pay.
        """
        settings = ScanSettings(self.latent, self.gru.update_bias, self.gru.norm.eps)
        weights = Weights(
            self.input_stoch.weight,
            self.gru.gates.weight,
            self.gru.norm.weight,
            self.gru.norm.bias,
            self.posterior_deter.weight,
            self.posterior_out.weight,
            self.posterior_out.bias,
        )
        actions_in, embed_in = actions_in + self.input_stoch.bias, embed_in + self.posterior_deter.bias
        with th.autocast(embed_in.device.type, enabled=False):
            return LatentState(*Scan.apply(settings, noise, first, state.deter, state.stoch, actions_in, embed_in, *weights))

    def prior(self, deter: th.Tensor) -> th.Tensor:
        """Parameters of the prior that belongs to a deterministic state, shape ``(*batch, stats_size)``."""
        return self.prior_net(deter).float()

    def imagine_step(self, state: LatentState, action: th.Tensor, deterministic: bool = False) -> LatentState:
        """
        One step without an observation.

        :param state: latent state, batch dimension ``(n,)``
        :param action: the action taken in it, shape ``(n, action_dim)``
        :param deterministic: take the mode instead of a sample
        :return: the predicted next state
        """
        deter = self(state.stoch, self.input_action(action), state.deter)
        stats = self.prior(deter)
        if deterministic:
            return LatentState(deter, self.latent.mode(stats), stats)
        return LatentState(deter, self.latent.sample(stats, self.latent.noise(len(deter), like=deter)), stats)

    def dynamics(self) -> Dynamics:
        """What :meth:`imagine_step` is made of, for :class:`~sb3_cpm.world_model.by_hand.dream.Dream`."""
        assert isinstance(self.latent, GaussianLatent)
        gates, hidden = self.gru.gates.weight, self.input_action.out_features
        hidden_layer, _, output_layer = self.prior_net
        assert isinstance(hidden_layer, nn.Linear) and isinstance(output_layer, nn.Linear)
        return Dynamics(
            self.latent,
            th.cat((self.input_action.weight, self.input_stoch.weight), dim=1),
            self.input_stoch.bias,
            th.cat((gates[:, hidden:], gates[:, :hidden]), dim=1),  # the cell itself reads its input first
            self.gru.norm.weight,
            self.gru.norm.bias,
            self.gru.norm.eps,
            self.gru.update_bias,
            ((hidden_layer.weight, hidden_layer.bias), (output_layer.weight, output_layer.bias)),
        )
