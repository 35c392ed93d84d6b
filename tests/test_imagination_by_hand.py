"""Imagination without autograd, on CPUs, gives what the same computed with autograd gives."""

from typing import Any

import numpy as np
import pytest
import torch
from challenger_helpers import SMALL, VECTOR, random_batch, small

from sb3_cpm.challenger import Challenger
from sb3_cpm.world_model.behavior import ActorCritic, BehaviorLosses
from sb3_cpm.world_model.by_hand.dream import Dream
from sb3_cpm.world_model.by_hand.returns import Returns, through
from sb3_cpm.world_model.distributions import OutputSampler, TruncatedNormal
from sb3_cpm.world_model.losses import lambda_returns
from sb3_cpm.world_model.networks import MLP

KINDS = ("dynamics", "reinforce", "both")


def behaviour_losses(challenger: Challenger, by_hand: bool, monkeypatch: pytest.MonkeyPatch) -> list[BehaviorLosses]:
    """Of all behaviours, from the same states with the same random numbers."""
    with monkeypatch.context() as patch:
        if not by_hand:
            patch.setattr(ActorCritic, "_learns_by_hand", lambda *arguments: False)
        torch.manual_seed(0)
        batch = challenger.learner.to_device(random_batch(VECTOR, challenger.action_dim))
        start = challenger.learner.imagination_starts(batch, challenger.world_model.loss(batch))
        share = torch.linspace(0.0, 2.0, len(start.deter))
        return [challenger.learner.learn_behavior(name, *start, share) for name in challenger.behaviors]


def assert_alike(found: list[BehaviorLosses], expected: list[BehaviorLosses]) -> None:
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close((one.actor, one.critic), (other.actor, other.critic), rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(one.metrics, other.metrics, rtol=1e-4, atol=1e-5)
        pairs = zip(
            (*one.actor_gradients, *one.critic_gradients), (*other.actor_gradients, *other.critic_gradients), strict=True
        )
        for left, right in pairs:
            assert left is not None and right is not None
            assert torch.linalg.vector_norm(left - right) <= 1e-4 * torch.linalg.vector_norm(right) + 1e-8


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("action_dim", [1, 3])
@pytest.mark.parametrize(
    "entries",
    [
        {},
        {"actor_input_gradient": False},
        {"actor_layers": 0, "critic_layers": 0, "continue_head": False},
        {"horizon": 1, "slow_target": False},
        {"gamma": 0.0},
        {"lambda_": 1.0, "symlog_rewards": True},
    ],
)
def test_behaviours_learn_the_same(
    kind: str, action_dim: int, entries: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    challenger = small(action_dim=action_dim, actor_gradient=kind, train_task_behavior=True, **entries)
    for seed in range(3):
        challenger.train(random_batch(VECTOR, action_dim, seed=seed))
    found = behaviour_losses(challenger, True, monkeypatch)
    assert_alike(found, behaviour_losses(challenger, False, monkeypatch))
    assert all(
        bool((gradient != 0.0).any()) for losses in found for gradient in losses.actor_gradients if gradient is not None
    )


def test_by_hand_is_what_gaussian_latents_on_a_cpu_get(monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[str] = []
    forward = Dream.forward
    monkeypatch.setattr(Dream, "forward", staticmethod(lambda *arguments: (used.append("dream"), forward(*arguments))[1]))
    small().train(random_batch(VECTOR, 2))
    assert used == ["dream"]
    for other in ({"latent": "categorical", "stoch_size": 4, "stoch_classes": 5}, {"amp": True}):
        small(preset={**SMALL, **other}).train(random_batch(VECTOR, 2))
    assert used == ["dream"]


def test_nobody_but_the_actor_gets_a_gradient() -> None:
    challenger = small(train_task_behavior=True)
    before = [weight.requires_grad for network in challenger.networks.values() for weight in network.parameters()]
    challenger.train(random_batch(VECTOR, 2))
    weights = [weight for network in challenger.networks.values() for weight in network.parameters()]
    assert [weight.requires_grad for weight in weights] == before and all(weight.grad is None for weight in weights)


# ---- samples ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.3, 3.0, 1e3])
def test_actions_and_their_slopes(scale: float) -> None:
    torch.manual_seed(0)
    outputs = (scale * torch.randn(400, 6)).requires_grad_()
    chance = torch.rand(400, 3)
    chance[0], chance[1] = 0.0, 1.0 - 1e-7  # the very ends
    policy = TruncatedNormal.of_outputs(outputs)
    actions, standard = policy.at(chance)
    (expected,) = torch.autograd.grad(actions.sum(), outputs)
    found, found_standard = OutputSampler(outputs).sample(outputs.detach(), chance)
    assert found.abs().max() <= 1.0
    torch.testing.assert_close(found, actions.detach(), rtol=1e-3, atol=1e-4)
    slopes = policy.slopes(chance, standard).detach()
    assert torch.isfinite(slopes).all() and torch.isfinite(found_standard).all()
    inside = (chance > 1e-3).all(1) & (chance < 1.0 - 1e-3).all(1)
    torch.testing.assert_close(slopes[inside], expected[inside], rtol=1e-3, atol=1e-4)


# ---- returns ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ends", [True, False])
@pytest.mark.parametrize("gamma, lambda_", [(0.99, 0.95), (0.0, 0.5), (0.9, 0.0), (1.0, 1.0)])
def test_returns_and_their_gradients(ends: bool, gamma: float, lambda_: float) -> None:
    torch.manual_seed(0)
    critic, head = MLP(5, 2, 8, 1), MLP(5, 1, 8, 1) if ends else None
    rewards, feats = torch.randn(6, 4, requires_grad=True), torch.randn(6, 4, 5, requires_grad=True)
    goes_on = torch.sigmoid(head(feats).squeeze(-1)) if head is not None else torch.ones(6, 4)
    expected = lambda_returns(rewards, critic(feats).squeeze(-1), gamma * goes_on, lambda_)
    found, values, discounts = Returns.apply(rewards, feats, critic, head, gamma, lambda_)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(values, critic(feats).squeeze(-1))
    torch.testing.assert_close(discounts, gamma * goes_on)
    assert not values.requires_grad and not discounts.requires_grad
    weight = torch.randn(6, 4)
    theirs = torch.autograd.grad((weight * expected).sum(), [rewards, feats], allow_unused=True, materialize_grads=True)
    torch.testing.assert_close(torch.autograd.grad((weight * found).sum(), [rewards, feats]), theirs)


@pytest.mark.parametrize("layers", [0, 1, 3])
def test_an_mlp_by_hand(layers: int) -> None:
    torch.manual_seed(0)
    mlp, inputs = MLP(5, layers, 8, 2), torch.randn(3, 7, 5, requires_grad=True)
    output, weight = mlp(inputs), torch.randn(21, 2)
    expected = torch.autograd.grad((output.view(21, 2) * weight).sum(), [inputs, *mlp.parameters()])
    done = through(mlp, inputs)
    torch.testing.assert_close(done.output, output.view(21, 2))
    torch.testing.assert_close(done.to_parameters(weight.clone()), expected[1:])
    torch.testing.assert_close(done.to_inputs(weight.clone()).view(3, 7, 5), expected[0])
    assert np.isfinite(done.output.numpy()).all()
