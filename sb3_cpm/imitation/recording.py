"""
Episodes of a scripted expert, recorded as training will see them.

An environment that can demonstrate has a method ``expert_action()``: the action that its expert takes now, in the
environment's units. ``CPMToy-v0`` and many of the ManiSkill tasks have one. It is called through ``VecEnv.env_method``, so
environments in worker processes demonstrate as well, all at once.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor, unwrap_vec_normalize

from sb3_cpm.arguments import check, integer
from sb3_cpm.buffers import Demonstration
from sb3_cpm.dreamer.spaces import as_dict
from sb3_cpm.envs.maniskill.experts import EXPERTS
from sb3_cpm.exploration import without_exploration
from sb3_cpm.imitation.progress import progress
from sb3_cpm.training_env import success_of

#: The expert's method; and where an environment says why it has none after all, before that is called in a worker process.
EXPERT, NO_EXPERT = "expert_action", "no_expert"
#: An expert may fail this often for each episode that is wanted, and :data:`FREE_FAILURES` times more.
FAILURES_PER_EPISODE, FREE_FAILURES = 4, 10
#: What a Monitor has counted.
COUNTED = ("episode_returns", "episode_lengths", "episode_times", "total_steps")


def record_demonstrations(
    env: VecEnv,
    n_episodes: int,
    seed: int | None = None,
    hold: bool = False,
    progress_bar: bool = False,
    outcomes: list[bool] | None = None,
) -> list[Demonstration]:
    """
    Let the expert of the environments act until it has succeeded often enough. Episodes without success are left out.

    Observations and rewards are those of the environment, as replay buffers store them: beside a ``VecNormalize`` they are
    recorded un-normalized, and its statistics stay as they are, as do those of ``Monitor``. The environments are left in the
    middle of episodes: reset them.

    :param env: the training environments, all of which take part
    :param n_episodes: number of demonstrations
    :param seed: given to the environments; None: they go on with the random numbers that they have
    :param hold: go on to the end of the episode, the expert holding what it has reached; what counts is success in the last
        step. By default a demonstration ends with its first success, also where the environment would go on (it then counts
        as cut off, not as terminated)
    :param progress_bar: show one
    :param outcomes: gets whether each episode was a success, those that were left out among them
    :return: the demonstrations, in the same order for the same environments and seed
    :raises ValueError: if the environment has no expert, or its actions are changed on the way to it
    :raises RuntimeError: if the expert fails too often
    """
    check("n_episodes", n_episodes, integer(1))
    inner = _without_normalization(env)
    _check_expert(inner)
    recorder = _Recorder(inner.num_envs, n_episodes, hold)
    with _statistics_kept(inner), progress(n_episodes, "episode", progress_bar) as show:
        if seed is not None:
            inner.seed(seed)
        observations = inner.reset()
        recorder.begin(observations)
        while not recorder.complete:
            actions = np.stack(inner.env_method(EXPERT))
            observations, rewards, dones, infos = inner.step(actions)
            show(recorder.step(observations, actions, rewards, dones, infos))
            recorder.check_failures()
    if outcomes is not None:
        outcomes += [True] * len(recorder.demonstrations) + [False] * recorder.n_failed
    return recorder.demonstrations


class _Recorder:
    """
    Every environment records its share, so that episodes that take long are as likely to be among them as short ones.

    :param n_envs: number of environments
    :param n_episodes: number of demonstrations
    :param hold: see :func:`record_demonstrations`
    """

    def __init__(self, n_envs: int, n_episodes: int, hold: bool):
        self.n_episodes = n_episodes
        self.hold = hold
        self.shares = [(n_episodes + i) // n_envs for i in reversed(range(n_envs))]
        self.found: list[list[Demonstration]] = [[] for _ in range(n_envs)]
        self.n_failed = 0
        self._running: list[_Episode] = []

    @property
    def complete(self) -> bool:
        return all(len(found) >= share for found, share in zip(self.found, self.shares, strict=True))

    @property
    def demonstrations(self) -> list[Demonstration]:
        """The first of every environment, then the second, ..."""
        rounds = range(max(self.shares))
        return [found[k] for k in rounds for found in self.found if k < len(found)]

    def begin(self, observations: Any) -> None:
        self._running = [_Episode(_row(observations, i)) for i in range(len(self.shares))]

    def step(
        self, observations: Any, actions: np.ndarray, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
    ) -> int:
        """:return: how many demonstrations this step has completed"""
        before = sum(map(len, self.found))
        for i, episode in enumerate(self._running):
            done, info = bool(dones[i]), infos[i]
            if not episode.over and len(self.found[i]) < self.shares[i]:
                last = _row(info["terminal_observation"]) if done else _row(observations, i)
                episode.add(last, actions[i], float(rewards[i]))
                succeeded = _succeeded(info)
                if done or (succeeded and not self.hold):
                    episode.over = True
                    self._end(i, episode, succeeded, done and not info.get("TimeLimit.truncated", False), info)
            if done:
                self._running[i] = _Episode(_row(observations, i))
        return sum(map(len, self.found)) - before

    def _end(self, i: int, episode: "_Episode", succeeded: bool, terminated: bool, info: dict[str, Any]) -> None:
        if succeeded:
            self.found[i].append(episode.demonstration(terminated, info.get("instance")))
        else:
            self.n_failed += 1

    def check_failures(self) -> None:
        if self.n_failed > FREE_FAILURES + FAILURES_PER_EPISODE * self.n_episodes:
            n_found = sum(map(len, self.found))
            raise RuntimeError(
                f"The expert succeeded in {n_found} of {n_found + self.n_failed} episodes: too seldom for {self.n_episodes} "
                "demonstrations. Give the episodes more steps (max_episode_steps of env_kwargs), or record them otherwise."
            )


class _Episode:
    """
    One that is being recorded.

    :param observation: the first one, by key
    """

    def __init__(self, observation: dict[str, np.ndarray]):
        self.observations = [observation]
        self.actions: list[np.ndarray] = []
        self.rewards: list[float] = []
        self.over = False

    def add(self, observation: dict[str, np.ndarray], action: np.ndarray, reward: float) -> None:
        self.observations.append(observation)
        self.actions.append(action.copy())
        self.rewards.append(reward)

    def demonstration(self, terminated: bool, instance: str | None) -> Demonstration:
        stacked = {key: np.stack([one[key] for one in self.observations]) for key in self.observations[0]}
        return Demonstration(stacked, np.stack(self.actions), np.array(self.rewards, np.float32), terminated, instance)


def _row(observations: Any, i: int | None = None) -> dict[str, np.ndarray]:
    """A copy of one environment's observation by key."""
    return {key: np.array(value if i is None else value[i]) for key, value in as_dict(observations).items()}


def _succeeded(info: dict[str, Any]) -> bool:
    success = success_of(info)
    if success is None:
        raise ValueError(
            "The environment does not tell whether it succeeded: its infos have neither 'is_success' nor 'success'. Wrap it "
            "in one that adds it."
        )
    return success


def _without_normalization(env: VecEnv) -> VecEnv:
    env = without_exploration(env)
    normalize = unwrap_vec_normalize(env)
    return env if normalize is None else normalize.venv


def _check_expert(env: VecEnv) -> None:
    if not env.has_attr(EXPERT):
        raise ValueError(
            f"The environment has no expert, a method {EXPERT}() that gives the next action. CPMToy-v0, CPMReach-v0 and "
            f"these tasks of ManiSkill have one: {', '.join(EXPERTS)}. Give a file of demonstrations instead of 'expert'."
        )
    for reason in env.get_attr(NO_EXPERT) if env.has_attr(NO_EXPERT) else ():
        if reason:
            raise ValueError(f"{reason} Or give a file of demonstrations instead of 'expert'.")
    if any(env.env_is_wrapped(gym.ActionWrapper)):
        raise ValueError(
            "A wrapper changes the actions on their way to the environment, whose expert gives what arrives there. Make the "
            "environment without it."
        )


@contextlib.contextmanager
def _statistics_kept(env: VecEnv) -> Iterator[None]:
    """
    Meanwhile Monitors in this process write no file, and afterwards all have counted nothing. (A file that a Monitor in a
    worker process writes gets the episodes.)
    """
    monitors: list[Any] = [unwrap_wrapper(one, Monitor) for one in getattr(env.unwrapped, "envs", [])]
    layer: VecEnv = env
    while isinstance(layer, VecEnvWrapper):
        if isinstance(layer, VecMonitor):
            monitors.append(layer)
        layer = layer.venv
    monitors = [one for one in monitors if one is not None]
    writers = [one.results_writer for one in monitors]
    counts = [getattr(one, "episode_count", None) for one in monitors]
    counted = {name: env.get_attr(name) for name in COUNTED} if env.has_attr(COUNTED[0]) else {}
    counted = {name: [list(one) if isinstance(one, list) else one for one in values] for name, values in counted.items()}
    for one in monitors:
        one.results_writer = None
    try:
        yield
    finally:
        for one, writer, count in zip(monitors, writers, counts, strict=True):
            one.results_writer = writer
            if count is not None:
                one.episode_count = count
        for name, values in counted.items():
            for i, value in enumerate(values):
                env.env_method("set_wrapper_attr", name, value, indices=[i])
