"""When updates are recorded and when they are replayed. That CUDA graphs compute the same needs a GPU: test_gpu.py."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import pytest
import torch

from sb3_cpm.world_model.fast import cuda_graphs
from sb3_cpm.world_model.fast.cuda_graphs import MOST_GRAPHS, WARM_UP, Graphed, GraphPool


class Double:
    """Doubles numbers; what it has returned last is written over when a graph is replayed."""

    def __init__(self) -> None:
        self.calls = 0
        self.synchronizes = False

    def __call__(self, inputs: torch.Tensor, missing: None) -> torch.Tensor:
        self.calls += 1
        if self.synchronizes:
            raise RuntimeError("called a synchronizing CUDA operation")
        self.inputs, self.outputs = inputs, 2.0 * inputs
        return self.outputs


@pytest.fixture
def double(monkeypatch: pytest.MonkeyPatch) -> Double:
    """The function, among stand-ins for what needs a GPU."""
    function = Double()

    class Graph:
        def replay(self) -> None:
            torch.mul(self.inputs, 2.0, out=self.outputs)

    @contextmanager
    def record(graph: Any, pool: Any, stream: Any) -> Iterator[None]:
        yield
        graph.inputs, graph.outputs = function.inputs, function.outputs

    @contextmanager
    def forbidden_synchronization() -> Iterator[None]:
        try:
            yield
        finally:
            function.synchronizes = False

    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", record)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 0))
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    monkeypatch.setattr(torch.cuda, "Stream", lambda: None)
    monkeypatch.setattr(cuda_graphs, "forbidden_synchronization", forbidden_synchronization)
    return function


def test_the_third_call_records_and_the_others_replay(double: Double) -> None:
    graphed = Graphed("example", double, GraphPool(torch.device("cuda")))
    for call in range(1, 7):
        inputs = torch.full((3,), float(call))
        assert torch.equal(graphed(inputs, None), 2.0 * inputs)
        assert torch.equal(inputs, torch.full((3,), float(call)))
        assert double.calls == min(call, WARM_UP + 1) and len(graphed.recordings) == (call > WARM_UP)


def test_every_shape_has_a_graph_of_its_own_but_not_too_many(double: Double) -> None:
    graphed = Graphed("example", double, GraphPool(torch.device("cuda")))
    for size in range(1, MOST_GRAPHS + 3):
        for _ in range(2):
            for call in range(WARM_UP + 2):
                inputs = torch.full((size,), float(call))
                assert torch.equal(graphed(inputs, None), 2.0 * inputs)
    assert len(graphed.recordings) == MOST_GRAPHS


def test_what_looks_at_numbers_is_found_out_before_it_is_recorded(double: Double) -> None:
    graphed, double.synchronizes = Graphed("example", double, GraphPool(torch.device("cuda"))), True
    with pytest.warns(UserWarning, match=r"The update of the example cannot be recorded .*\.item\(\)"):
        assert torch.equal(graphed(torch.ones(3), None), torch.full((3,), 2.0))
    for _ in range(4):
        assert torch.equal(graphed(torch.ones(3), None), torch.full((3,), 2.0))
    assert not graphed.recordings


def test_other_errors_are_no_reason_to_go_on(double: Double) -> None:
    def fails(inputs: torch.Tensor) -> torch.Tensor:
        return inputs @ torch.ones(4, 4)

    with pytest.raises(RuntimeError, match="mat1 and mat2 shapes cannot be multiplied"):
        Graphed("example", fails, GraphPool(torch.device("cuda")))(torch.ones(2, 3))
