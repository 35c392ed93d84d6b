"""The whole method through stock SB3: two lines of user code, save and load, seeds, several environments, bad input."""

import gc
import os
import pickle
import signal
import warnings
import weakref

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DQN, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecNormalize

from sb3_cpm import ChallengerCallback, CPMBuffer, PointNetPolicy
from sb3_cpm.buffers import Demonstration
from sb3_cpm.envs.toy import ToyEnv
from sb3_cpm.envs.wrappers import DictObservation
from sb3_cpm.exploration import ExplorationVecEnv, without_exploration

TINY = dict(
    batch_size=4, sequence_length=12, cnn_depth=4, vector_units=16, stoch_size=4, deter_size=16, hidden_size=16, head_units=16,
    actor_units=16, critic_units=16, horizon=4, imagination_starts=8,
)  # fmt: skip


def make_callback(**kwargs):
    return ChallengerCallback(**{**dict(train_freq=10, challenger_kwargs=TINY), **kwargs})


def toy(keys=("state",), n_envs=1, **kwargs):
    return make_vec_env("sb3_cpm.envs.toy:CPMToy-v0", n_envs=n_envs, seed=0, env_kwargs=dict(keys=keys), **kwargs)


def make_model(env=None, model_class=SAC, policy="MultiInputPolicy", buffer_kwargs=None, **kwargs):
    arguments = dict(
        learning_starts=100, batch_size=16, buffer_size=2000, seed=0, device="cpu", policy_kwargs=dict(net_arch=[16])
    )
    return model_class(
        policy,
        toy() if env is None else env,
        replay_buffer_class=CPMBuffer,
        replay_buffer_kwargs=buffer_kwargs or {},
        **{**arguments, **kwargs},
    )


LENIENT = dict(filter_kwargs=dict(novelty_tolerance=1e5, relevance_tolerance=1e5))


@pytest.mark.parametrize("model_class", [SAC, TD3, TQC])
def test_stock_algorithms(model_class):
    model = make_model(model_class=model_class, buffer_kwargs=LENIENT)
    callback = make_callback()
    env = model.env
    model.learn(400, callback=callback)
    assert model.env is env, "the wrapper is taken off again"
    assert callback.challenger.trained_updates == pytest.approx(30, abs=1)
    buffer = model.replay_buffer
    assert buffer.counters.proposed == 6, "episodes that end before C's first update are not judged"
    assert buffer.counters.kept >= len(buffer.challenges) > 0
    assert 0.05 < callback.explored_share < 0.9


@pytest.mark.parametrize("keys", [("camera",), ("camera", "state"), ("camera", "pointcloud", "state")])
def test_images_vectors_and_both(keys):
    """P needs no image network of its own when there is something else to look at."""
    if keys == ("camera",):  # SB3's NatureCNN refuses 32x32 images, so P gets the pixels flat
        policy_kwargs = dict(net_arch=[16], normalize_images=False)
        env = make_vec_env(lambda: FlatCopy(gym.make("CPMToy-v0", keys=keys)), seed=0)
        model = make_model(
            env,
            buffer_kwargs=dict(player_keys=["flat"], **LENIENT),
            policy_kwargs=dict(**policy_kwargs, features_extractor_class=FlatOnly),
        )
        callback = make_callback(keys=["camera"])
    else:
        model = make_model(toy(keys), policy=PointNetPolicy, buffer_kwargs=LENIENT)
        callback = make_callback()
    model.learn(250, callback=callback)
    assert callback.challenger.keys == tuple(key for key in ("camera", "state") if key in keys)
    if keys != ("camera",):
        expected = tuple(key for key in ("pointcloud", "state") if key in keys)
        assert set(model.replay_buffer.player_keys) == set(expected), "no camera image is moved for P"
    assert model.replay_buffer.counters.proposed > 0


def test_images_that_vec_normalize_declares_anew():
    """C reads what the environment gives: the whole range of uint8 from black to white."""
    env = VecNormalize(toy(("camera", "state")), norm_obs_keys=["camera", "state"])
    model = make_model(env, policy=PointNetPolicy)
    callback = make_callback()
    model.learn(200, callback=callback)
    assert callback.challenger.trained_updates and callback.challenger.spec.ranges == {"camera": (0.0, 255.0)}
    batch = model.replay_buffer.sample_sequences(2, 4, ("camera", "state"))
    images = callback.challenger.spec.preprocess(batch.observations, th.device("cpu"))
    assert float(images.images.max()) > 0.0, "bright discs"


def test_going_on_without_the_buffer(tmp_path):
    """learning_starts counts from the run's beginning: said before training."""
    model = make_model(toy())
    model.learn(150, callback=make_callback())
    model.save(tmp_path / "model")
    resumed = SAC.load(tmp_path / "model", env=toy())
    with pytest.raises(ValueError, match="load_replay_buffer.* or begin with new experience: learning_starts=200"):
        resumed.learn(100, callback=make_callback(), reset_num_timesteps=False)
    resumed.learning_starts = 200
    resumed.learn(100, callback=make_callback(decay_steps=250), reset_num_timesteps=False)


def test_a_buffer_without_challenges_is_mentioned():
    """As Dreamer leaves it, which has no player."""
    model = make_model(toy())
    model.replay_buffer.challenge_ratio = 0
    with pytest.warns(UserWarning, match="has challenge_ratio=0.* will be given no challenges"):
        model.learn(10, callback=make_callback())


@pytest.mark.parametrize("decay", ["exponential", "linear"])
def test_a_callback_can_be_pickled(decay):
    callback = ChallengerCallback(decay=decay)
    again = pickle.loads(pickle.dumps(callback))
    assert [again.decay(left) for left in (1.0, 0.5, 0.0)] == [callback.decay(left) for left in (1.0, 0.5, 0.0)]


class FlatCopy(gym.ObservationWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Dict(
            {"camera": env.observation_space["camera"], "flat": spaces.Box(0, 1, (64,), np.float32)}
        )

    def observation(self, observation):
        pixels = observation["camera"][::4, ::4, 0].astype(np.float32).ravel() / 255
        return {**observation, "flat": pixels}


def _flat_only():
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class FlatOnlyExtractor(BaseFeaturesExtractor):
        player_keys = ("flat",)

        def __init__(self, observation_space):
            super().__init__(observation_space, 64)

        def forward(self, observations):
            return observations["flat"]

    return FlatOnlyExtractor


FlatOnly = _flat_only()


@pytest.mark.parametrize("vec_env_class", [None, SubprocVecEnv])
def test_three_environments(vec_env_class):
    model = make_model(toy(n_envs=3, vec_env_cls=vec_env_class), learning_starts=150, buffer_kwargs=LENIENT, train_freq=4)
    callback = make_callback(unit="segment")
    model.learn(750, callback=callback)
    assert model.replay_buffer.counters.proposed == 12  # 3 x 5 episodes, the first of each before C knows anything
    assert {episode.env_idx for episode in model.replay_buffer.episodes} == {0, 1, 2}
    assert model.replay_buffer.challenges
    model.env.close()


class ExecutedActions(gym.Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.executed = []

    def step(self, action):
        self.executed.append(np.array(action))
        return self.env.step(action)


def test_d_stores_what_was_executed():
    env = ExecutedActions(DictObservation(gym.make("Pendulum-v1")))  # actions within [-2, 2]
    model = make_model(env, learning_starts=200)
    model.learn(500, callback=make_callback(decay="constant", decay_kwargs=dict(start=0.5)))
    stored = model.replay_buffer.actions[:500, 0] * 2
    np.testing.assert_allclose(stored, np.array(env.executed), atol=1e-5)


@pytest.mark.slow
def test_same_seed_same_run_and_another_seed_another():
    def run(seed):
        model = make_model(toy(("camera", "state")), policy=PointNetPolicy, seed=seed, buffer_kwargs=LENIENT)
        callback = make_callback()
        model.learn(300, callback=callback)
        weights = th.cat([p.flatten() for p in (*model.policy.parameters(), *callback.challenger.world_model.parameters())])
        return weights.detach(), model.replay_buffer.coefficients, model.replay_buffer.rewards.copy()

    (weights, coefficients, rewards), (same_weights, same_coefficients, same_rewards) = run(3), run(3)
    assert th.equal(weights, same_weights) and coefficients == same_coefficients
    np.testing.assert_array_equal(rewards, same_rewards)
    assert not th.equal(weights, run(4)[0])


def test_save_load_continue(tmp_path):
    model = make_model(buffer_kwargs=LENIENT)
    callback = make_callback()
    model.learn(400, callback=callback)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    callback.save(tmp_path / "challenger.pt")
    proposed, coefficients = model.replay_buffer.counters.proposed, model.replay_buffer.coefficients

    loaded = SAC.load(tmp_path / "model", env=toy(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer.coefficients == coefficients
    assert len(loaded.replay_buffer.challenges) == len(model.replay_buffer.challenges)
    resumed = make_callback(load_path=tmp_path / "challenger.pt", decay="exponential", decay_steps=600)
    loaded.learn(200, callback=resumed, reset_num_timesteps=False)
    assert loaded.num_timesteps == 600 and resumed.epsilon == pytest.approx(0.05 + 0.75 * np.exp(-5.0))
    assert resumed.challenger.trained_updates > callback.challenger.trained_updates
    assert loaded.replay_buffer.counters.proposed > proposed


def test_a_second_learn_goes_on_with_the_same_challenger():
    model, callback = make_model(), make_callback()
    model.learn(200, callback=callback)
    challenger, updates = callback.challenger, callback.challenger.trained_updates
    model.learn(130, callback=callback)
    assert callback.challenger is challenger and challenger.trained_updates > updates
    lengths = [episode.length for episode in model.replay_buffer.episodes]
    assert lengths == [50] * 6, "130 steps leave 30 of an unfinished episode"
    with pytest.raises(ValueError, match="other spaces"):
        make_model(toy(("camera", "state")), policy=PointNetPolicy).learn(10, callback=callback)


def test_a_used_buffer_that_meets_a_new_challenger():
    model, callback = make_model(buffer_kwargs=LENIENT), make_callback(decay="constant")
    model.learn(300, callback=callback)
    assert model.replay_buffer.challenges
    with pytest.warns(UserWarning, match=r"holds \d+ challenges, .* of an earlier challenger.*load_path=.*resume\(\) keep"):
        model.learn(10, callback=make_callback(decay="constant"), reset_num_timesteps=False)
    model.learn(10, callback=callback, reset_num_timesteps=False)


@pytest.mark.parametrize("before_learn", [True, False])
def test_the_state_of_a_callback(before_learn):
    """C's next training comes when it would have come, with the same networks."""
    model, callback = make_model(), make_callback(train_freq=70, decay="constant")
    model.learn(330, callback=callback)
    assert model.replay_buffer.episodes_ended and callback.challenger.trained_updates == 4  # at 101, 171, 241 and 311
    state = pickle.loads(pickle.dumps(callback.state_dict()))
    again = ChallengerCallback(**callback.arguments)
    assert again.arguments == callback.arguments
    if not before_learn:
        again.init_callback(model)
    again.load_state_dict(state)
    model.learn(50, callback=again, reset_num_timesteps=False)
    assert again.challenger.trained_updates == 4
    ours, theirs = (one.challenger.world_model.state_dict() for one in (callback, again))
    assert all(th.equal(ours[name], theirs[name]) for name in ours)
    again.load_state_dict(state)
    model.learn(1, callback=again, reset_num_timesteps=False)
    assert again.challenger.trained_updates == 5, "at 381"


def test_the_state_of_a_challenger_of_other_sizes():
    model, callback = make_model(), make_callback()
    model.learn(10, callback=callback)
    other = make_callback(challenger_kwargs={**TINY, "hidden_size": 17})
    other.init_callback(model)
    with pytest.raises(ValueError, match="world_model"):
        other.load_state_dict(callback.state_dict())


def test_vecnormalize():
    env = VecNormalize(toy(), norm_obs_keys=["state"])
    model = make_model(env, buffer_kwargs=LENIENT)
    model.learn(300, callback=make_callback())
    assert np.abs(model.replay_buffer.observations["state"]).max() <= 1, "D holds what the environment gave"
    assert model.get_vec_normalize_env() is env and model.env is env


def test_evaluation_and_checkpoints_beside_vecnormalize(tmp_path):
    """SB3 walks the wrappers of training and evaluation in step to copy the statistics, and ours must not be among them."""
    env, evaluation_env = VecNormalize(toy()), VecNormalize(toy(), training=False, norm_reward=False)
    seen = set()

    class WhatOthersSee(BaseCallback):
        def _on_step(self):
            seen.add(self.training_env)
            return True

    evaluation = EvalCallback(evaluation_env, n_eval_episodes=1, eval_freq=60, verbose=0)
    checkpoint = CheckpointCallback(120, tmp_path, save_vecnormalize=True)
    model, callback = make_model(env, buffer_kwargs=LENIENT), make_callback(decay="constant")
    model.learn(240, callback=[evaluation, callback, checkpoint, WhatOthersSee()])
    assert np.isfinite(evaluation.last_mean_reward) and evaluation.n_calls == 240
    assert evaluation_env.obs_rms["state"].count == env.obs_rms["state"].count, "evaluated in the last step, too"
    assert seen == {env} and callback.explored_share == pytest.approx(0.8, abs=0.1) and model.env is env
    assert (tmp_path / "rl_model_vecnormalize_240_steps.pkl").exists()
    model.learn(60, callback=[evaluation, callback], reset_num_timesteps=False)
    assert callback.explored_share == pytest.approx(0.8, abs=0.2) and model.env is env


def test_row_mix_with_evaluation_progress_bar_and_tensorboard(tmp_path):
    model = make_model(buffer_kwargs=dict(mix="row", **LENIENT))
    logger = configure(str(tmp_path), ["csv", "tensorboard"])
    model.set_logger(logger)
    evaluation = EvalCallback(toy(), n_eval_episodes=1, eval_freq=150, verbose=0)
    model.learn(420, callback=[make_callback(), evaluation], progress_bar=True)
    logger.close()
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    names = {"rollout/exploration_rate", "challenger/world_model_loss", "challenger/exp_scale"}
    names |= {f"challenge/{name}" for name in ("kept", "c_emb", "w3", "reward_memory", "reward_origin", "acceptance_novel")}
    assert names <= set(header)
    assert any(path.name.startswith("events.out.tfevents") for path in tmp_path.iterdir())


@pytest.mark.parametrize("how", ["trajectory", "call"])
def test_reward_memory_of_several_environments(how):
    """Three episodes end in the same step: a call of the report's agent with three new trajectories."""
    kwargs = dict(filter_kwargs=dict(reward_memory_update=how))
    model = make_model(toy(n_envs=3), buffer_kwargs=kwargs, learning_starts=150, buffer_size=20_000)
    model.learn(310, callback=make_callback())
    buffer, memory = model.replay_buffer, None
    ended = buffer.rewards[:100].reshape(2, 50, 3).mean(axis=1)  # two episodes of 50 steps in each environment
    for means in [[mean] for mean in ended.ravel()] if how == "trajectory" else ended:
        memory = np.mean(means) if memory is None else 0.99 * memory + 0.01 * np.mean(means)
    assert buffer.coefficients["reward_memory"] == pytest.approx(memory, rel=1e-5)


@pytest.mark.parametrize("length, warmup_steps, told", [(5, 5, 1), (6, 5, 1), (7, 5, 0), (5, 3, 0), (2, 1, 1)])
def test_episodes_too_short_for_any_challenge_are_told_of_once(length, warmup_steps, told):
    env = gym.make("sb3_cpm.envs.toy:CPMToy-v0", keys=("state",), max_episode_steps=length)
    model = make_model(env, learning_starts=20, buffer_kwargs=dict(warmup_steps=warmup_steps))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        model.learn(180, callback=make_callback())
    short = [str(warning.message) for warning in found if "episodes in a row" in str(warning.message)]
    assert len(short) == told
    if told:
        assert f"fewer than {warmup_steps + 2} steps" in short[0] and f"warmup_steps={warmup_steps}" in short[0]
        assert not model.replay_buffer.counters.kept


def learn_in_portions(portions, **kwargs):
    """:return: share of the actions that C gave in 600 steps, and epsilon after each portion"""
    model = make_model(learning_starts=100, train_freq=10)
    callback = make_callback(**kwargs, unit="step", gradient_steps=0)
    shares, epsilons = [], []
    for _ in range(portions):
        model.learn(600 // portions, callback=callback, reset_num_timesteps=False)
        shares.append(callback.explored_share)
        epsilons.append(callback.epsilon)
    return np.mean(shares), epsilons


def test_a_decay_over_a_number_of_steps_runs_through_all_portions():
    decay = dict(decay="linear", decay_kwargs=dict(start=0.9, floor=0.1), decay_steps=600)
    at_once, _ = learn_in_portions(1, **decay)
    in_portions, epsilons = learn_in_portions(6, **decay)
    assert at_once == pytest.approx(0.5, abs=0.06) and in_portions == pytest.approx(0.5, abs=0.06)
    assert epsilons == pytest.approx([0.9 - 0.8 * n / 6 for n in range(1, 7)])
    _, epsilons = learn_in_portions(2, **{**decay, "decay_steps": 400})
    assert epsilons == pytest.approx([0.3, 0.1]), "after its end it stays at the floor"


def test_a_decay_that_begins_again_in_every_portion_is_told_of_once():
    with pytest.warns(UserWarning, match="had fallen to 0.1 and begins again at 0.5: .*decay_steps=") as found:
        share, _ = learn_in_portions(6, decay="linear", decay_kwargs=dict(start=0.9, floor=0.1))
    assert len(found) == 1 and share < 0.35, "C gives what the decay has for the end most of the time"
    learn_in_portions(3, decay="constant")  # has no end to begin again from


def test_a_decay_that_begins_again_after_loading_is_told_of_too(tmp_path):
    model = make_model(train_freq=10)
    model.learn(150, callback=make_callback(decay="exponential", gradient_steps=0))
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = SAC.load(tmp_path / "model", toy())
    loaded.load_replay_buffer(tmp_path / "buffer")
    with pytest.warns(UserWarning, match="had fallen to 0.0551 and begins again at 0.112"):
        loaded.learn(150, callback=make_callback(decay="exponential", gradient_steps=0), reset_num_timesteps=False)


def test_starting_anew_begins_the_decay_anew_without_a_word():
    model, callback = make_model(train_freq=10), make_callback(decay="linear", decay_kwargs={}, gradient_steps=0)
    for _ in range(2):
        model.learn(150, callback=callback)
    assert callback.epsilon == pytest.approx(0.05)


@pytest.mark.parametrize("value, message", [(0, "an integer of at least 1, got 0"), (1e5, "Write 100000"), ("1e5", "text")])
def test_decay_steps_are_checked(value, message):
    with pytest.raises(ValueError, match=f"decay_steps must be .*{message}"):
        ChallengerCallback(decay_steps=value)


class RaisesAt(BaseCallback):
    def __init__(self, step, action):
        super().__init__()
        self.step, self.action = step, action

    def _on_step(self):
        if self.num_timesteps == self.step:
            self.action()
        return True


@pytest.fixture
def ctrl_c():
    """Python's own handler, even where the tests run in the background and the shell had Ctrl-C ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class InterruptedSAC(SAC):
    """Somebody presses Ctrl-C while P trains."""

    def train(self, gradient_steps, batch_size):
        if self.num_timesteps == 230:
            os.kill(os.getpid(), signal.SIGINT)
        super().train(gradient_steps, batch_size)


@pytest.mark.parametrize("while_p_trains", [False, True])
@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_loses_nothing(while_p_trains, tmp_path):
    model = make_model(model_class=InterruptedSAC if while_p_trains else SAC)
    callback, env = make_callback(), model.env
    press = RaisesAt(230, lambda: None if while_p_trains else os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        model.learn(400, callback=[callback, press])
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert len(model.replay_buffer.episodes) == 4
    explored = callback.exploration_env.n_explored
    evaluate_policy(model, model.get_env(), 1)
    assert callback.exploration_env.n_explored == explored, "C does not act where P is evaluated"
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    callback.save(tmp_path / "challenger.pt")
    SAC.load(tmp_path / "model", env=model.get_env()).load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    model.learn(50, callback=callback, reset_num_timesteps=False)
    assert model.env is env


@pytest.mark.usefixtures("ctrl_c")
def test_a_handler_of_the_users_that_lets_the_run_go_on():
    """Many set a flag on Ctrl-C and stop at a moment of their choice."""
    asked = []

    class StopsAfterwards(BaseCallback):
        def _on_step(self):
            return not asked or self.num_timesteps < 230

    def handler(signum, frame):
        asked.append(signum)

    signal.signal(signal.SIGINT, handler)
    model, callback = make_model(), make_callback(decay="constant", decay_kwargs=dict(start=1.0))
    press = RaisesAt(170, lambda: os.kill(os.getpid(), signal.SIGINT))
    model.learn(400, callback=[callback, press, StopsAfterwards()])
    assert model.num_timesteps == 230 and signal.getsignal(signal.SIGINT) is handler
    assert callback.explored_share == 1.0, "C was not taken off when the signal came"


def test_an_exception_of_another_callback_leaves_nothing_behind():
    model, callback = make_model(), make_callback(decay="constant", decay_kwargs=dict(start=1.0))
    env = model.env
    with pytest.raises(ZeroDivisionError):
        model.learn(400, callback=[callback, RaisesAt(130, lambda: 1 / 0)])
    assert model.env is env
    explored, size = callback.exploration_env.n_explored, model.replay_buffer.size()
    evaluate_policy(model, model.get_env(), 1)
    for reset in (True, False):  # SB3 tells no callback that its learn() is over
        with pytest.raises(ValueError, match=r"callback=ChallengerCallback\(\)"):
            model.learn(50, reset_num_timesteps=reset)
    assert callback.exploration_env.n_explored == explored and model.replay_buffer.size() == size
    model.learn(100, callback=callback, reset_num_timesteps=False)
    assert callback.explored_share == 1.0 and model.env is env


def test_one_challenger_per_learn():
    model = make_model()
    with pytest.raises(ValueError, match="two ChallengerCallbacks"):
        model.learn(200, callback=[make_callback(), make_callback()])
    assert model.env is without_exploration(model.env)
    model.learn(200, callback=make_callback())


def test_a_function_as_decay_takes_no_arguments_for_decays_by_name():
    with pytest.raises(ValueError, match="are for decays by name"):
        make_callback(decay=lambda remaining: 0.5 * remaining, decay_kwargs=dict(start=0.5))


def test_player_keys_that_the_player_cannot_do_without():
    model = make_model(toy(keys=("pointcloud", "state")), buffer_kwargs=dict(player_keys=["state"]))
    with pytest.raises(ValueError, match=r"lack \['pointcloud'\], which the player's CombinedExtractor reads"):
        model.learn(200, callback=make_callback())


def test_an_exception_keeps_no_model_alive():
    """SB3 tells no callback of it, and in a notebook there may be many."""
    buffers = []
    for _ in range(3):
        model = make_model()
        buffers.append(weakref.ref(model.replay_buffer))
        with pytest.raises(ZeroDivisionError):
            model.learn(200, callback=[make_callback(), RaisesAt(130, lambda: 1 / 0)])
        del model
    gc.collect()
    assert [buffer() for buffer in buffers] == [None] * 3


def test_an_exception_while_p_trains_leaves_nothing_that_acts():
    model, callback = make_model(), make_callback(decay="constant", decay_kwargs=dict(start=1.0))
    batch_size, model.batch_size = model.batch_size, "16"
    with pytest.raises(TypeError):
        model.learn(400, callback=callback)
    model.batch_size = batch_size
    explored = callback.exploration_env.n_explored
    evaluate_policy(model, model.get_env(), 1)
    with pytest.raises(ValueError, match=r"callback=ChallengerCallback\(\)"):
        model.learn(50)
    assert callback.exploration_env.n_explored == explored


def test_an_environment_that_dies_takes_the_wrapper_off():
    class Dies(gym.Wrapper):
        n = 0

        def step(self, action):
            self.n += 1
            if self.n == 120:
                raise ConnectionResetError
            return self.env.step(action)

    model = make_model(make_vec_env(lambda: Dies(gym.make("CPMToy-v0", keys=("state",)))))
    with pytest.raises(RuntimeError, match="died at step 120"):
        model.learn(400, callback=make_callback())
    assert not isinstance(model.env, ExplorationVecEnv)
    assert len(model.replay_buffer.episodes) == 2
    model.set_env(toy())
    model.learn(100, callback=make_callback(), reset_num_timesteps=False)
    assert [episode.length for episode in model.replay_buffer.episodes][:4] == [50, 50, 19, 50]


class Goals(gym.Env):
    """Hindsight needs the environment itself: it computes the rewards."""

    point = spaces.Box(-10, 10, (2,), np.float32)
    observation_space = spaces.Dict(observation=point, achieved_goal=point, desired_goal=point)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n, self.at = 0, np.zeros(2, np.float32)
        return self.observe(), {}

    def observe(self):
        return dict(observation=self.at.copy(), achieved_goal=self.at.copy(), desired_goal=np.ones(2, np.float32))

    def compute_reward(self, achieved, desired, info):
        return -np.linalg.norm(achieved - desired, axis=-1)

    def step(self, action):
        self.n += 1
        self.at = (self.at + 0.1 * action).astype(np.float32)
        return self.observe(), float(self.compute_reward(self.at, np.ones(2), {})), False, self.n >= 10, {}


def test_hindsight_goes_on_in_new_environments_after_a_process_died():
    """As the message of the error promises."""
    env = SubprocVecEnv([Goals])
    model = make_model(env, learning_starts=30, train_freq=7, buffer_kwargs=dict(n_sampled_goal=4))
    callback = make_callback(decay="constant")
    with pytest.raises(RuntimeError, match=r"goes on after model.set_env\(\)"):
        model.learn(100, callback=[callback, RaisesAt(60, lambda: env.processes[0].kill())])
    demonstrated = [Goals().reset()[0] for _ in range(6)]
    observations = {key: np.stack([obs[key] for obs in demonstrated]) for key in demonstrated[0]}
    model.replay_buffer.add_demonstrations([Demonstration(observations, np.zeros((5, 2), np.float32), np.ones(5))])
    model.replay_buffer.mix = "row"
    new = DummyVecEnv([Goals])
    model.set_env(new)
    model.learn(50, callback=callback, reset_num_timesteps=False)
    assert model.num_timesteps >= 110 and model.replay_buffer.env is model.replay_buffer.demonstrations.env is new


@pytest.mark.parametrize(
    "n_envs, player, expected",
    [(1, (1, "step"), 40), (1, (100, "step"), 40), (1, (2, "episode"), 40), (50, (1, "step"), 41)],
)
def test_how_often_c_trains_does_not_depend_on_the_length_of_rollouts(n_envs, player, expected):
    """Every 10 steps over all environments, from the end of learning_starts on; there is no backlog of the steps before."""
    learning_starts = 100 * n_envs
    model = make_model(toy(n_envs=n_envs), learning_starts=learning_starts, train_freq=player, buffer_size=20_000)
    callback = make_callback(decay="constant")
    model.learn(learning_starts + 400, callback=callback)
    updates = callback.challenger.trained_updates
    assert updates == pytest.approx(expected, abs=1)
    model.learn(95, callback=callback, reset_num_timesteps=False)
    steps = model.num_timesteps - learning_starts - 400
    assert callback.challenger.trained_updates - updates == pytest.approx(steps / 10, abs=1)


def test_the_moments_at_which_c_trains_with_short_rollouts():
    """One environment, one step at a time: the first update after learning_starts, then every train_freq steps."""
    moments, model, callback = [], make_model(), make_callback(train_freq=13, gradient_steps=2, decay="constant")

    class Counts(BaseCallback):
        def _on_rollout_end(self):
            while len(moments) < callback.challenger.trained_updates:
                moments.append(self.num_timesteps)

        def _on_step(self):
            return True

    model.learn(150, callback=[callback, Counts()])
    assert moments == [101, 101, 114, 114, 127, 127, 140, 140]
    moments[:] = [0] * 8
    model.learn(30, callback=[callback, Counts()], reset_num_timesteps=False)
    assert moments[8:] == [163, 163, 176, 176]


class SharedInfos(VecEnvWrapper):
    """Gives the same dict for all environments and steps in which there is nothing to say."""

    def __init__(self, venv):
        super().__init__(venv)
        self.executed, self.nothing = [], {}

    def reset(self):
        return self.venv.reset()

    def step_async(self, actions):
        self.executed.append(np.array(actions))
        self.venv.step_async(actions)

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        return obs, rewards, dones, infos if dones.any() else [self.nothing] * self.num_envs


def test_d_stores_what_was_executed_where_environments_share_their_infos():
    env = SharedInfos(toy(n_envs=3))
    model = make_model(env, learning_starts=150)
    model.learn(300, callback=make_callback(decay="constant", decay_kwargs=dict(start=0.4)))
    np.testing.assert_allclose(model.replay_buffer.actions[:100], np.array(env.executed), atol=1e-5)
    assert env.nothing == {}


def test_time_table_covers_the_run():
    callback = make_callback()
    make_model().learn(250, callback=callback)
    expected = {"simulate+render", "C acts", "C evaluates", "C trains", "P trains", "P acts", "buffer", "bookkeeping"}
    assert set(callback.stopwatch.seconds) == expected
    assert all(seconds > 0 for seconds in callback.stopwatch.seconds.values())
    assert not callback.stopwatch._open


# ---------------------------------------------------------------------- bad input, before any training


def never_step(env):
    def step(*args):
        raise AssertionError("a step was taken")

    env.step_wait = step
    return env


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: make_model("Pendulum-v1", policy="MlpPolicy"), "sb3_cpm.envs.DictObservation"),
        (lambda: CrossQ("MlpPolicy", "Pendulum-v1", replay_buffer_class=CPMBuffer), "sb3-contrib's CrossQ has none"),
        (lambda: CrossQ("MlpPolicy", "Pendulum-v1").learn(10, callback=make_callback()), "sb3-contrib's CrossQ has none"),
        (lambda: DQN("MlpPolicy", "CartPole-v1").learn(10, callback=make_callback()), "Dict observation space"),
        (lambda: PPO("MultiInputPolicy", never_step(toy())).learn(10, callback=make_callback()), "off-policy"),
        (
            lambda: SAC("MultiInputPolicy", never_step(toy())).learn(10, callback=make_callback()),
            "replay_buffer_class=CPMBuffer",
        ),
        (
            lambda: make_model(never_step(toy()), learning_starts=49).learn(10, callback=make_callback()),
            "learning_starts=50 or more",
        ),
        (lambda: make_model(never_step(toy()), buffer_size=60).learn(10, callback=make_callback()), "buffer_size=100 or more"),
        (
            lambda: make_model(never_step(toy(n_envs=3)), learning_starts=100).learn(10, callback=make_callback()),
            "learning_starts=150",
        ),
        (lambda: make_model(buffer_kwargs=dict(challenge_ratio=1.5)), r"\[0, 1\], got 1.5"),
        (lambda: make_callback(decay="expnential"), "Unknown decay 'expnential'. Did you mean 'exponential'"),
        (lambda: make_callback(unit="minute"), "unit must be"),
        (lambda: make_callback(train_freq=0), "train_freq"),
        (lambda: make_callback(segment_length=0), "segment_length"),
        (lambda: make_callback(train_freq=25.0), r"train_freq must be an integer of at least 1, got 25.0. Write 25\."),
        (lambda: make_callback(train_freq="x"), "train_freq must be an integer .* got 'x'"),
        (lambda: make_callback(gradient_steps=1.5), "gradient_steps must be an integer of at least 0, got 1.5"),
        (lambda: make_callback(segment_length=2.5), "segment_length must be an integer"),
        (lambda: make_callback(decay_kwargs=dict(strat=0.9)), "decay_kwargs: unknown key 'strat'. Did you mean 'start'"),
        (lambda: make_callback(decay_kwargs=dict(floor="1e-2")), r"floor must be .* got '1e-2'. That is text: .* 1.0e-2"),
        (lambda: make_callback(challenger_kwargs=["horizon"]), r"challenger_kwargs must be arguments by name .* got \['horiz"),
        (lambda: make_callback(challenger_kwargs=dict(device="cpu")), "give 'device' to ChallengerCallback itself"),
        (lambda: make_callback(challenger_kwargs=dict(horizn=3)), "challenger_kwargs: .*Did you mean 'horizon'"),
        (lambda: make_callback(preset=dict(horizn=3)), "Did you mean 'horizon'"),
        (lambda: make_callback(uncertainty_class="plan2explor"), "Did you mean 'plan2explore'"),
        (lambda: make_callback(uncertainty_kwargs=dict(head=3)), "uncertainty_kwargs: .*Did you mean 'heads'"),
        (lambda: make_callback(preset="reprt"), "Did you mean 'report'"),
        (lambda: make_model(never_step(toy())).learn(10, callback=make_callback(keys=["stat"])), "stat"),
        (lambda: make_model(never_step(toy())).learn(10, callback=make_callback(load_path="nowhere.pt")), "nowhere.pt"),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def unpicklable_spec():
    return gym.wrappers.TransformReward(gym.make("CPMToy-v0", keys=("state",)), lambda reward: 2 * reward)


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_spec_that_no_process_can_send():
    """Asking a worker for its spec would kill it; the number alone says what learning_starts must be."""
    env = SubprocVecEnv([unpicklable_spec] * 2, start_method="fork")
    with pytest.raises(ValueError, match="learning_starts=100 or more"):
        make_model(env, learning_starts=99).learn(10, callback=make_callback())
    make_model(env).learn(110, callback=make_callback())
    env.close()


def test_a_time_limit_around_an_environment_that_is_not_registered():
    """It has no spec, so gymnasium's wrapper has none either, but it knows when it ends an episode."""
    env = DummyVecEnv([lambda: gym.wrappers.TimeLimit(ToyEnv(keys=("state",)), 30)] * 2)
    with pytest.raises(ValueError, match="up to 30 steps in each of 2 environments.*learning_starts=60 or more"):
        make_model(env, learning_starts=59).learn(10, callback=make_callback())
    with pytest.raises(ValueError, match="buffer_size=120 or more"):
        make_model(env, buffer_size=119).learn(10, callback=make_callback())
    make_model(env, learning_starts=60).learn(70, callback=make_callback())


def test_processes_without_a_time_limit():
    env = SubprocVecEnv([Goals])  # its workers die of questions that they cannot answer
    make_model(env, learning_starts=20).learn(30, callback=make_callback())
    env.close()


def test_discrete_actions():
    class Discrete(gym.Wrapper):
        action_space = spaces.Discrete(3)

    with pytest.raises(ValueError, match="continuous actions"):
        DQN("MultiInputPolicy", Discrete(gym.make("CPMToy-v0", keys=("state",))), replay_buffer_class=CPMBuffer)


def test_images_of_unequal_size():
    class TwoCameras(gym.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            big = spaces.Box(0, 255, (64, 64, 3), np.uint8)
            self.observation_space = spaces.Dict({**env.observation_space.spaces, "big": big})

        def observation(self, observation):
            return {**observation, "big": np.zeros((64, 64, 3), np.uint8)}

    model = make_model(TwoCameras(gym.make("CPMToy-v0")), policy=PointNetPolicy)
    with pytest.raises(ValueError, match=r"(?s)camera.*big|big.*camera"):
        model.learn(10, callback=make_callback())


def test_what_neither_player_nor_challenger_reads_is_told():
    class WithDiscrete(gym.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            self.observation_space = spaces.Dict({**env.observation_space.spaces, "mode": spaces.Discrete(3)})

        def observation(self, observation):
            return {**observation, "mode": 1}

    env = WithDiscrete(gym.make("CPMToy-v0"))
    with pytest.warns(UserWarning, match="Neither player nor challenger reads 'mode'") as told:
        make_model(env, policy=PointNetPolicy).learn(10, callback=make_callback())
    assert len(told) == 1  # neither the camera, which C reads, nor the point cloud, which P reads
    env = WithDiscrete(gym.make("CPMToy-v0", keys=("state",)))
    model, callback = make_model(env), make_callback()
    with pytest.warns(UserWarning, match="challenger cannot read 'mode' .*Let a wrapper make it a vector"):
        model.learn(10, callback=callback)  # SB3's own policy reads everything
    model.learn(10, callback=callback)  # told once
    make_model(env, policy=PointNetPolicy).learn(10, callback=make_callback(keys=["state"]))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (4, 3), np.float32),  # stacked states
        spaces.Box(-1, 1, (2, 10), np.float64),
        spaces.Box(0, 9, (3, 3), np.int64),
        spaces.MultiBinary(4),
        spaces.Box(0, 255, (2, 8, 8, 3), np.uint8),  # stacked images
    ],
)
def test_what_the_challenger_cannot_read_is_told_beside_a_policy_that_reads_everything(space):
    class With(gym.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            self.observation_space = spaces.Dict({**env.observation_space.spaces, "more": space})

        def observation(self, observation):
            return {**observation, "more": np.zeros(space.shape, space.dtype)}

    with pytest.warns(UserWarning, match=r"(?s)challenger cannot read 'more'.*name the `keys` to read") as told:
        make_model(With(gym.make("CPMToy-v0", keys=("state",)))).learn(4, callback=make_callback())
    assert len(told) == 1


def test_the_buffer_without_its_callback():
    with pytest.raises(ValueError, match=r"callback=ChallengerCallback\(\)"):
        make_model().learn(10)


def test_saving_before_there_is_a_challenger():
    with pytest.raises(RuntimeError, match="learn"):
        make_callback().save("challenger.pt")
    assert isinstance(CallbackList([make_callback()]), BaseCallback)
