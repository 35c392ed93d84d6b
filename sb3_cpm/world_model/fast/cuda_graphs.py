"""
CUDA graphs of whole updates (preset entry ``compile`` on a GPU).

A world model's update is two thousand operations on a GPU, most of them so small that it takes longer to launch than to
compute them. A CUDA graph launches all of them at once. It replays what was recorded on the same memory, so that it fits
functions that are given tensors of the same shapes, look at no number on the way, and read weights that change in place.
"""

import gc
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch as th

WARM_UP = 2  # calls before a function is recorded
MOST_GRAPHS = 4  # of a function, one for every shape of its inputs: each takes memory

Signature = tuple[tuple[th.Size, th.dtype] | None, ...]


class Recording(NamedTuple):
    """
    :param graph: what to replay
    :param inputs: tensors that the graph reads
    :param outputs: what the function returned while it was recorded; replaying writes to its tensors
    """

    graph: th.cuda.CUDAGraph
    inputs: tuple[th.Tensor | None, ...]
    outputs: Any


class GraphPool:
    """
    Memory that the graphs of one challenger share: they never run at the same time.

    :param device: of all their tensors
    """

    def __init__(self, device: th.device) -> None:
        self.device = device
        self.handle = th.cuda.graph_pool_handle()


@contextmanager
def forbidden_synchronization() -> Iterator[None]:
    """Context in which looking at a number on a GPU is an error."""
    before = th.cuda.get_sync_debug_mode()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it is said to be a prototype
            th.cuda.set_sync_debug_mode("error")
        yield
    finally:
        th.cuda.set_sync_debug_mode(before)


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Context in which nothing that is thrown away gives memory back: an older graph that does spoils one being recorded."""
    gc.collect()
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class Graphed:
    """
    A function that is recorded at its third call with inputs of the same shapes, and replayed from then on. The first two run
    as ever: they let the libraries choose their algorithms, and show whether the function can be recorded.

    What it returns is written over by the next call. Functions that look at numbers on the way (a measure of uncertainty of
    your own might) go on as they are, with a warning.

    :param name: how the warning calls it
    :param function: of tensors, or None for those that are missing, on a GPU; random numbers must come from torch's generator
    :param pool: memory for the graphs
    """

    def __init__(self, name: str, function: Callable[..., Any], pool: GraphPool) -> None:
        self.name, self.function, self.pool = name, function, pool
        self.calls: Counter[Signature] = Counter()
        self.recordings: dict[Signature, Recording] = {}
        self.works = True

    def __call__(self, *inputs: th.Tensor | None) -> Any:
        signature = tuple(None if one is None else (one.shape, one.dtype) for one in inputs)
        if signature not in self.recordings:
            self.calls[signature] += 1
            if self.calls[signature] <= WARM_UP or not self.works or len(self.recordings) >= MOST_GRAPHS:
                return self._without(inputs)
            self.recordings[signature] = self._record(inputs)
        recording = self.recordings[signature]
        for fixed, new in zip(recording.inputs, inputs, strict=True):
            if fixed is not None and new is not None:
                fixed.copy_(new)
        with th.cuda.device(self.pool.device):
            recording.graph.replay()
        return recording.outputs

    def _without(self, inputs: tuple[th.Tensor | None, ...]) -> Any:
        """As it is, on the look-out for what a graph cannot do: found out while recording, it would break the generator."""
        if not self.works:
            return self.function(*inputs)
        try:
            with forbidden_synchronization():
                return self.function(*inputs)
        except RuntimeError as error:
            if "synchronizing" not in str(error):
                raise
        self.works = False
        warnings.warn(
            f"The update of the {self.name} cannot be recorded as a CUDA graph and runs as without `compile`: it looks at "
            "numbers on the way (`.item()`, `bool(tensor)`, boolean indices), perhaps in an uncertainty class of your own.",
            UserWarning,
            stacklevel=3,
        )
        return self.function(*inputs)

    def _record(self, inputs: tuple[th.Tensor | None, ...]) -> Recording:
        fixed = tuple(None if one is None else one.clone() for one in inputs)
        graph = th.cuda.CUDAGraph()
        with th.cuda.device(self.pool.device):
            stream = th.cuda.Stream()  # torch's own stream for recording belongs to the GPU that was the first to use it
            with no_garbage_collection(), th.cuda.graph(graph, pool=self.pool.handle, stream=stream):
                outputs = self.function(*fixed)
        return Recording(graph, fixed, outputs)


class GraphedFunctions:
    """
    The functions of one challenger by name, each recorded on its own, in memory that they share.

    :param device: of all their tensors
    """

    def __init__(self, device: th.device) -> None:
        self.pool = GraphPool(device)
        self.functions: dict[str, Graphed] = {}

    def run(self, name: str, function: Callable[..., Any], *inputs: th.Tensor | None) -> Any:
        """
        :param name: of the function, also in the warning of one that cannot be recorded
        :param function: see :class:`Graphed`; of a name only the first is ever called
        :param inputs: its arguments
        """
        if name not in self.functions:
            self.functions[name] = Graphed(name, function, self.pool)
        return self.functions[name](*inputs)
