"""DAPG: PPO, with demonstrated actions in its loss."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0)
from sb3_cpm.imitation import DAPG, CloneCallback, record_demonstrations

SMALL: dict[str, Any] = {"n_steps": 20, "batch_size": 10, "n_epochs": 2, "seed": 0, "policy_kwargs": {"net_arch": [8]}}


def toy(n_envs: int = 2) -> VecEnv:
    return make_vec_env("CPMToy-v0", n_envs, seed=0, env_kwargs={"keys": ["state"]})


def make(kind: type[PPO] = DAPG, env: VecEnv | None = None, **kwargs: Any) -> PPO:
    return kind("MultiInputPolicy", env or toy(), device="cpu", **{**SMALL, **kwargs})


def same(one: PPO, other: PPO) -> bool:
    pairs = zip(one.policy.state_dict().values(), other.policy.state_dict().values(), strict=True)
    optimizers = (model.policy.optimizer.state_dict()["state"] for model in (one, other))
    states = zip(*(list(state.values()) for state in optimizers), strict=True)
    return all(th.equal(a, b) for a, b in pairs) and all(th.equal(a["exp_avg_sq"], b["exp_avg_sq"]) for a, b in states)


def test_without_demonstrations_it_is_ppo_bit_for_bit() -> None:
    plain = {"demo_coef": 0.0, "critic_warmup": 0}
    learning = {"demonstrations": "expert", "n_episodes": 3, "critic_warmup": 0}
    models = [make(kind, **kwargs).learn(200) for kind, kwargs in ((PPO, {}), (DAPG, plain), (DAPG, learning))]
    assert same(models[0], models[1])
    assert not same(models[0], models[2])


def test_the_demonstrations_stand_in_its_loss() -> None:
    """One minibatch of one round beside the loss written out: gradients are added, then clipped, then stepped."""
    arguments = {"n_epochs": 1, "batch_size": 40, "demonstrations": "expert", "n_episodes": 3, "critic_warmup": 0}
    model = make(demo_coef=0.7, demo_decay=0.5, **arguments).learn(40)
    other = make(demo_coef=0.7, demo_decay=0.5, **arguments)

    def by_hand() -> None:
        policy, weight = other.policy, 0.7
        (batch,) = other.rollout_buffer.get(40)
        values, log_prob, _ = policy.evaluate_actions(batch.observations, batch.actions)
        advantages = (batch.advantages - batch.advantages.mean()) / (batch.advantages.std() + 1e-8)
        ratio = th.exp(log_prob - batch.old_log_prob)
        surrogate = -th.min(advantages * ratio, advantages * th.clamp(ratio, 0.8, 1.2)).mean()
        episodes = other.demonstration_episodes()
        observations = th.as_tensor(np.concatenate([one.observations["state"][:-1] for one in episodes]))
        actions = th.as_tensor(np.concatenate([one.actions for one in episodes]))
        rows = th.randint(len(actions), (40,))
        demonstrated = policy.get_distribution({"state": observations[rows]}).log_prob(actions[rows]).mean()
        loss = surrogate + 0.5 * th.nn.functional.mse_loss(batch.returns, values.flatten()) - weight * demonstrated
        policy.optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(policy.parameters(), 0.5)
        policy.optimizer.step()

    other.train = by_hand  # type: ignore[method-assign]
    other.learn(40)
    for one, two in zip(model.policy.parameters(), other.policy.parameters(), strict=True):
        th.testing.assert_close(one, two, rtol=1e-4, atol=1e-6)


def test_the_weight_falls_from_round_to_round_and_goes_on_after_loading(tmp_path: Path) -> None:
    seen: list[float] = []

    class Noting(DAPG):
        def train(self) -> None:
            super().train()
            seen.append(self.logger.name_to_value["train/demo_coef"])

    model = make(Noting, demonstrations="expert", n_episodes=3, demo_coef=0.4, demo_decay=0.5, critic_warmup=1)
    model.learn(120)
    assert seen == pytest.approx([0.0, 0.2, 0.1])
    model.save(tmp_path / "model")
    loaded = Noting.load(tmp_path / "model", toy())
    loaded.learn(40, reset_num_timesteps=False)
    assert seen[3] == pytest.approx(0.05)
    assert loaded.demonstrations == "expert" and loaded.n_episodes == 3
    with_list = make(Noting, demonstrations=model.demonstration_episodes())
    with_list.save(tmp_path / "list")
    assert Noting.load(tmp_path / "list", demonstrations="expert").demonstrations == "expert"
    with pytest.raises(ValueError, match="DAPG learns from demonstrations and was given none"):
        Noting.load(tmp_path / "list", toy()).learn(40)


def test_at_first_the_value_alone_learns() -> None:
    model = make(demonstrations="expert", n_episodes=3, critic_warmup=2)
    before = {name: one.detach().clone() for name, one in model.policy.named_parameters()}
    model.learn(80)
    changed = {name for name, one in model.policy.named_parameters() if not th.equal(one, before[name])}
    assert changed and all("value" in name for name in changed)
    model.learn(40, reset_num_timesteps=False)
    assert {name for name, one in model.policy.named_parameters() if not th.equal(one, before[name])} == set(before)


def test_its_demonstrations_can_be_cloned_first_and_are_normalized_as_they_are_now() -> None:
    env = VecNormalize(toy(1), norm_reward=False)
    model = make(env=env, demonstrations="expert", n_episodes=5, critic_warmup=0)
    callback = CloneCallback(demonstrations=None, n_updates=50)
    model.learn(40, callback)
    assert callback.result is not None and callback.result.n_episodes + 1 == len(model.demonstration_episodes()) == 5
    first = {key: one.clone() for key, one in model._rows.observations.items()}
    env.obs_rms["state"].mean += 1.0
    model.learn(20, reset_num_timesteps=False)
    assert (model._rows.observations["state"] < first["state"]).all()


def test_more_demonstrations_more_likely() -> None:
    env = toy()
    episodes = record_demonstrations(env, 20, seed=1)

    def likelihood(model: PPO) -> float:
        observations = {"state": th.as_tensor(np.concatenate([one.observations["state"][:-1] for one in episodes]))}
        actions = th.as_tensor(np.concatenate([one.actions for one in episodes]))
        with th.no_grad():
            return model.policy.get_distribution(observations).log_prob(actions).mean().item()

    alone = make(PPO, learning_rate=3e-3)
    beside = make(demonstrations=episodes, demo_coef=1.0, critic_warmup=0, learning_rate=3e-3)
    for model in (alone, beside):
        model.learn(800)
    assert likelihood(beside) > likelihood(alone) + 0.3


def test_arguments_that_cannot_be() -> None:
    for wrong in ({"demo_coef": -1.0}, {"demo_decay": 2.0}, {"critic_warmup": -1}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be"):
            make(**wrong)
    with pytest.raises(ValueError, match="has no expert"):
        DAPG("MlpPolicy", DummyVecEnv([lambda: gym.make("Pendulum-v1")]), demonstrations="expert", n_episodes=1).learn(1)
