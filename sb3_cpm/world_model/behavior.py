"""
Actor and critic that learn in imagination (report, B.1; Hafner et al. 2021, section 3): one class for the task and for
exploration, which differ in nothing but the reward that they are given.

Imagined states have indices 0..H, actions and rewards 0..H-1: action i is taken in state i, reward i is for arriving in state
i + 1, and so is return i.

The actor learns in one of three ways (preset entry ``actor_gradient``; Hafner et al. 2021, eq. 6):

* "dynamics": the gradient of the returns flows back through the learned dynamics into the actions. Little variance, and as
  good as the learned dynamics' slopes are; nothing is learnt from rewards that are flat in between steps.
* "reinforce": log-probabilities of the actions, weighted with how much better than the critic's expectation they turned out
  (Williams 1992). Needs no slopes, has more variance, and costs less: nothing is back-propagated through time.
* "both": a mixture, ``reinforce_share`` of it REINFORCE.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_cpm.presets import Preset
from sb3_cpm.world_model.by_hand.dream import Dream, DreamSettings
from sb3_cpm.world_model.by_hand.returns import Returns, through
from sb3_cpm.world_model.distributions import GaussianLatent, TruncatedNormal
from sb3_cpm.world_model.fast.acceleration import is_compiled, is_plain, mixed_precision
from sb3_cpm.world_model.fast.one_hot import OneHot
from sb3_cpm.world_model.losses import lambda_returns
from sb3_cpm.world_model.networks import MLP, frozen
from sb3_cpm.world_model.optimizer import Gradients, Optimizer
from sb3_cpm.world_model.rssm import RSSM, LatentState
from sb3_cpm.world_model.world_model import WorldModel


class Imagination(NamedTuple):
    """
    What it holds is stacked twice, since the gradient of a slice is as large as what it was cut from.

    :param feats: latents of the states 0..H-1, in which the actions are taken, shape ``(H, n, feat_dim)``
    :param actions: shape ``(H, n, action_dim)``, within [-1, 1]
    :param entropies: of the actor in these states, shape ``(H, n)``
    :param next_feats: latents of the states 1..H, in which the actions arrive, shape ``(H, n, feat_dim)``
    """

    feats: th.Tensor
    actions: th.Tensor
    entropies: th.Tensor
    next_feats: th.Tensor


RewardFunction = Callable[[Imagination], th.Tensor]


class BehaviorLosses(NamedTuple):
    """
    :param actor: the actor's loss, a detached scalar
    :param actor_gradients: of the actor's parameters
    :param critic: the critic's loss, a detached scalar
    :param critic_gradients: of the critic's parameters
    :param metrics: further numbers worth logging, detached scalars
    """

    actor: th.Tensor
    actor_gradients: Gradients
    critic: th.Tensor
    critic_gradients: Gradients
    metrics: dict[str, th.Tensor]


class Actor(nn.Module):
    """
    Latents to a truncated normal over actions in [-1, 1].

    :param feat_dim: size of the latent
    :param action_dim: number of action dimensions
    :param layers: hidden layers
    :param units: size of each of them
    :param one_hot: which of the latent's numbers are one-hot vectors
    """

    def __init__(self, feat_dim: int, action_dim: int, layers: int, units: int, one_hot: OneHot | None = None) -> None:
        super().__init__()
        self.net = MLP(feat_dim, layers, units, 2 * action_dim, one_hot)

    def forward(self, feat: th.Tensor) -> TruncatedNormal:
        return TruncatedNormal.of_outputs(self.net(feat))


class ActorCritic(nn.Module):
    """
    :param name: prefix of its log keys, "task" or "exploration"
    :param feat_dim: size of the latent
    :param action_dim: number of action dimensions
    :param preset: sizes and constants, see :mod:`sb3_cpm.presets`
    :param one_hot: which of the latent's numbers are one-hot vectors
    """

    updates: th.Tensor

    def __init__(self, name: str, feat_dim: int, action_dim: int, preset: Preset, one_hot: OneHot | None = None) -> None:
        super().__init__()
        self.name, self.preset, self.one_hot = name, preset, one_hot
        self.entropy_scale = preset.exploration_entropy_scale if name == "exploration" else preset.entropy_scale
        self.actor = Actor(feat_dim, action_dim, preset.actor_layers, preset.actor_units, one_hot)
        self.critic = self._make_critic(feat_dim)
        self.target_critic = self.critic
        if preset.slow_target:
            self.target_critic = self._make_critic(feat_dim).requires_grad_(False)
            self.target_critic.load_state_dict(self.critic.state_dict())
        self.register_buffer("updates", th.zeros((), dtype=th.long))

    def _make_critic(self, feat_dim: int) -> MLP:
        return MLP(feat_dim, self.preset.critic_layers, self.preset.critic_units, 1, self.one_hot)

    def make_optimizers(self) -> dict[str, Optimizer]:
        """Optimizers of actor and critic, by name."""
        parts = {"actor": (self.actor, self.preset.actor_lr), "critic": (self.critic, self.preset.critic_lr)}
        return {
            f"{self.name}_{part}": Optimizer(f"{self.name} {part}", [module], rate, **self.preset.optimizer_kwargs)
            for part, (module, rate) in parts.items()
        }

    def imagine(self, world_model: WorldModel, start: LatentState) -> Imagination:
        """
        Let the actor act in the world model for ``horizon`` steps.

        With ``actor_input_gradient`` the actor reads latents that carry a gradient, so that returns have their exact one,
        also through the choice of later actions. Without, it stops there, as in the code of Dreamer V1, V2 and sheeprl.

        :param world_model: supplies the dynamics; its weights get no gradient
        :param start: states to start in, batch dimension ``(n,)``, without gradient
        """
        if self._learns_by_hand(world_model, start):
            settings = DreamSettings(self.preset.horizon, self.preset.actor_input_gradient)
            layers = [layer for layer in self.actor.net if isinstance(layer, nn.Linear)]
            actor = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
            here, there, acts, outputs = Dream.apply(settings, world_model.rssm.dynamics(), start.deter, start.stoch, *actor)
            return Imagination(here, acts, TruncatedNormal.of_outputs(outputs).entropy(), there)
        states, feats, actions, policies = [start], [start.feat], [], []
        for _ in range(self.preset.horizon):
            seen = feats[-1] if self.preset.actor_input_gradient else feats[-1].detach()
            policies.append(self.actor(seen))
            actions.append(policies[-1].rsample())
            states.append(world_model.rssm.imagine_step(states[-1], actions[-1]))
            feats.append(states[-1].feat)
        # many small operations less than the entropies of single steps
        policy = TruncatedNormal(*(th.stack(part) for part in zip(*((p.loc, p.scale) for p in policies), strict=True)))
        return Imagination(
            th.stack(feats[:-1]),
            th.stack(actions),
            policy.entropy(),
            th.stack(feats[1:]),
        )

    def _learns_by_hand(self, world_model: WorldModel, start: LatentState) -> bool:
        """
        Whether gradients are computed by hand (:mod:`~sb3_cpm.world_model.by_hand`): with Gaussian latents, in plain float32
        on a CPU. They are the same as autograd's.
        """
        return (
            is_plain(start.deter)
            and isinstance(world_model.rssm, RSSM)
            and isinstance(world_model.rssm.latent, GaussianLatent)
            and not any(map(is_compiled, (world_model.rssm, self.actor.net, self.critic)))
        )

    def losses(
        self,
        world_model: WorldModel,
        start: LatentState,
        reward: RewardFunction,
        optimizers: Mapping[str, Optimizer],
        share: th.Tensor | None = None,
    ) -> BehaviorLosses:
        """
        What one update of actor and critic minimises. Looks at no number on the way: a CUDA graph can hold all of it.

        :param world_model: supplies dynamics and continuation
        :param start: states to start in, batch dimension ``(n,)``
        :param reward: differentiable, returns shape ``(H, n)`` for an imagination
        :param optimizers: those of :meth:`make_optimizers`
        :param share: how much each start counts, 1 on average, shape ``(n,)``; None where all count alike
        """
        amp, by_hand = mixed_precision(start.deter.device, self.preset.amp), self._learns_by_hand(world_model, start)
        # what the actor learns goes through world model and slow critic, which learn nothing here; by hand nobody asks
        constant = () if by_hand else (world_model, self.target_critic)
        with th.set_grad_enabled(self.preset.actor_gradient != "reinforce"), frozen(*constant):
            with amp:
                imagined = self.imagine(world_model, start)
            rewards = reward(imagined)  # (H, n), and so are returns, values and discounts: [i] of arriving in state i + 1
            gamma, lambda_ = self.preset.gamma, self.preset.lambda_
            if by_hand:
                heads = (self.target_critic, world_model.continue_head)
                returns, values, discounts = Returns.apply(rewards, imagined.next_feats, *heads, gamma, lambda_)
            else:
                with amp:
                    discounts = gamma * world_model.continue_probability(imagined.next_feats)
                    values = self.target_critic(imagined.next_feats).float().squeeze(-1)
                returns = lambda_returns(rewards, values, discounts, lambda_)
        # state i is reached with this probability: what lies behind an imagined end of the episode counts for nothing
        reached = th.cumprod(th.cat((th.ones_like(discounts[:1]), discounts[:-1])), dim=0).detach()  # (H, n)
        share = th.ones_like(reached[0]) if share is None else share  # (n,)
        weight = reached * share  # (H, n)

        objective, entropies = self._objective(imagined, returns, values)
        actor_loss = -(weight * (objective + self.entropy_scale * entropies)).mean()
        actor_gradients = optimizers[f"{self.name}_actor"].gradients(actor_loss)
        critic_loss, critic_gradients = self._critic_loss(imagined, returns.detach(), weight, optimizers, by_hand)
        means = {"imagined_reward": rewards, "imagined_return": returns, "entropy": entropies}
        metrics = {name: (share * value.detach()).mean() for name, value in means.items()}
        return BehaviorLosses(actor_loss.detach(), actor_gradients, critic_loss.detach(), critic_gradients, metrics)

    def _critic_loss(
        self,
        imagined: Imagination,
        returns: th.Tensor,
        weight: th.Tensor,
        optimizers: Mapping[str, Optimizer],
        by_hand: bool,
    ) -> tuple[th.Tensor, Gradients]:
        """
        :param imagined: what the actor did
        :param returns: of each action, shape ``(H, n)``
        :param weight: how much each counts, shape ``(H, n)``
        :param optimizers: those of :meth:`make_optimizers`
        :param by_hand: without autograd
        """
        feats = imagined.feats.detach()
        if by_hand:
            judged = through(self.critic, feats)  # of H * n rows
            error = judged.output.view_as(returns) - returns
            loss = (weight * 0.5 * error.square()).mean()
            return loss, judged.to_parameters((weight * error / error.numel()).view(-1, 1))
        with mixed_precision(feats.device, self.preset.amp):
            predicted = self.critic(feats).float().squeeze(-1)
        loss = (weight * 0.5 * (predicted - returns).square()).mean()
        return loss, optimizers[f"{self.name}_critic"].gradients(loss)

    def step(self, losses: BehaviorLosses, optimizers: Mapping[str, Optimizer]) -> dict[str, th.Tensor]:
        """
        One update of actor and critic.

        :param losses: of :meth:`losses`
        :param optimizers: those of :meth:`make_optimizers`
        :return: numbers worth logging, detached scalars
        """
        actor_norm = optimizers[f"{self.name}_actor"].step(losses.actor, losses.actor_gradients)
        critic_norm = optimizers[f"{self.name}_critic"].step(losses.critic, losses.critic_gradients)
        self._follow_slowly()
        metrics = {"actor_loss": losses.actor, "critic_loss": losses.critic}
        metrics |= {"actor_grad_norm": actor_norm, "critic_grad_norm": critic_norm, **losses.metrics}
        return {f"{self.name}_{key}": value for key, value in metrics.items()}

    def _objective(self, imagined: Imagination, returns: th.Tensor, values: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        What the actor climbs, and its entropies, each of shape ``(H, n)``.

        :param imagined: what it did
        :param returns: of each action, shape ``(H, n)``
        :param values: of the states 1..H by the slow critic, shape ``(H, n)``
        """
        kind = self.preset.actor_gradient
        if kind == "dynamics":
            return returns, imagined.entropies
        feats = imagined.feats.detach()
        with mixed_precision(feats.device, self.preset.amp):
            policy = self.actor(feats)
        with th.no_grad():
            baseline = th.cat((self.target_critic(feats[:1]).squeeze(-1), values[:-1]))  # of states 0..H-1, (H, n)
            advantage = returns - baseline
        reinforce = policy.log_prob(imagined.actions.detach()) * advantage
        if kind == "reinforce":
            return reinforce, policy.entropy()
        share = self.preset.reinforce_share
        return share * reinforce + (1.0 - share) * returns, imagined.entropies

    def _follow_slowly(self) -> None:
        """Hard copy of the critic into the slow target every ``slow_target_every`` updates."""
        self.updates += 1
        if self.preset.slow_target and int(self.updates) % self.preset.slow_target_every == 0:
            self.target_critic.load_state_dict(self.critic.state_dict())
