"""
The original buffer D and the imaginary buffer I as one SB3 replay buffer (report, sections 3.2.1, 4.3 and 4.4).

D is a ``HerReplayBuffer`` that stores every observation once and samples in time independent of its size. I holds
*challenges*: views into D (environment, start, goal) with rewards of their own. Demonstrations, beyond the report, are a
part of D that is never overwritten.

=================  ==================================================
``storage``        the ring of observations
``compact``        how a key is stored, ``allocation``: where
``imaginary``      I
``sequences``      sequences for the world model
``demonstrations`` reading recorded trajectories
=================  ==================================================
"""

import copy
import os
import pickle
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cpm.allocation import InFolder, check_space, in_memory
from sb3_cpm.buffer_checks import check_arguments, check_environment, checked_rewards, unreadable
from sb3_cpm.challenges import ChallengeCurator, Proposal
from sb3_cpm.compact import StorageSpec, make_codecs
from sb3_cpm.demonstrations import Demonstration, as_transitions, read_demonstrations
from sb3_cpm.imaginary import Challenge, ChallengeCounters, Episode, ImaginaryBuffer
from sb3_cpm.sequences import draw_starts, read_sequences, side_by_side
from sb3_cpm.stopwatch import Stopwatch
from sb3_cpm.storage import NextObservationView, ObservationRing
from sb3_cpm.type_aliases import Evaluation, SequenceBatch

__all__ = ["EXECUTED_ACTION", "CPMBuffer", "Challenge", "ChallengeCounters", "Demonstration", "Episode"]

#: Key of ``infos[i]`` under which the exploration wrapper tells the action, within [-1, 1], that was really executed.
EXECUTED_ACTION = "cpm_executed_action"
#: Changes whenever a pickled buffer of an earlier release could be misread.
FORMAT = 2
# Bytes per transition of the books beside observations and actions: reward, done, timeout, ep_start, ep_length, final_slot
_BOOKS = 3 * 4 + 2 * 8 + 4


class CPMBuffer(HerReplayBuffer):
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
        environments without goals; ``HerReplayBuffer`` has 4
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
    :param refresh_every: re-evaluate challenges whose rewards are at least this many transitions old with today's world
        model (beyond the report). None: rewards stay those of the moment when the challenge was kept [4.3]
    :param demonstration_ratio: share of P's updates or of each batch, as ``mix`` says, from :meth:`add_demonstrations`, and of
        the challenger's sequences
    :param storage_dtypes: compact storage of keys of floats, ``{"pointcloud": "float16"}``; ``("uint8", 0.0, 1.0)`` for numbers
        between these bounds (without bounds: the space's), a list of such for one per feature of the last axis. Batches hold the
        space's dtype as ever
    :param memmap_dir: keep the observations in files in a folder of their own there, for buffers larger than memory
    :param player_keys: observation keys that batches for P hold. None: all keys, unless P's features extractor names
        those that it reads (``PointNetExtractor`` does), which the callback then passes on
    :raises ValueError: for spaces and arguments that cannot work, and if it would take more memory than the machine has
    """

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
        refresh_every: int | None = None,
        demonstration_ratio: float = 0.1,
        storage_dtypes: dict[str, StorageSpec] | None = None,
        memmap_dir: str | Path | None = None,
        player_keys: Sequence[str] | None = None,
    ):
        check_arguments(
            observation_space,
            action_space,
            challenge_ratio,
            demonstration_ratio,
            mix,
            max_challenges,
            refresh_every,
            n_sampled_goal,
            player_keys,
        )
        # The parent allocates two copies of the observations and a dict per transition: give it a single slot.
        super().__init__(
            n_envs,
            observation_space,
            action_space,
            env,  # type: ignore[arg-type]  # None is fine where no hindsight goals are sampled
            device=device,
            n_envs=n_envs,
            optimize_memory_usage=optimize_memory_usage,
            handle_timeout_termination=handle_timeout_termination,
            n_sampled_goal=n_sampled_goal,
            goal_selection_strategy=goal_selection_strategy,
            copy_info_dict=copy_info_dict,
        )
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.storage_dtypes = storage_dtypes
        self.memmap_dir = memmap_dir
        self.challenge_ratio = challenge_ratio
        self.demonstration_ratio = demonstration_ratio
        self.mix = mix
        self.max_challenges = max_challenges
        self.terminal_goals = terminal_goals
        self.refresh_every = refresh_every
        self._allocate()

        self.curator = ChallengeCurator(
            warmup_steps, kl_ratio, reward_ratio, filter_kwargs, reward_kwargs, coefficient_kwargs=coefficient_kwargs
        )
        self.player_keys = None if player_keys is None else tuple(player_keys)
        #: Demonstrations, as a buffer of their own; None while there are none.
        self.demonstrations: CPMBuffer | None = None
        #: Set by the callback while it is there to feed the curator; without it nothing would ever enter I.
        self.has_challenger = False
        self.stopwatch: Stopwatch | None = None

    # ------------------------------------------------------------------ storage

    def _allocate(self) -> None:
        """Arrays for ``buffer_size`` transitions per environment, and empty books."""
        shape = (self.buffer_size, self.n_envs)
        assert isinstance(self.obs_shape, dict)
        codecs = make_codecs(self.observation_space, self.obs_shape, self.storage_dtypes)
        n_slots = self.buffer_size * self.n_envs
        n_bytes = {key: codec.nbytes * n_slots for key, codec in codecs.items()}
        in_files = 0 if self.memmap_dir is None else sum(n_bytes.values())
        n_bytes["actions and books"] = (self.action_dim * self.actions.dtype.itemsize + _BOOKS) * n_slots
        check_space(n_bytes, in_files, self.memmap_dir, f"{type(self).__name__} of {n_slots:,} transitions")

        allocate = in_memory if self.memmap_dir is None else InFolder(self.memmap_dir)
        self.ring = ObservationRing(self.buffer_size, self.n_envs, codecs, allocate)
        self._link_ring()
        self.actions = np.zeros((*shape, self.action_dim), dtype=self.actions.dtype)
        self.rewards, self.dones, self.timeouts = (np.zeros(shape, dtype=np.float32) for _ in range(3))
        self.ep_start, self.ep_length = (np.zeros(shape, dtype=np.int64) for _ in range(2))
        self._current_ep_start = np.zeros(self.n_envs, dtype=np.int64)
        self.infos = np.empty(shape if self.copy_info_dict else (0, self.n_envs), dtype=object)

        self._episodes: list[deque[Episode]] = [deque() for _ in range(self.n_envs)]
        # Environments whose oldest, second oldest, ... complete episode starts in a slot
        self._starts: dict[int, list[int]] = {}
        self._n_episodes = np.zeros(self.n_envs, dtype=np.int64)
        # Complete episodes of an environment are contiguous in the ring and end where the current one starts, so their
        # number of transitions says which slots can be sampled.
        self._n_valid = np.zeros(self.n_envs, dtype=np.int64)
        self._valid_ends = np.cumsum(self._n_valid)
        self._n_steps = 0
        self._began = np.zeros(self.n_envs, dtype=np.int64)  # number of the step that the unfinished episodes began with
        self._earliest_began = 0
        self._completed: list[Episode] = []
        self._imaginary = ImaginaryBuffer(self.buffer_size, self.max_challenges)
        self.counters = ChallengeCounters()

    def _link_ring(self) -> None:
        self.observations = self.ring.observations
        self.next_observations = {key: NextObservationView(self.ring, key) for key in self.observations}  # type: ignore[misc]

    def reset(self) -> None:
        """Forget all transitions, episodes and challenges. Demonstrations, coefficients, tolerances and reward memory stay."""
        super().reset()
        self._allocate()

    @property
    def n_added(self) -> int:
        """Number of transitions that D has been given."""
        return self._n_steps * self.n_envs

    @property
    def nbytes(self) -> int:
        """Bytes that all arrays take (of which the system gives those in memory only as they are written to)."""
        books = (self.actions, self.rewards, self.dones, self.timeouts, self.ep_start, self.ep_length)
        ours = self.ring.nbytes + sum(array.nbytes for array in books)
        return ours + (0 if self.demonstrations is None else self.demonstrations.nbytes)

    def add(  # type: ignore[override]
        self,
        obs: dict[str, np.ndarray],
        next_obs: dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition per environment. ``infos[i]`` may name the action that was executed instead of ``action[i]``.

        :raises ValueError: if no challenger would ever fill I, an episode does not fit into the buffer, for wrong shapes,
            rewards that are not finite, values that compact storage cannot hold, a full disk; nothing is stored then
        """
        if self.challenge_ratio > 0 and not self.has_challenger:
            raise ValueError(
                f"CPMBuffer has challenge_ratio={self.challenge_ratio}, but nobody proposes challenges: pass "
                "callback=ChallengerCallback() to learn(), or replay_buffer_kwargs=dict(challenge_ratio=0) to use the "
                "buffer without challenges."
            )
        if self.stopwatch is None:
            self._add(obs, next_obs, action, reward, done, infos)
        else:
            with self.stopwatch.section("buffer"):
                self._add(obs, next_obs, action, reward, done, infos)

    def _add(
        self,
        obs: dict[str, np.ndarray],
        next_obs: dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        ring, pos, n_envs = self.ring, self.pos, self.n_envs
        # whatever can fail comes before the first change
        encoded_next = ring.encode(next_obs)
        reward = checked_rewards(reward, n_envs)
        action = _executed(np.reshape(action, (n_envs, self.action_dim)), infos)
        ring.final.reserve(2 * n_envs)
        encoded = None if ring.goes_on_with(obs) else ring.encode(obs)
        if encoded is not None:
            self._cut_discontinued_episodes(encoded)
        if self._n_steps - self._earliest_began >= self.buffer_size:
            self._refuse_long_episode()

        if pos in self._starts:
            self._make_room(pos)
        ring.write(pos, encoded)
        ring.write_next(pos, encoded_next, next_obs)
        self.actions[pos] = action
        self.rewards[pos] = reward
        self.dones[pos] = done
        self.ep_start[pos] = self._current_ep_start
        if self.copy_info_dict:
            self.infos[pos] = infos
        self.timeouts[pos] = 0
        self.pos = (pos + 1) % self.buffer_size
        self.full = self.full or self.pos == 0
        self._n_steps += 1
        dones = done.tolist()
        if True in dones:
            for env_idx, ended in enumerate(dones):
                if ended:
                    if self.handle_timeout_termination:
                        self.timeouts[pos, env_idx] = infos[env_idx].get("TimeLimit.truncated", False)
                    self._compute_episode_length(env_idx)

    def _cut_discontinued_episodes(self, encoded: dict[str, np.ndarray]) -> None:
        """
        An environment may be reset in the middle of an episode, as a second ``learn()`` does. Its last transition would
        then be taken to lead to the first observation of the new episode, so the old one ends here, as a truncation.
        """
        for env_idx in np.flatnonzero(self._began < self._n_steps):
            if not self.ring.continues(env_idx, encoded):
                self._truncate_episode(int(env_idx))

    def _refuse_long_episode(self) -> None:
        env_idx = int(np.argmin(self._began))
        raise ValueError(
            f"Environment {env_idx}: an episode is longer than the {self.buffer_size} transitions that the buffer holds "
            f"per environment. Set buffer_size to more than {self.n_envs} x the longest episode "
            f"(currently {self.buffer_size * self.n_envs}), or limit the episodes (gymnasium.wrappers.TimeLimit)."
        )

    def _make_room(self, slot: int) -> None:
        """Forget the episodes (and their challenges) whose first slot is overwritten next."""
        for env_idx in self._starts.pop(slot):
            episode = self._episodes[env_idx].popleft()
            assert episode.start == slot
            slots = episode.slots(self.buffer_size)
            self.ring.drop_episode(int(slots[-1]), env_idx)
            # The parent's way to say "not to be sampled" (it reads this array in `_sample_goals`)
            self.ep_length[slots, env_idx] = 0
            self._n_valid[env_idx] -= episode.length
            self._imaginary.forget(episode)
            if episode in self._completed:
                self._completed.remove(episode)
        self._valid_ends = np.cumsum(self._n_valid)

    def _compute_episode_length(self, env_idx: int) -> None:
        """Book an episode that ends with the newest transition."""
        start, length = int(self._current_ep_start[env_idx]), self._n_steps - int(self._began[env_idx])
        episode = Episode(env_idx, start, length, ordinal=int(self._n_episodes[env_idx]))
        stop = start + length
        self.ep_length[start : min(stop, self.buffer_size), env_idx] = length
        self.ep_length[: max(stop - self.buffer_size, 0), env_idx] = length
        self.ring.end_episode((stop - 1) % self.buffer_size, env_idx)
        self._current_ep_start[env_idx] = self.pos
        self._began[env_idx] = self._n_steps
        self._earliest_began = int(self._began.min())
        self._episodes[env_idx].append(episode)
        self._starts.setdefault(start, []).append(env_idx)
        self._n_episodes[env_idx] += 1
        self._n_valid[env_idx] += length
        self._valid_ends = np.cumsum(self._n_valid)
        if self.has_challenger:
            self._completed.append(episode)

    def _truncate_episode(self, env_idx: int) -> None:
        last = (self.pos - 1) % self.buffer_size
        self.dones[last, env_idx] = True
        self._compute_episode_length(env_idx)
        if self.handle_timeout_termination:
            self.timeouts[last, env_idx] = True  # not an actual timeout, but it allows bootstrapping

    # ------------------------------------------------------------------ sampling for P

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> DictReplayBufferSamples:  # type: ignore[override]
        """
        A batch for the player, from D, I and the demonstrations.

        :param batch_size: number of transitions
        :param env: associated VecEnv to normalize the observations and rewards
        :return: samples; observations hold ``player_keys`` only
        :raises RuntimeError: before the end of the first episode
        """
        if not self.episodes_ended:
            raise RuntimeError(
                f"Unable to sample before the end of the first episode: there is no complete one among the last {self.size() * self.n_envs} "
                "transitions. Set learning_starts to more than n_envs x the longest episode, buffer_size to more than twice that, or limit "
                "the episodes (gymnasium.wrappers.TimeLimit)."
            )
        if self.stopwatch is None:
            return self._sample(batch_size, env)
        with self.stopwatch.section("buffer"):
            return self._sample(batch_size, env)

    def _sample(self, batch_size: int, env: VecNormalize | None) -> DictReplayBufferSamples:
        n_imaginary, n_demonstrated = self._shares(batch_size)
        n_ours = batch_size - n_demonstrated
        if not n_demonstrated:
            return self._sample_own(n_ours - n_imaginary, n_imaginary, env)
        assert self.demonstrations is not None
        demonstrated = self.demonstrations._sample_own(n_demonstrated, 0, env, self._keys_for_player())
        return _concatenate(self._sample_own(n_ours - n_imaginary, n_imaginary, env), demonstrated) if n_ours else demonstrated

    def _shares(self, batch_size: int) -> tuple[int, int]:
        """:return: number of rows from I and from the demonstrations"""
        of_challenges = self.challenge_ratio if len(self._imaginary) else 0.0
        of_demonstrations = self.demonstration_ratio if self.demonstrations is not None else 0.0
        if not self._n_valid.any():  # nothing in D, hence nothing in I
            return 0, batch_size
        if self.mix == "row":
            return round(of_challenges * batch_size), round(of_demonstrations * batch_size)
        if of_challenges + of_demonstrations == 0:
            return 0, 0
        draw = np.random.random()
        if draw < of_challenges:
            return batch_size, 0
        return 0, batch_size if draw < of_challenges + of_demonstrations else 0

    def _sample_own(
        self, n_original: int, n_imaginary: int, env: VecNormalize | None, player_keys: tuple[str, ...] | None = None
    ) -> DictReplayBufferSamples:
        """
        D's share, uniform over all transitions of complete episodes, the hindsight part of them relabelled; then I's,
        uniform over all transitions of all challenges.
        """
        rows, envs = self._uniform_transitions(n_original)
        if not n_imaginary:
            return self._read(rows, envs, int(self.her_ratio * n_original), env, player_keys)
        imaginary_rows, imaginary_envs, rewards, is_goal = self._imaginary.sample(n_imaginary, self.n_added)
        return self._read(
            np.concatenate([rows, imaginary_rows]),
            np.concatenate([envs, imaginary_envs]),
            int(self.her_ratio * n_original),
            env,
            player_keys,
            rewards,
            is_goal if self.terminal_goals else None,
        )

    def _uniform_transitions(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """:return: slots and environments of n transitions of complete episodes, with replacement, each shape ``(n,)``"""
        if n == 0:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        ends = self._valid_ends
        picks = np.random.randint(ends[-1], size=n)
        if self.n_envs == 1:
            envs = np.zeros(n, dtype=np.int64)
            rows = picks + (self._current_ep_start[0] - ends[0])
        else:
            envs = ends.searchsorted(picks, side="right")
            # oldest + (pick - ends of the environment before)
            rows = picks + (self._current_ep_start - ends).take(envs)
        rows[rows < 0] += self.buffer_size
        return rows, envs

    def _read(
        self,
        rows: np.ndarray,
        envs: np.ndarray,
        n_virtual: int = 0,
        env: VecNormalize | None = None,
        player_keys: tuple[str, ...] | None = None,
        last_rewards: np.ndarray | None = None,
        last_is_goal: np.ndarray | None = None,
    ) -> DictReplayBufferSamples:
        """
        :param rows: slots of transitions, shape ``(n,)``
        :param envs: their environments, shape ``(n,)``
        :param n_virtual: the first so many get a hindsight goal
        :param env: normalizes observations and rewards
        :param player_keys: keys of the result
        :param last_rewards: rewards instead of the task's, for the last transitions
        :param last_is_goal: which of these end here
        """
        wanted = self._keys_for_player() if player_keys is None else player_keys
        at = self.ring.locate(rows, envs)
        # VecNormalize wants all the keys that it normalizes, whether P reads them or not
        keys = wanted if env is None else tuple(self.observations)
        obs: Any = {key: self.ring.read(key, at) for key in keys}
        next_obs: Any = {key: self.ring.read_next(key, at) for key in keys}
        rewards = self.rewards.reshape(-1).take(at.here)
        dones = self.dones.reshape(-1).take(at.here) * (1 - self.timeouts.reshape(-1).take(at.here))
        if n_virtual:
            goals = self._sample_goals(rows[:n_virtual], envs[:n_virtual])
            rewards[:n_virtual] = self._hindsight_rewards(rows[:n_virtual], envs[:n_virtual], goals)
            for observations in (obs, next_obs):
                if "desired_goal" in observations:
                    observations["desired_goal"][:n_virtual] = goals
        if last_rewards is not None:
            rewards[len(rewards) - len(last_rewards) :] = last_rewards
        if last_is_goal is not None:
            dones[len(dones) - len(last_is_goal) :][last_is_goal] = 1
        if env is not None:
            obs, next_obs = env.normalize_obs(obs), env.normalize_obs(next_obs)
            rewards = self._normalize_reward(rewards, env)
        device = self.device
        return DictReplayBufferSamples(
            observations={key: th.as_tensor(obs[key], device=device) for key in wanted},
            actions=th.as_tensor(self.actions.reshape(-1, self.action_dim).take(at.here, axis=0), device=device),
            next_observations={key: th.as_tensor(next_obs[key], device=device) for key in wanted},
            dones=th.as_tensor(dones.reshape(-1, 1), device=device),
            rewards=th.as_tensor(rewards.reshape(-1, 1), device=device),
        )

    def _hindsight_rewards(self, rows: np.ndarray, envs: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """The environment's rewards for what was achieved, had these been the goals, shape ``(n,)``."""
        if self.env is None:
            raise ValueError("Hindsight goals need the environment to compute their rewards: call set_env(env) first")
        achieved = self.ring.read_next("achieved_goal", self.ring.locate(rows, envs))
        infos = copy.deepcopy(self.infos[rows, envs]) if self.copy_info_dict else [{}] * len(rows)
        # all environments are taken to be alike, as the parent does
        return np.asarray(self.env.env_method("compute_reward", achieved, goals, infos, indices=[0])[0], dtype=np.float32).reshape(-1)

    def _get_real_samples(
        self, batch_indices: np.ndarray, env_indices: np.ndarray, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        """As the parent's, without hindsight goals."""
        return self._read(batch_indices, env_indices, 0, env)

    def _get_virtual_samples(
        self, batch_indices: np.ndarray, env_indices: np.ndarray, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        """As the parent's, with hindsight goals."""
        return self._read(batch_indices, env_indices, len(batch_indices), env)

    def _keys_for_player(self) -> tuple[str, ...]:
        return tuple(self.observations) if self.player_keys is None else self.player_keys

    # ------------------------------------------------------------------ sequences for C

    def sample_sequences(self, batch_size: int, length: int, keys: Sequence[str] | None = None) -> SequenceBatch:
        """
        Sequences of consecutive states for the world model, starting anywhere in D, across episode boundaries.

        Starts are uniform over the transitions that at least ``length - 1`` transitions of complete episodes follow in
        the same environment. An environment with fewer gives what it has, padded and masked. Each sequence comes from the
        demonstrations with probability ``demonstration_ratio``.

        :param batch_size: number of sequences
        :param length: rows per sequence
        :param keys: observation keys; None: all
        :return: time-major batch, see :class:`~sb3_cpm.type_aliases.SequenceBatch`
        :raises RuntimeError: before the end of the first episode
        """
        if not self.episodes_ended:
            raise RuntimeError(f"No complete episode to sample sequences from after {self.n_added} transitions")
        keys = tuple(self.observations) if keys is None else tuple(keys)
        n_demonstrated, parts = 0, []
        if self.demonstrations is not None:
            n_demonstrated = np.random.binomial(batch_size, self.demonstration_ratio) if self._n_valid.any() else batch_size
        if n_demonstrated:
            assert self.demonstrations is not None
            parts.append(self.demonstrations.sample_sequences(n_demonstrated, length, keys))
        if n_demonstrated < batch_size:
            envs, offsets = draw_starts(self._n_valid, batch_size - n_demonstrated, length)
            parts.append(self._read_sequences(envs, offsets, length, keys))
        return side_by_side(parts)

    def _read_sequences(self, envs: np.ndarray, offsets: np.ndarray, length: int, keys: Sequence[str]) -> SequenceBatch:
        n_valid = self._n_valid[envs]
        oldest = self._current_ep_start[envs] - n_valid
        return read_sequences(self, oldest, n_valid, envs, offsets, length, keys)

    # ------------------------------------------------------------------ challenges

    def pop_completed(self) -> list[Episode]:
        """:return: the episodes that ended since the last call and are still whole in D, oldest first"""
        completed, self._completed = self._completed, []
        return completed

    def episode_observations(self, episode: Episode, keys: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """
        :param episode: an episode that is still in D
        :param keys: observation keys; None: all
        :return: its states, one array of shape ``(length + 1, *observation_shape)`` per key
        :raises ValueError: if D has overwritten it
        """
        self._check_present(episode)
        slots = episode.slots(self.buffer_size)
        at = self.ring.locate(slots, np.full(episode.length, episode.env_idx))
        last = self.ring.locate(slots[-1:], np.array([episode.env_idx]))
        return {
            key: np.concatenate([self.ring.read(key, at), self.ring.read_next(key, last)])
            for key in (self.observations if keys is None else keys)
        }

    def episode_actions(self, episode: Episode) -> np.ndarray:
        """:return: executed actions of an episode that is still in D, within [-1, 1], shape ``(length, action_dim)``"""
        self._check_present(episode)
        return self.actions[episode.slots(self.buffer_size), episode.env_idx]

    def propose(self, episode: Episode, evaluation: Evaluation) -> Proposal | None:
        """
        Choose a goal in an episode, filter, and keep the challenge in I if it passes.

        :param episode: a complete episode that is still in D
        :param evaluation: the challenger's evaluation of it
        :return: what was decided; None if the episode is too short to have a transition that counts
        :raises ValueError: for an evaluation that does not fit the episode; nothing is changed then
        """
        self._check_present(episode)
        proposal = self.curator.propose(self.rewards[episode.slots(self.buffer_size), episode.env_idx], evaluation)
        if proposal is None:
            return None
        self.counters.count(proposal)
        if proposal.accepted:
            self._imaginary.keep(episode, proposal, self.n_added)
        return proposal

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
        """Let an episode count for the mean reward memory without proposing a challenge (while C knows nothing yet)."""
        self._check_present(episode)
        self.curator.filter.remember(float(self.rewards[episode.slots(self.buffer_size), episode.env_idx].mean()))

    def _check_present(self, episode: Episode) -> None:
        episodes = self._episodes[episode.env_idx]
        if not episodes or not episodes[0].ordinal <= episode.ordinal <= episodes[-1].ordinal:
            raise ValueError(f"{episode} is no longer in the buffer, which holds {self.buffer_size} transitions per environment")

    @property
    def episodes(self) -> list[Episode]:
        """Complete episodes in D, by environment, oldest first."""
        return [episode for episodes in self._episodes for episode in episodes]

    @property
    def episodes_ended(self) -> bool:
        """Whether there is a complete episode to sample from, in D or among the demonstrations."""
        return bool(self._valid_ends[-1]) or self.demonstrations is not None

    @property
    def challenges(self) -> list[Challenge]:
        """Challenges in I, oldest first."""
        return self._imaginary.inspect(self.n_added)

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients, tolerances and reward memory by the report's names."""
        return self.curator.coefficients

    # ------------------------------------------------------------------ demonstrations

    def add_demonstrations(self, source: str | Path | Sequence[Demonstration], env: Any = None) -> int:
        """
        Add recorded episodes. They are never overwritten, and are sampled with ``demonstration_ratio``.

        :param source: ManiSkill's trajectory file (``.h5``, with the ``.json`` of the same name beside it), or episodes
        :param env: a single environment, as made for training, in which recorded actions are replayed where the file does not
            hold this buffer's observations
        :return: number of episodes added
        :raises ValueError: for files and episodes that don't fit; nothing is added then
        """
        if isinstance(source, (str, Path)):
            source = read_demonstrations(source, self.observation_space, self.action_space, env)
        if not source:
            raise ValueError("No demonstrations given")
        steps = [step for episode in source for step in as_transitions(episode, self.observation_space, self.action_space)]
        earlier = self.demonstrations
        n_earlier = 0 if earlier is None else earlier.size()
        grown = CPMBuffer(
            n_earlier + len(steps),
            self.observation_space,
            self.action_space,
            self.env,
            self.device,
            handle_timeout_termination=self.handle_timeout_termination,
            n_sampled_goal=self.n_sampled_goal,
            goal_selection_strategy=self.goal_selection_strategy,
            challenge_ratio=0,
            storage_dtypes=self.storage_dtypes,
            memmap_dir=self.memmap_dir,
        )
        if earlier is not None:
            for row in range(n_earlier):
                grown.add(*earlier._transition(row))
        for step in steps:
            grown.add(*step)
        self.demonstrations = grown
        return len(source)

    def _transition(self, row: int) -> tuple[Any, ...]:
        """What was given to ``add()``."""
        at = self.ring.locate(np.full(self.n_envs, row), np.arange(self.n_envs))
        return (
            {key: self.ring.read(key, at) for key in self.observations},
            {key: self.ring.read_next(key, at) for key in self.observations},
            self.actions[row],
            self.rewards[row],
            self.dones[row],
            [{"TimeLimit.truncated": bool(timeout)} for timeout in self.timeouts[row]],
        )

    # ------------------------------------------------------------------ environment, saving, loading

    def set_env(self, env: VecEnv) -> None:
        """
        Set the environment, after loading.

        :param env: the training environment
        :raises ValueError: if the buffer was filled in environments of another kind or number
        """
        check_environment(env, self.observation_space, self.action_space, self.n_envs)
        super().set_env(env)
        if self.demonstrations is not None:
            self.demonstrations.env = env

    def truncate_last_trajectory(self) -> None:
        """As the parent's, and also for an episode that fills the buffer exactly."""
        if (self._began < self._n_steps).any() and (self._current_ep_start == self.pos).all():
            for env_idx in np.flatnonzero(self._began < self._n_steps):
                self._truncate_episode(int(env_idx))
        super().truncate_last_trajectory()

    def save(self, path: str | Path) -> None:
        """
        Save everything, as ``model.save_replay_buffer(path)`` does, but never leave half a file.

        :param path: file to write, replaced only once it is complete
        """
        path = Path(path)
        temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
        try:
            with temporary.open("wb") as file:
                pickle.dump(self, file, protocol=pickle.HIGHEST_PROTOCOL)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | Path, env: VecEnv | None = None) -> "CPMBuffer":
        """
        Load what :meth:`save` or ``model.save_replay_buffer()`` saved.

        :param path: the file
        :param env: the training environment (for hindsight goals)
        :raises ValueError: if it is truncated, foreign, or of a release that this one cannot read
        """
        with Path(path).open("rb") as file:
            try:
                buffer = pickle.load(file)
            except Exception as error:  # a damaged pickle can raise nearly anything
                raise unreadable(path, error) from error
        if not isinstance(buffer, CPMBuffer):
            raise ValueError(f"{path} holds a {type(buffer).__name__}, not a CPMBuffer")
        if env is not None:
            buffer.set_env(env)
        return buffer

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        # views are made anew; the challenger and its stopwatch belong to a running learn()
        for name in ("observations", "next_observations", "stopwatch", "has_challenger"):
            del state[name]
        return {**state, "format": FORMAT}

    def __setstate__(self, state: dict[str, Any]) -> None:
        state = dict(state)
        found = state.pop("format", None)
        if found != FORMAT:
            raise ValueError(
                f"This replay buffer was saved in format {found}, this version of sb3_cpm reads format {FORMAT}: how observations are "
                "laid out has changed. Collect it anew, or load it with the version that saved it."
            )
        super().__setstate__(state)
        self.stopwatch, self.has_challenger = None, False
        self._link_ring()


def _executed(action: np.ndarray, infos: Sequence[dict[str, Any]]) -> np.ndarray:
    """P's actions, replaced wherever the challenger acted instead."""
    copied = False
    for env_idx, info in enumerate(infos):
        if EXECUTED_ACTION in info:
            if not copied:
                action, copied = action.copy(), True
            action[env_idx] = info[EXECUTED_ACTION]
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
