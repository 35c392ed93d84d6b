"""
ManiSkill 3 tasks as plain gymnasium environments with the observations of the report (section 4.1).

ManiSkill's own environments return batched torch tensors in nested dicts, know no ``max_episode_steps`` and draw from
torch's global random numbers. Ours returns NumPy copies in a flat Dict, one render per step, ends episodes by gymnasium's
rules and is ruled by the seed of ``reset`` alone.
"""

import copy
import inspect
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding

from sb3_cpm.envs.maniskill.batch import OBS_MODES, ManiSkillBatch
from sb3_cpm.envs.maniskill.checks import check_sizes, check_task, check_task_kwargs, choose_renderer, explained
from sb3_cpm.envs.maniskill.clouds import CloudSettings
from sb3_cpm.envs.maniskill.gains import Gains
from sb3_cpm.envs.maniskill.simulation import choose_simulation
from sb3_cpm.envs.maniskill.start_states import StartState, check_state
from sb3_cpm.envs.maniskill.visuals import choose_visuals
from sb3_cpm.extras import needed
from sb3_cpm.machine.rendering import opened


class ManiSkillEnv(gym.Wrapper[Any, Any, Any, Any]):
    """
    One ManiSkill environment, as gymnasium means it. Use :func:`make_maniskill_env` to get one.

    Random numbers: ``reset(seed=s)`` starts a generator; every later ``reset()`` draws the episode's seed from it, so a whole
    run is determined by the first seed. (ManiSkill would take torch's global generator: not reproducible in worker processes,
    and it would disturb the random numbers of the agent.)

    ``info`` holds Python numbers: ``success`` and ``is_success`` at every step (True in the step in which the task is solved,
    ManiSkill's success is not sticky), ``fail`` where the task has it, ``elapsed_steps`` and the task's own entries; and
    ``diverged`` where the simulation broke down, which truncates the episode.

    Start states: ``reset(options={"state": state})`` goes on where :meth:`get_state` was called, here or in another process,
    also for an environment in SB3's VecEnvs: ``vec_env.set_options([{"state": ...}, ...])`` before ``vec_env.reset()``,
    ``vec_env.env_method("start_next_from", state, indices=[i])`` before an episode ends.

    :param batch: a simulation of one environment
    """

    def __init__(self, batch: ManiSkillBatch):
        super().__init__(batch.env)
        self.batch = batch
        self.action_space = batch.action_space
        self.observation_space = batch.observation_space
        self._max_episode_steps = batch.max_episode_steps  # where gymnasium's TimeLimit has it
        self._next_state: StartState | None = None

    # ------------------------------------------------------------------ gymnasium
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """
        :param seed: see the class; with a state it rules the episodes after this one
        :param options: ``"state"``: a start state, see the class; everything else is passed to ManiSkill
        :raises ValueError: if that is no start state, or one of another task
        """
        if seed is not None:
            self.np_random, _ = seeding.np_random(seed)
        options = dict(options or {})
        state = options.pop("state", self._next_state)
        if state is not None:
            check_state(state, self.batch.env_id)
        self._next_state = None
        # a seed is given to ManiSkill in any case, see the class; a state has its own, and none is drawn for it
        episode_seed = int(self.np_random.integers(2**31)) if seed is None and state is None else seed or 0
        observations, infos = self.batch.reset(np.zeros(1, dtype=np.intp), [episode_seed], [state], options)
        return _first(observations), infos[0]

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        step = self.batch.step(np.asarray(action, dtype=np.float32)[None])
        return (
            _first(step.observations),
            float(step.rewards[0]),
            bool(step.terminated[0]),
            bool(step.truncated[0]),
            step.infos[0],
        )

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
        return spec_of(self.batch)

    def expert_action(self) -> np.ndarray:
        """
        :return: what the task's scripted expert does now, see :mod:`sb3_cpm.envs.maniskill.experts`
        :raises ValueError: if there is none, see :attr:`no_expert`
        """
        return self.batch.expert_action(0)

    @property
    def no_expert(self) -> str | None:
        """Why the task's scripted expert cannot act here; None: it can."""
        return self.batch.no_expert

    # ------------------------------------------------------------------ start states
    def get_state(self) -> StartState:
        """:return: where this episode is now, for ``reset(options={"state": ...})``; plain data, about 2 kB"""
        return self.batch.get_state(0)

    def start_next_from(self, state: StartState | None) -> None:
        """
        :param state: where the next ``reset`` starts, once; None to forget it
        :raises ValueError: if that is no start state, or one of another task
        """
        self._next_state = None if state is None else check_state(state, self.batch.env_id)


def spec_of(batch: ManiSkillBatch) -> gym.envs.registration.EnvSpec | None:
    """:return: ManiSkill's spec with the number of steps that really ends an episode"""
    spec = copy.copy(batch.env.spec)
    if spec is not None:
        spec.max_episode_steps = batch.max_episode_steps
    return spec


def _first(observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {key: value[0] for key, value in observations.items()}


def make_maniskill_env(
    env_id: str,
    *,
    obs_mode: str = "visual",
    control_mode: str = "pd_ee_delta_pose",
    reward_mode: str = "normalized_dense",
    robot_uids: str | None = None,
    stiffness: float | None = None,
    damping: float | None = None,
    cameras: Sequence[str] | str | None = None,
    image_size: int | tuple[int, int] = 32,
    n_points: int = 256,
    goal_points: int = 50,
    max_distance: float = 3.0,
    point_sampling: str = "random",
    point_frame: str = "world",
    point_labels: bool | str = False,
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
    * ``pointcloud``, shape ``(n_points + goal_points, 6)``, float32: x, y, z in metres, then red, green, blue in
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
    :param stiffness: proportional gain of the arm's PD controller, N m / rad; by default the robot's own (the Panda's: 1000)
    :param damping: its derivative gain, N m s / rad; by default the robot's own (the Panda's: 100)
    :param cameras: names of the cameras to show; by default all of the task and of the robot
    :param image_size: pixels, one number or ``(height, width)``
    :param n_points: points of the scene; 0 leaves ``pointcloud`` out
    :param goal_points: additional points around the goal
    :param max_distance: metres from the camera beyond which points are dropped
    :param point_sampling: which points stay where there are more than ``n_points``: ``"random"`` (ruled by the episode's seed
        and the step) or ``"farthest"``: spread as widely as possible, see
        :func:`~sb3_cpm.envs.maniskill.clouds.farthest_points`
    :param point_frame: where the points' zero is: ``"world"``, ``"base"`` of the robot, or ``"end_effector"``
    :param point_labels: a seventh column: 0 for the robot, 1, 2, ... for the other things in the order in which the scene
        lists them, -1 for the points at the goal. ``"roles"``: 1 for the thing to act on (the object; of a cabinet or faucet
        the link that is to move), 2 for the rest of what it is a part of, 3 for other things, so that labels mean the same
        with every cabinet. Privileged: a camera does not tell this
    :param max_episode_steps: by default the task's own (50 for PickCube)
    :param ignore_terminations: By default False: success (or failure) terminates the episode, as the task defines it and as
        evaluations want it. With positive dense rewards an agent may then learn to hover beside the goal, since success ends
        its income; ``True`` lets every episode run to ``max_episode_steps``, and ``is_success`` is that of the moment.
    :param visuals: ``"light"`` draws the robot with fewer triangles (software rendering is many times faster, physics
        are the same), ``"full"`` leaves it, ``"auto"`` is light on a software renderer
    :param render_mode: ``"rgb_array"`` or None; for ``env.render()``, which makes frames for people and videos
    :param render_size: pixels, width and height of those frames
    :param task_kwargs: passed to the ManiSkill task
    :raises ValueError: for an unknown task, robot, controller, camera, mode or argument, or an impossible size
    :raises RuntimeError: if assets are missing or this machine cannot render, with the cure
    """
    for name in ("num_envs", "sim_backend"):
        if name in task_kwargs:
            raise ValueError(f"make_maniskill_env makes one environment on the CPU; {name} is for make_maniskill_vec_env.")
    return ManiSkillEnv(
        build_batch(
            env_id,
            num_envs=1,
            sim_backend="physx_cpu",
            obs_mode=obs_mode,
            control_mode=control_mode,
            reward_mode=reward_mode,
            robot_uids=robot_uids,
            stiffness=stiffness,
            damping=damping,
            cameras=cameras,
            image_size=image_size,
            n_points=n_points,
            goal_points=goal_points,
            max_distance=max_distance,
            point_sampling=point_sampling,
            point_frame=point_frame,
            point_labels=point_labels,
            max_episode_steps=max_episode_steps,
            ignore_terminations=ignore_terminations,
            visuals=visuals,
            render_mode=render_mode,
            render_size=render_size,
            **task_kwargs,
        )
    )


def build_batch(
    env_id: str,
    *,
    num_envs: int,
    sim_backend: str,
    obs_mode: str,
    control_mode: str,
    reward_mode: str,
    robot_uids: str | None,
    stiffness: float | None,
    damping: float | None,
    cameras: Sequence[str] | str | None,
    image_size: int | tuple[int, int],
    n_points: int,
    goal_points: int,
    max_distance: float,
    point_sampling: str,
    point_frame: str,
    point_labels: bool | str,
    max_episode_steps: int | None,
    ignore_terminations: bool,
    visuals: str,
    render_mode: str | None,
    render_size: int,
    **task_kwargs: Any,
) -> ManiSkillBatch:
    """
    Check everything, then build. Parameters as for :func:`make_maniskill_env`, and:

    :param num_envs: environments in one simulation
    :param sim_backend: ``"physx_cpu"``, ``"physx_cuda"`` or ``"auto"``, see
        :func:`~sb3_cpm.envs.maniskill.simulation.choose_simulation`
    """
    gains = Gains(stiffness, damping).check()
    height, width = check_sizes(image_size, n_points, goal_points, max_distance, max_episode_steps, render_size)
    cloud = CloudSettings(n_points, goal_points, max_distance, point_sampling, point_frame, point_labels).check()
    if obs_mode not in OBS_MODES:
        raise ValueError(f"Unknown obs_mode {obs_mode!r}, expected one of {', '.join(OBS_MODES)}.")
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be 'rgb_array' or None, got {render_mode!r}.")
    renderer = choose_renderer(env_id, obs_mode)
    with needed("ManiSkill's tasks", "maniskill"):
        task = check_task(env_id, robot_uids, control_mode, reward_mode, max_episode_steps)
    check_task_kwargs(task.env_id, task_kwargs, inspect.signature(make_maniskill_env).parameters.keys() - {"task_kwargs"})
    sim_backend, simulation_kwargs = choose_simulation(
        num_envs, sim_backend, task_kwargs, renderer.backend, obs_mode == "visual"
    )
    context = choose_visuals(visuals, software=renderer.software)
    with explained(env_id), context, opened(renderer):
        env = gym.make(
            task.env_id,
            disable_env_checker=True,
            num_envs=num_envs,
            obs_mode=OBS_MODES[obs_mode],
            control_mode=control_mode,
            reward_mode=reward_mode,
            render_mode=render_mode if renderer.backend != "none" else None,
            sensor_configs={"height": height, "width": width},
            human_render_camera_configs={"height": render_size, "width": render_size},
            sim_backend=sim_backend,
            render_backend=renderer.backend,
            **task.robot_kwargs,
            **simulation_kwargs,
        ).unwrapped
    return ManiSkillBatch(
        env,
        cameras=cameras,
        obs_mode=obs_mode,
        cloud=cloud,
        max_episode_steps=task.max_episode_steps,
        ignore_terminations=ignore_terminations,
        visuals=context,
        gains=gains,
    )
