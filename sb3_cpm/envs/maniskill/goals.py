"""
Goal view: a task as a goal environment, so that hindsight (HER) can be compared with challenges.

**Privileged**: ``achieved_goal`` is where the object is, which only the simulator knows. The agents of the report have to find
it with their cameras. A comparison should say so, or give the other side the same position.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_cpm.envs.maniskill.batch import ManiSkillBatch
from sb3_cpm.envs.maniskill.vec_env import ManiSkillVecEnv

Tree = dict[str, np.ndarray]


class Goal(NamedTuple):
    """
    That something be somewhere.

    :param thing: attribute of the ManiSkill task: the object that is to be moved, or a pose, where the task does not measure
        from the object's origin
    :param place: attribute of the ManiSkill task: where it is to be, an object or a pose
    :param threshold: metres between them that count as reached; with ``height`` in the horizontal plane
    :param offset: metres from ``place`` to the goal
    :param axes: 3, or 2 where height does not matter
    :param height: metres above or below the goal that count as reached, None where ``threshold`` says all
    :param hidden: parts of the state (names of :attr:`ManiSkillBatch.state_layout`) that would tell the true goal behind the
        back of ``desired_goal``, beside those that are named after a goal or a target
    """

    thing: str
    place: str
    threshold: float
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axes: int = 3
    height: float | None = None
    hidden: tuple[str, ...] = ()

    def positions(self, task: Any) -> dict[str, th.Tensor]:
        """
        :param task: the unwrapped ManiSkill environment
        :return: ``achieved_goal`` and ``desired_goal``, metres, shape ``(N, axes)``
        """
        achieved, place = (_position(getattr(task, name)) for name in (self.thing, self.place))
        desired = place + th.tensor(self.offset, dtype=place.dtype, device=place.device)
        return {"achieved_goal": achieved[:, : self.axes], "desired_goal": desired[:, : self.axes]}

    def reached(self, achieved: np.ndarray, desired: np.ndarray) -> Any:
        """
        :param achieved: metres, shape ``(..., axes)``
        :param desired: metres, shape ``(..., axes)``
        :return: whether that is near enough, shape ``(...)``
        """
        apart = np.asarray(achieved) - np.asarray(desired)
        if self.height is None:
            return np.linalg.norm(apart, axis=-1) <= self.threshold
        return (np.linalg.norm(apart[..., :2], axis=-1) <= self.threshold) & (np.abs(apart[..., 2]) <= self.height)


def _position(thing: Any) -> th.Tensor:
    """:param thing: an object, or a pose"""
    position: th.Tensor = getattr(thing, "pose", thing).p
    return position


GOALS = {
    "PickCube-v1": Goal("cube", "goal_site", 0.025),
    "PickSingleYCB-v1": Goal("obj", "goal_site", 0.025),
    "PickSingleEGAD-v1": Goal("obj_pose", "goal_site", 0.025),
    "StackCube-v1": Goal(
        "cubeA",
        "cubeB",
        float(np.hypot(0.02, 0.02)) + 0.005,
        offset=(0.0, 0.0, 0.04),
        height=0.005,
        hidden=("tcp_to_cubeB_pos", "cubeA_to_cubeB_pos"),
    ),
    "PushCube-v1": Goal("obj", "goal_region", 0.1, axes=2),
    "PullCube-v1": Goal("obj", "goal_region", 0.1, axes=2),
}
"""
What the tasks want, with their own thresholds.

In StackCube the goal is on a thing. Of that cube only what is seen from it is hidden (where the hand and the other cube are
from there); its own pose stays, as a camera would show it: it stands in the robot's way and carries the other cube, so that
without it nobody could tell what an action does.
"""

REWARDS = ("sparse", "dense")


class _View:
    """What the wrappers below have in common: which observations, which rewards."""

    def __init__(self, batch: Any, goal: Goal | None, reward: str):
        if not isinstance(batch, ManiSkillBatch):
            raise ValueError("A goal view is of a task made by make_maniskill_env or make_maniskill_vec_env.")
        if goal is None and batch.env_id not in GOALS:
            raise ValueError(f"{batch.env_id} is no task of bringing an object to a place that we know; pass goal=Goal(...).")
        if reward not in REWARDS:
            raise ValueError(f"reward must be one of {', '.join(REWARDS)}, got {reward!r}.")
        if "pointcloud" in batch.observation_space.spaces and batch.cloud.goal_points and batch.shows_goal:
            raise ValueError(
                "The point cloud shows the goal, which hindsight cannot change: make the environment with goal_points=0."
            )
        self.goal = goal or GOALS[batch.env_id]
        layout = batch.state_layout
        unknown = [name for name in self.goal.hidden if name not in layout]
        if unknown and batch.obs_mode == "state":  # in the other mode no part tells where objects are
            raise ValueError(
                f"The goal hides {unknown[0]!r}, which is no part of this state. It has: {', '.join(layout)}; "
                "correct Goal(hidden=...)."
            )
        if self.goal.height is not None and self.goal.axes != 3:
            raise ValueError(f"Goal(height={self.goal.height:g}) needs axes=3, got axes={self.goal.axes}: leave one out.")
        self.dense = reward == "dense"
        batch.goal = self.goal
        # A goal environment goes on until its time is over: hindsight changes goals, it cannot change where episodes ended.
        batch.ignore_terminations = True
        # what would tell the true goal behind the back of `desired_goal`
        told = [
            part for name, part in layout.items() if "goal" in name or name.startswith("target") or name in self.goal.hidden
        ]
        hidden = {i for part in told for i in range(part.start, part.stop)}
        size = batch.observation_space["state"].shape[0]  # type: ignore[index]
        self._keep = np.array([i for i in range(size) if i not in hidden], dtype=np.intp)
        position = spaces.Box(-np.inf, np.inf, (self.goal.axes,), np.float32)
        others = {key: space for key, space in batch.observation_space.spaces.items() if key != "state"}
        own = {"observation": spaces.Box(-np.inf, np.inf, self._keep.shape, np.float32)}
        self.space = spaces.Dict({**others, **own, "achieved_goal": position, "desired_goal": position})

    def observation(self, observation: Mapping[str, np.ndarray]) -> Tree:
        """From an observation of the batch, with or without a first axis N."""
        seen = {key: value for key, value in observation.items() if key != "state"}
        return {**seen, "observation": observation["state"][..., self._keep]}

    def distance(self, achieved: np.ndarray, desired: np.ndarray) -> Any:
        return np.linalg.norm(np.asarray(achieved) - np.asarray(desired), axis=-1)

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any = None) -> Any:
        """
        :param achieved_goal: metres, shape ``(..., axes)``
        :param desired_goal: metres, shape ``(..., axes)``
        :param info: not needed
        :return: 0 where the goal is reached, else -1 (``"sparse"``); minus the metres between (``"dense"``); shape ``(...)``
        """
        if self.dense:
            return -self.distance(achieved_goal, desired_goal)
        return np.asarray(self.goal.reached(achieved_goal, desired_goal), dtype=np.float32) - 1


class GoalView(gym.Wrapper[Any, Any, Any, Any]):
    """
    A ManiSkill task as a goal environment: ``observation`` (what the robot knows of itself, without the goal),
    ``achieved_goal`` (where the object is; **privileged**), ``desired_goal`` (where it should be), and
    cameras and cloud where the task was made with them. Rewards are those of :meth:`compute_reward`.

    Episodes end by time only. ``is_success`` is still the task's own, which may want more than a place (PickCube: that the
    robot rests); ``goal_reached`` says that the object is there.

    >>> env = GoalView(make_maniskill_env("PickCube-v1", obs_mode="state"))
    >>> SAC("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer)

    :param env: made by :func:`~sb3_cpm.envs.make_maniskill_env`, with ``goal_points=0`` if it has a cloud
    :param goal: what is wanted; by default that of :data:`GOALS`
    :param reward: ``"sparse"`` or ``"dense"``
    :raises ValueError: if the task has no goal that we know, or shows it where hindsight cannot change it
    """

    def __init__(self, env: gym.Env, goal: Goal | None = None, reward: str = "sparse"):
        super().__init__(env)
        self._view = _View(env.get_wrapper_attr("batch") if env.has_wrapper_attr("batch") else None, goal, reward)
        self.observation_space = self._view.space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tree, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._view.observation(observation), info

    def step(self, action: np.ndarray) -> tuple[Tree, float, bool, bool, dict[str, Any]]:
        observation, _, terminated, truncated, info = self.env.step(action)
        places = observation["achieved_goal"], observation["desired_goal"]
        info["goal_reached"] = bool(self._view.goal.reached(*places))
        return self._view.observation(observation), float(self.compute_reward(*places)), terminated, truncated, info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any = None) -> Any:
        """
        :param achieved_goal: metres, shape ``(..., 3)``
        :param desired_goal: metres, shape ``(..., 3)``
        :param info: not needed
        :return: 0 where the goal is reached, else -1 (``"sparse"``); minus the metres between (``"dense"``); shape ``(...)``
        """
        return self._view.compute_reward(achieved_goal, desired_goal)


class GoalVecEnv(VecEnvWrapper):
    """
    :class:`GoalView` for a batch of environments.

    :param venv: made by :func:`~sb3_cpm.envs.make_maniskill_vec_env`, with ``goal_points=0`` if it has a cloud
    :param goal: what is wanted; by default that of :data:`GOALS`
    :param reward: ``"sparse"`` or ``"dense"``
    :raises ValueError: if the task has no goal that we know, or shows it where hindsight cannot change it
    """

    def __init__(self, venv: ManiSkillVecEnv, goal: Goal | None = None, reward: str = "sparse"):
        self._view = _View(getattr(venv, "batch", None), goal, reward)
        super().__init__(venv, observation_space=self._view.space)
        self._returns = np.zeros(venv.num_envs)

    def reset(self) -> VecEnvObs:
        self._returns[:] = 0
        return self._view.observation(self.venv.reset())  # type: ignore[arg-type]

    def step_wait(self) -> VecEnvStepReturn:
        first, _, dones, infos = self.venv.step_wait()
        assert isinstance(first, dict)
        # where the objects were when the step ended; the others are the first observations of new episodes
        places = {key: first[key].copy() for key in ("achieved_goal", "desired_goal")}
        for i in np.flatnonzero(dones).tolist():
            last = infos[i]["terminal_observation"]
            infos[i]["terminal_observation"] = self._view.observation(last)
            for key, value in places.items():
                value[i] = last[key]
        rewards = np.asarray(self._view.compute_reward(*places.values()), dtype=np.float32)
        self._returns += rewards
        for i, reached in enumerate(self._view.goal.reached(*places.values()).tolist()):
            infos[i]["goal_reached"] = reached
            if dones[i]:
                infos[i]["episode"]["r"] = round(float(self._returns[i]), 6)
                self._returns[i] = 0
        return self._view.observation(first), rewards, dones, infos

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        if method_name == "compute_reward":
            return [self._view.compute_reward(*method_args, **method_kwargs) for _ in self._get_indices(indices)]
        return self.venv.env_method(method_name, *method_args, indices=indices, **method_kwargs)
