"""How actors learn in imagination: through the dynamics, by REINFORCE, by a mixture; and the two switches for speed."""

import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from challenger_helpers import BOTH, SMALL, VECTOR, random_batch, small, update, weights
from torch import nn

from sb3_cpm.challenger import Challenger
from sb3_cpm.presets import make_preset
from sb3_cpm.world_model.behavior import ActorCritic, Imagination
from sb3_cpm.world_model.distributions import TruncatedNormal
from sb3_cpm.world_model.fast import acceleration
from sb3_cpm.world_model.rssm import LatentState

KINDS = ("dynamics", "reinforce", "both")


# ---- a bandit whose gradient is known ----------------------------------------------------------------------------------


class Nothing(nn.Module):
    """A world in which nothing ever changes."""

    rssm = property(lambda self: self)

    def imagine_step(self, state: LatentState, action: torch.Tensor) -> LatentState:
        return state

    def continue_probability(self, feat: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(feat[..., 0])


class Bandit(ActorCritic):
    """One state, one action, one step; the actor is two numbers, mean and raw standard deviation."""

    def __init__(self, **preset: Any) -> None:
        super().__init__("bandit", 2, 1, make_preset(horizon=1, actor_layers=0, gamma=0.5, entropy_scale=0.0, **preset))
        with torch.no_grad():
            self.actor.net[-1].weight.zero_()
            self.actor.net[-1].bias.copy_(torch.tensor([0.2, -0.5]))
            for parameter in self.target_critic.parameters():
                parameter.zero_()
            self.target_critic[-1].bias.fill_(0.7)  # a baseline that is wrong but does no harm

    def policy(self) -> TruncatedNormal:
        return self.actor(torch.zeros(2))

    def gradient(self, reward: Callable[[torch.Tensor], torch.Tensor], n: int = 200_000) -> torch.Tensor:
        """Of the actor's loss with respect to the two numbers, the baseline's share of the return left out."""
        stuck = LatentState(torch.zeros(n, 1), torch.zeros(n, 1), torch.zeros(n, 2))
        with torch.set_grad_enabled(self.preset.actor_gradient != "reinforce"):
            imagined = self.imagine(Nothing(), stuck)  # type: ignore[arg-type]
            values = self.target_critic(imagined.next_feats).squeeze(-1)
            returns = reward(imagined.actions.squeeze(-1)) + 0.5 * values
        objective, _ = self._objective(imagined, returns, values)
        return torch.autograd.grad(objective.mean(), self.actor.net[-1].bias)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_a_linear_reward_has_the_gradient_of_the_mean(kind: str) -> None:
    """E[3 a] = 3 * mean of the truncated normal."""
    bandit = Bandit(actor_gradient=kind)
    expected = torch.autograd.grad(3.0 * bandit.policy().mean.sum(), bandit.actor.net[-1].bias)[0]
    assert torch.allclose(bandit.gradient(lambda action: 3.0 * action), expected, atol=0.02)


def test_a_reward_in_steps_needs_reinforce() -> None:
    """P(a > 0.1) is smooth in the policy, but the reward is flat wherever one looks."""
    bandit, threshold = Bandit(actor_gradient="reinforce"), 0.1
    policy = bandit.policy()
    above = torch.special.ndtr(policy.beta) - torch.special.ndtr((threshold - policy.loc) / policy.scale)
    expected = torch.autograd.grad((above / policy._mass).sum(), bandit.actor.net[-1].bias)[0]

    def reward(action: torch.Tensor) -> torch.Tensor:
        return (action > threshold).float() + 0.0 * action

    found = bandit.gradient(reward)
    assert expected.abs().min() > 0.01 and torch.allclose(found, expected, atol=0.01)
    assert Bandit(actor_gradient="dynamics").gradient(reward).abs().sum() == 0.0
    mixed = Bandit(actor_gradient="both", reinforce_share=0.25).gradient(reward)
    assert torch.allclose(mixed, 0.25 * expected, atol=0.01)


def test_the_mixture_goes_from_one_to_the_other() -> None:
    gradients = {}
    for kind, share in (("dynamics", 0.5), ("reinforce", 0.5), ("both", 0.0), ("both", 1.0), ("both", 0.3)):
        torch.manual_seed(0)
        gradients[kind, share] = Bandit(actor_gradient=kind, reinforce_share=share).gradient(torch.square, n=1000)
    dynamics, reinforce = gradients["dynamics", 0.5], gradients["reinforce", 0.5]
    assert torch.allclose(gradients["both", 0.0], dynamics, atol=1e-6)
    assert torch.allclose(gradients["both", 1.0], reinforce, atol=1e-6)
    assert torch.allclose(gradients["both", 0.3], 0.3 * reinforce + 0.7 * dynamics, atol=1e-6)


# ---- in a challenger ---------------------------------------------------------------------------------------------------


def imagine(challenger: Challenger) -> LatentState:
    batch = challenger.learner.to_device(random_batch(challenger.observation_space, challenger.action_dim))
    return challenger.learner.imagination_starts(batch, challenger.world_model.loss(batch))


@pytest.mark.parametrize("kind", KINDS)
def test_the_actor_learns_with_the_critic_zeroed_and_nobody_else_does(kind: str) -> None:
    challenger = small(actor_gradient=kind, exploration_entropy_scale=0.0)
    exploration, start = challenger.exploration, imagine(challenger)
    with torch.no_grad():
        for parameter in exploration.target_critic.parameters():
            parameter.zero_()
    before = weights(challenger)
    metrics = update(challenger, start, challenger.learner.imagined_novelty)
    assert metrics["exploration_actor_grad_norm"] > 0 and metrics["exploration_critic_grad_norm"] > 0
    changed = {key for key, value in weights(challenger).items() if not np.array_equal(value, before[key])}
    expected = {key for key in before if key.startswith(("exploration.actor", "exploration.critic"))}
    assert changed == expected | {"exploration.updates"}
    assert all(parameter.grad is None for network in challenger.networks.values() for parameter in network.parameters())


@pytest.mark.parametrize("kind", KINDS)
def test_entropy_is_rewarded_by_its_scale(kind: str) -> None:
    """Where nothing else is rewarded the policy becomes as wide as it can, in proportion to the scale."""
    spread = []
    for scale in (0.0, 1.0):
        torch.manual_seed(0)
        challenger = small(actor_gradient=kind, exploration_entropy_scale=scale, actor_lr=3e-3)
        start = imagine(challenger)
        with torch.no_grad():
            for parameter in challenger.exploration.target_critic.parameters():
                parameter.zero_()

        def nothing(imagined: Imagination) -> torch.Tensor:
            return 0.0 * imagined.next_feats.sum(-1)

        for _ in range(60):
            metrics = update(challenger, start, nothing)
        spread.append(metrics["exploration_entropy"].item())
    assert spread[1] > spread[0] + 0.01 and spread[1] > 0.95 * 2 * math.log(2.0)  # the uniform policy's entropy, two actions


@pytest.mark.parametrize("kind", KINDS)
def test_starts_that_count_for_nothing_have_no_influence(kind: str) -> None:
    """What CUDA graphs are filled up with."""
    challenger = small(actor_gradient=kind)
    exploration, start = challenger.exploration, imagine(challenger)
    share, other = torch.ones(16), LatentState(*(part.clone() for part in start))
    share[10:], share[:10] = 0.0, 1.6
    for part in other:
        part[10:] += 1.0
    found = []
    for states in (start, other):
        torch.manual_seed(0)
        arguments = (challenger.world_model, states, challenger.learner.imagined_novelty, challenger.optimizers)
        found.append((exploration.losses(*arguments, share), exploration.losses(*arguments)))
    (one, alike), (another, different) = found
    for left, right in zip((one.actor, *one.actor_gradients), (another.actor, *another.actor_gradients), strict=True):
        torch.testing.assert_close(left, right)
    for left, right in zip((one.critic, *one.critic_gradients), (another.critic, *another.critic_gradients), strict=True):
        torch.testing.assert_close(left, right)
    torch.testing.assert_close(one.metrics, another.metrics)
    assert not torch.isclose(alike.critic, different.critic)


@pytest.mark.parametrize(("horizon", "same"), [(1, True), (3, False)])
def test_the_gradient_through_the_actors_input(horizon: int, same: bool) -> None:
    """Concerns the actions after the first alone, and changes what the actor learns but not what it imagines."""
    challenger = small(horizon=horizon, exploration_entropy_scale=0.0)
    found = []
    for through in (True, False):
        challenger.exploration.preset = replace(challenger.exploration.preset, actor_input_gradient=through)
        torch.manual_seed(0)
        start = imagine(challenger)
        found.append(
            challenger.exploration.losses(
                challenger.world_model, start, lambda imagined: imagined.next_feats.sum(-1), challenger.optimizers
            )
        )
    exact, stopped = found
    assert torch.equal(exact.actor, stopped.actor)
    close = [torch.allclose(*pair, atol=1e-6) for pair in zip(exact.actor_gradients, stopped.actor_gradients, strict=True)]
    assert all(close) is same


@pytest.mark.parametrize("kind", ["reinforce", "both"])
def test_save_load_train_is_train(kind: str, tmp_path: Any) -> None:
    challenger, batch = small(actor_gradient=kind, train_task_behavior=True), random_batch(VECTOR, 2)
    challenger.train(batch)
    challenger.save(tmp_path / "challenger.pt")
    expected = [challenger.train(batch) for _ in range(2)]
    loaded = Challenger.load(tmp_path / "challenger.pt", "cpu", restore_rng=True)
    assert [loaded.train(batch) for _ in range(2)] == expected


@pytest.mark.parametrize(
    "entries, message",
    [
        ({"actor_gradient": "pathwise"}, "'actor_gradient' must be one of"),
        ({"reinforce_share": 1.5}, "'reinforce_share' must be a number from 0 to 1"),
        ({"amp": "yes"}, "'amp' must be one of"),
    ],
)
def test_wrong_entries(entries: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_preset("default", **entries)


# ---- mixed precision and compilation -------------------------------------------------------------------------------------

CATEGORICAL = {**SMALL, "latent": "categorical", "stoch_size": 4, "stoch_classes": 5}


@pytest.mark.parametrize("preset", [SMALL, CATEGORICAL, {**SMALL, "actor_gradient": "both"}])
def test_mixed_precision_is_off_by_default_and_changes_little(preset: dict[str, Any]) -> None:
    results = []
    for amp in ({}, {"amp": False}, {"amp": True}):
        torch.manual_seed(0)
        challenger = small(BOTH, preset=preset, **amp)
        results.append([challenger.train(random_batch(BOTH, 2, seed=seed)) for seed in range(3)])
    assert results[0] == results[1] and results[0] != results[2]
    for exact, rounded in zip(results[0], results[2], strict=True):
        for key in (
            "world_model_loss",
            "kl_loss",
            "kl",
            "image_loss",
            "reward_loss",
            "uncertainty_loss",
            "exploration_critic_loss",
        ):
            assert rounded[key] == pytest.approx(exact[key], rel=0.05, abs=0.01), key


def test_mixed_precision_computes_in_bfloat16_and_keeps_float32_where_it_counts() -> None:
    challenger = small(BOTH, amp=True)
    batch, seen = challenger.learner.to_device(random_batch(BOTH, 2)), set()
    linear = challenger.world_model.decoder.cnn.linear  # type: ignore[union-attr]
    linear.register_forward_hook(lambda module, inputs, output: seen.add(output.dtype))
    with acceleration.mixed_precision(challenger.device, True):
        output = challenger.world_model.loss(batch)
        start = challenger.learner.imagination_starts(batch, output)
        imagined = challenger.exploration.imagine(challenger.world_model, start)
    assert seen == {torch.bfloat16}
    kept = (*output.losses.values(), *output.metrics.values(), *output.posterior, output.embed, *imagined)
    assert {part.dtype for part in kept} == {torch.float32}
    assert {part.dtype for network in challenger.networks.values() for part in network.parameters()} == {torch.float32}
    dtypes = {p.dtype for p in challenger.optimizers["world_model"].adam.state_dict()["state"].values() for p in p.values()}
    challenger.train(random_batch(BOTH, 2))
    assert dtypes <= {torch.float32}
    assert challenger.act(challenger.initial_state(2)).dtype == np.float32


def test_a_gpu_without_bfloat16_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_bf16_supported", lambda: False)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda device: "an old one")
    with pytest.raises(ValueError, match="bfloat16, which an old one does not have"):
        acceleration.check_mixed_precision(torch.device("cuda"))


def test_without_a_compiler_everything_runs_and_a_warning_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_compiler(function: Any) -> Any:
        raise RuntimeError("InvalidCxxCompiler: No working C++ compiler found")

    monkeypatch.setattr(torch, "compile", no_compiler)
    acceleration.why_not_compile.cache_clear()
    with pytest.warns(UserWarning, match="compile=True has no effect.*No working C\\+\\+ compiler found.*Install"):
        challenger = small(compile=True)
    assert challenger.compiled is False
    acceleration.why_not_compile.cache_clear()
    torch.manual_seed(0)
    plain, again = small(), random_batch(VECTOR, 2)
    assert np.isfinite(challenger.train(again)["kl"]) and np.isfinite(plain.train(again)["kl"])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # the compiler's own
@pytest.mark.skipif(
    shutil.which("g++") is None and shutil.which("clang++") is None, reason="torch.compile needs a C++ compiler"
)
def test_compiled_it_computes_the_same(tmp_path: Any) -> None:
    reason = acceleration.why_not_compile("cpu")
    if reason:
        pytest.skip(f"torch.compile does not work here: {reason}")
    results = []
    for compiled in (False, True):
        torch.manual_seed(0)
        challenger = small(compile=compiled)
        assert challenger.compiled is compiled
        results.append([challenger.train(random_batch(VECTOR, 2, seed=seed)) for seed in range(2)])
    for one, other in zip(*results, strict=True):
        assert one == pytest.approx(other, rel=1e-3, abs=1e-4)
    challenger.save(tmp_path / "challenger.pt")  # compiled weights have the same names
    small().load_state(tmp_path / "challenger.pt")
