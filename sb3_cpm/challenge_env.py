"""The player is told which challenge it plays: one more key of its observations."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_cpm.arguments import nearest
from sb3_cpm.spaces import CHALLENGE, is_vector


class ChallengeVecEnv(VecEnvWrapper):
    """
    Adds the key ``"challenge"`` to Dict observations: whether a challenge is posed, and its goal (report, 2.3 and 3.1: the
    goal has to be a part of the policy's input). A challenge's rewards are not the task's, and a player that cannot tell the
    two apart takes one for the other.

    In the environment no challenge is posed: the key is all zeros, and the player plays the task. In the batches of a
    :class:`~sb3_cpm.buffers.CPMBuffer` whose environment has this wrapper, rows of a challenge have 1 and the goal: the vector
    keys of the observation that its last transition leads to. Nothing of that is stored. The challenger never reads the key.

    Put it around everything else, VecNormalize included::

        env = ChallengeVecEnv(make_vec_env("MyEnv-v0", n_envs=4))
        model = SAC("MultiInputPolicy", env, replay_buffer_class=CPMBuffer, learning_starts=1000)

    :param venv: environments with Dict observations
    :param goal: keys that the goal consists of, vectors all of them; None: all vectors that there are
    :raises ValueError: for observations without vectors, and keys that are none
    """

    def __init__(self, venv: VecEnv, goal: Sequence[str] | None = None) -> None:
        if not isinstance(venv, VecEnv):
            raise ValueError(
                f"ChallengeVecEnv is put around a VecEnv, not around {type(venv).__name__}: "
                "ChallengeVecEnv(DummyVecEnv([lambda: env])), or make_vec_env(..., n_envs=1)."
            )
        space = venv.observation_space
        if not isinstance(space, spaces.Dict):
            raise ValueError(
                f"ChallengeVecEnv needs Dict observations, got {space}. Wrap each environment in "
                "sb3_cpm.envs.DictObservation first: make_vec_env(env_id, wrapper_class=DictObservation)."
            )
        if CHALLENGE in space.spaces:
            raise ValueError(f"The observations have a key {CHALLENGE!r} already. Is there a ChallengeVecEnv around them?")
        vectors = [key for key, part in space.spaces.items() if is_vector(part)]
        if isinstance(goal, str):
            raise ValueError(f"`goal` is a list of keys: goal=[{goal!r}].")
        for key in goal or ():
            if key not in vectors:
                raise ValueError(
                    f"`goal` names {key!r}, which is no vector of the observations.{nearest(key, vectors)} {vectors}"
                )
        #: Keys that a goal consists of, in this order.
        self.challenge_keys: tuple[str, ...] = tuple(goal or vectors)
        if not self.challenge_keys:
            raise ValueError(
                f"ChallengeVecEnv makes goals of vectors, and there are none among {sorted(space.spaces)}. Add one, the "
                "robot's state for instance."
            )
        self._size = 1 + sum(flatdim(space[key]) for key in self.challenge_keys)
        with_challenge = {**space.spaces, CHALLENGE: spaces.Box(-np.inf, np.inf, (self._size,), np.float32)}
        super().__init__(venv, observation_space=spaces.Dict(with_challenge))

    def reset(self) -> VecEnvObs:
        return self._with_challenge(self.venv.reset())

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        infos = [dict(info) for info in infos]  # environments may share theirs, or keep them
        for info in infos:
            last = info.get("terminal_observation")
            if isinstance(last, Mapping):
                info["terminal_observation"] = {**last, CHALLENGE: np.zeros(self._size, np.float32)}
        return self._with_challenge(obs), rewards, dones, infos

    def _with_challenge(self, obs: VecEnvObs) -> VecEnvObs:
        assert isinstance(obs, dict)
        return {**obs, CHALLENGE: np.zeros((self.num_envs, self._size), np.float32)}


def without_challenge(observation: Mapping[str, Any], space: spaces.Dict) -> dict[str, Any]:
    """
    For ``predict()`` with observations that come from no :class:`ChallengeVecEnv`: no challenge is posed.

    >>> model.predict(without_challenge(observation, model.observation_space))

    :param observation: of one environment, or of several
    :param space: of the model
    :return: the same with the key ``"challenge"``, all zeros
    :raises ValueError: if the model's observations have no such key
    """
    if CHALLENGE not in space.spaces:
        raise ValueError(f"This model's observations have no key {CHALLENGE!r}: predict() takes them as they are.")
    key, part = next((key, part) for key, part in space.spaces.items() if key != CHALLENGE)
    several = np.asarray(observation[key]).shape[: -len(part.shape or ()) or None]
    return {**observation, CHALLENGE: np.zeros((*several, *(space[CHALLENGE].shape or ())), np.float32)}


def check_outermost(venv: VecEnv | None) -> None:
    """
    :param venv: environments of a model
    :raises ValueError: if a VecNormalize normalizes the challenge, whose numbers it never sees
    """
    inner: Any = venv
    while isinstance(inner, VecEnvWrapper):
        if isinstance(inner, VecNormalize) and inner.norm_obs and CHALLENGE in (inner.norm_obs_keys or ()):
            raise ValueError(
                "VecNormalize is around ChallengeVecEnv, and sees nothing but zeros for challenges: put ChallengeVecEnv "
                "around VecNormalize."
            )
        inner = inner.venv
