"""
The original buffer D and the imaginary buffer I as one SB3 replay buffer (report, sections 3.2.1, 4.3 and 4.4).

D is a ``HerReplayBuffer`` that stores every observation once and samples in time independent of its size. I holds
*challenges*: views into D (environment, start, goal) with rewards of their own. Demonstrations, beyond the report, are a
part of D that is never overwritten.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy

from sb3_cpm.arguments import names_checked
from sb3_cpm.buffers.checks import check_buffer_arguments, check_shares, checked_infos
from sb3_cpm.buffers.compact import StorageSpec
from sb3_cpm.buffers.demonstrations import Demonstration, as_transitions, read_demonstrations
from sb3_cpm.buffers.episode_buffer import NOT_SAVED, EpisodeBuffer
from sb3_cpm.buffers.imaginary import Challenge, ChallengeCounters, ImaginaryBuffer, ImaginaryRows
from sb3_cpm.buffers.sequences import side_by_side
from sb3_cpm.buffers.storage import Episode
from sb3_cpm.challenges import ArtificialRewards, ChallengeCurator, OriginKind, Proposal
from sb3_cpm.challenges.state import restored, state_of
from sb3_cpm.files import Archive
from sb3_cpm.packing import pack, unpack
from sb3_cpm.stopwatch import Stopwatch
from sb3_cpm.type_aliases import Evaluation, SequenceBatch

#: Key of ``infos[i]`` under which the exploration wrapper tells the action, within [-1, 1], that was really executed.
EXECUTED_ACTION = "cpm_executed_action"

#: What the file of a buffer may hold of I.
_OF_CHALLENGES = (Challenge, Episode, Proposal, ArtificialRewards)
ONE_STEP = (
    "it has one-step returns only. Leave n_steps and gamma out of replay_buffer_kwargs, and n_steps at 1 in the algorithm."
)


class CPMBuffer(EpisodeBuffer):
    """
    Replay buffer of CPM: the original buffer D and the imaginary buffer I.

    Needs a Dict observation space and, unless ``challenge_ratio=0``, a
    :class:`~sb3_cpm.callbacks.ChallengerCallback` in ``learn()``. With ``challenge_ratio=0`` it is a
    ``HerReplayBuffer`` that needs half of the memory and does not slow down with its size.

    :param buffer_size: max number of transitions in D (the report keeps 50 trajectories)
    :param observation_space: observation space
    :param action_space: action space
    :param env: the training environment (only used for hindsight goals)
    :param device: PyTorch device
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: not needed, must be False
    :param handle_timeout_termination: bootstrap at time limits
    :param n_sampled_goal: number of hindsight transitions per real one in D's share of a batch. 0, the default, works on
        environments without goals; ``HerReplayBuffer`` has 4. Their rewards come from the environment's ``compute_reward``,
        as in SB3: wrappers that scale or shape the rewards of ``step()`` do not reach them, and both kinds are mixed in every
        batch. Scale in ``compute_reward``, too
    :param goal_selection_strategy: one of 'episode', 'final', 'future'
    :param copy_info_dict: pass the infos to ``compute_reward()``
    :param challenge_ratio: share of P's updates (``mix="batch"``) or of each batch (``mix="row"``) from I [4.3: 0.25]
    :param mix: ``"batch"``: a batch comes from I with probability ``challenge_ratio``, else from D [4.3];
        ``"row"``: that share of the rows of every batch comes from I
    :param max_challenges: size of I in challenges; the oldest makes room [4.3: 10]
    :param terminal_goals: treat the goal of a challenge as the end of the episode. By default the cut is a truncation:
        the critic bootstraps through the goal
    :param warmup_steps: first transitions of every trajectory that never count and never enter I [B.5.2: 5]
    :param kl_ratio: target of mean(c1 * KL) over mean(DISAG) [4.4.1: 0.1]
    :param reward_ratio: c*, target of mean(c * r) over mean(u) [4.4.1: 0.75]
    :param filter_kwargs: see :class:`~sb3_cpm.challenges.filters.ChallengeFilter` [B.5.2]
    :param reward_kwargs: see :class:`~sb3_cpm.challenges.rewards.ArtificialReward` [B.6]
    :param coefficient_kwargs: see :class:`~sb3_cpm.challenges.targeting.DynamicCoefficient` [B.7]
    :param reward_origin: where rewards are measured from: ``"low_quantile"``, a moving low quantile of them where that is
        negative, else zero; ``"zero"``, as the report has it. See :class:`~sb3_cpm.challenges.origin.RewardOrigin`
    :param refresh_every: re-evaluate challenges whose rewards are at least this many transitions old with today's world
        model (beyond the report). None: rewards stay those of the moment when the challenge was kept [4.3]
    :param demonstration_ratio: share of P's updates or of each batch, as ``mix`` says, from :meth:`add_demonstrations`, and of
        the challenger's sequences
    :param storage_dtypes: compact storage of keys of floats, ``{"pointcloud": "float16"}``; ``("uint8", 0.0, 1.0)`` for
        numbers between these bounds (without bounds: the space's), a list of such for one per feature of the last axis.
        Batches hold the space's dtype as ever
    :param memmap_dir: keep the observations in files in a folder of their own there, for buffers larger than memory
    :param player_keys: observation keys that batches for P hold. None: all keys, unless P's features extractor names
        those that it reads (``PointNetExtractor`` does), which the callback then passes on
    :param challenge_keys: keys that make the goal of a challenge, where a
        :class:`~sb3_cpm.challenge_env.ChallengeVecEnv` adds ``"challenge"`` to the observations: rows then tell P which
        challenge they are of; None: those that the environment names
    :raises ValueError: for spaces and arguments that cannot work, and if it would take more memory than the machine has
    """

    @names_checked(n_steps=ONE_STEP, gamma=ONE_STEP)
    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        env: VecEnv | None = None,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_sampled_goal: int = 0,
        goal_selection_strategy: GoalSelectionStrategy | str = "future",
        copy_info_dict: bool = False,
        challenge_ratio: float = 0.25,
        mix: Literal["batch", "row"] = "batch",
        max_challenges: int = 10,
        terminal_goals: bool = False,
        warmup_steps: int = 5,
        kl_ratio: float = 0.1,
        reward_ratio: float = 0.75,
        filter_kwargs: dict[str, Any] | None = None,
        reward_kwargs: dict[str, Any] | None = None,
        coefficient_kwargs: dict[str, Any] | None = None,
        reward_origin: OriginKind = "low_quantile",
        refresh_every: int | None = None,
        demonstration_ratio: float = 0.1,
        storage_dtypes: dict[str, StorageSpec] | None = None,
        memmap_dir: str | Path | None = None,
        player_keys: Sequence[str] | None = None,
        challenge_keys: Sequence[str] | None = None,
    ):
        given = {name: value for name, value in locals().items() if name not in NOT_SAVED}
        check_buffer_arguments(
            observation_space, action_space, challenge_ratio, demonstration_ratio, mix, max_challenges, refresh_every
        )
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            env,
            device=device,
            n_envs=n_envs,
            optimize_memory_usage=optimize_memory_usage,
            handle_timeout_termination=handle_timeout_termination,
            n_sampled_goal=n_sampled_goal,
            goal_selection_strategy=goal_selection_strategy,
            copy_info_dict=copy_info_dict,
            storage_dtypes=storage_dtypes,
            memmap_dir=memmap_dir,
            player_keys=player_keys,
            challenge_keys=challenge_keys,
        )
        self._given = given
        self.challenge_ratio = challenge_ratio
        self.demonstration_ratio = demonstration_ratio
        self.mix = mix
        self.max_challenges = max_challenges
        self.terminal_goals = terminal_goals
        self.refresh_every = refresh_every
        self.curator = ChallengeCurator(
            warmup_steps, kl_ratio, reward_ratio, filter_kwargs, reward_kwargs, coefficient_kwargs, reward_origin
        )
        #: Demonstrations, as a buffer of their own; None while there are none.
        self.demonstrations: EpisodeBuffer | None = None
        self.detach_challenger()
        self._forget_challenges()

    # ------------------------------------------------------------------ who proposes challenges

    def attach_challenger(self, is_running: Callable[[], bool] = lambda: True, stopwatch: Stopwatch | None = None) -> None:
        """
        Somebody calls :meth:`propose` from now on. Without, nothing would ever enter I, and :meth:`add` says so.

        :param is_running: whether that is still so: a ``learn()`` may have ended in an exception
        :param stopwatch: charged with "buffer"
        """
        self._challenger_is_running = is_running
        self._stopwatch = Stopwatch() if stopwatch is None else stopwatch

    def detach_challenger(self) -> None:
        """Nobody does any more."""
        self.attach_challenger(lambda: False)

    @property
    def has_challenger(self) -> bool:
        """Whether somebody proposes challenges."""
        return self._challenger_is_running()

    # ------------------------------------------------------------------ storage

    def _forget_challenges(self) -> None:
        self._completed: list[Episode] = []
        self._imaginary = ImaginaryBuffer(self.buffer_size, self.max_challenges)
        self.counters = ChallengeCounters()

    def reset(self) -> None:
        """Forget all transitions, episodes and challenges. Demonstrations and what the curator has learnt of rewards stay."""
        super().reset()
        self._forget_challenges()

    @property
    def nbytes(self) -> int:
        """Bytes that all arrays take (of which the system gives those in memory only as they are written to)."""
        return super().nbytes + (0 if self.demonstrations is None else self.demonstrations.nbytes)

    def add(  # type: ignore[override]
        self,
        obs: dict[str, np.ndarray],
        next_obs: dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray | float,
        done: np.ndarray | bool,
        infos: Sequence[dict[str, Any]] | dict[str, Any],
    ) -> None:
        """
        Store one transition per environment. ``infos[i]`` may name the action that was executed instead of ``action[i]``.

        :param obs: observations, each of shape ``(n_envs, *observation_shape)``
        :param next_obs: what they led to; the true last observation where an episode ends
        :param action: within [-1, 1], as ``policy.scale_action()`` gives it, shape ``(n_envs, *action_shape)``
        :param reward: shape ``(n_envs,)``; a number will do for one environment, and so for ``done`` and ``infos``
        :param done: whether the episodes ended, shape ``(n_envs,)``
        :param infos: one per environment
        :raises ValueError: if no challenger would ever fill I, an episode does not fit into the buffer, for wrong shapes,
            rewards that are not finite, values that compact storage cannot hold, a full disk; nothing is stored then
        """
        if self.challenge_ratio > 0 and not self.has_challenger:
            raise ValueError(
                f"CPMBuffer has challenge_ratio={self.challenge_ratio}, but nobody proposes challenges: pass "
                "callback=ChallengerCallback() to learn() (a configuration of rl_zoo3 has the line `callback: "
                "sb3_cpm.ChallengerCallback`), or replay_buffer_kwargs=dict(challenge_ratio=0) to use the buffer without "
                "challenges. To fill it by hand before learn(), use add_demonstrations(), or set its challenge_ratio to 0 "
                "meanwhile."
            )
        infos = checked_infos(infos, self.n_envs)
        action = _executed(action, infos)
        with self._stopwatch.section("buffer"):
            super().add(obs, next_obs, action, reward, done, infos)

    def _remember(self, episode: Episode) -> None:
        if self.has_challenger:
            self._completed.append(episode)

    def _forget(self, episode: Episode) -> None:
        self._imaginary.forget(episode)
        if episode in self._completed:
            self._completed.remove(episode)

    @property
    def episodes_ended(self) -> bool:
        """Whether there is a complete episode to sample from, in D or among the demonstrations."""
        return super().episodes_ended or self.demonstrations is not None

    # ------------------------------------------------------------------ sampling for P

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> DictReplayBufferSamples:  # type: ignore[override]
        """
        A batch for the player, from D, I and the demonstrations.

        :param batch_size: number of transitions
        :param env: associated VecEnv to normalize the observations and rewards
        :return: samples; observations hold ``player_keys`` only
        :raises RuntimeError: before the end of the first episode
        """
        self._check_can_sample()
        with self._stopwatch.section("buffer"):
            return self._sample(batch_size, env)

    def _sample(self, batch_size: int, env: VecNormalize | None) -> DictReplayBufferSamples:
        n_imaginary, n_demonstrated = self._shares(batch_size)
        n_ours = batch_size - n_demonstrated
        if not n_demonstrated:
            return self._sample_own(n_ours - n_imaginary, n_imaginary, env)
        demonstrated = self.sample_demonstrations(n_demonstrated, env)
        return _concatenate(self._sample_own(n_ours - n_imaginary, n_imaginary, env), demonstrated) if n_ours else demonstrated

    def sample_demonstrations(self, batch_size: int, env: VecNormalize | None = None) -> DictReplayBufferSamples:
        """
        A batch of demonstrations alone; there must be some.

        :param batch_size: number of transitions
        :param env: associated VecEnv to normalize the observations and rewards
        :return: as :meth:`sample`
        """
        return self._demonstrations_for_player().sample(batch_size, env)

    def _demonstrations_for_player(self) -> EpisodeBuffer:
        assert self.demonstrations is not None
        # SB3 sets a loaded buffer's device, and knows nothing of a second one in it
        self.demonstrations.player_keys, self.demonstrations.device = self.player_keys, self.device
        self.demonstrations.attach_reward(self._reward, self.reward_keys, self._reward_is_on)
        return self.demonstrations

    def _shares(self, batch_size: int) -> tuple[int, int]:
        """:return: number of rows from I and from the demonstrations"""
        of_challenges = self.challenge_ratio if len(self._imaginary) else 0.0
        of_demonstrations = self.demonstration_ratio if self.demonstrations is not None else 0.0
        if not self.books.n_drawable:  # nothing in D, hence nothing in I
            return 0, batch_size
        if self.mix == "row":
            n_imaginary = round(of_challenges * batch_size)
            return n_imaginary, min(round(of_demonstrations * batch_size), batch_size - n_imaginary)
        if of_challenges + of_demonstrations == 0:
            return 0, 0
        draw = np.random.random()
        if draw < of_challenges:
            return batch_size, 0
        return 0, batch_size if draw < of_challenges + of_demonstrations else 0

    def _sample_own(self, n_original: int, n_imaginary: int, env: VecNormalize | None) -> DictReplayBufferSamples:
        """
        D's share, uniform over all transitions of complete episodes, the hindsight part of them relabelled; then I's,
        uniform over all transitions of all challenges.
        """
        n_virtual = int(self.her_ratio * n_original)
        rows, envs = self.books.draw(n_original, n_virtual)
        if not n_imaginary:
            return self._read(rows, envs, n_virtual, env)
        drawn = self._imaginary.sample(n_imaginary, self.n_added)
        if not drawn.demonstrated.any():
            return self._read_with_challenges(self, rows, envs, n_virtual, drawn, env)
        nothing, elsewhere = np.zeros(0, dtype=np.int64), drawn.of(demonstrated=True)
        demonstrated = self._read_with_challenges(self._demonstrations_for_player(), nothing, nothing, 0, elsewhere, env)
        ours = drawn.of(demonstrated=False)
        if not len(rows) + len(ours.slots):
            return demonstrated
        return _concatenate(self._read_with_challenges(self, rows, envs, n_virtual, ours, env), demonstrated)

    def _read_with_challenges(
        self,
        home: EpisodeBuffer,
        rows: np.ndarray,
        envs: np.ndarray,
        n_virtual: int,
        drawn: ImaginaryRows,
        env: VecNormalize | None,
    ) -> DictReplayBufferSamples:
        """Transitions of a buffer, D or the demonstrations, and after them those of challenges that are cut from it."""
        rows, envs = np.concatenate([rows, drawn.slots]), np.concatenate([envs, drawn.envs])
        goals = None if self.challenge_keys is None else home.ring.locate(drawn.goal_slots, drawn.envs)
        return home._read(rows, envs, n_virtual, env, drawn.rewards, drawn.is_goal if self.terminal_goals else None, goals)

    # ------------------------------------------------------------------ sequences for C

    def sample_sequences(self, batch_size: int, length: int, keys: Sequence[str] | None = None) -> SequenceBatch:
        """
        As :meth:`~sb3_cpm.buffers.episode_buffer.EpisodeBuffer.sample_sequences`; each
        sequence comes from the demonstrations with probability ``demonstration_ratio``.

        :param batch_size: number of sequences
        :param length: rows per sequence
        :param keys: observation keys; None: all
        :return: time-major batch, see :class:`~sb3_cpm.type_aliases.SequenceBatch`
        :raises RuntimeError: before the end of the first episode
        """
        if self.demonstrations is None:
            return super().sample_sequences(batch_size, length, keys)
        n_demonstrated = np.random.binomial(batch_size, self.demonstration_ratio) if super().episodes_ended else batch_size
        parts = []
        if n_demonstrated < batch_size:
            parts.append(super().sample_sequences(batch_size - n_demonstrated, length, keys))
        if n_demonstrated:
            parts.append(self.demonstrations.sample_sequences(n_demonstrated, length, keys))
        return side_by_side(parts)

    # ------------------------------------------------------------------ challenges

    def pop_completed(self) -> list[Episode]:
        """:return: the episodes that ended since the last call and are still whole in D, oldest first"""
        completed, self._completed = self._completed, []
        return completed

    def propose(self, episode: Episode, evaluation: Evaluation) -> Proposal | None:
        """
        Choose a goal in an episode, filter, and keep the challenge in I if it passes.

        :param episode: a complete episode that is still in D, or a demonstration, see :meth:`draw_demonstration`. What a
            demonstration earns says nothing of what P does: reward memory and origin do not count it
        :param evaluation: the challenger's evaluation of it
        :return: what was decided; None if the episode is too short to have a transition that counts
        :raises ValueError: for an evaluation that does not fit the episode; nothing is changed then
        """
        proposal = self.curator.propose(self.episode_rewards(episode), evaluation, remember=not episode.demonstrated)
        if proposal is None:
            return None
        self.counters.count(proposal)
        if proposal.accepted:
            self._imaginary.keep(episode, proposal, self.n_added)
        return proposal

    def draw_demonstration(self) -> Episode:
        """
        :return: one of the demonstrations at random, for :meth:`propose`
        :raises ValueError: if there are none
        """
        if self.demonstrations is None:
            raise ValueError(
                "There are no demonstrations to cut challenges from: add_demonstrations() adds some, and so does a "
                "sb3_cpm.imitation.DemonstrationsCallback in learn(). Else leave out demonstration_challenges."
            )
        episodes = self.demonstrations.episodes
        return replace(episodes[np.random.randint(len(episodes))], demonstrated=True)

    def due_for_refresh(self) -> list[Challenge]:
        """:return: the challenges whose rewards are at least ``refresh_every`` transitions old"""
        if self.refresh_every is None:
            return []
        return [challenge for challenge in self.challenges if challenge.age >= self.refresh_every]

    def refresh(self, challenge: Challenge, evaluation: Evaluation) -> float:
        """
        Give a challenge the rewards that today's world model has for it. Its goal, the coefficients and the tolerances stay.

        :param challenge: one that is still in I
        :param evaluation: the challenger's evaluation of its whole episode
        :return: by how much its rewards changed: mean absolute change over mean absolute reward
        :raises ValueError: if it is no longer there, or the evaluation does not fit the episode; nothing is changed then
        """
        proposal = self.curator.refresh(challenge.proposal, evaluation)
        assert proposal.artificial is not None
        self._imaginary.replace(challenge, proposal, self.n_added)
        self.counters.refreshed += 1
        before = challenge.rewards
        return float(np.abs(proposal.artificial.total - before).mean() / max(np.abs(before).mean(), 1e-12))

    def pop_sampled_age(self) -> float | None:
        """:return: mean age, in transitions, of the artificial rewards sampled since the last call; None if there were none"""
        return self._imaginary.pop_sampled_age()

    def remember_reward(self, episode: Episode) -> None:
        """Let an episode count for reward memory and origin without proposing a challenge (while C knows nothing yet)."""
        self.curator.remember(self.episode_rewards(episode))

    def remember_call(self, episodes: Sequence[Episode]) -> None:
        """Before the episodes of a rollout are proposed from: the reward memory may count them together [B.5.2]."""
        self.curator.remember_call([self.episode_rewards(episode) for episode in episodes])

    @property
    def challenges(self) -> list[Challenge]:
        """Challenges in I, oldest first."""
        return self._imaginary.inspect(self.n_added)

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients, tolerances, reward memory and origin by name."""
        return self.curator.coefficients

    # ------------------------------------------------------------------ demonstrations

    def add_demonstrations(self, source: str | Path | Sequence[Demonstration], env: Any = None) -> int:
        """
        Add recorded episodes. They are never overwritten, and are sampled with ``demonstration_ratio``. Actions outside of
        their bounds are clipped, as environments do with them, and a warning counts them.

        :param source: ManiSkill's trajectory file (``.h5``, with the ``.json`` of the same name beside it), or episodes
        :param env: a single environment, as made for training, in which the recorded actions are replayed; needed unless the
            file holds this buffer's observations and rewards
        :return: number of episodes added
        :raises ValueError: for files and episodes that don't fit, and if ``challenge_ratio`` and ``demonstration_ratio``
            exceed 1 together; nothing is added then
        """
        check_shares(self.challenge_ratio, self.demonstration_ratio)
        if isinstance(source, (str, Path)):
            source = read_demonstrations(source, self.observation_space, self.action_space, env)
        if isinstance(source, Demonstration):
            source = [source]
        if not source:
            raise ValueError("No demonstrations given: `source` is a list of Demonstrations, or the path of ManiSkill's .h5.")
        steps = as_transitions(source, self.observation_space, self.action_space)
        earlier = self.demonstrations
        n_earlier = 0 if earlier is None else earlier.size()
        grown = EpisodeBuffer(
            n_earlier + len(steps),
            self.observation_space,
            self.action_space,
            self.env,
            self.device,
            handle_timeout_termination=self.handle_timeout_termination,
            n_sampled_goal=self.n_sampled_goal,
            goal_selection_strategy=self.goal_selection_strategy,
            storage_dtypes=self.storage_dtypes,
            memmap_dir=self.memmap_dir,
            challenge_keys=self.challenge_keys,
        )
        if earlier is not None:
            for row in range(n_earlier):
                grown.add(*earlier._transition(row))
        for step in steps:
            grown.add(*step)
        self.demonstrations = grown
        return len(source)

    def _home(self, episode: Episode) -> EpisodeBuffer:
        if not episode.demonstrated:
            return super()._home(episode)
        assert self.demonstrations is not None
        return self.demonstrations._home(episode)

    # ------------------------------------------------------------------ environment, saving

    def set_env(self, env: VecEnv) -> None:
        """As the parent's, for the demonstrations too."""
        super().set_env(env)
        if self.demonstrations is not None:
            self.demonstrations.env = env

    def _state(self, prefix: str = "") -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        content, arrays = super()._state(prefix)
        content["curator"] = pack(state_of(self.curator), name="curator")
        content["counters"] = pack(self.counters, (ChallengeCounters,))
        content["completed"] = pack(self._completed, (Episode,))
        content["imaginary"] = pack(self._imaginary.state(), _OF_CHALLENGES, "challenges")
        if self.demonstrations is not None:
            content["demonstrations"], theirs = self.demonstrations._state(f"{prefix}demonstrations/")
            arrays |= theirs
        return content, arrays

    def _restore(self, content: dict[str, Any], archive: Archive, prefix: str) -> None:
        super()._restore(content, archive, prefix)
        restored(self.curator, unpack(content["curator"]), "curator")
        self.counters = unpack(content["counters"], (ChallengeCounters,))
        self._completed = unpack(content["completed"], (Episode,))
        self._imaginary.restore(unpack(content["imaginary"], _OF_CHALLENGES))
        if "demonstrations" in content:
            theirs = content["demonstrations"]
            self.demonstrations = EpisodeBuffer._made_from(theirs, archive, f"{prefix}demonstrations/")

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        del state["_stopwatch"], state["_challenger_is_running"]  # these belong to a running learn()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.detach_challenger()


def _executed(action: np.ndarray, infos: Sequence[dict[str, Any]]) -> np.ndarray:
    """P's actions, replaced wherever the challenger acted instead."""
    copied = False
    for env_idx, info in enumerate(infos):
        if EXECUTED_ACTION in info:
            if not copied:
                action, copied = np.array(action).reshape(len(infos), -1), True
            action[env_idx] = np.ravel(info[EXECUTED_ACTION])
    return action


def _concatenate(first: DictReplayBufferSamples, second: DictReplayBufferSamples) -> DictReplayBufferSamples:
    def joined(a: dict[str, th.Tensor], b: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
        return {key: th.cat([a[key], b[key]]) for key in a}

    return DictReplayBufferSamples(
        observations=joined(first.observations, second.observations),
        actions=th.cat([first.actions, second.actions]),
        next_observations=joined(first.next_observations, second.next_observations),
        dones=th.cat([first.dones, second.dones]),
        rewards=th.cat([first.rewards, second.rewards]),
    )
