"""
The world model: encoder, RSSM, decoders, reward head and continue head, trained together (report, B.1; Hafner et al. 2021).
"""

from typing import NamedTuple

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_cpm.presets import Preset
from sb3_cpm.world_model.distributions import CategoricalLatent, GaussianLatent, Latent
from sb3_cpm.world_model.losses import balanced_kl, masked_mean, squared_error
from sb3_cpm.world_model.networks import MLP, Decoder, Encoder
from sb3_cpm.world_model.observations import Inputs, ObservationSpec, symexp, symlog
from sb3_cpm.world_model.rssm import RSSM, LatentState


class Sequences(NamedTuple):
    """
    A :class:`~sb3_cpm.type_aliases.SequenceBatch` on the device; ``inputs`` has its ``L * n`` rows flattened.

    :param inputs: preprocessed observations of all rows
    :param actions: shape ``(L, n, action_dim)``
    :param rewards: shape ``(L, n)``
    :param is_first: shape ``(L, n)``, bool
    :param is_terminal: shape ``(L, n)``, bool
    :param mask: shape ``(L, n)``, bool
    """

    inputs: Inputs
    actions: th.Tensor
    rewards: th.Tensor
    is_first: th.Tensor
    is_terminal: th.Tensor
    mask: th.Tensor


class WorldModelOutput(NamedTuple):
    """
    :param losses: the terms of the loss, already multiplied by their scale; their sum is what is minimised
    :param metrics: further numbers worth logging, detached scalars
    :param posterior: posterior states of all rows, batch dimensions ``(L, n)``, detached
    :param embed: encoder outputs of all rows, shape ``(L, n, embed_dim)``, detached
    """

    losses: dict[str, th.Tensor]
    metrics: dict[str, th.Tensor]
    posterior: LatentState
    embed: th.Tensor

    @property
    def total(self) -> th.Tensor:
        """What is minimised, a scalar."""
        return th.stack(list(self.losses.values())).sum()


def make_latent(preset: Preset) -> Latent:
    """The kind of stochastic state that a preset asks for."""
    if preset.latent == "gaussian":
        return GaussianLatent(preset.stoch_size)
    return CategoricalLatent(preset.stoch_size, preset.stoch_classes)


class WorldModel(nn.Module):
    """
    :param spec: the observations that it reads
    :param action_dim: number of action dimensions
    :param preset: sizes and scales, see :mod:`sb3_cpm.presets`
    """

    def __init__(self, spec: ObservationSpec, action_dim: int, preset: Preset) -> None:
        super().__init__()
        self.spec, self.action_dim, self.preset = spec, action_dim, preset
        vector = (preset.vector_layers, preset.vector_units)
        cnn = (preset.cnn_depth, preset.cnn_layers)
        self.encoder = Encoder(spec, *cnn, *vector)
        self.embed_dim = self.encoder.output_dim
        self.latent = make_latent(preset)
        self.rssm = RSSM(self.latent, preset.deter_size, preset.hidden_size, self.embed_dim, action_dim)
        self.feat_dim = self.rssm.feat_dim
        self.decoder = Decoder(self.feat_dim, spec, *cnn, *vector, self.latent.one_hot)
        head = (self.feat_dim, preset.head_layers, preset.head_units, 1, self.latent.one_hot)
        self.reward_head = MLP(*head)
        self.continue_head = MLP(*head) if preset.continue_head else None

    def loss(self, batch: Sequences) -> WorldModelOutput:
        """Everything that one update of the world model minimises, and the posterior states it found on the way."""
        length, n = batch.mask.shape
        embed = self.encoder(batch.inputs).float().unflatten(0, (length, n))
        # no mask here: padding follows the last row, so it cannot change a state that counts
        posterior = self.rssm.observe(embed, batch.actions, batch.is_first)
        prior = self.rssm.prior(posterior.deter)
        feat = posterior.feat
        kl_loss, kl = balanced_kl(
            self.latent, posterior.stats, prior, batch.mask, self.preset.kl_balance, self.preset.free_nats
        )
        losses = {"kl": self.preset.kl_scale * kl_loss}
        metrics = {"kl": kl}
        reconstructions, errors = self._reconstruction_losses(feat, batch)
        losses.update(reconstructions)
        metrics.update(errors)
        heads, errors = self._head_losses(feat, batch)
        losses.update(heads)
        metrics.update(errors)
        return WorldModelOutput(losses, metrics, posterior.detach(), embed.detach())

    def _reconstruction_losses(self, feat: th.Tensor, batch: Sequences) -> tuple[dict[str, th.Tensor], dict[str, th.Tensor]]:
        losses, metrics = {}, {}
        decoded = self.decoder(feat.flatten(0, 1)).float()
        mask = batch.mask.flatten()
        if decoded.images is not None and batch.inputs.images is not None:
            losses["image"] = masked_mean(squared_error(decoded.images, batch.inputs.images), mask)
        if decoded.vectors is not None and batch.inputs.vectors is not None:
            losses["vector"] = masked_mean(squared_error(decoded.vectors, batch.inputs.vectors), mask)
        with th.no_grad():
            errors = {key: masked_mean(one, mask) for key, one in self.spec.errors(decoded, batch.inputs)}
            metrics.update({f"error_{key}": value for key, value in errors.items()})
        if decoded.images is not None:  # the report's measure of Fig. 10b, on the scale of [-0.5, 0.5]
            cameras = zip(self.spec.image_keys, self.spec.channels, strict=True)
            metrics["pixel_error"] = th.stack([n * errors[key] for key, n in cameras]).sum() / len(decoded.images[0])
        return losses, metrics

    def _head_losses(self, feat: th.Tensor, batch: Sequences) -> tuple[dict[str, th.Tensor], dict[str, th.Tensor]]:
        feat_reward = feat if self.preset.reward_gradient else feat.detach()
        target = symlog(batch.rewards) if self.preset.symlog_rewards else batch.rewards
        prediction = self.reward_head(feat_reward).float().squeeze(-1)
        error = squared_error(prediction.flatten(), target.flatten())
        # nothing was received for arriving in a reset state; its stored 0 is no observation of the reward function
        arrived = (batch.mask & ~batch.is_first).flatten()
        losses = {"reward": self.preset.reward_scale * masked_mean(error, arrived)}
        if self.continue_head is not None:
            logits = self.continue_head(feat).float().squeeze(-1)
            goes_on = (~batch.is_terminal).to(logits.dtype)
            entropy = F.binary_cross_entropy_with_logits(logits, goes_on, reduction="none")
            losses["continue"] = self.preset.continue_scale * masked_mean(entropy, batch.mask)
        with th.no_grad():  # the report's measures of Fig. 10f; without any reward the relative one is 0
            rewards = batch.rewards.flatten()
            absolute = masked_mean((self._unsquashed(prediction).flatten() - rewards).abs(), arrived)
            size = masked_mean(rewards.abs(), arrived)
            relative = th.where(size > 0.0, absolute / size.clamp(min=1e-12), th.zeros_like(size))
        return losses, {"reward_error": absolute, "relative_reward_error": relative}

    def reward(self, feat: th.Tensor) -> th.Tensor:
        """Predicted reward for arriving in a state, shape ``(*batch,)``."""
        return self._unsquashed(self.reward_head(feat).float().squeeze(-1))

    def _unsquashed(self, prediction: th.Tensor) -> th.Tensor:
        """What the reward head says, on the scale of the environment."""
        return symexp(prediction) if self.preset.symlog_rewards else prediction

    def continue_probability(self, feat: th.Tensor) -> th.Tensor:
        """Predicted probability that the episode does not terminate in a state, shape ``(*batch,)``."""
        if self.continue_head is None:
            return th.ones_like(feat[..., 0])
        return th.sigmoid(self.continue_head(feat).float().squeeze(-1))

    def kl(self, state: LatentState) -> th.Tensor:
        """
        KL(posterior || prior) of every state: per step, unbalanced, before free nats. The report's KL-LOSS in u_t.

        :param state: posterior states
        :return: nats, shape ``(*batch,)``
        """
        return self.latent.kl(state.stats, self.rssm.prior(state.deter))

    def open_loop(self, state: LatentState, actions: th.Tensor) -> dict[str, th.Tensor]:
        """
        What the model expects to see if ``actions`` were executed, without looking (modes only, no random numbers).

        :param state: the state to start in, batch dimension ``(n,)``
        :param actions: shape ``(H, n, action_dim)``
        :return: decoded observations of the ``H`` states that follow, per key of shape ``(H, n, *observation_shape)``
        """
        feats = []
        for action in actions:
            state = self.rssm.imagine_step(state, action, deterministic=True)
            feats.append(state.feat)
        feat = th.stack(feats)
        return self.spec.split(self.decoder(feat.flatten(0, 1)), feat.shape[:2])
