"""Parts of the world model one by one: observations, networks, distributions, losses, latent states."""

import math
from dataclasses import FrozenInstanceError, asdict, replace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from sb3_cpm.presets import PRESETS, make_preset
from sb3_cpm.world_model.distributions import CategoricalLatent, GaussianLatent, TruncatedNormal
from sb3_cpm.world_model.losses import lambda_returns, masked_mean
from sb3_cpm.world_model.networks import ConvDecoder, ConvEncoder
from sb3_cpm.world_model.observations import ObservationSpec, symexp, symlog
from sb3_cpm.world_model.rssm import RSSM, LatentState

CPU = torch.device("cpu")


def image(height: int = 32, width: int = 32, channels: int = 3, channel_first: bool = False) -> spaces.Box:
    return spaces.Box(0, 255, (channels, height, width) if channel_first else (height, width, channels), np.uint8)


def vector(size: int = 5) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)


# ---- observations ----------------------------------------------------------------------------------------------------


def test_images_and_vectors_are_read_clouds_only_when_asked_for() -> None:
    space = spaces.Dict({"cam": image(), "state": vector(), "cloud": spaces.Box(-1, 1, (10, 6)), "mode": spaces.Discrete(3)})
    assert ObservationSpec(space).keys == ("cam", "state")
    spec = ObservationSpec(space, keys=["cloud", "cam"])
    assert spec.keys == ("cam", "cloud") and spec.vector_dim == 60


@pytest.mark.parametrize("squash", [True, False])
def test_preprocess_and_split_are_inverse_for_mixed_channel_orders(squash: bool) -> None:
    space = spaces.Dict({"a": image(32, 48), "b": image(32, 48, 4, channel_first=True), "v": vector(3), "w": vector(2)})
    spec = ObservationSpec(space, squash=squash)
    observations = {key: np.stack([np.stack([space[key].sample() for _ in range(3)]) for _ in range(2)]) for key in space}
    before = {key: value.copy() for key, value in observations.items()}
    inputs = spec.preprocess(observations, CPU)
    assert inputs.images is not None and inputs.images.shape == (6, 7, 32, 48)
    assert inputs.images.min() >= -0.5 and inputs.images.max() <= 0.5
    expected = observations["a"][1, 2, 5, 7, 1] / 255 - 0.5, observations["b"][1, 2, 3, 5, 7] / 255 - 0.5
    assert np.allclose(expected, (inputs.images[5, 1, 5, 7], inputs.images[5, 3 + 3, 5, 7]), atol=1e-6)
    for key, value in spec.split(inputs, (2, 3)).items():
        assert np.allclose(value.numpy(), observations[key], rtol=1e-4, atol=1e-3)
        assert np.array_equal(before[key], observations[key]), "the caller's arrays were changed"


def test_symlog_and_symexp_are_inverse() -> None:
    x = torch.tensor([-1e4, -1.0, -1e-3, 0.0, 1e-3, 1.0, 1e4])
    assert torch.allclose(symexp(symlog(x)), x, rtol=1e-4)
    assert torch.allclose(symlog(torch.tensor([0.0, math.e - 1])), torch.tensor([0.0, 1.0]))


@pytest.mark.parametrize(
    "space, keys, message",
    [
        (vector(), None, "Dict observation space"),
        (spaces.Dict({"cloud": spaces.Box(-1, 1, (10, 6))}), None, "No observation key is usable"),
        (spaces.Dict({"a": image(32, 32), "b": image(64, 64)}), None, "a: 32x32, b: 64x64.*one size"),
        (spaces.Dict({"a": vector()}), ["b"], "Unknown observation key 'b'"),
        (spaces.Dict({"a": vector(), "d": spaces.Discrete(2)}), ["d"], "cannot read key 'd'"),
        (spaces.Dict({"a": vector()}), [], "non-empty list"),
        (spaces.Dict({"a": vector()}), "a", "non-empty list"),
    ],
)
def test_spaces_that_cannot_be_read(space: spaces.Space, keys: list[str] | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ObservationSpec(space, keys)  # type: ignore[arg-type]


def test_observations_of_another_space_are_refused() -> None:
    spec = ObservationSpec(spaces.Dict({"v": vector(3)}))
    with pytest.raises(ValueError, match=r"'v' has shape \(4, 2\), expected it to end in \(3,\)"):
        spec.preprocess({"v": np.zeros((4, 2), np.float32)}, CPU)
    with pytest.raises(ValueError, match="'v' is missing"):
        spec.preprocess({"w": np.zeros((4, 3), np.float32)}, CPU)


@pytest.mark.parametrize("dtype, high", [(np.float32, 255), (np.int32, 255), (np.int32, 7), (np.float64, 255), (np.uint8, 1)])
def test_the_declared_bounds_are_black_and_white_whatever_the_dtype(dtype: type, high: int) -> None:
    spec = ObservationSpec(spaces.Dict({"camera": spaces.Box(0, high, (4, 4, 3), dtype)}))
    pictures = np.zeros((2, 4, 4, 3), dtype)
    pictures[1, :2] = high
    inputs = spec.preprocess({"camera": pictures}, CPU)
    assert inputs.images is not None and inputs.images.dtype == torch.float32
    assert (inputs.images[0] == -0.5).all() and (inputs.images[1, :, :2] == 0.5).all()
    assert np.array_equal(spec.split(inputs, (2,))["camera"].numpy(), pictures.astype(np.float32))


def test_bounds_of_uint8_are_taken_at_their_word() -> None:
    spec = ObservationSpec(spaces.Dict({"mask": spaces.Box(0, 1, (4, 4, 1), np.uint8), "camera": image(4, 4)}))
    mask, camera = np.zeros((1, 4, 4, 1), np.uint8), np.full((1, 4, 4, 3), 255, np.uint8)
    with pytest.raises(ValueError, match=r"'mask' holds values from 0 to 2, its space declares 0 to 1"):
        spec.preprocess({"mask": mask + np.arange(4, dtype=np.uint8).reshape(4, 1).clip(0, 2), "camera": camera}, CPU)
    with pytest.raises(ValueError, match=r"'mask' came as torch.float32, its space declares uint8 from 0 to 1"):
        spec.preprocess({"mask": mask.astype(np.float32), "camera": camera}, CPU)
    with pytest.raises(ValueError, match="cannot read key 'mask'.*finite bounds"):
        ObservationSpec(spaces.Dict({"mask": spaces.Box(0, 0, (4, 4, 1), np.uint8)}), ["mask"])


def test_rounding_may_leave_the_declared_range_a_little() -> None:
    """As float16 does, in which a buffer may store images: 0.7 becomes 0.7002."""
    spec = ObservationSpec(spaces.Dict({"depth": spaces.Box(0.0, 0.7, (4, 4, 1), np.float32)}))
    depth = np.full((1, 4, 4, 1), np.float16(0.7)).astype(np.float32)
    assert depth.max() > np.float32(0.7)
    images = spec.preprocess({"depth": depth}, CPU).images
    assert images is not None and (images == 0.5).all(), "inputs stay within their range"
    for wrong in (0.702, -0.002):
        with pytest.raises(ValueError, match="its space declares 0 to 0.7"):
            spec.preprocess({"depth": np.full_like(depth, wrong)}, CPU)


# ---- networks --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(16, 16), (32, 32), (64, 64), (96, 32), (17, 31), (50, 84), (84, 84), (3, 250), (1, 1)])
def test_encoder_and_decoder_fit_images_of_any_size(size: tuple[int, int]) -> None:
    shape = (6, *size)
    encoder, decoder = ConvEncoder(shape, 8, 4), ConvDecoder(20, shape, 8, 4)
    assert encoder(torch.zeros(2, *shape)).shape == (2, encoder.output_dim)
    assert decoder(torch.zeros(2, 20)).shape == (2, *shape)


@pytest.mark.parametrize("size", [(32, 32), (64, 64), (32, 64)])
def test_sizes_that_can_be_halved_go_through_the_convolutions_alone(size: tuple[int, int]) -> None:
    encoder, decoder = ConvEncoder((3, *size), 4, 4), ConvDecoder(5, (3, *size), 4, 4)
    images, latents = torch.rand(2, 3, *size), torch.rand(2, 5)
    features = decoder.linear(latents).unflatten(1, decoder.feature_map).contiguous(memory_format=torch.channels_last)
    assert torch.equal(encoder(images), encoder.convolutions(images).flatten(1))
    assert torch.equal(decoder(latents), decoder.convolutions(features))


@pytest.mark.parametrize("size", [(84, 84), (33, 50), (17, 16)])
def test_every_pixel_of_an_image_is_seen_and_drawn(size: tuple[int, int]) -> None:
    """Also the last row and column of those that have to be padded: none is cut off."""
    images = torch.rand(1, 1, *size, requires_grad=True)
    ConvEncoder((1, *size), 4, 4)(images).pow(2).sum().backward()
    assert images.grad is not None and (images.grad != 0).all()
    decoder = ConvDecoder(5, (1, *size), 4, 4)
    drawn = decoder(torch.rand(2, 5))
    assert drawn.shape == (2, 1, *size) and (drawn[0] != drawn[1]).all()


def test_the_reports_embedding_is_32_times_depth() -> None:
    assert ConvEncoder((6, 32, 32), depth=32, layers=4).output_dim == 32 * 32


# ---- distributions ---------------------------------------------------------------------------------------------------


def test_gaussian_kl_is_that_of_torch() -> None:
    latent, (left, right) = GaussianLatent(5), torch.randn(2, 7, 10)
    reference = torch.distributions.kl_divergence(
        *(torch.distributions.Normal(*latent.mean_std(stats)) for stats in (left, right))
    ).sum(-1)
    assert torch.allclose(latent.kl(left, right), reference, rtol=1e-4, atol=1e-5)


def test_categorical_kl_is_that_of_torch_and_samples_are_one_hot_with_gradients() -> None:
    latent = CategoricalLatent(3, 4)
    left, right = torch.randn(2, 7, 12)
    reference = torch.distributions.kl_divergence(
        *(torch.distributions.Categorical(logits=stats.view(7, 3, 4)) for stats in (left, right))
    ).sum(-1)
    assert torch.allclose(latent.kl(left, right), reference, rtol=1e-4, atol=1e-5)
    left.requires_grad_(True)
    sample = latent.sample(left, latent.noise(7, like=left))
    assert torch.allclose(sample.view(7, 3, 4).sum(-1), torch.ones(7, 3))
    (sample * torch.randn(7, 12)).sum().backward()
    assert left.grad is not None and left.grad.abs().sum() > 0


@pytest.mark.parametrize("race", [False, True])
def test_categorical_samples_follow_their_probabilities(race: bool) -> None:
    """From uniform numbers, as on CPUs, and from exponential ones, as on GPUs."""
    latent, logits = CategoricalLatent(1, 3), torch.tensor([0.5, 0.3, 0.2]).log()
    noise = torch.empty(20000, 1, 3).exponential_() if race else latent.noise(20000, like=logits)
    samples = latent.sample(logits.expand(20000, 3), noise)
    assert torch.allclose(samples.mean(0), torch.tensor([0.5, 0.3, 0.2]), atol=0.02)


def test_truncated_normal_moments_entropy_and_gradients() -> None:
    loc, scale = torch.tensor([-0.9, 0.0, 0.5, 1.0]), torch.tensor([0.1, 1.0, 0.4, 2.0])
    policy = TruncatedNormal(loc, scale)
    grid = torch.linspace(-1, 1, 20001)
    density = torch.exp(
        torch.stack([TruncatedNormal(loc[i : i + 1], scale[i : i + 1]).log_prob(grid[:, None]) for i in range(4)])
    )
    assert torch.allclose(torch.trapezoid(density, grid), torch.ones(4), atol=1e-3)
    assert torch.allclose(torch.trapezoid(density * grid, grid), policy.mean, atol=1e-3)
    entropy = -torch.trapezoid(density * density.clamp(min=1e-30).log(), grid)
    assert torch.allclose(entropy.sum(), policy.entropy(), atol=5e-3)
    samples = TruncatedNormal(loc.expand(50000, 4), scale.expand(50000, 4)).rsample()
    assert torch.allclose(samples.mean(0), policy.mean, atol=0.01)


def test_truncated_normal_pathwise_gradient_is_that_of_the_mean() -> None:
    loc, scale = torch.tensor([0.7, -0.2], requires_grad=True), torch.tensor([0.3, 0.8], requires_grad=True)
    expected = torch.autograd.grad(TruncatedNormal(loc, scale).mean.sum(), [loc, scale])
    samples = TruncatedNormal(loc.expand(200000, 2), scale.expand(200000, 2)).rsample()
    found = torch.autograd.grad(samples.mean(0).sum(), [loc, scale])
    for one, other in zip(found, expected, strict=True):
        assert torch.allclose(one, other, atol=0.02)


# ---- losses ----------------------------------------------------------------------------------------------------------


def test_masked_mean_ignores_what_stands_in_the_padding() -> None:
    values = torch.tensor([1.0, 3.0, math.nan], requires_grad=True)
    mean = masked_mean(values, torch.tensor([True, True, False]))
    mean.backward()
    assert mean.item() == 2.0 and values.grad is not None and values.grad.tolist() == [0.5, 0.5, 0.0]
    assert masked_mean(values, torch.zeros(3, dtype=torch.bool)).item() == 0.0


def test_lambda_returns_by_hand() -> None:
    rewards, values, discounts = (torch.tensor(x)[:, None] for x in ([1.0, 2.0], [10.0, 20.0], [0.5, 0.9]))
    # G_1 = 2 + 0.9 * 20 = 20;  G_0 = 1 + 0.5 * (0.2 * 10 + 0.8 * 20) = 10
    assert torch.allclose(lambda_returns(rewards, values, discounts, 0.8).squeeze(1), torch.tensor([10.0, 20.0]))


# ---- latent states ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("latent", [GaussianLatent(6), CategoricalLatent(4, 5)])
def test_observing_in_parts_is_observing_the_whole(latent: GaussianLatent | CategoricalLatent) -> None:
    rssm = RSSM(latent, deter_size=8, hidden_size=16, embed_dim=7, action_dim=2)
    embed, actions = torch.randn(9, 3, 7), torch.rand(9, 3, 2)
    is_first, mask = torch.rand(9, 3) < 0.3, torch.rand(9, 3) < 0.7
    whole = rssm.observe(embed, actions, is_first, mask, deterministic=True)
    state = rssm.initial_state(3)
    for rows in (slice(0, 4), slice(4, 5), slice(5, 9)):
        part = rssm.observe(embed[rows], actions[rows], is_first[rows], mask[rows], state, deterministic=True)
        for one, other in zip(part, whole, strict=True):
            assert torch.allclose(one, other[rows], atol=1e-6)
        state = LatentState(*(value[-1] for value in part))


def test_masked_rows_keep_the_state() -> None:
    rssm = RSSM(GaussianLatent(6), deter_size=8, hidden_size=16, embed_dim=7, action_dim=2)
    embed, actions, state = torch.randn(3, 2, 7), torch.rand(3, 2, 2), LatentState(*(torch.randn(2, n) for n in (8, 6, 12)))
    mask = torch.tensor([[True, False], [False, False], [True, False]])
    is_first = torch.tensor([[False, False], [False, True], [False, False]])  # a reset in a row that does not exist is none
    rows = rssm.observe(embed, actions, is_first, mask, state, deterministic=True)
    for part, before in zip(rows, state, strict=True):
        assert torch.equal(part[2, 1], before[1]), "column 1 has no row at all"
        assert torch.equal(part[1, 0], part[0, 0]) and not torch.equal(part[0, 0], before[0])
    short = rssm.observe(embed[[0, 2]], actions[[0, 2]], torch.zeros(2, 2, dtype=torch.bool), None, state, deterministic=True)
    assert torch.allclose(rows.deter[2, 0], short.deter[1, 0], atol=1e-6)


# ---- presets ---------------------------------------------------------------------------------------------------------


def test_presets_are_frozen_and_made_of_names_entries_and_presets() -> None:
    report = PRESETS["report"]
    assert (report.gamma, report.deter_size, report.stoch_size, report.horizon) == (0.99, 200, 50, 15)
    with pytest.raises(FrozenInstanceError):
        report.gamma = 0.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="'gamma' must be a number from 0 to 1, got 2"):
        replace(report, gamma=2)
    make_preset("report").uncertainty["rnd"]["layers"] = 9  # type: ignore[index]
    assert report.uncertainty["rnd"]["layers"] == 3, "a copy"
    assert make_preset({"horizon": 3}, gamma=0.5).horizon == 3
    assert make_preset(report, horizon=3) == replace(report, horizon=3)
    for preset in PRESETS:
        assert make_preset(preset) == make_preset(asdict(PRESETS[preset])) == PRESETS[preset]


def test_numpy_scalars_become_plain_numbers() -> None:
    layers = {"rnd": {"layers": np.int8(2)}}
    preset = make_preset(gamma=np.float64(0.97), horizon=np.int64(3), amp=np.bool_(False), uncertainty=layers)
    values = preset.gamma, preset.horizon, preset.amp, preset.uncertainty["rnd"]["layers"]
    assert values == (0.97, 3, False, 2) and [type(value) for value in values] == [float, int, bool, int]


@pytest.mark.parametrize(
    "preset, overrides, message",
    [
        ("reprot", {}, "Did you mean 'report'"),
        ("default", {"horizn": 3}, "Unknown preset entry 'horizn'. Did you mean 'horizon'"),
        ({"deter": 3}, {}, "Did you mean 'deter_size'"),
        ({"deter_size": 0}, {}, "'deter_size' must be an integer of at least 1"),
        ({"sequence_length": 1}, {}, "at least 2"),
        ({"imagination_starts": 0}, {}, "'imagination_starts' must be None or an integer of at least 1, got 0"),
        ({"imagination_starts": 8.0}, {}, "'imagination_starts' must be None or an integer"),
        ({"horizon": True}, {}, "'horizon' must be an integer of at least 1, got True"),
        ({"cnn_layers": 0}, {}, "'cnn_layers' must be an integer of at least 1"),
        ({"actor_layers": -1}, {}, "'actor_layers' must be an integer of at least 0, got -1"),
        ({"head_layers": None}, {}, "'head_layers' must be an integer of at least 0"),
        ({"gamma": 1.01}, {}, "'gamma' must be a number from 0 to 1, got 1.01"),
        ({"lambda_": -0.1}, {}, "'lambda_' must be a number from 0 to 1"),
        ({"kl_balance": math.nan}, {}, "'kl_balance' must be a number from 0 to 1"),
        ({"reinforce_share": 2}, {}, "'reinforce_share' must be a number from 0 to 1"),
        ({"model_lr": -1e-3}, {}, "'model_lr' must be a finite number of at least 0"),
        ({"actor_lr": math.inf}, {}, "'actor_lr' must be a finite number of at least 0"),
        ({"critic_lr": "3e-4"}, {}, "'critic_lr' must be a finite number of at least 0, got '3e-4'"),
        ({"free_nats": None}, {}, "'free_nats' must be a finite number of at least 0"),
        ({"adam_eps": 0.0}, {}, "'adam_eps' must be a number above 0"),
        ({"grad_clip": 0}, {}, "'grad_clip' must be a number above 0"),
        ({"uncertainty": {"rnd": 3}}, {}, "'uncertainty' must be a dict of dicts"),
        ({"model_lr": "1e-3"}, {}, "got '1e-3'. That is text: .*1.0e-2"),
        (3, {}, "must be a name"),
    ],
)
def test_wrong_presets(preset: object, overrides: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_preset(preset, **overrides)  # type: ignore[arg-type]
