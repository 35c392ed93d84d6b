"""
D: whole episodes in a replay buffer that stores every observation once and samples in time independent of its size.

By itself this is a faster ``HerReplayBuffer`` of half the memory; :class:`~sb3_cpm.buffers.CPMBuffer` adds challenges and
demonstrations. Where episodes lie and how one is drawn is in :mod:`sb3_cpm.buffers.books`.
"""

import copy
import inspect
import pickle
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from typing_extensions import Self

from sb3_cpm.buffers.allocation import InFolder, check_space, in_memory
from sb3_cpm.buffers.books import EpisodeBooks
from sb3_cpm.buffers.checks import (
    check_construction,
    check_environment,
    check_player_reads_images,
    check_spaces,
    checked_actions,
    checked_dones,
    checked_hindsight_rewards,
    checked_infos,
    checked_rewards,
    compute_reward_failed,
    holds_pickles,
    unreadable,
)
from sb3_cpm.buffers.compact import StorageSpec, make_codecs
from sb3_cpm.buffers.saving import pack_space, unpack_space
from sb3_cpm.buffers.sequences import draw_starts, read_sequences
from sb3_cpm.buffers.storage import Episode, Locations, NextObservationView, ObservationRing
from sb3_cpm.files import Archive, DamagedFileError, write_archive
from sb3_cpm.packing import pack, unpack
from sb3_cpm.spaces import CHALLENGE
from sb3_cpm.type_aliases import SequenceBatch

#: Changes whenever a buffer of an earlier release could be misread: of one that was pickled, and of one in a file of ours.
FORMAT, FILE_FORMAT = 2, 3
_VIEWS = ("observations", "next_observations", "rewards", "dones", "timeouts", "ep_start", "ep_length", "_current_ep_start")
#: Arguments that belong to where a buffer is used, and what else ``locals()`` has
NOT_SAVED = ("self", "__class__", "env", "device")
# Bytes per transition of the books beside observations and actions: reward, done, timeout, ep_start, ep_length, final_slot
_BOOKS = 3 * 4 + 2 * 8 + 4


#: Observations by key (tensors on P's device, each of shape ``(n, *shape)``), actions within [-1, 1], shape
#: ``(n, action_dim)``, and the environment's rewards, shape ``(n, 1)``, to those that P learns from, shape ``(n, 1)``.
RewardFunction = Callable[[dict[str, th.Tensor], th.Tensor, th.Tensor], th.Tensor]

#: Key of ``infos[i]`` with the next observation as the environment gave it. What SB3 calls the ``terminal_observation`` has
#: been clipped by a VecNormalize, and integers are cut off when it is un-normalized.
NEXT_OBSERVATION = "cpm_next_observation"
#: Key of ``infos[i]`` with the reward as the environment gave it, where SB3 has another one by mistake.
REWARD = "cpm_reward"


class EpisodeBuffer(HerReplayBuffer):
    """
    Replay buffer of whole episodes, each observation stored once.

    :param buffer_size: max number of transitions
    :param observation_space: observation space, a Dict
    :param action_space: action space
    :param env: the training environment (only used for hindsight goals)
    :param device: PyTorch device
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: not needed, must be False
    :param handle_timeout_termination: bootstrap at time limits
    :param n_sampled_goal: number of hindsight transitions per real one; 0 works on environments without goals. Their rewards
        come from the environment's ``compute_reward``, see :class:`~sb3_cpm.buffers.CPMBuffer`
    :param goal_selection_strategy: one of 'episode', 'final', 'future'
    :param copy_info_dict: pass the infos to ``compute_reward()``
    :param storage_dtypes: compact storage of keys of floats, ``{"pointcloud": "float16"}``; ``("uint8", 0.0, 1.0)`` for
        numbers between these bounds (without bounds: the space's), a list of such for one per feature of the last axis.
        Batches hold the space's dtype as ever
    :param memmap_dir: keep the observations in files in a folder of their own there, for buffers larger than memory
    :param player_keys: observation keys that batches hold; None: all keys
    :param challenge_keys: keys that make the goal of a challenge, where a
        :class:`~sb3_cpm.challenge_env.ChallengeVecEnv` adds ``"challenge"`` to the observations; None: those that the
        environment names
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
        storage_dtypes: dict[str, StorageSpec] | None = None,
        memmap_dir: str | Path | None = None,
        player_keys: Sequence[str] | None = None,
        challenge_keys: Sequence[str] | None = None,
    ):
        if challenge_keys is None:
            challenge_keys = getattr(env, "challenge_keys", None)
        self._given = {name: value for name, value in locals().items() if name not in NOT_SAVED}
        check_spaces(observation_space, n_sampled_goal, player_keys)
        check_player_reads_images(observation_space)
        check_construction(buffer_size, n_envs, optimize_memory_usage, goal_selection_strategy)
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
        self.player_keys = None if player_keys is None else tuple(player_keys)
        #: Keys that the goal of a challenge consists of; None where P is not told which challenge it plays.
        self.challenge_keys = None if challenge_keys is None else tuple(challenge_keys)
        self.attach_reward(None)
        self._allocate()

    # ------------------------------------------------------------------ whose rewards P gets

    def attach_reward(
        self, function: RewardFunction | None, keys: Sequence[str] = (), is_on: Callable[[], bool] = lambda: True
    ) -> None:
        """
        Give P other rewards, anew whenever it samples; those that are stored stay the environment's. Never saved.

        :param function: to those rewards; None: P gets the environment's again
        :param keys: observations that it reads, as the environment gave them, whether P reads them or not
        :param is_on: whether that is still so: a ``learn()`` may have ended in an exception
        """
        self._reward = function
        self._reward_is_on = is_on
        self.reward_keys = tuple(keys)

    @property
    def reward_of(self) -> RewardFunction | None:
        """What gives P its rewards in place of the environment, if anything does."""
        return self._reward if self._reward is not None and self._reward_is_on() else None

    # ------------------------------------------------------------------ storage

    def _allocate(self) -> None:
        """Arrays for ``buffer_size`` transitions per environment, and empty books."""
        shape = (self.buffer_size, self.n_envs)
        assert isinstance(self.obs_shape, dict)
        shapes = dict(self.obs_shape)
        if self.challenge_keys is not None:  # follows from where a row is drawn from, and is never stored
            del shapes[CHALLENGE]
        codecs = make_codecs(self.observation_space, shapes, self.storage_dtypes)
        n_slots = self.buffer_size * self.n_envs
        n_bytes = {key: codec.nbytes * n_slots for key, codec in codecs.items()}
        in_files = 0 if self.memmap_dir is None else sum(n_bytes.values())
        n_bytes["actions and books"] = (self.action_dim * self.actions.dtype.itemsize + _BOOKS) * n_slots
        check_space(n_bytes, in_files, self.memmap_dir, f"{type(self).__name__} of {n_slots:,} transitions")

        allocate = in_memory if self.memmap_dir is None else InFolder(self.memmap_dir)
        self.ring = ObservationRing(self.buffer_size, self.n_envs, codecs, allocate)
        self.actions = np.zeros((*shape, self.action_dim), dtype=self.actions.dtype)
        # What is read together lies together: at a million transitions, most of the time of `sample` is waiting for memory
        self._outcomes = np.zeros((*shape, 3), dtype=np.float32)
        self.infos = np.empty(shape if self.copy_info_dict else (0, self.n_envs), dtype=object)
        self.books = EpisodeBooks(self.buffer_size, self.n_envs)
        self._link_views()

    def _link_views(self) -> None:
        """SB3's arrays, as views of where the numbers are."""
        self.rewards, self.dones, self.timeouts = (self._outcomes[:, :, i] for i in range(3))
        self.ep_start, self.ep_length = (self.ring.spans[:, :, i] for i in range(2))
        self._current_ep_start = self.books.current_ep_start
        self.observations = self.ring.observations
        self.next_observations = {key: NextObservationView(self.ring, key) for key in self.observations}  # type: ignore[misc]

    def reset(self) -> None:
        """Forget all transitions and episodes."""
        super().reset()
        self._allocate()

    @property
    def n_added(self) -> int:
        """Number of transitions that D has been given."""
        return self.books.n_steps * self.n_envs

    @property
    def nbytes(self) -> int:
        """Bytes that all arrays take (of which the system gives those in memory only as they are written to)."""
        return self.ring.nbytes + self.actions.nbytes + self._outcomes.nbytes

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
        Store one transition per environment. ``infos[i]`` may have next observation and reward as the environment gave
        them, see :data:`NEXT_OBSERVATION` and :data:`REWARD`.

        :param obs: observations, each of shape ``(n_envs, *observation_shape)``
        :param next_obs: what they led to; the true last observation where an episode ends
        :param action: within [-1, 1], as ``policy.scale_action()`` gives it, shape ``(n_envs, *action_shape)``
        :param reward: shape ``(n_envs,)``; a number will do for one environment, and so for ``done`` and ``infos``
        :param done: whether the episodes ended, shape ``(n_envs,)``
        :param infos: one per environment
        :raises ValueError: if an episode does not fit into the buffer, for wrong shapes, rewards that are not finite, values
            that compact storage cannot hold, a full disk; nothing is stored then
        """
        ring, pos, n_envs = self.ring, self.pos, self.n_envs
        # whatever can fail comes before the first change
        infos = checked_infos(infos, n_envs)
        next_obs, reward = _as_the_environment_gave(next_obs, reward, infos)
        reward, done = checked_rewards(reward, n_envs), checked_dones(done, n_envs)
        encoded_next = ring.encode(next_obs)
        action = checked_actions(action, n_envs, self.action_space, self.action_dim)
        ring.final.reserve(2 * n_envs)
        encoded = None if ring.goes_on_with(obs) else ring.encode(obs)
        if encoded is not None:
            self._cut_discontinued_episodes(encoded)
        if self.books.is_filled_by_one:
            self._refuse_long_episode()

        self._make_room(pos)
        ring.write(pos, encoded)
        ring.write_next(pos, encoded_next, next_obs)
        self.actions[pos] = action
        self.rewards[pos] = reward
        self.dones[pos] = done
        self.ep_start[pos] = self.books.current_ep_start
        if self.copy_info_dict:
            self.infos[pos] = infos
        self.timeouts[pos] = 0
        self.pos = (pos + 1) % self.buffer_size
        self.full = self.full or self.pos == 0
        self.books.n_steps += 1
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
        for env_idx in self.books.unfinished:
            if not self.ring.continues(env_idx, encoded):
                self._truncate_episode(env_idx)

    def _refuse_long_episode(self) -> None:
        env_idx = self.books.longest_unfinished
        raise ValueError(
            f"Environment {env_idx}: an episode is longer than the {self.buffer_size} transitions that the buffer holds "
            f"per environment. Set buffer_size to more than {self.n_envs} x the longest episode "
            f"(currently {self.buffer_size * self.n_envs}), or limit the episodes (gymnasium.wrappers.TimeLimit)."
        )

    def _make_room(self, slot: int) -> None:
        """Forget the episodes (and what refers to them) whose first slot is overwritten next."""
        for episode in self.books.overwrite(slot):
            slots = episode.slots(self.buffer_size)
            self.ring.drop_episode(int(slots[-1]), episode.env_idx)
            # The parent's way to say "not to be sampled" (it reads this array in `_sample_goals`)
            self.ep_length[slots, episode.env_idx] = 0
            self._forget(episode)

    def _compute_episode_length(self, env_idx: int) -> None:
        """Book an episode that ends with the newest transition."""
        episode = self.books.end(env_idx)
        stop = episode.start + episode.length
        self.ep_length[episode.start : min(stop, self.buffer_size), env_idx] = episode.length
        self.ep_length[: max(stop - self.buffer_size, 0), env_idx] = episode.length
        self.ring.end_episode((stop - 1) % self.buffer_size, env_idx)
        self._remember(episode)

    def _truncate_episode(self, env_idx: int) -> None:
        last = (self.pos - 1) % self.buffer_size
        self.dones[last, env_idx] = True
        self._compute_episode_length(env_idx)
        if self.handle_timeout_termination:
            self.timeouts[last, env_idx] = True  # not an actual timeout, but it allows bootstrapping

    def _remember(self, episode: Episode) -> None:
        """An episode is complete."""

    def _forget(self, episode: Episode) -> None:
        """An episode is about to be overwritten."""

    # ------------------------------------------------------------------ sampling for P

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> DictReplayBufferSamples:  # type: ignore[override]
        """
        Transitions drawn uniformly from all complete episodes, a part of them with hindsight goals.

        :param batch_size: number of transitions
        :param env: associated VecEnv to normalize the observations and rewards
        :return: samples; observations hold ``player_keys`` only
        :raises RuntimeError: before the end of the first episode
        """
        self._check_can_sample()
        n_virtual = int(self.her_ratio * batch_size)
        return self._read(*self.books.draw(batch_size, n_virtual), n_virtual, env)

    def _check_can_sample(self) -> None:
        if not self.episodes_ended:
            raise RuntimeError(
                "Unable to sample before the end of the first episode: there is no complete one among the last "
                f"{self.size() * self.n_envs} transitions. Set learning_starts to more than n_envs x the longest episode, "
                "buffer_size to more than twice that, or limit the episodes (gymnasium.wrappers.TimeLimit). A model that was "
                "loaded needs its replay buffer too: model.load_replay_buffer(path)."
            )

    def _read(
        self,
        rows: np.ndarray,
        envs: np.ndarray,
        n_virtual: int = 0,
        env: VecNormalize | None = None,
        last_rewards: np.ndarray | None = None,
        last_is_goal: np.ndarray | None = None,
        last_goals: Locations | None = None,
    ) -> DictReplayBufferSamples:
        """
        :param rows: slots of transitions, shape ``(n,)``
        :param envs: their environments, shape ``(n,)``
        :param n_virtual: the first so many get a hindsight goal
        :param env: normalizes observations and rewards
        :param last_rewards: rewards instead of the task's, for the last transitions
        :param last_is_goal: which of these end here
        :param last_goals: the transitions that lead to the goals of the last ones' challenges
        """
        wanted = self._keys_for_player()
        at = self.ring.locate(rows, envs)
        # VecNormalize wants all the keys that it normalizes, hindsight the goals, whether P reads them or not
        keys = [key for key in wanted if key in self.observations] if env is None and not n_virtual else [*self.observations]
        reward_of = self.reward_of
        if reward_of is not None:
            keys += [key for key in self.reward_keys if key not in keys]
        obs: Any = {key: self.ring.read(key, at) for key in keys}
        next_obs: Any = {key: self.ring.read_next(key, at) for key in keys if key in wanted or env is not None or n_virtual}
        outcomes = self._outcomes.reshape(-1, 3).take(at.here, axis=0)
        rewards = outcomes[:, :1]
        dones = outcomes[:, 1:2] * (1 - outcomes[:, 2:])
        if n_virtual:
            goals = self._hindsight_goals(at, n_virtual)
            achieved = next_obs["achieved_goal"][:n_virtual]
            rewards[:n_virtual, 0] = self._hindsight_rewards(rows[:n_virtual], envs[:n_virtual], achieved, goals)
            for observations in (obs, next_obs):
                observations["desired_goal"][:n_virtual] = goals
        if last_rewards is not None:
            rewards[len(rewards) - len(last_rewards) :, 0] = last_rewards
        if last_is_goal is not None:
            dones[len(dones) - len(last_is_goal) :, 0][last_is_goal] = 1
        tensor = self._tensor
        actions = tensor(self.actions.reshape(-1, self.action_dim).take(at.here, axis=0))
        if reward_of is not None:
            with th.no_grad():
                read = {key: tensor(obs[key]) for key in self.reward_keys}
                given = reward_of(read, actions, tensor(np.ascontiguousarray(rewards)))
            rewards = given.to(th.float32).cpu().numpy()
        if env is not None:
            obs, next_obs = env.normalize_obs(obs), env.normalize_obs(next_obs)
            rewards = self._normalize_reward(rewards, env)
        if self.challenge_keys is not None and CHALLENGE in wanted:
            obs[CHALLENGE] = next_obs[CHALLENGE] = self._challenges_of(len(rows), last_goals, env)
        return DictReplayBufferSamples(
            observations={key: tensor(obs[key]) for key in wanted},
            actions=actions,
            next_observations={key: tensor(next_obs[key]) for key in wanted},
            dones=tensor(dones),
            rewards=tensor(np.ascontiguousarray(rewards)),
        )

    def _challenges_of(self, n: int, last_goals: Locations | None, env: VecNormalize | None) -> np.ndarray:
        """
        :param n: number of rows, of which the last ones are of challenges
        :param last_goals: the transitions that lead to their goals
        :param env: normalizes observations
        :return: flag and goal, zeros for rows of the task, shape ``(n, 1 + goal_dim)``
        """
        assert self.challenge_keys is not None
        shape = self.observation_space[CHALLENGE].shape
        assert shape is not None
        challenges = np.zeros((n, *shape), np.float32)
        if last_goals is not None:
            keys = self.challenge_keys if env is None else self.observations
            goals: Any = {key: self.ring.read_next(key, last_goals) for key in keys}
            if env is not None:
                goals = env.normalize_obs(goals)
            of_challenges = challenges[n - len(last_goals.here) :]
            of_challenges[:, 0] = 1
            np.concatenate([goals[key] for key in self.challenge_keys], axis=1, out=of_challenges[:, 1:], casting="same_kind")
        return challenges

    def _tensor(self, fresh: np.ndarray) -> th.Tensor:
        """On P's device, sharing the memory of an array that is nobody else's."""
        tensor = th.from_numpy(fresh)
        return tensor if self.device.type == "cpu" else tensor.to(self.device)

    def _sample_goals(self, batch_indices: np.ndarray, env_indices: np.ndarray) -> np.ndarray:
        """As the parent's."""
        return self._hindsight_goals(self.ring.locate(batch_indices, env_indices), len(batch_indices))

    def _hindsight_goals(self, at: Locations, n: int) -> np.ndarray:
        """
        Goals for the first n transitions by ``goal_selection_strategy``. (NumPy's ``randint`` between arrays, which the parent
        uses, takes longer than all the rest of ``sample``.)
        """
        at = at._replace(envs=at.envs[:n], starts=at.starts[:n], steps=at.steps[:n], lengths=at.lengths[:n])
        if self.goal_selection_strategy == GoalSelectionStrategy.FINAL:
            steps = at.lengths - 1
        else:
            # inclusive of the transition itself: what it leads to may be the goal
            first: Any = at.steps if self.goal_selection_strategy == GoalSelectionStrategy.FUTURE else 0
            steps = first + (np.random.random(n) * (at.lengths - first)).astype(np.int64)
        return self.ring.read_next("achieved_goal", self.ring.locate_later(at, steps))

    def _hindsight_rewards(self, rows: np.ndarray, envs: np.ndarray, achieved: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """The environment's rewards for what was achieved, had these been the goals, shape ``(n,)``."""
        if self.env is None:
            raise ValueError("Hindsight goals need the environment to compute their rewards: call set_env(env) first")
        infos = copy.deepcopy(self.infos[rows, envs]) if self.copy_info_dict else [{}] * len(rows)
        try:
            # all environments are taken to be alike, as the parent does
            rewards = self.env.env_method("compute_reward", achieved, goals, infos, indices=[0])[0]
        except Exception as error:  # it is the user's
            raise compute_reward_failed(len(rows), error) from error
        return checked_hindsight_rewards(rewards, len(rows))

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
        return tuple(self.observation_space.spaces) if self.player_keys is None else self.player_keys

    # ------------------------------------------------------------------ sequences for C, episodes

    def sample_sequences(self, batch_size: int, length: int, keys: Sequence[str] | None = None) -> SequenceBatch:
        """
        Sequences of consecutive states for the world model, starting anywhere, across episode boundaries.

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
        envs, offsets = draw_starts(self.books.n_valid, batch_size, length)
        wanted = tuple(self.observations) if keys is None else tuple(keys)
        return read_sequences(self, self.books.oldest(envs), self.books.n_valid[envs], envs, offsets, length, wanted)

    def episode_observations(self, episode: Episode, keys: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """
        :param episode: an episode that is still in D
        :param keys: observation keys; None: all
        :return: its states, one array of shape ``(length + 1, *observation_shape)`` per key
        :raises ValueError: if D has overwritten it
        """
        home = self._home(episode)
        slots = episode.slots(home.buffer_size)
        at = home.ring.locate(slots, np.full(episode.length, episode.env_idx))
        last = home.ring.locate(slots[-1:], np.array([episode.env_idx]))
        return {
            key: np.concatenate([home.ring.read(key, at), home.ring.read_next(key, last)])
            for key in (self.observations if keys is None else keys)
        }

    def episode_actions(self, episode: Episode) -> np.ndarray:
        """:return: executed actions of an episode that is still in D, within [-1, 1], shape ``(length, action_dim)``"""
        home = self._home(episode)
        return home.actions[episode.slots(home.buffer_size), episode.env_idx]

    def episode_rewards(self, episode: Episode) -> np.ndarray:
        """:return: the task's rewards of an episode that is still in D, shape ``(length,)``"""
        home = self._home(episode)
        return home.rewards[episode.slots(home.buffer_size), episode.env_idx]

    def _home(self, episode: Episode) -> "EpisodeBuffer":
        """
        :return: the buffer that an episode is in
        :raises ValueError: if it is no longer there
        """
        if not self.books.holds(episode):
            raise ValueError(
                f"{episode} is no longer in the buffer, which holds {self.buffer_size} transitions per environment"
            )
        return self

    @property
    def episodes(self) -> list[Episode]:
        """Complete episodes in D, by environment, oldest first."""
        return self.books.episodes

    @property
    def episodes_ended(self) -> bool:
        """Whether there is a complete episode to sample from."""
        return self.books.n_drawable > 0

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

    def truncate_last_trajectory(self) -> None:
        """As the parent's, and also for an episode that fills the buffer exactly."""
        unfinished = self.books.unfinished
        if unfinished:
            warnings.warn(
                "The last trajectory in the replay buffer will be truncated. If you are in the same episode as when the "
                "replay buffer was saved, you should use `truncate_last_traj=False` to avoid that."
            )
        for env_idx in unfinished:
            self._truncate_episode(env_idx)

    def save(self, path: str | Path) -> None:
        """
        Save everything in one file of arrays and JSON, which cannot execute anything when it is read, unlike the pickle that
        ``model.save_replay_buffer()`` makes. It is replaced only by a complete one.

        :param path: file to write, ``"replay_buffer.npz"`` for instance
        :raises ValueError: if something is no plain data: a space of one's own, objects in infos (with ``copy_info_dict``)
        :raises NotWrittenError: if the disk does not take it, naming the file
        """
        content, arrays = self._state()
        write_archive(path, {"kind": type(self).__name__, "version": FILE_FORMAT, **content}, arrays)

    @classmethod
    def load(cls, path: str | Path, env: VecEnv | None = None, allow_pickle: bool = False) -> Self:
        """
        Load what :meth:`save` saved.

        :param path: the file
        :param env: the training environment (for hindsight goals)
        :param allow_pickle: also read what ``model.save_replay_buffer()`` wrote, or :meth:`save` of earlier versions. **A
            pickle can execute anything when it is read**: only for files that you trust
        :raises ValueError: if it is damaged, foreign, a pickle, or of a release that this one cannot read
        """
        if holds_pickles(path):
            buffer = cls._unpickled(path, allow_pickle)
        else:
            with Archive(path, "replay buffer") as archive:
                buffer = cls._from(archive)
        if env is not None:
            buffer.set_env(env)
        return buffer

    @classmethod
    def _unpickled(cls, path: str | Path, allowed: bool) -> Self:
        if not allowed:
            raise ValueError(
                f"{path} is a pickle, as model.save_replay_buffer() and earlier versions of this package write, and a pickle "
                f"can execute anything when it is read. If you trust it, {cls.__name__}.load(path, allow_pickle=True) reads "
                "it, and save() then writes a file that executes nothing."
            )
        with Path(path).open("rb") as file:
            try:
                buffer = pickle.load(file)
            except Exception as error:  # a damaged pickle can raise nearly anything
                raise unreadable(path, error) from error
        if not isinstance(buffer, cls):
            raise ValueError(f"{path} holds a {type(buffer).__name__}, not a {cls.__name__}")
        return buffer

    @classmethod
    def _from(cls, archive: Archive) -> Self:
        content, path = archive.content, archive.path
        if not isinstance(content, dict) or not {"kind", "version", "arguments"} <= set(content):
            raise DamagedFileError(f"{path} is no saved replay buffer.")
        if content["version"] != FILE_FORMAT:
            raise ValueError(f"{path} has version {content['version']}, this version of sb3_cpm reads version {FILE_FORMAT}.")
        if content["kind"] != cls.__name__:
            raise ValueError(f"{path} holds a {content['kind']}, not a {cls.__name__}")
        return cls._made_from(content, archive, "")

    @classmethod
    def _made_from(cls, content: dict[str, Any], archive: Archive, prefix: str) -> Self:
        arguments = {name: unpack(value) for name, value in content["arguments"].items()}
        for name, space in content["spaces"].items():
            arguments[name] = unpack_space(space)
        device = content["device"] if th.device(content["device"]).type == "cpu" or th.cuda.is_available() else "cpu"
        buffer = cls(**arguments, device=device)
        buffer._restore(content, archive, prefix)
        return buffer

    def _arguments(self) -> dict[str, Any]:
        """What the constructor must be given for a buffer like this one, as it is now."""
        given: dict[str, Any] = getattr(self, "_given", {})  # buffers that earlier versions pickled have none
        names = given or [name for name in inspect.signature(type(self)).parameters if hasattr(self, name)]
        # what can be changed later is an attribute of the same name
        found = {name: getattr(self, name, given.get(name)) for name in names if name not in NOT_SAVED}
        found["buffer_size"] = max(given.get("buffer_size", 0), self.buffer_size * self.n_envs)
        found["goal_selection_strategy"] = self.goal_selection_strategy.name.lower()
        found["memmap_dir"] = None if self.memmap_dir is None else str(self.memmap_dir)
        return found

    def _state(self, prefix: str = "") -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """
        Everything that it holds. A subclass with a state of its own adds to both.

        :param prefix: before the names of the arrays
        :return: what JSON can say, and arrays
        """
        arguments = self._arguments()
        found = {name: arguments.pop(name) for name in ("observation_space", "action_space")}
        used = self.buffer_size if self.full else self.pos  # the rest is as it was allocated
        books, arrays_of_books = self.books.state()
        content = {
            "arguments": {name: pack(value, name=name) for name, value in arguments.items()},
            "spaces": {name: pack_space(space, name) for name, space in found.items()},
            "device": str(self.device),
            "pos": self.pos,
            "full": bool(self.full),
            **books,
            "episodes": pack(self.books.episodes, (Episode,)),
            "infos": pack(self.infos[:used].tolist(), name="infos"),
            "ring": pack(self.ring.books()),
        }
        arrays = {
            "actions": self.actions[:used],
            "outcomes": self._outcomes[:used],
            **arrays_of_books,
            **self.ring.arrays(used),
        }
        return content, {f"{prefix}{name}": array for name, array in arrays.items()}

    def _restore(self, content: dict[str, Any], archive: Archive, prefix: str) -> None:
        """
        The opposite of :meth:`_state`, for a buffer that the same arguments have made and that is empty.

        :raises ValueError: if the state does not belong to such a buffer
        """
        self.pos, self.full = content["pos"], content["full"]
        used = self.buffer_size if self.full else self.pos
        self.ring.restore_books(unpack(content["ring"]))
        archive.read_into(f"{prefix}actions", self.actions[:used])
        archive.read_into(f"{prefix}outcomes", self._outcomes[:used])
        for name, array in self.ring.arrays(used).items():
            archive.read_into(f"{prefix}{name}", array)
        arrays = {name: archive.array(f"{prefix}{name}") for name in self.books.state()[1]}
        self.books.restore(content["n_steps"], content["starts"], unpack(content["episodes"], (Episode,)), **arrays)
        self._link_views()
        infos = unpack(content["infos"])
        for row in range(len(infos)):
            for env_idx in range(self.n_envs):  # one by one: NumPy would take dicts apart
                self.infos[row, env_idx] = infos[row][env_idx]

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        for name in _VIEWS:  # made anew
            del state[name]
        del state["_reward"], state["_reward_is_on"]  # of a running learn()
        return {**state, "reward_keys": (), "format": FORMAT}

    def __setstate__(self, state: dict[str, Any]) -> None:
        state = dict(state)
        found = state.pop("format", None)
        if found != FORMAT:
            raise ValueError(
                f"This replay buffer was saved in format {found}, this version of sb3_cpm reads format {FORMAT}: how "
                "observations are laid out has changed. Collect it anew, or load it with the version that saved it."
            )
        if "books" not in state:  # pickled before they were an object of their own
            state["books"] = books = EpisodeBooks(state["buffer_size"], state["n_envs"])
            episodes = [episode for of_env in state.pop("_episodes") for episode in of_env]
            arrays = {name: state.pop(f"_{name}") for name in books.state()[1]}
            books.restore(state.pop("_n_steps"), state.pop("_starts").items(), episodes, **arrays)
            del state["_valid_ends"], state["_earliest_began"]
        state.setdefault("challenge_keys", None)  # pickled before there were any
        super().__setstate__(state)
        self.attach_reward(None)
        self._link_views()


def _as_the_environment_gave(next_obs: Any, reward: Any, infos: Sequence[Mapping[str, Any]]) -> tuple[Any, Any]:
    """:return: next observations and rewards, with those of the infos in place of what SB3 has for them"""
    copied = False
    for env_idx, info in enumerate(infos):
        if NEXT_OBSERVATION in info:
            true = info[NEXT_OBSERVATION]
            if not copied:
                next_obs, copied = {key: np.array(array) for key, array in next_obs.items()}, True
            for key, array in next_obs.items():
                array[env_idx] = true[key] if isinstance(true, Mapping) else true  # of a Box there is but one
        if REWARD in info:
            reward = np.array(reward)
            reward[env_idx] = info[REWARD]
    return next_obs, reward
