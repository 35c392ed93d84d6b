"""
Deterministic evaluation of any SB3 model: always the same episodes, which training never sees.

Unlike SB3's ``evaluate_policy`` it seeds every episode, and tells success at the end from success at any moment: ManiSkill's
``success`` is not sticky, an arm can reach its goal and leave it again.
"""

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize

from sb3_cpm.seeds import FIRST_SEED
from sb3_cpm.training_env import success_of


class Outcome(NamedTuple):
    """
    One episode.

    :param episode_return: sum of the task's own rewards (of ``Monitor``, below all reward wrappers)
    :param length: steps
    :param success_once: whether it was a success in any step, None where the environment doesn't say
    :param success_at_end: whether it was one in the last step
    """

    episode_return: float
    length: int
    success_once: bool | None
    success_at_end: bool | None


def means(outcomes: Sequence[Outcome]) -> tuple[float, float | None]:
    """:return: mean return, and success rate at the end of the episodes, None where nobody says"""
    told = [outcome.success_at_end for outcome in outcomes if outcome.success_at_end is not None]
    return float(np.mean([outcome.episode_return for outcome in outcomes])), float(np.mean(told)) if told else None


def evaluate(model: BaseAlgorithm, env: VecEnv, n_episodes: int, first_seed: int = FIRST_SEED) -> list[Outcome]:
    """
    Play episodes with seeds from ``first_seed`` on.

    :param model: the player; recurrent ones get their state back
    :param env: one environment, made like those of the training and not one of them
    :param n_episodes: how many
    :param first_seed: training has the seeds below ``FIRST_SEED``
    """
    ours, theirs = unwrap_vec_normalize(env), model.get_vec_normalize_env()  # images are transposed outside of either
    if ours is not None and theirs is not None:
        if hasattr(theirs, "obs_rms"):  # not where only rewards are normalized
            ours.obs_rms = copy.deepcopy(theirs.obs_rms)
        ours.training = ours.norm_reward = False
    return [_play(model, env, first_seed + index) for index in range(n_episodes)]


def _play(model: BaseAlgorithm, env: VecEnv, seed: int) -> Outcome:
    env.seed(seed)
    observation = env.reset()
    state, first, successes = None, np.ones(1, dtype=bool), []
    while True:
        action, state = model.predict(observation, state=state, episode_start=first, deterministic=True)  # type: ignore[arg-type]
        observation, _, dones, infos = env.step(action)
        first = dones
        successes.append(success_of(infos[0]))
        if dones[0]:
            break
    episode = infos[0]["episode"]
    at_end = successes[-1]
    return Outcome(float(episode["r"]), int(episode["l"]), None if at_end is None else any(successes), at_end)


class _Filmed(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps a picture of every state: a ``VecEnv`` begins the next episode at once, and nobody else sees the last."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.frames: list[np.ndarray] = []

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        result = self.env.reset(**kwargs)
        self._film()
        return result

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self._film()
        return result

    def _film(self) -> None:
        frame = self.env.render()
        assert isinstance(frame, np.ndarray), "made with render_mode='rgb_array'"
        self.frames.append(frame)


def film(model: BaseAlgorithm, env: VecEnv, seed: int = FIRST_SEED) -> tuple[Outcome, list[np.ndarray]]:
    """
    Play one episode as :func:`evaluate` does.

    :param model: the player
    :param env: as for :func:`evaluate`, made with ``render_mode="rgb_array"``, a ``DummyVecEnv`` below its wrappers
    :param seed: of the episode
    :return: the outcome, and a picture of every state, each of shape ``(height, width, 3)``, uint8
    """
    inner = env.unwrapped
    assert isinstance(inner, DummyVecEnv)
    filmed = inner.envs[0] = _Filmed(inner.envs[0])
    try:
        outcome = evaluate(model, env, 1, seed)[0]
    finally:
        inner.envs[0] = filmed.env
    return outcome, filmed.frames[: outcome.length + 1]  # what comes after it is of the next episode
