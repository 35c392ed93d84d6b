"""An actor that keeps to its demonstrations while it learns from rewards."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env

from sb3_cpm import CPMBuffer, RLPDPolicy
from sb3_cpm.imitation import BCLossCallback, DemonstrationsCallback
from sb3_cpm.imitation.regularization import drawn_actions


def toy() -> Any:
    return make_vec_env("sb3_cpm.envs.toy:CPMToy-v0", seed=0, env_kwargs=dict(keys=("state",)))


def make(algorithm: Any = SAC, policy: Any = "MultiInputPolicy", **kwargs: Any) -> Any:
    return algorithm(
        policy,
        toy(),
        replay_buffer_class=CPMBuffer,
        replay_buffer_kwargs=dict(challenge_ratio=0, demonstration_ratio=0.5, mix="row"),
        policy_kwargs=dict(net_arch=[32]),
        **dict(learning_starts=20, batch_size=32, buffer_size=1000, seed=0, device="cpu", learning_rate=1e-3, **kwargs),
    )


def distance(model: Any) -> float:
    np.random.seed(0)
    batch = model.replay_buffer.sample_demonstrations(256)
    with th.no_grad():
        return (drawn_actions(model.policy, batch.observations) - batch.actions).square().sum(1).mean().item()


@pytest.mark.parametrize("algorithm, policy", [(SAC, RLPDPolicy), (TD3, "MultiInputPolicy")])
def test_actions_stay_near_those_of_the_demonstrations(algorithm: Any, policy: Any) -> None:
    distances = {}
    for weight in (None, 1.0):
        callbacks: list[Any] = [DemonstrationsCallback("expert", n_episodes=10)]
        model = make(algorithm, policy)
        model.learn(200, callback=callbacks if weight is None else [*callbacks, BCLossCallback(weight)])
        distances[weight] = distance(model)
    assert distances[1.0] < 0.7 * distances[None], distances


def test_one_step_of_the_actor_for_each_update_and_no_other_parameter() -> None:
    model, callback = make(), BCLossCallback(decay_steps=100)
    model.learn(60, callback=[DemonstrationsCallback("expert", n_episodes=2), callback])
    assert callback.current_weight == pytest.approx(0.4)
    steps = [int(state["step"]) for state in model.actor.optimizer.state.values()]
    assert model._n_updates == 40 and set(steps) == {80}
    critics = [int(state["step"]) for state in model.critic.optimizer.state.values()]
    assert set(critics) == {40}
    model.learn(60, callback=callback, reset_num_timesteps=False)  # its weight is 0 from step 100 on
    steps = [int(state["step"]) for state in model.actor.optimizer.state.values()]
    assert model._n_updates == 100 and set(steps) == {80 + 60 + 39}


def test_bad_input() -> None:
    for kwargs in (dict(weight=0), dict(decay_steps=0), dict(batch_size=1.5)):
        with pytest.raises(ValueError, match=f"{next(iter(kwargs))} must be"):
            BCLossCallback(**kwargs)
    with pytest.raises(ValueError, match="reads demonstrations from a CPMBuffer, which this PPO has not"):
        PPO("MultiInputPolicy", toy(), n_steps=32, batch_size=32, device="cpu").learn(32, callback=BCLossCallback())
