"""Spaces as plain data, for buffers in files without pickles."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_cpm.packing import pack, unpack


def pack_space(space: spaces.Space, name: str) -> dict[str, Any]:
    """
    :param space: Box, Discrete, MultiDiscrete, MultiBinary, or a Dict of such
    :param name: what the user calls it, for messages
    :return: what JSON can say, its random numbers included
    :raises ValueError: for another space
    """
    packed: dict[str, Any]
    if isinstance(space, spaces.Dict):
        packed = {
            "kind": "Dict",
            "spaces": [[key, pack_space(part, f"{name}[{key!r}]")] for key, part in space.spaces.items()],
        }
    elif isinstance(space, spaces.Box):
        bounds = {"low": _bounds(space.low), "high": _bounds(space.high)}
        packed = {"kind": "Box", **bounds, "shape": list(space.shape), "dtype": space.dtype.str}
    elif isinstance(space, spaces.Discrete):
        packed = {"kind": "Discrete", "n": int(space.n), "start": int(space.start), "dtype": np.dtype(space.dtype).str}
    elif isinstance(space, spaces.MultiDiscrete):
        start, dtype = pack(space.start), np.dtype(space.dtype).str
        packed = {"kind": "MultiDiscrete", "nvec": pack(space.nvec), "start": start, "dtype": dtype}
    elif isinstance(space, spaces.MultiBinary):
        packed = {"kind": "MultiBinary", "n": np.array(space.n).tolist()}
    else:
        raise ValueError(
            f"{name} is {space}, which a file without pickles cannot hold; model.save_replay_buffer() pickles it."
        )
    generator = space._np_random  # the property would make one
    return packed if generator is None else {**packed, "random": pack(generator.bit_generator.state)}


def unpack_space(packed: dict[str, Any]) -> Any:
    """
    :param packed: what :func:`pack_space` returned
    :raises ValueError: if it is something else
    """
    kind = packed["kind"]
    space: spaces.Space
    if kind == "Dict":
        space = spaces.Dict()
        space.spaces = {key: unpack_space(part) for key, part in packed["spaces"]}  # the constructor would sort them
    elif kind == "Box":
        shape, dtype = tuple(packed["shape"]), np.dtype(packed["dtype"])
        low, high = (np.broadcast_to(unpack(packed[side]), shape) for side in ("low", "high"))
        space = spaces.Box(low, high, shape, dtype.type)
    elif kind == "Discrete":
        space = spaces.Discrete(packed["n"], start=packed["start"])
        space.dtype = np.dtype(packed["dtype"])
    elif kind == "MultiDiscrete":
        space = spaces.MultiDiscrete(unpack(packed["nvec"]), np.dtype(packed["dtype"]).type, start=unpack(packed["start"]))
    elif kind == "MultiBinary":
        space = spaces.MultiBinary(packed["n"])
    else:
        raise ValueError(f"There is no space {kind!r} to be read here.")
    if "random" in packed:
        space.np_random.bit_generator.state = unpack(packed["random"])
    return space


def _bounds(bounds: np.ndarray) -> Any:
    """One number where all are equal, as those of images are."""
    same = bounds.size > 0 and bool((bounds == bounds.flat[0]).all())
    return pack(bounds.reshape(-1)[:1].reshape(()) if same else bounds)
