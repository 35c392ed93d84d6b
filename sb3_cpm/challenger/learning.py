"""How a challenger learns: one update of world model, uncertainty and behaviours from a batch of sequences."""

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import torch as th
from torch import nn

from sb3_cpm.challenger.log_names import short_names
from sb3_cpm.presets import Preset
from sb3_cpm.type_aliases import SequenceBatch
from sb3_cpm.uncertainty.base import Transitions, Uncertainty, checked_novelty
from sb3_cpm.uncertainty.ensemble import Ensemble
from sb3_cpm.world_model.behavior import ActorCritic, BehaviorLosses, Imagination
from sb3_cpm.world_model.fast.acceleration import check_mixed_precision, compile_modules, mixed_precision
from sb3_cpm.world_model.fast.cuda_graphs import GraphedFunctions
from sb3_cpm.world_model.networks import MLP, frozen
from sb3_cpm.world_model.observations import Inputs, to_tensor
from sb3_cpm.world_model.optimizer import ADVICE, Gradients, Optimizer
from sb3_cpm.world_model.rssm import LatentState
from sb3_cpm.world_model.world_model import Sequences, WorldModel, WorldModelOutput


class Learner:
    """
    Everything that trains a challenger's networks.

    :param world_model: learns from all batches
    :param uncertainty: learns from the latents' transitions; None where nothing is explored
    :param behaviors: actor-critics by name, "exploration" and "task"; they learn in imagination
    :param preset: their sizes and constants
    :raises ValueError: if the preset asks for mixed precision on a GPU that has none
    """

    def __init__(
        self,
        world_model: WorldModel,
        uncertainty: Uncertainty | None,
        behaviors: Mapping[str, ActorCritic],
        preset: Preset,
    ) -> None:
        self.world_model, self.uncertainty, self.behaviors = world_model, uncertainty, behaviors
        self.preset = preset
        self.updates = 0
        self._log_names = {f"error_{key}": f"error_{name}" for key, name in short_names(world_model.spec.keys).items()}
        self.optimizers = self._make_optimizers()
        if preset.amp:
            check_mixed_precision(self.device)
        #: CUDA graphs of whole updates; None unless ``compile`` is asked for on a GPU
        self.graphs: GraphedFunctions | None = None
        #: whether ``compile`` was asked for and works here
        self.compiled: bool = preset.compile
        if self.compiled and self.device.type == "cuda":
            self.graphs = GraphedFunctions(self.device)
        elif self.compiled:
            self.compiled = compile_modules(self._hot_modules(), self.device)

    @property
    def device(self) -> th.device:
        """Where all networks are."""
        return next(self.world_model.parameters()).device

    def _make_optimizers(self) -> dict[str, Optimizer]:
        common = self.preset.optimizer_kwargs
        optimizers = {"world_model": Optimizer("world model", [self.world_model], self.preset.model_lr, **common)}
        if self.uncertainty is not None:
            optimizers["uncertainty"] = Optimizer("uncertainty", [self.uncertainty], self.preset.uncertainty_lr, **common)
        for behavior in self.behaviors.values():
            optimizers.update(behavior.make_optimizers())
        return optimizers

    def _hot_modules(self) -> list[nn.Module]:
        """What nearly all of the time goes into; none of it draws random numbers, and none contains another."""
        model = self.world_model
        heads = [model.reward_head, *([] if model.continue_head is None else [model.continue_head])]
        actors = [part for one in self.behaviors.values() for part in (one.actor.net, one.critic)]
        measure: Iterable[nn.Module] = () if self.uncertainty is None else self.uncertainty.modules()
        novelty = [part for part in measure if isinstance(part, (Ensemble, MLP))]
        return [model.encoder, model.decoder, model.rssm, model.rssm.prior_net, *heads, *actors, *novelty]

    def train(self, batch: SequenceBatch) -> dict[str, float]:
        """
        One update of everything, see :meth:`Challenger.train <sb3_cpm.challenger.Challenger.train>`.

        :param batch: sequences; its arrays are not changed
        :return: losses and other numbers worth logging
        :raises RuntimeError: if a loss is not finite, naming the term; the parts updated before it keep their update
        """
        sequences = self.to_device(batch)
        output, gradients = self._run("world model", self.learn_model, *sequences.inputs, *sequences[1:])
        metrics = self._step_world_model(output, gradients)
        metrics.update(self.train_uncertainty(sequences, output))
        start, share = self._fill_up(self.imagination_starts(sequences, output), sequences.mask.numel())
        for name, behavior in self.behaviors.items():
            losses = self._run(f"{name} behaviour", partial(self.learn_behavior, name), *start, share)
            metrics.update(behavior.step(losses, self.optimizers))
        self.updates += 1
        values = th.stack([value.detach().to(th.float32) for value in metrics.values()]).tolist()  # one transfer
        return dict(zip((self._log_names.get(name, name) for name in metrics), values, strict=True))

    def _run(self, name: str, function: Callable[..., Any], *inputs: th.Tensor | None) -> Any:
        return function(*inputs) if self.graphs is None else self.graphs.run(name, function, *inputs)

    def to_device(self, batch: SequenceBatch) -> Sequences:
        """:raises ValueError: if the batch has no valid row"""
        mask = to_tensor(batch.mask, self.device).to(th.bool)
        if not bool(mask.any()):
            raise ValueError("The batch has no valid row: its mask is False everywhere.")
        return Sequences(
            self.world_model.spec.preprocess(batch.observations, self.device),
            to_tensor(batch.actions, self.device).to(th.float32).view(*mask.shape, self.world_model.action_dim),
            to_tensor(batch.rewards, self.device).to(th.float32),
            to_tensor(batch.is_first, self.device).to(th.bool),
            to_tensor(batch.is_terminal, self.device).to(th.bool),
            mask,
        )

    # ---- world model -------------------------------------------------------------------------------------------------

    def learn_model(
        self, images: th.Tensor | None, vectors: th.Tensor | None, *rest: th.Tensor
    ) -> tuple[WorldModelOutput, Gradients]:
        """The world model's losses for the parts of :class:`Sequences`, and their sum's gradients."""
        with mixed_precision(self.device, self.preset.amp):
            output = self.world_model.loss(Sequences(Inputs(images, vectors), *rest))
        losses = {name: value.detach() for name, value in output.losses.items()}
        return output._replace(losses=losses), self.optimizers["world_model"].gradients(output.total)

    def _step_world_model(self, output: WorldModelOutput, gradients: Gradients) -> dict[str, th.Tensor]:
        total = output.total
        if not th.isfinite(total):
            broken = {name: value.item() for name, value in output.losses.items() if not math.isfinite(value.item())}
            raise RuntimeError(
                f"The world model's loss became non-finite in the terms {broken or 'that are summed'}. {ADVICE}"
            )
        norm = self.optimizers["world_model"].step(total, gradients)
        losses = {f"{name}_loss": value for name, value in output.losses.items()}
        return {"world_model_loss": total, **losses, **output.metrics, "world_model_grad_norm": norm}

    # ---- uncertainty -------------------------------------------------------------------------------------------------

    def train_uncertainty(self, batch: Sequences, output: WorldModelOutput) -> dict[str, th.Tensor]:
        """
        :param batch: sequences
        :param output: what the world model made of them
        :return: numbers worth logging; none where nothing is explored or the batch has no transition
        """
        if self.uncertainty is None:
            return {}
        transitions = real_transitions(self.world_model, output.posterior, batch.actions, output.embed)
        # neither into padding nor from the last state of one episode to the first of the next
        valid = batch.mask[1:] & batch.mask[:-1] & ~batch.is_first[1:]
        transitions = transitions.flatten() if bool(valid.all()) else transitions.select(valid)  # the one copies nothing
        if not len(transitions.feat):
            return {}
        loss = self.uncertainty.loss(transitions)
        norm = self.optimizers["uncertainty"].step(loss)
        return {"uncertainty_loss": loss, "uncertainty_grad_norm": norm, **self.uncertainty.adapt(transitions)}

    # ---- behaviours --------------------------------------------------------------------------------------------------

    def imagination_starts(self, batch: Sequences, output: WorldModelOutput) -> LatentState:
        """Posterior states to imagine from: rows that exist and do not end an episode, all or a random choice of them."""
        valid = batch.mask & ~batch.is_terminal
        index = (valid if bool(valid.any()) else batch.mask).flatten().nonzero().squeeze(1)
        limit = self.preset.imagination_starts
        if limit is not None and len(index) > limit:
            index = index[th.randperm(len(index), device=self.device)[:limit]]
        return output.posterior.flatten().select(index)

    def _fill_up(self, start: LatentState, rows: int) -> tuple[LatentState, th.Tensor | None]:
        """
        CUDA graphs need the same number of states every time.

        :param start: states to imagine from
        :param rows: of the batch that they are from
        :return: the states and more of them, which count for nothing, and how much each counts; None where all count alike
        """
        if self.graphs is None:
            return start, None
        limit = self.preset.imagination_starts
        n, place = len(start.deter), th.arange(rows if limit is None else min(limit, rows), device=self.device)
        return start.select(place % n), (place < n) * (len(place) / n)

    def learn_behavior(
        self, name: str, deter: th.Tensor, stoch: th.Tensor, stats: th.Tensor, share: th.Tensor | None
    ) -> BehaviorLosses:
        """
        :param name: of the behaviour
        :param deter: with ``stoch`` and ``stats`` the states to start in, see :class:`LatentState`
        :param share: how much each start counts, 1 on average, shape ``(n,)``; None where all count alike
        """
        reward = self.imagined_novelty if name == "exploration" else self.imagined_reward
        start = LatentState(deter, stoch, stats)
        return self.behaviors[name].losses(self.world_model, start, reward, self.optimizers, share)

    def imagined_novelty(self, imagined: Imagination) -> th.Tensor:
        """The exploration actor's reward, shape ``(H, n)``."""
        assert self.uncertainty is not None, "who explores has a measure of novelty"
        stoch = self.world_model.latent.size
        next_stoch, next_deter = imagined.next_feats[..., :stoch], imagined.next_feats[..., stoch:]
        return checked_novelty(self.uncertainty, Transitions(imagined.feats, imagined.actions, next_stoch, next_deter))

    def imagined_reward(self, imagined: Imagination) -> th.Tensor:
        """The task actor's reward, shape ``(H, n)``."""
        with frozen(self.world_model.reward_head):
            return self.world_model.reward(imagined.next_feats)


def real_transitions(world_model: WorldModel, posterior: LatentState, actions: th.Tensor, embed: th.Tensor) -> Transitions:
    """
    Transitions between consecutive rows. State t is paired with the action in row t + 1, which was taken in it.

    :param world_model: whose latents these are
    :param posterior: batch dimensions ``(L, n)``
    :param actions: as in a SequenceBatch, shape ``(L, n, action_dim)``
    :param embed: shape ``(L, n, embed_dim)``
    :return: batch dimensions ``(L - 1, n)``
    """
    expectation = world_model.latent.mean(posterior.stats[1:])  # less noisy a target than the sample
    return Transitions(posterior.feat[:-1], actions[1:], expectation, posterior.deter[1:], embed[1:], embed[:-1])


def rate_entry(optimizer: str) -> str:
    """
    :param optimizer: name of one of a challenger's optimizers
    :return: the preset entry that has its learning rate
    """
    return {"world_model": "model_lr", "uncertainty": "uncertainty_lr"}.get(optimizer, f"{optimizer.split('_')[-1]}_lr")
