"""What is computed by hand for speed gives what PyTorch gives: products, the scan, errors, disagreement."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from challenger_helpers import BOTH, random_batch, small
from torch import nn

from sb3_cpm.uncertainty import heads as heads_module
from sb3_cpm.uncertainty.ensemble import Ensemble, disagreement, ensemble_loss
from sb3_cpm.uncertainty.scale import root
from sb3_cpm.world_model.distributions import CategoricalLatent, GaussianLatent
from sb3_cpm.world_model.fast import acceleration, activation, one_hot
from sb3_cpm.world_model.fast import linear as linear_module
from sb3_cpm.world_model.fast.acceleration import cache_slices
from sb3_cpm.world_model.fast.activation import ELU, elu_
from sb3_cpm.world_model.fast.deconvolution import Deconvolution
from sb3_cpm.world_model.fast.linear import Linear, affine, is_faster, linear
from sb3_cpm.world_model.fast.one_hot import OneHot, OneHotLinear, find_choice
from sb3_cpm.world_model.losses import squared_error
from sb3_cpm.world_model.networks import MLP, ConvDecoder, ConvEncoder, frozen
from sb3_cpm.world_model.rssm import RSSM, LatentState

LATENTS = [GaussianLatent(4), CategoricalLatent(3, 5)]


def leaves(*shapes: tuple[int, ...], dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    return [torch.randn(*shape, dtype=dtype, requires_grad=True) for shape in shapes]


def gradients(function: Callable[..., torch.Tensor], inputs: list[torch.Tensor]) -> list[torch.Tensor]:
    """The result, and the gradients of a random weighting of it."""
    torch.manual_seed(7)
    result = function(*inputs)
    return [result, *torch.autograd.grad((result * torch.randn_like(result)).sum(), inputs)]


def assert_equal(found: list[torch.Tensor], expected: list[torch.Tensor], tolerance: float) -> None:
    for one, other in zip(found, expected, strict=True):
        size = other.abs().max().item() if other.numel() else 0.0
        assert torch.allclose(one, other, rtol=tolerance, atol=tolerance * size)


@pytest.fixture
def small_products(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also small matrices are multiplied by oneDNN, on any processor."""
    monkeypatch.setattr(linear_module, "MIN_MULTIPLICATIONS", 0)
    monkeypatch.setattr(linear_module, "prefers_onednn", linear_module.onednn_works)


# ---- dense layers ----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not linear_module.onednn_works(), reason="PyTorch was built without oneDNN's operator")
@pytest.mark.parametrize("batch", [(64,), (100,), (7, 10)])
def test_products_are_those_of_pytorch(batch: tuple[int, ...], small_products: None) -> None:
    inputs = leaves((*batch, 30), (20, 30), (20,))
    assert is_faster(inputs[0], 20)
    assert_equal(gradients(linear, inputs), gradients(F.linear, inputs), 1e-5)


@pytest.mark.parametrize("onednn", [True, False])
def test_products_without_gradients(onednn: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linear_module, "prefers_onednn", lambda: onednn and linear_module.onednn_works())
    x, matrix, bias, total = torch.randn(70, 30), torch.randn(30, 20), torch.randn(20), torch.randn(70, 20)
    expected, out = x @ matrix, torch.empty(70, 20)
    assert_equal([affine(x, matrix, bias)], [expected + bias], 1e-5)
    assert linear_module.multiply(x, matrix.t(), out=out) is out
    assert_equal([linear_module.multiply(x, matrix.t()), out], [expected, expected], 1e-5)
    expected = expected + total
    linear_module.add_product_(total, x, matrix.t())
    assert_equal([total], [expected], 1e-5)


def test_a_gradient_without_strides(small_products: None) -> None:
    inputs = leaves((70, 5), (3, 5), (3,))
    found = torch.autograd.grad(linear(*inputs).sum(), inputs)
    assert_equal(list(found), list(torch.autograd.grad(F.linear(*inputs).sum(), inputs)), 1e-5)


def test_everything_else_is_left_to_pytorch() -> None:
    assert is_faster(torch.zeros(300, 400), 400) == linear_module.prefers_onednn()
    assert not is_faster(torch.zeros(60, 4000), 400), "few rows"
    assert not is_faster(torch.zeros(300, 40), 40), "small matrices"
    assert not is_faster(torch.zeros(300, 400, dtype=torch.float64), 400)
    assert not is_faster(torch.zeros(0, 400), 400)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert not is_faster(torch.zeros(300, 400), 400)
        assert Linear(400, 400)(torch.zeros(300, 400)).dtype == torch.bfloat16


@pytest.mark.parametrize("vendor, faster", [("AuthenticAMD", True), ("GenuineIntel", False), ("", False)])
def test_the_processor_decides(vendor: str, faster: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acceleration, "processor", lambda: f"vendor_id : {vendor}")
    for module in (linear_module, activation):
        monkeypatch.setattr(module, "is_amd", acceleration.is_amd.__wrapped__)
    assert linear_module.prefers_onednn.__wrapped__() == (faster and linear_module.onednn_works())
    assert activation.is_faster(torch.zeros(activation.SLICE)) == (not faster)


def test_without_the_operator_the_same_is_computed(monkeypatch: pytest.MonkeyPatch, small_products: None) -> None:
    batch, losses = random_batch(BOTH, 2), []
    for works in (linear_module.onednn_works(), False):
        monkeypatch.setattr(linear_module, "prefers_onednn", lambda works=works: works)
        torch.manual_seed(0)
        challenger = small(BOTH, imagination_starts=None, sequence_length=32)
        losses.append([challenger.train(batch)["world_model_loss"] for _ in range(3)])
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)


def test_the_check_for_the_operator_draws_no_random_numbers() -> None:
    state = torch.get_rng_state()
    linear_module.onednn_works.__wrapped__()
    assert torch.equal(state, torch.get_rng_state())


@pytest.mark.parametrize("batch", [(), (0,), (7,), (3, 4), (5, 3, 100)])
def test_an_mlp_takes_any_batch_and_copies_no_gradient(batch: tuple[int, ...]) -> None:
    """An ELU in place on a view, which is what a layer returns for more than one batch dimension, would copy it."""
    net, inputs = MLP(6, 2, 8, 3), torch.randn(*batch, 6, requires_grad=True)
    result = net(inputs)
    assert result.shape == (*batch, 3)
    expected = inputs
    for layer in net:
        expected = F.elu(expected) if isinstance(layer, ELU) else F.linear(expected, layer.weight, layer.bias)
    assert_equal([result], [expected], 1e-5)
    names, waiting = set(), [result.grad_fn]
    while waiting:
        node = waiting.pop()
        names.add(type(node).__name__)
        waiting += [parent for parent, _ in node.next_functions if parent is not None]
    assert "CopySlices" not in names and "EluBackward1" in names


def test_frozen_weights_get_no_gradient_and_inputs_do(small_products: None) -> None:
    net, inputs = nn.Sequential(Linear(5, 4), Linear(4, 1)), torch.randn(70, 5, requires_grad=True)
    with frozen(net):
        result = net(inputs).sum()
    assert all(parameter.requires_grad for parameter in net.parameters())
    assert torch.autograd.grad(result, inputs, retain_graph=True)[0].abs().sum() > 0
    assert torch.autograd.grad(result, list(net.parameters()), allow_unused=True) == (None,) * 4
    net[0].bias.requires_grad_(False)
    with pytest.raises(KeyError), frozen(net):
        raise KeyError
    assert [parameter.requires_grad for parameter in net.parameters()] == [True, False, True, True]


# ---- scan ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("latent", LATENTS)
def test_the_scan_by_hand_is_the_plain_one(latent: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """In float64, with resets in the middle: all three outputs, and the gradients of every weight and input."""
    monkeypatch.setattr(torch.Tensor, "float", lambda tensor: tensor)  # which guards float32 where mixed precision is on
    rssm = RSSM(latent, deter_size=6, hidden_size=7, embed_dim=9, action_dim=2).double()
    for parameter in rssm.parameters():
        nn.init.normal_(parameter, std=0.5)
    is_first = torch.zeros(8, 4, dtype=torch.bool)
    is_first[0] = is_first[3, 1] = is_first[5] = True
    embed, actions = leaves((8, 4, 9), (8, 4, 2), dtype=torch.float64)
    start = LatentState(*(torch.randn_like(part) for part in rssm.initial_state(4)))
    trained = [embed, actions, *(weight for name, weight in rssm.named_parameters() if "prior" not in name)]
    results = []
    for by_hand in (True, False):
        monkeypatch.setattr(rssm, "_trains_by_hand", lambda _, by_hand=by_hand: by_hand)
        torch.manual_seed(1)
        states = rssm.observe(embed, actions, is_first, state=start)
        assert ("Scan" in type(states.deter.grad_fn).__name__) == by_hand
        torch.manual_seed(2)
        loss = sum((part * torch.randn_like(part)).sum() for part in states)
        results.append([*states, *torch.autograd.grad(loss, trained)])
    assert_equal(*results, 1e-12)


def test_the_scan_by_hand_trains_and_everything_else_does_not_use_it() -> None:
    challenger = small(BOTH)
    output = challenger.world_model.loss(challenger.learner.to_device(random_batch(BOTH, 2)))
    names, nodes = set(), [output.losses["kl"].grad_fn]
    while nodes:
        node = nodes.pop()
        if node is not None and node not in names:
            names.add(node)
            nodes += [following for following, _ in node.next_functions]
    assert any("Scan" in type(node).__name__ for node in names)
    rssm, embed = challenger.world_model.rssm, torch.zeros(1, requires_grad=True)
    assert rssm._trains_by_hand(embed) and not rssm._trains_by_hand(embed.detach())
    with torch.autocast("cpu", dtype=torch.bfloat16):  # it keeps float32 then
        output = challenger.world_model.loss(challenger.learner.to_device(random_batch(BOTH, 2)))
    assert {part.dtype for part in output.posterior} == {torch.float32}
    rssm._compiled_call_impl = rssm._call_impl  # what torch.compile leaves behind
    assert not rssm._trains_by_hand(embed)


@pytest.mark.parametrize("latent", LATENTS)
def test_samples_pull_gradients_back(latent: Any) -> None:
    (stats,) = leaves((6, latent.stats_size), dtype=torch.float64)
    noise = latent.noise(6, like=stats)
    sample = latent.sample(stats, noise)
    gradient = torch.randn_like(sample)
    by_hand = latent.pull_back(latent.slopes(stats, noise), gradient)
    assert_equal([by_hand], list(torch.autograd.grad(sample, stats, gradient)), 1e-12)


def test_categorical_samples_are_exactly_one_hot_and_avoid_what_is_impossible() -> None:
    latent = CategoricalLatent(2, 4)
    logits = torch.tensor([0.0, -200.0, 0.0, -200.0]).repeat(5000, 2)
    sample = latent.sample(logits, latent.noise(5000, like=logits)).view(-1, 4)
    assert torch.equal(sample.unique(), torch.tensor([0.0, 1.0])) and torch.equal(sample.sum(-1), torch.ones(10000))
    assert sample[:, [1, 3]].sum() == 0 and 0.45 < sample[:, 0].mean() < 0.55
    almost_one = torch.full((1, 2), 1.0 - 2.0**-24)  # the greatest that torch.rand gives
    assert latent.sample(torch.randn(1, 8), almost_one).sum() == 2


@pytest.mark.parametrize("latent", LATENTS)
def test_both_sides_of_the_kl(latent: Any) -> None:
    posterior, prior = leaves((7, latent.stats_size), (7, latent.stats_size), dtype=torch.float64)
    for found, expected in zip(
        latent.kl_sides(posterior, prior),
        (latent.kl(posterior.detach(), prior), latent.kl(posterior, prior.detach())),
        strict=True,
    ):
        assert torch.allclose(found, expected)
        pairs = (torch.autograd.grad(side.sum(), [posterior, prior], allow_unused=True) for side in (found, expected))
        for one, other in zip(*pairs, strict=True):
            assert (one is None or not one.any()) if other is None else torch.allclose(one, other)


# ---- in slices -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(130, 3, 4, 4), (5, 3), (9,)])
def test_squared_error(shape: tuple[int, ...]) -> None:
    prediction, target = leaves(shape, shape, dtype=torch.float64)
    target = target.detach()
    plain = lambda one: 0.5 * (one - target).square().reshape(len(one), -1).sum(1)  # noqa: E731
    assert_equal(gradients(lambda one: squared_error(one, target), [prediction]), gradients(plain, [prediction]), 1e-12)


def test_slices_are_all_rows_in_order() -> None:
    rows = torch.arange(10).view(10, 1)
    slices = list(cache_slices(rows, 2 * rows, rows=4))
    assert [len(one) for one, _ in slices] == [4, 4, 2]
    assert torch.equal(torch.cat([other for _, other in slices]), 2 * rows)


def test_convolutions_in_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    encoder, decoder = ConvEncoder((3, 16, 16), depth=4, layers=2), ConvDecoder(6, (3, 16, 16), depth=4, layers=2)
    results = []
    for numbers in (1000, 10**9):
        monkeypatch.setattr("sb3_cpm.world_model.networks.CACHED_NUMBERS", numbers)
        torch.manual_seed(3)
        feat, images = leaves((9, 6), (9, 3, 16, 16))
        weights = [*encoder.parameters(), *decoder.parameters()]
        embed, drawn = encoder(images), decoder(feat)
        loss = (embed * torch.randn_like(embed)).sum() + (drawn * torch.randn_like(drawn)).sum()
        results.append([embed, drawn, *torch.autograd.grad(loss, [feat, images, *weights])])
    assert_equal(*results, 1e-5)


# ---- activation ------------------------------------------------------------------------------------------------------


@pytest.fixture
def fast_exp(monkeypatch: pytest.MonkeyPatch) -> None:
    """ELU by exp on any processor."""
    monkeypatch.setattr(activation, "is_amd", lambda: False)


@pytest.mark.parametrize("shape", [(activation.SLICE,), (300, 500), (40, 32, 12, 8), (0, 4)])
def test_elu_in_place_is_that_of_pytorch(shape: tuple[int, ...], fast_exp: None) -> None:
    (values,) = leaves(shape)
    assert activation.is_faster(values.detach()) == (values.numel() > 0)
    # times one: in place on a result, as after a layer
    assert_equal(gradients(lambda x: elu_(x * 1.0), [values]), gradients(lambda x: F.elu(x * 1.0), [values]), 1e-6)
    if len(shape) == 4:
        images = values.detach().contiguous(memory_format=torch.channels_last)
        expected, found = F.elu(images), elu_(images)
        assert found is images and torch.allclose(found, expected, atol=1e-6)


def test_elu_of_extreme_values_and_of_what_is_left_to_pytorch(fast_exp: None) -> None:
    one = torch.tensor([0.0, -0.0, 100.0, -100.0, 1e-20, -1e-20, torch.inf, -torch.inf, torch.nan])
    extremes = one.repeat(activation.SLICE)
    expected = F.elu(extremes)
    assert torch.allclose(elu_(extremes), expected, atol=1e-7, equal_nan=True)
    many = torch.zeros(2 * activation.SLICE)
    assert activation.is_faster(many)
    assert not activation.is_faster(many.double()) and not activation.is_faster(many[: activation.SLICE - 1])
    assert not activation.is_faster(many.bfloat16()) and not activation.is_faster(torch.zeros(2, activation.SLICE).t()[::2])


# ---- deconvolution ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels, height, width", [(3, 4, 4), (6, 5, 3), (1, 1, 1), (24, 5, 3)])
def test_the_decoders_layers_are_transposed_convolutions(channels: int, height: int, width: int) -> None:
    inputs = leaves((7, 8, height, width), (8, channels, 4, 4), (channels,))

    def with_layer(layer: nn.ConvTranspose2d) -> Callable[..., torch.Tensor]:
        # contiguous: random weights of the result are drawn in the order of its memory
        return lambda x, weight, bias: torch.func.functional_call(layer, {"weight": weight, "bias": bias}, x).contiguous()

    ours, theirs = Deconvolution(8, channels), nn.ConvTranspose2d(8, channels, 4, 2, 1)
    assert_equal(gradients(with_layer(ours), inputs), gradients(with_layer(theirs), inputs), 1e-5)
    plain = ours(inputs[0].contiguous(memory_format=torch.channels_last))
    assert plain.is_contiguous(memory_format=torch.channels_last) and plain.grad_fn.name() == "_DeconvolutionBackward"
    F.elu_(plain)  # as the layer that follows does
    wide = ours.double()(inputs[0].double())
    assert torch.allclose(plain.double(), F.elu(wide), atol=1e-5) and wide.grad_fn.name() == "ConvolutionBackward0"
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert Deconvolution(8, channels)(inputs[0]).dtype == torch.bfloat16


@pytest.mark.parametrize("needed", [(True, False, False), (False, True, False), (False, False, True), (False, True, True)])
def test_a_transposed_convolution_computes_the_gradients_that_are_asked_for(needed: tuple[bool, ...]) -> None:
    inputs = leaves((7, 8, 5, 3), (8, 24, 4, 4), (24,))
    some = [one.detach().requires_grad_(wanted) for one, wanted in zip(inputs, needed, strict=True)]
    layer = Deconvolution(8, 24)

    def sums(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(layer, {"weight": weight, "bias": bias}, x).square().sum()

    wanted = [one for one, asked in zip(some, needed, strict=True) if asked]
    expected = [one for one, asked in zip(torch.autograd.grad(sums(*inputs), inputs), needed, strict=True) if asked]
    assert_equal(torch.autograd.grad(sums(*some), wanted), expected, 1e-5)


# ---- one-hot inputs --------------------------------------------------------------------------------------------------


def samples(n: int, kind: OneHot, rest: int) -> torch.Tensor:
    """One-hot vectors, each class at least missing once, and other numbers behind them."""
    classes = torch.randint(0, kind.classes - 1, (n, kind.groups))
    return torch.cat((F.one_hot(classes, kind.classes).float().flatten(1), torch.randn(n, rest)), dim=1)


@pytest.mark.parametrize("rest", [0, 5])
@pytest.mark.parametrize("other_way", [False, True])
def test_layers_with_one_hot_inputs(rest: int, other_way: bool, small_products: None) -> None:
    kind = OneHot(3, 4)
    inputs = samples(300, kind, rest).requires_grad_(True)
    weight, bias = leaves((7, 12 + rest), (7,))
    choice = find_choice(inputs, kind, 7)
    assert choice is not None
    if other_way:
        matrix = weight.detach().t().contiguous().requires_grad_(True)
        found = gradients(lambda x, m, b: one_hot.one_hot_affine(x, choice, m, b), [inputs, matrix, bias])
        expected = gradients(lambda x, m, b: x @ m + b, [inputs, matrix, bias])
        assert found[2].is_contiguous()
    else:
        layer = OneHotLinear(12 + rest, 7, kind)
        found = gradients(
            lambda x, w, b: torch.func.functional_call(layer, {"weight": w, "bias": b}, x), [inputs, weight, bias]
        )
        expected = gradients(F.linear, [inputs, weight, bias])
        assert "_Product" in type(layer(inputs).grad_fn).__name__ and found[2].is_contiguous()
    assert_equal(found, expected, 1e-5)


def test_what_is_not_one_hot_is_multiplied(small_products: None) -> None:
    kind, inputs = OneHot(3, 4), samples(300, OneHot(3, 4), 2)
    assert find_choice(inputs, kind, 7) is not None
    probabilities, reset, other = inputs.clone(), inputs.clone(), inputs.clone()
    probabilities[17, 4:8] = torch.tensor([0.2, 0.3, 0.4, 0.1])
    reset[17] = 0.0
    other[17, :4] = float("nan")
    for one in (probabilities, reset, other, inputs[:200], inputs.double()):
        assert find_choice(one, kind, 7) is None
    assert find_choice(inputs, None, 7) is None
    layer = OneHotLinear(14, 7, kind)
    # to rounding: on some processors another library multiplies
    torch.testing.assert_close(layer(probabilities), F.linear(probabilities, layer.weight, layer.bias))


def test_a_challenger_learns_the_same_from_one_hot_samples(small_products: None, monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for rows in (1, 10**9):
        monkeypatch.setattr(one_hot, "MIN_ROWS", rows)
        torch.manual_seed(0)
        challenger = small(
            BOTH, latent="categorical", stoch_size=4, stoch_classes=5, imagination_starts=None, train_task_behavior=True
        )
        batches = [random_batch(BOTH, 2, length=20, n=5, seed=seed) for seed in range(3)]
        results.append([challenger.train(batch) for batch in batches])
    for one, other in zip(*results, strict=True):
        assert one == pytest.approx(other, rel=1e-3, abs=1e-4)


# ---- ensemble --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("onednn", [True, False])
@pytest.mark.parametrize("one_hot", [None, OneHot(3, 4)])
def test_heads_one_by_one_are_the_heads_at_once(
    one_hot: OneHot | None, onednn: bool, small_products: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(linear_module, "prefers_onednn", lambda: onednn and linear_module.onednn_works())
    inputs = torch.randn(300, 14) if one_hot is None else samples(300, one_hot, 2)
    inputs.requires_grad_(True)
    assert (find_choice(inputs, one_hot, 7) is None) == (one_hot is None)
    ensemble = Ensemble(3, 14, 2, layers=2, units=7, one_hot=one_hot)
    weights = list(ensemble.parameters())
    for wanted in ([inputs, *weights], [inputs], weights):
        inputs.requires_grad_(wanted != weights)
        with frozen(*[ensemble] if wanted == [inputs] else []):
            found = torch.stack(ensemble.predictions(inputs)), ensemble(inputs)
        results = []
        for outputs in found:
            torch.manual_seed(4)
            results.append([outputs, *torch.autograd.grad((outputs * torch.randn_like(outputs)).sum(), wanted)])
        assert_equal(*results, 1e-4)


def test_heads_of_which_only_some_have_a_loss(small_products: None) -> None:
    ensemble, inputs = Ensemble(3, 5, 2, layers=2, units=7), torch.randn(70, 5)
    found = torch.autograd.grad(ensemble.predictions(inputs)[1].sum(), list(ensemble.parameters()))
    assert_equal(list(found), list(torch.autograd.grad(ensemble(inputs)[1].sum(), list(ensemble.parameters()))), 1e-4)


@pytest.mark.parametrize("onednn", [True, False])
@pytest.mark.parametrize("one_hot", [None, OneHot(3, 4)])
def test_heads_rate_in_slices_what_they_predict_at_once(
    one_hot: OneHot | None, onednn: bool, small_products: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(linear_module, "prefers_onednn", lambda: onednn and linear_module.onednn_works())
    monkeypatch.setattr(heads_module, "RATED_ROWS", 130)
    inputs = torch.randn(300, 14) if one_hot is None else samples(300, one_hot, 2)
    inputs.requires_grad_(True)
    ensemble = Ensemble(3, 14, 2, layers=3, units=7, one_hot=one_hot)
    with frozen(ensemble):
        assert_equal(*(gradients(of, [inputs]) for of in (ensemble.disagreement, lambda x: disagreement(ensemble(x)))), 1e-4)
        kept: list[torch.Tensor] = []
        with torch.autograd.graph.saved_tensors_hooks(lambda one: kept.append(one) or one, lambda one: one):
            rated = ensemble.disagreement(inputs)
    assert [one.shape for one in kept] == [inputs.shape], "its gradient, and nothing else"
    with torch.no_grad():
        assert torch.equal(ensemble.disagreement(inputs), rated)
    learnt = torch.autograd.grad(ensemble.disagreement(inputs).sum(), list(ensemble.parameters()))
    assert all(one.abs().sum() > 0 for one in learnt), "where weights learn they get their gradient"


def test_disagreement_and_its_gradient() -> None:
    heads = leaves(*[(150, 4)] * 3, dtype=torch.float64)

    def plain(*predictions: torch.Tensor) -> torch.Tensor:
        stacked = torch.stack(predictions)
        return root((stacked - stacked.mean(0)).square().mean(0)).mean(-1)

    assert_equal(gradients(lambda *predictions: disagreement(predictions), heads), gradients(plain, heads), 1e-9)
    same = heads[:1] * 3
    assert disagreement(same).abs().max() == 0 and torch.isfinite(torch.autograd.grad(disagreement(same).sum(), same)[0]).all()
    assert disagreement([one.view(3, 50, 4) for one in heads]).shape == (3, 50)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])  # by hand and, as on a GPU, with PyTorch's operation
def test_ensemble_loss_is_per_head(dtype: torch.dtype) -> None:
    heads, target = leaves(*[(6, 4)] * 3, dtype=dtype), torch.randn(6, 4, dtype=dtype)
    expected = 0.5 * (torch.stack(heads) - target).square().sum((0, 2)).mean()
    assert torch.allclose(ensemble_loss(heads, target), expected)
