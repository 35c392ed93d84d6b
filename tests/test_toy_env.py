"""The toy environment and the wrapper for Box observations."""

import time

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_checker import check_env

from sb3_cpm.envs.toy import KEYS, ToyEnv
from sb3_cpm.envs.wrappers import DictObservation


@pytest.mark.filterwarnings("ignore:The minimal resolution for an image", "ignore:Your observation pointcloud")
@pytest.mark.parametrize("task", ["reach", "push"])
def test_obeys_gymnasium(task: str) -> None:
    check_env(ToyEnv(task=task))


@pytest.mark.parametrize("keys", [("state",), ("camera", "pointcloud"), KEYS])
def test_keys_are_switched(keys: tuple[str, ...]) -> None:
    env = gym.make("CPMToy-v0", keys=keys)
    observation, _ = env.reset(seed=0)
    assert set(observation) == set(keys)
    assert env.observation_space.contains(observation)


def test_walking_to_the_goal_succeeds_and_pays() -> None:
    env = gym.make("CPMToy-v0", keys=("state",))
    observation, _ = env.reset(seed=1)
    rewards = []
    for _ in range(50):
        robot, goal = observation["state"][:2], observation["state"][2:4]
        observation, reward, terminated, truncated, info = env.step(np.clip((goal - robot) / 0.1, -1, 1).astype(np.float32))
        rewards.append(reward)
    assert info["is_success"]
    assert rewards[-1] == 1.0
    assert all(0 <= reward <= 1 for reward in rewards)
    assert truncated
    assert not terminated


def test_terminates_on_success_when_asked() -> None:
    env = ToyEnv(keys=("state",), terminate_on_success=True)
    observation, _ = env.reset(seed=1)
    n_steps, terminated = 0, False
    while not terminated and n_steps < 50:
        robot, goal = observation["state"][:2], observation["state"][2:4]
        observation, _, terminated, _, info = env.step(np.clip((goal - robot) / 0.1, -1, 1))
        n_steps += 1
    assert terminated and info["is_success"]
    assert n_steps < 40


def test_puck_is_pushed_and_never_overlaps() -> None:
    env = ToyEnv(keys=("state",), task="push")
    env.reset(seed=0)
    env._positions[:] = [[-0.3, 0.0], [0.8, 0.0], [0.0, 0.0]]
    for _ in range(6):
        observation, _, _, _, _ = env.step(np.array([1.0, 0.0]))
    robot, puck = observation["state"][:2], observation["state"][4:]
    assert puck == pytest.approx([0.54, 0.0], abs=1e-6)  # robot at 0.3, and two radii of 0.12 between the centres
    assert np.hypot(*(puck - robot)) == pytest.approx(0.24, abs=1e-6)


def test_image_and_cloud_show_the_state() -> None:
    env = ToyEnv()
    observation, _ = env.reset(seed=3)
    blue = (observation["camera"] == [40, 90, 200]).all(-1)
    rows, columns = np.nonzero(blue)
    seen = np.array([(columns.mean() + 0.5) / 32 * 2.2 - 1.1, 1.1 - (rows.mean() + 0.5) / 32 * 2.2])
    assert seen == pytest.approx(observation["state"][:2], abs=0.05)
    robot_points = observation["pointcloud"][0::2]
    assert robot_points[:, :2].mean(0) == pytest.approx(observation["state"][:2], abs=0.06)


def test_same_seed_same_episode() -> None:
    first, second = ToyEnv(), ToyEnv()
    for key, value in first.reset(seed=5)[0].items():
        assert np.array_equal(value, second.reset(seed=5)[0][key])


def test_is_fast() -> None:
    env = gym.make("CPMToy-v0")
    env.reset(seed=0)
    start = time.process_time()
    for _ in range(1000):
        env.step(np.zeros(2, dtype=np.float32))
    assert 1000 / (time.process_time() - start) > 2000  # about 16000 on an idle core


@pytest.mark.parametrize("kwargs", [{"keys": ("camera", "depth")}, {"keys": ()}, {"task": "fly"}])
def test_wrong_arguments(kwargs: dict) -> None:
    with pytest.raises(ValueError, match="expected"):
        ToyEnv(**kwargs)


def test_dict_observation() -> None:
    env = DictObservation(gym.make("Pendulum-v1"))
    observation, _ = env.reset(seed=0)
    assert isinstance(env.observation_space, spaces.Dict)
    assert env.observation_space.contains(observation)
    observation, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    with pytest.raises(ValueError, match="needs no wrapper"):
        DictObservation(env)
