"""
GAIL (Ho & Ermon 2016) beside a stock off-policy agent of Stable-Baselines3, as the winners of ManiSkill 2021 have it (Shen
et al. 2022): a discriminator that learns between rollouts, rewards that are computed when the player samples, and an expert
who is joined by the player's own successes.
"""

import math
import sys
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cpm.arguments import (
    ABOVE_0,
    AT_LEAST_0,
    SHARE,
    check,
    check_arguments,
    check_each,
    choice,
    error_prefix,
    integer,
    names_checked,
    nearest,
    number,
)
from sb3_cpm.buffers import CPMBuffer, Demonstration, Episode, EpisodeBuffer
from sb3_cpm.buffers.compact import StorageSpec
from sb3_cpm.buffers.demonstrations import as_arrays
from sb3_cpm.files import Archive, check_finite, write_archive
from sb3_cpm.imitation.callback import demonstrations_for
from sb3_cpm.imitation.discriminator import DISCRIMINATORS, Discriminator, Observations, softplus_reward
from sb3_cpm.imitation.instance_buffer import ANY, InstanceBuffer
from sb3_cpm.imitation.loading import Source
from sb3_cpm.packing import pack, unpack
from sb3_cpm.player import max_episode_steps
from sb3_cpm.randomness import own_randomness
from sb3_cpm.stateful import StatefulCallback
from sb3_cpm.training_env import learns, success_of

#: Expert rows that the scale of a discriminator's inputs is taken from.
SCALE_ROWS = 4096
#: Episodes of the player per demonstrated object, after which all should have been shown: of k that are equally likely, one is
#: missing with a probability below k * exp(-10).
EPISODES_PER_INSTANCE = 10
#: What presets set, unless it is given: the paper's sizes, for GPUs, and some that two cores can bear.
PRESETS: dict[str, dict[str, Any]] = {
    "default": {"batch_size": 1024, "quota": 30_000, "progressive": {}},
    "small": {
        "batch_size": 128,
        "quota": 2000,
        "progressive": {"sizes": (32, 64), "embed": 64, "head_size": 16, "blocks": 1},
    },
}


@dataclass(frozen=True)
class Played:
    """
    An episode of the player that has ended. Steps are numbered as the player's buffer counts them, from its first on: where
    an episode begins is the buffer's to say, which also ends those that a checkpoint or another ``learn()`` cuts.

    :param env_idx: environment that it was played in
    :param last_step: number of its last step
    :param successes: numbers of steps that led to a success, in order; the first may be of an episode that was cut
    :param instance: which object it was about, as the environment names it
    """

    env_idx: int
    last_step: int
    successes: list[int]
    instance: str | None


class GAILCallback(StatefulCallback):
    """
    Generative adversarial imitation for SAC, TD3, TQC or DDPG with a :class:`~sb3_cpm.buffers.CPMBuffer`
    (``challenge_ratio=0``) or an :class:`~sb3_cpm.buffers.EpisodeBuffer`::

        model = SAC("MultiInputPolicy", env, replay_buffer_class=CPMBuffer, replay_buffer_kwargs={"challenge_ratio": 0})
        model.learn(100_000, callback=GAILCallback(demonstrations="expert", n_episodes=100))

    The player's rewards are ``env_reward * r + expert_reward * softplus(f)``, f being the discriminator's logit, whenever it
    samples; what is stored stays the task's. Every ``episodes_per_round`` episodes the discriminator makes
    ``gradient_steps`` updates on these episodes and as many rows of the expert. That is the demonstrations, and the player's
    own episodes with a success (``self_imitation``), in a ring per object (``balance``).

    Numbers in brackets are the paper's. Its methods: I is ``self_imitation=False`` with ``grow=(0, 0)``, II the same with
    growth, III ``balance=False``, IV ``grow=(0, 0)``, V all of it, VI ``env_reward=0.5`` on top.

    :param demonstrations: ``"expert"``, a file, or a list, see :func:`~sb3_cpm.imitation.load_demonstrations`
    :param n_episodes: how many; None: all that there are
    :param hold: whether an expert goes on to the end of the episode. It should where the player's episodes do
    :param discriminator_class: "vector", "progressive" (clouds of labelled parts), or a subclass of
        :class:`~sb3_cpm.imitation.discriminator.Discriminator`
    :param discriminator_kwargs: its arguments
    :param preset: sizes of the progressive discriminator, ``batch_size`` and ``quota``: "default" (the paper's, for GPUs) or
        "small"
    :param keys: observation keys that the discriminator reads; None: what it chooses
    :param env_reward: weight of the environment's reward [0; 0.5 with dense ones]
    :param expert_reward: weight of the discriminator's [1]
    :param reward: "softplus" [-log D], which is never negative, or "logit", f itself, of either sign, for tasks whose episodes
        end with success
    :param episodes_per_round: episodes between the discriminator's updates [8]
    :param gradient_steps: updates then [5]
    :param batch_size: rows of the expert in an update, and as many of the player [1024]; None: the preset's
    :param recent_transitions: at most so many of the round are learnt from, the newest [6000]
    :param quota: transitions of a ring [30,000]; None: the preset's
    :param max_instances: refuse more objects than that
    :param keep_demonstrations: share of a ring that demonstrations are not pushed out of [0]
    :param self_imitation: whether the player's successes join the expert
    :param balance: a ring per object, equally sampled; False: one for all
    :param demonstrations_for_player: whether the player's buffer gets the demonstrations, too, with the same rewards
    :param learning_rate: of the discriminator's Adam [5e-4]
    :param weight_decay: of it [5e-6]
    :param gradient_penalty: weight of a penalty on interpolated rows [0]
    :param label_smoothing: [0]
    :param storage_dtypes: compact storage in the rings, see :class:`~sb3_cpm.buffers.CPMBuffer`
    :param seed: of an expert, and of the discriminator's own random numbers; None: the model's
    :param load_path: of :meth:`save`, to start from
    :param device: PyTorch device of the discriminator; "auto": the model's
    :param verbose: as SB3's callbacks have it
    :raises ValueError: for arguments that cannot work; in ``learn()``, before any training, for models that this cannot work
        with, and demonstrations that do not fit
    """

    @names_checked()
    def __init__(
        self,
        demonstrations: Source = "expert",
        n_episodes: int | None = 100,
        hold: bool = True,
        discriminator_class: str | type[Discriminator] = "progressive",
        discriminator_kwargs: dict[str, Any] | None = None,
        preset: str = "default",
        keys: Sequence[str] | None = None,
        env_reward: float = 0.0,
        expert_reward: float = 1.0,
        reward: Literal["softplus", "logit"] = "softplus",
        episodes_per_round: int = 8,
        gradient_steps: int = 5,
        batch_size: int | None = None,
        recent_transitions: int = 6000,
        quota: int | None = None,
        max_instances: int | None = None,
        keep_demonstrations: float = 0.0,
        self_imitation: bool = True,
        balance: bool = True,
        demonstrations_for_player: bool = True,
        learning_rate: float = 5e-4,
        weight_decay: float = 5e-6,
        gradient_penalty: float = 0.0,
        label_smoothing: float = 0.0,
        storage_dtypes: dict[str, StorageSpec] | None = None,
        seed: int | None = None,
        load_path: str | Path | None = None,
        device: th.device | str = "auto",
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        check("preset", preset, choice(*PRESETS))
        check("reward", reward, choice("softplus", "logit"))
        sizes = PRESETS[preset]
        self.batch_size = sizes["batch_size"] if batch_size is None else batch_size
        quota = sizes["quota"] if quota is None else quota
        for name, value in (("n_episodes", n_episodes), ("max_instances", max_instances)):
            if value is not None:
                check(name, value, integer(1))
        check_each(integer(1), episodes_per_round=episodes_per_round, gradient_steps=gradient_steps, quota=quota)
        check_each(integer(1), batch_size=self.batch_size, recent_transitions=recent_transitions)
        check_each(AT_LEAST_0, env_reward=env_reward, expert_reward=expert_reward, gradient_penalty=gradient_penalty)
        check("keep_demonstrations", keep_demonstrations, SHARE)
        check(
            "label_smoothing",
            label_smoothing,
            number("a number from 0 up to, but without 0.5", lambda value: 0.0 <= value < 0.5),
        )
        check("learning_rate", learning_rate, ABOVE_0)
        check("weight_decay", weight_decay, AT_LEAST_0)
        if env_reward == 0 and expert_reward == 0:
            raise ValueError(
                "env_reward and expert_reward are both 0: the player would learn from nothing. Give one a weight."
            )
        self.discriminator_class = _class_of(discriminator_class)
        kwargs = dict(discriminator_kwargs or {})
        if self.discriminator_class is DISCRIMINATORS["progressive"]:
            kwargs = {**sizes["progressive"], **kwargs}
        check_arguments(
            "discriminator_kwargs", kwargs, self.discriminator_class, excluded=("observation_space", "action_space")
        )
        self.discriminator_kwargs = kwargs if keys is None else {**kwargs, "keys": list(keys)}
        self.demonstrations, self.n_episodes, self.hold = demonstrations, n_episodes, hold
        self.env_reward, self.expert_reward, self.reward = env_reward, expert_reward, reward
        self.episodes_per_round, self.gradient_steps = episodes_per_round, gradient_steps
        self.recent_transitions = recent_transitions
        self.ring_kwargs: dict[str, Any] = {
            **{"quota": quota, "max_instances": max_instances, "balance": balance},
            **{"keep_demonstrations": keep_demonstrations, "storage_dtypes": storage_dtypes},
        }
        self.self_imitation = self_imitation
        self.demonstrations_for_player = demonstrations_for_player
        self.learning_rate, self.weight_decay = learning_rate, weight_decay
        self.gradient_penalty, self.label_smoothing = gradient_penalty, label_smoothing
        self.seed, self.load_path, self.device = seed, load_path, device

        #: Made in the first ``learn()``, from the model's spaces.
        self.discriminator: Discriminator | None = None
        self.optimizer: th.optim.Optimizer | None = None
        #: The expert: demonstrations, and successes of the player.
        self.expert: InstanceBuffer | None = None
        #: Successes that have joined the expert.
        self.n_successes = 0
        self._round: list[Episode] = []
        self._played: list[Played] = []
        self._successes: list[list[int]] = []  # of the episodes that go on, by environment
        self._shown: dict[str, int] = {}  # instances of the player's episodes, and how many there were of each
        self._demonstrated: list[str] = []  # instances of the demonstrations
        self._of: EpisodeBuffer | None = None  # the buffer that episodes and steps belong to
        self._entropy: int | None = None
        self._told: set[str] = set()

    # ------------------------------------------------------------------ coming and going

    @property
    def buffer(self) -> EpisodeBuffer:
        """The player's."""
        return self.model.replay_buffer  # type: ignore[attr-defined]

    def _randomness(self, *words: int) -> AbstractContextManager[None]:
        """
        Random numbers of its own, so that a player who learns from the environment's rewards alone has those that it would
        have had, and a resumed run draws what an unbroken one does.

        :param words: what they are for
        """
        assert self._entropy is not None
        return own_randomness(self._entropy, *words)

    def _init_callback(self) -> None:
        _check_model(self.model)
        if self.discriminator is not None:
            return
        space, action_space = self.model.observation_space, self.model.action_space
        assert isinstance(space, spaces.Dict) and isinstance(action_space, spaces.Box)
        device = self.model.device if self.device == "auto" else th.device(self.device)
        seed = self.model.seed if self.seed is None else self.seed
        self._entropy = int(np.random.SeedSequence(seed).generate_state(1)[0])
        with error_prefix("GAILCallback"), self._randomness():
            self.discriminator = self.discriminator_class(space, action_space, **self.discriminator_kwargs).to(device)
        self.optimizer = th.optim.Adam(self.discriminator.parameters(), self.learning_rate, weight_decay=self.weight_decay)
        read = spaces.Dict({key: space[key] for key in self.discriminator.keys})
        self.expert = InstanceBuffer(read, action_space, device=device, **self.ring_kwargs)
        if self.load_path is not None:
            self.load(self.load_path)
            self._round, self._of = [], None  # episodes of another player

    def _on_training_start(self) -> None:
        assert self.discriminator is not None and self.expert is not None
        model, buffer = self.model, self.buffer
        if buffer.reward_of is not None:
            raise ValueError("There are two GAILCallbacks in this learn(): a player has one discriminator. Leave one out.")
        self._refuse_challenger()
        if not self.expert.instances:
            self._take_demonstrations()
        elif isinstance(buffer, CPMBuffer) and self.demonstrations_for_player and buffer.demonstrations is None:
            warnings.warn("The player's buffer has none of the demonstrations that the discriminator knows.", stacklevel=2)
        self.discriminator.plan(self._planned_updates())
        if self._of is not buffer:
            self._of, self._round, self._successes = buffer, [], [[] for _ in range(model.n_envs)]
        self._played = []
        buffer.attach_reward(self.player_rewards, self.discriminator.keys, lambda: learns(model, sys._getframe()))

    def _take_demonstrations(self) -> None:
        assert self.expert is not None
        space = self.model.observation_space
        assert isinstance(space, spaces.Dict)
        episodes: list[Demonstration] = demonstrations_for(
            self.model, self.demonstrations, self.n_episodes, self.seed, self.hold
        )
        buffer = self.buffer
        if self.demonstrations_for_player and isinstance(buffer, CPMBuffer) and buffer.demonstrations is None:
            buffer.add_demonstrations(episodes)
        for demonstration, arrays in zip(episodes, as_arrays(episodes, space, self.model.action_space), strict=True):
            self.expert.add(demonstration.instance, arrays[0], arrays[1], demonstration=True)
        self._demonstrated = self.expert.instances
        assert self.discriminator is not None
        with error_prefix("GAILCallback"), self._randomness(0):
            self.discriminator.observe(self.expert.sample(SCALE_ROWS)[0])
        if self.reward == "softplus" and any(episode.terminated for episode in episodes):
            self._warn_of_ends("demonstrations")

    def _planned_updates(self) -> int:
        """How many of the discriminator this ``learn()`` is going to make."""
        longest = max_episode_steps(self.training_env)
        if longest is None:
            grow = getattr(self.discriminator, "grow", (0,))
            if isinstance(grow[0], float) and "grow" not in self._told:
                self._told.add("grow")
                warnings.warn(
                    f"grow={grow} are shares of all updates, and how many there will be is not known without a time limit: "
                    "100 steps an episode are taken for granted. Give numbers of updates, or limit the episodes "
                    "(gymnasium.wrappers.TimeLimit).",
                    stacklevel=2,
                )
            longest = 100
        episodes = self.locals["total_timesteps"] // longest
        return episodes // self.episodes_per_round * self.gradient_steps

    def _refuse_challenger(self) -> None:
        if isinstance(self.buffer, CPMBuffer) and self.buffer.has_challenger:
            raise ValueError(
                "There is a ChallengerCallback beside GAILCallback: challenges have rewards of their own, the "
                "discriminator's are others. Leave one out."
            )

    def _warn_of_ends(self, whose: str) -> None:
        if "ends" in self._told:
            return
        self._told.add("ends")
        warnings.warn(
            f"Some {whose} end before the time limit, and a reward that is never negative makes ending early a loss. Let "
            "episodes go on (env_kwargs=dict(ignore_terminations=True), hold=True), or take reward='logit'.",
            stacklevel=2,
        )

    def _on_rollout_start(self) -> None:
        self._refuse_challenger()

    def _on_training_end(self) -> None:
        self.buffer.attach_reward(None)

    # ------------------------------------------------------------------ what the player gets

    def player_rewards(self, observations: dict[str, th.Tensor], actions: th.Tensor, rewards: th.Tensor) -> th.Tensor:
        """
        :param observations: by key, as the environment gave them, each of shape ``(n, *shape)``
        :param actions: within [-1, 1], shape ``(n, action_dim)``
        :param rewards: the environment's, shape ``(n, 1)``
        :return: shape ``(n, 1)``
        """
        if not self.expert_reward:
            return self.env_reward * rewards
        learnt = self.expert_rewards(observations, actions).to(rewards.device).unsqueeze(1)
        return self.env_reward * rewards + self.expert_reward * learnt

    @th.no_grad()
    def expert_rewards(self, observations: Observations, actions: th.Tensor) -> th.Tensor:
        """
        :param observations: by key, each of shape ``(n, *shape)``
        :param actions: within [-1, 1], shape ``(n, action_dim)``
        :return: the discriminator's rewards, shape ``(n,)``
        """
        logits = self._logits(observations, actions)
        return softplus_reward(logits) if self.reward == "softplus" else logits

    def _logits(self, observations: Observations, actions: th.Tensor) -> th.Tensor:
        assert self.discriminator is not None
        device = next(self.discriminator.parameters()).device
        self.discriminator.eval()
        return self.discriminator({key: one.to(device) for key, one in observations.items()}, actions.to(device))

    # ------------------------------------------------------------------ what it learns from

    def _on_step(self) -> bool:
        step = self.buffer.books.n_steps  # the buffer is given this step after the callbacks
        for i, (info, done) in enumerate(zip(self.locals["infos"], self.locals["dones"], strict=True)):
            success = success_of(info)
            if success is None and self.self_imitation:
                raise ValueError(
                    "self_imitation needs to know which episodes succeed, and the environment's infos have neither "
                    "'is_success' nor 'success'. Wrap it in one that adds it, or give GAILCallback self_imitation=False."
                )
            if success:
                self._successes[i].append(step)
            if done:
                self._played.append(Played(i, step, self._successes[i], info.get("instance")))
                self._successes[i] = []
                if self.reward == "softplus" and not info.get("TimeLimit.truncated", False):
                    self._warn_of_ends("episodes of the player")
        return True

    def _on_rollout_end(self) -> None:
        if self._played:
            try:
                self._take_episodes()
                if len(self._round) >= self.episodes_per_round:
                    self._train_discriminator()
                    self._round = []
            except BaseException:
                self.buffer.attach_reward(None)
                raise
            self._played = []

    def _take_episodes(self) -> None:
        """Those that ended in this rollout join the round, and the expert those with a success, up to the first."""
        assert self.expert is not None and self.discriminator is not None
        buffer = self.buffer
        by_end = {(one.env_idx, (one.start + one.length - 1) % buffer.buffer_size): one for one in buffer.episodes}
        for played in self._played:
            episode = by_end.get((played.env_idx, played.last_step % buffer.buffer_size))
            if episode is None or buffer.books.n_steps - played.last_step > buffer.buffer_size:
                raise ValueError(
                    f"The replay buffer, of {buffer.buffer_size} transitions per environment, has lost an episode of the "
                    "rollout that ends here, before the discriminator could learn from it: give a buffer_size of more than "
                    "n_envs x the rollout and the longest episode, or a smaller train_freq."
                )
            self._round.append(episode)
            self._shows(played.instance)
            first_step = played.last_step - episode.length + 1
            until_success = [step - first_step + 1 for step in played.successes if step >= first_step][:1]
            if self.self_imitation and until_success:
                n = until_success[0]
                states = buffer.episode_observations(episode, self.discriminator.keys)
                actions = buffer.episode_actions(episode)
                self.expert.add(played.instance, {key: rows[: n + 1] for key, rows in states.items()}, actions[:n])
                self.n_successes += 1
                self.logger.record("gail/successes_added", self.n_successes)

    def _shows(self, instance: str | None) -> None:
        """Demonstrations of objects that the environment lacks, or calls otherwise, would have their share of each batch."""
        assert self.expert is not None
        name = ANY if instance is None else instance
        self._shown[name] = self._shown.get(name, 0) + 1
        if not self.expert.balance or "instances" in self._told:
            return
        named, without = instance is not None, ANY in self._demonstrated
        if named == without:
            self._told.add("instances")
            told = f"an object, {instance!r}" if named else "none (there is no infos[i]['instance'])"
            theirs = "name none" if without else f"name {', '.join(self._demonstrated)}"
            warnings.warn(
                f"The environment names {told}, and demonstrations {theirs}: the player's successes get rings of their own. "
                "Give each Demonstration the `instance` that the environment names, or GAILCallback balance=False.",
                stacklevel=2,
            )
        elif sum(self._shown.values()) >= EPISODES_PER_INSTANCE * len(self._demonstrated):
            self._told.add("instances")
            absent = [one for one in self._demonstrated if one not in self._shown]
            if absent:
                warnings.warn(
                    f"In {sum(self._shown.values())} episodes the environment has not shown {', '.join(absent)}, of which "
                    f"there are demonstrations: a share of the expert's rows is about what the player never sees. It has "
                    f"shown {', '.join(self._shown)}.",
                    stacklevel=2,
                )

    def _recent(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """The newest transitions of the round that the player's buffer still holds."""
        assert self.discriminator is not None
        held = [episode for episode in self._round if self.buffer.books.holds(episode)]
        states = [self.buffer.episode_observations(episode, self.discriminator.keys) for episode in held]
        actions = np.concatenate([self.buffer.episode_actions(episode) for episode in held])
        n = self.recent_transitions
        return {key: np.concatenate([one[key][:-1] for one in states])[-n:] for key in self.discriminator.keys}, actions[-n:]

    def _train_discriminator(self) -> None:
        assert self.discriminator is not None and self.expert is not None and self.optimizer is not None
        device = next(self.discriminator.parameters()).device
        recent, taken = self._recent()
        with self._randomness(1, int(self.discriminator.updates)):
            for _ in range(self.gradient_steps):
                observations, actions = self.expert.sample(self.batch_size)
                rows = np.random.randint(len(taken), size=len(actions))
                of_player = {key: th.as_tensor(one[rows], device=device) for key, one in recent.items()}
                self._update((observations, actions), (of_player, th.as_tensor(taken[rows], device=device)))
        sizes = self.expert.sizes()
        self.logger.record("gail/alpha", self.discriminator.alpha)
        self.logger.record("gail/updates", int(self.discriminator.updates))
        self.logger.record("gail/instances", len(sizes))
        self.logger.record("gail/smallest_ring", min(sizes.values()))
        self.logger.record("gail/largest_ring", max(sizes.values()))

    def _update(self, of_expert: tuple[Observations, th.Tensor], of_player: tuple[Observations, th.Tensor]) -> None:
        assert self.discriminator is not None and self.optimizer is not None
        self.discriminator.train()
        n = len(of_expert[1])
        both = {key: th.cat((of_expert[0][key], of_player[0][key])) for key in self.discriminator.keys}
        logits = self.discriminator(both, th.cat((of_expert[1], of_player[1])))
        smooth = self.label_smoothing
        labels = th.cat((th.full((n,), 1.0 - smooth), th.full((len(logits) - n,), smooth))).to(logits.device)
        losses = F.binary_cross_entropy_with_logits(logits, labels, reduction="none")
        expert_loss, player_loss = losses[:n].mean(), losses[n:].mean()
        loss = expert_loss + player_loss
        if self.gradient_penalty:
            loss = loss + self.gradient_penalty * self._penalty(of_expert, of_player)
        number = int(self.discriminator.updates) + 1
        if not math.isfinite(float(loss.detach())):
            raise ValueError(
                f"The discriminator's loss is {float(loss.detach())} in its update {number}. Are there NaN or huge values in "
                f"the observations {list(self.discriminator.keys)}? Else lower learning_rate ({self.learning_rate})."
            )
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.discriminator.updates += 1
        with th.no_grad():
            values = {
                "expert_loss": expert_loss,
                "player_loss": player_loss,
                "expert_accuracy": (logits[:n] > 0).float().mean(),
                "player_accuracy": (logits[n:] < 0).float().mean(),
                "expert_reward": softplus_reward(logits[:n]).mean(),
                "player_reward": softplus_reward(logits[n:]).mean(),
            }
        for name, value in values.items():
            self.logger.record_mean(f"gail/{name}", value.item())

    def _penalty(self, of_expert: tuple[Observations, th.Tensor], of_player: tuple[Observations, th.Tensor]) -> th.Tensor:
        """Gulrajani et al. 2017: slopes of 1 between the two, along everything but the labels of points."""
        assert self.discriminator is not None
        share = th.rand(len(of_expert[1]), 1, device=of_expert[1].device)
        mixed: dict[str, th.Tensor] = {}
        for key, ours in of_expert[0].items():
            weight = share.view(-1, *[1] * (ours.dim() - 1))
            mixed[key] = th.lerp(of_player[0][key].float(), ours.float(), weight)
            if ours.dim() == 3:
                mixed[key][..., -1] = ours[..., -1].float()
            mixed[key].requires_grad_()
        actions = th.lerp(of_player[1], of_expert[1], share).requires_grad_()
        inputs = [*mixed.values(), actions]
        slopes = th.autograd.grad(self.discriminator(mixed, actions).sum(), inputs, create_graph=True)
        return (th.cat([one.flatten(1) for one in slopes], dim=1).norm(dim=1) - 1.0).square().mean()

    # ------------------------------------------------------------------ files

    @property
    def has_state(self) -> bool:
        return self.discriminator is not None

    def save(self, path: str | Path) -> None:
        """
        Discriminator, its optimizer and scale, counters, and the rings of the expert, in one file that executes nothing when
        it is read.

        :param path: file to write, ``"gail.npz"`` for instance
        :raises ValueError: before the first ``learn()``
        :raises NotFiniteError: if a weight is not finite
        """
        if self.discriminator is None or self.optimizer is None or self.expert is None:
            raise ValueError("GAILCallback has nothing to save before learn().")
        weights = self.discriminator.state_dict()
        check_finite(path, "discriminator", weights)
        rings, arrays = self.expert.state("rings/")
        arrays |= {f"weights/{name}": value.cpu().numpy() for name, value in weights.items()}
        for index, entry in self.optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer/{index}/{name}": th.as_tensor(value).cpu().numpy() for name, value in entry.items()}
        content = {
            "kind": "GAILCallback",
            "discriminator": self.discriminator_class.__name__,
            "rings": rings,
            "n_successes": self.n_successes,
            "entropy": self._entropy,
            "shown": self._shown,
            "demonstrated": self._demonstrated,
            "round": pack(self._round, (Episode,)),
            "optimized": sorted(self.optimizer.state_dict()["state"]),
            "told": sorted(self._told),
        }
        write_archive(path, content, arrays)

    def load(self, path: str | Path) -> None:
        """
        Go on with what :meth:`save` wrote. Needs a model: ``load_path`` does it in ``learn()``.

        :param path: the file
        :raises ValueError: if it is damaged, or of a discriminator of another kind or other sizes
        """
        if self.discriminator is None or self.optimizer is None or self.expert is None:
            raise ValueError("GAILCallback.load() needs a model first: give load_path to the callback instead.")
        with Archive(path, "discriminator") as archive:
            content = archive.content
            if content.get("kind") != "GAILCallback" or content["discriminator"] != self.discriminator_class.__name__:
                raise ValueError(
                    f"{path} holds a {content.get('discriminator', content.get('kind'))}, not a "
                    f"{self.discriminator_class.__name__} of GAILCallback."
                )
            own = self.discriminator.state_dict()
            found = {name: th.as_tensor(archive.array(f"weights/{name}")) for name in own}
            wrong = [name for name, value in found.items() if value.shape != own[name].shape]
            if wrong:
                raise ValueError(
                    f"{path} belongs to a discriminator of other sizes: {wrong[0]} is {tuple(found[wrong[0]].shape)} there "
                    f"and {tuple(own[wrong[0]].shape)} here. Make the callback with the same arguments."
                )
            self.discriminator.load_state_dict(found)
            state = self.optimizer.state_dict()
            names = ("step", "exp_avg", "exp_avg_sq")
            state["state"] = {
                index: {name: th.as_tensor(archive.array(f"optimizer/{index}/{name}")) for name in names}
                for index in content["optimized"]
            }
            self.optimizer.load_state_dict(state)
            self.expert.restore(content["rings"], archive, "rings/")
        self.n_successes = content["n_successes"]
        self._round = unpack(content["round"], (Episode,))
        self._told = set(content["told"])
        self._entropy, self._shown, self._demonstrated = content["entropy"], content["shown"], content["demonstrated"]
        self._of, self._successes = self.buffer, [[] for _ in range(self.model.n_envs)]


def _class_of(given: Any) -> type[Discriminator]:
    if isinstance(given, str):
        if given not in DISCRIMINATORS:
            raise ValueError(
                f"Unknown discriminator_class {given!r}.{nearest(given, DISCRIMINATORS)} Valid: {sorted(DISCRIMINATORS)}, or "
                "a subclass of Discriminator."
            )
        return DISCRIMINATORS[given]
    if not (isinstance(given, type) and issubclass(given, Discriminator)):
        raise ValueError(f"`discriminator_class` must be a name or a subclass of Discriminator, got {given!r}.")
    return given


def _check_model(model: Any) -> None:
    """Everything that must hold before the first step."""
    name = type(model).__name__
    if not isinstance(model, OffPolicyAlgorithm):
        raise ValueError(f"GAILCallback relabels a replay buffer, and {name} has none: take SAC, TD3, DDPG or TQC.")
    buffer = model.replay_buffer
    if not isinstance(buffer, EpisodeBuffer):
        raise ValueError(
            f"GAILCallback needs a CPMBuffer, {name} has a {type(buffer).__name__}: make it with "
            "replay_buffer_class=CPMBuffer, replay_buffer_kwargs=dict(challenge_ratio=0)."
        )
    if isinstance(buffer, CPMBuffer) and buffer.challenge_ratio > 0:
        raise ValueError(
            f"The replay buffer has challenge_ratio={buffer.challenge_ratio}, and challenges have rewards of their own: give "
            "replay_buffer_kwargs=dict(challenge_ratio=0)."
        )
    if buffer.n_sampled_goal > 0:
        raise ValueError(
            "GAILCallback and hindsight goals do not go together: the discriminator would rate rows for goals that they did "
            "not have. Give replay_buffer_kwargs=dict(n_sampled_goal=0)."
        )
    if not isinstance(model.action_space, spaces.Box):
        raise ValueError(f"GAILCallback needs continuous actions (a Box), the action space is {model.action_space}.")
    normalize = model.get_vec_normalize_env()
    if normalize is not None and normalize.norm_reward:
        raise ValueError(
            "VecNormalize normalizes rewards by the task's statistics, and the discriminator's are others: VecNormalize(env, "
            "norm_reward=False)."
        )
