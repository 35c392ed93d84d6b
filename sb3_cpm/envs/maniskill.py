"""
ManiSkill 3 tasks as plain gymnasium environments with the observations of the report (section 4.1).

ManiSkill's own environments return batched torch tensors in nested dicts, know no ``max_episode_steps`` and draw from
torch's global random numbers. Ours returns NumPy copies in a flat Dict, one render per step, ends episodes by gymnasium's
rules and is ruled by the seed of ``reset`` alone.
"""

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding

from sb3_cpm.envs import observations as obs_tools
from sb3_cpm.envs.maniskill_checks import check_sizes, check_task, explained
from sb3_cpm.envs.rendering import ensure_renderer
from sb3_cpm.envs.visuals import Visuals, choose_visuals

OBS_MODES = {"visual": "rgb+position+segmentation", "state": "state_dict"}
"""Our observation modes and ManiSkill's. "rgb+position+segmentation" costs the same one render as "rgb" alone."""


class ManiSkillEnv(gym.Wrapper[Any, Any, Any, Any]):
    """
    One ManiSkill environment on the CPU simulator, as gymnasium means it. Use :func:`make_maniskill_env` to get one.

    Random numbers: ``reset(seed=s)`` starts a generator; every later ``reset()`` draws the episode's seed from it, so a whole
    run is determined by the first seed. (ManiSkill would take torch's global generator: not reproducible in worker processes,
    and it would disturb the random numbers of the agent.)

    ``info`` holds Python numbers: ``success`` and ``is_success`` at every step (True in the step in which the task is solved,
    ManiSkill's success is not sticky), ``fail`` where the task has it, ``elapsed_steps`` and the task's own entries.

    :param env: the unwrapped ManiSkill environment
    :param cameras: names of the cameras to show, None for all that the task and the robot have
    :param obs_mode: ``"visual"`` or ``"state"``
    :param n_points: points of the scene in the cloud, 0 for no cloud
    :param goal_points: additional points around the goal, where the task shows one
    :param max_distance: metres from the camera beyond which points are dropped
    :param max_episode_steps: an episode is truncated after so many steps
    :param ignore_terminations: see :func:`make_maniskill_env`
    :param visuals: entered around whatever may build the scene
    """

    def __init__(
        self,
        env: gym.Env,
        cameras: Sequence[str] | None,
        obs_mode: str,
        n_points: int,
        goal_points: int,
        max_distance: float,
        max_episode_steps: int,
        ignore_terminations: bool,
        visuals: Visuals,
    ):
        super().__init__(env)
        self.obs_mode = obs_mode
        self.n_points = n_points
        self.goal_points = goal_points
        self.max_distance = max_distance
        self.max_episode_steps = max_episode_steps
        self.ignore_terminations = ignore_terminations
        self._visuals = visuals
        self._background_ids: list[int] = []
        self.cameras = self._choose_cameras(cameras) if obs_mode == "visual" else ()
        self._scene_changed()
        self.action_space = self.unwrapped.single_action_space  # type: ignore[attr-defined]
        # ManiSkill rendered once while it was built; that observation has every key, so the spaces need no second render
        self.observation_space = self._make_space(self._observe(self.unwrapped._last_obs))  # type: ignore[attr-defined]

    # ------------------------------------------------------------------ gymnasium
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        if seed is not None:
            self.np_random, _ = seeding.np_random(seed)
        # a seed is given to ManiSkill in any case, see the class docstring
        episode_seed = int(self.np_random.integers(2**31)) if seed is None else seed
        with self._visuals:
            raw, info = self.unwrapped.reset(seed=episode_seed, options=options)
        if info.pop("reconfigure", False):
            self._scene_changed()
        # A new episode starts before any contact; ManiSkill still reports the contact of the previous episode's last step.
        for source in (raw["extra"], info):
            source.update({key: np.zeros(1, dtype=bool) for key in source if "grasp" in key})
        return self._observe(raw), self._plain_info(info)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        raw, reward, terminated, _, info = self.unwrapped.step(np.asarray(action, dtype=np.float32))
        info = self._plain_info(info)
        over = bool(terminated) and not self.ignore_terminations
        truncated = info["elapsed_steps"] >= self.max_episode_steps
        return self._observe(raw), float(reward), over, bool(truncated), info

    def render(self) -> np.ndarray | None:
        """
        :return: the scene from the task's camera for people, goal marker included, shape ``(height, width, 3)``, uint8; a
            render of its own, so call it for videos only. None if made with ``render_mode=None``.
        """
        if self.render_mode is None:
            return None
        frame: Any = self.unwrapped.render()
        return np.array(frame[0].cpu().numpy(), dtype=np.uint8)

    @property
    def spec(self) -> gym.envs.registration.EnvSpec | None:  # type: ignore[override]
        """ManiSkill's spec with the number of steps that really ends an episode."""
        spec = copy.copy(self.unwrapped.spec)
        if spec is not None:
            spec.max_episode_steps = self.max_episode_steps
        return spec

    # ------------------------------------------------------------------ observation
    def _observe(self, raw: dict[str, Any]) -> dict[str, np.ndarray]:
        agent, extra = _first(raw["agent"]), _first(raw["extra"])
        if self.obs_mode == "state":
            return {"state": obs_tools.flat_vector([agent, extra])}
        observation: dict[str, np.ndarray] = {}
        clouds = []
        for name in self.cameras:
            picture = _first(raw["sensor_data"][name])
            observation[name] = picture["rgb"]
            if self.n_points:
                cam2world = _first(raw["sensor_param"][name])["cam2world_gl"]
                clouds.append(
                    obs_tools.camera_points(
                        picture["rgb"],
                        picture["position"],
                        picture["segmentation"],
                        cam2world,
                        self._background_ids,
                        self.max_distance,
                    )
                )
        if self.n_points:
            observation["pointcloud"] = self._make_cloud(np.concatenate(clouds), extra)
        observation["state"] = obs_tools.robot_state(agent, extra)
        return observation

    def _make_cloud(self, points: np.ndarray, extra: dict[str, np.ndarray]) -> np.ndarray:
        hand = extra["tcp_pose"][:3] if "tcp_pose" in extra else np.zeros(3)
        cloud = obs_tools.resize_cloud(points, self.n_points, self.np_random, hand)
        goal = obs_tools.find_goal(extra)
        if goal is None or self.goal_points == 0:
            return cloud
        return np.concatenate([cloud, obs_tools.goal_cloud(goal, self.goal_points)])

    def _make_space(self, example: dict[str, np.ndarray]) -> spaces.Dict:
        return spaces.Dict(
            {
                key: spaces.Box(0, 255, value.shape, np.uint8)
                if value.dtype == np.uint8
                else spaces.Box(-np.inf, np.inf, value.shape, np.float32)
                for key, value in example.items()
            }
        )

    # ------------------------------------------------------------------ scene
    def _choose_cameras(self, wanted: Sequence[str] | None) -> tuple[str, ...]:
        available = tuple(self.unwrapped._sensors)  # type: ignore[attr-defined]
        unknown = [name for name in wanted or () if name not in available]
        if unknown:
            raise ValueError(f"Unknown camera {unknown[0]!r}: this task with this robot has {', '.join(available) or 'none'}.")
        return available if wanted is None else tuple(wanted)

    def _scene_changed(self) -> None:
        """After ManiSkill built the scene: ids are new, cameras nobody wants must not be rendered."""
        unwrapped = self.unwrapped
        id_map = unwrapped.segmentation_id_map  # type: ignore[attr-defined]
        self._background_ids = [i for i, thing in id_map.items() if thing.name in obs_tools.BACKGROUND_NAMES]
        for name in set(unwrapped._sensors) - set(self.cameras):  # type: ignore[attr-defined]
            del unwrapped._sensors[name]  # type: ignore[attr-defined]

    def _plain_info(self, info: dict[str, Any]) -> dict[str, Any]:
        plain: dict[str, Any] = {}
        for key, value in info.items():
            array = np.squeeze(_numpy(value))  # without the batch of one
            plain[key] = array.item() if array.ndim == 0 else array
        if "success" in plain:
            plain["success"] = plain["is_success"] = bool(plain["success"])
        return plain


def _numpy(value: Any) -> np.ndarray:
    """A copy: ManiSkill and SAPIEN reuse their buffers."""
    return np.array(value.cpu().numpy() if hasattr(value, "cpu") else value)


def _first(tree: dict[str, Any]) -> dict[str, Any]:
    """The first (and only) environment of a batched tree, as NumPy copies."""
    return {key: _first(value) if isinstance(value, dict) else _numpy(value)[0] for key, value in tree.items()}


def make_maniskill_env(
    env_id: str,
    *,
    obs_mode: str = "visual",
    control_mode: str = "pd_ee_delta_pose",
    reward_mode: str = "normalized_dense",
    robot_uids: str | None = None,
    cameras: Sequence[str] | None = None,
    image_size: int | tuple[int, int] = 32,
    n_points: int = 256,
    goal_points: int = 50,
    max_distance: float = 3.0,
    max_episode_steps: int | None = None,
    ignore_terminations: bool = False,
    visuals: str = "auto",
    render_mode: str | None = "rgb_array",
    render_size: int = 256,
    **task_kwargs: Any,
) -> ManiSkillEnv:
    """
    Make a ManiSkill task with the observations of the report.

    With ``obs_mode="visual"`` the observation space is a flat Dict:

    * one image per camera, e.g. ``base_camera`` and ``hand_camera``, shape ``(height, width, 3)``, uint8
    * ``pointcloud``, shape ``(n_points + goal_points, 6)``, float32: x, y, z in metres (world frame), then red, green, blue in
      [0, 1], from the same render; ground, table and far points are dropped; the last ``goal_points`` rows lie on a
      small green sphere around the goal (these rows are absent where the task shows no goal)
    * ``state``, 1-D, float32: joint positions and velocities, hand pose, goal position, whether something is
      grasped. Object poses are not in it.

    With ``obs_mode="state"`` the only key is ``state``: ManiSkill's full state **including object poses**. Privileged, fast
    (nothing is rendered), for experiments with state vectors.

    :param env_id: e.g. ``"PickCube-v1"``
    :param obs_mode: ``"visual"`` or ``"state"``
    :param control_mode: the robot's controller; actions are in [-1, 1]
    :param reward_mode: ``"normalized_dense"``, ``"dense"``, ``"sparse"`` or ``"none"``, as far as the task has it
    :param robot_uids: ManiSkill's name of the robot; by default the Panda with a camera at its hand where the task knows
        the Panda, else the task's own choice
    :param cameras: names of the cameras to show; by default all of the task and of the robot
    :param image_size: pixels, one number or ``(height, width)``
    :param n_points: points of the scene; 0 leaves ``pointcloud`` out
    :param goal_points: additional points around the goal
    :param max_distance: metres from the camera beyond which points are dropped
    :param max_episode_steps: by default the task's own (50 for PickCube)
    :param ignore_terminations: By default False: success (or failure) terminates the episode, as the task defines it and as
        evaluations want it. With positive dense rewards an agent may then learn to hover beside the goal, since success ends
        its income; ``True`` lets every episode run to ``max_episode_steps``, and ``is_success`` is that of the moment.
    :param visuals: ``"light"`` draws the robot with fewer triangles (software rendering is many times faster, physics
        are the same), ``"full"`` leaves it, ``"auto"`` is light on a software renderer
    :param render_mode: ``"rgb_array"`` or None; for ``env.render()``, which makes frames for people and videos
    :param render_size: pixels, width and height of those frames
    :param task_kwargs: passed to the ManiSkill task
    :raises ValueError: for an unknown task, robot, controller, camera, mode, or an impossible size
    :raises RuntimeError: if assets are missing or this machine cannot render, with the cure
    """
    height, width = check_sizes(image_size, n_points, goal_points, max_distance, max_episode_steps, render_size)
    if obs_mode not in OBS_MODES:
        raise ValueError(f"Unknown obs_mode {obs_mode!r}, expected one of {', '.join(OBS_MODES)}.")
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be 'rgb_array' or None, got {render_mode!r}.")
    renderer = ensure_renderer()
    task = check_task(env_id, robot_uids, control_mode, reward_mode, max_episode_steps)
    context = choose_visuals(visuals, software=renderer.software, robot=task.robot)
    with explained(env_id), context:
        env = gym.make(
            env_id,
            disable_env_checker=True,
            num_envs=1,
            obs_mode=OBS_MODES[obs_mode],
            control_mode=control_mode,
            reward_mode=reward_mode,
            render_mode=render_mode,
            sensor_configs={"height": height, "width": width},
            human_render_camera_configs={"height": render_size, "width": render_size},
            sim_backend="physx_cpu",
            render_backend=renderer.backend,
            **task.robot_kwargs,
            **task_kwargs,
        ).unwrapped
    return ManiSkillEnv(
        env,
        cameras=cameras,
        obs_mode=obs_mode,
        n_points=n_points,
        goal_points=goal_points,
        max_distance=max_distance,
        max_episode_steps=task.max_episode_steps,
        ignore_terminations=ignore_terminations,
        visuals=context,
    )
