"""The experts of environments demonstrate, and what is recorded is what training sees; the run after it is a fresh one."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize, VecTransposeImage

import sb3_cpm.envs  # noqa: F401
from sb3_cpm import CheckpointCPMCallback, CPMBuffer, resume
from sb3_cpm.buffers import Demonstration
from sb3_cpm.imitation import DemonstrationsCallback, load_demonstrations, record_demonstrations


def toys(n_envs=2, monitor_dir=None, vec_env_cls=None, **kwargs):
    kwargs = {"keys": ("state",), **kwargs}
    return make_vec_env(
        "sb3_cpm.envs:CPMToy-v0", n_envs, seed=0, env_kwargs=kwargs, monitor_dir=monitor_dir, vec_env_cls=vec_env_cls
    )


def assert_same(ours, others):
    assert len(ours) == len(others)
    for one, other in zip(ours, others, strict=True):
        assert one.observations.keys() == other.observations.keys()
        for key in one.observations:
            np.testing.assert_array_equal(one.observations[key], other.observations[key])
        np.testing.assert_array_equal(one.actions, other.actions)
        np.testing.assert_array_equal(one.rewards, other.rewards)
        assert (one.terminated, one.instance) == (other.terminated, other.instance)


def assert_is_what_happens(demonstration, env):
    """Its actions, from its first observation on, lead to its observations and rewards."""
    env = env.unwrapped
    env._positions[:] = demonstration.observations["state"][0].reshape(-1, 2)
    for step, action in enumerate(demonstration.actions):
        np.testing.assert_allclose(env._observe()["state"], demonstration.observations["state"][step], atol=1e-6)
        observation, reward, *_ = env.step(action)
        assert reward == pytest.approx(demonstration.rewards[step], abs=1e-6)
    np.testing.assert_allclose(observation["state"], demonstration.observations["state"][-1], atol=1e-6)


@pytest.mark.parametrize("task, rate", [("reach", 1.0), ("push", 0.8)])
def test_expert_of_the_toy(task, rate):
    env = gym.make("CPMToy-v0", keys=("state",), task=task).unwrapped
    succeeded = []
    for seed in range(50):
        env.reset(seed=seed)
        for _ in range(50):
            *_, info = env.step(env.expert_action())
        succeeded.append(info["is_success"])
    assert np.mean(succeeded) >= rate


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("terminates", [False, True])
def test_what_is_recorded_is_what_happens(hold, terminates):
    env = toys(2, terminate_on_success=terminates)
    found = record_demonstrations(env, 5, seed=3, hold=hold)
    assert_same(found, record_demonstrations(env, 5, seed=3, hold=hold))
    assert len(found) == 5
    for one in found:
        assert one.terminated == terminates
        assert len(one.rewards) == 50 if hold and not terminates else len(one.rewards) < 30
        assert one.rewards[-1] == 1.0, "the last step succeeds"
        assert (one.rewards[:-1] < 1.0).all() or hold
        assert_is_what_happens(one, gym.make("CPMToy-v0", keys=("state",)))


def test_images_last_observations_and_vecnormalize():
    env = VecTransposeImage(toys(2, keys=("camera", "state")))
    plain = record_demonstrations(env, 3, seed=1, hold=True)
    assert plain[0].observations["camera"].shape == (51, 3, 32, 32)
    normalized = VecNormalize(env, norm_obs_keys=["state"])
    before = normalized.obs_rms["state"].mean.copy(), normalized.ret_rms.count
    assert_same(record_demonstrations(normalized, 3, seed=1, hold=True), plain)
    np.testing.assert_array_equal(normalized.obs_rms["state"].mean, before[0])
    assert normalized.ret_rms.count == before[1]


@pytest.mark.slow
def test_in_worker_processes():
    env = toys(2, vec_env_cls=SubprocVecEnv)
    try:
        assert_same(record_demonstrations(env, 4, seed=3), record_demonstrations(toys(2), 4, seed=3))
    finally:
        env.close()


def test_no_expert_and_bad_arguments():
    env = make_vec_env("Pendulum-v1", 1)
    with pytest.raises(ValueError, match="no expert.*PickCube-v1"):
        record_demonstrations(env, 1)
    with pytest.raises(ValueError, match="wrapper changes the actions"):
        record_demonstrations(
            DummyVecEnv([lambda: gym.wrappers.RescaleAction(gym.make("CPMToy-v0", keys=("state",)), -2.0, 2.0)]), 1
        )
    with pytest.raises(ValueError, match="n_episodes must be an integer of at least 1"):
        record_demonstrations(toys(), 0)
    with pytest.raises(ValueError, match="Say n_episodes"):
        load_demonstrations("expert", toys())
    with pytest.raises(ValueError, match="No demonstrations given"):
        load_demonstrations([], toys())
    with pytest.raises(ValueError, match="got int"):
        load_demonstrations([3], toys())
    env = make_vec_env("CPMToy-v0", 1, env_kwargs=dict(keys=("state",), max_episode_steps=1))
    with pytest.raises(RuntimeError, match=r"succeeded in \d of \d+ episodes.*max_episode_steps"):
        record_demonstrations(env, 5, seed=0)


def test_lists_of_sources():
    env = toys()
    given = record_demonstrations(env, 2, seed=0)
    assert load_demonstrations(given[0], env) == [given[0]]
    assert load_demonstrations(given, env, n_episodes=1) == [given[0]]
    assert len(load_demonstrations([*given, "expert"], env, n_episodes=4, seed=1)) == 4
    with pytest.raises(ValueError, match="3 demonstrations are wanted"):
        load_demonstrations(given, env, n_episodes=3)
    single = gym.make("CPMToy-v0", keys=("state",))
    assert isinstance(load_demonstrations("expert", single, 1)[0], Demonstration)


# ---------------------------------------------------------------------- the callback


class Seen(BaseCallback):
    """What a run does."""

    def __init__(self):
        super().__init__()
        self.observations = []

    def _on_step(self):
        self.observations.append({key: value.copy() for key, value in self.locals["new_obs"].items()})
        return True


def sac(env, **kwargs):
    return SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=CPMBuffer,
        replay_buffer_kwargs={"challenge_ratio": 0, "demonstration_ratio": 0.5, "mix": "row", **kwargs},
        learning_starts=1000,
        policy_kwargs={"net_arch": [8]},
        device="cpu",
        seed=4,
    )


def learned(callbacks, tmp_path, normalize, name):
    """:return: model, what it saw, the lines that Monitor wrote"""
    env = toys(2, monitor_dir=str(tmp_path / name))
    model = sac(VecNormalize(env, norm_reward=False) if normalize else env)
    seen = Seen()
    model.learn(120, callback=[*callbacks, seen])
    env.close()
    lines = (tmp_path / name / "0.monitor.csv").read_text().splitlines()[2:]
    return model, seen.observations, [line.rpartition(",")[0] for line in lines]


@pytest.mark.parametrize("normalize", [False, True])
def test_callback_leaves_a_fresh_run(normalize, tmp_path):
    model, seen, rows = learned([DemonstrationsCallback("expert", n_episodes=6)], tmp_path, normalize, "with")
    bare, alone, rows_alone = learned([], tmp_path, normalize, "without")
    assert len(model.replay_buffer.demonstrations.episodes) == 6
    for one, other in zip(seen, alone, strict=True):
        np.testing.assert_array_equal(one["state"], other["state"])
    np.testing.assert_array_equal(model.replay_buffer.observations["state"], bare.replay_buffer.observations["state"])
    assert rows == rows_alone and rows, "Monitor writes down training only"
    monitor = model.get_env().unwrapped.envs[0]
    assert monitor.get_wrapper_attr("total_steps") == 60 and len(monitor.get_wrapper_attr("episode_returns")) == 1


def test_resumed_run_does_not_record_twice(tmp_path):
    model = sac(toys(2))
    callback = DemonstrationsCallback("expert", n_episodes=3)
    model.learn(100, callback=[callback, CheckpointCPMCallback(50, tmp_path)])
    again, _ = resume(tmp_path, toys(2))
    stored = again.replay_buffer.demonstrations.observations["state"].copy()
    again.learn(20, callback=DemonstrationsCallback("expert", n_episodes=9), reset_num_timesteps=False)
    assert len(again.replay_buffer.demonstrations.episodes) == 3
    np.testing.assert_array_equal(again.replay_buffer.demonstrations.observations["state"], stored)


def test_callback_on_wrong_models():
    model = SAC("MultiInputPolicy", toys(), replay_buffer_class=DictReplayBuffer, learning_starts=1000)
    with pytest.raises(ValueError, match="has DictReplayBuffer: make it with replay_buffer_class=CPMBuffer"):
        model.learn(2, callback=DemonstrationsCallback(n_episodes=1))
    with pytest.raises(ValueError, match="PPO has no replay buffer"):
        PPO("MultiInputPolicy", toys(), n_steps=8, batch_size=8).learn(2, callback=DemonstrationsCallback(n_episodes=1))
    with pytest.warns(UserWarning, match="demonstration_ratio=0"):
        sac(toys(), demonstration_ratio=0).learn(2, callback=DemonstrationsCallback(n_episodes=1))
    with pytest.raises(ValueError, match="Did you mean 'n_episodes'"):
        DemonstrationsCallback(n_episode=3)
