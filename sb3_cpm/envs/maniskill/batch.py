"""
The layer between ManiSkill's batched tensors and everybody else: N environments of one simulation as NumPy arrays.

:class:`~sb3_cpm.envs.maniskill.env.ManiSkillEnv` is the case N = 1,
:class:`~sb3_cpm.envs.maniskill.vec_env.ManiSkillVecEnv` any N; both go through every line of this module, so what holds for
one holds for the other.
"""

import contextlib
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_cpm.envs.maniskill import clouds
from sb3_cpm.envs.maniskill import observations as obs_tools
from sb3_cpm.envs.maniskill.checks import explained
from sb3_cpm.envs.maniskill.cpu_speedups import speed_up
from sb3_cpm.envs.maniskill.experts import Expert, make_expert, why_not
from sb3_cpm.envs.maniskill.gains import OWN_GAINS, Gains
from sb3_cpm.envs.maniskill.start_states import StartState, restore, state_of
from sb3_cpm.envs.maniskill.visuals import Visuals
from sb3_cpm.machine.thread_affinity import follow_simulation

OBS_MODES = {"visual": "rgb+position+segmentation", "state": "state_dict"}
"""Our observation modes and ManiSkill's. "rgb+position+segmentation" costs the same one render as "rgb" alone."""


TARGETS = ("handle_link", "target_switch_link", "obj", "cube", "cubeA", "peg", "charger")
"""Where tasks keep what is to be acted on: the moving link of cabinets and faucets, or an object."""


class BatchStep(NamedTuple):
    """
    What happened in one step of N environments.

    :param observations: one array per key, first axis N
    :param rewards: shape ``(N,)``, float32
    :param terminated: shape ``(N,)``, bool
    :param truncated: shape ``(N,)``, bool
    :param infos: Python numbers, one dict per environment
    """

    observations: dict[str, np.ndarray]
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    infos: list[dict[str, Any]]


class ManiSkillBatch:
    """
    :param env: the unwrapped ManiSkill environment
    :param cameras: names of the cameras to show, None for all that the task and the robot have
    :param obs_mode: ``"visual"`` or ``"state"``
    :param cloud: what the point cloud is to be
    :param max_episode_steps: an episode is truncated after so many steps
    :param ignore_terminations: see :func:`~sb3_cpm.envs.make_maniskill_env`
    :param visuals: entered around whatever may build the scene
    :param gains: of the arm's controller
    :raises ValueError: for gains that the controller does not have
    """

    def __init__(
        self,
        env: Any,
        cameras: Sequence[str] | str | None,
        obs_mode: str,
        cloud: clouds.CloudSettings,
        max_episode_steps: int,
        ignore_terminations: bool,
        visuals: Visuals,
        gains: Gains = OWN_GAINS,
    ):
        self.env = env
        # the task's own name; read now, since gym.make() of an id of ours will write that id over ManiSkill's
        self.env_id: str = env.spec.id if env.spec is not None else type(env).__name__
        self.num_envs: int = self.env.num_envs
        self.obs_mode = obs_mode
        self.cloud = cloud
        self.max_episode_steps = max_episode_steps
        self.ignore_terminations = ignore_terminations
        self.episode_seeds = np.zeros(self.num_envs, dtype=np.int64)
        self.state_layout: dict[str, slice] = {}
        self.shows_goal = False
        self.goal: Any = None  # a goal view wants to know where things are, see `sb3_cpm.envs.maniskill.goals`
        self._visuals = visuals
        self._gains = gains
        self._experts: dict[int, Expert] = {}
        self._labels = np.zeros((self.num_envs, 1), dtype=np.int16)
        self.cameras = self._choose_cameras(cameras) if obs_mode == "visual" else ()
        self._scene_changed()
        self.action_space: spaces.Box = self.env.single_action_space
        # ManiSkill rendered once while it was built; that observation has every key, so the spaces need no second render
        raw = obs_tools.to_host(self._select(self.env._last_obs))
        self.shows_goal = obs_tools.find_goal(raw["extra"]) is not None
        self._last = self._observe(raw, np.arange(self.num_envs), np.zeros(self.num_envs, dtype=np.int64))
        self.observation_space = _space(self._last)
        self._grasps: dict[str, np.ndarray] = {}  # what the grippers feel, by the task's names

    # ------------------------------------------------------------------ episodes
    def reset(
        self,
        rows: np.ndarray,
        seeds: Sequence[int],
        states: Sequence[StartState | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
        """
        Begin an episode in some of the environments; the others go on undisturbed.

        With N = 1 the seed determines the start. With more, ManiSkill draws the starts of all that are reset together from one
        generator, so a start depends on the seeds and on who else was reset: a run repeats, a single episode need not.

        :param rows: indices of the environments, ascending, shape ``(n,)``
        :param seeds: of their episodes, where no state is given
        :param states: where to start instead, see :meth:`get_state`
        :param options: passed to ManiSkill
        :return: observations with first axis n, and n infos
        :raises RuntimeError: if the task builds a new scene and a file that this takes turns out to be damaged, with the cure
        """
        states = [None] * len(rows) if states is None else states
        self.episode_seeds[rows] = [s["seed"] if s is not None else seed for s, seed in zip(states, seeds, strict=True)]
        for row in rows.tolist():
            self._experts.pop(row, None)
        everyone = len(rows) == self.num_envs
        index = th.as_tensor(rows, device=self.env.device)
        given = self.episode_seeds.copy()
        if rows[0] != 0:
            # ManiSkill seeds torch with the first entry. Were that the seed of environment 0, which is in the middle of its
            # episode, then the others would start at the same place again and again until that episode ends.
            given[0] = given[rows[0]]
        builds = getattr(self.env, "reconfiguration_freq", 0) or (options or {}).get("reconfigure")
        with explained(self.env_id) if builds else contextlib.nullcontext(), self._visuals:
            raw, info = self.env.reset(
                seed=given.tolist(), options={**(options or {}), **({} if everyone else {"env_idx": index})}
            )
        if info.pop("reconfigure", False):
            self._scene_changed()
        starts = {int(row): state for row, state in zip(rows, states, strict=True) if state is not None}
        if starts:
            restore(self.env, starts)
            info = self.env.get_info()
            raw = self.env._last_obs = self.env.get_obs(info)
        host = obs_tools.to_host(self._select(raw, info), None if everyone else index)
        # A new episode starts before any contact; ManiSkill still reports the contact of the last step that it simulated.
        for part in (host["extra"], host["info"]):
            for key in filter(_is_grasp, part):
                part[key][:] = [bool(state and state["grasps"].get(key)) for state in states]
        self._remember_grasps(host, rows)
        observations = self._observe(host, rows, host["info"]["elapsed_steps"])
        # not in place: the arrays of the last step belong to whoever took that step
        last = {key: value.copy() for key, value in self._last.items()}
        for key, value in observations.items():
            if key in last:
                last[key][rows] = value
            else:
                last[key] = np.zeros((self.num_envs, *value.shape[1:]), dtype=value.dtype)
        self._last = last
        return observations, self._infos(host["info"], rows)

    def step(self, actions: np.ndarray) -> BatchStep:
        """
        :param actions: shape ``(N, action_dim)``
        :raises ValueError: for actions of a wrong size, or that are not finite: they would ruin the simulation for good
        """
        actions = np.asarray(actions, dtype=np.float32)
        if actions.shape != (self.num_envs, *self.action_space.shape):
            raise ValueError(f"Expected actions of shape {self.action_space.shape}, got {actions.shape[1:]}.")
        if not np.isfinite(actions).all():
            raise ValueError(f"Actions must be finite numbers within [-1, 1], got {actions}.")
        follow_simulation()
        raw, reward, terminated, _, info = self.env.step(actions)
        host = obs_tools.to_host({**self._select(raw, info), "reward": reward, "terminated": terminated})
        steps = host["info"]["elapsed_steps"]
        rewards = host["reward"].astype(np.float32)
        observations = self._observe(host, np.arange(self.num_envs), steps)
        over = host["terminated"].astype(bool) & (not self.ignore_terminations)
        truncated = steps >= self.max_episode_steps
        infos = self._infos(host["info"], np.arange(self.num_envs))
        self._remember_grasps(host, np.arange(self.num_envs))
        sane = np.isfinite(rewards) & np.isfinite(observations["state"]).all(axis=1)
        if not sane.all():
            for i in np.flatnonzero(~sane).tolist():
                self._diverged(i, observations, infos[i], int(steps[i]))
            rewards[~sane], over[~sane], truncated[~sane] = 0, False, True
        self._last = observations
        return BatchStep(observations, rewards, over, truncated, infos)

    def _diverged(self, i: int, observations: dict[str, np.ndarray], info: dict[str, Any], step: int) -> None:
        warnings.warn(
            f"The simulation of {self.env_id} gave numbers that are not finite in step {step} of the episode with seed "
            f"{self.episode_seeds[i]}: the episode is truncated there, its last observation is the one before, reward 0."
        )
        for key, value in observations.items():
            value[i] = self._last[key][i]
        info["diverged"] = True

    def get_state(self, i: int) -> StartState:
        """
        :param i: index of the environment
        :return: everything from which the simulation can go on here or elsewhere, see
            :mod:`sb3_cpm.envs.maniskill.start_states`
        """
        grasps = {key: bool(values[i]) for key, values in self._grasps.items()}
        return state_of(self.env, i, self.env_id, int(self.episode_seeds[i]), grasps)

    def expert_action(self, i: int) -> np.ndarray:
        """
        :param i: index of the environment
        :return: what the task's scripted expert does now, see :mod:`sb3_cpm.envs.maniskill.experts`
        :raises ValueError: if there is none, see :attr:`no_expert`
        """
        if i not in self._experts:
            self._experts[i] = make_expert(self.env_id, self.env, i)
        return self._experts[i].act()

    @property
    def no_expert(self) -> str | None:
        """Why the task's scripted expert cannot act here; None: it can."""
        return why_not(self.env_id, self.env)

    def _remember_grasps(self, host: dict[str, Any], rows: np.ndarray) -> None:
        for part in (host["extra"], host["info"]):
            for key in filter(_is_grasp, part):
                self._grasps.setdefault(key, np.zeros(self.num_envs, dtype=bool))[rows] = part[key]

    # ------------------------------------------------------------------ observation
    def _select(self, raw: dict[str, Any], info: dict[str, Any] | None = None) -> dict[str, Any]:
        """What is to be copied to the host, and nothing else."""
        tree: dict[str, Any] = {"agent": raw["agent"], "extra": raw["extra"]}
        if info is not None:
            tree["info"] = {key: value for key, value in info.items() if isinstance(value, (th.Tensor, np.ndarray))}
        for name in self.cameras:
            sensor = raw["sensor_data"][name]
            if self.cloud.n_points:
                tree[f"camera {name}"] = {
                    "rgb": sensor["rgb"],
                    "position": sensor["position"],
                    "segmentation": sensor["segmentation"],
                    "cam2world": raw["sensor_param"][name]["cam2world_gl"],
                }
            else:
                tree[f"camera {name}"] = {"rgb": sensor["rgb"]}
        if self.goal is not None:
            tree["goal"] = self.goal.positions(self.env)
        if self.cameras and self.cloud.n_points:
            robot = self.env.agent
            if self.cloud.frame == "base":
                tree["frame"] = robot.robot.pose.raw_pose
            elif self.cloud.frame == "end_effector":
                tree["frame"] = robot.tcp.pose.raw_pose
        return tree

    def _observe(self, host: dict[str, Any], rows: np.ndarray, steps: np.ndarray) -> dict[str, np.ndarray]:
        agent, extra = host["agent"], host["extra"]
        observations: dict[str, np.ndarray] = {}
        # copies: the pictures are parts of a block in which there is much else
        for name in self.cameras:
            observations[name] = host[f"camera {name}"]["rgb"].copy()
        if self.cameras and self.cloud.n_points:
            observations["pointcloud"] = clouds.make_clouds(
                self.cloud,
                [clouds.Picture(**host[f"camera {name}"]) for name in self.cameras],
                self._labels[rows],
                obs_tools.find_goal(extra),
                extra["tcp_pose"][:, :3] if "tcp_pose" in extra else np.zeros((len(rows), 3)),
                host.get("frame"),
                # the same points of the same picture, wherever and whenever it is seen
                lambda i: np.random.default_rng([int(self.episode_seeds[rows[i]]), int(steps[i])]),
            )
        parts = obs_tools.state_parts(agent, extra, privileged=self.obs_mode == "state")
        if not self.state_layout:
            self.state_layout = obs_tools.layout(parts)
        observations["state"] = obs_tools.join_parts(parts, len(rows))
        for key, place in host.get("goal", {}).items():
            observations[key] = place.astype(np.float32)
        return observations

    def _infos(self, info: Mapping[str, np.ndarray], rows: np.ndarray) -> list[dict[str, Any]]:
        """Python numbers; arrays only where a task reports more than one number. And which object it is about."""
        names, n = list(info), len(rows)
        columns = [list(_rows(info[name], n)) for name in names]
        infos = [dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)]
        for one in infos:
            if "success" in one:
                one["success"] = one["is_success"] = bool(one["success"])
        for row, one in zip(rows.tolist(), infos, strict=True):
            one["instance"] = self._instances[row]
        return infos

    # ------------------------------------------------------------------ scene
    def _choose_cameras(self, wanted: Sequence[str] | str | None) -> tuple[str, ...]:
        available = tuple(self.env._sensors)
        if wanted is not None:
            wanted = (wanted,) if isinstance(wanted, str) else tuple(dict.fromkeys(wanted))  # each once
        unknown = [name for name in wanted or () if name not in available]
        if unknown:
            raise ValueError(f"Unknown camera {unknown[0]!r}: this task with this robot has {', '.join(available) or 'none'}.")
        if self.cloud.n_points and self.cloud.frame == "end_effector" and not hasattr(self.env.agent, "tcp"):
            raise ValueError(f"point_frame='end_effector': robot {self.env.agent.uid!r} names no end effector; take 'base'.")
        return available if wanted is None else tuple(wanted)

    def _target(self) -> Any:
        if self.cloud.labels != "roles":
            return None
        for name in TARGETS:
            if hasattr(self.env, name):
                return getattr(self.env, name)
        raise ValueError(f"point_labels='roles': {self.env_id} does not say what is to be acted on. Take point_labels=True.")

    def _scene_changed(self) -> None:
        """After ManiSkill built the scene: ids and objects are new, cameras nobody wants must not be rendered."""
        self._instances = _instances(self.env, self.env_id)
        if self.obs_mode == "visual":
            things = _things(self.env, self._target())
            self._labels = clouds.label_table(things, by_role=self.cloud.labels == "roles")
        for name in set(self.env._sensors) - set(self.cameras):
            del self.env._sensors[name]
        self._gains.give(self.env)
        speed_up(self.env)


def _things(env: Any, target: Any) -> list[dict[int, clouds.Thing]]:
    """
    :param env: the ManiSkill environment
    :param target: the actor or link that is to be acted on; None if nobody wants to know
    :return: for each environment: segmentation id to the thing
    """
    things: list[dict[int, clouds.Thing]] = [{} for _ in range(env.num_envs)]
    agents = getattr(env.agent, "agents", [env.agent])
    robots = {id(agent.robot) for agent in agents if agent is not None}
    targets = set() if target is None else set(_ids(target))
    named = [(actor, False, clouds.OTHER) for actor in env.scene.actors.values()]
    for articulation in env.scene.articulations.values():
        acted_on = any(not targets.isdisjoint(_ids(link)) for link in articulation.links)
        role = clouds.REST if acted_on else clouds.OTHER
        named += [(link, id(articulation) in robots, role) for link in articulation.links]
    for thing, is_robot, role in named:
        for number, i in _ids(thing):
            things[number][i] = clouds.Thing(thing.name, is_robot, clouds.TARGET if (number, i) in targets else role)
    return things


def _ids(thing: Any) -> list[tuple[int, int]]:
    """Of an actor or link, which may be in some of the environments only: environment and segmentation id there."""
    entities = [getattr(part, "entity", part) for part in thing._objs]  # links are components of theirs
    return [(number, one.per_scene_id) for number, one in zip(thing._scene_idxs.tolist(), entities, strict=True)]


def _instances(env: Any, env_id: str) -> list[str]:
    """
    :param env: the ManiSkill environment
    :param env_id: the task's name, where objects do not vary
    :return: for each environment which object it is about: ManiSkill's name of it, without the environment's number
    """
    for attribute in ("_objs", "_faucets", "_cabinets"):
        objects = getattr(env, attribute, ())
        if len(objects) == env.num_envs:
            return [re.sub(r"-\d+$", "", one.name) for one in objects]
    return [env_id] * env.num_envs


def _is_grasp(key: str) -> bool:
    return "grasp" in key


def _rows(values: np.ndarray, n: int) -> Iterator[Any]:
    """One Python number (or array) per environment; what does not belong to one environment is everybody's."""
    if values.ndim == 0 or len(values) != n:
        return iter([values.item() if values.ndim == 0 else values] * n)
    if values.size == n:
        return iter(values.reshape(n).tolist())
    return iter(value.copy() for value in values)


def _space(example: Mapping[str, np.ndarray]) -> spaces.Dict:
    return spaces.Dict(
        {
            key: spaces.Box(0, 255, value.shape[1:], np.uint8)
            if value.dtype == np.uint8
            else spaces.Box(-np.inf, np.inf, value.shape[1:], np.float32)
            for key, value in example.items()
        }
    )
