"""Dreamer and Plan2Explore as SB3 algorithms: acting, latent state, learning, saving, callbacks, wrappers, bad input."""

import warnings
from copy import deepcopy
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_cpm import ChallengerCallback, CPMBuffer
from sb3_cpm.buffers.episode_buffer import EpisodeBuffer
from sb3_cpm.challenger import Challenger
from sb3_cpm.dreamer import Dreamer, DreamerPolicy, Plan2Explore
from sb3_cpm.dreamer.spaces import OBSERVATION
from sb3_cpm.envs.wrappers import DictObservation
from sb3_cpm.presets import DEFAULT
from sb3_cpm.uncertainty import UNCERTAINTY_CLASSES

TINY = dict(
    batch_size=4, sequence_length=12, cnn_depth=4, vector_units=16, stoch_size=4, deter_size=16, hidden_size=16, head_units=16,
    actor_units=16, critic_units=16, horizon=4, imagination_starts=8,
    uncertainty={"plan2explore": {"heads": 3, "layers": 1, "units": 16}, "rnd": {"layers": 2, "units": 16}},
)  # fmt: skip
KINDS = {"state": ("state",), "camera": ("camera",), "both": ("state", "camera")}


class Counting(gym.Env):
    """Observes (number of the episode, number of the step); episode e of environment i lasts ``lengths[i] + e`` steps."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(np.float32([-2.0, 0.0]), np.float32([2.0, 10.0]))

    def __init__(self, length: int = 7, terminates: bool = False) -> None:
        self.length, self.terminates, self.episode, self.n_steps = length, terminates, -1, 0
        self.actions: list[np.ndarray] = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.n_steps = self.episode + 1, 0
        return self._observe(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.actions.append(action)
        self.n_steps += 1
        ends = self.n_steps == self.length + self.episode
        return self._observe(), float(action[0]), ends and self.terminates, ends and not self.terminates, {}

    def _observe(self):
        return np.float32([self.episode, self.n_steps])


def toy(*keys: str) -> gym.Env:
    return gym.make("sb3_cpm.envs.toy:CPMToy-v0", keys=keys or ("state",))


def camera_only() -> gym.Env:
    """An environment with an image, not a Dict, for an observation."""
    env = toy("camera")
    return TransformObservation(env, lambda observation: observation["camera"], env.observation_space["camera"])


def make(env=None, kind=Dreamer, policy="MultiInputPolicy", preset=None, **kwargs):
    arguments = dict(
        learning_starts=60, train_freq=10, buffer_size=2000, seed=0, device="cpu", preset={**TINY, **(preset or {})}
    )
    return kind(policy, toy() if env is None else env, **{**arguments, **kwargs})


def counting(*lengths: int, **kwargs):
    """:return: a model in environments with episodes of different lengths"""
    env = DummyVecEnv([lambda length=length: Counting(length) for length in lengths or (7,)])
    return make(env, policy="MlpPolicy", **{"learning_starts": 20, **kwargs})


def weights(model) -> dict[str, np.ndarray]:
    return {key: value.numpy().copy() for key, value in model.policy.state_dict().items()}


def assert_same(one, other) -> None:
    """Same weights, and same optimizers."""
    first, second = one.get_parameters(), other.get_parameters()
    assert first.keys() == second.keys()
    for name in first:
        flat = [th.utils._pytree.tree_flatten(dict(part[name]))[0] for part in (first, second)]
        assert len(flat[0]) == len(flat[1]) > 0
        assert all(th.equal(th.as_tensor(a), th.as_tensor(b)) for a, b in zip(*flat, strict=True) if a is not None), name


# ---- predict -------------------------------------------------------------------------------------------------------------


def episode(env: gym.Env, n_steps: int, seed: int = 3):
    """States 0..n of a random episode, and what led to them."""
    env.action_space.seed(seed)
    observations, actions = [env.reset(seed=seed)[0]], [np.zeros(2, np.float32)]
    for _ in range(n_steps):
        actions.append(env.action_space.sample())
        observations.append(env.step(actions[-1])[0])
    return {key: np.stack([o[key] for o in observations]) for key in observations[0]}, np.stack(actions)


@pytest.mark.parametrize("kind", KINDS)
def test_predicting_step_by_step_is_following_the_whole_episode(kind):
    env = toy(*KINDS[kind])
    model = make(toy(*KINDS[kind]))
    observations, actions = episode(env, 20)
    state = None
    for step in range(21):
        observation = {key: value[step] for key, value in observations.items()}
        if state is not None:
            state = (*state[:2], actions[step][None])  # somebody else acted
        action, state = model.predict(observation, state, np.array([step == 0]), deterministic=True)
    challenger, first = model.challenger, np.arange(21)[:, None] == 0
    rows = {key: (value.transpose(0, 3, 1, 2) if value.ndim == 4 else value)[:, None] for key, value in observations.items()}
    whole = challenger.follow(challenger.initial_state(1), rows, actions[:, None], first, deterministic=True)
    np.testing.assert_allclose(state[0], whole.deter, atol=1e-5)
    np.testing.assert_allclose(state[1], whole.stoch, atol=1e-5)
    np.testing.assert_allclose(action, challenger.act(whole, deterministic=True, behavior="task")[0], atol=1e-5)
    np.testing.assert_allclose(
        state[2][0], action, atol=1e-6, err_msg="the next call will take it that this action was executed"
    )


def test_memory_matters_and_an_episode_start_forgets_it():
    model = make()
    rng = np.random.default_rng(0)
    first, second = ({"state": rng.normal(size=(2, 4)).astype(np.float32)} for _ in range(2))
    _, state = model.predict(first, deterministic=True)
    remembered, _ = model.predict(second, state, np.array([False, False]), deterministic=True)
    fresh, _ = model.predict(second, deterministic=True)
    mixed, _ = model.predict(second, state, np.array([False, True]), deterministic=True)
    assert not np.allclose(remembered, fresh)
    np.testing.assert_allclose(mixed, [remembered[0], fresh[1]], atol=1e-6)
    assert np.array_equal(state[0], model.predict(first, deterministic=True)[1][0]), "what was passed in is not changed"


def test_one_environment_or_several_and_the_units_of_actions():
    model = counting()
    one, state = model.predict(np.zeros(2, np.float32), deterministic=True)
    several, states = model.predict(np.zeros((3, 2), np.float32), deterministic=True)
    assert one.shape == (2,) and several.shape == (3, 2) and [len(part) for part in states] == [3, 3, 3]
    np.testing.assert_allclose(several, [one] * 3, atol=1e-6)
    draws = np.concatenate([model.predict(np.zeros((50, 2), np.float32))[0] for _ in range(20)])
    assert (draws >= [-2, 0]).all() and (draws <= [2, 10]).all()
    assert (draws.std(0) > [0.3, 0.7]).all(), "sampled, and in the environment's units"
    np.testing.assert_allclose(state[2], model.policy.scale_action(one)[None], atol=1e-6)


def test_only_the_keys_that_are_read_must_be_there():
    model = make(toy("state", "camera"), keys=["state"])
    action, _ = model.predict({"state": np.zeros(4, np.float32)}, deterministic=True)
    assert action.shape == (2,)
    with pytest.raises(ValueError, match="'state' is missing"):
        model.predict({"camera": np.zeros((32, 32, 3), np.uint8)})


@pytest.mark.parametrize(
    "observation, state, message",
    [
        ((np.zeros(2, np.float32), {}), None, "pass the observation"),
        ({"state": np.zeros(2, np.float32)}, None, "type dict"),
        (np.zeros(3, np.float32), None, "shape"),
        (np.zeros((2, 2), np.float32), "of one", "2 environment"),
    ],
)
def test_predict_says_what_is_wrong(observation, state, message):
    model = counting()
    if state == "of one":
        state = model.predict(np.zeros(2, np.float32))[1]
    with pytest.raises(ValueError, match=message):
        model.predict(observation, state)


# ---- the latent state in learn() -----------------------------------------------------------------------------------------


class Recorder(DreamerPolicy):
    """Writes down what its latent state follows."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.rows = []

    def follow(self, observations, state, episode_start, deterministic=False):
        latent = super().follow(observations, state, episode_start, deterministic)
        self.rows.append((np.array(observations), [np.array(part) for part in state], np.array(episode_start), latent))
        return latent


@pytest.mark.parametrize("kind", [Dreamer, Plan2Explore])
def test_the_latent_state_follows_every_environment_through_rollouts_and_resets(kind):
    model = make(DummyVecEnv([lambda: Counting(4), lambda: Counting(7)]), kind, Recorder, learning_starts=20)
    envs = [env.unwrapped for env in model.env.envs]
    model.learn(60)
    model.learn(40, reset_num_timesteps=False)
    rows = model.policy.rows
    assert len(rows) == 50 and model._n_updates > 0
    for step, (observations, state, first, _) in enumerate(rows):
        assert np.array_equal(first, observations[:, 1] == 0), "reset exactly where an episode begins"
        if step == 0:
            continue
        latent = rows[step - 1][3]
        assert np.array_equal(state[0], latent.deter) and np.array_equal(state[1], latent.stoch)
        executed = np.stack([env.actions[step - 1] for env in envs])
        np.testing.assert_allclose(model.policy.unscale_action(state[2]), executed, atol=1e-5)
    assert sum(first[0] for _, _, first, _ in rows) > sum(first[1] for _, _, first, _ in rows) > 2


def test_the_buffer_holds_true_last_observations_and_executed_actions():
    model = counting(4, 7, action_noise=NormalActionNoise(np.zeros(2), np.full(2, 0.5))).learn(80)
    batch = model.replay_buffer.sample_sequences(50, 12)
    observations, mask = batch.observations[OBSERVATION], batch.mask
    assert np.array_equal(batch.is_first[mask], observations[..., 1][mask] == 0)
    inside = mask[1:] & ~batch.is_first[1:]
    assert (observations[1:, :, 1][inside] == observations[:-1, :, 1][inside] + 1).all(), "the last state is a row, too"
    # the reward is the first action in the environment's units
    np.testing.assert_allclose(2 * batch.actions[1:, :, 0][inside], batch.rewards[1:][inside], atol=1e-5)
    assert not batch.is_terminal.any() and np.abs(batch.actions).max() <= 1


def test_random_at_first_then_by_the_policy():
    """A policy of nothing but zeros shows who acts."""
    model = counting(learning_starts=30, gradient_steps=0)
    with th.no_grad():
        for parameter in model.challenger.task.actor.parameters():
            parameter.zero_()
        model.challenger.task.actor.net[-1].bias[2:] = -50.0  # the smallest deviation
    model.learn(200)
    first, second = np.split(model.policy.scale_action(np.stack(model.env.envs[0].unwrapped.actions)), [30])
    assert 0.4 < first.std() < 0.75 and second.std() < 0.15


@pytest.mark.parametrize("train_freq, gradient_steps, updates", [(5, 2, 32), ((2, "episode"), -1, None), (1, 1, 80)])
def test_how_often_it_learns(train_freq, gradient_steps, updates):
    model = counting(train_freq=train_freq, gradient_steps=gradient_steps).learn(100)
    if updates is None:
        updates = model.num_timesteps - 28  # episodes of 7, 8, 9, ... steps
        assert model._n_updates in (updates, updates + 13)
    else:
        assert model._n_updates == updates
    assert model._n_updates == model.challenger.trained_updates


def test_before_the_first_episode_ends_there_is_nothing_to_learn():
    model = counting(30, learning_starts=0).learn(20)
    assert model._n_updates == model.challenger.trained_updates == 0
    assert model.learn(30, reset_num_timesteps=False)._n_updates > 0


# ---- learning ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Dreamer, Plan2Explore])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_same_seed_gives_the_same_run(kind, n_envs):
    runs = [make(make_vec_env(toy, n_envs), kind=kind, seed=seed).learn(140) for seed in (1, 1, 2)]
    assert_same(runs[0], runs[1])
    assert any(not np.array_equal(value, weights(runs[2])[key]) for key, value in weights(runs[0]).items())


class Middle(gym.Env):
    """A point on a line that is to be kept in the middle."""

    observation_space = action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1, 1, 1).astype(np.float32)
        return self.x.copy(), {}

    def step(self, action):
        self.x = np.clip(self.x + 0.5 * action, -1, 1).astype(np.float32)
        return self.x.copy(), -float(abs(self.x[0])), False, False, {}


def test_it_learns_within_seconds():
    env = make_vec_env(lambda: gym.wrappers.TimeLimit(Middle(), 10), 1)
    preset = dict(
        batch_size=16, sequence_length=6, imagination_starts=64, horizon=4, gamma=0.8, slow_target_every=20, model_lr=5e-3,
        actor_lr=3e-3, critic_lr=3e-3, actor_units=32, head_units=32, hidden_size=32, deter_size=32,
    )  # fmt: skip
    model = make(env, policy="MlpPolicy", learning_starts=100, train_freq=2, preset=preset)
    before, _ = evaluate_policy(model, env, 20)
    model.learn(500)
    after, _ = evaluate_policy(model, env, 20)
    assert after > -1.5 and before < -4, (before, after)


@pytest.mark.parametrize(
    "env, policy",
    [
        (lambda: toy("camera"), "MultiInputPolicy"),
        (lambda: toy("state", "camera"), "MultiInputPolicy"),
        (camera_only, "CnnPolicy"),
        (lambda: gym.make("Pendulum-v1", max_episode_steps=50), "MlpPolicy"),
        (lambda: VecFrameStack(make_vec_env(camera_only, 2), 3), "CnnPolicy"),
        (lambda: VecFrameStack(make_vec_env("Pendulum-v1", 2, env_kwargs=dict(max_episode_steps=50)), 3), "MlpPolicy"),
    ],
)
def test_images_vectors_and_dicts(env, policy):
    model = make(env(), policy=policy, learning_starts=100).learn(140)
    assert model._n_updates > 0
    evaluate_policy(model, env(), 1, warn=False)


def test_scalars_are_logged(tmp_path):
    model = make(kind=Plan2Explore, train_task_behavior=True)
    model.set_logger(configure(str(tmp_path), ["csv", "tensorboard"]))
    model.learn(200, log_interval=1)
    model.logger.close()
    names = set((tmp_path / "progress.csv").read_text().splitlines()[0].split(","))
    assert {"rollout/ep_rew_mean", "train/kl", "train/reward_loss", "train/learning_rate", "train/n_updates"} <= names
    assert {"train/task_actor_loss", "train/exploration_actor_loss", "train/uncertainty_loss", "train/disagreement"} <= names
    assert list(tmp_path.glob("events*"))


class Sampling(gym.Env):
    """Observes samples of a space."""

    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, observation_space: spaces.Space, length: int = 7) -> None:
        self.observation_space, self.length = deepcopy(observation_space), length  # VecNormalize changes it

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.n_steps += 1
        return self.observation_space.sample(), float(action.sum()), False, self.n_steps == self.length, {}


LONG = {
    "a_name_with_27_characters__": "a_name_with_27_characters__",
    "robot0_left_fingers_joint_positions": "robot0_l..._joint_positions",
    "robot0_left_gripper_joint_positions": "robot0_..2..joint_positions",
    "robot0_left_gripper_joint_velocities": "robot0_l...joint_velocities",
}


def test_long_keys_get_names_that_a_printed_log_can_tell_apart(capsys):
    space = spaces.Dict({key: spaces.Box(-1, 1, (3,)) for key in LONG})
    make(Sampling(space), learning_starts=10, verbose=1).learn(40, log_interval=1)
    printed = capsys.readouterr().out
    assert all(f"   error_{name} |" in printed for name in LONG.values())


def rates(model):
    return {name: one.adam.param_groups[0]["lr"] for name, one in model.challenger.optimizers.items()}


def test_a_learning_rate_schedule_moves_all_learning_rates():
    plain = make(kind=Plan2Explore).learn(200)
    assert rates(plain)["world_model"] == plain.learning_rate == DEFAULT.model_lr
    assert rates(plain)["exploration_actor"] == DEFAULT.actor_lr
    model = make(kind=Plan2Explore, learning_rate=lambda progress: 0.1 * progress)
    model.learn(200)
    now = rates(model)
    assert 0 <= now["world_model"] < 0.01
    for entry, name in (
        ("actor_lr", "exploration_actor"),
        ("critic_lr", "exploration_critic"),
        ("uncertainty_lr", "uncertainty"),
    ):
        assert now[name] == pytest.approx(now["world_model"] * getattr(DEFAULT, entry) / DEFAULT.model_lr)


def test_a_frozen_world_model():
    explorer = counting(kind=Plan2Explore).learn(60)
    frozen = {"model_lr": 0.0, "weight_decay": 0.0}
    arguments = dict(policy="MlpPolicy", env=Counting(), start_from=explorer, device="cpu", learning_starts=10)
    model = Dreamer(**arguments, preset=frozen)
    task = part(model.challenger, "task").detach().clone()
    model.learn(30)
    assert rates(model) == {"world_model": 0.0, "task_actor": DEFAULT.actor_lr, "task_critic": DEFAULT.critic_lr}
    assert th.equal(part(model.challenger, "world_model"), part(explorer.challenger, "world_model"))
    assert model._n_updates > 0 and not th.equal(part(model.challenger, "task"), task)
    with pytest.raises(ValueError, match="'model_lr' is 0, .*`learning_rate`.*leave one of them out"):
        Dreamer(**arguments, preset=frozen, learning_rate=1e-3)


# ---- exploring -----------------------------------------------------------------------------------------------------------


class Scaled(gym.RewardWrapper):
    def __init__(self, env, factor):
        super().__init__(env)
        self.factor = factor

    def reward(self, reward):
        return self.factor * reward


@pytest.mark.parametrize("uncertainty", ["plan2explore", "rnd"])
def test_exploring_does_not_depend_on_the_reward(uncertainty):
    actions = []
    for factor in (0.0, 3.0):
        model = make(
            Scaled(toy(), factor),
            Plan2Explore,
            uncertainty_class=uncertainty,
            preset=dict(reward_gradient=False, grad_clip=1e9),
        )
        model.learn(200)
        actions.append(model.replay_buffer.actions[:200])
    assert np.array_equal(*actions) and len(np.unique(actions[0])) > 300


def test_dreamer_is_lean_and_explorer_has_both_on_request():
    assert set(make().challenger.networks) == {"world_model", "task"}
    assert set(make(kind=Plan2Explore).challenger.networks) == {"world_model", "uncertainty", "exploration"}
    both = make(kind=Plan2Explore, train_task_behavior=True).challenger
    assert set(both.networks) == {"world_model", "uncertainty", "exploration", "task"}


def part(challenger: Challenger, name: str) -> th.Tensor:
    return th.nn.utils.parameters_to_vector(challenger.networks[name].parameters())


@pytest.mark.parametrize("source", ["zip", "model", "challenger file", "callback"])
@pytest.mark.parametrize("task", [True, False])
def test_dreamer_starts_from_what_was_explored(tmp_path, source, task):
    if source in ("zip", "model"):
        start = make(kind=Plan2Explore, train_task_behavior=task).learn(120)
        explored = start.challenger
        if source == "zip":
            start.save(tmp_path / "explorer")
            start = tmp_path / ("explorer" if task else "explorer.zip")
    else:
        start = ChallengerCallback(train_freq=10, challenger_kwargs={**TINY, "train_task_behavior": task})
        player = SAC(
            "MultiInputPolicy", toy(), replay_buffer_class=CPMBuffer, learning_starts=60, batch_size=8, train_freq=10,
            policy_kwargs=dict(net_arch=[8]), device="cpu", seed=0,
        )  # fmt: skip
        player.learn(120, callback=start)
        explored = start.challenger
        if source == "challenger file":
            start.save(tmp_path / "challenger.pt")
            start = tmp_path / "challenger.pt"
    model = Dreamer("MultiInputPolicy", toy(), start_from=start, seed=5, device="cpu", learning_starts=60, train_freq=10)
    assert explored.trained_updates == model.challenger.trained_updates > 0
    assert th.equal(part(model.challenger, "world_model"), part(explored, "world_model"))
    moments = [one.optimizers["world_model"].adam.state_dict()["state"] for one in (model.challenger, explored)]
    assert th.equal(moments[0][0]["exp_avg"], moments[1][0]["exp_avg"]) and moments[0][0]["exp_avg"].abs().sum() > 0
    if task:
        assert th.equal(part(model.challenger, "task"), part(explored, "task"))
    assert model.challenger.preset.deter_size == TINY["deter_size"], "its sizes, too"
    before = part(explored, "world_model").clone()
    model.learn(120)
    assert th.equal(part(explored, "world_model"), before), "the original is left alone"
    assert not th.equal(part(model.challenger, "world_model"), before)


def test_what_can_change_at_the_start_and_what_cannot(tmp_path):
    explorer = make(kind=Plan2Explore)
    model = Dreamer("MultiInputPolicy", toy(), start_from=explorer, preset={"gamma": 0.9, "actor_lr": 0.5}, device="cpu")
    assert model.gamma == model.challenger.preset.gamma == 0.9
    model.learning_starts, model.train_freq = 50, type(model.train_freq)(10, model.train_freq.unit)
    model.learn(60)
    assert model.challenger.optimizers["task_actor"].adam.param_groups[0]["lr"] == 0.5
    with pytest.raises(ValueError, match="other sizes"):
        Dreamer("MultiInputPolicy", toy(), start_from=explorer, preset={"deter_size": 17}, device="cpu")
    with pytest.raises(ValueError, match="reads the observations"):
        Dreamer("MlpPolicy", "Pendulum-v1", start_from=explorer, device="cpu")
    other = SAC("MultiInputPolicy", toy(), policy_kwargs=dict(net_arch=[8]))
    other.save(tmp_path / "sac")
    for source, message in (
        (tmp_path / "sac.zip", "another algorithm"),
        (tmp_path / "missing", "no file"),
        (other, "must be a file"),
        (ChallengerCallback(), "no challenger yet"),
    ):
        with pytest.raises(ValueError, match=message):
            Dreamer("MultiInputPolicy", toy(), start_from=source, device="cpu")


def test_an_explorer_goes_on_from_an_explorer():
    first = make(kind=Plan2Explore).learn(120)
    second = make(kind=Plan2Explore, start_from=first, seed=7)
    for name in ("world_model", "uncertainty", "exploration"):
        assert th.equal(part(first.challenger, name), part(second.challenger, name)), name
    with pytest.raises(ValueError, match="rnd"):
        make(kind=Plan2Explore, start_from=first, uncertainty_class="rnd")


class Own(UNCERTAINTY_CLASSES["rnd"]):
    """A class of one's own."""


@pytest.mark.parametrize("kind", [None, "rnd", Own])
@pytest.mark.parametrize("saved", [True, False])
def test_an_explorer_takes_over_uncertainty_and_its_arguments(tmp_path, kind, saved):
    kwargs = {"units": 12, "scale_factor": 1.25}
    first = counting(kind=Plan2Explore, uncertainty_class=kind, uncertainty_kwargs=kwargs).learn(30)
    first.save(tmp_path / "first.zip")
    source = tmp_path / "first.zip" if saved else first
    arguments = dict(policy="MlpPolicy", env=Counting(), start_from=source, device="cpu")
    second = Plan2Explore(**arguments).challenger
    assert second.uncertainty_name == first.challenger.uncertainty_name
    assert second.uncertainty_kwargs == first.challenger.uncertainty_kwargs
    assert th.equal(part(second, "uncertainty"), part(first.challenger, "uncertainty"))
    third = Plan2Explore(**arguments, uncertainty_kwargs={"metric": "log"}).challenger
    assert third.uncertainty.metric == "log" and third.uncertainty_kwargs["units"] == 12
    name = first.challenger.uncertainty_name
    fourth = Plan2Explore(**arguments, preset={"uncertainty": {name: {"scale_factor": 1.125}}}).challenger
    assert kind is Own or fourth.uncertainty.rule.factor == 1.125, "what is given wins"
    with pytest.raises(ValueError, match="other sizes"):
        Plan2Explore(**arguments, uncertainty_kwargs={"units": 13})


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_file_fits_the_environment_that_it_comes_from(tmp_path, dtype):
    env = Sampling(spaces.Box(0.0, 0.7, (8, 8, 3), dtype))
    first = make(env, policy="CnnPolicy")
    first.challenger.save(tmp_path / "challenger.pt")
    second = Dreamer("CnnPolicy", env, start_from=tmp_path / "challenger.pt", device="cpu")
    assert all(np.array_equal(value, weights(second)[key]) for key, value in weights(first).items())


def test_learning_offline_from_an_explorers_buffer(tmp_path):
    explorer = make(kind=Plan2Explore).learn(120)
    explorer.save_replay_buffer(tmp_path / "buffer")
    model = make(start_from=explorer)
    with pytest.warns(UserWarning, match="truncated"):
        model.load_replay_buffer(tmp_path / "buffer")
    before = part(model.challenger, "task").detach().clone()
    model.train(3)
    assert model._n_updates == 3 and not th.equal(part(model.challenger, "task"), before)


# ---- saving and loading --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Dreamer, Plan2Explore])
def test_saving_and_loading_changes_nothing(tmp_path, kind):
    model = make(kind=kind).learn(120)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = kind.load(tmp_path / "model", env=toy(), device="cpu")
    assert_same(model, loaded)
    assert loaded.num_timesteps == 120 and loaded._n_updates == loaded.challenger.trained_updates == model._n_updates
    loaded.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    for one in (model, loaded):
        one.set_logger(configure(None, []))
        th.manual_seed(0)
        np.random.seed(0)
        one.train(3)
    assert_same(model, loaded)


def test_a_resumed_run_is_the_unbroken_run(tmp_path):
    """As far as SB3 allows: the environment itself has to live on."""
    unbroken = make().learn(170)
    unbroken.learn(100, reset_num_timesteps=False)
    first = make().learn(170)
    first.save(tmp_path / "model")
    first.save_replay_buffer(tmp_path / "buffer")
    np.random.seed(99)
    th.manual_seed(99)
    second = Dreamer.load(tmp_path / "model", env=first.env, force_reset=False, device="cpu")
    second.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    second.learn(100, reset_num_timesteps=False)
    assert second.num_timesteps == 270
    assert_same(unbroken, second)


def test_a_resumed_run_sees_new_start_states(tmp_path):
    def starts(one, **kwargs):
        one.learn(1, **kwargs)
        return np.array(one.replay_buffer.observations["state"][0])

    model = make(make_vec_env(toy, 1))
    first = starts(model)
    model.save(tmp_path / "model")
    loaded = Dreamer.load(tmp_path / "model", env=make_vec_env(toy, 1), device="cpu")
    assert not np.array_equal(first, starts(loaded, reset_num_timesteps=False))


def test_load_without_environment_and_with_everything_that_sb3_offers(tmp_path):
    model = make(toy("state", "camera")).learn(70)
    model.save(str(tmp_path / "model"), exclude=["tensorboard_log"])
    observation = toy("state", "camera").reset(seed=1)[0]
    wanted, _ = model.predict(observation, deterministic=True)
    loaded = Dreamer.load(tmp_path / "model.zip", custom_objects={"learning_rate": 1e-5, "buffer_size": 1}, device="cpu")
    assert np.array_equal(loaded.predict(observation, deterministic=True)[0], wanted)
    assert loaded.env is None and loaded.learning_rate == 1e-5
    with open(tmp_path / "stream", "wb") as file:
        model.save(file)
    with open(tmp_path / "stream", "rb") as file:
        assert np.array_equal(Dreamer.load(file, device="cpu").predict(observation, deterministic=True)[0], wanted)
    policy_file = tmp_path / "policy.pth"
    model.policy.save(policy_file)
    assert np.array_equal(DreamerPolicy.load(policy_file, device="cpu").predict(observation, deterministic=True)[0], wanted)


@pytest.mark.parametrize("kind", [Dreamer, Plan2Explore])
def test_a_loaded_model_takes_other_rates_and_constants(tmp_path, kind):
    model = make(kind=kind).learn(80)
    model.save(tmp_path / "model")
    changed = {"model_lr": 5e-4, "actor_lr": 2e-5, "adam_eps": 1e-4, "horizon": 3, "batch_size": 2, "gamma": 0.5}
    loaded = kind.load(tmp_path / "model", env=toy(), device="cpu", preset=changed, keys=["state"])
    assert_same_weights(model, loaded)
    assert loaded.challenger.preset == replace(model.challenger.preset, **changed)
    assert loaded.learning_rate == 5e-4 and loaded.batch_size == 2 and loaded.gamma == 0.5
    model.save_replay_buffer(tmp_path / "buffer")
    loaded.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    loaded.train(1)
    now = rates(loaded)
    assert now["world_model"] == 5e-4
    assert now[f"{loaded.behavior}_actor"] == pytest.approx(2e-5)
    assert {one.adam.param_groups[0]["eps"] for one in loaded.challenger.optimizers.values()} == {1e-4}
    loaded.save(tmp_path / "again")
    assert kind.load(tmp_path / "again", device="cpu").challenger.preset == loaded.challenger.preset
    # the schedule's start is what the user gives it
    given = kind.load(tmp_path / "model", device="cpu", preset={"model_lr": 5e-4}, learning_rate=1e-5)
    assert given.learning_rate == 1e-5


def assert_same_weights(one, other) -> None:
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys() and all(np.array_equal(first[key], second[key]) for key in first)


@pytest.mark.parametrize(
    "kind, given, message",
    [
        (
            Dreamer,
            {"preset": {"deter_size": 20}},
            r"model cannot be loaded with \{'deter_size': 20\}; .*size mismatch for networks",
        ),
        (Dreamer, {"preset": "report"}, r"'deter_size': 200"),
        (Dreamer, {"keys": ["target"]}, r"cannot be loaded with \{'keys': \['target'\]\}"),
        (Plan2Explore, {"train_task_behavior": True}, r"\{'train_task_behavior': True\}; .*task"),
        (Plan2Explore, {"uncertainty_class": "rnd"}, r"\{'uncertainty_class': 'rnd'\}"),
        (Dreamer, {"preset": {"gama": 1}}, "Did you mean 'gamma'"),
    ],
)
def test_a_loaded_model_keeps_its_networks(tmp_path, kind, given, message):
    make(toy("state", "camera"), kind=kind).save(tmp_path / "model")
    with pytest.raises(ValueError, match=message):
        kind.load(tmp_path / "model", device="cpu", **given)


@pytest.mark.parametrize("saved, loaded", [(Plan2Explore, Dreamer), (Dreamer, Plan2Explore)])
def test_a_model_of_the_other_algorithm_is_not_loaded(tmp_path, saved, loaded):
    make(kind=saved).save(tmp_path / "model")
    with pytest.raises(ValueError, match=rf"no model of {loaded.__name__}: .*{loaded.__name__}\(\.\.\., start_from="):
        loaded.load(tmp_path / "model", device="cpu")


def test_what_a_loaded_model_began_with_is_past(tmp_path):
    model = make(start_from=make(kind=Plan2Explore), pretrain_steps=3).learn(80)
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match="`start_from` plays no role any more"):
        loaded = Dreamer.load(tmp_path / "model", device="cpu", start_from="explorer.zip")
    assert_same(model, loaded)
    with pytest.warns(UserWarning, match="`pretrain_steps` plays no role any more"):
        Dreamer.load(tmp_path / "model", device="cpu", pretrain_steps=5)


def test_parameters_by_sb3s_methods():
    model, other = make().learn(80), make(seed=3)
    assert set(model.get_parameters()) == {
        "policy", "policy.world_model_optimizer", "policy.task_actor_optimizer", "policy.task_critic_optimizer"
    }  # fmt: skip
    other.set_parameters(model.get_parameters())
    assert_same(model, other)
    with pytest.raises(ValueError, match="Names of parameters"):
        other.set_parameters({"policy": model.policy.state_dict()})
    other.set_parameters({"policy": model.policy.state_dict()}, exact_match=False)


def test_another_number_of_environments_after_loading(tmp_path):
    model = counting(4, 7).learn(40)
    model.save(tmp_path / "model")
    loaded = Dreamer.load(tmp_path / "model", env=DummyVecEnv([lambda: Counting(5)] * 3), device="cpu")
    loaded.learn(60, reset_num_timesteps=False)
    assert loaded.n_envs == 3 and loaded.num_timesteps == 40 + 60 and loaded._n_updates > model._n_updates


def test_a_broken_model_does_not_replace_a_good_file(tmp_path):
    model = make()
    model.save(tmp_path / "model")
    good = (tmp_path / "model.zip").read_bytes()
    with th.no_grad():
        model.challenger.task.critic[0].weight[0, 0] = th.nan
    with pytest.raises(RuntimeError, match=r"task.critic.0.weight is not finite"):
        model.save(tmp_path / "model")
    assert (tmp_path / "model.zip").read_bytes() == good and len(list(tmp_path.iterdir())) == 1


# ---- other people's callbacks and wrappers -------------------------------------------------------------------------------


def test_callbacks_of_sb3(tmp_path):
    class Wants(BaseCallback):
        def _on_step(self):
            return self.num_timesteps < 150

    model = counting(learning_starts=30)
    evaluation = EvalCallback(
        DummyVecEnv([lambda: Counting(9)]), eval_freq=50, n_eval_episodes=2, best_model_save_path=str(tmp_path), verbose=0
    )
    checkpoint = CheckpointCallback(60, str(tmp_path), save_replay_buffer=True)
    with pytest.warns(UserWarning, match="Monitor"):
        model.learn(1000, callback=[evaluation, checkpoint, Wants()], progress_bar=True)
    assert model.num_timesteps == 150 and np.isfinite(evaluation.best_mean_reward)
    assert (tmp_path / "best_model.zip").exists() and (tmp_path / "rl_model_120_steps.zip").exists()
    resumed = Dreamer.load(tmp_path / "rl_model_120_steps", env=Counting(), device="cpu")
    with pytest.warns(UserWarning, match="truncated"):
        resumed.load_replay_buffer(tmp_path / "rl_model_replay_buffer_120_steps.pkl")
    resumed.learn(30, reset_num_timesteps=False)


@pytest.mark.parametrize("box", [True, False])
def test_what_acts_and_what_learns_see_the_same_normalized_observations(box):
    env = VecNormalize(DummyVecEnv([(lambda: Counting(9)) if box else lambda: DictObservation(Counting(9))]))
    model = make(env, policy="MlpPolicy" if box else "MultiInputPolicy", learning_starts=20).learn(100)
    env.training = False
    raw = model.replay_buffer.sample_sequences(3, 5)
    seen = model._normalized(raw)
    original = raw.observations["state"]
    expected = env.normalize_obs(original[2]) if box else env.normalize_obs({"state": original[2]})["state"]
    np.testing.assert_allclose(seen.observations["state"][2], expected)
    assert not np.allclose(expected, original[2])
    np.testing.assert_allclose(seen.rewards[1], env.normalize_reward(raw.rewards[1]))
    assert (seen.rewards[raw.is_first] == 0).all()
    assert np.array_equal(raw.observations["state"], original)
    evaluate_policy(model, env, 1, warn=False)


MIXED = spaces.Dict(
    {
        "state": spaces.Box(-1, 1, (3,), np.float32),
        "other": spaces.Box(-1, 1, (2,), np.float32),
        "depth": spaces.Box(0, 1, (8, 8, 1), np.float32),
        "camera": spaces.Box(0, 255, (3, 8, 8), np.uint8),
    }
)


@pytest.mark.parametrize(
    "keys, normalized",
    [
        (["state"], None),
        (["state", "depth"], ["state", "other"]),
        (["state", "camera"], None),
        (["depth"], ["other"]),
    ],
)
def test_keys_that_are_not_read_may_be_normalized(keys, normalized):
    env = VecNormalize(DummyVecEnv([lambda: Sampling(MIXED)]), norm_obs_keys=normalized)
    model = make(env, keys=keys, learning_starts=20).learn(40)
    assert model._n_updates > 0
    raw = model.replay_buffer.sample_sequences(2, 5, model.challenger.keys)
    seen = model._normalized(raw).observations
    every = env.normalize_obs(model.replay_buffer.sample_sequences(2, 5).observations)
    assert set(seen) == set(keys) and all(seen[key].dtype == every[key].dtype for key in keys)
    unchanged = [key for key in keys if np.array_equal(seen[key], raw.observations[key])]
    assert unchanged == [key for key in keys if normalized is not None and key not in normalized]


@pytest.mark.parametrize(
    "space, kwargs, message",
    [
        (MIXED, {}, r"within \+-10, .*\{'depth': '0 to 1'\}.*norm_obs_keys=\['camera', 'other', 'state'\]"),
        (MIXED, {"norm_obs_keys": ["depth"]}, "'depth'.*norm_obs=False"),
        (MIXED["depth"], {}, "norm_obs=False"),
        (MIXED["depth"], {"clip_obs": 0.5}, r"within \+-0.5"),
    ],
)
def test_images_that_vec_normalize_would_move_out_of_their_range(space, kwargs, message):
    env = VecNormalize(DummyVecEnv([lambda: Sampling(space)]), **kwargs)
    with pytest.raises(ValueError, match=message):
        make(env, policy="MultiInputPolicy" if space is MIXED else "CnnPolicy")


def test_images_that_vec_normalize_declares_anew():
    """It does so for uint8 from 0 to 255, in float32: 3.3 is no such number."""
    camera = spaces.Box(0, 255, (3, 16, 16), np.uint8)
    make(VecNormalize(DummyVecEnv([lambda: Sampling(camera)]), clip_obs=3.3), policy="CnnPolicy")


def test_it_learns_from_what_a_player_and_its_challenger_collected(tmp_path):
    """There is nobody to give challenges to."""
    player = SAC(
        "MultiInputPolicy",
        toy(),
        replay_buffer_class=CPMBuffer,
        learning_starts=60,
        policy_kwargs={"net_arch": [8]},
        device="cpu",
    )
    player.learn(100, callback=ChallengerCallback(preset=TINY))
    player.save_replay_buffer(tmp_path / "buffer")
    model = make()
    model.load_replay_buffer(tmp_path / "buffer")
    model.learn(80)
    assert model.replay_buffer.challenge_ratio == 0 and model.replay_buffer.size() == 180


# ---- bad input -----------------------------------------------------------------------------------------------------------


class Spaces(gym.Env):
    def __init__(self, observation_space=None, action_space=None):
        self.observation_space = observation_space or spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = action_space or spaces.Box(-1, 1, (1,), np.float32)


@pytest.mark.parametrize(
    "env, kwargs, message",
    [
        (lambda: Spaces(action_space=spaces.Discrete(3)), {}, "continuous action space"),
        (lambda: Spaces(spaces.Discrete(3)), {}, "FlattenObservation"),
        (lambda: Spaces(spaces.Box(-1, 1, (4, 2), np.float32)), {}, "FlattenObservation"),
        (lambda: Spaces(spaces.Dict({"n": spaces.Discrete(3)})), {"policy": "MultiInputPolicy"}, "No observation key"),
        (toy, {"policy": "MlpPolicy"}, "MultiInputPolicy"),
        (Spaces, {"policy": "LstmPolicy"}, "unknown"),
        (Spaces, {"preset": "defualt"}, "Did you mean 'default'"),
        (Spaces, {"preset": {"horizont": 3}}, "Did you mean 'horizon'"),
        (Spaces, {"keys": ["camera"]}, "Unknown observation key"),
        (Spaces, {"policy_kwargs": {"preset": {"train_task_behavior": False}}}, "train_task_behavior"),
        (Spaces, {"replay_buffer_class": SAC}, "sequences"),
        (Spaces, {"replay_buffer_kwargs": {"challenge_ratio": 0.2}}, "no player"),
        (Spaces, {"train_freq": (5, "minutes")}, "unit of the `train_freq`"),
    ],
)
def test_bad_arguments(env, kwargs, message):
    with pytest.raises(ValueError, match=message):
        Dreamer(**{"policy": "MlpPolicy", "env": env(), "device": "cpu", **kwargs})


def test_what_nobody_reads_is_told(tmp_path):
    parts = {"vector": spaces.Box(-1, 1, (2,)), "kind": spaces.Discrete(3), "table": spaces.Box(0, 9, (4, 2), np.int64)}
    parts |= {"cloud": spaces.Box(-1, 1, (50, 3)), "stack": spaces.Box(-1, 1, (4, 3))}  # the one is read on request only

    def make_dreamer(**kwargs):
        return Dreamer("MultiInputPolicy", Spaces(spaces.Dict(parts)), preset=TINY, device="cpu", buffer_size=100, **kwargs)

    with pytest.warns(UserWarning, match="Dreamer reads images and vectors") as told:
        make_dreamer().save(tmp_path / "model")
    assert sorted(str(one.message).split("'")[1] for one in told) == ["kind", "stack", "table"]
    assert "FlattenObservation" in next(str(one.message) for one in told if "'stack'" in str(one.message))
    assert all(one.filename == __file__ for one in told)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        make_dreamer(keys=["vector", "cloud"])
        Dreamer.load(tmp_path / "model", device="cpu")


@pytest.mark.skipif(th.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there():
    with pytest.raises(ValueError, match="no GPU"):
        Dreamer("MlpPolicy", "Pendulum-v1", device="cuda")


def test_a_plain_episode_buffer_will_do():
    assert type(make(replay_buffer_class=EpisodeBuffer).learn(80).replay_buffer) is EpisodeBuffer


def test_a_buffer_of_another_environment(tmp_path):
    model = counting().learn(30)
    model.save_replay_buffer(tmp_path / "one")
    with pytest.raises(ValueError, match="belongs to another environment"):
        make().load_replay_buffer(tmp_path / "one.pkl")
    with pytest.raises(ValueError, match="1 parallel environments"):
        counting(3, 4).load_replay_buffer(tmp_path / "one.pkl")
    other = SAC("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[8]), buffer_size=10)
    other.save_replay_buffer(tmp_path / "two")
    with pytest.raises(ValueError, match="learns from a CPMBuffer"):
        model.load_replay_buffer(tmp_path / "two.pkl")


def test_another_environment_is_refused():
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        make().set_env(make_vec_env("Pendulum-v1", 1))


class Breaks(Counting):
    """What it returns is not finite from step 50 on."""

    def __init__(self, where):
        super().__init__()
        self.where = where

    def step(self, action):
        observation, reward, *rest = super().step(action)
        if len(self.actions) > 50:
            if self.where == "reward":
                reward = np.nan
            else:
                observation[1] = np.inf
        return observation, reward, *rest


@pytest.mark.parametrize(
    "where, message", [("reward", "reward of nan"), ("observation", "NaN or infinite values in observation")]
)
def test_an_environment_that_gives_nan(where, message):
    model = make(Breaks(where), policy="MlpPolicy", learning_starts=20)
    with pytest.raises(ValueError, match=message):
        model.learn(200)
    assert all(np.isfinite(value).all() for value in weights(model).values())


def test_a_loss_that_is_not_finite_is_named_and_changes_nothing():
    model = counting().learn(30)
    with th.no_grad():
        model.challenger.world_model.reward_head[0].weight[0, 0] = th.nan
    before = weights(model)
    with pytest.raises(RuntimeError, match="'reward': nan"):
        model.train(1)
    assert all(np.array_equal(value, before[key], equal_nan=True) for key, value in weights(model).items())


def test_pretraining_comes_once_before_the_first_action_of_the_behavior():
    model = counting(learning_starts=20, train_freq=10, pretrain_steps=7).learn(40)
    assert model._n_updates == model.challenger.trained_updates == 1 + 7 + 1
    started = Dreamer(
        "MlpPolicy", Counting(), start_from=model, learning_starts=10, train_freq=10, pretrain_steps=7, device="cpu"
    )
    started.learn(20)
    assert started._n_updates == 1, "what has learnt already needs none"
