"""
ManiSkill's batched simulation as a VecEnv of Stable-Baselines3, with Dict observations.

ManiSkill's own adapter cannot show Dict observations, hands out terminal observations that the next episode overwrites,
and puts arrays of all environments where SB3 expects the number of one. This one keeps to what SB3's VecEnvs promise:

* an environment whose episode ends is reset at once, alone; its last observation, a copy, is ``terminal_observation``
* ``episode`` (return, length, seconds) appears once per episode, as ``Monitor`` would put it; ``is_success`` and
  ``TimeLimit.truncated`` are bools
* what a step produced is copied from the simulation's device to the host once, in one block (and what a reset produced, in
  the steps that end an episode)
"""

import inspect
import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_cpm.envs.maniskill.batch import ManiSkillBatch
from sb3_cpm.envs.maniskill.env import build_batch, make_maniskill_env, spec_of
from sb3_cpm.envs.maniskill.start_states import StartState, check_state


class ManiSkillVecEnv(VecEnv):
    """
    Use :func:`make_maniskill_vec_env` to get one. No ``Monitor`` and no ``VecMonitor`` is needed.

    Seeds: ``seed(s)`` gives environment ``i`` the seed ``s + i`` at the next ``reset()``, and all its later episodes follow
    from that. Start states as for :class:`~sb3_cpm.envs.maniskill.env.ManiSkillEnv`.

    :param batch: a simulation of any number of environments
    """

    def __init__(self, batch: ManiSkillBatch):
        self.batch = batch
        self.members = [Member(self, i) for i in range(batch.num_envs)]
        self._generators: list[np.random.Generator | None] = [None] * batch.num_envs
        self._actions = np.zeros((batch.num_envs, *batch.action_space.shape), dtype=np.float32)
        self._returns = np.zeros(batch.num_envs)
        self._lengths = np.zeros(batch.num_envs, dtype=np.int64)
        self._start = time.time()
        super().__init__(batch.num_envs, batch.observation_space, batch.action_space)

    # ------------------------------------------------------------------ episodes
    def reset(self) -> VecEnvObs:
        """:raises ValueError: for a start state in the options that is none, or of another task"""
        everyone = np.arange(self.num_envs)
        shared: dict[str, Any] = {}
        for member, options in zip(self.members, self._options, strict=True):
            options = dict(options)
            if (state := options.pop("state", None)) is not None:
                member.start_next_from(state)
            if shared and options != shared:
                raise ValueError(
                    f"All environments of one simulation are reset with the same options, got {shared} and {options}; only "
                    "'state' may differ."
                )
            shared = options
        observations, self.reset_infos = self._begin(everyone, shared)
        self._reset_seeds()
        self._reset_options()
        return observations

    def _begin(self, rows: np.ndarray, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], list[dict]]:
        states = [self.members[i].take_start() for i in rows]
        given = self._seeds if options is not None else [None] * self.num_envs  # SB3's seeds are for reset() only
        seeds = [self._episode_seed(i, given[i], state) for i, state in zip(rows.tolist(), states, strict=True)]
        self._returns[rows], self._lengths[rows] = 0, 0
        return self.batch.reset(rows, seeds, states, options)

    def _episode_seed(self, i: int, given: int | None, state: StartState | None) -> int:
        if given is not None:
            self._generators[i] = seeding.np_random(given)[0]
        if state is not None:
            return state["seed"]  # none is drawn for it; the seed rules the episodes after this one
        if given is not None:
            return given
        generator = self._generators[i]
        if generator is None:
            # SB3 seeds NumPy's global generator
            generator = self._generators[i] = seeding.np_random(int(np.random.randint(2**31)))[0]
        return int(generator.integers(2**31))

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        step = self.batch.step(self._actions)
        observations, infos = step.observations, step.infos
        dones = step.terminated | step.truncated
        self._returns += step.rewards
        self._lengths += 1
        for info, terminated, truncated in zip(infos, step.terminated.tolist(), step.truncated.tolist(), strict=True):
            info["TimeLimit.truncated"] = truncated and not terminated
        ended = np.flatnonzero(dones)
        if len(ended):
            # copies first: the arrays are about to get the first observations of the next episodes
            for i in ended.tolist():
                infos[i]["terminal_observation"] = {key: value[i].copy() for key, value in observations.items()}
                infos[i]["episode"] = self._statistics(i)
            first, reset_infos = self._begin(ended)
            for i, info in zip(ended.tolist(), reset_infos, strict=True):
                self.reset_infos[i] = info
            for key, value in first.items():
                observations[key][ended] = value
        return observations, step.rewards, dones, infos

    def _statistics(self, i: int) -> dict[str, float]:
        seconds = round(time.time() - self._start, 6)
        return {"r": round(float(self._returns[i]), 6), "l": int(self._lengths[i]), "t": seconds}

    def close(self) -> None:
        self.batch.env.close()

    # ------------------------------------------------------------------ the single environments
    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self.members[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        for i in self._get_indices(indices):
            setattr(self.members[i], attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        return [getattr(self.members[i], method_name)(*method_args, **method_kwargs) for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """True for ``Monitor``, whose work is done here; nothing else is wrapped around a single environment."""
        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        if self.render_mode is None:
            return [None] * self.num_envs
        return list(self.batch.env.render().cpu().numpy().astype(np.uint8))


class Member:
    """
    One environment of the batch, as ``get_attr``, ``set_attr`` and ``env_method`` see it. What it does not have itself it
    takes from the batch and from ManiSkill's environment, which all members share; what is set is set for this member alone.
    """

    def __init__(self, vec_env: ManiSkillVecEnv, i: int):
        self._batch = vec_env.batch
        self._index = i
        self._next_state: StartState | None = None
        self.observation_space = self._batch.observation_space
        self.action_space = self._batch.action_space
        self.render_mode: str | None = self._batch.env.render_mode
        self.spec = spec_of(self._batch)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "_batch":  # no recursion in one that is only half made
            raise AttributeError(name)
        owner = self._batch if hasattr(self._batch, name) else self._batch.env
        return getattr(owner, name)

    @property
    def unwrapped(self) -> Any:
        """ManiSkill's environment, all of the batch."""
        return self._batch.env

    def render(self) -> np.ndarray | None:
        """:return: this environment's picture for people, None if made with ``render_mode=None``"""
        if self.render_mode is None:
            return None
        return np.array(self._batch.env.render()[self._index].cpu().numpy(), dtype=np.uint8)

    def expert_action(self) -> np.ndarray:
        """
        :return: what the task's scripted expert does now
        :raises ValueError: if there is none, which ``no_expert`` says beforehand
        """
        return self._batch.expert_action(self._index)

    def get_state(self) -> StartState:
        """:return: where this episode is now"""
        return self._batch.get_state(self._index)

    def start_next_from(self, state: StartState | None) -> None:
        """
        :param state: where the next episode starts, once; None to forget it
        :raises ValueError: if that is no start state, or one of another task
        """
        self._next_state = None if state is None else check_state(state, self._batch.env_id)

    def take_start(self) -> StartState | None:
        """:return: the state for the episode that begins now, which is then forgotten"""
        state, self._next_state = self._next_state, None
        return state


def make_maniskill_vec_env(
    env_id: str, num_envs: int = 1, *, sim_backend: str = "auto", seed: int | None = None, **kwargs: Any
) -> ManiSkillVecEnv:
    """
    Make a batch of environments of a ManiSkill task for Stable-Baselines3.

    On a GPU one simulation holds hundreds of environments. On a CPU it holds one: for more, use SB3's
    ``make_vec_env(make_maniskill_env, n_envs, env_kwargs={"env_id": ...}, vec_env_cls=SubprocVecEnv)``.

    :param env_id: e.g. ``"PickCube-v1"``
    :param num_envs: environments in the simulation
    :param sim_backend: ``"physx_cpu"``, ``"physx_cuda"``, or ``"auto"``: the GPU for more than one environment
    :param seed: of the first environment, see :class:`ManiSkillVecEnv`
    :param kwargs: as for :func:`~sb3_cpm.envs.make_maniskill_env`
    :raises ValueError: for an unknown task, robot, controller, camera, mode, or an impossible size
    :raises RuntimeError: if assets are missing, or this machine cannot render or simulate so, with the cure
    """
    parameters = inspect.signature(make_maniskill_env).parameters.values()
    defaults = {parameter.name: parameter.default for parameter in parameters if parameter.default is not parameter.empty}
    env = ManiSkillVecEnv(build_batch(env_id, num_envs=num_envs, sim_backend=sim_backend, **{**defaults, **kwargs}))
    if seed is not None:
        env.seed(seed)
    return env
