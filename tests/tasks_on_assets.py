"""
All tasks of the report on the objects that they download, run by test_tasks.py in a process of its own: ManiSkill reads where
they are (``MS_ASSET_DIR``) when it is imported. Once on stand-ins, and once on the real ones, where they are present.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from stable_baselines3.common.env_util import make_vec_env

from sb3_cpm.envs import GoalView, ManiSkillEnv, make_maniskill_env
from sb3_cpm.envs.maniskill import assets
from sb3_cpm.envs.maniskill.tasks import REPORT_TASKS, register_report_tasks
from sb3_cpm.imitation import record_demonstrations

CONTROLLERS = ("pd_ee_delta_pose", "pd_joint_delta_pos", "pd_ee_target_delta_pose")
STEPS = {"TurnFaucet-v1": 200, "OpenCabinetDrawer-v1": 100, "OpenCabinetDoor-v1": 100}
FREE = ("PickCube-v1", "StackCube-v1", "LiftCube-v1")


def make(env_id: str, **kwargs: Any) -> ManiSkillEnv:
    register_report_tasks()
    if any(asset.problems for asset in assets.assets_of(env_id)):
        pytest.skip(f"the objects of {env_id} are not here")
    return make_maniskill_env(env_id, **{"image_size": 16, "n_points": 32, **kwargs})


def play(env: ManiSkillEnv, n_steps: int, seed: int = 0) -> Iterator[tuple[Any, ...]]:
    for action in np.random.default_rng(seed).uniform(-1, 1, (n_steps, *env.action_space.shape)):  # type: ignore
        yield env.step(action.astype(np.float32))


# ---------------------------------------------------------------------- every task, mode and controller
@pytest.mark.parametrize("control_mode", CONTROLLERS)
@pytest.mark.parametrize("env_id", REPORT_TASKS)
def test_state(env_id: str, control_mode: str) -> None:
    env = make(env_id, obs_mode="state", control_mode=control_mode)
    assert env.spec is not None and env.spec.max_episode_steps == STEPS.get(env_id, 50)
    for _ in range(2):
        observation, info = env.reset(seed=3)
        assert env.observation_space.contains(observation) and np.isfinite(observation["state"]).all()
        assert info["is_success"] is False and not any(value for key, value in info.items() if "grasp" in key)
        for observation, reward, terminated, truncated, info in play(env, 3):
            assert type(reward) is float and 0 <= abs(reward) <= 1 and terminated is truncated is False
            assert np.isfinite(observation["state"]).all() and type(info["is_success"]) is bool
    env.close()


@pytest.mark.parametrize("control_mode", CONTROLLERS)
@pytest.mark.parametrize("env_id", REPORT_TASKS)
def test_visual(env_id: str, control_mode: str) -> None:
    env = make(env_id, control_mode=control_mode, reward_mode="sparse")
    first, _ = env.reset(seed=3)
    assert {key for key in first if first[key].ndim == 3} == set(env.batch.cameras) and len(env.batch.cameras) == 2
    for observation, reward, *_ in play(env, 2):
        assert env.observation_space.contains(observation)
        assert type(reward) is float and reward in (0.0, 1.0)
        assert observation["pointcloud"].std() > 0.01
    if control_mode == CONTROLLERS[0]:
        again, _ = env.reset(seed=3)
        assert all((first[key] == again[key]).all() for key in first)
    env.close()


@pytest.mark.parametrize("env_id", ["TurnFaucet-v1", "OpenCabinetDrawer-v1"])
def test_a_controller_that_the_robot_lacks_is_named_with_those_it_has(env_id: str) -> None:
    with pytest.raises(ValueError, match=r"has no controller 'pd_ee_pos_delta'.*pd_ee_delta_pose.*pd_ee_target_delta_pose"):
        make(env_id, control_mode="pd_ee_pos_delta")


# ---------------------------------------------------------------------- which object it is about, and demonstrations with it
@pytest.mark.parametrize("env_id", ["PickSingleYCB-v1", "PickSingleEGAD-v1", "TurnFaucet-v1", "OpenCabinetDrawer-v1"])
def test_infos_name_the_object(env_id: str) -> None:
    env = make(env_id, obs_mode="state")
    seen = set()
    for seed in range(4):
        _, info = env.reset(seed=seed)
        assert info["instance"] in env.unwrapped.all_model_ids  # type: ignore[attr-defined]
        assert next(play(env, 1))[-1]["instance"] == info["instance"]
        seen.add(info["instance"])
    assert len(seen) > 1, "each reset may bring another one"
    env.close()


@pytest.mark.parametrize("env_id", ["TurnFaucet-v1", "OpenCabinetDrawer-v1", "PickSingleYCB-v1"])
def test_points_by_role(env_id: str) -> None:
    by_role, in_order = (
        make(env_id, point_labels=labels, n_points=1000, image_size=64, goal_points=0) for labels in ("roles", True)
    )
    roles, places = (env.reset(seed=3)[0]["pointcloud"][:, 6] for env in (by_role, in_order))
    task: Any = by_role.unwrapped
    things = [thing.name for thing in task.scene.actors.values() if thing.name not in ("ground", "table-workspace")]
    for articulation in task.scene.articulations.values():
        things += [link.name for link in articulation.links if articulation is not task.agent.robot]
    target = getattr(task, {"TurnFaucet-v1": "target_switch_link", "OpenCabinetDrawer-v1": "handle_link"}.get(env_id, "obj"))
    name = getattr(target._objs[0], "entity", target._objs[0]).name  # after that of its scene
    found = {role: {things[int(place) - 1] for place in places[roles == role]} for role in set(roles) - {0}}
    assert len(found[1.0]) == 1 and name.endswith(found[1.0].pop()), (name, found)
    assert (2.0 in found) == (env_id != "PickSingleYCB-v1") and set(roles[places == 0]) == {0}
    by_role.close(), in_order.close()


@pytest.mark.parametrize("env_id", ["PickSingleYCB-v1", "PickSingleEGAD-v1"])
def test_experts_pick_objects(env_id: str) -> None:
    env = make_vec_env(make, 1, env_kwargs={"env_id": env_id, "obs_mode": "state"})
    found = record_demonstrations(env, 5, seed=0, outcomes=(outcomes := []))
    assert len(outcomes) <= 6 and len({one.instance for one in found}) > 1
    env.close()


# ---------------------------------------------------------------------- start states
@pytest.mark.parametrize("env_id", REPORT_TASKS)
def test_the_same_actions_from_a_stored_state(env_id: str) -> None:
    """Things that slept sleep on: the stand-in of a ball stands on one of its corners, and would roll over if woken."""
    env = make(env_id, obs_mode="state")
    env.reset(seed=3)
    before = [step[0]["state"] for step in play(env, 20)][-1]
    state = env.get_state()
    expected = list(play(env, 20, seed=1))
    env.reset(seed=8)
    again, _ = env.reset(options={"state": state})
    np.testing.assert_allclose(again["state"], before, atol=1e-5)
    for one, other in zip(play(env, 20, seed=1), expected, strict=True):
        np.testing.assert_allclose(one[0]["state"], other[0]["state"], atol=1e-4)  # metres, radians, and per second
        assert one[1] == pytest.approx(other[1], abs=1e-5)
    env.close()


# ---------------------------------------------------------------------- light visuals
@pytest.mark.parametrize(
    "env_id", ["StackCube-v1", "PickSingleYCB-v1", "PickSingleEGAD-v1", "TurnFaucet-v1", "OpenCabinetDrawer-v1"]
)
def test_light_visuals_leave_the_physics_to_the_last_bit(env_id: str) -> None:
    light = make(env_id, obs_mode="state", visuals="light")
    full = make(env_id, obs_mode="state", visuals="full")
    assert triangles(light) < triangles(full) / 5
    assert (light.reset(seed=5)[0]["state"] == full.reset(seed=5)[0]["state"]).all()
    for mine, theirs in zip(*(play(env, STEPS.get(env_id, 50)) for env in (light, full)), strict=True):
        assert mine[1:4] == theirs[1:4] and (mine[0]["state"] == theirs[0]["state"]).all()
        # the whole state of the simulator
        assert torch.equal(*(env.unwrapped.get_state() for env in (light, full)))  # type: ignore
    assert mine[3]  # to the end of the episode
    light.close(), full.close()


@pytest.mark.parametrize("env_id", ["PickSingleYCB-v1", "PickSingleEGAD-v1", "TurnFaucet-v1", "OpenCabinetDoor-v1"])
def test_light_visuals_look_like_the_full_ones(env_id: str) -> None:
    pictures = []
    for visuals in ("light", "full"):
        env = make(env_id, visuals=visuals, image_size=64)
        observation, _ = env.reset(seed=1)
        pictures.append(np.stack([observation[camera] for camera in env.batch.cameras]).astype(float))
        env.close()
    difference = np.abs(pictures[0] - pictures[1]).mean()
    print(f"{env_id}: mean difference {difference:.2f} of 255")
    assert difference < 8
    # the same colours in all, not only on the mean of light and dark
    np.testing.assert_allclose(pictures[0].mean(axis=(0, 1, 2)), pictures[1].mean(axis=(0, 1, 2)), atol=4)


def triangles(env: ManiSkillEnv) -> int:
    """What the renderer of the environment has to draw."""
    bodies = env.unwrapped.scene.sub_scenes[0].render_system.render_bodies  # type: ignore
    shapes = [shape for body in bodies for shape in body.render_shapes]
    return sum(len(part.triangles) for shape in shapes for part in getattr(shape, "parts", []))


# ---------------------------------------------------------------------- ManiSkill 2's definitions
def reward_of(task: Any) -> tuple[float, float, dict[str, Any]]:
    info = task.evaluate()
    return (
        float(task.compute_dense_reward(None, None, info)),
        float(task.compute_normalized_dense_reward(None, None, info)),
        info,
    )


def test_lift_cube_by_hand() -> None:
    from mani_skill.utils.structs.pose import Pose

    env = make("LiftCube-v1", obs_mode="state")
    env.reset(seed=0)
    task: Any = env.unwrapped
    hand, cube = (thing.pose.p[0].numpy() for thing in (task.agent.tcp, task.cube))
    assert cube[2] == pytest.approx(0.02)
    reward, normalized, info = reward_of(task)
    assert reward == pytest.approx(1 - np.tanh(5 * np.linalg.norm(hand - cube)), abs=1e-5)
    assert normalized == pytest.approx(reward / 2.25) and not info["success"]
    # a grasp that the simulator would have to feel: 0.25 and the share of the height
    task.cube.set_pose(Pose.create_from_pq(torch.tensor([[cube[0], cube[1], 0.07]])))
    grasped = {**task.evaluate(), "is_grasped": torch.tensor([True])}
    reaching = 1 - np.tanh(5 * np.linalg.norm(hand - task.cube.pose.p[0].numpy()))
    assert float(task.compute_dense_reward(None, None, grasped)) == pytest.approx(reaching + 0.25 + 0.05 / 0.2, abs=1e-5)
    for height, success in ((0.219, False), (0.221, True)):
        task.cube.set_pose(Pose.create_from_pq(torch.tensor([[cube[0], cube[1], height]])))
        assert bool(task.evaluate()["success"]) is success
    assert reward_of(task)[:2] == (2.25, 1.0)
    env.close()


def test_lift_cube_can_be_solved_and_the_next_episode_starts_without_a_grasp() -> None:
    env = make("LiftCube-v1")
    observation, _ = env.reset(seed=0)
    task: Any = env.unwrapped
    rewards, closed_for = [], 0
    for _ in range(50):
        hand, cube = (thing.pose.p[0].numpy() for thing in (task.agent.tcp, task.cube))
        above = np.linalg.norm(hand[:2] - cube[:2]) > 0.01 and closed_for == 0
        closed_for += closed_for > 0 or np.linalg.norm(hand - cube) < 0.01
        way = cube + np.array([0, 0, 0.08 * above]) - hand if closed_for == 0 else [0, 0, 0.1 * (closed_for > 3)]
        action = [*np.clip(np.divide(way, 0.1), -1, 1), 0, 0, 0, -1 if closed_for else 1]
        observation, reward, terminated, _, info = env.step(np.array(action))
        rewards.append(reward)
        if terminated:
            break
    assert info["is_success"] and info["is_grasped"] and observation["state"][-1] == 1.0 and rewards[-1] == 1.0
    assert rewards[0] < 0.5 and rewards[-2] > 0.99  # lifted, not yet at rest
    observation, info = env.reset(seed=1)
    assert info["is_grasped"] is False and observation["state"][-1] == 0.0
    env.close()


def test_pick_single_egad_by_hand() -> None:
    from mani_skill.utils.structs.pose import Pose

    env = make("PickSingleEGAD-v1", obs_mode="state")
    env.reset(seed=0)
    task: Any = env.unwrapped
    reward, normalized, info = reward_of(task)
    hand, goal, center = (pose.p[0].numpy() for pose in (task.agent.tcp.pose, task.goal_site.pose, task.obj_pose))
    model = task.models[task._objs[0].name.rsplit("-", 1)[0]]
    size = np.linalg.norm(np.subtract(model["bbox"]["max"], model["bbox"]["min"])) * model["scales"][0]
    reaching = 1 - np.tanh(3 * max(np.linalg.norm(hand - center) - size, 0))
    assert reward == pytest.approx(reaching, abs=1e-5) and normalized == pytest.approx(reward / 10)
    assert np.linalg.norm(goal - center) > 0.05
    carrying = 3 + 3 * (1 - np.tanh(3 * np.linalg.norm(goal - center)))
    grasped = {**info, "is_grasped": torch.tensor([True])}
    assert float(task.compute_dense_reward(None, None, grasped)) == pytest.approx(reaching + carrying, abs=1e-5)
    assert not info["success"]
    moved = task.obj.pose.p + torch.as_tensor(goal - center)
    task.obj.set_pose(Pose.create_from_pq(moved, task.obj.pose.q))
    assert reward_of(task)[:2] == (10.0, 1.0)
    env.close()


def test_the_goal_view_of_egad_measures_from_the_centre_of_mass() -> None:
    from mani_skill.utils.structs.pose import Pose

    view = GoalView(make("PickSingleEGAD-v1", obs_mode="state"))
    task: Any = view.unwrapped
    apart = []
    for seed in range(6):  # the object is another one after each reset
        observation, _ = view.reset(seed=seed)
        np.testing.assert_allclose(observation["achieved_goal"], task.obj_pose.p[0], atol=1e-6)
        apart.append(float(torch.linalg.norm(task.obj.pose.p - task.obj_pose.p)))
        for off in (0.024, 0.026):
            goal = task.goal_site.pose.p + torch.tensor([0, 0, off])
            task.obj.set_pose(Pose.create_from_pq(task.obj.pose.p + goal - task.obj_pose.p, task.obj.pose.q))
            places = {key: place.numpy() for key, place in view.get_wrapper_attr("batch").goal.positions(task).items()}
            placed = bool(task.evaluate()["is_obj_placed"])
            assert placed == (off < 0.025) and view.compute_reward(**places)[0] == (0 if placed else -1)
    assert max(apart) > 0.005  # one of them has its origin elsewhere
    view.close()


def test_goals_of_egad_lie_in_manipulation_range_and_off_the_object() -> None:
    env = make("PickSingleEGAD-v1", obs_mode="state")
    task: Any = env.unwrapped
    center = torch.tensor([[0.0, 0.0, 0.02]]).repeat(2000, 1)
    goals = task._draw_goals(center)
    assert (goals.abs() <= torch.tensor([0.15, 0.25, 0.5])).all() and goals[:, 2].min() >= 0.02
    assert torch.linalg.norm(goals - center, dim=1).min() > 0.05 and goals[:, 2].max() == 0.5
    env.close()
    with pytest.raises(ValueError, match="EGAD has no object 'Z9'"):
        make("PickSingleEGAD-v1", model_ids=("Z9",))


def test_turn_faucet_by_hand() -> None:
    import trimesh
    from mani_skill.utils.geometry.trimesh_utils import get_component_meshes, merge_meshes

    env = make("TurnFaucet-v1", obs_mode="state")
    env.reset(seed=0)
    task: Any = env.unwrapped
    low, high = task.target_switch_link.joint.limits.reshape(-1, 2)[0].tolist()
    target = low + 0.9 * (high - low)
    fingers = (task.agent.robot.links_map[f"panda_{side}finger"]._objs[0] for side in ("left", "right"))
    links = [task.target_switch_link._objs[0], *fingers]
    clouds = []
    for link in links:
        points = trimesh.sample.sample_surface(merge_meshes(get_component_meshes(link)), 4000, seed=1)[0]
        clouds.append(trimesh.transform_points(points, link.entity.pose.to_transformation_matrix()))
    distance = min(cdist(clouds[0], finger).min() for finger in clouds[1:])
    assert float(task.finger_distance()) == pytest.approx(distance, abs=0.02)  # 256 points against 4000
    for angle, before in ((0.4, 0.4), (0.5, 0.4), (0.4, 0.5)):
        put_handle(task, angle)
        reaching = 1 - np.tanh(5 * float(task.finger_distance()))
        task._angle_before = torch.tensor([before])
        expected = reaching + 3 * (1 - np.tanh(2 * (target - angle))) + 5 * np.tanh(2 * (angle - before))
        reward, normalized, info = reward_of(task)
        assert reward == pytest.approx(expected, abs=1e-4) and normalized == pytest.approx(reward / 10)
        assert not info["success"]
    put_handle(task, target + 0.01)
    assert reward_of(task)[:2] == (10.0, 1.0)
    # the angle before a step is read when the step begins: a handle that was put somewhere did not turn by itself
    put_handle(task, 0.7)
    task._before_control_step()
    assert float(task._angle_before) == pytest.approx(0.7)
    env.close()


def put_handle(task: Any, angle: float) -> None:
    qpos = task.faucet.get_qpos()
    qpos[0, int(task.target_switch_link.joint.active_index[0])] = angle
    task.faucet.set_qpos(qpos)


def test_the_dense_faucet_is_maniskills_own_seed_by_seed() -> None:
    dense, sparse = (make("TurnFaucet-v1", obs_mode="state", reward_mode=mode) for mode in ("dense", "sparse"))
    assert type(dense.unwrapped).__name__ == "TurnFaucetDenseEnv" and type(sparse.unwrapped).__name__ == "TurnFaucetEnv"
    for seed in range(4):
        left, right = dense.reset(seed=seed)[0]["state"], sparse.reset(seed=seed)[0]["state"]
        np.testing.assert_allclose(left, right, atol=1e-5)
        for mine, theirs in zip(play(dense, 5, seed), play(sparse, 5, seed), strict=True):
            np.testing.assert_allclose(mine[0]["state"], theirs[0]["state"], atol=1e-4)
    dense.close(), sparse.close()
