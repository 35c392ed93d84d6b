"""
Stands in for ManiSkill's environment with any number of environments in one simulation, which needs a GPU: the parts of its
interface that the package uses, with its manners: batched tensors, the same live buffers in every observation, torch seeded
with the seed of environment 0, partial resets by ``env_idx``.
"""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

SIZE = 36  # the smallest that SB3's own convolutions take


class FakeAgent:
    """A controller that remembers a target, as ``pd_ee_target_delta_pose`` does."""

    uid = "fake"

    def __init__(self, env: "FakeManiSkill"):
        self.env = env
        self.target = th.zeros(env.num_envs, 2)
        self.controller = self
        pose = th.tensor([[0.5, 0, 0, 1, 0, 0, 0]]).repeat(env.num_envs, 1)
        self.robot = SimpleNamespace(pose=SimpleNamespace(raw_pose=pose))

    def reset(self) -> None:
        mask = self.env.scene._reset_mask
        self.target[mask] = self.env.place[mask]

    def get_controller_state(self) -> dict[str, Any]:
        return {"arm": {"target": self.target}}

    def set_controller_state(self, state: dict[str, Any]) -> None:
        self.target = state["arm"]["target"].clone()


class FakeManiSkill(gym.Env):
    """
    A point pulled by its target, which the action moves; the episode succeeds when it is at the goal.

    :param num_envs: how many
    """

    render_mode = "rgb_array"

    def __init__(self, num_envs: int):
        self.num_envs = num_envs
        self.device = th.device("cpu")
        self.spec = gym.envs.registration.EnvSpec(id="Fake-v1")
        self.single_action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.place, self.goal = th.zeros(num_envs, 2), th.zeros(num_envs, 3)
        self.grasped = th.zeros(num_envs, dtype=th.bool)
        self._elapsed_steps = th.zeros(num_envs, dtype=th.int32)
        self._sensors = {"camera": None, "other": None}
        self._position = th.zeros(num_envs, SIZE, SIZE, 3, dtype=th.int16)
        self._rgb = th.zeros(num_envs, SIZE, SIZE, 3, dtype=th.uint8)
        self._segmentation = th.arange(SIZE * SIZE, dtype=th.int16).reshape(1, SIZE, SIZE, 1).repeat(num_envs, 1, 1, 1) % 4
        ids = [SimpleNamespace(per_scene_id=1)] * num_envs
        ground = SimpleNamespace(name="ground", _objs=ids, _scene_idxs=th.arange(num_envs))
        self.scene = SimpleNamespace(
            gpu_sim_enabled=True,
            actors={"ground": ground},
            articulations={},
            _reset_mask=th.ones(num_envs, dtype=th.bool),
            renders=0,
        )
        self.agent = FakeAgent(self)
        self.torch_seeds: list[int] = []
        self._last_obs, _ = self.reset(seed=[2022 + i for i in range(num_envs)])

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        assert len(seed) == self.num_envs
        rows = (options or {}).get("env_idx", th.arange(self.num_envs))
        with th.random.fork_rng():
            th.manual_seed(seed[0])
            self.torch_seeds.append(seed[0])
            start = th.rand(len(rows), 5)
        self.place[rows], self.goal[rows] = start[:, :2], start[:, 2:]
        self._elapsed_steps[rows] = 0
        self.scene._reset_mask[:] = False
        self.scene._reset_mask[rows] = True
        self.agent.reset()
        self.scene._reset_mask[:] = True
        info = self.get_info()
        return self.get_obs(info), {**info, "reconfigure": False}

    def step(self, action: Any) -> tuple[dict[str, Any], th.Tensor, th.Tensor, th.Tensor, dict[str, Any]]:
        action = th.as_tensor(action)
        self.agent.target += 0.1 * action
        self.place += 0.5 * (self.agent.target - self.place)
        self.grasped[:] = action[:, 0] > 0.9
        self._elapsed_steps += 1
        info = self.get_info()
        reward = -(self.place - self.goal[:, :2]).norm(dim=1)
        return self.get_obs(info), reward, info["success"], th.zeros(self.num_envs, dtype=th.bool), info

    def get_info(self) -> dict[str, Any]:
        success = (self.place - self.goal[:, :2]).norm(dim=1) < 0.05
        return {"elapsed_steps": self._elapsed_steps, "success": success, "is_grasped": self.grasped, "place": self.place}

    def get_obs(self, info: dict[str, Any]) -> dict[str, Any]:
        self.scene.renders += 1
        self._rgb[:] = (self.place[:, :1, None, None] * 100).to(th.uint8)
        self._position[..., 2] = (-1000 * self.place[:, :1, None]).to(th.int16)
        cameras = {"rgb": self._rgb, "position": self._position, "segmentation": self._segmentation}
        pose = th.eye(4).repeat(self.num_envs, 1, 1)
        hand = th.cat([self.place, th.zeros(self.num_envs, 5)], dim=1)
        return {
            "agent": {"qpos": self.place},
            "extra": {"is_grasped": self.grasped, "tcp_pose": hand, "goal_pos": self.goal},
            "sensor_data": {name: cameras for name in self._sensors},
            "sensor_param": {name: {"cam2world_gl": pose} for name in self._sensors},
        }

    def get_state_dict(self) -> dict[str, Any]:
        actors = {"point": self.place.clone(), "goal": self.goal.clone()}
        return {"actors": actors, "controller": self.agent.get_controller_state()}

    def set_state_dict(self, state: dict[str, Any], env_idx: th.Tensor) -> None:
        self.place[env_idx], self.goal[env_idx] = state["actors"]["point"], state["actors"]["goal"]

    def render(self) -> th.Tensor:  # type: ignore[override]
        return self._rgb
