"""
PickSingleEGAD: pick up one of the objects of EGAD, an evolved set of shapes that are hard to grasp, and carry it to a goal.

After ManiSkill 2's ``PickSingleEGAD-v0``: the same objects, success and terms of the dense reward, and the same regions for
object and goal. As in ManiSkill 3's PickSingleYCB-v1, its sibling, the object is put onto the table (ManiSkill 2 let it
fall and settle, which a batched simulation cannot do for one environment alone), and an episode has 50 steps.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import sapien
import torch as th
from mani_skill import ASSET_DIR
from mani_skill.agents.robots import Panda, PandaWristCam
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.randomization.pose import random_quaternions
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import assets, common, sapien_utils
from mani_skill.utils.building import actors
from mani_skill.utils.registration import register_env
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.pose import Pose

from sb3_cpm.envs.maniskill.tasks.lift_cube import GRASP_ANGLE

FOLDER = "mani_skill2_egad"
MODELS = "info_pick_train_v0.json"
"""Its list of objects: ``{id: {"bbox": {"min": .., "max": ..}, "scales": [..]}}``"""

assets.DATA_SOURCES.setdefault(
    "egad",
    assets.DataSource(
        source_type="task_assets",
        url="https://storage1.ucsd.edu/datasets/ManiSkill2022-assets/mani_skill2_egad_v1.zip",
        target_path=FOLDER,
        checksum="4b5d841256e0151c2a615a98d4e92afa12ad6d795e2565b364586e3940d3aa36",
    ),
)


def model_files(folder: Path, model_id: str) -> tuple[Path, Path]:
    """:return: collision shapes (one convex part per group) and looks of an object"""
    split = "train" if "_" in model_id else "eval"
    return folder / f"egad_{split}_set_coacd" / f"{model_id}.obj", folder / f"egad_{split}_set" / f"{model_id}.obj"


@register_env("PickSingleEGAD-v1", max_episode_steps=50, asset_download_ids=["egad"])
class PickSingleEGADEnv(BaseEnv):
    """
    Success: the object's centre of mass is within 2.5 cm of the goal, and the robot's joints rest (below 0.2 rad/s).

    Dense reward, at most 10 (the value in a successful step): ``1 - tanh(3 max(d - s, 0))`` for the distance d between hand
    and object and the object's size s (the diagonal of its box), 3 for a grasp, and in the grasp ``3 (1 - tanh(3 g))`` for
    the distance g between object and goal.

    :param model_ids: the objects to choose from, by default all; which one it is changes when the scene is built anew
    :param reconfiguration_freq: build a new scene every so many resets; by default at each if there is one environment only
    """

    SUPPORTED_ROBOTS = ("panda", "panda_wristcam")
    agent: Panda | PandaWristCam
    goal_thresh = 0.025
    object_region = 0.1
    goal_region = (0.15, 0.25, 0.5)

    def __init__(
        self,
        *args: Any,
        robot_uids: str = "panda_wristcam",
        robot_init_qpos_noise: float = 0.02,
        model_ids: tuple[str, ...] = (),
        num_envs: int = 1,
        reconfiguration_freq: int | None = None,
        **kwargs: Any,
    ) -> None:
        self.robot_init_qpos_noise = robot_init_qpos_noise
        self.folder = Path(ASSET_DIR) / FOLDER
        self.models: dict[str, Any] = json.loads((self.folder / MODELS).read_text())
        unknown = set(model_ids) - set(self.models)
        if unknown:
            raise ValueError(f"EGAD has no object {sorted(unknown)[0]!r}; it has {', '.join(sorted(self.models)[:10])} ...")
        self.all_model_ids = np.array(sorted(model_ids or self.models))
        if reconfiguration_freq is None:
            reconfiguration_freq = 1 if num_envs == 1 else 0
        super().__init__(*args, robot_uids=robot_uids, num_envs=num_envs, reconfiguration_freq=reconfiguration_freq, **kwargs)

    # ------------------------------------------------------------------ scene
    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.3, 0, 0.6], target=[-0.1, 0, 0.1])
        return [CameraConfig("base_camera", pose, 128, 128, np.pi / 2, 0.01, 100)]

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at([0.6, 0.7, 0.6], [0.0, 0.0, 0.35])
        return CameraConfig("render_camera", pose, 512, 512, 1, 0.01, 100)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        self.table_scene = TableSceneBuilder(self, robot_init_qpos_noise=self.robot_init_qpos_noise)
        self.table_scene.build()
        self._objs: list[Actor] = []
        sizes = []
        # by ManiSkill's generators of the episode, which also a simulation on the GPU draws from on the CPU
        for index, model_id in enumerate(self._batched_episode_rng.choice(self.all_model_ids)):
            model = self.models[str(model_id)]
            scale = float((model.get("scales") or [1.0])[0])
            sizes.append(scale * float(np.linalg.norm(np.subtract(model["bbox"]["max"], model["bbox"]["min"]))))
            self._objs.append(self._build_object(str(model_id), scale, index))
        self.obj = Actor.merge(self._objs, name="egad_object")
        self.add_to_state_dict_registry(self.obj)
        self.obj_size = common.to_tensor(sizes, device=self.device).float()
        self.goal_site = actors.build_sphere(
            self.scene,
            radius=self.goal_thresh,
            color=[0, 1, 0, 1],
            name="goal_site",
            body_type="kinematic",
            add_collision=False,
            initial_pose=sapien.Pose(),
        )
        self._hidden_objects.append(self.goal_site)

    def _build_object(self, model_id: str, scale: float, index: int) -> Actor:
        collision, looks = model_files(self.folder, model_id)
        color = self._batched_episode_rng[index].uniform(0.2, 0.8, 3)
        material = sapien.render.RenderMaterial(base_color=[*color, 1.0], roughness=0.1, metallic=0.0)
        builder = self.scene.create_actor_builder()
        builder.add_multiple_convex_collisions_from_file(filename=str(collision), scale=[scale] * 3, density=100)
        builder.add_visual_from_file(filename=str(looks), scale=[scale] * 3, material=material)
        builder.initial_pose = sapien.Pose()
        builder.set_scene_idxs([index])
        actor = builder.build(name=f"{model_id}-{index}")
        actor.set_linear_damping(0.1)
        actor.set_angular_damping(0.1)
        self.remove_from_state_dict_registry(actor)
        return actor

    def _after_reconfigure(self, options: dict) -> None:
        meshes = [obj.get_first_collision_mesh(to_world_frame=False) for obj in self._objs]
        for obj, mesh in zip(self._objs, meshes, strict=True):
            if mesh is None:  # SAPIEN goes on without shapes that it cannot read
                raise RuntimeError(f"Failed to load the collision shapes of EGAD's {obj.name}: its file is damaged")
        lowest = [mesh.bounds[0, 2] for mesh in meshes]
        self.object_zs = -common.to_tensor(lowest, device=self.device).float()

    def _initialize_episode(self, env_idx: th.Tensor, options: dict) -> None:
        with th.device(self.device):
            n = len(env_idx)
            self.table_scene.initialize(env_idx)
            place = th.zeros((n, 3))
            place[:, :2] = (2 * th.rand((n, 2)) - 1) * self.object_region
            place[:, 2] = self.object_zs[env_idx]
            pose = Pose.create_from_pq(p=place, q=random_quaternions(n, lock_x=True, lock_y=True))
            self.obj.set_pose(pose)
            center = (pose * self.obj.cmass_local_pose[env_idx]).p
            self.goal_site.set_pose(Pose.create_from_pq(self._draw_goals(center)))

    def _draw_goals(self, center: th.Tensor) -> th.Tensor:
        """Goals that are not where the object is already: drawn again until they are far enough, at most 100 times."""
        region = th.tensor(self.goal_region)
        goal = th.zeros_like(center)
        near = th.ones(len(center), dtype=th.bool)
        for _ in range(100):
            drawn = th.rand_like(center) * region
            drawn[:, :2] = 2 * drawn[:, :2] - region[:2]
            drawn[:, 2] = (drawn[:, 2] + center[:, 2]).clamp(max=self.goal_region[2])
            goal = th.where(near[:, None], drawn, goal)
            near = th.linalg.norm(goal - center, dim=1) <= 2 * self.goal_thresh
            if not near.any():
                break
        return goal

    # ------------------------------------------------------------------ task
    @property
    def obj_pose(self) -> Pose:
        """Of the centre of mass: EGAD's origins lie anywhere."""
        return self.obj.pose * self.obj.cmass_local_pose

    def evaluate(self) -> dict[str, th.Tensor]:
        to_goal = self.goal_site.pose.p - self.obj_pose.p
        placed = th.linalg.norm(to_goal, dim=1) <= self.goal_thresh
        static = self.agent.is_static(0.2)
        return {
            "obj_to_goal_pos": to_goal,
            "is_obj_placed": placed,
            "is_robot_static": static,
            "is_grasped": self.agent.is_grasping(self.obj, max_angle=GRASP_ANGLE),
            "success": placed & static,
        }

    def _get_obs_extra(self, info: dict) -> dict[str, th.Tensor]:
        hand, goal = self.agent.tcp.pose, self.goal_site.pose.p
        obs = {"tcp_pose": hand.raw_pose, "goal_pos": goal, "is_grasped": info["is_grasped"]}
        if "state" in self.obs_mode:
            obj = self.obj_pose
            obs["tcp_to_goal_pos"] = goal - hand.p
            obs["obj_pose"] = obj.raw_pose
            obs["tcp_to_obj_pos"] = obj.p - hand.p
            obs["obj_to_goal_pos"] = goal - obj.p
        return obs

    def compute_dense_reward(self, obs: Any, action: th.Tensor, info: dict) -> th.Tensor:
        distance = th.linalg.norm(self.obj_pose.p - self.agent.tcp.pose.p, dim=1)
        to_goal = th.linalg.norm(info["obj_to_goal_pos"], dim=1)
        reward = 1 - th.tanh(3 * (distance - self.obj_size).clamp(min=0.0))
        reward = reward + info["is_grasped"] * (3 + 3 * (1 - th.tanh(3 * to_goal)))
        return th.where(info["success"], 10.0, reward)

    def compute_normalized_dense_reward(self, obs: Any, action: th.Tensor, info: dict) -> th.Tensor:
        return self.compute_dense_reward(obs, action, info) / 10
