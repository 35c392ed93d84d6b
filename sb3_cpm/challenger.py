"""
The challenger C: DreamerV2 world model, Plan2Explore ensemble, exploration actor (report, sections 4.1, 4.4.1, B.1 and B.2).

It knows nothing of SB3's training loop: whoever conducts it hands it observations, actions and sequences. All random numbers
come from torch's global generator, so that one seed rules the run.
"""

import copy
import math
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.utils import get_device

from sb3_cpm.arguments import check_arguments, check_names, nearest
from sb3_cpm.files import check_finite
from sb3_cpm.presets import make_preset, plain
from sb3_cpm.type_aliases import Evaluation, SequenceBatch
from sb3_cpm.uncertainty import UNCERTAINTY_CLASSES, Transitions, Uncertainty
from sb3_cpm.uncertainty.base import LatentSizes
from sb3_cpm.uncertainty.ensemble import Ensemble
from sb3_cpm.world_model.acceleration import check_mixed_precision, compile_modules, mixed_precision
from sb3_cpm.world_model.behavior import ActorCritic, BehaviorLosses, Imagination
from sb3_cpm.world_model.checkpoint import check_sizes, check_storable, read_file, state_to_check, write_file
from sb3_cpm.world_model.cuda_graphs import Graphed, GraphPool
from sb3_cpm.world_model.linear import frozen
from sb3_cpm.world_model.networks import MLP
from sb3_cpm.world_model.observations import Inputs, ObservationSpec, check_action_space, to_tensor
from sb3_cpm.world_model.open_loop import OpenLoop, open_loop
from sb3_cpm.world_model.optimizer import ADVICE, Gradients, Optimizer
from sb3_cpm.world_model.rssm import LatentState
from sb3_cpm.world_model.world_model import Sequences, WorldModel, WorldModelOutput

Array = np.ndarray | torch.Tensor


class Challenger:
    """
    World model, uncertainty and exploration behaviour, with everything that trains them.

    :param observation_space: Dict space; images (3-D, with finite bounds) and vectors (1-D) are read
    :param action_space: bounded Box; here all actions are scaled to [-1, 1] (SB3's ``policy.scale_action``)
    :param device: "auto" takes the GPU where there is one
    :param preset: "default", "dreamer", "report", "report_images", or a dict of entries, see :mod:`sb3_cpm.presets`
    :param keys: the observation keys to read; all images, and vectors unless the preset leaves them out, by default
    :param uncertainty_class: "plan2explore", "rnd", "prediction_error", "observation_ensemble" (see
        :mod:`sb3_cpm.uncertainty`) or a subclass of :class:`~sb3_cpm.uncertainty.base.Uncertainty`
    :param uncertainty_kwargs: arguments for it, on top of the preset's
    :param overrides: single preset entries
    :raises ValueError: for spaces it cannot work with, unknown preset entries, and arguments that no file can hold
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        device: torch.device | str = "auto",
        preset: str | Mapping[str, Any] = "default",
        keys: Sequence[str] | None = None,
        uncertainty_class: str | type[Uncertainty] = "plan2explore",
        uncertainty_kwargs: Mapping[str, Any] | None = None,
        **overrides: Any,
    ) -> None:
        self.preset = make_preset(preset, **overrides)
        self.device = choose_device(device)
        check_action_space(action_space)
        self.observation_space, self.action_space = observation_space, action_space
        self.action_dim = int(np.prod(action_space.shape))
        self.spec = ObservationSpec(
            observation_space, keys, squash=self.preset["symlog_vectors"], vectors=self.preset["read_vectors"]
        )
        self.keys: tuple[str, ...] = self.spec.keys
        self.batch_size: int = self.preset["batch_size"]
        self.sequence_length: int = self.preset["sequence_length"]
        self.trained_updates = 0

        self.world_model = WorldModel(self.spec, self.action_dim, self.preset).to(self.device)
        self.uncertainty_name, kind, self.uncertainty_kwargs = choose_uncertainty(
            uncertainty_class, uncertainty_kwargs, self.preset
        )
        check_storable("uncertainty_kwargs", self.uncertainty_kwargs)
        model = self.world_model
        sizes = LatentSizes(
            model.feat_dim, self.action_dim, model.latent.size, model.rssm.deter_size, model.embed_dim, model.latent.one_hot
        )
        feat = (model.feat_dim, self.action_dim, self.preset, model.latent.one_hot)
        self._uncertainty: Uncertainty | None = None
        self._exploration: ActorCritic | None = None
        if self.preset["train_exploration_behavior"]:
            self._uncertainty = kind(sizes, **self.uncertainty_kwargs).to(self.device)
            self._exploration = ActorCritic("exploration", *feat).to(self.device)
        self.task = ActorCritic("task", *feat).to(self.device) if self.preset["train_task_behavior"] else None
        self.optimizers = self._make_optimizers()
        if self.preset["amp"]:
            check_mixed_precision(self.device)
        self._pool: GraphPool | None = None
        self._graphs: dict[str, Graphed] = {}
        #: whether ``compile`` was asked for and works here
        self.compiled: bool = self.preset["compile"]
        if self.compiled and self.device.type == "cuda":
            self._pool = GraphPool(self.device)
        elif self.compiled:
            self.compiled = compile_modules(self._hot_modules(), self.device)

    @property
    def explores(self) -> bool:
        """Whether it has uncertainty and an exploration behaviour; ``train_exploration_behavior=False`` leaves them out."""
        return self._exploration is not None

    @property
    def uncertainty(self) -> Uncertainty:
        """:raises ValueError: for a challenger that has none"""
        if self._uncertainty is None:
            raise ValueError(_NO_EXPLORATION.format("uncertainty"))
        return self._uncertainty

    @property
    def exploration(self) -> ActorCritic:
        """:raises ValueError: for a challenger that has none"""
        if self._exploration is None:
            raise ValueError(_NO_EXPLORATION.format("exploration behaviour"))
        return self._exploration

    @property
    def behaviors(self) -> dict[str, ActorCritic]:
        """The actor-critics that it has, "exploration" and "task"."""
        both = {"exploration": self._exploration, "task": self.task}
        return {name: behavior for name, behavior in both.items() if behavior is not None}

    def _make_optimizers(self) -> dict[str, Optimizer]:
        common = {"eps": self.preset["adam_eps"], "clip": self.preset["grad_clip"]}
        common["weight_decay"] = self.preset["weight_decay"]
        optimizers = {"world_model": Optimizer("world model", [self.world_model], self.preset["model_lr"], **common)}
        if self._uncertainty is not None:
            optimizers["uncertainty"] = Optimizer("uncertainty", [self._uncertainty], self.preset["uncertainty_lr"], **common)
        for behavior in self.behaviors.values():
            optimizers.update(behavior.make_optimizers())
        return optimizers

    def _hot_modules(self) -> list[torch.nn.Module]:
        """What nearly all of the time goes into; none of it draws random numbers, and none contains another."""
        model = self.world_model
        heads = [model.reward_head, *([] if model.continue_head is None else [model.continue_head])]
        actors = [part for one in self.behaviors.values() for part in (one.actor.net, one.critic)]
        measure = () if self._uncertainty is None else self._uncertainty.modules()
        novelty = [part for part in measure if isinstance(part, (Ensemble, MLP))]
        return [model.encoder, model.decoder, model.rssm, model.rssm.prior_net, *heads, *actors, *novelty]

    # ---- acting ------------------------------------------------------------------------------------------------------

    def initial_state(self, n: int) -> LatentState:
        """
        What is believed before anything was seen: zeros.

        :param n: number of environments
        """
        with torch.no_grad():
            return self.world_model.rssm.initial_state(n)

    @torch.no_grad()
    def follow(
        self,
        state: LatentState,
        observations: Mapping[str, Array],
        actions: Array,
        is_first: Array,
        mask: Array | None = None,
        deterministic: bool = False,
    ) -> LatentState:
        """
        Let the latent state follow what happened, whoever acted.

        :param state: the state before the first row, ``n`` columns
        :param observations: per key of shape ``(L, n, *observation_shape)``
        :param actions: the action that *led to* each row, shape ``(L, n, action_dim)``, within [-1, 1]; ignored in first rows
        :param is_first: first state of an episode, shape ``(L, n)``, bool; the column forgets everything before
        :param mask: rows that exist, shape ``(L, n)``, bool; where False the column's state stays as it is
        :param deterministic: modes instead of samples, no random numbers
        :return: the state after the last row
        """
        first = self._tensor(is_first, torch.bool)
        length, n = first.shape
        embed = self.world_model.encoder(self.spec.preprocess(observations, self.device)).unflatten(0, (length, n))
        rows = self.world_model.rssm.observe(
            embed,
            self._tensor(actions).view(length, n, self.action_dim),
            first,
            None if mask is None else self._tensor(mask, torch.bool),
            state,
            deterministic,
        )
        return LatentState(*(part[-1] for part in rows))

    @torch.no_grad()
    def act(
        self,
        state: LatentState,
        deterministic: bool = False,
        behavior: str = "exploration",
        noise: torch.Tensor | None = None,
    ) -> np.ndarray:
        """
        Actions of one of its behaviours.

        :param state: latent state, ``n`` columns
        :param deterministic: the policy's mode instead of a sample
        :param behavior: "exploration" or "task"
        :param noise: standard normal numbers that the samples are made of, shape ``(n, action_dim)``, such as those of
            :class:`~sb3_cpm.world_model.correlated_noise.CorrelatedNoise`; drawn anew where None
        :return: shape ``(n, action_dim)``, within [-1, 1]
        :raises ValueError: for a behaviour that it does not have
        """
        if behavior not in self.behaviors:
            raise ValueError(
                f"This challenger has the behaviours {list(self.behaviors)}, not {behavior!r}: build it with the preset entry "
                f"'train_{behavior}_behavior': True."
            )
        policy = self.behaviors[behavior].actor(state.feat)
        if deterministic:
            return policy.mode.cpu().numpy()
        actions = policy.rsample() if noise is None else policy.at(torch.special.ndtr(noise))[0]
        return actions.cpu().numpy()

    # ---- judging -----------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def evaluate(self, observations: Mapping[str, Array], actions: Array) -> Evaluation:
        """
        Opinion of one complete episode of ``T`` transitions. It uses modes and no random numbers: the same episode gets the
        same opinion, and judging more or fewer episodes changes nothing else in a run.

        :param observations: of the states 0..T, the true last one included, per key of shape ``(T + 1, *observation_shape)``
        :param actions: action ``t`` was taken in state ``t``, shape ``(T, action_dim)``, within [-1, 1]
        :raises ValueError: for another number of observations, and where the uncertainty gives a novelty below zero that is
            said to be ``nonnegative``, or of another shape than one number per transition
        :raises RuntimeError: if KL or novelty are not finite
        """
        taken = self._tensor(actions).view(-1, self.action_dim)
        length = len(taken) + 1
        # row t + 1 holds action t, the one that led to it
        rows = torch.cat((torch.zeros_like(taken[:1]), taken)).unsqueeze(1)
        first = torch.zeros(length, 1, dtype=torch.bool, device=self.device)
        first[0] = True
        embed = self.world_model.encoder(self.spec.preprocess(observations, self.device))
        if len(embed) != length:
            raise ValueError(f"An episode of {len(taken)} actions has {length} observations, got {len(embed)}.")
        posterior = self.world_model.rssm.observe(embed.unsqueeze(1), rows, first, deterministic=True)
        kl = self.world_model.kl(posterior)[1:, 0]
        novelty = self._novelty(self._transitions(posterior, rows, embed.unsqueeze(1)))[:, 0]
        if not (torch.isfinite(kl).all() and torch.isfinite(novelty).all()):
            raise RuntimeError("KL or disagreement of an episode is not finite: are its observations and actions?")
        if self.uncertainty.nonnegative and bool((novelty < 0.0).any()):
            raise ValueError(
                f"The uncertainty {self.uncertainty_name} gave a novelty of {novelty.min():.4g}, below zero, which S, F and R "
                "do not expect. Let it return magnitudes, or set `nonnegative = False` in the class."
            )
        return Evaluation(novelty.float().cpu().numpy(), kl.clamp(min=0.0).cpu().numpy(), embed.cpu().numpy())

    def open_loop(self, observations: Mapping[str, Array], actions: Array, context: int) -> OpenLoop:
        """
        What the world model believes it would see in an episode of which it is shown the first states only.

        :param observations: of the states 0..T, or of the context only, per key of shape ``(rows, *observation_shape)``
        :param actions: action ``t`` was taken in state ``t``, shape ``(T, action_dim)``, within [-1, 1]
        :param context: how many states it is shown, at least 1
        :raises ValueError: if there are fewer states than that
        """
        taken = self._tensor(actions).view(-1, self.action_dim)
        rows = min(len(observations[self.keys[0]]), len(taken) + 1)
        if not 1 <= context <= rows:
            raise ValueError(f"`context` must lie between 1 and the episode's {rows} states, got {context}.")
        return open_loop(self.world_model, self.spec.preprocess(observations, self.device), taken, context)

    def _transitions(self, posterior: LatentState, actions: torch.Tensor, embed: torch.Tensor) -> Transitions:
        """
        Transitions between consecutive rows. State t is paired with the action in row t + 1, which was taken in it.

        :param posterior: batch dimensions ``(L, n)``
        :param actions: as in a SequenceBatch, shape ``(L, n, action_dim)``
        :param embed: shape ``(L, n, embed_dim)``
        :return: batch dimensions ``(L - 1, n)``
        """
        expectation = self.world_model.latent.mean(posterior.stats[1:])  # less noisy a target than the sample
        return Transitions(posterior.feat[:-1], actions[1:], expectation, posterior.deter[1:], embed[1:], embed[:-1])

    # ---- learning ----------------------------------------------------------------------------------------------------

    def train(self, batch: SequenceBatch) -> dict[str, float]:
        """
        One update of everything: world model, uncertainty and exploration behaviour (unless the preset leaves them out), task
        behaviour (if the preset asks for it).

        Sequences longer than any episode are fine: they run on into the next episode (``is_first`` resets the state there),
        and where nothing follows they are padded, with ``mask`` False. Padding has no influence on anything.

        :param batch: sequences; its arrays are not changed
        :return: losses and other numbers worth logging
        :raises RuntimeError: if a loss is not finite, naming the term; the parts updated before it keep their update
        """
        sequences = self._to_device(batch)
        output, gradients = self._compute("world model", self._learn_model, *sequences.inputs, *sequences[1:])
        metrics = self._step_world_model(output, gradients)
        if self.explores:
            metrics.update(self._train_uncertainty(sequences, output))
        start, share = self._fill_up(self._imagination_starts(sequences, output), sequences.mask.numel())
        for name, behavior in self.behaviors.items():
            losses = self._compute(f"{name} behaviour", partial(self._learn_behavior, name), *start, share)
            metrics.update(behavior.step(losses, self.optimizers))
        self.trained_updates += 1
        values = torch.stack([value.detach().to(torch.float32) for value in metrics.values()]).tolist()  # one transfer
        return dict(zip(metrics, values, strict=True))

    def _to_device(self, batch: SequenceBatch) -> Sequences:
        mask = self._tensor(batch.mask, torch.bool)
        if not bool(mask.any()):
            raise ValueError("The batch has no valid row: its mask is False everywhere.")
        return Sequences(
            self.spec.preprocess(batch.observations, self.device),
            self._tensor(batch.actions).view(*mask.shape, self.action_dim),
            self._tensor(batch.rewards),
            self._tensor(batch.is_first, torch.bool),
            self._tensor(batch.is_terminal, torch.bool),
            mask,
        )

    def _compute(self, name: str, function: Callable[..., Any], *inputs: torch.Tensor | None) -> Any:
        """``function(*inputs)``, by a CUDA graph where ``compile`` is asked for on a GPU."""
        if self._pool is None:
            return function(*inputs)
        if name not in self._graphs:
            self._graphs[name] = Graphed(name, function, self._pool)
        return self._graphs[name](*inputs)

    def _learn_model(
        self, images: torch.Tensor | None, vectors: torch.Tensor | None, *rest: torch.Tensor
    ) -> tuple[WorldModelOutput, Gradients]:
        """The world model's losses for the parts of :class:`Sequences`, and their sum's gradients."""
        with mixed_precision(self.device, self.preset["amp"]):
            output = self.world_model.loss(Sequences(Inputs(images, vectors), *rest))
        losses = {name: value.detach() for name, value in output.losses.items()}
        return output._replace(losses=losses), self.optimizers["world_model"].gradients(output.total)

    def _learn_behavior(
        self, name: str, deter: torch.Tensor, stoch: torch.Tensor, stats: torch.Tensor, share: torch.Tensor | None
    ) -> BehaviorLosses:
        reward = self._imagined_novelty if name == "exploration" else self._imagined_reward
        start = LatentState(deter, stoch, stats)
        return self.behaviors[name].losses(self.world_model, start, reward, self.optimizers, share)

    def _step_world_model(self, output: WorldModelOutput, gradients: Gradients) -> dict[str, torch.Tensor]:
        total = output.total
        if not torch.isfinite(total):
            broken = {name: value.item() for name, value in output.losses.items() if not math.isfinite(value.item())}
            raise RuntimeError(
                f"The world model's loss became non-finite in the terms {broken or 'that are summed'}. {ADVICE}"
            )
        norm = self.optimizers["world_model"].step(total, gradients)
        losses = {f"{name}_loss": value for name, value in output.losses.items()}
        return {"world_model_loss": total, **losses, **output.metrics, "world_model_grad_norm": norm}

    def _train_uncertainty(self, batch: Sequences, output: WorldModelOutput) -> dict[str, torch.Tensor]:
        transitions = self._transitions(output.posterior, batch.actions, output.embed)
        # neither into padding nor from the last state of one episode to the first of the next
        valid = batch.mask[1:] & batch.mask[:-1] & ~batch.is_first[1:]
        transitions = transitions.flatten() if bool(valid.all()) else transitions.select(valid)  # the one copies nothing
        if not len(transitions.feat):
            return {}
        loss = self.uncertainty.loss(transitions)
        norm = self.optimizers["uncertainty"].step(loss)
        return {"uncertainty_loss": loss, "uncertainty_grad_norm": norm, **self.uncertainty.adapt(transitions)}

    def _imagination_starts(self, batch: Sequences, output: WorldModelOutput) -> LatentState:
        """Posterior states to imagine from: rows that exist and do not end an episode, all or a random choice of them."""
        valid = batch.mask & ~batch.is_terminal
        index = (valid if bool(valid.any()) else batch.mask).flatten().nonzero().squeeze(1)
        limit = self.preset["imagination_starts"]
        if limit is not None and len(index) > limit:
            index = index[torch.randperm(len(index), device=self.device)[:limit]]
        return output.posterior.flatten().select(index)

    def _fill_up(self, start: LatentState, rows: int) -> tuple[LatentState, torch.Tensor | None]:
        """
        CUDA graphs need the same number of states every time.

        :param start: states to imagine from
        :param rows: of the batch that they are from
        :return: the states and more of them, which count for nothing, and how much each counts; None where all count alike
        """
        if self._pool is None:
            return start, None
        limit = self.preset["imagination_starts"]
        n, place = len(start.deter), torch.arange(rows if limit is None else min(limit, rows), device=self.device)
        return start.select(place % n), (place < n) * (len(place) / n)

    def _imagined_novelty(self, imagined: Imagination) -> torch.Tensor:
        stoch = self.world_model.latent.size
        next_stoch, next_deter = imagined.next_feats[..., :stoch], imagined.next_feats[..., stoch:]
        return self._novelty(Transitions(imagined.feats, imagined.actions, next_stoch, next_deter))

    def _novelty(self, transitions: Transitions) -> torch.Tensor:
        """:raises ValueError: unless the uncertainty gives a number per transition: others might be broadcast unnoticed"""
        novelty, expected = self.uncertainty.novelty(transitions), transitions.feat.shape[:-1]
        if novelty.shape != expected:
            raise ValueError(
                f"The uncertainty {self.uncertainty_name} gave a novelty of shape {tuple(novelty.shape)} for transitions of "
                f"shape {tuple(expected)}: it must be one number for each."
            )
        return novelty

    def _imagined_reward(self, imagined: Imagination) -> torch.Tensor:
        with frozen(self.world_model.reward_head):
            return self.world_model.reward(imagined.next_feats)

    def _tensor(self, array: Array, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return to_tensor(array, self.device).to(dtype)

    # ---- saving ------------------------------------------------------------------------------------------------------

    @property
    def networks(self) -> dict[str, torch.nn.Module]:
        """Everything with weights, by name."""
        parts: dict[str, torch.nn.Module] = {"world_model": self.world_model}
        if self._uncertainty is not None:
            parts["uncertainty"] = self._uncertainty
        return {**parts, **self.behaviors}

    def state_dict(self, include_rng: bool = True) -> dict[str, Any]:
        """
        Networks, optimizers, scales and counters.

        :param include_rng: also torch's global random state
        """
        state: dict[str, Any] = {
            "networks": {name: network.state_dict() for name, network in self.networks.items()},
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "trained_updates": self.trained_updates,
        }
        if include_rng:
            cuda = [rng.cpu() for rng in torch.cuda.get_rng_state_all()] if torch.cuda.is_available() else []
            state["rng"] = {"cpu": torch.get_rng_state(), "cuda": cuda}
        return state

    def load_state_dict(self, state: Mapping[str, Any], restore_rng: bool = False) -> None:
        """
        :param state: of :meth:`state_dict`
        :param restore_rng: also set torch's global random state, where the state has one
        :raises ValueError: if it belongs to a challenger of other sizes, naming the first mismatch; nothing is changed then
        """
        for name, network in self.networks.items():
            check_sizes(name, network.state_dict(), state["networks"].get(name, {}))
        for name, network in self.networks.items():
            network.load_state_dict(state["networks"][name])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.trained_updates = int(state["trained_updates"])
        if restore_rng and "rng" in state:
            torch.set_rng_state(state["rng"]["cpu"].cpu())
            if torch.cuda.is_available() and len(state["rng"]["cuda"]) == torch.cuda.device_count():
                torch.cuda.set_rng_state_all([rng.cpu() for rng in state["rng"]["cuda"]])

    def adopt(self, other: "Challenger") -> tuple[str, ...]:
        """
        Start from what another challenger has learnt: the networks that both have, with their optimizers; learning rates stay
        this one's.

        :param other: one that reads the same observations, with the same sizes
        :return: names of the networks that were taken over; the world model is always among them
        :raises ValueError: if it reads others, has other sizes (naming the first mismatch) or another measure of uncertainty;
            nothing is changed then
        """
        theirs, ours = other._config()["keys"], self._config()["keys"]
        if not _same_observations(theirs, ours):
            raise ValueError(f"The one to start from reads the observations {theirs}, this one reads {ours}.")
        names = tuple(name for name in self.networks if name in other.networks)
        if "uncertainty" in names and self.uncertainty_name != other.uncertainty_name:
            raise ValueError(
                f"The one to start from has the uncertainty {other.uncertainty_name}, not {self.uncertainty_name}."
            )
        for name in names:
            check_sizes(name, self.networks[name].state_dict(), other.networks[name].state_dict())
        for name in names:
            self.networks[name].load_state_dict(other.networks[name].state_dict())
        for name, optimizer in self.optimizers.items():
            if name in other.optimizers:
                rates = [group["lr"] for group in optimizer.adam.param_groups]
                optimizer.load_state_dict(copy.deepcopy(other.optimizers[name].state_dict()))  # torch would share the moments
                for group, rate in zip(optimizer.adam.param_groups, rates, strict=True):
                    group["lr"] = rate
        self.trained_updates = other.trained_updates
        return names

    def save(self, path: str | os.PathLike, include_rng: bool = True) -> None:
        """
        Write everything to one file; a file that is there already is replaced only by a complete one.

        :param path: of the file
        :param include_rng: also torch's global random state
        :raises RuntimeError: if a weight is not finite; the last good file is kept then
        :raises OSError: if the disk does not take it; the last good file is kept then, too
        """
        state = self.state_dict(include_rng)
        check_finite(path, "challenger", state_to_check(state))
        write_file(path, {"config": self._config(), "state": state})

    def load_state(self, path: str | os.PathLike, restore_rng: bool = False) -> None:
        """
        Take over what :meth:`save` wrote, in a challenger that was built for the same spaces and preset. Where its preset has
        another learning rate than the saved one's, it keeps its own.

        :param path: of the file
        :param restore_rng: also set torch's global random state
        :raises ValueError: for damaged or foreign files, for weights that are not finite, and for challengers of other keys or
            sizes; nothing is changed then
        """
        content = read_file(path, self.device)
        theirs, ours = content["config"]["keys"], self._config()["keys"]
        if not _same_observations(theirs, ours):
            raise ValueError(
                f"{path} was saved for the observations {theirs}, this challenger reads {ours}. (An image with neither "
                "range nor dtype is uint8 from 0 to 255.)"
            )
        self.load_state_dict(content["state"], restore_rng)
        saved = content["config"]["preset"]
        for name, optimizer in self.optimizers.items():
            entry = rate_entry(name)
            if self.preset[entry] != saved[entry]:  # otherwise the file's, which a schedule may have changed
                for group in optimizer.adam.param_groups:
                    group["lr"] = self.preset[entry]

    def _config(self) -> dict[str, Any]:
        """Plain data only: files are read without executing anything in them."""
        keys: dict[str, dict[str, Any]] = {
            key: {"shape": list(self.spec.shapes[key]), "image": key in self.spec.image_keys} for key in self.keys
        }
        for key, limits in self.spec.ranges.items():
            if not self.spec.is_full_uint8(key):  # what is not written is uint8 from 0 to 255
                keys[key].update(range=list(limits), dtype=self.spec.dtypes[key])
        action = {"low": self.action_space.low.tolist(), "high": self.action_space.high.tolist()}
        return {
            "keys": keys,
            "action": action,
            "preset": self.preset,
            "uncertainty_class": self.uncertainty_name,
            "uncertainty_kwargs": self.uncertainty_kwargs,
        }

    @classmethod
    def load(
        cls,
        path: str | os.PathLike,
        device: torch.device | str = "auto",
        uncertainty_class: type[Uncertainty] | None = None,
        restore_rng: bool = False,
    ) -> "Challenger":
        """
        A challenger from a file of :meth:`save`.

        :param path: of the file
        :param device: may be another one than it was saved from
        :param uncertainty_class: needed where it was built with a class of your own
        :param restore_rng: also set torch's global random state
        :raises ValueError: for files that are damaged or something else, and for weights that are not finite
        """
        target = choose_device(device)
        content = read_file(path, target)
        config = content["config"]
        name = config["uncertainty_class"]
        if uncertainty_class is None and name not in UNCERTAINTY_CLASSES:
            raise ValueError(
                f"{path} was saved with the uncertainty class {name}, and a file cannot hold a class: "
                f"Challenger.load({str(path)!r}, uncertainty_class={name}) loads it, also for `start_from`."
            )
        challenger = cls(
            spaces.Dict({key: _space(entry) for key, entry in config["keys"].items()}),
            spaces.Box(np.float32(config["action"]["low"]), np.float32(config["action"]["high"])),
            target,
            config["preset"],
            tuple(config["keys"]),
            name if uncertainty_class is None else uncertainty_class,
            config["uncertainty_kwargs"],
        )
        challenger.load_state_dict(content["state"], restore_rng)
        return challenger


_NO_EXPLORATION = "This challenger has no {}: it was built with the preset entry 'train_exploration_behavior': False."


def rate_entry(optimizer: str) -> str:
    """
    :param optimizer: name of one of a challenger's optimizers
    :return: the preset entry that has its learning rate
    """
    return {"world_model": "model_lr", "uncertainty": "uncertainty_lr"}.get(optimizer, f"{optimizer.split('_')[-1]}_lr")


def _same_observations(theirs: Mapping[str, Mapping[str, Any]], ours: Mapping[str, Mapping[str, Any]]) -> bool:
    """
    Whether two configurations read the same keys in the same way. Of dtypes only uint8 matters, everything else is read as
    float32: files from before the dtype was written, where it was none, fit as well.
    """

    def comparable(keys: Mapping[str, Mapping[str, Any]]) -> list[tuple[Any, ...]]:
        return [
            (
                key,
                tuple(entry["shape"]),
                entry["image"],
                entry.get("dtype") == "uint8",
                tuple(float(np.float32(limit)) for limit in entry.get("range", ())),
            )
            for key, entry in keys.items()
        ]

    return comparable(theirs) == comparable(ours)


def _space(entry: Mapping[str, Any]) -> spaces.Box:
    if "range" in entry:
        low, high = entry["range"]
        return spaces.Box(low, high, tuple(entry["shape"]), np.dtype(entry.get("dtype", "float32")).type)
    if entry["image"]:
        return spaces.Box(0, 255, tuple(entry["shape"]), np.uint8)
    return spaces.Box(-np.inf, np.inf, tuple(entry["shape"]), np.float32)


def check_uncertainties(preset: Mapping[str, Any]) -> None:
    """
    :param preset: a complete one
    :raises ValueError: for classes and arguments in its entry 'uncertainty' that there are not, with the nearest
    """
    where = "Preset entry 'uncertainty'"
    # a class of one's own has its module in its name, and may take its arguments in any way
    known = {name: arguments for name, arguments in preset["uncertainty"].items() if "." not in name}
    check_names(where, known, UNCERTAINTY_CLASSES)
    for name, arguments in known.items():
        check_arguments(f"{where}, {name}", arguments, UNCERTAINTY_CLASSES[name], excluded=("sizes",))


def choose_uncertainty(
    kind: str | type[Uncertainty], kwargs: Mapping[str, Any] | None, preset: Mapping[str, Any]
) -> tuple[str, type[Uncertainty], dict[str, Any]]:
    """
    :param kind: ``uncertainty_class`` of :class:`Challenger`
    :param kwargs: ``uncertainty_kwargs``
    :param preset: a complete one
    :return: its name in checkpoints, the class, and its arguments: the preset's with ``kwargs`` on top
    :raises ValueError: for names that there are not, with the nearest, also of arguments in the preset
    """
    check_uncertainties(preset)
    if isinstance(kind, str):
        if kind not in UNCERTAINTY_CLASSES:
            raise ValueError(
                f"Unknown uncertainty class {kind!r}.{nearest(kind, UNCERTAINTY_CLASSES)} Valid: "
                f"{sorted(UNCERTAINTY_CLASSES)} or a class."
            )
        check_arguments("uncertainty_kwargs", kwargs, UNCERTAINTY_CLASSES[kind], excluded=("sizes",))
        return kind, UNCERTAINTY_CLASSES[kind], plain({**preset["uncertainty"].get(kind, {}), **(kwargs or {})})
    if not (isinstance(kind, type) and issubclass(kind, Uncertainty)):
        raise ValueError(f"`uncertainty_class` must be a name or a subclass of Uncertainty, got {kind!r}.")
    return f"{kind.__module__}.{kind.__qualname__}", kind, plain(dict(kwargs or {}))


def choose_device(device: torch.device | str) -> torch.device:
    """SB3's choice, but an explicit GPU that is not there is an error instead of a silent CPU."""
    try:
        wanted = torch.device("cpu" if device == "auto" else device)
    except RuntimeError as error:
        raise ValueError(f"Unknown device {str(device)!r}: use 'auto', 'cpu', 'cuda' or 'cuda:1'.") from error
    if wanted.type == "cuda":
        if not torch.cuda.is_available():
            raise ValueError(f"Device {str(device)!r} was asked for, but torch sees no GPU. Use device='auto' or 'cpu'.")
        if (wanted.index or 0) >= torch.cuda.device_count():
            raise ValueError(f"Device {str(device)!r} was asked for, but torch sees {torch.cuda.device_count()} GPU(s) only.")
    return get_device(device)
