"""
What SB3 loses or does not notice of the training environment while a rollout is collected.

* The last observation of an episode. A VecNormalize replaces it by the normalized one; un-normalized again, what was clipped
  stays clipped, and integers are cut off. Here it is noted before it gets there.
* Others who use the environment, as a callback that evaluates in it. SB3 would go on from the observation that it had before;
  and beside a VecNormalize it asks only after the callbacks for what the last step gave.
* What the infos say of success, and whether a ``learn()`` that ended in an exception is still running.
"""

import warnings
from collections.abc import Callable, Mapping
from types import FrameType
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_normalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cpm.buffers.episode_buffer import NEXT_OBSERVATION, REWARD


class _Noting:
    """
    Stands between a VecNormalize and its environments for one ``step_wait()``.

    :param venv: the environments
    """

    def __init__(self, venv: VecEnv):
        self.venv = venv

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        infos = [dict(info) for info in infos]  # environments may share theirs, or keep them
        for env_idx in np.flatnonzero(dones).tolist():
            last = infos[env_idx].get("terminal_observation")
            if last is not None:
                infos[env_idx][NEXT_OBSERVATION] = last
        return obs, rewards, dones, infos


class _Moves:
    """
    Who has moved the environments. It refers to nothing above them, so that they keep no model alive.

    :param normalize: around the environments, if there is one
    """

    def __init__(self, normalize: VecNormalize | None) -> None:
        self.normalize = normalize
        self.is_ours = self.others = False
        #: what the last step of ours has returned
        self.infos: list[dict[str, Any]] = []

    def note(self) -> None:
        """Somebody is about to move them."""
        if self.is_ours or self.others:
            return
        self.others = True
        if self.normalize is not None:  # what SB3 will ask it for is now that of our last step, and soon somebody else's
            obs, rewards = self.normalize.old_obs, self.normalize.old_reward
            for env_idx, info in enumerate(self.infos):
                row = {key: part[env_idx] for key, part in obs.items()} if isinstance(obs, dict) else obs[env_idx]
                info.setdefault(NEXT_OBSERVATION, row)
                info[REWARD] = rewards[env_idx]


class _Noticed:
    """
    A method of an environment that notes who calls it.

    :param method: it
    :param moves: where to note it
    """

    def __init__(self, method: Callable[..., Any], moves: _Moves):
        self.method = method
        self.moves = moves

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.moves.note()
        return self.method(*args, **kwargs)


class WatchedVecEnv(VecEnvWrapper):
    """
    The training environment during rollouts. ``infos[i]``, dicts of their own, have the last observation of an episode as the
    environment gave it; :attr:`moved` tells whether somebody else has reset or stepped the environments since the last
    ``reset()``.

    :param venv: the environments. Two methods of the innermost note who calls them from now on, also between two ``learn()``,
        when people evaluate in ``model.get_env()``
    """

    #: Methods by which others move the environments.
    WATCHED = ("reset", "step_async")

    def __init__(self, venv: VecEnv):
        super().__init__(venv)
        self._vec_normalize: VecNormalize | None = unwrap_vec_normalize(venv)
        self._moves = _Moves(self._vec_normalize)
        innermost = vars(venv.unwrapped)
        for name in self.WATCHED:
            if isinstance(innermost.get(name), _Noticed):  # for an earlier learn()
                del innermost[name]
            innermost[name] = _Noticed(getattr(venv.unwrapped, name), self._moves)

    @property
    def moved(self) -> bool:
        """Whether others have moved the environments."""
        return self._moves.others

    @moved.setter
    def moved(self, moved: bool) -> None:
        self._moves.others = moved

    def reset(self) -> VecEnvObs:
        self._moves.is_ours = True
        try:
            obs = self.venv.reset()
        finally:
            self._moves.is_ours = False
        self.moved = False
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        self._moves.is_ours = True
        try:
            self.venv.step_async(actions)
        finally:
            self._moves.is_ours = False

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self._step_wait()
        self._moves.infos = [dict(info) for info in infos]
        return obs, rewards, dones, self._moves.infos

    def _step_wait(self) -> VecEnvStepReturn:
        normalize = self._vec_normalize
        if normalize is None:
            return self.venv.step_wait()
        inner = normalize.venv
        normalize.venv = _Noting(inner)  # type: ignore[assignment]
        try:
            return self.venv.step_wait()
        finally:
            normalize.venv = inner


def begin_episodes(model: BaseAlgorithm, env: VecEnv | None = None, counted: bool = False) -> None:
    """
    End the episodes that go on in the model's buffer, and begin new ones, from which the next ``learn(...,
    reset_num_timesteps=False)`` goes on.

    :param model: between two rollouts
    :param env: the environments, as the rollouts see them; None: ``model.env``
    :param counted: whether a VecNormalize counts the first observations, as it does with those of other episodes. It must not
        where this is done once more, or already was
    """
    env = model.env if env is None else env
    assert env is not None
    buffer = getattr(model, "replay_buffer", None)
    if isinstance(buffer, HerReplayBuffer):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it is cut is what we want
            buffer.truncate_last_trajectory()
    noise = getattr(model, "action_noise", None)
    if noise is not None:
        noise.reset()
    normalize = model.get_vec_normalize_env()
    counts = normalize is not None and normalize.training
    if normalize is not None:
        normalize.training = counts and counted
    try:
        model._last_obs = env.reset()  # type: ignore[assignment]
    finally:
        if normalize is not None:
            normalize.training = counts
    model._last_episode_starts = np.ones(model.n_envs, dtype=bool)
    if normalize is not None:
        model._last_original_obs = normalize.get_original_obs()


def success_of(info: Mapping[str, Any]) -> bool | None:
    """:return: what an info says about success, None if nothing; gymnasium-robotics says ``success``, SB3 ``is_success``"""
    told = info.get("is_success", info.get("success"))
    return None if told is None else bool(told)


def learns(model: BaseAlgorithm | None, frame: FrameType | None) -> bool:
    """
    An exception ends a ``learn()`` without telling callbacks; only the stack knows.

    :param model: perhaps none any more
    :param frame: where to look from, outwards
    :return: whether the model's ``learn()`` is what runs there
    """
    while frame is not None:
        if frame.f_code.co_name == "learn" and model is not None and frame.f_locals.get("self") is model:
            return True
        frame = frame.f_back
    return False
