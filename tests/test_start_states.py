"""Starting an episode from a stored state, in the real simulation: the same actions, the same trajectory."""

import pickle
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecMonitor

from sb3_cpm.envs import ManiSkillEnv, make_maniskill_env, make_maniskill_vec_env

pytestmark = pytest.mark.maniskill

STATE, REWARD = 1e-4, 1e-5
"""The stated tolerances: the simulator's contact solver starts cold, so the last digits differ. Positions are in metres."""

CONTROLLERS = ("pd_ee_delta_pose", "pd_ee_target_delta_pose")
Step = tuple[np.ndarray, float, bool, bool, dict[str, Any]]


def make(control_mode: str, **kwargs: Any) -> ManiSkillEnv:
    return make_maniskill_env("PickCube-v1", obs_mode="state", control_mode=control_mode, **kwargs)


def random_actions(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (n, 7)).astype(np.float32)


def assert_same(one: Step, other: Step) -> None:
    np.testing.assert_allclose(one[0]["state"], other[0]["state"], atol=STATE)  # type: ignore[call-overload]
    assert one[1] == pytest.approx(other[1], abs=REWARD)
    assert one[2:4] == other[2:4]
    assert one[4]["elapsed_steps"] == other[4]["elapsed_steps"]


@pytest.fixture(params=CONTROLLERS)
def env(request: pytest.FixtureRequest) -> Iterator[ManiSkillEnv]:
    env = make(request.param)
    yield env
    env.close()


def test_the_rest_of_an_episode_again(env: ManiSkillEnv) -> None:
    actions = random_actions(50)
    first, _ = env.reset(seed=5)
    middle = [env.step(action)[0] for action in actions[:20]][-1]
    state = env.get_state()
    assert len(pickle.dumps(state)) < 4000
    rest: list[Any] = [env.step(action) for action in actions[20:]]
    # elsewhere in the meantime
    env.reset(seed=6)
    env.step(actions[0])
    again, info = env.reset(options={"state": state})
    assert info["elapsed_steps"] == 20
    np.testing.assert_allclose(again["state"], middle["state"], atol=STATE)
    for action, expected in zip(actions[20:], rest, strict=True):
        assert_same(env.step(action), expected)  # type: ignore[arg-type]
    assert rest[-1][3]  # truncated 50 steps after the true beginning
    # and in a fresh environment, which never saw that episode
    other = make(env.unwrapped.control_mode)  # type: ignore[attr-defined]
    other.reset(options={"state": pickle.loads(pickle.dumps(state))})
    for action, expected in zip(actions[20:], rest, strict=True):
        assert_same(other.step(action), expected)  # type: ignore[arg-type]
    other.close()
    # a stored state starts one episode, and disturbs none of the others
    np.testing.assert_array_equal(env.reset(seed=5)[0]["state"], first["state"])
    following = env.reset()[0]["state"]
    env.reset(seed=5)
    env.reset(options={"state": state})
    np.testing.assert_array_equal(env.reset()[0]["state"], following)


def test_a_grasp_is_restored() -> None:
    """Until the next step the simulator does not know what the gripper feels."""
    env = make("pd_ee_delta_pose")
    env.reset(seed=1)
    task: Any = env.unwrapped
    observation: Any = None
    info: dict[str, Any] = {"is_grasped": False}
    closed = False
    for _ in range(20):
        hand, cube = (thing.pose.p[0].numpy() for thing in (task.agent.tcp, task.cube))
        closed = closed or bool(np.linalg.norm(hand - cube) < 0.01)
        target = cube + np.array([0, 0, 0.08]) * (np.linalg.norm(hand[:2] - cube[:2]) > 0.01)
        move = np.zeros(3) if closed else np.clip((target - hand) / 0.1, -1, 1)
        observation, *_, info = env.step(np.array([*move, 0, 0, 0, -1 if closed else 1]))
        if info["is_grasped"]:
            break
    assert info["is_grasped"]
    state = env.get_state()
    assert env.reset(seed=2)[1]["is_grasped"] is False
    restored, info = env.reset(options={"state": state})
    np.testing.assert_allclose(restored["state"], observation["state"], atol=STATE)
    assert info["is_grasped"] is True
    env.close()


def test_pictures_and_clouds_too() -> None:
    """The random choice of points is that of the episode and the step, not that of the environment's past."""
    env = make_maniskill_env("PickCube-v1", n_points=64)
    env.reset(seed=3)
    for action in random_actions(5):
        seen = env.step(action)[0]
    state = env.get_state()
    env.reset(seed=4)
    again, _ = env.reset(options={"state": state})
    np.testing.assert_allclose(again["pointcloud"], seen["pointcloud"], atol=0.01)
    for camera in ("base_camera", "hand_camera"):
        assert np.abs(again[camera].astype(int) - seen[camera]).mean() < 1
    env.close()


def test_what_sleeps_sleeps_on_and_what_is_awake_is_awake() -> None:
    env = make("pd_ee_delta_pose")
    cube = env.unwrapped.cube._bodies[0]  # type: ignore[attr-defined]
    env.reset(seed=3)
    early = env.get_state()
    for _ in range(30):
        observation = env.step(np.zeros(7))[0]
    late = env.get_state()
    assert early["asleep"] == () and late["asleep"] == ("cube",)
    env.reset(options={"state": early})
    assert not cube.is_sleeping
    again, _ = env.reset(options={"state": late})
    assert cube.is_sleeping
    np.testing.assert_array_equal(again["state"], observation["state"])
    env.close()


def test_tasks_that_build_a_scene_per_episode() -> None:
    """The geometry is not in the state but follows from the seed, which is."""
    env = make_maniskill_env("PegInsertionSide-v1", obs_mode="state")
    env.reset(seed=8)
    action = random_actions(1)[0]
    state, expected = env.get_state(), env.step(action)
    env.reset(seed=9)
    env.reset(options={"state": state})
    assert_same(env.step(action), expected)  # type: ignore[arg-type]
    env.close()


def test_states_travel_between_worker_processes() -> None:
    env = VecMonitor(SubprocVecEnv([partial(make, CONTROLLERS[1], max_episode_steps=12)] * 2))
    env.seed(0)
    env.reset()
    actions = random_actions(40).reshape(20, 2, 7)
    for action in actions[:6]:
        env.step(action)
    states = env.env_method("get_state")
    rest = [env.step(action) for action in actions[6:12]]
    assert rest[-1][2].all()
    # both go on elsewhere: the workers swap their states, by options ...
    env.set_options([{"state": states[1]}, {"state": states[0]}])
    env.reset()
    for action, expected in zip(actions[6:12], rest, strict=True):
        # ... and before the episode ends, for the next one
        env.env_method("start_next_from", states[0], indices=[1])
        observations, rewards, dones, _ = env.step(action[::-1])
        assert dones.tolist() == expected[2].tolist()
        np.testing.assert_allclose(rewards[::-1], expected[1], atol=REWARD)
        if not dones.any():
            np.testing.assert_allclose(observations["state"][::-1], expected[0]["state"], atol=STATE)  # type: ignore
    for action, expected in zip(actions[6:10], rest, strict=False):
        observations, rewards, *_ = env.step(action[::-1])
        assert rewards[1] == pytest.approx(expected[1][0], abs=REWARD)
    env.close()


def test_through_wrappers_and_our_own_vec_env() -> None:
    env = Monitor(make(CONTROLLERS[0]))
    env.reset(seed=1)
    for action in random_actions(7):
        env.step(action)
    state = env.get_wrapper_attr("get_state")()
    expected = env.step(np.zeros(7))
    batched = make_maniskill_vec_env("PickCube-v1", obs_mode="state")
    batched.set_options([{"state": state}])
    batched.reset()
    observations, rewards, _, _ = batched.step(np.zeros((1, 7)))
    assert isinstance(observations, dict)
    np.testing.assert_allclose(observations["state"][0], expected[0]["state"], atol=STATE)
    assert rewards[0] == pytest.approx(expected[1], abs=REWARD)
    with pytest.raises(ValueError, match="of PickCube-v1, it cannot start an episode of PushCube-v1"):
        make_maniskill_env("PushCube-v1", obs_mode="state").reset(options={"state": state})
    with pytest.raises(ValueError, match="what get_state"):
        env.reset(options={"state": "somewhere"})
    env.close(), batched.close()
