"""
Two switches for speed, both off by default: mixed precision (preset entry ``amp``) and ``compile``, which is ``torch.compile``
on CPUs and stands for CUDA graphs on GPUs (:mod:`sb3_cpm.world_model.fast.cuda_graphs`).

Mixed precision runs the matrix products and convolutions of training in bfloat16, whose range is float32's, so that no loss
has to be scaled. Everything that adds up small differences stays in float32: weights and optimizers, recurrent and stochastic
state, all losses, the KL, and novelty altogether, since heads that agree to three digits would agree completely in bfloat16.
Acting and judging episodes stay in float32 as well; they cost little, and their numbers become rewards.
"""

import contextlib
import functools
import platform
import warnings
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import torch as th
from torch import nn


def mixed_precision(device: th.device, enabled: bool) -> AbstractContextManager:
    """
    Context in which matrix products and convolutions run in bfloat16. Leave it before weights change: it keeps their casts.

    :param device: where they run
    :param enabled: False for a context that does nothing
    """
    return th.autocast(device.type, dtype=th.bfloat16) if enabled else contextlib.nullcontext()


def is_plain(tensor: th.Tensor) -> bool:
    """
    Whether a tensor lies on a CPU in float32, and neither mixed precision nor ``torch.compile`` is at work: what is computed
    by hand for speed is made for that.
    """
    return (
        tensor.device.type == "cpu"
        and tensor.dtype == th.float32
        and not th.is_autocast_enabled("cpu")
        and not th.compiler.is_compiling()
    )


@functools.cache
def is_amd() -> bool:
    """Whether this process has a processor of AMD's, on which MKL is not at its best."""
    return "AuthenticAMD" in processor()


def processor() -> str:
    """What the operating system says of the processor, its vendor included."""
    try:
        return Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:  # not Linux
        return platform.processor()


def cache_slices(*tensors: th.Tensor, rows: int = 64) -> Iterator[tuple[th.Tensor, ...]]:
    """
    The same rows of all tensors, on a CPU so few that several operations on them stay in its caches; on a GPU all at once.

    :param tensors: of equal first dimension
    :param rows: of a slice
    """
    size = rows if tensors[0].device.type == "cpu" else max(len(tensors[0]), 1)
    return zip(*(one.split(size) for one in tensors), strict=True)


def check_mixed_precision(device: th.device) -> None:
    """
    :raises ValueError: if the device cannot compute in bfloat16
    """
    if device.type == "cuda" and not th.cuda.is_bf16_supported():
        raise ValueError(
            f"amp=True needs bfloat16, which {th.cuda.get_device_name(device)} does not have (Ampere and later do). "
            "Leave `amp` off."
        )


def compile_modules(modules: Iterable[nn.Module], device: th.device) -> bool:
    """
    Compile modules in place: their weights keep their names, and what calls them does not change. The first call of each
    then takes seconds to minutes. Where nothing can be compiled they stay as they are, with a warning that says why.

    :param modules: what to compile; their ``forward`` must be free of random numbers
    :param device: where they run
    :return: whether they were compiled
    """
    reason = why_not_compile(device.type)
    if reason:
        warnings.warn(
            f"compile=True has no effect, torch.compile does not work here ({reason}). Install a C++ compiler (for example "
            "g++) and Python's headers; on a GPU also Triton. Everything runs as without `compile`.",
            UserWarning,
            stacklevel=3,
        )
        return False
    for module in modules:
        module.compile()
    return True


def is_compiled(module: nn.Module) -> bool:
    """Whether :func:`compile_modules` has had a module."""
    return module._compiled_call_impl is not None


@functools.cache
def why_not_compile(device_type: str) -> str:
    """:return: the error of compiling something small on such a device, empty if that works; tried once per process"""
    try:
        probe = th.compile(lambda x: th.tanh(x) * 2.0 + 1.0)
        probe(th.zeros(8, device=device_type))
    except Exception as error:  # dynamo and inductor wrap whatever fails, from a missing g++ to an unsupported Python
        return f"{type(error).__name__}: {str(error).strip().splitlines()[0][:200] if str(error).strip() else 'no message'}"
    return ""
