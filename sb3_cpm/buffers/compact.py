"""
How one observation key is stored: as it is, or smaller.

A point cloud of 32-bit floats knows its points to fractions of a micrometre, which no camera does; its colours were 8-bit
numbers before they became floats. Storing them as what they are quarters their memory.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

#: ``"float16"``, ``("uint8", low, high)``, or a list of such, one per feature of the last axis
StorageSpec = str | Sequence[Any]


class Codec:
    """
    A key stored as it comes.

    :param key: observation key, for messages
    :param shape: shape of one observation
    :param dtype: dtype that the observation space gives it
    """

    def __init__(self, key: str, shape: tuple[int, ...], dtype: Any):
        self.key = key
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self.stored_shape = shape
        self.stored_dtype = self.dtype

    @property
    def as_it_is(self) -> bool:
        """Whether the stored form is the observation's own."""
        return type(self) is Codec

    @property
    def nbytes(self) -> int:
        """Bytes of one stored observation."""
        return self.stored_dtype.itemsize * int(np.prod(self.stored_shape))

    def encode(self, observations: np.ndarray, n_envs: int) -> np.ndarray:
        """
        :param observations: shape ``(n_envs, *shape)``
        :param n_envs: number of environments
        :return: the same in stored form, not necessarily a copy
        :raises ValueError: if they don't fit
        """
        return self._in_shape(observations, n_envs)

    def decode(self, stored: np.ndarray) -> np.ndarray:
        """
        :param stored: fresh array in stored form, shape ``(..., *stored_shape)``
        :return: observations in the space's dtype, shape ``(..., *shape)``
        """
        return stored

    def _in_shape(self, observations: np.ndarray, n_envs: int) -> np.ndarray:
        wanted = (n_envs, *self.shape)
        given = np.asarray(observations)
        # Discrete spaces give (n_envs,) for (n_envs, 1), as in SB3; any other shape of as many numbers is something else
        if given.shape != wanted and not (wanted[-1] == 1 and given.shape == wanted[:-1]):
            raise ValueError(
                f"Observation {self.key!r} has shape {given.shape}, expected {wanted}.{_cure(given.shape, wanted)}"
            )
        return self._in_dtype(given).reshape(wanted)

    def _in_dtype(self, given: np.ndarray) -> np.ndarray:
        """:raises ValueError: for values that the space's dtype has not, as 0.5 among integers"""
        if given.dtype == self.dtype:
            return given
        if given.dtype.kind not in "biuf":
            raise ValueError(f"Observation {self.key!r} must hold numbers ({self.dtype}), got {given.dtype}.")
        with np.errstate(invalid="ignore", over="ignore"):
            cast = given.astype(self.dtype)
        # floats may be rounded, but not to infinity
        lost = cast != given if self.dtype.kind != "f" else np.isinf(cast) & np.isfinite(given)
        if lost.any():
            raise ValueError(
                f"Observation {self.key!r} holds {given[lost][0]!s} ({given.dtype}), its space declares {self.dtype}, which "
                "has no such number. Has a wrapper scaled it? Declare in the space what the environment returns "
                "(gymnasium.wrappers.TransformObservation), or give what the space says."
            )
        return cast


def _cure(given: tuple[int, ...], wanted: tuple[int, ...]) -> str:
    """What to do about a shape, where it looks like one of the usual slips."""
    if len(wanted) == 4 and given == (wanted[0], *wanted[2:], wanted[1]):
        return (
            " Its channels come last, and SB3 puts them first (VecTransposeImage around the model's environment): transpose "
            "it, image.transpose(2, 0, 1). Beside VecNormalize, make it VecNormalize(VecTransposeImage(env))."
        )
    if given == wanted[1:]:
        return f" It lacks the first dimension, the {wanted[0]} environment{'s' if wanted[0] > 1 else ''}: observation[None]."
    return " Declare in the space what the environment returns."


class _CastCodec(Codec):
    """Stored in another floating-point type."""

    def __init__(self, key: str, shape: tuple[int, ...], dtype: Any, stored_dtype: Any):
        super().__init__(key, shape, dtype)
        self.stored_dtype = np.dtype(stored_dtype)

    def encode(self, observations: np.ndarray, n_envs: int) -> np.ndarray:
        return self.encode_part(self._in_shape(observations, n_envs))

    def encode_part(self, values: np.ndarray) -> np.ndarray:
        try:
            with np.errstate(over="raise"):
                return values.astype(self.stored_dtype)
        except FloatingPointError:
            raise ValueError(
                f"Observation {self.key!r} holds values up to {np.abs(values).max():.4g}, too large for {self.stored_dtype} "
                f"(up to {np.finfo(self.stored_dtype).max:.4g}). Leave it out of storage_dtypes."
            ) from None

    def decode(self, stored: np.ndarray) -> np.ndarray:
        if self.dtype == np.float32:  # several times faster in torch than in NumPy
            return th.from_numpy(stored.copy()).float().numpy()
        return stored.astype(self.dtype)


class _ScaledCodec(Codec):
    """
    Stored as integers that divide [low, high] evenly. Values that came from such integers, as colours do, come back exactly
    to the precision of a float.
    """

    #: Values may lie outside of [low, high] by this share of it (rounding errors); they are clipped.
    TOLERANCE = 1e-3

    def __init__(self, key: str, shape: tuple[int, ...], dtype: Any, stored_dtype: Any, low: float, high: float):
        super().__init__(key, shape, dtype)
        self.stored_dtype = np.dtype(stored_dtype)
        if not (np.isfinite([low, high]).all() and low < high):
            raise ValueError(
                f"storage_dtypes[{key!r}]: storing floats as {stored_dtype} needs finite bounds, got [{low}, {high}]. Give "
                f'them, for instance ("{stored_dtype}", 0.0, 1.0).'
            )
        self.low, self.high = float(low), float(high)
        self.levels = np.iinfo(self.stored_dtype).max
        self.step = self.dtype.type((self.high - self.low) / self.levels)

    def encode(self, observations: np.ndarray, n_envs: int) -> np.ndarray:
        return self.encode_part(self._in_shape(observations, n_envs))

    def encode_part(self, values: np.ndarray) -> np.ndarray:
        levels = (values - self.low) / self.step
        slack = self.TOLERANCE * self.levels
        if not (levels.min() >= -slack and levels.max() <= self.levels + slack):  # NaN fails too
            raise ValueError(
                f"Observation {self.key!r} holds values in [{values.min():.4g}, {values.max():.4g}], but storage_dtypes "
                f"declares [{self.low:g}, {self.high:g}] for {self.stored_dtype}. Declare bounds that hold."
            )
        np.rint(levels, out=levels)
        return np.minimum(np.maximum(levels, 0), self.levels).astype(self.stored_dtype)

    def decode(self, stored: np.ndarray) -> np.ndarray:
        values = stored.astype(self.dtype)
        values *= self.step
        if self.low:
            values += self.dtype.type(self.low)
        return values


class _ColumnsCodec(Codec):
    """
    Groups of features of the last axis, each stored in its own way, in one record per observation: feature by feature, which
    is several times faster to read than point by point.
    """

    def __init__(self, key: str, shape: tuple[int, ...], dtype: Any, columns: Sequence[StorageSpec]):
        super().__init__(key, shape, dtype)
        if not shape or len(columns) != shape[-1]:
            raise ValueError(
                f"storage_dtypes[{key!r}] lists {len(columns)} features, but the observations have the shape {shape}"
            )
        starts = [0, *(i for i in range(1, len(columns)) if columns[i] != columns[i - 1]), len(columns)]
        self.parts: list[tuple[slice, str, Any]] = []
        fields = []
        for number, (start, stop) in enumerate(itertools.pairwise(starts)):
            part_shape = (*shape[:-1], stop - start)
            codec = _simple_codec(key, part_shape, dtype, columns[start], None)
            self.parts.append((slice(start, stop), f"part{number}", codec))
            fields.append((f"part{number}", codec.stored_dtype, (stop - start, *shape[:-1])))
        self.stored_dtype = np.dtype(fields)
        self.stored_shape = ()

    def encode(self, observations: np.ndarray, n_envs: int) -> np.ndarray:
        features = np.moveaxis(self._in_shape(observations, n_envs), -1, 1)
        stored = np.empty(n_envs, dtype=self.stored_dtype)
        for columns, name, codec in self.parts:
            stored[name] = codec.encode_part(features[:, columns])
        return stored

    def decode(self, stored: np.ndarray) -> np.ndarray:
        values = np.empty((*stored.shape, *self.shape), dtype=self.dtype)
        features = np.moveaxis(values, -1, stored.ndim)
        every: tuple[Any, ...] = (slice(None),) * stored.ndim
        for columns, name, codec in self.parts:
            decoded = codec.decode(stored[name])
            for number, column in enumerate(range(columns.start, columns.stop)):
                features[(*every, column)] = decoded[(*every, number)]
        return values


def make_codecs(
    space: spaces.Dict, shapes: dict[str, tuple[int, ...]], specs: dict[str, StorageSpec] | None
) -> dict[str, Codec]:
    """
    :param space: observation space
    :param shapes: shape of one stored observation per key (discrete ones have (1,))
    :param specs: ``storage_dtypes`` of :class:`~sb3_cpm.buffers.CPMBuffer`
    :return: a codec per key
    :raises ValueError: for keys that there are not and storage that would destroy the observations
    """
    specs = {} if specs is None else specs
    if not isinstance(specs, Mapping):
        raise ValueError(f'storage_dtypes must say how each key is stored, {{"pointcloud": "float16"}}, got {specs!r}')
    unknown = set(specs) - set(shapes)
    if unknown:
        raise ValueError(f"storage_dtypes {sorted(unknown)} are not among the observation keys {sorted(shapes)}")
    codecs = {}
    for key, shape in shapes.items():
        dtype = space.spaces[key].dtype
        spec = specs.get(key)
        if spec is None or spec == str(dtype):
            codecs[key] = Codec(key, shape, dtype)
        elif np.dtype(dtype).kind != "f":
            raise ValueError(f"storage_dtypes[{key!r}]: only floats can be stored smaller, this one is {dtype} already")
        elif isinstance(spec, str) or _is_scaled(spec):
            codecs[key] = _simple_codec(key, shape, dtype, spec, space.spaces[key])
        else:
            codecs[key] = _ColumnsCodec(key, shape, dtype, [tuple(s) if not isinstance(s, str) else s for s in spec])
    return codecs


def _is_scaled(spec: StorageSpec) -> bool:
    return len(spec) == 3 and isinstance(spec[0], str) and all(isinstance(bound, (int, float)) for bound in spec[1:])


def _simple_codec(key: str, shape: tuple[int, ...], dtype: Any, spec: StorageSpec, space: spaces.Space | None) -> Any:
    if not (isinstance(spec, str) or _is_scaled(spec)):
        raise ValueError(f'storage_dtypes[{key!r}]: expected "float16", ("uint8", low, high) or one per feature, got {spec!r}')
    name, *bounds = [spec] if isinstance(spec, str) else list(spec)
    try:
        stored_dtype = np.dtype(name)
    except TypeError:
        raise ValueError(f"storage_dtypes[{key!r}]: {name!r} is not a dtype") from None
    if stored_dtype.kind == "f" and not bounds:
        return _CastCodec(key, shape, dtype, stored_dtype)
    if stored_dtype.kind != "u":
        raise ValueError(
            f"storage_dtypes[{key!r}]: floats can be stored as float16, or scaled to uint8 or uint16, not {spec!r}"
        )
    if not bounds and isinstance(space, spaces.Box):  # the space declares the scale
        bounds = [float(space.low.min()), float(space.high.max())]
    return _ScaledCodec(key, shape, dtype, stored_dtype, *(bounds or (-np.inf, np.inf)))
