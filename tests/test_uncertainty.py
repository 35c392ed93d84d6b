"""LatentDisagreement: ensemble, exp metric and its dynamic scale (SPEC of the method, section 2)."""

import math

import pytest
import torch

from sb3_cpm.uncertainty.base import LatentSizes, Transitions
from sb3_cpm.uncertainty.latent_disagreement import Ensemble, ExpScale, LatentDisagreement

SIZES = LatentSizes(feat=6, action=2, stoch=2, deter=4, embed=5)


def transitions(n: int = 32) -> Transitions:
    return Transitions(torch.randn(n, 6), torch.rand(n, 2), torch.randn(n, 2), torch.randn(n, 4), torch.randn(n, 5))


def make(**kwargs: object) -> LatentDisagreement:
    return LatentDisagreement(SIZES, **{"heads": 4, "layers": 1, "units": 16, **kwargs})  # type: ignore[arg-type]


def test_the_ensemble_is_k_separate_networks() -> None:
    ensemble, inputs = Ensemble(3, 5, 2, layers=2, units=7), torch.randn(4, 5)
    outputs = ensemble(inputs)
    for head in range(3):
        hidden = inputs
        for layer in range(3):
            hidden = hidden @ ensemble.weights[layer][head] + ensemble.biases[layer][head]
            hidden = hidden if layer == 2 else torch.nn.functional.elu(hidden)
        assert torch.allclose(outputs[head], hidden, atol=1e-6)
    assert not torch.allclose(outputs[0], outputs[1])


def test_disagreement_is_the_std_over_heads_averaged_over_dimensions() -> None:
    measure, batch = make(), transitions()
    expected = torch.stack(measure.predict(batch)).std(dim=0, correction=0).mean(-1)
    assert torch.allclose(measure.raw(batch), expected, atol=1e-5)
    assert torch.allclose(measure.novelty(batch), torch.expm1(measure.k * expected), rtol=1e-3)


def test_any_batch_dimensions() -> None:
    measure, batch = make(), transitions(12)
    grid = Transitions(*(part.unflatten(0, (3, 4)) for part in batch if part is not None))
    assert torch.allclose(measure.novelty(grid).flatten(), measure.novelty(batch), rtol=1e-5)


@pytest.mark.parametrize("target, size", [("feat", 6), ("stoch", 2), ("deter", 4), ("embed", 5)])
def test_targets(target: str, size: int) -> None:
    measure, batch = make(target=target), transitions()
    assert measure.targets(batch).shape == (32, size) and torch.stack(measure.predict(batch)).shape == (4, 32, size)
    assert torch.isfinite(measure.loss(batch))


def test_exp_metric_neither_overflows_nor_loses_order_or_gradient() -> None:
    measure = make(exponent_limit=5.0)
    measure.k.fill_(1e8)
    d = torch.tensor([0.0, 1e-9, 1.0, 1e10], requires_grad=True)
    rated = measure.rate(d)
    assert torch.isfinite(rated).all() and (rated.diff() > 0).all() and rated[0] == 0.0
    rated.sum().backward()
    assert d.grad is not None and (d.grad > 0).all() and torch.isfinite(d.grad).all()
    measure.k.fill_(1.0)
    assert torch.allclose(measure.rate(torch.tensor([1.0, 5.0])), torch.tensor([math.e - 1, math.exp(5) - 1]))
    assert torch.allclose(measure.rate(torch.tensor([6.0])), torch.tensor([2 * math.exp(5) - 1]))  # the straight line


def test_log_metric() -> None:
    measure = make(metric="log")
    assert not measure.nonnegative
    assert torch.allclose(measure.rate(torch.tensor([1.0, 0.1])), torch.tensor([1.0, 0.1]).log(), atol=1e-4)
    assert "exp_scale" in measure.adapt(transitions()) and measure.k == 1.0


def test_the_first_valid_batch_calibrates_k() -> None:
    measure = make()
    for useless in (torch.zeros(8), torch.full((8,), math.nan), torch.zeros(0)):
        measure._adapt_scale(useless)
        assert measure.k == 1.0 and not measure.calibrated
    d = torch.rand(1000) * 0.01
    measure._adapt_scale(d)
    assert torch.quantile(measure.k * d, 0.75).item() == pytest.approx(1.0, rel=1e-4)


def test_the_scale_adapts_to_what_the_heads_said_while_they_learnt() -> None:
    """No second prediction of the same transitions, unless they are others."""
    measure, batch, predicted, rated = make(), transitions(600), [], []
    raw, predict, rate = measure.raw(batch)[::3].detach(), measure.predict, measure.raw
    measure.predict = lambda given: predicted.append(len(given.feat)) or predict(given)  # type: ignore[method-assign]
    measure.raw = lambda given: rated.append(len(given.feat)) or rate(given)  # type: ignore[method-assign]
    measure.loss(batch)
    assert measure.adapt(batch)["raw_disagreement"] == pytest.approx(raw.mean().item(), rel=1e-5)
    assert (predicted, rated) == ([600], [])
    measure.loss(batch)
    measure.adapt(transitions(600))
    measure.adapt(batch)
    assert (predicted, rated) == ([600, 600], [200, 200])


def test_k_is_moved_by_its_factor_only_outside_of_the_intervals() -> None:
    rule = ExpScale(mean_range=(0.4, 1.2), max_range=(1.0, 5.0), factor=1.5)
    inside, low, high = torch.tensor([0.2, 1.4]), torch.tensor([0.1, 0.2]), torch.tensor([1.0, 3.0])
    assert rule.next(2.0, inside / 2.0) == 2.0
    assert rule.next(2.0, low / 2.0) == 3.0  # mean 0.15 and maximum 0.2 both too low
    assert rule.next(2.0, high / 2.0) == pytest.approx(2.0 / 1.5)  # mean 2 too high
    # mean too low, maximum nearly too high: they contradict each other
    assert rule.next(2.0, torch.tensor([0.1] * 30 + [4.5]) / 2.0) == 2.0


@pytest.mark.parametrize("odd", [torch.tensor([math.nan, 1.0]), torch.tensor([math.inf]), torch.zeros(3), torch.zeros(0)])
def test_statistics_that_say_nothing_leave_k_alone(odd: torch.Tensor) -> None:
    assert ExpScale().next(7.0, odd) == 7.0


def test_k_stays_within_its_bounds() -> None:
    rule, k = ExpScale(), 1.0
    for _ in range(200):
        k = rule.next(k, torch.full((4,), 1e-30))
    assert k == 1e8
    for _ in range(200):
        k = rule.next(k, torch.full((4,), 1e30))
    assert k == 1e-8


@pytest.mark.parametrize("level", [1e-6, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("tail", [1.0, 3.0, 30.0])
def test_k_settles_near_its_aim_and_does_not_oscillate(level: float, tail: float) -> None:
    rule, k = ExpScale(), 1.0
    d = torch.rand(1000) * level
    d[0] = tail * level
    for _ in range(100):
        k = rule.next(k, d)
    assert rule.next(k, d) == k
    if tail <= 3.0:
        assert 0.4 < float(torch.quantile(k * d, 0.75)) < 2.0


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"target": "state"}, "`target` must be one of"),
        ({"metric": "sqrt"}, "`metric` must be one of"),
        ({"heads": 1}, "at least two"),
        ({"mean_range": (0.5, 1.0)}, "mean_range=.* too narrow"),
        ({"max_range": (1.0, 2.0)}, "max_range=.* too narrow"),
    ],
)
def test_wrong_arguments(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_disagreement_is_lower_on_data_seen_often() -> None:
    measure = make(heads=5, units=32)
    seen, new = transitions(256), transitions(256)
    new = new._replace(feat=new.feat + 6.0 * torch.sign(new.feat))
    adam = torch.optim.Adam(measure.parameters(), lr=3e-3)
    before = measure.raw(seen).mean()
    for _ in range(300):
        adam.zero_grad()
        measure.loss(seen).backward()
        adam.step()
    with torch.no_grad():
        assert measure.raw(seen).mean() < 0.5 * before
        assert measure.raw(seen).mean() < 0.3 * measure.raw(new).mean()
