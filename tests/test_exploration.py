"""Who acts, how often, and what is stored: the exploration wrapper and the decay models."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0)
from sb3_cpm.buffers import EXECUTED_ACTION
from sb3_cpm.challenger import Challenger
from sb3_cpm.envs.wrappers import DictObservation
from sb3_cpm.exploration import ExplorationVecEnv, make_decay
from sb3_cpm.world_model.correlated_noise import CorrelatedNoise

TINY = dict(batch_size=2, sequence_length=8, cnn_depth=4, vector_units=16, stoch_size=4, deter_size=8, hidden_size=16)
NAMES = ["constant", "linear", "exponential", "inverse_time", "cosine", "logistic"]


@pytest.mark.parametrize("name", NAMES)
def test_decays_fall_gently_from_start_towards_a_floor_above_zero(name):
    decay = make_decay(name, start=0.9, floor=0.1)
    values = np.array([decay(remaining) for remaining in np.linspace(1, 0, 101)])
    assert (np.diff(values) <= 1e-12).all()
    assert values[0] == pytest.approx(0.9, abs=0.01)
    assert (values >= 0.1).all()
    if name == "constant":
        assert (values == 0.9).all()
    else:
        assert values[-1] < 0.25


def test_decays_by_hand():
    assert make_decay("linear", 1.0, 0.2)(0.5) == pytest.approx(0.6)
    assert make_decay("exponential", 1.0, 0.0, rate=2.0)(0.5) == pytest.approx(np.exp(-1))
    assert make_decay("inverse_time", 1.0, 0.0, rate=4.0)(0.5) == pytest.approx(1 / 3)
    assert make_decay("cosine", 1.0, 0.0)(0.5) == pytest.approx(0.5)
    assert make_decay("logistic", 1.0, 0.0)(0.5) == pytest.approx(0.5)
    assert make_decay(lambda remaining: 0.3 * remaining)(0.5) == pytest.approx(0.15)


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(decay="expo"),
        dict(start=1.2),
        dict(floor=-0.1),
        dict(start=0.1, floor=0.2),
        dict(rate=0.0),
        dict(rate="fast"),
        dict(decay=["linear"]),
        dict(decay=lambda remaining: 2.0 * remaining),
        dict(decay=lambda remaining: float("nan")),
        dict(decay=lambda remaining: None),
    ],
)
def test_bad_decays(kwargs):
    with pytest.raises(ValueError):
        make_decay(**kwargs)


def make_wrapper(epsilon=0.5, n_envs=2, unit="step", env_id="Pendulum-v1", keys=None, **kwargs):
    def make():
        return DictObservation(gym.make(env_id)) if env_id == "Pendulum-v1" else gym.make(env_id)

    venv = DummyVecEnv([make] * n_envs)
    th.manual_seed(0)
    np.random.seed(0)
    venv.seed(0)
    challenger = Challenger(venv.observation_space, venv.action_space, device="cpu", keys=keys, **TINY)
    challenger.trained_updates = 1  # as if it had learned something
    wrapper = ExplorationVecEnv(venv, challenger, lambda: epsilon, venv.reset(), unit, **kwargs)
    wrapper.active = True
    return wrapper


class RecordsActions(gym.ActionWrapper):
    """Remembers what really reached the environment."""

    def action(self, action):
        self.last_action = np.array(action)
        return action


@pytest.mark.parametrize("unit", ["step", "segment", "episode"])
def test_the_exploration_share_is_epsilon(unit):
    wrapper = make_wrapper(epsilon=0.3, n_envs=3, unit=unit, env_id="CPMToy-v0", keys=["state"], segment_length=5)
    who = []
    for _ in range(1500):
        wrapper.step(np.zeros((3, 2), dtype=np.float32))
        who.append(wrapper._explores.copy())
    who = np.array(who)
    error = {"step": 0.02, "segment": 0.05, "episode": 0.15}[unit]
    assert who.mean() == pytest.approx(0.3, abs=error)
    assert wrapper.n_explored / wrapper.n_actions == who.mean()
    length = {"step": 1, "segment": 5, "episode": 50}[unit]
    blocks = who.reshape(-1, length, 3)
    assert (blocks == blocks[:, :1]).all(), "within a unit it is always the same one who acts"
    assert not (blocks[1:, 0] == blocks[:-1, 0]).all()


def test_what_is_reported_is_what_was_executed_in_the_environments_units():
    def make():
        return RecordsActions(DictObservation(gym.make("Pendulum-v1")))  # actions within [-2, 2]

    venv = DummyVecEnv([make] * 2)
    challenger = Challenger(venv.observation_space, venv.action_space, device="cpu", **TINY)
    challenger.trained_updates = 1
    wrapper = ExplorationVecEnv(venv, challenger, lambda: 0.5, venv.reset())
    wrapper.active = True
    explored = 0
    for _ in range(100):
        asked = np.random.uniform(-2, 2, (2, 1)).astype(np.float32)
        _, _, _, infos = wrapper.step(asked)
        for env_idx, info in enumerate(infos):
            executed = venv.envs[env_idx].last_action
            if EXECUTED_ACTION in info:
                explored += 1
                np.testing.assert_allclose(2 * info[EXECUTED_ACTION], executed, atol=1e-6)
                assert not np.allclose(executed, asked[env_idx])
            else:
                np.testing.assert_array_equal(executed, asked[env_idx])
    assert explored == wrapper.n_explored > 0


def test_the_latent_state_that_follows_lazily_equals_the_one_that_follows_every_step():
    """Rarely acting must not change what C believes: with modes instead of samples both ways agree."""
    wrapper = make_wrapper(epsilon=0.15, n_envs=2, env_id="CPMToy-v0", keys=["state", "camera"])
    follow = wrapper.challenger.follow
    wrapper.challenger.follow = lambda *args: follow(*args, deterministic=True)
    eager = wrapper.challenger.initial_state(2)
    wrapper.MAX_PENDING = 20
    obs = {key: array.copy() for key, array in wrapper.venv.buf_obs.items()}
    action, is_first = np.zeros((2, 2), np.float32), np.ones(2, bool)
    for step in range(120):
        rows = {key: obs[key][None] for key in wrapper.challenger.keys}
        eager = follow(eager, rows, action[None], is_first[None], deterministic=True)
        if step % 7 == 0:  # sometimes one of them catches up in between
            wrapper._catch_up(np.flatnonzero(wrapper._explores))
        obs, _, is_first, _ = wrapper.step(np.random.uniform(-1, 1, (2, 2)).astype(np.float32))
        action = wrapper._executed.copy()
    eager = follow(
        eager, {key: obs[key][None] for key in wrapper.challenger.keys}, action[None], is_first[None], deterministic=True
    )
    wrapper._catch_up(np.arange(2))
    for lazy, expected in zip(wrapper._latent, eager, strict=True):
        th.testing.assert_close(lazy, expected, rtol=1e-4, atol=1e-5)


def test_an_untrained_challenger_acts_uniformly():
    wrapper = make_wrapper(epsilon=1.0, n_envs=1)
    wrapper.challenger.trained_updates = 0
    actions = []
    for _ in range(400):
        _, _, _, infos = wrapper.step(np.zeros((1, 1), dtype=np.float32))
        actions.append(infos[0][EXECUTED_ACTION][0])
    histogram, _ = np.histogram(actions, bins=4, range=(-1, 1))
    assert histogram.min() > 60


def test_inactive_it_only_passes_through():
    wrapper = make_wrapper(epsilon=1.0)
    wrapper.active = False
    _, _, _, infos = wrapper.step(np.zeros((2, 1), dtype=np.float32))
    assert all(EXECUTED_ACTION not in info for info in infos) and wrapper.n_actions == 0


def test_c_sees_observations_as_they_were_before_vecnormalize():
    venv = VecNormalize(DummyVecEnv([lambda: DictObservation(gym.make("Pendulum-v1"))]), norm_obs_keys=["state"])
    challenger = Challenger(venv.observation_space, venv.action_space, device="cpu", **TINY)
    venv.reset()
    wrapper = ExplorationVecEnv(venv, challenger, lambda: 0.0, venv.get_original_obs())
    wrapper.active = True
    for _ in range(10):
        wrapper.step(np.ones((1, 1), dtype=np.float32))
        np.testing.assert_array_equal(wrapper._pending[0][-1].observation["state"], venv.get_original_obs()["state"][0])


class PlainValues(gym.ObservationWrapper):
    """Observations that are no arrays. SB3 makes arrays of them, except of the last one of an episode."""

    def __init__(self, env):
        super().__init__(env)
        extra = {"mode": spaces.Discrete(3), "list": spaces.Box(-1, 1, (2,), np.float32)}
        self.observation_space = spaces.Dict({**env.observation_space.spaces, **extra})

    def observation(self, observation):
        return {**observation, "mode": 2, "list": [0.0, self.value]}

    value = 0.5


def test_last_observations_of_plain_numbers_and_lists():
    venv = DummyVecEnv([lambda: PlainValues(gym.make("CPMToy-v0", keys=("state",), max_episode_steps=3))])
    challenger = Challenger(venv.observation_space, venv.action_space, device="cpu", keys=["state"], **TINY)
    wrapper = ExplorationVecEnv(venv, challenger, lambda: 0.5, venv.reset())
    wrapper.active = True
    assert [wrapper.step(np.zeros((1, 2), dtype=np.float32))[2][0] for _ in range(3)] == [False, False, True]
    venv.envs[0].value = float("nan")
    with pytest.raises(ValueError, match="NaN or infinite values in observation 'list' at step 4"):
        wrapper.step(np.zeros((1, 2), dtype=np.float32))


class Broken(gym.Wrapper):
    """Misbehaves in one way from step ``at`` on."""

    def __init__(self, env, how, at=3):
        super().__init__(env)
        self.how, self.at, self.n = how, at, 0

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.n += 1
        if self.n >= self.at:
            if self.how == "reward":
                reward = float("nan")
            elif self.how == "observation":
                obs["state"] = np.full_like(obs["state"], np.inf)
            elif self.how == "last observation":
                obs["state"], truncated = np.full_like(obs["state"], np.nan), True
            else:
                raise {"dies": ConnectionResetError, "raises": ZeroDivisionError}[self.how]
        return obs, reward, terminated, truncated, info


@pytest.mark.parametrize(
    "how, error, message",
    [
        ("reward", ValueError, "Environment 1 gave a reward of nan at step 3"),
        ("observation", ValueError, "Environment 1 gave NaN or infinite values in observation 'state' at step 3"),
        ("last observation", ValueError, "Environment 1 gave NaN or infinite values in observation 'state' at step 3"),
        ("dies", RuntimeError, "died at step 3 .*save_replay_buffer"),
        ("raises", ZeroDivisionError, None),
    ],
)
def test_environments_that_misbehave(how, error, message):
    venv = DummyVecEnv([lambda: gym.make("CPMToy-v0"), lambda: Broken(gym.make("CPMToy-v0"), how)])
    challenger = Challenger(venv.observation_space, venv.action_space, device="cpu", keys=["state"], **TINY)
    taken_off = []
    wrapper = ExplorationVecEnv(venv, challenger, lambda: 0.5, venv.reset(), on_failure=lambda: taken_off.append(True))
    wrapper.active = True
    for _ in range(2):
        wrapper.step(np.zeros((2, 2), dtype=np.float32))
    with pytest.raises(error, match=message):
        wrapper.step(np.zeros((2, 2), dtype=np.float32))
    assert taken_off == [True]


# ---------------------------------------------------------------- noise that perseveres


def draws(noise, steps, envs=(0,)):
    return np.array([noise.draw(np.array(envs)).numpy() for _ in range(steps)])


@pytest.mark.parametrize("memory, expected", [(0.0, 0.0), (5.0, np.exp(-1 / 5)), (20.0, np.exp(-1 / 20))])
def test_noise_is_standard_normal_and_correlated_over_its_memory(memory, expected):
    th.manual_seed(0)
    numbers = draws(CorrelatedNoise(memory, 2, th.device("cpu")), 4000, envs=range(8))
    assert numbers.mean() == pytest.approx(0.0, abs=0.06) and numbers.std() == pytest.approx(1.0, abs=0.04)
    assert np.corrcoef(numbers[:-1].ravel(), numbers[1:].ravel())[0, 1] == pytest.approx(expected, abs=0.02)
    assert abs(np.corrcoef(numbers[:, 0, 0], numbers[:, 1, 0])[0, 1]) < 0.15, "environments have noise of their own"


def test_noise_begins_anew_with_an_episode_and_waits_while_others_act():
    th.manual_seed(0)
    noise = CorrelatedNoise(1e6, 1, th.device("cpu"))
    first, second = (noise.draw(np.array([env])).item() for env in (0, 3))
    assert noise.draw(np.array([0])).item() == pytest.approx(first, abs=0.02), "with such a memory it hardly moves"
    noise.restart(np.array([0]))
    assert abs(noise.draw(np.array([0])).item() - first) > 0.05
    assert noise.draw(np.array([3])).item() == pytest.approx(second, abs=0.02)


def test_what_noise_makes_of_a_policy_is_that_policy():
    """Each action has the actor's distribution; only what follows on it is correlated."""
    challenger = Challenger(spaces.Dict({"state": spaces.Box(-1, 1, (4,))}), spaces.Box(-1, 1, (2,)), "cpu", **TINY)
    state = challenger.initial_state(4000)
    th.manual_seed(0)
    white = challenger.act(state)
    coloured = challenger.act(state, noise=CorrelatedNoise(10.0, 2, th.device("cpu")).draw(np.arange(4000)))
    assert np.abs(coloured).max() <= 1.0
    assert np.allclose(np.quantile(coloured, [0.1, 0.5, 0.9], 0), np.quantile(white, [0.1, 0.5, 0.9], 0), atol=0.06)


@pytest.mark.parametrize("memory, wanted", [(0.0, (-0.2, 0.2)), (50.0, (0.8, 1.0))])
def test_the_challengers_actions_in_a_run_persevere(memory, wanted):
    wrapper = make_wrapper(epsilon=1.0, n_envs=1, env_id="CPMToy-v0", keys=["state"])
    wrapper._noise = CorrelatedNoise(memory, 2, th.device("cpu"))
    actions = []
    for _ in range(300):
        _, _, _, infos = wrapper.step(np.zeros((1, 2), dtype=np.float32))
        actions.append(infos[0][EXECUTED_ACTION])
    correlation = np.corrcoef(np.ravel(actions[:-1]), np.ravel(actions[1:]))[0, 1]
    assert wanted[0] <= correlation <= wanted[1]
