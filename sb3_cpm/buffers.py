"""
The original buffer D and the imaginary buffer I as one SB3 replay buffer (report, sections 3.2.1, 4.3 and 4.4).

D is a ``HerReplayBuffer`` that stores every observation once and samples in time independent of its size. I holds
*challenges*: views into D (environment, start, goal) with rewards of their own.
"""

import warnings
from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cpm.challenges import CRITERIA, ChallengeCurator, Proposal
from sb3_cpm.stopwatch import Stopwatch
from sb3_cpm.storage import NextObservationView, ObservationRing
from sb3_cpm.type_aliases import Evaluation, SequenceBatch

#: Key of ``infos[i]`` under which the exploration wrapper tells the action, within [-1, 1], that was really executed.
EXECUTED_ACTION = "cpm_executed_action"
#: Changes whenever a pickled buffer of an earlier release could be misread.
FORMAT = 1


@dataclass(frozen=True)
class Episode:
    """
    A complete episode in D.

    :param env_idx: environment that it was played in
    :param start: slot of its first transition in the ring
    :param length: number of transitions
    :param ordinal: how many episodes of this environment came before it
    """

    env_idx: int
    start: int
    length: int
    ordinal: int

    def slots(self, buffer_size: int) -> np.ndarray:
        """Slots of its transitions in a ring of ``buffer_size``, shape ``(length,)``."""
        return np.arange(self.start, self.start + self.length) % buffer_size


@dataclass(frozen=True)
class Challenge:
    """
    A challenge in I: transitions ``first`` to ``goal`` of an episode, with artificial rewards.

    :param episode: the episode in D that it is cut from
    :param proposal: its evaluation and its rewards
    :param added_at: number of transitions that D had been given when the challenge was kept, for its age
    """

    episode: Episode
    proposal: Proposal
    added_at: int


@dataclass
class ChallengeCounters:
    """How many candidates there were, how many were kept, and how many each criterion alone would have rejected."""

    proposed: int = 0
    kept: int = 0
    rejected_by: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CRITERIA, 0))

    def count(self, proposal: Proposal) -> None:
        self.proposed += 1
        self.kept += proposal.accepted
        for name, verdict in proposal.verdicts.items():
            self.rejected_by[name] += not verdict


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
    :param player_keys: observation keys that batches for P hold. None: all keys, unless P's features extractor names
        those that it reads (``PointNetExtractor`` does), which the callback then passes on
    :raises ValueError: for spaces and arguments that cannot work
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
        player_keys: Sequence[str] | None = None,
    ):
        _check_arguments(observation_space, action_space, challenge_ratio, mix, max_challenges, n_sampled_goal, player_keys)
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
        self._allocate()

        self.challenge_ratio = challenge_ratio
        self.mix = mix
        self.max_challenges = max_challenges
        self.terminal_goals = terminal_goals
        self.curator = ChallengeCurator(
            warmup_steps, kl_ratio, reward_ratio, filter_kwargs, reward_kwargs, coefficient_kwargs=coefficient_kwargs
        )
        self.player_keys = None if player_keys is None else tuple(player_keys)
        #: Set by the callback while it is there to feed the curator; without it nothing would ever enter I.
        self.has_challenger = False
        self.stopwatch: Stopwatch | None = None

    # ------------------------------------------------------------------ storage

    def _allocate(self) -> None:
        """Arrays for ``buffer_size`` transitions per environment, and empty books."""
        shape = (self.buffer_size, self.n_envs)
        dtypes = {key: space.dtype for key, space in self.observation_space.spaces.items()}
        self._ring = ObservationRing(self.buffer_size, self.n_envs, self.obs_shape, dtypes)
        self._link_ring()
        self.actions = np.zeros((*shape, self.action_dim), dtype=self.actions.dtype)
        self.rewards, self.dones, self.timeouts = (np.zeros(shape, dtype=np.float32) for _ in range(3))
        self.ep_start, self.ep_length = (np.zeros(shape, dtype=np.int64) for _ in range(2))
        self._current_ep_start = np.zeros(self.n_envs, dtype=np.int64)
        self.infos = np.empty(shape if self.copy_info_dict else (0, self.n_envs), dtype=object)
        _warn_if_too_large(self._ring.nbytes + self.actions.nbytes + 20 * self.buffer_size * self.n_envs)

        self._episodes: list[deque[Episode]] = [deque() for _ in range(self.n_envs)]
        self._n_episodes = np.zeros(self.n_envs, dtype=np.int64)
        # Complete episodes of an environment are contiguous in the ring and end where the current one starts, so their
        # number of transitions says which slots can be sampled.
        self._n_valid = np.zeros(self.n_envs, dtype=np.int64)
        self._n_current = np.zeros(self.n_envs, dtype=np.int64)  # transitions of the unfinished episodes
        self.n_added = 0
        self._completed: list[Episode] = []
        self._challenges: deque[Challenge] = deque()
        self._imaginary: _ImaginaryIndex | None = None
        self.counters = ChallengeCounters()

    def _link_ring(self) -> None:
        self.observations = self._ring.observations
        self.next_observations = {key: NextObservationView(self._ring, key) for key in self.observations}  # type: ignore[misc]

    def reset(self) -> None:
        """Forget all transitions, episodes and challenges. Coefficients, tolerances and reward memory stay."""
        super().reset()
        self._allocate()

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

        :raises ValueError: if no challenger would ever fill I, or an episode does not fit into the buffer
        """
        if self.challenge_ratio > 0 and not self.has_challenger:
            raise ValueError(
                f"CPMBuffer has challenge_ratio={self.challenge_ratio}, but nobody proposes challenges: pass "
                "callback=ChallengerCallback() to learn(), or replay_buffer_kwargs=dict(challenge_ratio=0) to use the "
                "buffer without challenges."
            )
        with self._section():
            self._cut_discontinued_episodes(obs)
            self._make_room()
            self._n_current += 1
            self.n_added += self.n_envs
            super().add(obs, next_obs, _executed(action, infos, self.n_envs, self.action_dim), reward, done, infos)

    def _cut_discontinued_episodes(self, obs: dict[str, np.ndarray]) -> None:
        """
        An environment may be reset in the middle of an episode, as a second ``learn()`` does. Its last transition would
        then be taken to lead to the first observation of the new episode, so the old one ends here, as a truncation.
        """
        for env_idx in np.flatnonzero(self._n_current):
            if not self._ring.continues(env_idx, obs):
                self._truncate_episode(int(env_idx))

    def _make_room(self) -> None:
        """Forget the episodes (and their challenges) whose first slot is overwritten next."""
        for env_idx, episodes in enumerate(self._episodes):
            if self.full and episodes and episodes[0].start == self.pos:
                self._drop(episodes.popleft())
            elif self._n_current[env_idx] == self.buffer_size:
                raise ValueError(
                    f"Environment {env_idx}: an episode is longer than the {self.buffer_size} transitions that the buffer holds "
                    f"per environment. Set buffer_size to more than {self.n_envs} x the longest episode "
                    f"(currently {self.buffer_size * self.n_envs}), or limit the episodes (gymnasium.wrappers.TimeLimit)."
                )

    def _drop(self, episode: Episode) -> None:
        slots = episode.slots(self.buffer_size)
        self._ring.drop_episode(int(slots[-1]), episode.env_idx)
        # The parent's way to say "not to be sampled" (it reads this array in `_sample_goals`)
        self.ep_length[slots, episode.env_idx] = 0
        self._n_valid[episode.env_idx] -= episode.length
        kept = [challenge for challenge in self._challenges if challenge.episode != episode]
        if len(kept) < len(self._challenges):
            self._challenges, self._imaginary = deque(kept), None
        if episode in self._completed:
            self._completed.remove(episode)

    def _compute_episode_length(self, env_idx: int) -> None:
        """Book an episode that ends with the newest transition."""
        episode = Episode(
            env_idx,
            start=int(self._current_ep_start[env_idx]),
            length=int(self._n_current[env_idx]),
            ordinal=int(self._n_episodes[env_idx]),
        )
        slots = episode.slots(self.buffer_size)
        self.ep_length[slots, env_idx] = episode.length
        self._ring.end_episode(int(slots[-1]), env_idx)
        self._current_ep_start[env_idx] = self.pos
        self._episodes[env_idx].append(episode)
        self._n_episodes[env_idx] += 1
        self._n_valid[env_idx] += episode.length
        self._n_current[env_idx] = 0
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
        A batch for the player, from D and I.

        :param batch_size: number of transitions
        :param env: associated VecEnv to normalize the observations and rewards
        :return: samples; observations hold ``player_keys`` only
        :raises RuntimeError: before the end of the first episode
        """
        if not self.episodes_ended:
            raise RuntimeError(
                f"Unable to sample: there is no complete episode among the last {self.size() * self.n_envs} transitions. Set "
                "learning_starts to more than n_envs x the longest episode, buffer_size to more than twice that, or limit the "
                "episodes (gymnasium.wrappers.TimeLimit)."
            )
        with self._section():
            n_imaginary = self._n_imaginary_rows(batch_size)
            parts = [self._sample_imaginary(n_imaginary, env)] if n_imaginary else []
            if n_imaginary < batch_size:
                parts.extend(self._sample_original(batch_size - n_imaginary, env))
            return parts[0] if len(parts) == 1 else _concatenate(parts)

    def _n_imaginary_rows(self, batch_size: int) -> int:
        if not self._challenges:
            return 0
        if self.mix == "row":
            return round(self.challenge_ratio * batch_size)
        return batch_size if np.random.random() < self.challenge_ratio else 0

    def _sample_original(self, batch_size: int, env: VecNormalize | None) -> list[DictReplayBufferSamples]:
        """D's share: uniform over all transitions of complete episodes, the hindsight part of them relabelled."""
        slots, envs = self._uniform_transitions(batch_size)
        n_virtual = int(self.her_ratio * batch_size)
        parts = []
        if n_virtual < batch_size:
            parts.append(self._get_real_samples(slots[n_virtual:], envs[n_virtual:], env))
        if n_virtual:
            virtual = self._get_virtual_samples(slots[:n_virtual], envs[:n_virtual], env)
            parts.append(
                virtual._replace(
                    observations=self._for_player(virtual.observations),
                    next_observations=self._for_player(virtual.next_observations),
                )
            )
        return parts

    def _uniform_transitions(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """:return: slots and environments of n transitions of complete episodes, with replacement, each shape ``(n,)``"""
        ends = np.cumsum(self._n_valid)
        picks = np.random.randint(ends[-1], size=n)
        envs = np.searchsorted(ends, picks, side="right")
        offsets = picks - (ends - self._n_valid)[envs]
        return (self._oldest(envs) + offsets) % self.buffer_size, envs

    def _oldest(self, envs: np.ndarray) -> np.ndarray:
        """Slots where the oldest complete episodes of environments start (may be negative: counted back from slot 0)."""
        return self._current_ep_start[envs] - self._n_valid[envs]

    def _sample_imaginary(self, batch_size: int, env: VecNormalize | None) -> DictReplayBufferSamples:
        """I's share: uniform over all transitions of all challenges."""
        if self._imaginary is None:
            self._imaginary = _ImaginaryIndex.of(self._challenges, self.buffer_size)
        index = self._imaginary
        picks = np.random.randint(len(index.slots), size=batch_size)
        samples = self._get_real_samples(index.slots[picks], index.envs[picks], env)
        rewards = self._normalize_reward(index.rewards[picks].reshape(-1, 1), env)
        samples = samples._replace(rewards=self.to_torch(rewards, copy=False))
        if self.terminal_goals:
            dones = self.to_torch(index.is_goal[picks].astype(np.float32).reshape(-1, 1), copy=False)
            samples = samples._replace(dones=th.maximum(samples.dones, dones))
        return samples

    def _get_real_samples(
        self, batch_indices: np.ndarray, env_indices: np.ndarray, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        """As the parent's, but only the keys that P reads, and without copying a fresh array once more."""
        # VecNormalize wants all the keys that it normalizes, whether P reads them or not
        keys = self._keys_for_player() if env is None else tuple(self.observations)
        obs = self._normalize_obs({key: self.observations[key][batch_indices, env_indices] for key in keys}, env)
        next_obs = self._normalize_obs(
            {key: self._ring.next_observation(key, batch_indices, env_indices) for key in keys}, env
        )
        dones = self.dones[batch_indices, env_indices] * (1 - self.timeouts[batch_indices, env_indices])
        rewards = self._normalize_reward(self.rewards[batch_indices, env_indices].reshape(-1, 1), env)
        return DictReplayBufferSamples(
            observations={key: self.to_torch(obs[key], copy=False) for key in self._keys_for_player()},
            actions=self.to_torch(self.actions[batch_indices, env_indices], copy=False),
            next_observations={key: self.to_torch(next_obs[key], copy=False) for key in self._keys_for_player()},
            dones=self.to_torch(dones.reshape(-1, 1), copy=False),
            rewards=self.to_torch(rewards, copy=False),
        )

    def _keys_for_player(self) -> tuple[str, ...]:
        return tuple(self.observations) if self.player_keys is None else self.player_keys

    def _for_player(self, observations: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
        return {key: observations[key] for key in self._keys_for_player()}

    # ------------------------------------------------------------------ sequences for C

    def sample_sequences(self, batch_size: int, length: int, keys: Sequence[str] | None = None) -> SequenceBatch:
        """
        Sequences of consecutive states for the world model, starting anywhere in D, across episode boundaries.

        Starts are uniform over the transitions that at least ``length - 1`` transitions of complete episodes follow in
        the same environment. An environment with fewer gives what it has, padded and masked.

        :param batch_size: number of sequences
        :param length: rows per sequence
        :param keys: observation keys; None: all
        :return: time-major batch, see :class:`~sb3_cpm.type_aliases.SequenceBatch`
        :raises RuntimeError: before the end of the first episode
        """
        if not self.episodes_ended:
            raise RuntimeError(f"No complete episode to sample sequences from after {self.n_added} transitions")
        n_starts = np.where(self._n_valid > 0, np.maximum(self._n_valid - length + 1, 1), 0)
        ends = np.cumsum(n_starts)
        picks = np.random.randint(ends[-1], size=batch_size)
        envs = np.searchsorted(ends, picks, side="right")
        offsets = picks - (ends - n_starts)[envs]
        return self._read_sequences(envs, offsets, length, tuple(self.observations) if keys is None else tuple(keys))

    def _read_sequences(self, envs: np.ndarray, offsets: np.ndarray, length: int, keys: Sequence[str]) -> SequenceBatch:
        """
        Walk ``length`` rows along each environment, from the state that transition number ``offset`` starts in.

        Row and transition numbers differ, as an episode of T transitions has T + 1 states: after the transition that ends
        an episode, its next observation is a row of its own, and only then comes the following transition's state.
        """
        oldest, n_valid = self._oldest(envs), self._n_valid[envs]
        slots = np.empty((length, len(envs)), dtype=np.int64)  # of the transition that starts in, or led to, the state
        final = np.zeros((length, len(envs)), dtype=bool)  # the row is the last state of its episode
        mask = np.ones((length, len(envs)), dtype=bool)
        at_final = np.zeros(len(envs), dtype=bool)
        for row in range(length):
            mask[row] = offsets < n_valid
            slots[row] = (oldest + np.minimum(offsets, n_valid - 1)) % self.buffer_size
            final[row] = at_final
            ends_episode = self._ring.final_slot[slots[row], envs] >= 0
            # next row: the final state of this episode, or the state of the following transition
            offsets = np.where(ends_episode & ~at_final, offsets, offsets + 1)
            at_final = ends_episode & ~at_final
        final &= mask

        is_first = (self.ep_start[slots, envs] == slots) & ~final
        led_here = np.where(final, slots, (slots - 1) % self.buffer_size)
        inside = mask & ~is_first
        actions = self.actions[led_here, envs].astype(np.float32) * inside[..., None]
        rewards = self.rewards[led_here, envs] * inside
        is_terminal = final & (self.dones[slots, envs] > 0) & (self.timeouts[slots, envs] == 0)
        return SequenceBatch(
            observations={key: self._states(key, slots, np.broadcast_to(envs, slots.shape), final) for key in keys},
            actions=actions,
            rewards=rewards,
            is_first=is_first & mask,
            is_terminal=is_terminal,
            mask=mask,
        )

    def _states(self, key: str, slots: np.ndarray, envs: np.ndarray, final: np.ndarray) -> np.ndarray:
        states = self.observations[key][slots, envs]
        if final.any():
            states[final] = self._ring.next_observation(key, slots[final], envs[final])
        return states

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
        last, env_idx = slots[-1:], np.array([episode.env_idx])
        return {
            key: np.concatenate(
                [self.observations[key][slots, episode.env_idx], self._ring.next_observation(key, last, env_idx)]
            )
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
            if len(self._challenges) >= self.max_challenges:
                self._challenges.popleft()
            self._challenges.append(Challenge(episode, proposal, self.n_added))
            self._imaginary = None
        return proposal

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
        """Whether there is a complete episode in D to sample from."""
        return bool(self._n_valid.any())

    @property
    def challenges(self) -> list[Challenge]:
        """Challenges in I, oldest first."""
        return list(self._challenges)

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients, tolerances and reward memory by the report's names."""
        return self.curator.coefficients

    # ------------------------------------------------------------------ pickling

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
            raise ValueError(f"This replay buffer was saved in format {found}, this version of sb3_cpm reads format {FORMAT}")
        super().__setstate__(state)
        self.stopwatch, self.has_challenger = None, False
        self._link_ring()

    def _section(self) -> AbstractContextManager[None]:
        return nullcontext() if self.stopwatch is None else self.stopwatch.section("buffer")


@dataclass(frozen=True)
class _ImaginaryIndex:
    """All transitions of I one after another, each array of shape ``(transitions in I,)``."""

    slots: np.ndarray
    envs: np.ndarray
    rewards: np.ndarray
    is_goal: np.ndarray

    @classmethod
    def of(cls, challenges: Sequence[Challenge] | deque[Challenge], buffer_size: int) -> "_ImaginaryIndex":
        slots, envs, rewards, is_goal = [], [], [], []
        for challenge in challenges:
            proposal = challenge.proposal
            assert proposal.artificial is not None
            steps = np.arange(proposal.first, proposal.goal + 1)
            slots.append((challenge.episode.start + steps) % buffer_size)
            envs.append(np.full(len(steps), challenge.episode.env_idx))
            rewards.append(proposal.artificial.total.astype(np.float32))
            is_goal.append(steps == proposal.goal)
        return cls(*(np.concatenate(parts) for parts in (slots, envs, rewards, is_goal)))


def _executed(action: np.ndarray, infos: Sequence[dict[str, Any]], n_envs: int, action_dim: int) -> np.ndarray:
    """P's actions, replaced wherever the challenger acted instead."""
    if any(EXECUTED_ACTION in info for info in infos):
        action = np.array(action).reshape(n_envs, action_dim)
        for env_idx, info in enumerate(infos):
            if EXECUTED_ACTION in info:
                action[env_idx] = info[EXECUTED_ACTION]
    return action


def _concatenate(parts: Sequence[DictReplayBufferSamples]) -> DictReplayBufferSamples:
    def joined(name: str) -> dict[str, th.Tensor]:
        return {key: th.cat([getattr(part, name)[key] for part in parts]) for key in getattr(parts[0], name)}

    return DictReplayBufferSamples(
        observations=joined("observations"),
        actions=th.cat([part.actions for part in parts]),
        next_observations=joined("next_observations"),
        dones=th.cat([part.dones for part in parts]),
        rewards=th.cat([part.rewards for part in parts]),
    )


def _check_arguments(
    observation_space: spaces.Space,
    action_space: spaces.Space,
    challenge_ratio: float,
    mix: str,
    max_challenges: int,
    n_sampled_goal: int,
    player_keys: Sequence[str] | None,
) -> None:
    if not isinstance(observation_space, spaces.Dict):
        raise ValueError(
            f"CPMBuffer needs a Dict observation space, got {observation_space}. Wrap the environment in "
            'sb3_cpm.envs.DictObservation(env) and use "MultiInputPolicy" (SAC, TD3, DDPG and TQC have one, CrossQ has none).'
        )
    if not 0 <= challenge_ratio <= 1:
        raise ValueError(f"challenge_ratio is the share of batches from I and must lie in [0, 1], got {challenge_ratio}")
    if challenge_ratio > 0 and not isinstance(action_space, spaces.Box):
        raise ValueError(
            f"Challenges need continuous actions (a Box action space), got {action_space}. Use SAC, TD3, DDPG or TQC on a "
            "continuous environment, or challenge_ratio=0 to use the buffer without challenges."
        )
    if mix not in ("batch", "row"):
        raise ValueError(f'mix must be "batch" or "row", got {mix!r}')
    if max_challenges < 1:
        raise ValueError(f"max_challenges must be at least 1, got {max_challenges}; use challenge_ratio=0 for no challenges")
    missing = {"achieved_goal", "desired_goal"} - set(observation_space.spaces)
    if n_sampled_goal > 0 and missing:
        raise ValueError(
            f"n_sampled_goal={n_sampled_goal} asks for hindsight goals, but the observations have no {sorted(missing)}; "
            "use n_sampled_goal=0 on an environment without goals."
        )
    unknown = set(player_keys or ()) - set(observation_space.spaces)
    if unknown:
        raise ValueError(f"player_keys {sorted(unknown)} are not among the observation keys {sorted(observation_space.spaces)}")


def _warn_if_too_large(n_bytes: int) -> None:
    try:
        import psutil
    except ImportError:  # as in SB3, the check is made where psutil is there
        return
    available = psutil.virtual_memory().available
    if n_bytes > available:
        warnings.warn(
            f"The replay buffer will take {n_bytes / 1e9:.2f} GB when it is full, but only {available / 1e9:.2f} GB of memory "
            "are available. Use a smaller buffer_size, image size or number of points."
        )
