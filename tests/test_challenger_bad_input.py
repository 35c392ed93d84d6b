"""What can be wrong with what the challenger is given, and what it then says or keeps."""

import pathlib
from typing import Any

import numpy as np
import pytest
import torch
from challenger_helpers import BOTH, SMALL, VECTOR, box, image, random_batch, small, vector, weights
from gymnasium import spaces

from sb3_cpm.challenger import Challenger, choose_device
from sb3_cpm.uncertainty import Transitions
from sb3_cpm.uncertainty.base import LatentSizes, Uncertainty
from sb3_cpm.world_model.observations import ObservationSpec

CPU = torch.device("cpu")
DEPTH = spaces.Box(-1.0, 3.0, (32, 32, 1), np.float32)
WITH_DEPTH = spaces.Dict({"camera": image(), "depth": DEPTH})


# ---- sequences longer than any episode ---------------------------------------------------------------------------------


def test_sequences_longer_than_any_episode_are_those_episodes() -> None:
    """Eight rows asked for, five there: the same losses as from the five alone, whatever stands in the padding."""
    losses = []
    for length in (5, 8):
        batch = random_batch(BOTH, 2)
        batch.is_first[1:] = batch.mask[5:] = False
        cut = type(batch)({k: v[:length] for k, v in batch.observations.items()}, *(part[:length] for part in batch[1:]))
        torch.manual_seed(0)
        challenger = small(BOTH)
        challenger.world_model.latent.noise = lambda *size, like: torch.full((*size, 6), 0.3)  # type: ignore[method-assign]
        losses.append(challenger.train(cut))
    for key, value in losses[0].items():
        if not key.startswith("exploration"):  # imagines from the same states, with actions of its own
            assert losses[1][key] == pytest.approx(value, rel=1e-4, abs=1e-5), key


# ---- observations that are not what the space says -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "changed, message",
    [
        (
            {"state": np.zeros((8, 4, 5), np.float32)},
            r"'state' has shape \(8, 4, 5\), expected it to end in \(3,\).*not the one",
        ),
        ({"base": np.zeros((8, 4, 64, 64, 3), np.uint8)}, r"'base' has shape .* expected it to end in \(32, 32, 3\)"),
        ({"base": np.zeros((8, 4, 32, 32, 3), np.float32)}, "'base' came as torch.float32, its space declares uint8"),
        ({"base": None}, "Observation key 'base' is missing"),
    ],
)
def test_an_observation_space_that_changes(changed: dict[str, Any], message: str) -> None:
    challenger, batch = small(BOTH), random_batch(BOTH, 2)
    before = weights(challenger)
    observations = {key: value for key, value in {**batch.observations, **changed}.items() if value is not None}
    with pytest.raises(ValueError, match=message):
        challenger.train(batch._replace(observations=observations))
    with pytest.raises(ValueError, match=message):
        challenger.follow(challenger.initial_state(4), observations, batch.actions, batch.is_first)
    assert all(np.array_equal(value, weights(challenger)[key]) for key, value in before.items())


def test_images_in_a_declared_range_are_scaled_by_it(tmp_path: pathlib.Path) -> None:
    spec = ObservationSpec(WITH_DEPTH)
    assert spec.image_keys == ("camera", "depth") and spec.ranges["depth"] == (-1.0, 3.0)
    observations = {key: np.stack([WITH_DEPTH[key].sample() for _ in range(4)]) for key in WITH_DEPTH}
    inputs = spec.preprocess(observations, CPU)
    assert inputs.images is not None and inputs.images.shape == (4, 4, 32, 32) and inputs.images.abs().max() <= 0.5
    assert np.allclose(inputs.images[:, 3].numpy(), (observations["depth"][..., 0] + 1) / 4 - 0.5, atol=1e-6)
    for key, value in spec.split(inputs, (4,)).items():
        assert np.allclose(value.numpy(), observations[key], atol=1e-3), key
    challenger, batch = small(WITH_DEPTH), random_batch(WITH_DEPTH, 2)
    batch.observations["depth"] = batch.observations["depth"].clip(-1, 3)
    challenger.train(batch)
    challenger.save(tmp_path / "challenger.pt")
    loaded = Challenger.load(tmp_path / "challenger.pt", "cpu")
    assert loaded.spec.ranges == challenger.spec.ranges and loaded.train(batch)["error_depth"] < 1.0
    other = small(spaces.Dict({"camera": image(), "depth": spaces.Box(0.0, 3.0, (32, 32, 1), np.float32)}))
    with pytest.raises(ValueError, match="was saved for the observations"):
        other.load_state(tmp_path / "challenger.pt")


@pytest.mark.parametrize(
    "dtype, high", [(np.uint8, 1), (np.uint8, 255), (np.float32, 255), (np.int32, 255), (np.float32, 0.7), (np.float64, 0.7)]
)
def test_images_of_every_dtype_are_saved_and_loaded(tmp_path: pathlib.Path, dtype: type, high: float) -> None:
    space = spaces.Dict({"camera": spaces.Box(0, high, (8, 8, 3), dtype)})
    challenger, batch = small(space), random_batch(space, 2)
    batch.observations["camera"] = (np.random.default_rng(0).integers(0, 2, (8, 4, 8, 8, 3)) * high).astype(dtype)
    challenger.train(batch)
    challenger.save(tmp_path / "challenger.pt")
    entry = torch.load(tmp_path / "challenger.pt")["config"]["keys"]["camera"]
    assert set(entry) == ({"shape", "image"} if (dtype, high) == (np.uint8, 255) else {"shape", "image", "range", "dtype"})
    torch.manual_seed(0)
    expected = challenger.train(batch)
    for how in ("load", "load_state", "adopt"):
        loaded = Challenger.load(tmp_path / "challenger.pt", "cpu") if how != "load_state" else small(space)
        if how == "load_state":
            loaded.load_state(tmp_path / "challenger.pt")
        elif how == "adopt":
            source, loaded = loaded, small(space)
            loaded.adopt(source)
        assert loaded.observation_space == space
        torch.manual_seed(0)
        assert loaded.train(batch) == expected, how


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_files_from_before_the_dtype_was_saved(tmp_path: pathlib.Path, dtype: type) -> None:
    """They fit an environment whose images are declared with the same bounds, but not one with uint8."""
    challenger, path = small(spaces.Dict({"depth": spaces.Box(0, 0.7, (8, 8, 1), dtype)})), tmp_path / "challenger.pt"
    challenger.save(path)
    content = torch.load(path)
    del content["config"]["keys"]["depth"]["dtype"]
    torch.save({**content, "version": 1}, path)  # they had no digest either
    old = Challenger.load(path, "cpu")
    challenger.load_state(path)
    challenger.adopt(old)
    with pytest.raises(ValueError, match="was saved for the observations"):
        small(spaces.Dict({"depth": spaces.Box(0, 1, (8, 8, 1), np.uint8)})).load_state(path)


@pytest.mark.parametrize("value", [3.5, -1.5, np.nan])
def test_images_outside_of_their_declared_range(value: float) -> None:
    depth = np.zeros((2, 32, 32, 1), np.float32)
    depth[1, 3, 4] = value
    with pytest.raises(ValueError, match=r"'depth' holds values from .* its space declares -1 to 3"):
        ObservationSpec(WITH_DEPTH).preprocess({"camera": np.zeros((2, 32, 32, 3), np.uint8), "depth": depth}, CPU)


@pytest.mark.parametrize("bounds", [(-np.inf, np.inf), (0.0, np.inf), (-3.4e38, 3.4e38)])
def test_images_neither_uint8_nor_in_a_declared_range(bounds: tuple[float, float]) -> None:
    space = spaces.Dict({"camera": spaces.Box(*bounds, (32, 32, 3), np.float32), "state": vector()})
    with pytest.raises(ValueError, match="cannot read key 'camera'.*no finite bounds.*return uint8, or declare the bounds"):
        ObservationSpec(space, ["camera"])
    with pytest.warns(UserWarning, match="leaves out 'camera'"):
        assert ObservationSpec(space).keys == ("state",)


@pytest.mark.parametrize("dtype", [np.int16, np.uint16, np.int32, np.uint32, np.int64])
@pytest.mark.parametrize("from_zero", [False, True])
def test_integer_images_whose_bounds_are_the_limits_of_their_dtype(dtype: type, from_zero: bool) -> None:
    """They tell nothing: depth in millimetres would be a thousandth of the range, colours less."""
    limits = np.iinfo(dtype)
    camera = spaces.Box(0 if from_zero else limits.min, limits.max, (32, 32, 3), dtype)
    space = spaces.Dict({"camera": camera, "state": vector()})
    with pytest.warns(UserWarning, match="leaves out 'camera'.*limits of its dtype are none.*declare the bounds"):
        assert ObservationSpec(space).keys == ("state",)
    with pytest.raises(ValueError, match="cannot read key 'camera'.*declare the bounds"):
        ObservationSpec(space, ["camera", "state"])
    declared = spaces.Dict({"camera": spaces.Box(0, 4000, (32, 32, 3), dtype)})
    assert ObservationSpec(declared).ranges == {"camera": (0.0, 4000.0)}


def test_eight_bits_are_a_range() -> None:
    space = spaces.Dict({"camera": spaces.Box(-128, 127, (8, 8, 3), np.int8), "other": image(8)})
    assert ObservationSpec(space).ranges == {"camera": (-128.0, 127.0), "other": (0.0, 255.0)}


@pytest.mark.parametrize("size", [16, 23, 84])
def test_images_of_any_size(size: int, tmp_path: pathlib.Path) -> None:
    space = spaces.Dict({"camera": image(size), "state": vector()})
    challenger, batch = small(space), random_batch(space, 2)
    for _ in range(2):
        before = challenger.train(batch)
    challenger.save(tmp_path / "challenger.pt")
    assert Challenger.load(tmp_path / "challenger.pt", "cpu").trained_updates == 2
    assert np.isfinite(list(before.values())).all() and 0.0 < before["error_camera"] < 1.0
    opened = challenger.open_loop({key: value[:, 0] for key, value in batch.observations.items()}, batch.actions[1:, 0], 3)
    assert opened.observations["camera"].shape == (8, size, size, 3)


# ---- numbers that are not finite ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "spoil, term",
    [
        (lambda batch: batch.rewards.__setitem__((3, 1), np.inf), "'reward': inf"),
        (lambda batch: batch.observations["state"].__setitem__((3, 1), np.nan), "'vector': nan"),
    ],
)
def test_a_loss_that_is_not_finite_names_its_term_and_the_last_good_checkpoint_stays(
    spoil: Any, term: str, tmp_path: pathlib.Path
) -> None:
    challenger, batch, path = small(), random_batch(VECTOR, 2), tmp_path / "challenger.pt"
    challenger.train(batch)
    challenger.save(path)
    spoil(batch)
    with pytest.raises(RuntimeError, match=f"non-finite in the terms .*{term}"):
        challenger.train(batch)
    challenger.save(path)  # what was not updated is as good as before
    loaded = Challenger.load(path, "cpu")
    assert all(np.array_equal(value, weights(challenger)[key]) for key, value in weights(loaded).items())
    assert np.isfinite(loaded.train(random_batch(VECTOR, 2))["world_model_loss"])


def test_novelty_that_is_not_finite_is_named() -> None:
    challenger = small()
    with torch.no_grad():
        challenger.uncertainty.ensemble.weights[0][1, 0, 0] = torch.nan
    with pytest.raises(RuntimeError, match="The uncertainty loss became nan"):
        challenger.train(random_batch(VECTOR, 2))


class Signed(Uncertainty):
    """A measure of one's own that is below zero at times, or has a dimension too many."""

    def __init__(self, sizes: LatentSizes, keepdim: bool = False) -> None:
        super().__init__(sizes)
        self.net, self.keepdim = torch.nn.Linear(sizes.feat, sizes.stoch), keepdim

    def novelty(self, transitions: Transitions) -> torch.Tensor:
        return -(self.net(transitions.feat) - transitions.next_stoch).abs().mean(-1, keepdim=self.keepdim)

    def loss(self, transitions: Transitions) -> torch.Tensor:
        return -self.novelty(transitions).mean()


def test_what_an_uncertainty_of_ones_own_gives_is_checked() -> None:
    rng = np.random.default_rng(0)
    episode = {"state": rng.normal(size=(6, 3)).astype(np.float32)}, rng.uniform(-1, 1, (5, 2)).astype(np.float32)
    signed = small(uncertainty_class=Signed)
    signed.train(random_batch(VECTOR, 2))
    with pytest.raises(ValueError, match=r"Signed gave a novelty of -.*, below zero.*set `nonnegative = False`"):
        signed.evaluate(*episode)
    signed.uncertainty.nonnegative = False
    assert (signed.evaluate(*episode).disagreement < 0.0).all()
    wide = small(uncertainty_class=Signed, uncertainty_kwargs={"keepdim": True})
    with pytest.raises(ValueError, match=r"Signed gave a novelty of shape \(.*, 1\) for transitions .* one number for each"):
        wide.train(random_batch(VECTOR, 2))
    with pytest.raises(ValueError, match=r"novelty of shape \(5, 1, 1\) for transitions of shape \(5, 1\)"):
        wide.evaluate(*episode)


def test_a_broken_challenger_does_not_replace_a_good_checkpoint(tmp_path: pathlib.Path) -> None:
    challenger, path = small(), tmp_path / "challenger.pt"
    challenger.save(path)
    before = path.read_bytes()
    with torch.no_grad():
        challenger.world_model.reward_head[0].weight[2, 3] = torch.inf
    with pytest.raises(RuntimeError, match=r"not saved: its weight world_model\.reward_head\.0\.weight is not finite.*kept"):
        challenger.save(path)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


# ---- checkpoints and devices ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "entries, message",
    [
        ({"stoch_size": 7}, r"world_model\.\S+ is \(\d+, \d+\) there and \(\d+, \d+\) here"),
        ({"actor_layers": 3}, r"(no|additional) weight exploration\.actor|other sizes: exploration\.actor"),
        ({"uncertainty": {"plan2explore": {"heads": 4, "layers": 1, "units": 16}}}, r"other sizes: uncertainty\.ensemble"),
        ({"continue_head": False}, r"additional weight world_model\.continue_head"),
    ],
)
def test_a_checkpoint_of_other_sizes_names_the_first_mismatch(entries: dict, message: str, tmp_path: pathlib.Path) -> None:
    small().save(tmp_path / "challenger.pt")
    other = small(preset={**SMALL, **entries})
    before = weights(other)
    with pytest.raises(ValueError, match=message):
        other.load_state(tmp_path / "challenger.pt")
    assert all(np.array_equal(value, weights(other)[key]) for key, value in before.items())


def test_a_checkpoint_of_another_uncertainty_names_it(tmp_path: pathlib.Path) -> None:
    small().save(tmp_path / "challenger.pt")
    with pytest.raises(ValueError, match=r"weight uncertainty\."):
        small(uncertainty_class="rnd").load_state(tmp_path / "challenger.pt")


@pytest.mark.parametrize(
    "device, message",
    [("cuda", "torch sees no GPU"), ("cuda:1", "torch sees no GPU"), ("gpu", "Unknown device 'gpu'")],
)
def test_no_gpu_where_one_was_asked_for(monkeypatch: pytest.MonkeyPatch, device: str, message: str) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ValueError, match=message):
        Challenger(VECTOR, box(2), device=device, preset=SMALL)
    assert choose_device("auto").type == "cpu"


def test_a_gpu_number_that_does_not_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    with pytest.raises(ValueError, match=r"'cuda:3' was asked for, but torch sees 1 GPU"):
        choose_device("cuda:3")
