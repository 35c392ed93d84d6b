"""The challenger on a GPU: what it computes there is what it computes on a CPU, with and without its switches for speed."""

import gc
from typing import Any

import numpy as np
import pytest
import torch
from challenger_helpers import BOTH, SMALL, VECTOR, box, random_batch, weights

from sb3_cpm.challenger import Challenger
from sb3_cpm.type_aliases import SequenceBatch
from sb3_cpm.uncertainty import LatentDisagreement, Transitions
from sb3_cpm.world_model.fast.cuda_graphs import Graphed, GraphPool

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
CATEGORICAL = {"latent": "categorical", "stoch_size": 4, "stoch_classes": 5}


def whole(seed: int = 0) -> SequenceBatch:
    """Without an episode's end, so that imagination starts from every row."""
    batch = random_batch(BOTH, 2, seed=seed)
    return batch._replace(is_terminal=np.zeros_like(batch.is_terminal))


def make(device: str = "cuda", **kwargs: Any) -> Challenger:
    torch.manual_seed(0)
    return Challenger(BOTH, box(2), device, **{"preset": SMALL, "imagination_starts": None, **kwargs})


@pytest.mark.parametrize("amp", [False, True])
@pytest.mark.parametrize("compiled", [False, True])
def test_on_a_gpu_and_back(amp: bool, compiled: bool, tmp_path: Any) -> None:
    challenger = make(amp=amp, compile=compiled)
    for seed in range(4):
        assert np.isfinite(challenger.train(random_batch(BOTH, 2, seed=seed))["world_model_loss"])
    challenger.save(tmp_path / "challenger.pt")
    loaded = Challenger.load(tmp_path / "challenger.pt", "cuda" if compiled else "cpu")  # on a CPU the compiler takes a minute
    after = weights(loaded)
    assert all(np.array_equal(value, after[key]) for key, value in weights(challenger).items())
    assert loaded.trained_updates == 4


@pytest.mark.parametrize("latent", [{}, CATEGORICAL])
def test_it_computes_what_a_cpu_computes(latent: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Losses and gradients of the world model, with the same random numbers."""
    monkeypatch.setattr("torch.backends.cuda.matmul.allow_tf32", False)
    monkeypatch.setattr("torch.backends.cudnn.allow_tf32", False)
    results = []
    for device in ("cpu", "cuda"):
        challenger = make(device, **latent)
        kind = type(challenger.world_model.latent)
        draw = kind.noise

        def noise(self: Any, *batch: int, like: torch.Tensor, draw: Any = draw) -> torch.Tensor:
            torch.manual_seed(1)
            return draw(self, *batch, like=torch.zeros(())).to(like.device)

        with monkeypatch.context() as patch:
            patch.setattr(kind, "noise", noise)
            sequences = challenger.learner.to_device(whole())
            output, gradients = challenger.learner.learn_model(*sequences.inputs, *sequences[1:])
        results.append([part.cpu() for part in (*output.losses.values(), *output.posterior, *gradients)])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("latent", [{}, CATEGORICAL])
@pytest.mark.parametrize("kind", ["dynamics", "reinforce"])
def test_cuda_graphs_compute_the_same(latent: dict[str, Any], kind: str) -> None:
    results = []
    for compiled in (False, True):
        challenger = make(compile=compiled, actor_gradient=kind, train_task_behavior=True, **latent)
        assert challenger.compiled is compiled
        torch.manual_seed(0)
        results.append([challenger.train(whole(seed)) for seed in range(6)])
    assert len(challenger.learner.graphs.functions["world model"].recordings) == 1
    for one, other in zip(*results, strict=True):
        assert one == pytest.approx(other, rel=1e-2, abs=1e-3)


def test_cuda_graphs_draw_new_numbers_and_follow_the_weights() -> None:
    challenger, batch = make(compile=True), whole()
    losses = [challenger.train(batch)["world_model_loss"] for _ in range(30)]
    assert len(set(losses)) == len(losses) and losses[-1] < 0.97 * losses[0]


def test_cuda_graphs_for_batches_of_any_shape_with_missing_rows() -> None:
    challenger = make(compile=True)
    for length in (8, 8, 8, 6, 6, 6, 8):
        batch = random_batch(BOTH, 2, length=length)
        batch.mask[-2:, 1] = False
        assert all(np.isfinite(value) for value in challenger.train(batch).values())
    assert len(challenger.learner.graphs.functions["world model"].recordings) == 2


class Looks(LatentDisagreement):
    """Looks at a number, which no CUDA graph can."""

    def novelty(self, transitions: Transitions) -> torch.Tensor:
        novelty = super().novelty(transitions)
        return novelty * float(novelty.mean() >= 0.0)


def test_what_cannot_be_recorded_goes_on_without_a_cuda_graph() -> None:
    torch.manual_seed(0)
    challenger = Challenger(VECTOR, box(2), "cuda", SMALL, uncertainty_class=Looks, compile=True)
    batches = [random_batch(VECTOR, 2, seed=seed) for seed in range(6)]
    with pytest.warns(UserWarning, match="exploration behaviour cannot be recorded as a CUDA graph"):
        challenger.train(batches[0])
    for batch in batches[1:]:
        assert all(np.isfinite(value) for value in challenger.train(batch).values())


def test_a_graph_that_is_thrown_away_does_not_spoil_one_being_recorded() -> None:
    """Python may throw away an earlier challenger at any moment, if cycles hold it; here it is during a recording."""
    pool = GraphPool(torch.device("cuda", torch.cuda.current_device()))
    inputs = torch.ones(3, device="cuda")

    def twice(numbers: torch.Tensor) -> torch.Tensor:
        _ = [[] for _ in range(100_000)]  # type: ignore[var-annotated]
        return 2.0 * numbers

    thresholds = gc.get_threshold()
    try:
        gc.disable()
        old: Any = Graphed("old", twice, pool)
        for _ in range(3):
            old(inputs)
        old.itself = old
        del old
        new = Graphed("new", twice, pool)
        for _ in range(2):
            new(inputs)
        gc.set_threshold(2_000, 1, 1)
        gc.enable()
        assert new(inputs).tolist() == [2.0, 2.0, 2.0] and gc.isenabled()
    finally:
        gc.set_threshold(*thresholds)
        gc.enable()


def test_not_a_number_is_refused_in_a_cuda_graph_too() -> None:
    challenger, batch = make(compile=True), whole()
    for _ in range(4):
        challenger.train(batch)
    before = weights(challenger)
    with pytest.raises(RuntimeError, match="non-finite in the terms .*reward"):
        challenger.train(batch._replace(rewards=np.full_like(batch.rewards, np.nan)))
    assert all(np.array_equal(value, before[key]) for key, value in weights(challenger).items())
    assert np.isfinite(challenger.train(batch)["world_model_loss"])
