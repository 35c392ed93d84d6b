"""Last observations beside VecNormalize are the environment's own, and others who use the environment are noticed."""

import gymnasium as gym
import numpy as np
import pytest
from challenger_helpers import SMALL
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize, VecTransposeImage

from sb3_cpm import ChallengerCallback, CPMBuffer, PointNetExtractor
from sb3_cpm.dreamer import Dreamer

LENGTH = 10


class Counter(gym.Env):
    """Counts its steps, in integers, in floats that end far out, and in the pixels of an image."""

    def __init__(self, keys=("count", "state")):
        parts = {
            "count": spaces.Box(0, 1000, (2,), np.int32),
            "state": spaces.Box(-np.inf, np.inf, (1,), np.float32),
            "image": spaces.Box(0, 255, (16, 16, 3), np.uint8),
        }
        self.observation_space = spaces.Dict({key: parts[key] for key in keys})
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)

    def look(self):
        image = np.full((16, 16, 3), self.t, np.uint8)
        image[:, :, 1] = 100
        values = {
            "count": np.array([self.t, 7 * self.t], np.int32),
            "state": np.array([1000.0 if self.t == LENGTH else 0.1 * np.sin(self.t)], np.float32),
            "image": image,
        }
        return {key: values[key] for key in self.observation_space.spaces}

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.look(), {}

    def step(self, action):
        self.t += 1
        return self.look(), float(self.t), False, self.t == LENGTH, {}


class Box(gym.ObservationWrapper):
    """One far value at the end, as a Box."""

    def __init__(self):
        super().__init__(Counter(["state"]))
        self.observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def observation(self, observation):
        return observation["state"]


def sac(env, callbacks=(), n_steps=45, learning_starts=40, reset=True, model=None):
    model = model or SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=CPMBuffer,
        learning_starts=learning_starts,
        buffer_size=1000,
        policy_kwargs=dict(net_arch=[8], features_extractor_class=PointNetExtractor),
        device="cpu",
        seed=0,
    )
    model.learn(n_steps, callback=[ChallengerCallback(SMALL), *callbacks], reset_num_timesteps=reset)
    return model


def dreamer(env, callbacks=(), n_steps=45):
    policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
    model = Dreamer(policy, env, preset=SMALL, buffer_size=1000, learning_starts=40, device="cpu", seed=0)
    model.learn(n_steps, callback=list(callbacks))
    return model


def transitions(model):
    """Observation, next observation and reward of every transition of complete episodes, by their counts."""
    buffer = model.replay_buffer
    for episode in buffer.episodes:
        for slot in episode.slots(buffer.buffer_size):
            at = (slot, episode.env_idx)
            yield (
                int(buffer.observations["count"][at][0]),
                int(buffer.next_observations["count"][at][0]),
                float(buffer.rewards[at]),
            )


def last_observations(model, key):
    buffer = model.replay_buffer
    return [buffer.episode_observations(episode)[key][-1] for episode in buffer.episodes]


# ---- the last observation -------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
@pytest.mark.parametrize(
    "learn, n_envs, vec_env_class",
    [(sac, 1, DummyVecEnv), (sac, 2, SubprocVecEnv), (dreamer, 1, DummyVecEnv), (dreamer, 2, DummyVecEnv)],
)
def test_d_holds_the_last_observations_that_the_environment_gave(learn, n_envs, vec_env_class):
    env = VecNormalize(vec_env_class([Counter] * n_envs))
    model = learn(env)
    ends = last_observations(model, "count")
    assert len(ends) >= 4 and all(end.tolist() == [LENGTH, 7 * LENGTH] for end in ends)
    assert [float(end[0]) for end in last_observations(model, "state")] == [1000.0] * len(ends)
    env.close()


def test_they_are_those_of_the_environment_where_it_is_a_box():
    model = dreamer(VecNormalize(DummyVecEnv([Box])))
    assert {float(end[0]) for end in last_observations(model, "state")} == {1000.0}


def test_images_beside_vec_normalize():
    """SB3 would put its VecTransposeImage outside; VecNormalize then gives original images that nobody has transposed."""
    inside = VecTransposeImage(DummyVecEnv([lambda: Counter(["image", "state"])]))
    model = sac(VecNormalize(inside, norm_obs_keys=["state"]))
    ends = last_observations(model, "image")
    assert all(end.shape == (3, 16, 16) and (end[0] == LENGTH).all() and (end[1] == 100).all() for end in ends)
    with pytest.raises(ValueError, match=r"VecNormalize\(VecTransposeImage\(env\)\)"):
        sac(VecNormalize(DummyVecEnv([lambda: Counter(["image", "state"])]), norm_obs_keys=["state"]))


def test_infinite_values_that_vec_normalize_would_hide():
    class Falls(Counter):
        def look(self):
            values = super().look()
            return {**values, "state": np.float32([np.inf])} if self.t == LENGTH else values

    with pytest.raises(ValueError, match="'state'"):
        sac(VecNormalize(DummyVecEnv([Falls])))


# ---- others who use the environment ---------------------------------------------------------------------------------


class At(BaseCallback):
    """Does something in the training environment after a step."""

    def __init__(self, number, what):
        super().__init__()
        self.number, self.what = number, what

    def _on_step(self):
        if self.n_calls == self.number:
            self.what(self.model, self.training_env)
        return True


def evaluates(model, env):
    evaluate_policy(model, env, n_eval_episodes=1, warn=False)


def resets(model, env):
    env.reset()


def steps(model, env):
    env.step(np.zeros((env.num_envs, 1), np.float32))


@pytest.mark.parametrize("learn", [sac, dreamer])
@pytest.mark.parametrize("what", [evaluates, resets, steps])
@pytest.mark.parametrize("normalized", [False, True])
def test_running_episodes_end_where_somebody_else_uses_the_environment(learn, what, normalized):
    env = DummyVecEnv([Counter, Counter])
    model = learn(VecNormalize(env) if normalized else env, [At(13, what)], n_steps=96)
    lengths = [episode.length for episode in model.replay_buffer.episodes]
    assert lengths == 2 * [LENGTH, 3, LENGTH, LENGTH, LENGTH]  # of each environment
    assert all(after == before + 1 == reward for before, after, reward in transitions(model))


def test_an_evaluation_between_two_portions_of_learning():
    env = DummyVecEnv([Counter])
    model = sac(env, n_steps=45)
    callback = ChallengerCallback(SMALL, decay="constant")
    for portion in range(3):
        model.learn(16, callback=callback, reset_num_timesteps=False)
        if portion == 1:
            evaluates(model, model.get_env())
    assert all(after == before + 1 == reward for before, after, reward in transitions(model))
    lengths = [episode.length for episode in model.replay_buffer.episodes]
    assert lengths == [LENGTH] * 7 + [7, LENGTH]  # 45 + 16 + 16 steps, then 16 from a new beginning


def test_using_another_environment_changes_nothing():
    env = DummyVecEnv([Counter])
    model = sac(env, [At(13, lambda model, env: evaluates(model, DummyVecEnv([Counter])))])
    assert [episode.length for episode in model.replay_buffer.episodes] == [LENGTH] * 4


def test_dreamer_between_two_portions_and_saved(tmp_path):
    model = dreamer(DummyVecEnv([Counter]))
    evaluates(model, model.get_env())
    model.learn(20, reset_num_timesteps=False)
    assert [episode.length for episode in model.replay_buffer.episodes] == [LENGTH] * 4 + [5, LENGTH, LENGTH]
    model.save(tmp_path / "model")
    assert Dreamer.load(tmp_path / "model", DummyVecEnv([Counter]), device="cpu").learn(12).num_timesteps >= 12
