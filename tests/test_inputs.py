"""Whatever comes in has its right value, or an error that says what came, what was expected, and the cure."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cpm import ChallengerCallback, CPMBuffer, PointNetExtractor, PointNetPolicy
from sb3_cpm import __main__ as cli
from sb3_cpm.challenger import Challenger
from sb3_cpm.envs import DictObservation
from sb3_cpm.envs.suites import register_suite
from sb3_cpm.extras import MissingExtra, check_installed, install_command, needed
from sb3_cpm.machine import rendering
from sb3_cpm.presets import make_preset
from sb3_cpm.world_model.observations import ObservationSpec
from sb3_cpm.zoo import __main__ as zoo_cli
from sb3_cpm.zoo.wrappers import TerminationIsSuccess, as_dict

STATE = spaces.Dict(state=spaces.Box(-1, 1, (2,), np.float32))
ACTIONS = spaces.Box(-1, 1, (1,), np.float32)


def make_buffer(space=STATE, actions=ACTIONS, n_envs=1, **kwargs):
    return CPMBuffer(60, space, actions, device="cpu", n_envs=n_envs, **{"challenge_ratio": 0, **kwargs})


def add(buffer, n=1, **changes):
    """A transition of zeros, with changes."""
    n = buffer.n_envs
    obs = {key: np.zeros((n, *space.shape), space.dtype) for key, space in buffer.observation_space.items()}
    given = dict(
        obs=obs,
        next_obs=obs,
        action=np.zeros((n, *buffer.action_space.shape), np.float32),
        reward=np.zeros(n),
        done=np.ones(n, bool),
        infos=[{}] * n,
    )
    buffer.add(**{**given, **changes})
    return buffer


# ---- rewards of compute_reward ---------------------------------------------------------------------------------------


class Line(gym.Env):
    """A goal environment whose rewards are computed by a function of achieved and desired goal."""

    def __init__(self, function):
        box = spaces.Box(-50, 50, (1,), np.float32)
        self.observation_space = spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)
        self.action_space, self.function = ACTIONS, function

    def compute_reward(self, achieved, desired, info):
        return self.function(achieved, desired)

    def reset(self, seed=None, options=None):
        return {key: np.zeros(1, np.float32) for key in self.observation_space.spaces}, {}


def sampled(function):
    env = DummyVecEnv([lambda: Line(function)])
    buffer = make_buffer(env.observation_space, n_sampled_goal=4, env=env)
    for number in range(20):
        there = {key: np.full((1, 1), number + 1, np.float32) for key in env.observation_space.spaces}
        here = {key: np.full((1, 1), number, np.float32) for key in env.observation_space.spaces}
        add(buffer, obs=here, next_obs=there, done=np.array([number == 19]))
    return buffer.sample(50)  # 40 of them in hindsight


def distance(achieved, desired):
    return np.linalg.norm(achieved - desired, axis=-1)


@pytest.mark.parametrize(
    "function, message",
    [
        (lambda a, d: -np.linalg.norm(a - d), r"shape \(\) for a batch of 40 .*one reward per row, shape \(40,\).*axis=-1"),
        (lambda a, d: -distance(a, d)[:7], r"shape \(7,\) for a batch of 40"),
        (lambda a, d: (a - d) * np.ones(3), r"shape \(40, 3\)"),
        (lambda a, d: -distance(a, d[:, None]), r"shape \(40, 40\)"),
        (lambda a, d: np.nan * distance(a, d), "nan for 40 of 40 .*must be finite"),
        (lambda a, d: np.log(np.zeros(len(a))), "-inf for 40 of 40 .*must be finite"),
        (lambda a, d: None, "must return 40 numbers .* got None"),
        (lambda a, d: ["far"] * len(a), "must return 40 numbers"),
        (lambda a, d: 0.0 if distance(a, d) < 0.5 else -1.0, r"failed for a batch of 40 .*np.where\(...\) instead of if"),
        (lambda a, d: a["x"], r"failed for a batch of 40 .*arrays of shape \(40, goal size\)"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_rewards_in_hindsight_that_cannot_be(function, message):
    with pytest.raises(ValueError, match=message):
        sampled(function)


@pytest.mark.parametrize("function", [distance, lambda a, d: distance(a, d)[:, None], lambda a, d: distance(a, d).tolist()])
def test_rewards_in_hindsight(function):
    batch = sampled(function)
    goals, reached = batch.observations["desired_goal"], batch.next_observations["achieved_goal"]
    assert (batch.rewards[:40] == (goals - reached)[:40].abs()).all() and batch.rewards[:40].max() > 0


def test_hindsight_without_compute_reward():
    class Without(Line):
        compute_reward = property()

    env = DummyVecEnv([lambda: Without(distance)])
    buffer = add(make_buffer(env.observation_space, n_sampled_goal=4, env=env))
    with pytest.raises(ValueError, match="environment has no compute_reward.*or use n_sampled_goal=0"):
        buffer.sample(10)


# ---- what is added by hand -------------------------------------------------------------------------------------------

PARTS = spaces.Dict(
    image=spaces.Box(0, 255, (3, 8, 6), np.uint8),
    matrix=spaces.Box(-1, 1, (2, 3), np.float32),
    kind=spaces.Discrete(5),
    count=spaces.Box(0, 100, (2,), np.int16),
)


@pytest.mark.parametrize(
    "n_envs, key, value, message",
    [
        (1, "image", np.zeros((1, 8, 6, 3), np.uint8), r"shape \(1, 8, 6, 3\), expected \(1, 3, 8, 6\).*transpose\(2, 0, 1\)"),
        (2, "image", np.zeros((2, 8, 6, 3), np.uint8), "channels come last"),
        (1, "image", np.zeros((1, 6, 8, 3), np.uint8), r"expected \(1, 3, 8, 6\)"),
        (1, "image", np.zeros((3, 8, 6), np.uint8), r"lacks the first dimension, the 1 environment: observation\[None\]"),
        (2, "matrix", np.zeros((2, 3, 2), np.float32), r"shape \(2, 3, 2\), expected \(2, 2, 3\)"),
        (1, "matrix", np.zeros((1, 6), np.float32), r"shape \(1, 6\), expected \(1, 2, 3\)"),
        (3, "kind", np.zeros((1, 3), int), r"shape \(1, 3\), expected \(3, 1\)"),
        (2, "kind", 1, r"shape \(\), expected \(2, 1\)"),
        (1, "image", np.full((1, 3, 8, 6), 0.5), "holds 0.5 .float64., its space declares uint8.*scaled it"),
        (1, "image", np.full((1, 3, 8, 6), 300), "holds 300 .int64., its space declares uint8"),
        (1, "count", np.array([[1.5, 2.0]]), "holds 1.5 .float64., its space declares int16"),
        (1, "count", np.array([[np.nan, 2.0]]), "holds nan"),
        (1, "count", np.array([[70000, 2]]), "holds 70000"),
        (1, "matrix", np.full((1, 2, 3), 1e300), r"holds 1e\+300 .float64., its space declares float32"),
        (1, "matrix", np.full((1, 2, 3), "x"), "must hold numbers"),
    ],
)
@pytest.mark.parametrize("which", ["obs", "next_obs"])
def test_observations_that_are_not_what_the_space_says(n_envs, key, value, message, which):
    buffer = make_buffer(PARTS, n_envs=n_envs)
    good = {k: np.zeros((n_envs, *space.shape), space.dtype) for k, space in PARTS.items()}
    with pytest.raises(ValueError, match=f"Observation '{key}' .*{message}"):
        add(buffer, **{which: {**good, key: value}})
    assert buffer.size() == 0


def test_observations_of_another_dtype_that_has_the_same_numbers():
    buffer = make_buffer(PARTS, n_envs=2)
    rng = np.random.default_rng(0)
    given = {
        "image": rng.integers(0, 256, (2, 3, 8, 6)),
        "matrix": rng.uniform(-1, 1, (2, 2, 3)),
        "kind": np.array([3, 4]),  # without the last dimension, as VecEnvs give it
        "count": np.array([[1.0, 2.0], [3.0, 4.0]]),
    }
    add(buffer, obs=given)
    for key, value in given.items():
        stored = buffer.observations[key][0]
        assert stored.dtype == PARTS[key].dtype or key == "kind"
        assert np.array_equal(stored, value.reshape(stored.shape).astype(stored.dtype)), key


@pytest.mark.parametrize("reward, done", [(1.5, True), ([1.5], [True]), (np.float32(1.5), np.bool_(True)), ((1.5,), (1,))])
@pytest.mark.parametrize("infos", [[{}], ({},), {}])
def test_plain_numbers_of_one_environment(reward, done, infos):
    buffer = add(make_buffer(), reward=reward, done=done, action=[0.25], infos=infos)
    assert buffer.rewards[0].tolist() == [1.5] and buffer.actions[0].tolist() == [[0.25]] and len(buffer.episodes) == 1


@pytest.mark.parametrize(
    "n_envs, changes, message",
    [
        (2, dict(reward=1.0), r"Rewards have shape \(\), expected \(2,\): one number per environment"),
        (2, dict(reward=np.zeros((2, 1))), r"Rewards have shape \(2, 1\)"),
        (1, dict(reward="high"), "Rewards must be numbers, got 'high'"),
        (1, dict(reward=None), "Rewards must be numbers, got None"),
        (1, dict(reward=[[1], [2, 3]]), "Rewards have shape"),
        (1, dict(reward=np.inf), "gave a reward of inf"),
        (2, dict(done=True), r"Dones have shape \(\), expected \(2,\)"),
        (1, dict(done=0.5), "Dones must be True or False, got 0.5"),
        (1, dict(done="no"), "Dones must be True or False"),
        (2, dict(infos=[{}]), "infos must be a list of 2 dicts"),
        (1, dict(infos=None), "infos must be a list of 1 dicts"),
        (2, dict(infos={}), "infos must be a list of 2 dicts"),
        (2, dict(action=np.zeros((3, 2))), r"Actions have shape \(3, 2\) .*expected numbers of shape \(2, 3\)"),
        (2, dict(action=np.zeros(6)), r"Actions have shape \(6,\)"),
        (2, dict(action=np.full((2, 3), np.nan)), "Actions must be finite and lie within"),
        (2, dict(action=np.full((2, 3), 1.5)), r"within \[-1, 1\], got .*policy.scale_action"),
        (1, dict(reward=1e300), r"reward of 1e\+300: rewards must be finite \(as float32\)"),
        (2, dict(obs=np.zeros((2, 2))), "Observations must be dicts of arrays with the keys .'state'"),
        (2, dict(obs={"stat": np.zeros((2, 2))}), "lack 'state'"),
        (2, dict(next_obs={"stat": np.zeros((2, 2))}), "lack 'state'"),
    ],
)
def test_what_cannot_be_added(n_envs, changes, message):
    buffer = make_buffer(actions=spaces.Box(-1, 1, (3,) if n_envs == 2 else (1,), np.float32), n_envs=n_envs)
    add(buffer, done=np.zeros(n_envs, bool))
    with pytest.raises(ValueError, match=message):
        add(buffer, **changes)
    assert buffer.n_added == n_envs


def test_filling_by_hand_where_challenges_are_wanted():
    with pytest.raises(ValueError, match="by hand before learn.., use add_demonstrations.., or set its challenge_ratio to 0"):
        add(make_buffer(challenge_ratio=0.25))


# ---- arguments -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: make_buffer(chalenge_ratio=0.1), "CPMBuffer: unknown key 'chalenge_ratio'. Did you mean 'challenge_ratio'"),
        (lambda: make_buffer(warmup=1), "Did you mean 'warmup_steps'"),
        (lambda: make_buffer(n_steps=3), "one-step returns only. Leave n_steps and gamma out"),
        (lambda: make_buffer(gamma=0.9), "one-step returns only"),
        (lambda: make_buffer(optimize_memory_usage=True), "stores every observation once anyway: leave it out"),
        (lambda: make_buffer(goal_selection_strategy="futur"), "Did you mean 'future'"),
        (lambda: CPMBuffer(1e4, STATE, ACTIONS), "buffer_size must be .* got 10000.0. Write 10000"),
        (lambda: CPMBuffer("1e4", STATE, ACTIONS), "buffer_size must be .* That is text: .* a whole number has none: 10000"),
        (lambda: CPMBuffer(0, STATE, ACTIONS), "buffer_size must be"),
        (lambda: make_buffer(player_keys="state"), "player_keys must be a list of observation keys.*got 'state'"),
        (lambda: make_buffer(player_keys=[]), "player_keys must be a list"),
        (lambda: make_buffer(player_keys=True), "player_keys must be a list"),
        (lambda: make_buffer(spaces.Dict()), "Dict without keys"),
        (lambda: make_buffer(spaces.Dict(a=STATE)), "'a' is Dict.*FlattenObservation"),
        (lambda: make_buffer(spaces.Dict(a=spaces.Text(3))), "'a' is Text"),
        (lambda: make_buffer(spaces.Dict(a=spaces.MultiDiscrete([[2, 3], [2, 3]]))), "Flatten it"),
        (lambda: ChallengerCallback(train_frek=3), "ChallengerCallback: unknown key 'train_frek'. Did you mean 'train_freq'"),
        (lambda: ChallengerCallback(decay_kwarg={}), "Did you mean 'decay_kwargs'"),
        (
            lambda: ChallengerCallback(preset="tuned"),
            r"'tuned' is no preset of the challenger.*CHALLENGES\['tuned'\].*cpm_sac_tuned",
        ),
        (lambda: make_preset("tuned"), "give it to the buffer"),
        (lambda: Challenger(STATE, ACTIONS, preset="tuned"), "give it to the buffer"),
        (lambda: make_preset("tund"), "Unknown preset 'tund'"),
    ],
)
def test_arguments_that_there_are_not(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("arguments", [dict(n_steps=3), dict(n_steps=3, gamma=0.9)])
def test_n_step_returns_as_sb3_advises(arguments):
    with pytest.raises(ValueError, match="one-step returns only"):
        SAC("MultiInputPolicy", pendulum(), replay_buffer_class=CPMBuffer, replay_buffer_kwargs=arguments)


def pendulum():
    return DictObservation(gym.make("Pendulum-v1", max_episode_steps=20))


@pytest.mark.parametrize(
    "callback", [ChallengerCallback, [ChallengerCallback], [ChallengerCallback(train_freq=1), ChallengerCallback]]
)
def test_a_callback_without_parentheses(callback):
    model = SAC("MultiInputPolicy", pendulum(), replay_buffer_class=CPMBuffer, buffer_size=100)
    with pytest.raises(ValueError, match=r"callback=ChallengerCallback\(\)\), with parentheses"):
        model.learn(10, callback=callback)
    assert model.replay_buffer.size() == 0


@pytest.mark.parametrize("wrapper", [DictObservation, TerminationIsSuccess, as_dict])
@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: make_vec_env("Pendulum-v1", n_envs=2), "wrap each before they are put together, make_vec_env"),
        (lambda: gym.make_vec("Pendulum-v1", num_envs=2, vectorization_mode="sync"), "which holds several"),
        (lambda: "Pendulum-v1", r"make it first, \w+\(gym.make\('Pendulum-v1'\)\)"),
        (lambda: None, "make one first, with gymnasium.make"),
    ],
)
def test_wrappers_around_what_is_no_environment(wrapper, make, message):
    with pytest.raises(ValueError, match=rf"{wrapper.__name__} is put around one gymnasium environment, .*{message}"):
        wrapper(make())


def test_a_loaded_model_without_its_replay_buffer(tmp_path):
    def new(**kwargs):
        return SAC(
            "MultiInputPolicy", pendulum(), replay_buffer_class=CPMBuffer, learning_starts=25, buffer_size=100, **kwargs
        )

    model = new()
    model.replay_buffer.challenge_ratio = 0
    model.learn(25)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = SAC.load(tmp_path / "model.zip", pendulum())
    with pytest.raises(
        ValueError, match=r"made 25 steps, but its replay buffer .*Call model.load_replay_buffer\(path\).*=45 "
    ):
        loaded.learn(10, callback=ChallengerCallback(), reset_num_timesteps=False)
    loaded.replay_buffer.challenge_ratio = 0
    with pytest.raises(RuntimeError, match="needs its replay buffer too"):
        loaded.learn(10, reset_num_timesteps=False)
    with pytest.raises(ValueError, match="learning_starts=3 ends before the first episode may"):
        SAC("MultiInputPolicy", pendulum(), replay_buffer_class=CPMBuffer, learning_starts=3).learn(9, ChallengerCallback())
    with pytest.raises(ValueError, match=r"model.zip is a model that SB3 has saved.*ChallengerCallback.save\(path\)"):
        new().learn(10, callback=ChallengerCallback(load_path=tmp_path / "model.zip"))
    with pytest.raises(ValueError, match="is a model that SB3 has saved"):
        Challenger.load(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="damaged or no saved challenger"):
        Challenger.load(tmp_path / "buffer.pkl")


# ---- images that SB3's own extractor cannot read -----------------------------------------------------------------------


class Camera(gym.Env):
    def __init__(self, size, state=True):
        parts = {"camera": spaces.Box(0, 255, (*size, 3), np.uint8), "state": spaces.Box(-1, 1, (2,), np.float32)}
        self.observation_space = spaces.Dict({key: part for key, part in parts.items() if state or key == "camera"})
        self.action_space = ACTIONS

    def reset(self, seed=None, options=None):
        return {key: np.zeros(space.shape, space.dtype) for key, space in self.observation_space.items()}, {}


@pytest.mark.parametrize("size", [(16, 16), (35, 64), (35, 35)])
@pytest.mark.parametrize("state", [True, False])
def test_images_too_small_for_the_player(size, state):
    def make(policy="MultiInputPolicy", **policy_kwargs):
        return SAC(
            policy,
            Camera(size, state),
            replay_buffer_class=CPMBuffer,
            buffer_size=10,
            policy_kwargs=policy_kwargs,
            device="cpu",
        )

    with pytest.raises(ValueError, match=r"36x36 pixels and more.*features_extractor_class=sb3_cpm.PointNetExtractor") as told:
        make()
    cure = str(told.value).partition("policy_kwargs=dict(")[2].partition("), or leave")[0]
    model = make(**eval(f"dict({cure})", {"sb3_cpm": sys.modules["sb3_cpm"]}))  # it works as it is written
    assert "camera" in model.actor.features_extractor.player_keys
    model.predict(model.env.reset())
    make(PointNetPolicy)
    make(features_extractor_class=PointNetExtractor)


def test_images_large_enough_for_the_player():
    SAC("MultiInputPolicy", Camera((36, 36)), replay_buffer_class=CPMBuffer, buffer_size=10, device="cpu")


# ---- packages that are missing ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "package, main, arguments, extra",
    [
        ("sapien", cli.main, ["train", "--env", "PickCube-v1"], "maniskill"),
        ("mani_skill", cli.main, ["train", "--env", "PickCube-v1"], "maniskill"),
        ("tensorboard", cli.main, ["train", "--env", "CPMToy-v0"], "run"),
        ("imageio", cli.main, ["train", "--env", "CPMToy-v0"], "run"),
        ("gymnasium_robotics", cli.main, ["train", "--env", "FetchReach-v4"], "benchmarks"),
        ("shimmy", cli.main, ["train", "--env", "dm_control/reacher-hard-v0"], "benchmarks"),
        ("rl_zoo3", zoo_cli.main, ["train", "--algo", "sac"], "zoo"),
        ("gymnasium_robotics", zoo_cli.main, ["train", "--agent", "sac_her", "--env", "FetchReach-v4"], "benchmarks"),
    ],
)
def test_commands_without_an_extra_say_so_in_a_sentence(package, main, arguments, extra, monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr(rendering, "_renderer", None)
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    for env_id in ("FetchReach-v4", "dm_control/reacher-hard-v0"):
        monkeypatch.delitem(gym.registry, env_id, raising=False)
    if main is cli.main:
        arguments = [*arguments, "--run-folder", str(tmp_path / "run")]
    assert main(arguments) == 1
    told = capsys.readouterr().err
    assert told.startswith("error: ") and install_command(extra) in told
    assert package in told or package == "shimmy"  # or what shimmy needs


def test_experiments_without_their_extra():
    program = (
        "import sys; sys.modules['pandas'] = None; from sb3_cpm.__main__ import main; sys.exit(main(['reproduce', '--list']))"
    )
    run = subprocess.run([sys.executable, "-W", "ignore", "-c", program], capture_output=True, text=True, timeout=500)
    assert run.returncode == 1 and "Traceback" not in run.stderr
    assert run.stderr.startswith("error: ") and install_command("experiments") in run.stderr


def test_missing_modules_in_a_sentence():
    with pytest.raises(MissingExtra, match=r'Boats need sails, which is not installed: pip install .+\[run\]"$'):
        check_installed("Boats", ["numpy", "sails"], "run")
    with pytest.raises(ValueError, match="Boats need sails"), needed("Boats", "run"):
        import sails.of.canvas
    with pytest.raises(ImportError, match="cannot import name"), needed("Boats", "run"):  # no matter of what is installed
        from numpy import sails  # noqa: F401


@pytest.mark.parametrize("env_id, module", [("dm_control/cartpole-swingup-v0", "shimmy"), ("Meta-World/MT1", "metaworld")])
def test_suites_that_are_missing(env_id, module, monkeypatch):
    for name in ("shimmy", "metaworld", "dm_control"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(gym.registry, env_id, raising=False)
    with pytest.raises(MissingExtra, match=rf'Tasks such as {env_id} need .*pip install .*\[benchmarks\]"'):
        register_suite(env_id)


def test_an_image_whose_smallest_side_is_in_the_middle_has_its_channels_last():
    spec = ObservationSpec(spaces.Dict({"strip": spaces.Box(0, 255, (8, 1, 2), np.uint8)}))
    assert spec.image_shape == (2, 8, 1)
    images = np.random.default_rng(0).integers(0, 256, (3, 8, 1, 2), dtype=np.uint8)
    back = spec.split(spec.preprocess({"strip": images}, th.device("cpu")), (3,))["strip"]
    assert np.allclose(back.numpy(), images, atol=1e-3)


def test_numbers_beyond_float32_are_refused_and_infinite_ones_are_left_to_others():
    spec = ObservationSpec(spaces.Dict({"state": spaces.Box(-np.inf, np.inf, (2,), np.float64)}), squash=False)
    with pytest.raises(ValueError, match="'state' holds 1e\\+300, beyond float32.*Scale it"):
        spec.preprocess({"state": np.array([[1e300, 0.0]])}, th.device("cpu"))
    assert spec.preprocess({"state": np.array([[np.inf, 1.0]])}, th.device("cpu")).vectors is not None
