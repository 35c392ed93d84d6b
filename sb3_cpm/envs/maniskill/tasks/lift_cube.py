"""
LiftCube: grasp the cube and lift it by 20 cm. The easiest task of the report's predecessor (ManiSkill 2's PPO tutorial).

After ManiSkill 2's ``LiftCube-v0``: the same success and the same terms of the dense reward, with ManiSkill 3's PickCube-v1
as the scene (robot, cube, cameras, 50 steps).
"""

from typing import Any

import torch as th
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.pose import Pose

GRASP_ANGLE = 30
"""Degrees between the fingers' forces and their way that count as a grasp in ManiSkill 2's rewards."""


@register_env("LiftCube-v1", max_episode_steps=50)
class LiftCubeEnv(PickCubeEnv):
    """
    Success: the cube is :attr:`goal_height` above where it lay, and the robot's joints rest (below 0.2 rad/s).

    Dense reward, at most 2.25 (the value in a successful step): ``1 - tanh(5 d)`` for the distance d between hand and cube,
    and with the cube in the grasp 0.25 plus the share of the height that is reached.

    The goal is no place, so no observation shows one: it would tell where the cube lay.
    """

    goal_height = 0.2

    def _initialize_episode(self, env_idx: th.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        # the marker for people: above the cube
        goal = self.cube.pose.p[env_idx].clone()
        goal[:, 2] += self.goal_height
        self.goal_site.set_pose(Pose.create_from_pq(goal))

    def _get_obs_extra(self, info: dict) -> dict[str, Any]:
        obs = super()._get_obs_extra(info)
        for key in ("goal_pos", "obj_to_goal_pos"):
            obs.pop(key, None)
        return obs

    def evaluate(self) -> dict[str, th.Tensor]:
        lifted = self.cube.pose.p[:, 2] >= self.goal_height + self.cube_half_size
        static = self.agent.is_static(0.2)
        grasped = self.agent.is_grasping(self.cube, max_angle=GRASP_ANGLE)
        return {"success": lifted & static, "is_obj_placed": lifted, "is_robot_static": static, "is_grasped": grasped}

    def compute_dense_reward(self, obs: Any, action: th.Tensor, info: dict) -> th.Tensor:
        distance = th.linalg.norm(self.cube.pose.p - self.agent.tcp_pose.p, dim=1)
        height = (self.cube.pose.p[:, 2] - self.cube_half_size) / self.goal_height
        reward = 1 - th.tanh(5 * distance) + info["is_grasped"] * (0.25 + height.clamp(max=1.0))
        return th.where(info["success"], 2.25, reward)

    def compute_normalized_dense_reward(self, obs: Any, action: th.Tensor, info: dict) -> th.Tensor:
        return self.compute_dense_reward(obs, action, info) / 2.25
