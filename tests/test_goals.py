"""Tasks as goal environments: what they show, what hindsight may know, and that it trains."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_checker import check_env
from test_vec_env import SMALL, fake, inner, quietly

import sb3_cpm.zoo  # noqa: F401  (registers CPM/...)
from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.envs import make_maniskill_env
from sb3_cpm.envs.maniskill.goals import Goal, GoalVecEnv, GoalView

FAKE_GOAL = Goal("thing", "aim", 0.1, axes=2)


def make(**kwargs: Any) -> GoalView:
    return GoalView(make_maniskill_env("PickCube-v1", obs_mode="state", max_episode_steps=6), **kwargs)


@pytest.fixture(scope="module")
def env() -> Iterator[GoalView]:
    env = make()
    yield env
    env.close()


@pytest.mark.maniskill
def test_what_a_goal_environment_shows(env: GoalView) -> None:
    observation, _ = env.reset(seed=1)
    task: Any = env.unwrapped
    np.testing.assert_array_equal(observation["achieved_goal"], task.cube.pose.p[0])
    np.testing.assert_array_equal(observation["desired_goal"], task.goal_site.pose.p[0])
    assert env.observation_space.contains(observation)
    # the true goal is nowhere else, not even as a difference
    task.goal_site.set_pose(task.goal_site.pose * th_pose([0.05, 0, 0]))
    raw, _, _, _, _ = env.step(np.zeros(7))
    moved = raw["observation"]
    env.reset(seed=1)
    np.testing.assert_array_equal(env.step(np.zeros(7))[0]["observation"], moved)
    assert moved.shape == (18 + 7 + 1 + 7 + 3,)  # joints, hand, grasp, object's pose, hand to object


def th_pose(p: list[float]) -> Any:
    from mani_skill.utils.structs.pose import Pose

    return Pose.create_from_pq(p)


@pytest.mark.maniskill
def test_rewards_are_those_of_compute_reward(env: GoalView) -> None:
    env.reset(seed=1)
    task: Any = env.unwrapped
    observation, reward, terminated, _, info = env.step(np.zeros(7))
    assert (reward, info["goal_reached"]) == (-1.0, False)
    task.cube.set_pose(task.goal_site.pose)
    observation, reward, terminated, _, info = env.step(np.array([0] * 6 + [1.0]))
    assert reward == env.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)
    assert info["goal_reached"] == (reward == 0)
    assert not terminated and [env.step(np.zeros(7))[2:4] for _ in range(4)][-1] == (False, True)
    # vectorised, as hindsight asks
    achieved, desired = np.zeros((3, 3)), np.array([[0, 0, 0], [0, 0, 0.0249], [0.1, 0, 0]])
    np.testing.assert_array_equal(env.compute_reward(achieved, desired, [{}] * 3), [0, 0, -1])
    dense = GoalView(env.env, reward="dense")
    np.testing.assert_allclose(dense.compute_reward(achieved, desired), [0, -0.0249, -0.1])


@pytest.mark.maniskill
def test_a_task_made_by_its_registered_id_keeps_its_name(env: GoalView) -> None:
    """``gym.make`` writes the id it was asked for over ManiSkill's; goals and start states go by the task's own."""
    view = GoalView(gym.make("CPM/PickCubeState-v1", max_episode_steps=6))
    view.reset(seed=3)
    state = view.get_wrapper_attr("get_state")()
    assert state["env_id"] == "PickCube-v1"
    observation, _ = env.reset(options={"state": state})
    np.testing.assert_allclose(observation["achieved_goal"], state_position(view), atol=1e-5)
    view.close()


def state_position(view: GoalView) -> np.ndarray:
    task: Any = view.unwrapped
    return task.cube.pose.p[0].numpy()


@pytest.mark.maniskill
def test_a_stack_is_what_the_task_calls_one() -> None:
    view = GoalView(make_maniskill_env("StackCube-v1", obs_mode="state", max_episode_steps=50))
    view.reset(seed=1)
    task: Any = view.unwrapped
    # metres beside and above the right place; cubes of 4 cm
    off = [(0, 0), (0.033, 0), (0.034, 0), (0.05, 0), (0, 0.004), (0, 0.006), (0, -0.006), (0, 0.015), (0.03, 0.004)]
    truth, achieved, desired = [], [], []
    for beside, above in off:
        task.cubeA.set_pose(th_pose((task.cubeB.pose.p[0] + th.tensor([beside, 0, 0.04 + above])).tolist()))
        places = view.get_wrapper_attr("batch").goal.positions(task)
        truth.append(bool(task.evaluate()["is_cubeA_on_cubeB"]))
        achieved.append(places["achieved_goal"][0].numpy())
        desired.append(places["desired_goal"][0].numpy())
    assert truth == [True, True, False, False, True, False, False, False, True]
    np.testing.assert_array_equal(view.compute_reward(np.array(achieved), np.array(desired)), np.where(truth, 0, -1))
    # a step says the same
    for beside, reached in ((0.025, True), (0.05, False)):
        task.cubeA.set_pose(th_pose((task.cubeB.pose.p[0] + th.tensor([beside, 0, 0.04])).tolist()))
        observation, reward, _, _, info = view.step(np.zeros(7))
        places = observation["achieved_goal"], observation["desired_goal"]
        assert info["is_cubeA_on_cubeB"] == reached == info["goal_reached"]
        assert reward == view.compute_reward(*places) == (0 if reached else -1)
        task.cubeA.set_pose(th_pose((task.cubeB.pose.p[0] + th.tensor([0.2, 0, 0])).tolist()))
    view.close()


@pytest.mark.maniskill
def test_nothing_is_shown_as_seen_from_the_goal() -> None:
    """The lower cube stays, as the thing that it is; where hand and upper cube are from there is only in ``desired_goal``."""
    view = GoalView(make_maniskill_env("StackCube-v1", obs_mode="state"))
    observation, _ = view.reset(seed=1)
    layout = view.get_wrapper_attr("batch").state_layout
    told = {"tcp_to_cubeB_pos", "cubeA_to_cubeB_pos"}
    assert told < layout.keys() and observation["observation"].shape == (48 - 6,)
    task: Any = view.unwrapped
    for other in (task.agent.tcp, task.cubeA):
        difference = (task.cubeB.pose.p - other.pose.p)[0].numpy()
        assert not any(np.allclose(observation["observation"][i : i + 3], difference, atol=1e-5) for i in range(40))
    np.testing.assert_allclose(observation["observation"][32:35], task.cubeB.pose.p[0])
    with pytest.raises(ValueError, match="hides 'cubeC_pose', which is no part of this state. It has: agent/qpos"):
        GoalView(view.env, Goal("cubeA", "cubeB", 0.02, hidden=("cubeC_pose",)))
    with pytest.raises(ValueError, match=r"height=0.01\) needs axes=3, got axes=2"):
        GoalView(view.env, Goal("cubeA", "cubeB", 0.02, axes=2, height=0.01))
    view.close()


@pytest.mark.maniskill
def test_checker_of_sb3(env: GoalView) -> None:
    with quietly():
        check_env(env)


@pytest.mark.maniskill
def test_views_that_cannot_be() -> None:
    cloudy = make_maniskill_env("PickCube-v1")
    with pytest.raises(ValueError, match="goal_points=0"):
        GoalView(cloudy)
    with pytest.raises(ValueError, match="sparse, dense, got 'shaped'"):
        make(reward="shaped")
    with pytest.raises(ValueError, match="made by make_maniskill_env"):
        GoalVecEnv(SimpleNamespace())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Fake-v1 is no task of bringing"):
        GoalVecEnv(fake())
    cloudy.close()
    seeing = GoalView(make_maniskill_env("PickCube-v1", goal_points=0, n_points=32))
    observation, _ = seeing.reset()
    assert observation["pointcloud"].shape == (32, 6) and observation["observation"].shape == (26,)
    seeing.close()


@pytest.mark.maniskill
@pytest.mark.parametrize("buffer", [HerReplayBuffer, CPMBuffer])
def test_hindsight_trains(env: GoalView, buffer: Any) -> None:
    kwargs: dict[str, Any] = {"n_sampled_goal": 4, "goal_selection_strategy": "future"}
    if buffer is CPMBuffer:
        kwargs["challenge_ratio"] = 0  # episodes have six steps, too few for challenges
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=buffer,
        replay_buffer_kwargs=kwargs,
        buffer_size=200,
        learning_starts=12,
        batch_size=16,
        policy_kwargs={**SMALL},
        device="cpu",
    )
    callback = ChallengerCallback(preset=TINY, train_freq=10) if buffer is CPMBuffer else None
    model.learn(60, callback=callback)
    replayed: Any = model.replay_buffer
    batch = replayed.sample(64, env=model._vec_normalize_env)
    rewards = batch.rewards.numpy().ravel()
    # most episodes never reach their goal, but hindsight's goals are reached
    assert set(rewards) == {-1.0, 0.0}
    reached = np.linalg.norm(batch.next_observations["achieved_goal"] - batch.observations["desired_goal"], axis=1) <= 0.025
    real = rewards == np.where(reached, 0, -1)
    assert real.mean() > (0.99 if buffer is HerReplayBuffer else 0.7)


TINY: dict[str, Any] = {"batch_size": 2, "sequence_length": 5}


def test_a_thing_may_be_a_pose() -> None:
    task = SimpleNamespace(
        thing=SimpleNamespace(pose=SimpleNamespace(p=th.zeros(1, 3))),
        center=SimpleNamespace(p=th.tensor([[0.03, 0.0, 0.0]])),
        aim=SimpleNamespace(p=th.ones(1, 3)),
    )
    places = Goal("center", "aim", 0.1).positions(task)
    assert places["achieved_goal"].tolist() == [[pytest.approx(0.03), 0, 0]] and places["desired_goal"].tolist() == [[1, 1, 1]]
    assert Goal("thing", "aim", 0.1).positions(task)["achieved_goal"].tolist() == [[0, 0, 0]]


def test_a_goal_may_be_narrower_in_height() -> None:
    goal = Goal("thing", "aim", 0.1, height=0.01)
    achieved = np.array([[[0.06, 0.06, 0], [0.08, 0.08, 0]], [[0.06, 0.06, 0.02], [0.0, 0.0, -0.009]]], dtype=np.float32)
    assert goal.reached(achieved, np.zeros(3)).tolist() == [[True, False], [False, True]]
    assert goal._replace(height=None).reached(achieved, np.zeros(3)).tolist() == [[True, False], [True, True]]


# ---------------------------------------------------------------------- several environments in one simulation
def goal_batch(num_envs: int = 3) -> GoalVecEnv:
    env = fake(num_envs, limit=4, n_points=0)
    task: Any = inner(env)
    thing, aim = (SimpleNamespace(pose=SimpleNamespace(p=None)) for _ in range(2))
    task.thing, task.aim = thing, aim
    observe = task.get_obs

    def get_obs(info: dict[str, Any]) -> dict[str, Any]:
        thing.pose.p, aim.pose.p = th.cat([task.place, task.place[:, :1]], dim=1), task.goal
        return observe(info)

    task.get_obs = get_obs
    return GoalVecEnv(env, FAKE_GOAL)


def test_a_batch_of_goal_environments() -> None:
    env = goal_batch()
    first = env.reset()
    assert isinstance(first, dict) and first["observation"].shape == (3, 10)
    total = np.zeros(3)
    for _ in range(4):
        observations, rewards, dones, infos = env.step(np.ones((3, 2), dtype=np.float32))
        total += rewards
    assert dones.all() and isinstance(observations, dict)
    for i, info in enumerate(infos):
        last = info["terminal_observation"]
        assert info["episode"]["r"] == total[i]
        assert rewards[i] == env.env_method("compute_reward", last["achieved_goal"], last["desired_goal"], {}, indices=[0])[0]
        assert (last["achieved_goal"] != observations["achieved_goal"][i]).any() and last["observation"].shape == (10,)


def test_hindsight_trains_on_a_batch() -> None:
    model = SAC(
        "MultiInputPolicy",
        goal_batch(),
        replay_buffer_class=HerReplayBuffer,
        learning_starts=15,
        batch_size=16,
        policy_kwargs={**SMALL},
        device="cpu",
    )
    model.learn(60)
