"""make_maniskill_env against the real simulator and the real renderer, on PickCube-v1 unless said otherwise."""

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_cpm.envs import ManiSkillEnv, make_maniskill_env
from sb3_cpm.envs.maniskill.observations import to_host
from sb3_cpm.player import max_episode_steps

CAMERAS = ("base_camera", "hand_camera")


# ---------------------------------------------------------------------- requests that cannot be fulfilled
@pytest.mark.maniskill
@pytest.mark.parametrize(
    ("env_id", "kwargs", "message"),
    [
        ("PickCub-v1", {}, "Did you mean PickCube-v1"),
        ("PickCube-v1", {"control_mode": "pd_ee_delta_pos_"}, "Did you mean pd_ee_delta_pos"),
        ("PickCube-v1", {"control_mode": "pd_ee_delta_pos_"}, "pd_joint_delta_pos"),
        ("PickCube-v1", {"robot_uids": "pandas"}, "Did you mean panda"),
        ("PickCube-v1", {"reward_mode": "dens"}, "it has: normalized_dense, dense, sparse, none"),
        ("StackPyramid-v1", {}, "it has: none, sparse"),
        ("PickCube-v1", {"obs_mode": "rgbd"}, "expected one of visual, state"),
        ("PickCube-v1", {"obs_mode": "state", "imagesize": 64}, "takes no argument 'imagesize'. Did you mean 'image_size'"),
        ("PickCube-v1", {"obs_mode": "state", "robot_uid": "panda"}, "Did you mean 'robot_uids'"),
        ("PickCube-v1", {"obs_mode": "state", "reconfiguration_frek": 1}, "Did you mean 'reconfiguration_freq'"),
        ("PickCube-v1", {"obs_mode": "state", "sensor_configs": {}}, "sensor_configs is set by image_size, leave it out"),
        ("PickCube-v1", {"visuals": "heavy"}, "one of auto, light, full"),
        ("PickCube-v1", {"image_size": 0}, "image_size"),
        ("PickCube-v1", {"image_size": (32, 32, 3)}, "image_size"),
        ("PickCube-v1", {"image_size": 32.5}, "image_size"),
        ("PickCube-v1", {"n_points": -1}, "n_points"),
        ("PickCube-v1", {"goal_points": 1.5}, "goal_points"),
        ("PickCube-v1", {"max_distance": 0.0}, "max_distance"),
        ("PickCube-v1", {"max_episode_steps": 0}, "max_episode_steps"),
        ("PickCube-v1", {"render_mode": "human"}, "render_mode"),
        ("PickCube-v1", {"render_size": 0}, "render_size"),
        ("PickCube-v1", {"cameras": ["front"]}, "base_camera, hand_camera"),
        ("PickCube-v1", {"cameras": "front"}, "Unknown camera 'front'"),
        ("PickCube-v1", {"num_envs": 4}, "make_maniskill_vec_env"),
        ("PickCube-v1", {"sim_backend": "physx_cuda"}, "make_maniskill_vec_env"),
    ],
)
def test_bad_requests_are_value_errors_with_the_cure(env_id: str, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_maniskill_env(env_id, **kwargs)


@pytest.mark.maniskill
def test_an_action_of_a_wrong_size_and_cameras_by_name() -> None:
    env = make_maniskill_env("PickCube-v1", cameras="hand_camera", image_size=16)
    assert env.batch.cameras == ("hand_camera",)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions of shape \(7,\), got \(6,\)"):
        env.step(np.zeros(6))
    env.close()


MISSING_ASSETS = """
from sb3_cpm.envs import make_maniskill_env
for env_id, mode in (("PickSingleYCB-v1", "dense"), ("TurnFaucet-v1", "sparse"), ("OpenCabinetDoor-v1", "dense")):
    try:
        make_maniskill_env(env_id, reward_mode=mode)
    except RuntimeError as error:
        assert f"python -m sb3_cpm assets --download {env_id}" in str(error), error
        print("refused", env_id)
"""


@pytest.mark.maniskill
@pytest.mark.parametrize("leftover", [False, True], ids=["nothing", "empty-folder"])
def test_missing_assets_never_prompt(tmp_path: Path, leftover: bool) -> None:
    if leftover:  # of a download that failed; ManiSkill believes it
        (tmp_path / "data/assets/mani_skill2_ycb").mkdir(parents=True)
    environment = {**os.environ, "MS_ASSET_DIR": str(tmp_path)}
    # an open stdin that says nothing: a prompt would wait for ever
    command = [sys.executable, "-W", "ignore", "-c", MISSING_ASSETS]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert child.stdout is not None
        output = child.stdout.read()
        assert child.wait(timeout=600) == 0
    finally:
        child.kill()
        child.communicate()
    assert output.count("refused") == 3


# ---------------------------------------------------------------------- one environment for the tests below
@pytest.fixture(scope="module")
def env() -> Iterator[ManiSkillEnv]:
    env = make_maniskill_env("PickCube-v1")
    yield env
    env.close()


def rollout(env: gym.Env, seed: int, n_steps: int = 4) -> list[Any]:
    """Observations, rewards and ends after reset(seed) and actions that depend on the seed only."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (n_steps, 7)).astype(np.float32)
    return [env.reset(seed=seed)[0], *(env.step(action)[:4] for action in actions)]


def assert_equal(left: Any, right: Any) -> None:
    if isinstance(left, dict):
        assert left.keys() == right.keys()
        left, right = list(left.values()), list(right.values())
    if isinstance(left, (list, tuple)):
        for a, b in zip(left, right, strict=True):
            assert_equal(a, b)
    else:
        np.testing.assert_array_equal(left, right)


@pytest.mark.maniskill
def test_spaces(env: ManiSkillEnv) -> None:
    shapes = {key: (space.shape, str(space.dtype)) for key, space in env.observation_space.spaces.items()}  # type: ignore
    assert shapes == {
        "base_camera": ((32, 32, 3), "uint8"),
        "hand_camera": ((32, 32, 3), "uint8"),
        "pointcloud": ((306, 6), "float32"),
        "state": ((29,), "float32"),
    }
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (7,), np.float32)
    assert env.spec is not None and env.spec.max_episode_steps == 50


@pytest.mark.maniskill
@pytest.mark.filterwarnings("ignore::UserWarning")  # that the environment is a wrapper, that a cloud is no image
def test_checkers_of_gymnasium_and_sb3(env: ManiSkillEnv) -> None:
    check_gymnasium_env(env, skip_render_check=True, skip_close_check=True)
    check_env(env)


@pytest.mark.maniskill
def test_same_seed_same_episodes_in_another_environment(env: ManiSkillEnv) -> None:
    other = make_maniskill_env("PickCube-v1")
    assert_equal(rollout(env, 7), rollout(other, 7))
    # what follows without a seed is ruled by the last seed, and by no global generator
    np.random.seed(1)
    mine = env.reset()[0]
    np.random.seed(2)
    assert_equal(mine, other.reset()[0])
    with pytest.raises(AssertionError):
        assert_equal(mine, rollout(env, 8)[0])
    other.close()


@pytest.mark.maniskill
def test_resets_leave_the_random_numbers_of_the_agent_alone(env: ManiSkillEnv) -> None:
    import torch

    before = torch.random.get_rng_state()
    env.reset()
    env.step(env.action_space.sample())
    assert torch.equal(before, torch.random.get_rng_state())


@pytest.mark.maniskill
def test_one_render_per_step(env: ManiSkillEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    from mani_skill.sensors.camera import Camera

    pictures: list[str] = []
    capture = Camera.capture
    monkeypatch.setattr(Camera, "capture", lambda camera: (pictures.append(camera.config.uid), capture(camera)))
    scene = env.unwrapped.scene  # type: ignore
    update, updates = scene.update_render, []
    monkeypatch.setattr(scene, "update_render", lambda *a, **k: (updates.append(1), update(*a, **k)))
    env.reset(seed=0)
    pictures.clear(), updates.clear()
    for _ in range(3):
        env.step(np.zeros(7))
    assert sorted(pictures) == sorted(CAMERAS * 3)
    assert len(updates) == 3


@pytest.mark.maniskill
def test_unwanted_cameras_are_not_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    from mani_skill.sensors.camera import Camera

    env = make_maniskill_env("PickCube-v1", cameras=["hand_camera"], n_points=0, image_size=(24, 40), max_episode_steps=3)
    pictures: list[str] = []
    capture = Camera.capture
    monkeypatch.setattr(Camera, "capture", lambda camera: (pictures.append(camera.config.uid), capture(camera)))
    observation, _ = env.reset(seed=0)
    assert pictures == ["hand_camera"]
    assert observation.keys() == {"hand_camera", "state"}
    assert observation["hand_camera"].shape == (24, 40, 3)
    assert env.spec is not None and env.spec.max_episode_steps == 3
    env.close()


@pytest.mark.maniskill
def test_observations_are_copies(env: ManiSkillEnv) -> None:
    first, _ = env.reset(seed=0)
    kept = pickle.loads(pickle.dumps(first))
    for _ in range(3):
        env.step(np.ones(7))
    assert_equal(first, kept)


@pytest.mark.maniskill
def test_state_does_not_know_where_the_cube_is(env: ManiSkillEnv) -> None:
    from mani_skill.utils.structs.pose import Pose

    task: Any = env.unwrapped
    before, _ = env.reset(seed=3)
    place = task.cube.pose.p[0].numpy().copy()
    elsewhere = place + np.array([0.0, 0.1, 0.0])  # on the table, still in the picture
    task.cube.set_pose(Pose.create_from_pq(elsewhere, [1.0, 0, 0, 0]))
    host = to_host(env.batch._select(task.get_obs()))
    after = {key: value[0] for key, value in env.batch._observe(host, np.arange(1), np.zeros(1)).items()}
    np.testing.assert_array_equal(before["state"], after["state"])
    assert (before["base_camera"] != after["base_camera"]).any()
    # nor is it hidden in some sum of numbers: no entry equals a coordinate of the cube
    assert not np.isclose(before["state"][:, None], place[:2], atol=1e-5).any()


@pytest.mark.maniskill
def test_cloud_shows_cube_and_goal_but_no_table(env: ManiSkillEnv) -> None:
    task: Any = env.unwrapped
    observation, _ = env.reset(seed=3)
    scene, goal = observation["pointcloud"][:256], observation["pointcloud"][256:]
    np.testing.assert_allclose(goal[:, :3].mean(0), task.goal_site.pose.p[0], atol=2e-3)
    np.testing.assert_allclose(observation["state"][25:28], task.goal_site.pose.p[0])
    red = scene[(scene[:, 3] > 0.3) & (scene[:, 4] < 0.1) & (scene[:, 5] < 0.1)]
    assert len(red) > 0
    # a cube of 4 cm: every red point lies within half its diagonal
    assert (np.linalg.norm(red[:, :3] - task.cube.pose.p[0].numpy(), axis=1) < 0.02 * 3**0.5 + 0.002).all()
    # the robot stands at x = -0.6; the ground is a metre below and reaches for many metres
    assert (np.abs(scene[:, :3]) < 1.5).all() and (scene[:, 2] > -0.1).all()
    assert ((observation["pointcloud"][:, 3:] >= 0) & (observation["pointcloud"][:, 3:] <= 1)).all()


@pytest.mark.maniskill
def test_rendering_for_people_does_not_change_what_the_agent_sees(env: ManiSkillEnv) -> None:
    plain = rollout(env, 5)
    env.reset(seed=5)
    frame = env.render()
    assert frame is not None and frame.shape == (256, 256, 3) and frame.dtype == np.uint8 and frame.std() > 20
    action = np.random.default_rng(5).uniform(-1, 1, (4, 7)).astype(np.float32)[0]
    assert_equal(env.step(action)[:4], plain[1])


# ---------------------------------------------------------------------- ends of episodes
def grasp_and_carry(env: ManiSkillEnv, n_steps: int = 40) -> Iterator[tuple[Any, ...]]:
    """A scripted controller that knows where the cube is: above it, down, close the fingers, to the goal."""
    task: Any = env.unwrapped
    closed_for = 0
    for _ in range(n_steps):
        hand, cube, goal = (thing.pose.p[0].numpy() for thing in (task.agent.tcp, task.cube, task.goal_site))
        beside = np.linalg.norm(hand[:2] - cube[:2]) > 0.01
        target = cube + np.array([0, 0, 0.08]) if beside and closed_for == 0 else cube
        if closed_for or np.linalg.norm(hand - cube) < 0.01:
            closed_for += 1
            target = hand if closed_for < 3 else goal
        arm = np.clip((target - hand) / 0.1, -1, 1)
        yield env.step(np.array([*arm, 0, 0, 0, -1 if closed_for else 1]))


@pytest.mark.maniskill
def test_success_terminates_and_the_next_episode_starts_without_a_grasp(env: ManiSkillEnv) -> None:
    env.reset(seed=1)
    for observation, reward, terminated, truncated, info in grasp_and_carry(env):
        assert type(reward) is float and type(terminated) is type(truncated) is bool
        assert info["is_success"] is info["success"] is terminated
        assert observation["state"][-1] == info["is_grasped"]
        if terminated:
            break
    assert terminated and not truncated and reward == 1.0 and info["is_grasped"] is True
    # ManiSkill itself still reports the grasp of the last episode here
    observation, info = env.reset(seed=2)
    assert observation["state"][-1] == 0.0 and info["is_grasped"] is False and info["is_success"] is False


@pytest.mark.maniskill
def test_time_limit_truncates() -> None:
    env = make_maniskill_env("PickCube-v1", obs_mode="state", max_episode_steps=4)
    for _ in range(2):
        env.reset(seed=0)
        ends = [env.step(np.zeros(7))[2:4] for _ in range(4)]
        assert ends == [(False, False)] * 3 + [(False, True)]
    env.close()


@pytest.mark.maniskill
def test_terminations_can_be_ignored() -> None:
    env = make_maniskill_env("PickCube-v1", obs_mode="state", ignore_terminations=True)
    env.reset(seed=1)
    ends = [(terminated, truncated, info["is_success"]) for *_, terminated, truncated, info in grasp_and_carry(env, 50)]
    assert not any(terminated for terminated, _, _ in ends)
    assert any(success for _, _, success in ends)
    assert [truncated for _, truncated, _ in ends] == [False] * 49 + [True]
    env.close()


@pytest.mark.maniskill
def test_sparse_rewards_are_floats() -> None:
    env = make_maniskill_env("PickCube-v1", obs_mode="state", reward_mode="sparse", control_mode="pd_joint_delta_pos")
    env.reset(seed=0)
    assert env.action_space.shape == (8,)
    assert type(env.step(np.zeros(8))[1]) is float
    env.close()


# ---------------------------------------------------------------------- other modes, tasks, vector environments
@pytest.mark.maniskill
def test_state_mode_is_privileged_and_the_same_with_light_visuals() -> None:
    from mani_skill.agents.robots import PandaWristCam

    original = PandaWristCam.urdf_path
    light = make_maniskill_env("PickCube-v1", obs_mode="state", visuals="light")
    full = make_maniskill_env("PickCube-v1", obs_mode="state", visuals="full")
    assert original == PandaWristCam.urdf_path  # nothing stays changed
    rng = np.random.default_rng(0)
    for seed in range(2):
        assert_equal(light.reset(seed=seed)[0], full.reset(seed=seed)[0])
        for action in rng.uniform(-1, 1, (50, 7)):
            mine, theirs = light.step(action), full.step(action)
            assert_equal(mine[:4], theirs[:4])
            # the whole state of the simulator, to the last bit
            assert_equal(light.unwrapped.get_state().numpy(), full.unwrapped.get_state().numpy())  # type: ignore
    task: Any = light.unwrapped
    assert np.isin(task.cube.pose.p[0].numpy(), mine[0]["state"]).all()
    light.close(), full.close()


@pytest.mark.maniskill
def test_light_visuals_look_like_the_full_ones(env: ManiSkillEnv) -> None:
    full = make_maniskill_env("PickCube-v1", visuals="full")
    light_view, full_view = env.reset(seed=4)[0], full.reset(seed=4)[0]
    for camera in CAMERAS:
        difference = np.abs(light_view[camera].astype(float) - full_view[camera])
        assert difference.mean() < 5, camera  # of 255
    np.testing.assert_array_equal(light_view["state"], full_view["state"])
    full.close()


@pytest.mark.maniskill
def test_a_task_without_goal_and_with_a_new_scene_every_episode() -> None:
    env = make_maniskill_env("PegInsertionSide-v1", image_size=16, n_points=64)
    first, _ = env.reset(seed=0)
    assert first["pointcloud"].shape == (64, 6)  # it shows no goal
    env.reset(seed=1)
    env.step(np.zeros(7))
    assert_equal(first, env.reset(seed=0)[0])
    env.close()


@pytest.mark.slow
@pytest.mark.maniskill
def test_vector_environments_agree(env: ManiSkillEnv) -> None:
    factory = partial(make_maniskill_env, "PickCube-v1")
    pickle.loads(pickle.dumps(factory))
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 2, 7)).astype(np.float32)
    seen = []
    for kind in (DummyVecEnv, SubprocVecEnv):
        vec_env = kind([factory, factory])
        assert max_episode_steps(vec_env) == 50
        vec_env.seed(10)
        frames = [vec_env.reset(), *(vec_env.step(action)[:2] for action in actions)]
        seen.append(frames)
        vec_env.close()
    assert_equal(*seen)
    # seeds 10 and 11, as anybody would get them alone
    alone = env.reset(seed=11)[0]
    assert_equal({key: value[1] for key, value in seen[0][0].items()}, alone)
