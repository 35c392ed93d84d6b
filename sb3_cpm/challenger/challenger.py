"""
The challenger itself: its networks, and what it does with them, act and judge. How they learn is in ``learning``.

It knows nothing of SB3's training loop: whoever conducts it hands it observations, actions and sequences. All random numbers
come from torch's global generator, so that one seed rules the run.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import get_device

from sb3_cpm.challenger.file import (
    check_sizes,
    check_storable,
    describe_observations,
    random_state,
    read_file,
    restore_random_state,
    same_observations,
    space_of,
    state_to_check,
    write_file,
)
from sb3_cpm.challenger.learning import Learner, rate_entry, real_transitions
from sb3_cpm.files import check_finite
from sb3_cpm.presets import PresetLike, make_preset
from sb3_cpm.type_aliases import Evaluation, SequenceBatch
from sb3_cpm.uncertainty import UNCERTAINTY_CLASSES, Uncertainty, choose_uncertainty
from sb3_cpm.uncertainty.base import LatentSizes, checked_novelty
from sb3_cpm.world_model.behavior import ActorCritic
from sb3_cpm.world_model.observations import ObservationSpec, check_action_space, to_tensor
from sb3_cpm.world_model.open_loop import OpenLoop, open_loop
from sb3_cpm.world_model.optimizer import Optimizer
from sb3_cpm.world_model.rssm import LatentState
from sb3_cpm.world_model.world_model import WorldModel

Array = np.ndarray | th.Tensor


class Challenger:
    """
    World model, uncertainty and exploration behaviour, with everything that trains them.

    :param observation_space: Dict space; images (3-D, with finite bounds) and vectors (1-D) are read
    :param action_space: bounded Box; here all actions are scaled to [-1, 1] (SB3's ``policy.scale_action``)
    :param device: "auto" takes the GPU where there is one
    :param preset: "default", "dreamer", "report", "report_images", a :class:`~sb3_cpm.presets.Preset` or a dict of
        entries, see :mod:`sb3_cpm.presets`
    :param keys: the observation keys to read; all images, and vectors unless the preset leaves them out, by default
    :param uncertainty_class: "plan2explore", "rnd", "prediction_error", "observation_ensemble" (see
        :mod:`sb3_cpm.uncertainty`) or a subclass of :class:`~sb3_cpm.uncertainty.base.Uncertainty`. None: the preset's
    :param uncertainty_kwargs: arguments for it, on top of the preset's
    :param overrides: single preset entries
    :raises ValueError: for spaces it cannot work with, unknown preset entries, and arguments that no file can hold
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        device: th.device | str = "auto",
        preset: PresetLike = "default",
        keys: Sequence[str] | None = None,
        uncertainty_class: str | type[Uncertainty] | None = None,
        uncertainty_kwargs: Mapping[str, Any] | None = None,
        **overrides: Any,
    ) -> None:
        self.preset = make_preset(preset, **overrides)
        self.device = choose_device(device)
        check_action_space(action_space)
        self.observation_space, self.action_space = observation_space, action_space
        self.action_dim = int(np.prod(action_space.shape))
        self.spec = ObservationSpec(
            observation_space, keys, squash=self.preset.symlog_vectors, vectors=self.preset.read_vectors
        )
        self.keys: tuple[str, ...] = self.spec.keys
        self.batch_size, self.sequence_length = self.preset.batch_size, self.preset.sequence_length

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
        if self.preset.train_exploration_behavior:
            self._uncertainty = kind(sizes, **self.uncertainty_kwargs).to(self.device)
            self._exploration = ActorCritic("exploration", *feat).to(self.device)
        self.task = ActorCritic("task", *feat).to(self.device) if self.preset.train_task_behavior else None
        self.learner = Learner(self.world_model, self._uncertainty, self.behaviors, self.preset)

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

    @property
    def optimizers(self) -> dict[str, Optimizer]:
        """By name: "world_model", "uncertainty", and actor and critic of each behaviour, such as "task_actor"."""
        return self.learner.optimizers

    @property
    def trained_updates(self) -> int:
        """How often :meth:`train` was called, in the life of these weights."""
        return self.learner.updates

    @trained_updates.setter
    def trained_updates(self, updates: int) -> None:
        self.learner.updates = updates

    @property
    def compiled(self) -> bool:
        """Whether ``compile`` was asked for and works here."""
        return self.learner.compiled

    # ---- acting ------------------------------------------------------------------------------------------------------

    def initial_state(self, n: int) -> LatentState:
        """
        What is believed before anything was seen: zeros.

        :param n: number of environments
        """
        with th.no_grad():
            return self.world_model.rssm.initial_state(n)

    @th.no_grad()
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
        first = self._tensor(is_first, th.bool)
        length, n = first.shape
        embed = self.world_model.encoder(self.spec.preprocess(observations, self.device)).unflatten(0, (length, n))
        rows = self.world_model.rssm.observe(
            embed,
            self._tensor(actions).view(length, n, self.action_dim),
            first,
            None if mask is None else self._tensor(mask, th.bool),
            state,
            deterministic,
        )
        return LatentState(*(part[-1] for part in rows))

    @th.no_grad()
    def act(
        self,
        state: LatentState,
        deterministic: bool = False,
        behavior: str = "exploration",
        noise: th.Tensor | None = None,
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
        actions = policy.rsample() if noise is None else policy.at(th.special.ndtr(noise))[0]
        return actions.cpu().numpy()

    # ---- judging -----------------------------------------------------------------------------------------------------

    @th.no_grad()
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
        rows = th.cat((th.zeros_like(taken[:1]), taken)).unsqueeze(1)
        first = th.zeros(length, 1, dtype=th.bool, device=self.device)
        first[0] = True
        embed = self.world_model.encoder(self.spec.preprocess(observations, self.device))
        if len(embed) != length:
            raise ValueError(f"An episode of {len(taken)} actions has {length} observations, got {len(embed)}.")
        posterior = self.world_model.rssm.observe(embed.unsqueeze(1), rows, first, deterministic=True)
        kl = self.world_model.kl(posterior)[1:, 0]
        transitions = real_transitions(self.world_model, posterior, rows, embed.unsqueeze(1))
        novelty = checked_novelty(self.uncertainty, transitions)[:, 0]
        if not (th.isfinite(kl).all() and th.isfinite(novelty).all()):
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
        return self.learner.train(batch)

    def _tensor(self, array: Array, dtype: th.dtype = th.float32) -> th.Tensor:
        return to_tensor(array, self.device).to(dtype)

    # ---- saving ------------------------------------------------------------------------------------------------------

    @property
    def networks(self) -> dict[str, th.nn.Module]:
        """Everything with weights, by name."""
        parts: dict[str, th.nn.Module] = {"world_model": self.world_model}
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
            state["rng"] = random_state()
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
            restore_random_state(state["rng"])

    def adopt(self, other: "Challenger") -> tuple[str, ...]:
        """
        Start from what another challenger has learnt: the networks that both have, with their optimizers; learning rates stay
        this one's.

        :param other: one that reads the same observations, with the same sizes
        :return: names of the networks that were taken over; the world model is always among them
        :raises ValueError: if it reads others, has other sizes (naming the first mismatch) or another measure of uncertainty;
            nothing is changed then
        """
        theirs, ours = describe_observations(other.spec), describe_observations(self.spec)
        if not same_observations(theirs, ours):
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
                optimizer.adopt(other.optimizers[name])
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
        theirs, ours = content["config"]["keys"], describe_observations(self.spec)
        if not same_observations(theirs, ours):
            raise ValueError(
                f"{path} was saved for the observations {theirs}, this challenger reads {ours}. (An image with neither "
                "range nor dtype is uint8 from 0 to 255.)"
            )
        self.load_state_dict(content["state"], restore_rng)
        saved = content["config"]["preset"]
        for name, optimizer in self.optimizers.items():
            entry = rate_entry(name)
            rate = getattr(self.preset, entry)
            if rate != saved[entry]:  # otherwise the file's, which a schedule may have changed
                optimizer.learning_rate = rate

    def _config(self) -> dict[str, Any]:
        """Plain data only: files are read without executing anything in them."""
        action = {"low": self.action_space.low.tolist(), "high": self.action_space.high.tolist()}
        return {
            "keys": describe_observations(self.spec),
            "action": action,
            "preset": asdict(self.preset),
            "uncertainty_class": self.uncertainty_name,
            "uncertainty_kwargs": self.uncertainty_kwargs,
        }

    @classmethod
    def load(
        cls,
        path: str | os.PathLike,
        device: th.device | str = "auto",
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
            spaces.Dict({key: space_of(entry) for key, entry in config["keys"].items()}),
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


def choose_device(device: th.device | str) -> th.device:
    """SB3's choice, but an explicit GPU that is not there is an error instead of a silent CPU."""
    try:
        wanted = th.device("cpu" if device == "auto" else device)
    except RuntimeError as error:
        raise ValueError(f"Unknown device {str(device)!r}: use 'auto', 'cpu', 'cuda' or 'cuda:1'.") from error
    if wanted.type == "cuda":
        if not th.cuda.is_available():
            raise ValueError(f"Device {str(device)!r} was asked for, but torch sees no GPU. Use device='auto' or 'cpu'.")
        if (wanted.index or 0) >= th.cuda.device_count():
            raise ValueError(f"Device {str(device)!r} was asked for, but torch sees {th.cuda.device_count()} GPU(s) only.")
    return get_device(device)
