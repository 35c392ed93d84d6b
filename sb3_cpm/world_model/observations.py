"""
What of a Dict observation space the world model reads, and how it enters the networks (report, section 4.1 and B.1).

Images are stacked on their channels and scaled to [-0.5, 0.5]; vectors are concatenated and squashed with ``symlog``.
"""

import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_cpm.spaces import is_cloud, is_vector, looks_like_cloud
from sb3_cpm.world_model.fast.acceleration import cache_slices

MIN_FEATURE_MAP = 2  # the smallest feature map of the CNN, pixels per side


def symlog(x: th.Tensor) -> th.Tensor:
    """Logarithm that keeps sign and small values (Hafner et al. 2023, eq. 9): the range of a vector is rarely known."""
    return th.sign(x) * th.log1p(th.abs(x))


def symexp(x: th.Tensor) -> th.Tensor:
    """Inverse of ``symlog``."""
    return th.sign(x) * th.expm1(th.abs(x))


def to_tensor(array: np.ndarray | th.Tensor, device: th.device) -> th.Tensor:
    """Onto the device, without a copy where possible; torch warns about read-only arrays, so those are copied."""
    if isinstance(array, np.ndarray) and not array.flags.writeable:
        array = array.copy()
    return th.as_tensor(array, device=device)


class Inputs(NamedTuple):
    """
    Preprocessed observations of ``n`` states.

    :param images: all cameras on the channels, in [-0.5, 0.5], shape ``(n, channels, height, width)``, or None
    :param vectors: all vectors side by side, shape ``(n, vector_dim)``, or None
    """

    images: th.Tensor | None
    vectors: th.Tensor | None

    def float(self) -> "Inputs":
        """The same in float32, where mixed precision computed them."""
        return Inputs(*(None if part is None else part.float() for part in self))


class ObservationSpec:
    """
    The observation keys that the world model reads, sorted by kind.

    An *image* is a 3-D Box, channel-last ``(H, W, C)`` or channel-first ``(C, H, W)`` (the channels are the smallest
    dimension, as in SB3), of any dtype with finite bounds, which say what is black and what is white; a *vector* is a 1-D Box.
    A point cloud (2-D float Box) is read only when ``keys`` names it; it is then flattened to one long vector.

    :param observation_space: Dict space as SB3's VecEnv gives it
    :param keys: the keys to read; all images and vectors by default
    :param squash: squash vectors with ``symlog``
    :param vectors: whether vectors are among those that are read by default
    :raises ValueError: for a space that is not a Dict, unknown or unusable keys, images of unequal size
    """

    def __init__(
        self, observation_space: spaces.Dict, keys: Sequence[str] | None = None, squash: bool = True, vectors: bool = True
    ) -> None:
        if not isinstance(observation_space, spaces.Dict):
            raise ValueError(
                f"The challenger needs a Dict observation space, got {observation_space}. Wrap the environment, for "
                "example with gymnasium.wrappers.TransformObservation or a wrapper that returns {'state': observation}."
            )
        self.squash = squash
        chosen = self._choose(observation_space, keys, vectors)
        self.image_keys = tuple(key for key in chosen if is_image(observation_space[key]))
        self.vector_keys = tuple(key for key in chosen if key not in self.image_keys)
        self.keys = self.image_keys + self.vector_keys
        self.shapes: dict[str, tuple[int, ...]] = {key: tuple(observation_space[key].shape or ()) for key in self.keys}
        #: values that become -0.5 and 0.5, for every image
        self.ranges = {key: image_range(observation_space[key]) or UINT8_RANGE for key in self.image_keys}
        #: names of the dtypes of all images
        self.dtypes = {key: str(observation_space[key].dtype) for key in self.image_keys}
        self.scaled_alike = all(self.is_full_uint8(key) for key in self.image_keys)
        self.image_shape = self._image_shape()
        self.vector_sizes = [int(np.prod(self.shapes[key])) for key in self.vector_keys]
        self.vector_dim = sum(self.vector_sizes)

    @staticmethod
    def _choose(space: spaces.Dict, keys: Sequence[str] | None, vectors: bool) -> list[str]:
        if keys is None:
            chosen = [key for key, sub in space.items() if is_image(sub) or (vectors and is_vector(sub))]
            if not chosen and not vectors and any(is_vector(sub) for sub in space.values()):
                raise ValueError(
                    "No observation key is an image (3-D Box with finite bounds), and the preset's read_vectors=False leaves "
                    f'vectors out, the space has { {key: str(sub) for key, sub in space.items()} }. Take preset="report", '
                    "read_vectors=True, or name the vectors in `keys`."
                )
            if not chosen:
                raise ValueError(
                    "No observation key is usable by the challenger: it reads images (3-D Box with finite bounds) "
                    f"and vectors (1-D Box), the space has { {key: str(sub) for key, sub in space.items()} }. A point cloud "
                    "is read if `keys` names it; stacked states are best flattened (gymnasium.wrappers.FlattenObservation)."
                )
            for key, sub in space.items():
                if is_rangeless_image(sub):
                    warnings.warn(f"The challenger leaves out {key!r}: {RANGELESS.format(key=key, space=sub)}", stacklevel=4)
            return chosen
        if isinstance(keys, str) or not keys:
            raise ValueError(f"`keys` must be a non-empty list of observation keys, got {keys!r}.")
        for key in keys:
            if key not in space.spaces:
                raise ValueError(f"Unknown observation key {key!r}, the space has {sorted(space.spaces)}.")
            if is_rangeless_image(space[key]):
                raise ValueError(f"The challenger cannot read key {key!r}: {RANGELESS.format(key=key, space=space[key])}")
            if not (is_image(space[key]) or is_vector(space[key]) or is_cloud(space[key])):
                raise ValueError(
                    f"The challenger cannot read key {key!r}: {space[key]} is no image (3-D Box), no vector (1-D Box) "
                    "and no point cloud (2-D float Box). Leave it out of `keys`."
                )
        return list(dict.fromkeys(keys))

    def _image_shape(self) -> tuple[int, int, int] | None:
        if not self.image_keys:
            return None
        sizes = {key: self._height_width(key) for key in self.image_keys}
        if len(set(sizes.values())) > 1:
            listing = ", ".join(f"{key}: {height}x{width}" for key, (height, width) in sizes.items())
            raise ValueError(
                f"Images of unequal size cannot be stacked ({listing}). Render all cameras at one size, or pass `keys` "
                "with cameras of one size only."
            )
        self.channels = [self.shapes[key][0 if self._channel_first(key) else -1] for key in self.image_keys]
        height, width = sizes[self.image_keys[0]]
        return sum(self.channels), height, width

    def is_full_uint8(self, key: str) -> bool:
        """Whether an image is of the common kind, uint8 from 0 to 255."""
        return self.dtypes[key] == "uint8" and self.ranges[key] == UINT8_RANGE

    def _channel_first(self, key: str) -> bool:
        shape = self.shapes[key]
        return int(np.argmin(shape)) == 0 and shape[0] != shape[-1]

    def _height_width(self, key: str) -> tuple[int, int]:
        shape = self.shapes[key]
        return (shape[1], shape[2]) if self._channel_first(key) else (shape[0], shape[1])

    def preprocess(self, observations: Mapping[str, np.ndarray | th.Tensor], device: th.device) -> Inputs:
        """
        Raw observations to network inputs; the arrays that come in are not touched.

        :param observations: each of shape ``(*batch, *observation_shape)``; all batch dimensions are flattened
        :param device: where the inputs shall live
        :return: inputs of ``prod(batch)`` states
        :raises ValueError: for a missing key, an array of another shape than the space's, and images that are not as declared
        """
        tensors = {key: self._flat_batch(key, observations, device) for key in self.keys}
        images = vectors = None
        if self.image_keys:
            # (n, H, W, C) all along: seen as (n, C, H, W) that is PyTorch's channels-last format, fast in convolutions
            stacked = [self.channels_last(key, self._scaled(key, tensors[key])) for key in self.image_keys]
            joined = th.cat(stacked, dim=-1) if len(stacked) > 1 else stacked[0].contiguous()
            images = joined.permute(0, 3, 1, 2).float()
            images = images.div_(255.0).sub_(0.5) if self.scaled_alike else images
        if self.vector_keys:
            vectors = th.cat([tensors[key].flatten(1).float() for key in self.vector_keys], dim=-1)
            if self.squash:
                vectors = symlog(vectors)
        return Inputs(images, vectors)

    def _flat_batch(self, key: str, observations: Mapping[str, np.ndarray | th.Tensor], device: th.device) -> th.Tensor:
        if key not in observations:
            raise ValueError(f"Observation key {key!r} is missing, got {sorted(observations)}.")
        tensor = to_tensor(observations[key], device)
        if tensor.dtype == th.float64 and bool((tensor.isfinite() != tensor.float().isfinite()).any()):
            raise ValueError(
                f"Observation {key!r} holds {tensor.abs().amax():.3g}, beyond float32, in which networks compute. Scale it in "
                "a wrapper, for example with gymnasium's TransformObservation."
            )
        shape = self.shapes[key]
        if tuple(tensor.shape[-len(shape) :]) != shape:
            raise ValueError(
                f"Observation {key!r} has shape {tuple(tensor.shape)}, expected it to end in {shape}: the observation space "
                "is not the one that the challenger was built for."
            )
        if self.dtypes.get(key) == "uint8" and tensor.dtype != th.uint8:
            low, high = self.ranges[key]
            raise ValueError(
                f"Image {key!r} came as {tensor.dtype}, its space declares uint8 from {low:g} to {high:g}. Has a wrapper "
                "scaled it? Leave the image as it is (the player has normalize_images), or declare what the wrapper returns."
            )
        return tensor.reshape(-1, *shape)

    def _scaled(self, key: str, image: th.Tensor) -> th.Tensor:
        """An image in [-0.5, 0.5], or untouched where all are uint8 and can be scaled at once."""
        if self.scaled_alike:
            return image
        low, high = self.ranges[key]
        image = image.float()
        if not self.is_full_uint8(key):
            slack = RANGE_TOLERANCE * (high - low)
            if not (image.amin() >= low - slack and image.amax() <= high + slack):  # in this form NaN is caught too
                raise ValueError(
                    f"Image {key!r} holds values from {image.amin():.4g} to {image.amax():.4g}, its space declares {low:g} to "
                    f"{high:g}. Correct the space's bounds, or clip the image in a wrapper."
                )
        return ((image - low) / (high - low) - 0.5).clamp_(-0.5, 0.5)

    def channels_last(self, key: str, images: th.Tensor) -> th.Tensor:
        """
        :param key: an image key
        :param images: as the space has them, shape ``(*batch, *observation_shape)``
        :return: shape ``(*batch, height, width, channels)``
        """
        return images.movedim(-3, -1) if self._channel_first(key) else images

    def errors(self, decoded: Inputs, truth: Inputs) -> Iterator[tuple[str, th.Tensor]]:
        """
        Mean absolute error of every key, shape ``(n,)``: of images on the scale of [-0.5, 0.5], of vectors as they enter the
        networks (after ``symlog``).

        :param decoded: what the world model drew
        :param truth: what it should have drawn
        """
        if decoded.images is not None and truth.images is not None:
            pairs = cache_slices(decoded.images, truth.images)
            parts = th.cat([(one - other).abs_().mean((2, 3)) for one, other in pairs]).split(self.channels, dim=1)
            yield from zip(self.image_keys, (part.mean(1) for part in parts), strict=True)
        if decoded.vectors is not None and truth.vectors is not None:
            parts = (decoded.vectors - truth.vectors).abs().split(self.vector_sizes, dim=1)
            yield from zip(self.vector_keys, (part.mean(1) for part in parts), strict=True)

    def split(self, inputs: Inputs, batch: Sequence[int]) -> dict[str, th.Tensor]:
        """
        The inverse of :meth:`preprocess`, for decoded observations: one float tensor per key, images in their space's range.

        :param inputs: preprocessed (or decoded) observations of ``prod(batch)`` states
        :param batch: the batch dimensions to restore
        :return: tensors of shape ``(*batch, *observation_shape)``
        """
        result = {}
        if inputs.images is not None:
            cameras = th.split((inputs.images + 0.5).clamp(0.0, 1.0), self.channels, dim=1)
            for key, camera in zip(self.image_keys, cameras, strict=True):
                low, high = self.ranges[key]
                camera = camera * (high - low) + low
                camera = camera if self._channel_first(key) else camera.permute(0, 2, 3, 1)
                result[key] = camera.reshape(*batch, *self.shapes[key])
        if inputs.vectors is not None:
            vectors = symexp(inputs.vectors) if self.squash else inputs.vectors
            for key, vector in zip(self.vector_keys, th.split(vectors, self.vector_sizes, dim=-1), strict=True):
                result[key] = vector.reshape(*batch, *self.shapes[key])
        return result


UINT8_RANGE = (0.0, 255.0)
RANGE_TOLERANCE = 1e-3  # by this share of its range an image may leave it: a buffer that stores images small rounds them
GREATEST_RANGE = 2.0**32  # bounds wider than that (the limits of float32, say) tell nothing about an image
RANGELESS = (
    "{space} looks like an image, but has no finite bounds with room between them (the limits of its dtype are none), so "
    "nothing says what is black and what is white. Let the environment return uint8, or declare the bounds, as Box(0.0, 1.0, "
    "shape), with gymnasium's TransformObservation."
)


def is_image(space: spaces.Space) -> bool:
    """3-D Box with finite bounds."""
    return is_3d(space) and image_range(space) is not None


def is_3d(space: spaces.Space) -> bool:
    return isinstance(space, spaces.Box) and len(space.shape) == 3


def unread(space: spaces.Dict, keys: Collection[str]) -> dict[str, spaces.Space]:
    """
    :param space: of the observations
    :param keys: those that somebody reads
    :return: the others that nobody could have known of: point clouds are read on request only, and of images without bounds
        :class:`ObservationSpec` has told
    """
    return {
        key: sub for key, sub in space.items() if key not in keys and not looks_like_cloud(sub) and not is_rangeless_image(sub)
    }


def how_to_be_read(space: spaces.Space) -> str:
    """:return: what to do about an observation that is left out"""
    if is_cloud(space):
        return (
            "It may be a point cloud. If it is not (stacked states, say), flatten it (gymnasium.wrappers.FlattenObservation, "
            "before it goes into the Dict); or name all `keys`, this one too, to have it read as one long vector."
        )
    return "Let a wrapper make it a vector (a 1-D Box; one-hot for Discrete)."


def is_rangeless_image(space: spaces.Space) -> bool:
    """3-D Box without finite bounds."""
    return is_3d(space) and image_range(space) is None


def image_range(space: spaces.Space) -> tuple[float, float] | None:
    """Smallest and greatest value of a 3-D Box; None where it has no bounds, or none that tell what an image holds."""
    assert isinstance(space, spaces.Box)
    low, high = float(space.low.min()), float(space.high.max())
    if space.dtype.kind in "iu" and space.dtype.itemsize > 1:
        # where nothing better is known, the limits of the dtype are declared: int16 for colours, uint16 for millimetres
        limits = np.iinfo(space.dtype)
        if high >= limits.max or (limits.min < 0 and low <= limits.min):
            return None
    return (low, high) if 0.0 < high - low <= GREATEST_RANGE else None


def check_action_space(space: spaces.Space) -> None:
    """
    :raises ValueError: unless it is a bounded Box with room to act in every dimension
    """
    if not isinstance(space, spaces.Box):
        raise ValueError(f"The challenger needs a continuous action space (Box), got {space}.")
    if not np.prod(space.shape):
        raise ValueError(f"The action space {space} has no dimension to act in.")
    if not space.is_bounded():
        raise ValueError(
            f"The action space must be bounded on both sides, got {space}. Rescale it, for example with "
            "gymnasium.wrappers.RescaleAction, or state the bounds that the environment clips to."
        )
    with np.errstate(over="ignore"):
        width = space.high.astype(np.float32) - space.low.astype(np.float32)  # actions are scaled to [-1, 1] by it
    for place in np.argwhere(~((width > 0.0) & np.isfinite(width))):
        index = tuple(place.tolist())
        bounds = (
            f"The action space's dimension {index[0] if len(index) == 1 else index} is bounded from {space.low[index]:g} to "
            f"{space.high[index]:g}"
        )
        if width[index] > 0.0:
            raise ValueError(
                f"{bounds}, which is too wide to be scaled to [-1, 1]. Rescale it, for example with "
                "gymnasium.wrappers.RescaleAction, or state the bounds that the environment clips to."
            )
        raise ValueError(
            f"{bounds}: there is no room to act in. Leave the dimension out of the action space, and let a wrapper add it "
            "(gymnasium.wrappers.TransformAction)."
        )
