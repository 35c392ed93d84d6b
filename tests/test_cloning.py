"""Clones: an actor learns what demonstrations do, and nothing else of the model changes."""

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_cpm import PointNetPolicy
from sb3_cpm.buffers import CPMBuffer, Demonstration
from sb3_cpm.imitation import CloneCallback, clone, record_demonstrations
from sb3_cpm.imitation.cloning import ActionLoss, _keys_of_actor, actor_parameters
from sb3_cpm.zoo.policies import PointNetActorCriticPolicy

LOW, HIGH = np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32)
SLOPE = np.array([[0.5, -0.2], [0.1, 0.3], [-0.4, 0.2]], np.float32)


class Vectors(gym.Env):
    """A vector of three numbers; the expert's action is linear in them."""

    observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = spaces.Box(LOW, HIGH)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._observation(), 0.0, False, self.steps == 10, {}

    def _observation(self) -> np.ndarray:
        return self.np_random.uniform(-1, 1, 3).astype(np.float32)


def scaled(observations: np.ndarray) -> np.ndarray:
    """The expert's actions within [-1, 1]."""
    return observations @ SLOPE


def linear_demonstrations(n: int = 20, seed: int = 0, scale: float = 1.0) -> list[Demonstration]:
    generator = np.random.default_rng(seed)
    found = []
    for _ in range(n):
        observations = generator.uniform(-1, 1, (11, 3)).astype(np.float32)
        actions = LOW + (scaled(observations[:-1]) + 1) / 2 * (HIGH - LOW)
        found.append(Demonstration({"state": observations * scale}, actions.astype(np.float32), np.zeros(10)))
    return found


def make(kind: type[BaseAlgorithm], env: VecEnv | None = None, policy: Any = "MlpPolicy", **kwargs: Any) -> BaseAlgorithm:
    if kind in (PPO, A2C):
        kwargs = {"n_steps": 10, **({"batch_size": 10} if kind is PPO else {}), **kwargs}
    else:
        kwargs = {"buffer_size": 100, **kwargs}
    return kind(policy, env or DummyVecEnv([Vectors]), seed=0, device="cpu", **{"policy_kwargs": {"net_arch": [32]}, **kwargs})


def error_of(model: BaseAlgorithm, seed: int = 1) -> float:
    """Mean square error of a model's actions, scaled to [-1, 1], on what it has not seen."""
    observations = np.random.default_rng(seed).uniform(-1, 1, (500, 3)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=True)
    return float(np.mean((2 * (actions - LOW) / (HIGH - LOW) - 1 - scaled(observations)) ** 2))


def state_of(module: th.nn.Module) -> dict[str, th.Tensor]:
    return {name: one.detach().clone() for name, one in module.state_dict().items()}


def changed(before: dict[str, th.Tensor], module: th.nn.Module) -> set[str]:
    return {name for name, one in module.state_dict().items() if not th.equal(one, before[name])}


def error_on(model: BaseAlgorithm, demonstrations: list[Demonstration]) -> float:
    """Mean square error of a model's actions on what was demonstrated."""
    errors = []
    for one in demonstrations:
        observations: Any = {key: rows[:-1] for key, rows in one.observations.items()}
        if not isinstance(model.observation_space, spaces.Dict):
            observations = observations["state"]
        errors.append((model.predict(observations, deterministic=True)[0] - one.actions) ** 2)
    return float(np.concatenate(errors).mean())


def contrib() -> Any:
    return pytest.importorskip("sb3_contrib").TQC


@pytest.mark.parametrize("name", ["PPO", "A2C", "SAC", "TQC", "TD3", "DDPG"])
def test_a_linear_expert_is_recovered_and_nothing_but_the_actor_changes(name: str) -> None:
    kind = {"PPO": PPO, "A2C": A2C, "SAC": SAC, "TD3": TD3, "DDPG": DDPG}.get(name) or contrib()
    model = make(kind)
    before, optimizers = state_of(model.policy), copy.deepcopy(model.get_parameters())
    assert error_of(model) > 0.05
    result = clone(model, linear_demonstrations(), n_updates=600, batch_size=64, learning_rate=1e-2, seed=3)
    assert error_of(model) < 1e-3
    assert result.n_transitions == 180 and result.n_held_out == 20 and result.n_episodes == 18
    assert result.validation_loss is not None and result.validation_loss == min(point[2] or 0 for point in result.curve)
    assert result.scalars()["updates"] == 600
    actor = {"PPO": "mlp_extractor.policy_net action_net", "A2C": "mlp_extractor.policy_net action_net"}
    allowed = actor.get(name, "actor.latent_pi actor.mu actor_target.mu").split()
    told = changed(before, model.policy)
    assert told and all(one.startswith(tuple(allowed)) for one in told), told
    if name in ("TD3", "DDPG"):
        assert all(map(th.equal, model.policy.actor_target.state_dict().values(), model.policy.actor.state_dict().values()))
    for one, saved in model.get_parameters().items():
        if "optimizer" in one:  # an Adam of its own
            assert saved["state"] == optimizers[one]["state"] == {}


@pytest.mark.parametrize("kind", [PPO, SAC])
def test_by_likelihood_the_standard_deviation_stays(kind: type[BaseAlgorithm]) -> None:
    model = make(kind)
    before = state_of(model.policy)
    clone(model, linear_demonstrations(), n_updates=600, batch_size=64, learning_rate=1e-2, loss="nll")
    assert error_of(model) < 3e-3
    assert not {name for name in changed(before, model.policy) if "log_std" in name or "critic" in name or "value" in name}


def test_likelihood_is_that_of_the_distribution() -> None:
    model = make(PPO)
    observations, actions = th.rand(5, 3), th.rand(5, 2) * 2 - 1
    wanted = th.as_tensor(LOW) + (actions + 1) / 2 * th.as_tensor(HIGH - LOW)
    _, log_prob, _ = model.policy.evaluate_actions(observations, wanted)
    th.testing.assert_close(ActionLoss(model.policy).nll(observations, actions), -log_prob.mean())


# ---------------------------------------------------------------------- what it sees


def toy(*keys: str, n_envs: int = 1, **kwargs: Any) -> VecEnv:
    return make_vec_env("CPMToy-v0", n_envs, seed=0, env_kwargs={"keys": keys}, **kwargs)


class Large(gym.ObservationWrapper):
    """Pictures that NatureCNN can read; by itself, where there is nothing else."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        camera = spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.rest = {key: space for key, space in env.observation_space.spaces.items() if key != "camera"}
        self.observation_space = spaces.Dict({"camera": camera, **self.rest}) if self.rest else camera

    def observation(self, observation: dict[str, np.ndarray]) -> Any:
        camera = observation["camera"].repeat(2, 0).repeat(2, 1)
        return {**observation, "camera": camera} if self.rest else camera


@pytest.mark.parametrize("kind", [PPO, SAC, TD3])
@pytest.mark.parametrize("shared", [False, True])
def test_features_extractors_of_the_actor_learn_those_of_critics_stay(kind: type[BaseAlgorithm], shared: bool) -> None:
    extractor = {"features_extractor_kwargs": {"cnn_output_dim": 8}, "share_features_extractor": shared}
    env = toy("camera", "state", wrapper_class=Large)
    model = make(kind, env, "MultiInputPolicy", policy_kwargs={"net_arch": [8], **extractor})
    demonstrations = record_demonstrations(env, 2, seed=0)
    before, error = state_of(model.policy), error_on(model, demonstrations)
    clone(model, demonstrations, n_updates=20, batch_size=16, learning_rate=1e-3, validation=0.0)
    assert error_on(model, demonstrations) < 0.9 * error
    told = changed(before, model.policy)
    actor = "pi_features_extractor" if kind is PPO else "actor.features_extractor"
    critic = "vf_features_extractor" if kind is PPO else "critic.features_extractor"
    assert any(name.startswith(actor) for name in told)
    assert any(name.startswith(critic) for name in told) == shared
    assert not any("q_networks" in name or "qf" in name or "value_net" in name for name in told)
    if kind is not PPO:  # targets see what their networks see
        of_target = state_of(model.policy.critic_target.features_extractor)
        assert (changed(of_target, model.policy.critic.features_extractor) == set()) and (
            any(name.startswith("critic_target.features_extractor") for name in told) == shared
        )


def test_pictures_alone_go_through_nature_cnn() -> None:
    env = toy("camera", wrapper_class=Large)
    model = make(PPO, env, "CnnPolicy", policy_kwargs={"net_arch": [8]})
    assert model.observation_space.shape == (3, 64, 64)
    demonstrations = record_demonstrations(env, 3, seed=0)
    assert demonstrations[0].observations["state"].shape[1:] == (64, 64, 3)  # as environments give them
    error = error_on(model, demonstrations)
    clone(model, demonstrations, n_updates=20, batch_size=16, learning_rate=1e-3, validation=0.0)
    assert error_on(model, demonstrations) < 0.9 * error


@pytest.mark.parametrize(("kind", "policy"), [(PPO, PointNetActorCriticPolicy), (SAC, PointNetPolicy)])
def test_clouds_are_learned_from_and_pictures_stay_where_they_are(kind: type[BaseAlgorithm], policy: Any) -> None:
    env = toy("camera", "pointcloud", "state")
    extractor = {"features_extractor_kwargs": {"sizes": [16, 32]}, "share_features_extractor": False}
    model = make(kind, env, policy, policy_kwargs={"net_arch": [16], **extractor})
    demonstrations = record_demonstrations(env, 6, seed=0)
    error, critics = error_on(model, demonstrations), state_of(model.policy)
    clone(model, demonstrations, n_updates=150, batch_size=32, learning_rate=3e-3, validation=0.0)
    assert error_on(model, demonstrations) < 0.5 * error
    assert not {name for name in changed(critics, model.policy) if name.startswith(("critic", "vf_", "value"))}
    # images that it does not read are not brought to its device
    assert set(_keys_of_actor(model.policy)) == {"pointcloud", "state"}


def test_observations_are_normalized_as_training_would_see_them() -> None:
    env = VecNormalize(DummyVecEnv([Vectors]), norm_reward=False)
    model = make(PPO, env)
    demonstrations = linear_demonstrations(40)
    clone(model, demonstrations, n_updates=600, batch_size=64, learning_rate=1e-2)
    rows = np.concatenate([one.observations["state"][:-1] for one in demonstrations])
    np.testing.assert_allclose(env.obs_rms.mean, rows.mean(0), atol=1e-5)  # counted first
    assert env.obs_rms.count == pytest.approx(400, abs=1)
    observations = np.random.default_rng(1).uniform(-1, 1, (500, 3)).astype(np.float32)
    actions, _ = model.predict(env.normalize_obs(observations), deterministic=True)
    assert np.mean((2 * (actions - LOW) / (HIGH - LOW) - 1 - scaled(observations)) ** 2) < 1e-3
    env.training = False
    clone(model, demonstrations, n_updates=1)
    assert env.obs_rms.count == pytest.approx(400, abs=1)


# ---------------------------------------------------------------------- when it ends


def test_one_seed_is_one_clone_and_the_run_that_follows_has_its_own_random_numbers() -> None:
    results = []
    for seed in (0, 0, 1):
        model = make(SAC)
        th.manual_seed(7)
        expected = th.get_rng_state()
        clone(model, linear_demonstrations(), n_updates=20, seed=seed)
        assert th.equal(th.get_rng_state(), expected)
        results.append(th.cat([one.flatten() for one in model.actor.state_dict().values()]))
    assert th.equal(results[0], results[1]) and not th.equal(results[0], results[2])


def test_the_best_on_held_out_episodes_is_kept_and_patience_ends_it() -> None:
    noise = np.random.default_rng(0)
    demonstrations = [
        Demonstration(one.observations, noise.uniform(LOW, HIGH, one.actions.shape).astype(np.float32), one.rewards)
        for one in linear_demonstrations(6)
    ]  # nothing to be learned: the validation loss rises soon
    kwargs: dict[str, Any] = {"n_updates": 1000, "learning_rate": 1e-2, "validation": 0.3, "seed": 0}
    kept = clone(make(TD3), demonstrations, **kwargs, patience=5)
    assert kept.best_update < kept.updates == kept.best_update + 5 * 20 < 1000
    assert kept.validation_loss == min(point[2] or 0 for point in kept.curve)
    last = clone(make(TD3), demonstrations, **kwargs, keep_best=False)
    assert last.best_update == last.updates == 1000 and (last.validation_loss or 0) > (kept.validation_loss or 9)
    seen: list[int] = []

    def stop(update: int, training: float, validation: float | None) -> bool:
        seen.append(update)
        return update < 60

    assert clone(make(TD3), demonstrations, **kwargs, callback=stop, progress_bar=True).updates == 60
    assert seen == [20, 40, 60]
    alone = clone(make(TD3), demonstrations[:1], n_updates=10)
    assert alone.validation_loss is None and alone.n_held_out == 0 and alone.best_update == 10


def test_demonstrations_and_models_that_cannot_be_are_refused() -> None:
    model, demonstrations = make(PPO), linear_demonstrations(2)
    with pytest.raises(ValueError, match="PPO got no demonstrations to learn from: record some"):
        clone(model, [])
    holed = Demonstration({"state": np.full((11, 3), np.nan, np.float32)}, demonstrations[0].actions, np.zeros(10))
    with pytest.raises(ValueError, match="Demonstration 1 of 2.*NaN"):
        clone(model, [demonstrations[0], holed])
    other = Demonstration(demonstrations[0].observations, np.zeros((10, 7), np.float32), np.zeros(10))
    with pytest.raises(ValueError, match=r"actions of shape \(10, 2\), got"):
        clone(model, [other])
    with pytest.raises(ValueError, match="continuous actions.*Discrete"):
        clone(DQN("MlpPolicy", gym.make("CartPole-v1"), buffer_size=10), demonstrations)
    with pytest.raises(ValueError, match="loss='nll' needs a policy with a distribution of actions; TD3 has none"):
        clone(make(TD3), demonstrations, loss="nll")
    for wrong in ({"loss": "l1"}, {"validation": 1.0}, {"n_updates": 0}, {"learning_rate": -1.0}, {"patience": 0}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be"):
            clone(model, demonstrations, **wrong)  # type: ignore[arg-type]
    before = state_of(model.policy)
    with pytest.raises(ValueError, match=r"loss is (nan|inf|[0-9.e+]+) by update \d+. The model is as it was"):
        clone(model, demonstrations, n_updates=60, learning_rate=1e30)
    assert not changed(before, model.policy)


def test_a_recurrent_policy_is_refused() -> None:
    kind = pytest.importorskip("sb3_contrib").RecurrentPPO
    model = kind("MlpLstmPolicy", DummyVecEnv([Vectors]), n_steps=10, batch_size=10)
    with pytest.raises(ValueError, match="actors that see one observation"):
        clone(model, linear_demonstrations(2))


# ---------------------------------------------------------------------- as a callback


class Rounds(CloneCallback):
    """Notes what changed in every round of PPO."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.states: list[dict[str, th.Tensor]] = []

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        self.states.append(state_of(self.model.policy))


def test_at_first_the_value_alone_learns(tmp_path: Path) -> None:
    model = make(PPO, n_steps=20, policy_kwargs={"net_arch": [8], "log_std_init": -1.0})
    callback = Rounds(demonstrations=linear_demonstrations(), n_episodes=None, critic_warmup=2, n_updates=100)
    model.learn(80, callback)
    assert callback.result is not None and callback.result.updates == 100
    value = {"mlp_extractor.value_net.0.weight", "mlp_extractor.value_net.0.bias", "value_net.weight", "value_net.bias"}
    first, second, third, _ = callback.states
    for before, after in ((first, second), (second, third)):
        assert {name for name in before if not th.equal(before[name], after[name])} == value
    assert changed(third, model.policy) == set(third)
    assert all(one.requires_grad for one in model.policy.parameters())
    # Adam has not seen the actor before: its count of steps is that of the rounds that trained it
    counts = {name: int(model.policy.optimizer.state[one]["step"]) for name, one in model.policy.named_parameters()}
    assert counts["value_net.bias"] == 2 * counts["log_std"] == 2 * counts["action_net.weight"]


def test_it_clones_once_in_a_models_life(tmp_path: Path) -> None:
    arguments: dict[str, Any] = {
        "demonstrations": linear_demonstrations(),
        "n_updates": 20,
        "critic_warmup": 3,
        "n_episodes": None,
    }
    model = make(PPO)
    model.learn(10, CloneCallback(**arguments))
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model", DummyVecEnv([Vectors]))
    callback = Rounds(**arguments)
    loaded.learn(30, callback, reset_num_timesteps=False)
    assert callback.result is None
    first, _, third = callback.states
    assert not changed(state_of(model.policy), loaded.policy) - set(first) and th.equal(first["log_std"], third["log_std"])
    assert changed(third, loaded.policy) >= {"log_std"}, "one round was left, then two: now all learn"


def test_a_clone_may_wait_and_the_buffer_gets_what_it_is_made_of() -> None:
    env = toy("state")
    kwargs = {"challenge_ratio": 0, "demonstration_ratio": 0.5}
    model = make(SAC, env, "MultiInputPolicy", learning_starts=100, replay_buffer_class=CPMBuffer, replay_buffer_kwargs=kwargs)
    model.set_logger(Logger(None, []))
    before, at = state_of(model.policy), []

    class Changed(BaseCallback):
        def _on_step(self) -> bool:
            if changed(before, self.model.policy):
                at.append(self.num_timesteps)
            return True

    callback = CloneCallback(n_episodes=3, n_updates=10, after_steps=40, log_std=-2.5)
    model.learn(60, [callback, Changed()])
    assert callback.result is not None and at == list(range(41, 61))
    state = {key: th.randn(4, *space.shape) for key, space in model.observation_space.spaces.items()}
    assert th.equal(model.actor.get_action_dist_params(state)[1], th.full((4, 2), -2.5))
    assert len(model.replay_buffer.demonstrations.episodes) == 3
    again = CloneCallback(n_episodes=3, n_updates=10, after_steps=40)
    model.learn(20, again, reset_num_timesteps=False)
    assert again.result is None


def test_of_the_toys_expert_a_clone_succeeds() -> None:
    from sb3_cpm.run.evaluation import evaluate

    env = toy("state", n_envs=2)
    model = make(SAC, env, "MultiInputPolicy", learning_starts=10, policy_kwargs={"net_arch": [64, 64]})
    model.set_logger(Logger(None, []))
    model.learn(4, CloneCallback(n_episodes=80, n_updates=800, batch_size=64, learning_rate=3e-3))
    outcomes = evaluate(model, toy("state"), 20)
    assert np.mean([outcome.success_once for outcome in outcomes]) > 0.9


def test_callbacks_that_cannot_work_are_refused() -> None:
    with pytest.raises(ValueError, match="critic_warmup=4 counts rounds of PPO or A2C, SAC has none"):
        make(SAC).learn(1, CloneCallback(critic_warmup=4))
    with pytest.raises(ValueError, match="log_std=-2.5 is for SAC and TQC without gSDE; TD3 has no layer"):
        make(TD3).learn(1, CloneCallback(log_std=-2.5))
    with pytest.raises(ValueError, match="log_std must be a number from -20 to 2"):
        CloneCallback(log_std=3.0)
    with pytest.raises(ValueError, match="takes those of the model, PPO has none: name a source"):
        make(PPO).learn(1, CloneCallback(demonstrations=None))
    with pytest.raises(ValueError, match="unknown key 'n_update'.*Did you mean 'n_updates'"):
        CloneCallback(n_update=3)  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="loss must be one of"):
        CloneCallback(loss="l1")
    with pytest.raises(ValueError, match="has no expert"):
        make(PPO).learn(1, CloneCallback())


def test_the_actor_is_what_its_action_depends_on() -> None:
    model = make(A2C, policy_kwargs={"net_arch": [8]})
    names = {id(one): name for name, one in model.policy.named_parameters()}
    found = [names[id(one)] for one in actor_parameters(model.policy, th.zeros(1, 3))]
    assert found == [
        *("mlp_extractor.policy_net.0.weight", "mlp_extractor.policy_net.0.bias", "action_net.weight", "action_net.bias")
    ]


@pytest.mark.slow
@pytest.mark.maniskill
def test_a_clone_of_scripted_episodes_picks_the_cube() -> None:
    """120 episodes and 3000 updates, for CI: half of what docs/imitation.md reports."""
    pytest.importorskip("mani_skill")
    from sb3_cpm.agents.tasks import register_tasks
    from sb3_cpm.run.evaluation import evaluate

    register_tasks()
    env = make_vec_env("CPM/PickCubeState-v1", seed=0)
    policy_kwargs = {"net_arch": [256, 256], "activation_fn": th.nn.ReLU}
    model = PPO("MultiInputPolicy", env, n_steps=50, batch_size=50, seed=0, device="cpu", policy_kwargs=policy_kwargs)
    clone(model, record_demonstrations(env, 120, seed=0), n_updates=3000, learning_rate=1e-3)
    outcomes = evaluate(model, env, 20)
    env.close()
    assert np.mean([outcome.success_once for outcome in outcomes]) >= 0.3
