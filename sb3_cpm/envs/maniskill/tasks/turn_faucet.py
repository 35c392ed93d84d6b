"""
TurnFaucet with its dense reward, which ManiSkill 3 left out.

After ManiSkill 2's ``TurnFaucet-v0``. The scene is ManiSkill 3's TurnFaucet-v1, seed by seed, with two repairs that matter
where several environments are simulated at once: an episode starts with the handle at its lower limit (there a handle would
stay as the last episode left it), and the start of one episode leaves the others alone.
"""

from typing import Any

import numpy as np
import torch as th
import trimesh
from mani_skill.envs.tasks.tabletop.turn_faucet import TurnFaucetEnv
from mani_skill.envs.utils import randomization
from mani_skill.utils.geometry.trimesh_utils import get_component_meshes, merge_meshes
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.link import Link
from mani_skill.utils.structs.pose import Pose

SURFACE_POINTS = 256
"""On each finger and on the handle; the smallest distance between them stands for that of the surfaces."""

FINGERS = {
    "panda": ("panda_leftfinger", "panda_rightfinger"),
    "panda_wristcam": ("panda_leftfinger", "panda_rightfinger"),
    "fetch": ("l_gripper_finger_link", "r_gripper_finger_link"),
}


@register_env("TurnFaucetDense-v1", max_episode_steps=200, asset_download_ids=["partnet_mobility_faucet"])
class TurnFaucetDenseEnv(TurnFaucetEnv):
    """
    Success: the handle passed 90% of its way (ManiSkill 3's own, the same as ManiSkill 2's).

    Dense reward, at most 10 (the value in a successful step), with the angle a that is left and the angle b by which this step
    turned the handle: ``1 - tanh(5 d)`` for the distance d between fingers and handle, ``3 (1 - tanh(2 a))``, and
    ``5 tanh(2 b)``.

    The angle before the step is read from the simulation when a step begins, so nothing is remembered that a stored state
    would have to contain.
    """

    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")

    def _after_reconfigure(self, options: dict) -> None:
        super()._after_reconfigure(options)
        self.target_link_pos = th.zeros((self.num_envs, 3), device=self.device)
        self._angle_before = self.current_angle.clone()
        links = [self.agent.robot.links_map[name] for name in FINGERS[self.robot_uids]]
        self._finger_points = [self._surface([link] * self.num_envs) for link in links]
        self._handle_points = self._surface(self._target_switch_links)

    def _surface(self, links: list[Link]) -> th.Tensor:
        """
        :param links: one per environment
        :return: points on their collision shapes, in their own frames, shape ``(n_envs, SURFACE_POINTS, 3)``
        """
        sampled: dict[int, np.ndarray] = {}
        for link in {id(link): link for link in links}.values():
            mesh = merge_meshes(get_component_meshes(link._objs[0]))
            # the same points for the same shape, whatever the seed of the episode
            sampled[id(link)] = np.asarray(trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=0)[0])
        points = np.stack([sampled[id(link)] for link in links])
        return th.as_tensor(points, dtype=th.float32, device=self.device)

    def _initialize_episode(self, env_idx: th.Tensor, options: dict) -> None:
        with th.device(self.device):
            self.scene_builder.initialize(env_idx)
            # the handle at its start, the other joints at zero
            rows, joint = th.arange(len(env_idx)), self.target_switch_link.joint
            angles = th.zeros_like(self.faucet.get_qpos()[env_idx])
            angles[rows, joint.active_index.to(self.device)[env_idx]] = self.init_angle[env_idx]
            self.faucet.set_qpos(angles)
            self.faucet.set_qvel(th.zeros_like(angles))
            # ManiSkill's draws in ManiSkill's order
            place = th.zeros((len(env_idx), 3))
            place[:, :2] = randomization.uniform(-0.05, 0.05, size=(len(env_idx), 2))
            place[:, 2] = self.model_offsets[env_idx, 2]
            bounds = (-th.pi / 12, th.pi / 12)
            turn = randomization.random_quaternions(n=len(env_idx), lock_x=True, lock_y=True, bounds=bounds)
            self.faucet.set_pose(Pose.create_from_pq(place, turn))
            if self.gpu_sim_enabled:
                self.scene._gpu_apply_all()
                self.scene.px.gpu_update_articulation_kinematics()
                self.scene.px.step()
                self.scene._gpu_fetch_all()
            self._remember_handle(env_idx)

    def _remember_handle(self, env_idx: th.Tensor) -> None:
        """Where the handle is at the start, which the observation shows during the whole episode."""
        link = self.target_switch_link
        position = (link.pose * link.cmass_local_pose).p
        self.target_link_pos[env_idx] = position[env_idx]
        axis = link.joint.get_global_pose().to_transformation_matrix()[:, :3, 0]
        self.target_joint_axis[env_idx] = axis[env_idx]

    def _before_control_step(self) -> None:
        super()._before_control_step()
        self._angle_before = self.current_angle.clone()

    def finger_distance(self) -> th.Tensor:
        """:return: metres between the nearer finger and the handle, shape ``(n_envs,)``"""
        handle = _placed(self._handle_points, self.target_switch_link.pose)
        links = [self.agent.robot.links_map[name] for name in FINGERS[self.robot_uids]]
        fingers = [_placed(points, link.pose) for points, link in zip(self._finger_points, links, strict=True)]
        return th.cdist(handle, th.cat(fingers, dim=1)).amin(dim=(1, 2))

    def compute_dense_reward(self, obs: Any, action: th.Tensor, info: dict) -> th.Tensor:
        left = self.target_angle - self.current_angle
        turned = self.current_angle - self._angle_before
        reward = 1 - th.tanh(5 * self.finger_distance())
        reward = reward + 3 * (1 - th.tanh(2 * left.clamp(min=0.0))) + 5 * th.tanh(2 * turned)
        return th.where(info["success"], 10.0, reward)

    def compute_normalized_dense_reward(self, obs: Any, action: th.Tensor, info: dict) -> th.Tensor:
        return self.compute_dense_reward(obs, action, info) / 10


def _placed(points: th.Tensor, pose: Pose) -> th.Tensor:
    """Points of a link's frame in the world's frame."""
    matrix = pose.to_transformation_matrix()
    return points @ matrix[:, :3, :3].transpose(1, 2) + matrix[:, None, :3, 3]
