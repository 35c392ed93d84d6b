"""
Errors found in earlier PyTorch ports of DreamerV2 and Plan2Explore, one test for each that can occur here.

The numbers are those of the project's list of such errors; each docstring says what went wrong elsewhere.
"""

from typing import Any

import numpy as np
import pytest
import torch
from challenger_helpers import BOTH, IMAGES, SMALL, VECTOR, box, random_batch, small, update, weights
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_cpm.challenger import Challenger
from sb3_cpm.uncertainty.base import LatentSizes, Transitions
from sb3_cpm.uncertainty.latent_disagreement import TARGETS, LatentDisagreement
from sb3_cpm.world_model.distributions import CategoricalLatent, GaussianLatent, TruncatedNormal
from sb3_cpm.world_model.losses import balanced_kl, lambda_returns
from sb3_cpm.world_model.optimizer import Optimizer
from sb3_cpm.world_model.rssm import RSSM, LatentState
from sb3_cpm.world_model.world_model import Sequences, WorldModelOutput

CATEGORICAL = {**SMALL, "latent": "categorical", "stoch_size": 4, "stoch_classes": 5}


def imagine(challenger: Challenger, seed: int = 0) -> Any:
    """One imagination from states of a random batch."""
    batch = challenger.learner.to_device(random_batch(challenger.observation_space, challenger.action_dim, seed=seed))
    start = challenger.learner.imagination_starts(batch, challenger.world_model.loss(batch))
    return challenger.exploration.imagine(challenger.world_model, start)


def test_01_lambda_returns_run_forward_in_time() -> None:
    """1: lambda-returns came out reversed in time."""
    rewards, values, discounts = torch.randn(6, 4), torch.randn(6, 4), torch.rand(6, 4)
    assert torch.equal(lambda_returns(rewards, values, torch.zeros(6, 4), 0.95), rewards)
    following, naive = values[-1], []
    for i in reversed(range(6)):
        following = rewards[i] + discounts[i] * (0.05 * values[i] + 0.95 * following)
        naive.insert(0, following)
    assert torch.allclose(lambda_returns(rewards, values, discounts, 0.95), torch.stack(naive), atol=1e-6)


@pytest.mark.parametrize("loc", [-1.0, -0.99, 0.0, 1.0])
@pytest.mark.parametrize("scale", [0.1, 0.5, 2.1])
def test_02_the_truncated_normal_is_one(loc: float, scale: float) -> None:
    """2: a third of the "truncated" actions lay outside of [-1, 1], and the density had mass 0.64."""
    mean = torch.full((5000, 1), loc, requires_grad=True)
    std = torch.full((5000, 1), scale, requires_grad=True)
    samples = TruncatedNormal(mean, std).rsample()
    assert samples.min() >= -1.0 and samples.max() <= 1.0
    assert ((samples == -1.0) | (samples == 1.0)).float().mean() < 0.01, "clipped, not truncated"
    gradients = torch.autograd.grad(samples.sum(), [mean, std])
    assert all(torch.isfinite(gradient).all() and gradient.abs().sum() > 0 for gradient in gradients)
    grid = torch.linspace(-1, 1, 40001)[:, None]
    policy = TruncatedNormal(torch.tensor([loc]), torch.tensor([scale]))
    assert torch.trapezoid(policy.log_prob(grid).exp(), grid[:, 0]).item() == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("action_dim", [1, 7])
def test_02_all_actions_are_in_bounds(action_dim: int) -> None:
    """2: real and imagined actions alike, also of an actor with huge outputs."""
    challenger = small(action_dim=action_dim)
    for scale in (1.0, 1e3):
        with torch.no_grad():
            challenger.exploration.actor.net[-1].weight.mul_(scale)
        imagined = imagine(challenger)
        assert imagined.actions.abs().max() <= 1.0
        assert all(torch.isfinite(part).all() for part in imagined)
        state = LatentState(*(torch.randn_like(part) for part in challenger.initial_state(100)))
        for deterministic in (True, False):
            assert np.abs(challenger.act(state, deterministic)).max() <= 1.0


def test_03_weight_decay_is_applied() -> None:
    """3: clipping exhausted the generator of parameters, so that nothing was left to decay."""
    challenger = small(preset={**SMALL, "model_lr": 0.0, "weight_decay": 0.01})
    before = {key: value.clone() for key, value in challenger.world_model.named_parameters()}
    challenger.train(random_batch(VECTOR, 2))
    for key, value in challenger.world_model.named_parameters():
        factor = 0.99 if value.dim() > 1 else 1.0
        assert torch.allclose(value, before[key] * factor, rtol=1e-6), key


def test_04_the_batch_is_not_changed() -> None:
    """4: the discount of the batch was multiplied in place."""
    batch, copy = random_batch(BOTH, 2), random_batch(BOTH, 2)
    small(BOTH).train(batch)
    for key, value in copy.observations.items():
        assert np.array_equal(batch.observations[key], value)
    for one, other in zip(batch[1:], copy[1:], strict=True):
        assert np.array_equal(one, other)


def test_05_short_episodes_are_padded_and_masked() -> None:
    """5: episodes no longer than the sequence were dropped. What stands in the padding must not matter."""
    trained = []
    for filling in (0.0, 37.0):
        torch.manual_seed(1)
        challenger, batch = small(), random_batch(VECTOR, 2)
        batch.mask[5:, 1] = batch.mask[3:, 2] = False
        for array in (batch.observations["state"], batch.actions, batch.rewards):
            array[~batch.mask] = filling
        batch.is_terminal[~batch.mask] = batch.is_first[~batch.mask] = filling > 0
        challenger.train(batch)
        trained.append(weights(challenger))
    for key, value in trained[0].items():
        assert np.allclose(value, trained[1][key], atol=1e-5), key  # resets in the padding change the order of rounding


def test_06_what_follows_a_schedule_changes_with_updates() -> None:
    """6: schedules stayed frozen at step 0. Ours: the slow critic's copies, the exp scale, the counter of updates."""
    challenger = small(slow_target_every=3)
    exploration, batch = challenger.exploration, random_batch(VECTOR, 2)
    equal, scales = [], []
    for _ in range(6):
        scales.append(challenger.train(batch)["exp_scale"])
        pairs = zip(exploration.critic.parameters(), exploration.target_critic.parameters(), strict=True)
        equal.append(all(torch.equal(one, other) for one, other in pairs))
    assert equal == [False, False, True, False, False, True] and challenger.trained_updates == 6
    assert scales[0] != 1.0


@pytest.mark.parametrize("latent", [GaussianLatent(3), CategoricalLatent(2, 4)])
@pytest.mark.parametrize("balance", [0.0, 0.5, 0.8, 1.0])
@pytest.mark.parametrize("free_nats", [0.0, 1.0, 100.0])
def test_07_kl_balancing(latent: GaussianLatent | CategoricalLatent, balance: float, free_nats: float) -> None:
    """7: KL balancing crashed or mixed the sides up."""
    posterior, prior = torch.randn(2, 5, 4, latent.stats_size).requires_grad_(True).unbind(0)
    mask = torch.rand(5, 4) < 0.8
    loss, mean = balanced_kl(latent, posterior, prior, mask, balance, free_nats)
    kl = latent.kl(posterior, prior)[mask].mean()
    assert torch.allclose(mean, kl, rtol=1e-5) and not mean.requires_grad
    assert torch.allclose(loss, kl.clamp(min=free_nats), rtol=1e-5)
    found = torch.autograd.grad(loss, [posterior, prior], retain_graph=True)
    full = torch.autograd.grad(kl, [posterior, prior])
    active = float(kl > free_nats)
    assert torch.allclose(found[0], active * (1 - balance) * full[0], atol=1e-6)
    assert torch.allclose(found[1], active * balance * full[1], atol=1e-6)


def test_07_kl_of_zero_costs_the_free_nats_and_has_no_gradient() -> None:
    """7: the same at the point where maximum and value meet."""
    latent, stats = GaussianLatent(3), torch.randn(5, 4, 6, requires_grad=True)
    loss, _ = balanced_kl(latent, stats, stats * 1.0, torch.ones(5, 4, dtype=torch.bool), 0.8, 1.0)
    assert loss.item() == pytest.approx(1.0) and torch.autograd.grad(loss, stats)[0].abs().sum() == 0.0


@pytest.mark.parametrize("action_dim", [1, 2, 7])
@pytest.mark.parametrize("space", [VECTOR, IMAGES, BOTH])
def test_08_every_number_of_actions_works(space: Any, action_dim: int) -> None:
    """8: distributions worked for two action dimensions only."""
    challenger = small(space, action_dim)
    metrics = challenger.train(random_batch(space, action_dim))
    assert all(np.isfinite(value) for value in metrics.values())
    assert challenger.act(challenger.initial_state(3)).shape == (3, action_dim)
    batch = random_batch(space, action_dim, length=7, n=1)
    evaluation = challenger.evaluate({k: v[:, 0] for k, v in batch.observations.items()}, batch.actions[1:, 0])
    assert evaluation.disagreement.shape == evaluation.kl.shape == (6,)
    assert evaluation.embeddings.shape == (7, challenger.world_model.embed_dim)


def test_09_every_camera_is_scaled() -> None:
    """9: the second camera entered unscaled, 0 to 255, and 32x32 images did not work."""
    challenger = small(BOTH)
    images = challenger.learner.to_device(random_batch(BOTH, 2)).inputs.images
    assert images is not None and images.shape[1:] == (6, 32, 32)
    for camera in images.split(3, dim=1):
        assert -0.5 <= camera.min() < -0.4 and 0.4 < camera.max() <= 0.5


def test_10_nothing_before_a_reset_matters_after_it() -> None:
    """10: is_first was ignored."""
    rssm = RSSM(GaussianLatent(4), deter_size=8, hidden_size=8, embed_dim=5, action_dim=2)
    embed, actions = torch.randn(6, 1, 5), torch.rand(6, 1, 2)
    is_first = torch.zeros(6, 1, dtype=torch.bool)
    is_first[3] = True
    whole = rssm.observe(embed, actions, is_first, deterministic=True)
    embed[:3], actions[:4] = torch.nan, torch.nan  # the action into the reset row included
    again = rssm.observe(embed, actions, is_first, deterministic=True)
    assert torch.isnan(again.deter[:3]).any()
    for one, other in zip(whole, again, strict=True):
        assert torch.equal(one[3:], other[3:])
    assert torch.equal(rssm.prior(whole.deter[3:]), rssm.prior(again.deter[3:]))


@pytest.mark.slow
def test_10_termination_ends_the_return_and_truncation_bootstraps() -> None:
    """10: is_terminal was ignored, or every end of an episode was taken for a termination."""
    rewards, values = torch.ones(3, 1), torch.full((3, 1), 50.0)
    assert lambda_returns(rewards, values, torch.zeros(3, 1), 0.95)[0].item() == 1.0
    assert lambda_returns(rewards, values, torch.full((3, 1), 0.9), 0.95)[-1].item() == pytest.approx(1.0 + 0.9 * 50.0)
    # the continue head learns from is_terminal alone
    challenger, batch = small(), random_batch(VECTOR, 2)
    batch.is_terminal[:] = batch.observations["state"][..., 0] > 0
    for _ in range(150):
        challenger.train(batch)
    sequences = challenger.learner.to_device(batch)
    goes_on = challenger.world_model.continue_probability(challenger.world_model.loss(sequences).posterior.feat)
    assert goes_on[sequences.is_terminal].mean() < 0.3 < 0.7 < goes_on[~sequences.is_terminal].mean()


def test_10_imagination_does_not_start_where_an_episode_ended() -> None:
    """10: there is nothing to be imagined behind a termination."""
    challenger, batch = small(imagination_starts=None), random_batch(VECTOR, 2)
    batch.mask[6:, 3] = False
    sequences = challenger.learner.to_device(batch)
    start = challenger.learner.imagination_starts(sequences, challenger.world_model.loss(sequences))
    assert len(start.deter) == (batch.mask & ~batch.is_terminal).sum()


@pytest.mark.parametrize("preset", [SMALL, {**CATEGORICAL, "train_task_behavior": True}])
def test_11_save_load_train_is_train(tmp_path: Any, preset: dict) -> None:
    """11: optimizers, slow-target counters and random states were missing in checkpoints."""
    challenger = small(BOTH, preset={**preset, "slow_target_every": 4})
    batch = random_batch(BOTH, 2)
    for _ in range(2):
        challenger.train(batch)
    challenger.save(tmp_path / "challenger.pt")
    expected = [challenger.train(batch) for _ in range(3)]
    torch.rand(7)
    loaded = Challenger.load(tmp_path / "challenger.pt", "cpu", restore_rng=True)
    assert [loaded.train(batch) for _ in range(3)] == expected
    assert loaded.trained_updates == 5
    after = weights(loaded)
    for key, value in weights(challenger).items():
        assert np.array_equal(value, after[key]), key


def test_12_behaviour_does_not_train_the_world_model() -> None:
    """12: the exploration update back-propagated into the world model."""
    challenger = small()
    batch = challenger.learner.to_device(random_batch(VECTOR, 2))
    start = challenger.learner.imagination_starts(batch, challenger.world_model.loss(batch))
    before = weights(challenger)
    update(challenger, start, challenger.learner.imagined_novelty)
    assert all(parameter.grad is None for network in challenger.networks.values() for parameter in network.parameters())
    after = weights(challenger)
    changed = {key for key, value in before.items() if not np.array_equal(value, after[key])}
    assert changed and all(
        key.startswith(("exploration.actor", "exploration.critic", "exploration.updates")) for key in changed
    )


def test_13_the_scan_is_linear_in_time() -> None:
    """13: results were concatenated in every step, O(T^2)."""

    class Elements(TorchDispatchMode):
        count = 0

        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            result = func(*args, **(kwargs or {}))
            self.count += result.numel() if isinstance(result, torch.Tensor) else 0
            return result

    rssm = RSSM(GaussianLatent(4), deter_size=8, hidden_size=8, embed_dim=5, action_dim=2)
    counts = []
    for length in (25, 50, 100):
        with Elements() as mode, torch.no_grad():
            rssm.observe(torch.zeros(length, 2, 5), torch.zeros(length, 2, 2), torch.zeros(length, 2, dtype=torch.bool))
        counts.append(mode.count)
    assert counts[2] / counts[1] < 2.1 and counts[1] / counts[0] < 2.1


def crafted(challenger: Challenger, rows: torch.Tensor, actions: torch.Tensor, is_first: torch.Tensor) -> tuple:
    """A batch whose posterior is given: deter from ``rows``, everything else zero."""
    length, n = is_first.shape
    zeros = torch.zeros(length, n, challenger.world_model.latent.stats_size)
    posterior = LatentState(rows, zeros[..., : challenger.world_model.latent.size], zeros)
    mask = torch.ones_like(is_first)
    batch = Sequences(None, actions, torch.zeros(length, n), is_first, ~mask, mask)  # type: ignore[arg-type]
    return batch, WorldModelOutput({}, {}, posterior, torch.zeros(length, n, challenger.world_model.embed_dim))


def test_14_state_and_action_are_paired_so_that_they_tell_the_next_state() -> None:
    """14: state t was paired with the action that led to it, which says nothing about state t+1."""
    challenger = small(uncertainty_kwargs={"target": "deter", "units": 64}, uncertainty_lr=3e-3)
    losses = []
    for _ in range(400):  # every state is the action that led to it and nothing else
        actions = torch.rand(8, 16, 2) * 2 - 1
        rows = torch.cat((actions, torch.zeros(8, 16, 14)), dim=-1)
        batch, output = crafted(challenger, rows, actions, torch.zeros(8, 16, dtype=torch.bool))
        losses.append(challenger.learner.train_uncertainty(batch, output)["uncertainty_loss"].item())
    assert np.mean(losses[-20:]) < 0.02 * losses[0]


def test_15_no_transition_crosses_an_episode_boundary() -> None:
    """15: the ensemble learnt to "predict" resets, just behind the last states of episodes."""
    losses = []
    for value in (0.0, 9.0):
        torch.manual_seed(0)
        challenger = small()
        rows, actions = torch.randn(5, 2, 16), torch.rand(5, 2, 2)
        is_first = torch.zeros(5, 2, dtype=torch.bool)
        is_first[4] = True
        rows[4] = value
        losses.append(
            challenger.learner.train_uncertainty(*crafted(challenger, rows, actions, is_first))["uncertainty_loss"].item()
        )
    assert losses[0] == losses[1]


def test_16_heads_reach_targets_far_from_zero() -> None:
    """16: heads with tanh at the end could not reach their targets."""
    measure = LatentDisagreement(LatentSizes(2, 1, 1, 1, 1), heads=3, layers=1, units=32, target="deter")
    feat = torch.randn(64, 2)
    batch = Transitions(feat, torch.zeros(64, 1), feat[:, :1], 10.0 * feat[:, :1].clamp(-1.0, 1.0))
    adam = torch.optim.Adam(measure.parameters(), lr=1e-2)
    for _ in range(500):
        adam.zero_grad()
        measure.loss(batch).backward()
        adam.step()
    assert (torch.stack(measure.predict(batch)) - batch.next_deter).abs().median() < 1.0


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("preset", [SMALL, CATEGORICAL])
@pytest.mark.parametrize("metric", ["exp", "log"])
def test_17_plan2explore_runs(target: str, preset: dict, metric: str) -> None:
    """17: heads in a plain list, an optimizer with other parameters, log(0), a method that shadows ``Module.train``."""
    challenger = small(preset=preset, uncertainty_kwargs={"target": target, "metric": metric})
    before = weights(challenger)
    assert np.isfinite(challenger.train(random_batch(VECTOR, 2))["disagreement"])
    after = weights(challenger)
    heads = [key for key in before if key.startswith("uncertainty.ensemble.weights")]
    assert len(heads) == 2 and all((before[key] != after[key]).any() for key in heads)
    owned = challenger.optimizers["uncertainty"].parameters
    assert {id(parameter) for parameter in owned} == {id(parameter) for parameter in challenger.uncertainty.parameters()}
    for network in challenger.networks.values():
        assert network.eval().training is False and network.train().training is True


@pytest.mark.parametrize("metric", ["exp", "log"])
def test_17_identical_heads_are_finite_and_minimal(metric: str) -> None:
    """17: the logarithm of a disagreement of zero, and the infinite slope of its root."""
    measure = LatentDisagreement(LatentSizes(3, 2, 1, 2, 1), heads=4, layers=1, units=8, metric=metric)
    batch = Transitions(torch.randn(9, 3, requires_grad=True), torch.rand(9, 2), torch.zeros(9, 1), torch.zeros(9, 2))
    different = measure.novelty(batch).detach()
    with torch.no_grad():
        for parameter in measure.ensemble.parameters():
            parameter.copy_(parameter[:1].expand_as(parameter))
    same = measure.novelty(batch)
    assert torch.isfinite(same).all() and (same < different).all()
    assert torch.isfinite(torch.autograd.grad(same.sum(), batch.feat)[0]).all()
    if metric == "exp":
        assert same.abs().max() < 1e-6 and same.min() >= 0.0


def test_18_novelty_itself_moves_the_actor() -> None:
    """18: rewards on detached states left a continuous actor without gradient."""
    challenger = small()
    with torch.no_grad():
        for parameter in challenger.exploration.target_critic.parameters():
            parameter.zero_()
    imagined = imagine(challenger)
    novelty = challenger.learner.imagined_novelty(imagined)
    assert novelty.shape == (SMALL["horizon"], len(imagined.feats[0]))
    for step in (0, 3):  # through the action at once, and through the dynamics later
        gradients = torch.autograd.grad(
            novelty[step].sum(), list(challenger.exploration.actor.parameters()), retain_graph=True
        )
        assert all(gradient.abs().sum() > 0 for gradient in gradients)


def test_18_learning_rates_arrive_and_all_heads_are_clipped() -> None:
    """18: one learning rate was used for all, and only the last head was clipped."""
    rates = {"model_lr": 1e-3, "uncertainty_lr": 2e-3, "actor_lr": 3e-3, "critic_lr": 4e-3}
    optimizers = small(preset={**SMALL, **rates}).optimizers
    found = {name: optimizer.adam.param_groups[0]["lr"] for name, optimizer in optimizers.items()}
    assert found == {"world_model": 1e-3, "uncertainty": 2e-3, "exploration_actor": 3e-3, "exploration_critic": 4e-3}
    measure = LatentDisagreement(LatentSizes(3, 2, 1, 2, 1), heads=4, layers=1, units=8)
    optimizer = Optimizer("uncertainty", [measure], 1e-3, clip=1e-12, eps=1.0, weight_decay=0.0)
    before = [parameter.clone() for parameter in measure.parameters()]
    batch = Transitions(torch.randn(9, 3), torch.rand(9, 2), torch.randn(9, 1), torch.randn(9, 2))
    assert optimizer.step(measure.loss(batch)) > 1.0
    for one, other in zip(before, measure.parameters(), strict=True):
        assert torch.allclose(one, other, atol=1e-9), "Adam's epsilon of 1 shows the size of the clipped gradient"


def test_19_evaluation_is_about_arriving_in_the_next_state() -> None:
    """19: rewards, KL and observations were shifted against each other by a row."""
    challenger = small(BOTH)
    batch = random_batch(BOTH, 2, length=9, n=1)
    observations, actions = {key: value[:, 0] for key, value in batch.observations.items()}, batch.actions[1:, 0]
    reference = challenger.evaluate(observations, actions)
    changed_state = {key: value.copy() for key, value in observations.items()}
    changed_state["state"][5] += 3.0
    other = challenger.evaluate(changed_state, actions)
    # state 5 is what transition 4 arrives in: its KL changes. Its novelty was known before arriving, that of leaving was not
    assert np.array_equal(reference.kl[:4], other.kl[:4]) and reference.kl[4] != other.kl[4]
    assert np.array_equal(reference.disagreement[:5], other.disagreement[:5])
    assert reference.disagreement[5] != other.disagreement[5]
    changed_action = actions.copy()
    changed_action[5] *= -1.0
    other = challenger.evaluate(observations, changed_action)
    assert np.array_equal(reference.disagreement[:5], other.disagreement[:5])
    assert np.array_equal(reference.kl[:5], other.kl[:5])
    assert reference.disagreement[5] != other.disagreement[5] and reference.kl[5] != other.kl[5]


def test_19_evaluated_kl_is_per_step_and_before_free_nats() -> None:
    """19: the KL of the loss is balanced, averaged and floored; the one in u_t is none of it."""
    values = []
    for free_nats in (0.0, 1e6):
        torch.manual_seed(0)
        challenger = small(free_nats=free_nats, kl_balance=0.3, kl_scale=7.0)
        batch = random_batch(VECTOR, 2, length=9, n=1)
        values.append(challenger.evaluate({"state": batch.observations["state"][:, 0]}, batch.actions[1:, 0]).kl)
    assert np.array_equal(*values) and len(np.unique(values[0])) == 8


def test_19_the_zero_of_a_reset_row_is_no_reward() -> None:
    """19: nothing was received for arriving in a reset state."""
    losses = []
    for reward in (0.0, 50.0):
        torch.manual_seed(0)
        challenger, batch = small(), random_batch(VECTOR, 2)
        batch.rewards[batch.is_first] = reward
        losses.append(challenger.train(batch)["reward_loss"])
    assert losses[0] == losses[1]


SWITCHES = [
    {"slow_target": False},
    {"continue_head": False},
    {"reward_gradient": False},
    {"symlog_vectors": False},
    {"symlog_rewards": False},
    {"train_task_behavior": True},
    {"imagination_starts": None},
    {"latent": "categorical", "stoch_classes": 4},
    {"vector_layers": 0},
    {"horizon": 1},
    {"weight_decay": 0.0},
    {"free_nats": 0.0},
    {"kl_balance": 0.5},
]


@pytest.mark.parametrize("switch", SWITCHES, ids=lambda switch: next(iter(switch)))
def test_20_every_switch_works(switch: dict) -> None:
    """20: ``slow_target=False`` crashed, and the device was cuda whatever the machine."""
    challenger = Challenger(BOTH, box(2), preset=SMALL, **switch)
    for _ in range(2):
        metrics = challenger.train(random_batch(BOTH, 2))
    assert all(np.isfinite(value) for value in metrics.values())
    assert ("task_actor_loss" in metrics) == switch.get("train_task_behavior", False)


def test_20_the_device_is_one_that_exists() -> None:
    """20: the device was cuda whatever the machine."""
    challenger = Challenger(VECTOR, box(2), preset=SMALL)
    assert challenger.device.type == ("cuda" if torch.cuda.is_available() else "cpu")
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="no GPU"):
            Challenger(VECTOR, box(2), device="cuda", preset=SMALL)
