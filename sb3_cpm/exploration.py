"""
Challenge exploration: how often the challenger acts, and the wrapper through which it does (report, section 4.2).

The report's own decay models are lost (its appendix B.4 is empty); the usual ones are offered here. All follow SB3's
schedule convention: a function of the remaining progress, which falls from 1 to 0 over ``learn()``, or over the
callback's ``decay_steps``.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_cpm.arguments import ABOVE_0, SHARE, check, check_each, nearest
from sb3_cpm.buffers import EXECUTED_ACTION
from sb3_cpm.buffers.episode_buffer import NEXT_OBSERVATION
from sb3_cpm.challenger import Challenger
from sb3_cpm.stopwatch import Stopwatch
from sb3_cpm.training_env import WatchedVecEnv
from sb3_cpm.world_model.correlated_noise import CorrelatedNoise

ExplorationUnit = Literal["step", "segment", "episode"]

# Shapes from 1 at the start (progress 0) to about 0 at the end (progress 1), with their steepness where they have one.
_DECAYS: dict[str, Callable[[float, float], float]] = {
    "constant": lambda progress, rate: 1.0,
    "linear": lambda progress, rate: 1.0 - progress,
    "exponential": lambda progress, rate: math.exp(-rate * progress),
    "inverse_time": lambda progress, rate: 1.0 / (1.0 + rate * progress),
    "cosine": lambda progress, rate: 0.5 * (1.0 + math.cos(math.pi * progress)),
    "logistic": lambda progress, rate: 1.0 / (1.0 + math.exp(2 * rate * (progress - 0.5))),
}


def make_decay(decay: str | Schedule = "exponential", start: float = 0.8, floor: float = 0.05, rate: float = 5.0) -> Schedule:
    """
    Exploration probability epsilon as a function of the remaining progress.

    :param decay: ``"constant"``, ``"linear"``, ``"exponential"``, ``"inverse_time"``, ``"cosine"``, ``"logistic"``, or a
        function from remaining progress (1 to 0) to epsilon, which is then used as it is, without the other arguments
    :param start: epsilon that the decay comes from
    :param floor: epsilon that the decay goes to; the report wants it above zero [4.2]
    :param rate: steepness of exponential, inverse-time and logistic decay
    :return: the schedule
    :raises ValueError: for an unknown name, with the nearest, and for values that cannot work, those of a function included
    """
    if callable(decay):
        for progress in (1.0, 0.5, 0.0):
            check(f"`decay` at the remaining progress {progress}", decay(progress), SHARE)
        return decay
    if not isinstance(decay, str) or decay not in _DECAYS:
        raise ValueError(
            f"Unknown decay {decay!r}.{nearest(str(decay), _DECAYS)} Choose one of {sorted(_DECAYS)} or pass a function of "
            "the remaining progress."
        )
    check_each(SHARE, start=start, floor=floor)
    check("rate", rate, ABOVE_0)
    if floor > start:
        raise ValueError(f"A decay needs 0 <= floor <= start <= 1, got start={start}, floor={floor}")
    return Decay(decay, start, floor, rate)


@dataclass(frozen=True)
class Decay:
    """A decay by name, see :func:`make_decay`; can be pickled, as SB3's callbacks can."""

    name: str
    start: float
    floor: float
    rate: float

    def __call__(self, progress_remaining: float) -> float:
        return self.floor + (self.start - self.floor) * _DECAYS[self.name](1.0 - progress_remaining, self.rate)

    @property
    def arguments(self) -> dict[str, Any]:
        """Of the callback that has it."""
        return {"decay": self.name, "decay_kwargs": {"start": self.start, "floor": self.floor, "rate": self.rate}}


class _Row(NamedTuple):
    """A state that C's latent state has yet to follow, with the action that led to it."""

    observation: dict[str, np.ndarray]
    action: np.ndarray
    is_first: bool


class ExplorationVecEnv(WatchedVecEnv):
    """
    Replaces the player's actions by the challenger's with probability epsilon, while it is ``active``.

    The challenger's latent state follows whoever acts, but lazily: states are kept until the challenger is to act next,
    then encoded in one go. The action that was executed is reported in ``infos[i]`` wherever it is not the player's.

    :param venv: the environments
    :param challenger: C
    :param epsilon: gives the current exploration probability
    :param last_obs: the observation that the next actions answer to, as kept by the model
    :param unit: who acts is drawn anew for every ``"step"``, ``"segment"`` of steps, or ``"episode"``, per environment
    :param segment_length: number of steps in a segment
    :param stopwatch: charged with "simulate+render" and "C acts"
    :param on_failure: called when a step fails, before the exception goes on
    :param on_moved: called before a step if somebody else has reset or stepped the environments, see
        :class:`~sb3_cpm.training_env.WatchedVecEnv`; has to call :meth:`reset`
    """

    #: The latent state catches up after this many states at the latest, to bound memory.
    MAX_PENDING = 64

    def __init__(
        self,
        venv: VecEnv,
        challenger: Challenger,
        epsilon: Callable[[], float],
        last_obs: dict[str, np.ndarray],
        unit: ExplorationUnit = "segment",
        segment_length: int = 20,
        stopwatch: Stopwatch | None = None,
        on_failure: Callable[[], None] = lambda: None,
        on_moved: Callable[[], None] = lambda: None,
    ):
        super().__init__(venv)
        assert isinstance(self.action_space, spaces.Box)
        self._low, self._high = self.action_space.low, self.action_space.high
        self.challenger = challenger
        self.epsilon = epsilon
        self.unit = unit
        self.segment_length = segment_length
        self.stopwatch = stopwatch or Stopwatch()
        self.on_failure = on_failure
        self.on_moved = on_moved
        self.active = False
        #: Number of actions asked for while active, and how many of them the challenger gave.
        self.n_actions = self.n_explored = 0

        self._latent = challenger.initial_state(self.num_envs)
        self._noise = CorrelatedNoise(challenger.preset.noise_memory, challenger.action_dim, challenger.device)
        self._pending: list[list[_Row]] = [[] for _ in range(self.num_envs)]
        self._explores = np.zeros(self.num_envs, dtype=bool)
        self._unit_steps = np.zeros(self.num_envs, dtype=np.int64)  # since who acts was last drawn
        self._n_steps = 0
        self._executed = np.zeros((self.num_envs, *self._low.shape), dtype=np.float32)
        for env_idx in range(self.num_envs):
            self._start_episode(env_idx, last_obs)

    def reset(self) -> VecEnvObs:
        obs = super().reset()
        original = self._original(obs)
        for env_idx in range(self.num_envs):
            self._start_episode(env_idx, original)
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        try:
            if self.moved:
                self.on_moved()
            if self.active:
                with self.stopwatch.section("C acts"):
                    actions = self._choose_actions(np.array(actions))
            self.stopwatch.start("simulate+render")
            super().step_async(actions)
        except BaseException:
            self.on_failure()
            raise

    def step_wait(self) -> VecEnvStepReturn:
        try:
            obs, rewards, dones, infos = super().step_wait()
            self.stopwatch.stop("simulate+render")
            self._n_steps += 1
            if self.active:
                original = self._original(obs)
                self._check_finite(original, rewards, dones, infos)
                with self.stopwatch.section("C acts"):
                    self._follow(original, dones)
                self._report(infos)
            return obs, rewards, dones, infos
        except (EOFError, ConnectionError) as error:
            self.on_failure()
            raise RuntimeError(
                f"An environment process died at step {self._n_steps + 1} of this learn() ({type(error).__name__}). "
                "Everything up to then is still there: model.save() and model.save_replay_buffer() work, and learn() with "
                "reset_num_timesteps=False goes on after model.set_env() with new environments."
            ) from error
        except BaseException:
            self.on_failure()
            raise

    def _original(self, obs: VecEnvObs) -> dict[str, np.ndarray]:
        """D holds observations as they were before VecNormalize, and so does C see them."""
        if self._vec_normalize is not None:
            obs = self._vec_normalize.get_original_obs()
        assert isinstance(obs, dict)
        return obs

    # ------------------------------------------------------------------ who acts

    def _choose_actions(self, actions: np.ndarray) -> np.ndarray:
        """:return: the player's actions, replaced where the challenger acts, in the environment's units"""
        self._draw_who_acts()
        exploring = np.flatnonzero(self._explores)
        self._executed = self._scale(actions)
        if len(exploring):
            self._executed[exploring] = self._explore(exploring)
            actions[exploring] = self._unscale(self._executed[exploring])
        return actions

    def _draw_who_acts(self) -> None:
        length = {"step": 1, "segment": self.segment_length, "episode": np.inf}[self.unit]
        due = (self._unit_steps == 0) | (self._unit_steps >= length)
        draws = np.random.random(self.num_envs) < self.epsilon()
        self._explores = np.where(due, draws, self._explores)
        self._unit_steps = np.where(due, 1, self._unit_steps + 1)
        self.n_actions += self.num_envs
        self.n_explored += int(self._explores.sum())

    def _explore(self, envs: np.ndarray) -> np.ndarray:
        """:return: C's actions for some environments, within [-1, 1]; uniform while C has not learned anything yet"""
        if self.challenger.trained_updates == 0:
            return np.random.uniform(-1, 1, size=(len(envs), *self._low.shape)).astype(np.float32)
        self._catch_up(envs)
        actions = self.challenger.act(self._latent.select(th.as_tensor(envs)), noise=self._noise.draw(envs))
        return actions.reshape(len(envs), *self._low.shape)

    def _report(self, infos: Sequence[dict[str, Any]]) -> None:
        """Say in the infos which action was executed wherever C acted."""
        for info, executed, explores in zip(infos, self._executed, self._explores, strict=True):
            if explores:
                info[EXECUTED_ACTION] = executed.copy()

    # ------------------------------------------------------------------ C's latent state

    def _follow(self, obs: dict[str, np.ndarray], dones: np.ndarray) -> None:
        for env_idx, done in enumerate(dones):
            if done:
                self._start_episode(env_idx, obs)
            else:
                self._remember(env_idx, obs, self._executed[env_idx], is_first=False)

    def _start_episode(self, env_idx: int, obs: dict[str, np.ndarray]) -> None:
        self._pending[env_idx].clear()  # what came before an is_first row doesn't matter
        self._unit_steps[env_idx] = 0
        self._noise.restart(np.array([env_idx]))
        self._remember(env_idx, obs, np.zeros(self._low.shape, dtype=np.float32), is_first=True)

    def _remember(self, env_idx: int, obs: dict[str, np.ndarray], action: np.ndarray, is_first: bool) -> None:
        state = {key: np.array(obs[key][env_idx]) for key in self.challenger.keys}
        self._pending[env_idx].append(_Row(state, action.copy(), is_first))
        if len(self._pending[env_idx]) >= self.MAX_PENDING:
            self._catch_up(np.array([env_idx]))

    def _catch_up(self, envs: np.ndarray) -> None:
        """Let the latent states of some environments follow what happened since the last time, all in one pass."""
        pending = [self._pending[env_idx] for env_idx in envs]
        length = max(map(len, pending), default=0)
        if length == 0:
            return
        filler = next(rows[0] for rows in pending if rows)
        padded = [rows + [filler] * (length - len(rows)) for rows in pending]
        time_major = list(zip(*padded, strict=True))
        index = th.as_tensor(envs)
        latent = self.challenger.follow(
            self._latent.select(index),
            {key: np.array([[r.observation[key] for r in row] for row in time_major]) for key in self.challenger.keys},
            np.array([[r.action.ravel() for r in row] for row in time_major]),
            np.array([[r.is_first for r in row] for row in time_major]),
            np.arange(length)[:, None] < np.array([len(rows) for rows in pending]),
        )
        for whole, part in zip(self._latent, latent, strict=True):
            whole[index] = part
        for rows in pending:
            rows.clear()

    # ------------------------------------------------------------------ actions and checks

    def _scale(self, actions: np.ndarray) -> np.ndarray:
        return (2.0 * (actions - self._low) / (self._high - self._low) - 1.0).astype(np.float32)

    def _unscale(self, scaled: np.ndarray) -> np.ndarray:
        return self._low + 0.5 * (scaled + 1.0) * (self._high - self._low)

    def _check_finite(self, obs: dict[str, np.ndarray], rewards: np.ndarray, dones: np.ndarray, infos: Any) -> None:
        """NaN spreads from one transition into every network within an update: stop before it is stored."""
        for env_idx in range(self.num_envs):
            if not np.isfinite(rewards[env_idx]):
                raise ValueError(
                    f"Environment {env_idx} gave a reward of {rewards[env_idx]} at step {self._n_steps} of this learn(): "
                    "rewards must be finite. stable_baselines3.common.vec_env.VecCheckNan helps to find where it comes from."
                )
            info = infos[env_idx]
            last = info.get(NEXT_OBSERVATION, info.get("terminal_observation")) if dones[env_idx] else None
            for key, array in obs.items():
                for raw in (array[env_idx],) if last is None else (array[env_idx], last[key]):
                    value = np.asarray(raw)  # the last observation is as the environment gave it: a number, a list
                    if value.dtype.kind == "f" and not np.isfinite(value).all():
                        raise ValueError(
                            f"Environment {env_idx} gave NaN or infinite values in observation {key!r} at step "
                            f"{self._n_steps} of this learn(). stable_baselines3.common.vec_env.VecCheckNan helps to find "
                            "where they come from."
                        )


def without_exploration(env: VecEnv | None) -> VecEnv:
    """:return: the environment without any exploration wrapper around it, one that an exception left behind included"""
    assert env is not None
    while isinstance(env, ExplorationVecEnv):
        env = env.venv
    inner = env
    while isinstance(inner, VecEnvWrapper):
        if isinstance(inner.venv, ExplorationVecEnv):
            inner.venv = inner.venv.venv
        else:
            inner = inner.venv
    return env
