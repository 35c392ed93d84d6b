"""Novelty measures behind one seam: what they have in common, and what tells them apart."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from challenger_helpers import BOTH, SMALL, VECTOR, box, random_batch, small, vector, weights
from gymnasium import spaces

from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.challenger import Challenger
from sb3_cpm.challenger.file import read_file
from sb3_cpm.challenger.learning import real_transitions
from sb3_cpm.presets import PRESETS
from sb3_cpm.type_aliases import SequenceBatch
from sb3_cpm.uncertainty import UNCERTAINTY_CLASSES, Transitions
from sb3_cpm.uncertainty.base import LatentSizes, Uncertainty
from sb3_cpm.uncertainty.parts import RunningNorm

SIZES = LatentSizes(feat=8, action=2, stoch=3, deter=5, embed=6)
CATEGORICAL = {**SMALL, "latent": "categorical", "stoch_size": 4, "stoch_classes": 5}
CLASSES: list[tuple[str, dict[str, Any]]] = [
    ("plan2explore", {}),
    ("observation_ensemble", {}),
    ("rnd", {}),
    ("rnd", {"inputs": "embed"}),
    ("rnd", {"inputs": "stoch"}),
    ("rnd", {"inputs": "deter"}),
    ("prediction_error", {}),
    ("prediction_error", {"features": "inverse"}),
    ("prediction_error", {"target": "stoch"}),
]
every_class = pytest.mark.parametrize("name, kwargs", CLASSES, ids=lambda part: str(part).strip("{}") or "default")


def make(name: str, kwargs: dict[str, Any], sizes: LatentSizes = SIZES, **more: Any) -> Uncertainty:
    return UNCERTAINTY_CLASSES[name](sizes, **{"layers": 2, "units": 64, **kwargs, **more})


def learn(measure: Uncertainty, data: list[Transitions], updates: int, lr: float = 2e-3) -> None:
    adam = torch.optim.Adam([parameter for parameter in measure.parameters() if parameter.requires_grad], lr=lr)
    for update in range(updates):
        batch = data[update % len(data)]
        adam.zero_grad()
        measure.loss(batch).backward()
        adam.step()
        measure.adapt(batch)


def transitions(n: int, new: bool = False, seed: int = 0) -> Transitions:
    """A deterministic world whose unknown part lies far from the known one."""
    rng = torch.Generator().manual_seed(seed)
    latent = torch.randn(n, 3, generator=rng) + (5.0 if new else 0.0)
    action = torch.rand(n, 2, generator=rng) * 2 - 1
    reach = torch.linspace(-1, 1, 15).view(3, 5)
    following = latent + torch.nn.functional.pad(action, (0, 1))
    observed = [torch.cat((state, state.sin()), dim=-1) for state in (latent, following)]
    feat = torch.cat((latent, torch.tanh(latent @ reach)), dim=-1)
    return Transitions(feat, action, following, torch.tanh(following @ reach), observed[1], observed[0])


def imagined(real: Transitions) -> Transitions:
    return real._replace(next_embed=None, embed=None)


# ---- what they have in common ----------------------------------------------------------------------------------------


@every_class
def test_novelty_falls_where_data_is_seen_often_and_stays_high_elsewhere(name: str, kwargs: dict[str, Any]) -> None:
    measure = make(name, kwargs)
    seen, new = transitions(256, seed=100), transitions(256, new=True, seed=101)  # held out, both
    measure.adapt(seen)
    before = measure.raw(seen).mean()
    learn(measure, [transitions(256, seed=seed) for seed in range(10)], 400)
    with torch.no_grad():
        assert measure.raw(seen).mean() < 0.6 * before
        for view in (lambda batch: batch, imagined):
            known, unknown = (measure.novelty(view(batch)) for batch in (seen, new))
            assert (known >= 0.0).all() and known.shape == (256,)
            assert unknown.mean() > 2.0 * known.mean()
            assert measure.raw(view(new)).mean() > 1.5 * measure.raw(view(seen)).mean()


@every_class
def test_the_scale_is_that_of_plan2explore(name: str, kwargs: dict[str, Any]) -> None:
    """The first batch puts the upper quartile of k * d at 1, whatever the measure's own scale."""
    measure, batch = make(name, kwargs), transitions(200)
    metrics = measure.adapt(batch)
    with torch.no_grad():
        quartile = torch.quantile(measure.k * measure.raw(batch), 0.75)
    assert quartile.item() == pytest.approx(1.0, rel=1e-3)
    assert set(metrics) == {"raw_disagreement", "disagreement", "exp_scale"}
    logarithmic = make(name, kwargs, metric="log")
    assert not logarithmic.nonnegative and logarithmic.adapt(batch)["exp_scale"] == 1.0


@every_class
def test_any_batch_dimensions_and_a_gradient_for_the_actor(name: str, kwargs: dict[str, Any]) -> None:
    measure, real = make(name, kwargs), transitions(12)
    grid = Transitions(*(part.unflatten(0, (3, 4)) for part in real if part is not None))
    assert torch.allclose(measure.novelty(grid).flatten(), measure.novelty(real), rtol=1e-4, atol=1e-6)
    dreamt = Transitions(*(part.clone().requires_grad_() for part in real[:4]))
    gradients = torch.autograd.grad(measure.novelty(dreamt).sum(), list(dreamt[:4]), allow_unused=True)
    assert any(gradient is not None and gradient.abs().sum() > 0 for gradient in gradients)
    assert all(torch.isfinite(gradient).all() for gradient in gradients if gradient is not None)


@every_class
@pytest.mark.parametrize("preset", [SMALL, CATEGORICAL], ids=["gaussian", "categorical"])
def test_each_trains_saves_and_loads_bit_identically(name: str, kwargs: dict, preset: dict, tmp_path: Path) -> None:
    arguments = {"layers": 1, "units": 16, **kwargs}
    challenger = small(BOTH, preset=preset, uncertainty_class=name, uncertainty_kwargs=arguments)
    batch = random_batch(BOTH, 2)
    assert challenger.train(batch)["uncertainty_loss"] > 0
    owned = challenger.optimizers["uncertainty"].parameters
    trainable = [parameter for parameter in challenger.uncertainty.parameters() if parameter.requires_grad]
    assert {id(parameter) for parameter in owned} == {id(parameter) for parameter in trainable}
    challenger.save(tmp_path / "challenger.pt")
    expected = [challenger.train(batch) for _ in range(2)]
    loaded = Challenger.load(tmp_path / "challenger.pt", "cpu", restore_rng=True)
    assert [loaded.train(batch) for _ in range(2)] == expected
    after = weights(loaded)
    assert all(np.array_equal(value, after[key]) for key, value in weights(challenger).items())
    observations = {key: value[:4, 0] for key, value in batch.observations.items()}
    opinions = [one.evaluate(observations, batch.actions[1:4, 0]).disagreement for one in (challenger, loaded)]
    assert np.array_equal(*opinions) and (opinions[0] >= 0.0).all()


class Weighted(UNCERTAINTY_CLASSES["plan2explore"]):  # type: ignore[misc]
    """With an argument of any type."""

    def __init__(self, sizes: LatentSizes, weights: Any = None, **kwargs: Any) -> None:
        super().__init__(sizes, **kwargs)


@pytest.mark.parametrize("weights", [torch.ones(3), [1.0, np.float32(2)], {"a": (None, "b")}], ids=["tensor", "list", "dict"])
def test_arguments_that_a_file_can_hold(weights: Any, tmp_path: Path) -> None:
    challenger = small(VECTOR, uncertainty_class=Weighted, uncertainty_kwargs={"weights": weights})
    challenger.save(tmp_path / "challenger.pt")
    assert read_file(tmp_path / "challenger.pt", torch.device("cpu"))["config"]["uncertainty_kwargs"].keys() >= {"weights"}


@pytest.mark.parametrize("weights", [np.ones(3), [np.ones(3)], len, lambda: 1], ids=["array", "arrays", "function", "lambda"])
def test_arguments_that_no_file_can_hold_are_refused(weights: Any) -> None:
    """Not when the file is read again, which is too late."""
    with pytest.raises(ValueError, match=r"uncertainty_kwargs\['weights'\] is of <class '.*'>, which cannot be read"):
        small(VECTOR, uncertainty_class=Weighted, uncertainty_kwargs={"weights": weights})


@every_class
def test_each_moves_the_exploration_actor(name: str, kwargs: dict[str, Any]) -> None:
    """In imagination, with the critic zeroed: the gradient comes from the measure, through action and dynamics."""
    challenger = small(BOTH, uncertainty_class=name, uncertainty_kwargs={"layers": 1, "units": 16, **kwargs})
    batch = challenger.learner.to_device(random_batch(BOTH, 2))
    start = challenger.learner.imagination_starts(batch, challenger.world_model.loss(batch))
    novelty = challenger.learner.imagined_novelty(challenger.exploration.imagine(challenger.world_model, start))
    assert novelty.shape == (SMALL["horizon"], len(start.deter)) and (novelty >= 0.0).all()
    for step in (0, 3):
        gradients = torch.autograd.grad(
            novelty[step].sum(), list(challenger.exploration.actor.parameters()), retain_graph=True
        )
        assert all(gradient.abs().sum() > 0 for gradient in gradients)


def test_presets_name_every_class() -> None:
    for preset in PRESETS.values():
        assert set(preset.uncertainty) == set(UNCERTAINTY_CLASSES)
    for name in UNCERTAINTY_CLASSES:
        assert np.isfinite(Challenger(VECTOR, box(2), "cpu", uncertainty_class=name).train(random_batch(VECTOR, 2))["kl"])


@pytest.mark.parametrize(
    "name, kwargs, message",
    [
        ("rnd", {"inputs": "pixels"}, "`inputs` must be one of"),
        ("rnd", {"layers": 0}, "`layers` must be at least 1"),
        ("prediction_error", {"target": "feat"}, "`target` must be one of"),
        ("prediction_error", {"features": "random"}, "`features` must be one of"),
        ("prediction_error", {"forward_share": 0.0}, "`forward_share` must lie in"),
        ("observation_ensemble", {"heads": 1}, "at least two"),
        ("rnd", {"metric": "sqrt"}, "`metric` must be one of"),
    ],
)
def test_wrong_arguments(name: str, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(name, kwargs)


@pytest.mark.parametrize(
    "entry, message",
    [
        ({"plan2explor": {}}, "'uncertainty': .*Did you mean 'plan2explore'"),
        ({"rnd": {"unit": 3}}, "'uncertainty', rnd: unknown key 'unit'. Did you mean 'units'"),
    ],
)
def test_wrong_arguments_in_a_preset(entry: dict[str, Any], message: str) -> None:
    preset = {"uncertainty": entry}
    with pytest.raises(ValueError, match=message):
        Challenger(VECTOR, box(2), "cpu", preset)
    with pytest.raises(ValueError, match=message):
        ChallengerCallback(preset)  # and without an environment


# ---- what tells them apart -------------------------------------------------------------------------------------------


class NoisyTelevision:
    """
    A position that action 0 moves, and a television: where action 1 is positive it shows noise, else nothing. One can learn
    that it shows noise, but never which.
    """

    space = spaces.Dict({"place": vector(2), "television": vector(3)})

    def batch(self, rng: np.random.Generator, n: int, n_steps: int) -> SequenceBatch:
        """Whole episodes, one per column."""
        actions = np.concatenate([np.zeros((1, n, 2)), rng.uniform(-1, 1, (n_steps, n, 2))]).astype(np.float32)
        position = np.empty((n_steps + 1, n))
        position[0] = rng.uniform(0, 1, n)
        for t in range(1, n_steps + 1):
            position[t] = np.clip(position[t - 1] + 0.3 * actions[t, :, 0], 0, 1)
        noise = 2 * rng.normal(size=(n_steps + 1, n, 3)) * (actions[..., 1:] > 0)
        observations = {"place": 3 * np.stack([position, 1 - position], axis=-1), "television": noise}
        nothing, first = np.zeros((n_steps + 1, n), np.float32), np.zeros((n_steps + 1, n), bool)
        first[0] = True
        observations = {key: value.astype(np.float32) for key, value in observations.items()}
        return SequenceBatch(observations, actions, nothing, first, np.zeros_like(first), np.ones_like(first))


class Watched:
    """A world model of the television, and the transitions that it sees there."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        self.television, self.rng = NoisyTelevision(), np.random.default_rng(0)
        sizes = {
            "stoch_size": 12,
            "deter_size": 32,
            "hidden_size": 32,
            "model_lr": 3e-3,
            "horizon": 1,
            "imagination_starts": 1,
        }
        self.challenger = small(self.television.space, preset={**SMALL, **sizes})
        for _ in range(250):
            self.challenger.train(self.television.batch(self.rng, 16, 15))
        model = self.challenger.world_model
        self.sizes = LatentSizes(model.feat_dim, 2, model.latent.size, model.rssm.deter_size, model.embed_dim)
        self.data = [self.transitions(16)[0] for _ in range(60)]

    @torch.no_grad()
    def transitions(self, n: int) -> tuple[Transitions, torch.Tensor]:
        """Transitions, and whether the television shows noise after them."""
        batch = self.television.batch(self.rng, n, 15)
        sequences = self.challenger.learner.to_device(batch)
        output = self.challenger.world_model.loss(sequences)
        pairs = real_transitions(self.challenger.world_model, output.posterior, sequences.actions, output.embed)
        flat = Transitions(*(part.flatten(0, 1) for part in pairs if part is not None))
        return flat, torch.as_tensor(batch.actions[1:, :, 1] > 0).flatten()


@pytest.fixture(scope="module")
def watched() -> Watched:
    return Watched()


@pytest.mark.parametrize(
    "name, kwargs, calm",
    [
        ("plan2explore", {}, True),
        ("plan2explore", {"target": "embed"}, True),
        ("observation_ensemble", {}, True),
        ("prediction_error", {}, False),
        ("prediction_error", {"features": "inverse"}, False),
        ("prediction_error", {"target": "stoch"}, False),
    ],
)
def test_noise_keeps_prediction_errors_high_and_ensembles_calm(watched: Watched, name: str, kwargs: dict, calm: bool) -> None:
    measure = make(name, kwargs, watched.sizes)
    held_out, noisy = watched.transitions(64)
    learn(measure, watched.data, 400)
    with torch.no_grad():
        for view in (held_out, imagined(held_out)):
            raw = measure.raw(view)
            ratio = (raw[noisy].mean() / raw[~noisy].mean()).item()
            assert ratio < 1.25 if calm else ratio > 1.6, ratio


def test_running_norm() -> None:
    norm, data = (
        RunningNorm(3, bound=5.0),
        torch.randn(50, 40, 3) * torch.tensor([0.1, 1.0, 30.0]) + torch.tensor([5.0, 0, -9]),
    )
    assert torch.allclose(norm(torch.full((1, 3), 1e-3)), torch.full((1, 3), 1e-3)), "nothing is done before anything was seen"
    for batch in data:
        norm.update(batch)
    standard = (data.flatten(0, 1) - norm.mean) / norm.variance.sqrt()
    assert standard.mean(0).abs().max() < 0.05 and (standard.std(0) - 1).abs().max() < 0.05
    assert norm(torch.full((1, 3), 1e9)).abs().max() <= 5.0
    before = norm.mean.clone()
    for useless in (torch.zeros(0, 3), torch.full((2, 3), torch.inf)):
        norm.update(useless)
    assert torch.equal(norm.mean, before)
