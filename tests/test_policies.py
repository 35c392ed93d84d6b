"""Policies with layer normalisation, SimBa's networks and RLPD's critics, beside stock SAC and TQC."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_cpm import LayerNormPolicy, RLPDPolicy, SimbaPolicy
from sb3_cpm.envs import DictObservation, ToyEnv
from sb3_cpm.extractors import PointNetExtractor
from sb3_cpm.policies import td3, tqc
from sb3_cpm.policies.networks import MLPs, RunningNorm

OF_SAC: Any = [(SAC, policy) for policy in (LayerNormPolicy, SimbaPolicy, RLPDPolicy)]
OTHERS: Any = [
    (algorithm, getattr(module, name))
    for algorithm, module in ((TQC, tqc), (TD3, td3), (DDPG, td3))
    for name in ("LayerNormPolicy", "SimbaPolicy")
]
ALL = [*OF_SAC, *OTHERS]
ENVS = {
    "vector": lambda: make_vec_env("Pendulum-v1"),
    "dict": lambda: make_vec_env("Pendulum-v1", wrapper_class=DictObservation),
    "image": lambda: DummyVecEnv([lambda: FakeImageEnv(discrete=False, screen_height=40, screen_width=40)]),
    "cloud": lambda: DummyVecEnv([lambda: ToyEnv(keys=("pointcloud", "state"))]),
}


def make(algorithm: Any, policy: Any, env: str = "vector", **policy_kwargs: Any) -> Any:
    size: dict[str, Any] = {"net_arch": [16, 16], **policy_kwargs}
    return algorithm(
        policy, ENVS[env](), policy_kwargs=size, learning_starts=20, buffer_size=200, batch_size=8, seed=0, device="cpu"
    )


@pytest.mark.parametrize(
    ("algorithm", "policy", "env"), [(*one, env) for one in ALL for env in ENVS if one[0] is not DDPG or env == "vector"]
)
def test_learns_saves_and_loads(algorithm: Any, policy: Any, env: str, tmp_path: Path) -> None:
    model = make(algorithm, policy, env)
    before = [one.clone() for one in (*model.actor.parameters(), *model.critic.parameters())]
    model.learn(30)
    after = [*model.actor.parameters(), *model.critic.parameters()]
    assert all(not th.equal(old, new) for old, new in zip(before, after, strict=True) if old.numel() > 1)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    obs = model.get_env().reset()
    assert np.array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    model.policy.save(tmp_path / "policy")
    alone = type(model.policy).load(tmp_path / "policy", device="cpu")
    assert np.array_equal(model.predict(obs, deterministic=True)[0], alone.predict(obs, deterministic=True)[0])


@pytest.mark.parametrize("algorithm, policy", ALL)
def test_clouds_go_through_a_pointnet(algorithm: Any, policy: Any) -> None:
    assert isinstance(make(algorithm, policy, "cloud").actor.features_extractor, PointNetExtractor)


@pytest.mark.parametrize("algorithm, policy", [(SAC, LayerNormPolicy), (TQC, tqc.LayerNormPolicy), (TD3, td3.LayerNormPolicy)])
def test_every_hidden_layer_is_normalised(algorithm: Any, policy: Any) -> None:
    model = make(algorithm, policy)
    trunk = model.actor.mu[0] if algorithm is TD3 else model.actor.latent_pi
    for network in (trunk, *model.critic.q_networks):
        kinds = [type(layer) for layer in network]
        assert kinds[:6] == [nn.Linear, nn.LayerNorm, nn.ReLU] * 2
    model = make(algorithm, policy, actor_layer_norm=False, activation_fn=nn.Tanh)
    trunk = model.actor.mu[0] if algorithm is TD3 else model.actor.latent_pi
    assert [type(layer) for layer in trunk] == [nn.Linear, nn.Tanh] * 2


def test_layer_norm_bounds_what_critics_say_of_actions_that_nobody_took() -> None:
    values = {}
    for policy in ("MlpPolicy", LayerNormPolicy):
        model = make(SAC, policy, net_arch=[64, 64])
        obs = th.zeros(1, 3)
        near, far = (model.critic(obs, th.full((1, 1), scale))[0].item() for scale in (1.0, 1000.0))
        values[policy] = abs(far - near)
    assert values[LayerNormPolicy] < 2.0 < values["MlpPolicy"]


def test_tqc_has_its_quantiles() -> None:
    model = make(TQC, tqc.SimbaPolicy, n_quantiles=7, n_critics=3)
    assert model.critic(th.zeros(4, 3), th.zeros(4, 1)).shape == (4, 3, 7)


# ---------------------------------------------------------------------- SimBa


def test_running_norm_is_mean_and_variance_of_everything_seen() -> None:
    norm, rng = RunningNorm(3), np.random.default_rng(0)
    seen = [th.tensor(rng.normal(5, 3, (n, 4)), dtype=th.float32) for n in (1, 10, 7)]
    for batch in seen:
        assert th.equal(norm(batch)[:, 3], batch[:, 3])
    everything = th.cat(seen)[:, :3]
    assert th.allclose(norm.running_mean, everything.mean(0), atol=1e-5)
    assert th.allclose(norm.running_var, everything.var(0, correction=0), atol=1e-4)
    norm.eval()
    norm(seen[0] + 100)
    with th.no_grad():
        norm.train()(seen[0] + 100)
    assert th.allclose(norm.running_mean, everything.mean(0), atol=1e-5)


def test_targets_have_the_statistics_of_their_critics() -> None:
    model = make(SAC, SimbaPolicy).learn(30)
    (found,) = {tuple(net[0][0].running_mean.tolist()) for net in (model.critic.qf0, model.critic_target.qf0)}
    assert any(found)
    assert isinstance(model.actor.optimizer, th.optim.AdamW) and model.actor.optimizer.defaults["weight_decay"] == 0.01


def test_blocks_of_one_width() -> None:
    with pytest.raises(ValueError, match=r"net_arch=\[16, 32\] must be a list of one or more equal numbers"):
        make(SAC, SimbaPolicy, net_arch=[16, 32])


# ---------------------------------------------------------------------- RLPD


def test_batched_critics_are_as_many_single_ones() -> None:
    together, inputs = MLPs(4, 5, [8, 6]), th.randn(3, 5)
    for k in range(4):
        values = inputs
        for layer in range(2):
            values = values @ together.weights[layer][k] + together.biases[layer][k]
            values = F.layer_norm(values, values.shape[-1:]) * together.scales[layer][k] + together.shifts[layer][k]
            values = values.relu()
        values = values @ together.weights[2][k] + together.biases[2][k]
        assert th.allclose(together(inputs)[k], values, atol=1e-6)
        assert th.allclose(together(inputs, th.tensor([k, 0]))[0], values, atol=1e-6)
    bound = 5**-0.5  # as nn.Linear: uniform within it
    assert together.weights[0].abs().max() <= bound
    assert together.weights[0].std().item() == pytest.approx(bound / 3**0.5, rel=0.2)


def test_who_asks_decides_what_the_critics_say() -> None:
    critic, obs, actions = make(SAC, RLPDPolicy).critic, th.randn(6, 3), th.rand(6, 1)
    every = critic(obs, actions)
    assert len(every) == 10 and every[0].shape == (6, 1)
    of_actor = actions.clone().requires_grad_()
    (mean,) = critic(obs, of_actor)
    assert th.allclose(mean, th.stack(every).mean(0), atol=1e-6)
    mean.sum().backward()
    assert of_actor.grad.abs().sum() > 0
    assert all(one.grad is None for one in critic.parameters()), "SAC would clear it"
    pairs = set()
    with th.no_grad():
        for _ in range(20):
            pair = critic(obs, actions)
            assert len(pair) == 2
            places = [next(k for k, one in enumerate(every) if th.allclose(one, value, atol=1e-6)) for value in pair]
            pairs.add(tuple(places))
            assert places[0] != places[1]
        th.manual_seed(1)
        first = critic(obs, actions)
        th.manual_seed(1)
        assert all(th.equal(a, b) for a, b in zip(first, critic(obs, actions), strict=True))
    assert len(pairs) > 10


def test_two_critics_without_norm_learn_as_those_of_sb3() -> None:
    """The loss of SAC for the batched critics is that of SB3's own with the same weights."""
    ours = make(SAC, RLPDPolicy, n_critics=2, critic_layer_norm=False)
    theirs = make(SAC, "MlpPolicy")
    assert type(theirs.critic) is ContinuousCritic
    for k, network in enumerate(theirs.critic.q_networks):
        linear = [layer for layer in network if isinstance(layer, nn.Linear)]
        for layer, (weight, bias) in enumerate(zip(ours.critic.networks.weights, ours.critic.networks.biases, strict=True)):
            linear[layer].weight.data.copy_(weight[k].T)
            linear[layer].bias.data.copy_(bias[k, 0])
    obs, actions, target = th.randn(5, 3), th.rand(5, 1), th.randn(5, 1)
    for model in (ours, theirs):
        sum(F.mse_loss(one, target) for one in model.critic(obs, actions)).backward()
    for k, network in enumerate(theirs.critic.q_networks):
        assert th.allclose(network[0].weight.grad.T, ours.critic.networks.weights[0].grad[k], atol=1e-6)


def test_bad_numbers_of_critics() -> None:
    with pytest.raises(ValueError, match="n_min=3 critics cannot be drawn of n_critics=2"):
        make(SAC, RLPDPolicy, n_critics=2, n_min=3)
    with pytest.raises(ValueError, match="n_critics must be"):
        make(SAC, RLPDPolicy, n_critics=0)
    assert isinstance(make(SAC, RLPDPolicy).observation_space, spaces.Box)
