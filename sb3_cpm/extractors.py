"""
What the player sees: PointNet for point clouds, with state vectors appended (report, section 4.1).

PointNet (Qi et al. 2017): the same small MLP for every point, then the maximum over all points, so the order of the points
cannot matter. The challenger looks at camera images, the player doesn't: keys that only the challenger uses neither go
through the player's networks nor have to be in the batches that the player trains on.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space, is_image_space_channels_first
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, MultiInputPolicy
from torch import nn

from sb3_cpm.spaces import is_cloud, is_vector, looks_like_cloud

CACHED_FLOATS = 2**18  # activations of a layer that stay in a core's cache
SMALLEST_IMAGE = 14  # pixels per side; three strided convolutions leave 1x1


class PointNet(nn.Module):
    """
    One feature vector for a set of points, whatever their order.

    Only the points that hold the maximum of some channel, the *critical points* of the paper (section 4.3), influence the
    result, and only they receive a gradient. So the maximum is searched without a gradient, and the graph is built
    for the critical points alone: the same numbers and the same gradients, for less than half of the time.

    Layers begin as orthogonal matrices without a bias, as SB3's on-policy algorithms begin: points are a few centimetres from
    each other, and PyTorch's own beginning, whose biases are larger than that, tells them apart too late (docs/imitation.md).

    :param n_features: columns of a point: xyz first, then anything else (colour, ...)
    :param sizes: layer sizes of the shared MLP; the last one is the size of the result
    :param input_transform: align xyz by a predicted 3x3 matrix first (the T-Net of the paper, section 4.2)
    :raises ValueError: when sizes is empty, or a transform is asked for and points have less than three columns
    """

    def __init__(self, n_features: int, sizes: Sequence[int] = (32, 64, 128), input_transform: bool = False) -> None:
        super().__init__()
        if len(sizes) == 0 or min(sizes) < 1:
            raise ValueError(f"PointNet sizes={tuple(sizes)}: expected at least one layer, each of one unit or more")
        if input_transform and n_features < 3:
            raise ValueError(f"input_transform=True needs points with x, y, z, but these have {n_features} column(s)")
        *hidden, last = sizes
        layers = create_mlp(n_features, -1, list(hidden)) if hidden else []
        self.shared = nn.Sequential(*layers)
        self.last = nn.Linear(hidden[-1] if hidden else n_features, last)
        self.widest = max(sizes)
        for layer in (*self.shared, self.last):
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, gain=2**0.5)
                nn.init.zeros_(layer.bias)
        self.transform = InputTransform() if input_transform else None

    def forward(self, points: th.Tensor) -> th.Tensor:
        """
        :param points: shape ``(batch, n_points, n_features)``
        :return: shape ``(batch, sizes[-1])``
        """
        if self.transform is not None:
            points = th.cat([points[..., :3] @ self.transform(points[..., :3]), points[..., 3:]], dim=-1)
        if not th.is_grad_enabled():
            strongest = [
                self._project(part).amax(dim=1) for part in self._parts(points)
            ]  # `amax`: ten times faster than `max`
            return th.relu(th.cat(strongest) + self.last.bias)
        with th.no_grad():
            critical = th.cat([self._critical(part) for part in self._parts(points)])
        # row c of `hidden` belongs to the point that is strongest in channel c, so only that one product is needed of it
        chosen = points.gather(1, critical.unsqueeze(-1).expand(-1, -1, points.shape[-1]))
        hidden = self.shared(chosen)
        return th.relu((hidden * self.last.weight).sum(-1) + self.last.bias)

    def _parts(self, points: th.Tensor) -> Sequence[th.Tensor]:
        """Clouds that go through the layers together: on a CPU as many as its cache holds, which takes half of the time."""
        if points.device.type != "cpu" or th.compiler.is_compiling():  # a graph is for batches of any size
            return (points,)
        return points.split(max(CACHED_FLOATS // (points.shape[1] * self.widest), 1))

    def _project(self, points: th.Tensor) -> th.Tensor:
        """Channels of every point up to the bias, which cannot change who is strongest."""
        return nn.functional.linear(self.shared(points), self.last.weight)

    def _critical(self, points: th.Tensor) -> th.Tensor:
        """:return: the first of the strongest points by channel, as `max` has them, shape ``(batch, channels)``"""
        channels = self._project(points)
        if points.device.type != "cpu":
            return channels.max(dim=1).indices
        n_points = points.shape[1]
        places = th.arange(n_points, 0, -1, dtype=channels.dtype).unsqueeze(-1)  # the first point has the largest
        # three simple passes take half of the time that `max` takes along this dimension
        found = channels.sub_(channels.amax(dim=1, keepdim=True)).ge_(0).mul_(places).amax(dim=1)
        if bool((found == 0).any()):  # nothing is as large as NaN
            return self._project(points).max(dim=1).indices
        return (n_points - found).long()


class InputTransform(nn.Module):
    """
    T-Net: predict a 3x3 matrix from the points themselves; it starts as the identity.

    :param sizes: layer sizes of its own PointNet
    """

    def __init__(self, sizes: Sequence[int] = (32, 64)) -> None:
        super().__init__()
        self.points = PointNet(3, sizes)
        self.matrix = nn.Linear(sizes[-1], 9)
        nn.init.zeros_(self.matrix.weight)
        with th.no_grad():
            self.matrix.bias.copy_(th.eye(3).flatten())

    def forward(self, xyz: th.Tensor) -> th.Tensor:
        """
        :param xyz: shape ``(batch, n_points, 3)``
        :return: shape ``(batch, 3, 3)``
        """
        return self.matrix(self.points(xyz)).view(-1, 3, 3)


class ImageEncoder(nn.Module):
    """
    A small CNN that takes images of 16x16 pixels and more (SB3's NatureCNN rejects 32x32).

    :param space: the image's space, as SB3's ``VecEnv`` gives it
    :param size: size of the result
    :raises ValueError: for smaller images
    """

    def __init__(self, space: spaces.Box, size: int = 64) -> None:
        super().__init__()
        self.channels_first = is_image_space_channels_first(space)
        channels = space.shape[0] if self.channels_first else space.shape[-1]
        if min(space.shape[1:] if self.channels_first else space.shape[:-1]) < SMALLEST_IMAGE:
            raise ValueError(
                f"PointNetExtractor reads images of {SMALLEST_IMAGE}x{SMALLEST_IMAGE} pixels and more, not {space}. Let a "
                "wrapper enlarge them (gymnasium.wrappers.ResizeObservation), or flatten them to vectors."
            )
        self.cnn = nn.Sequential(
            nn.Conv2d(channels, 32, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(32, 64, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(64, 64, 2, stride=2),
            nn.ReLU(),
            nn.Flatten(),
        )
        with th.no_grad():
            n_flat = self.cnn(self._channels_first(th.zeros(1, *space.shape))).shape[1]
        self.linear = nn.Sequential(nn.Linear(n_flat, size), nn.ReLU())

    def forward(self, image: th.Tensor) -> th.Tensor:
        """
        :param image: pixels in [0, 1], shape ``(batch, channels, height, width)`` or ``(batch, height, width, channels)``
        :return: shape ``(batch, size)``
        """
        return self.linear(self.cnn(self._channels_first(image)))

    def _channels_first(self, image: th.Tensor) -> th.Tensor:
        return image if self.channels_first else image.permute(0, 3, 1, 2)


class PointNetExtractor(BaseFeaturesExtractor):
    """
    Features extractor for Dict observations with point clouds: a PointNet per cloud, vectors appended.

    Which keys it reads stands in ``player_keys``; ``CPMBuffer`` leaves all others out of the batches for the player.
    To be used with any SB3 algorithm: ``policy_kwargs=dict(features_extractor_class=PointNetExtractor)``.

    :param observation_space: Dict space; a *cloud* is a 2-D float Box ``(n_points, n_features)``, a *vector* a 1-D Box,
        an *image* a 3-D uint8 Box
    :param sizes: layer sizes of the shared MLP of each PointNet
    :param input_transform: align each cloud by a predicted 3x3 matrix (T-Net); costs about half as much again
    :param state_arch: layer sizes of an MLP for the vectors, ``()`` to append them as they are
    :param keys: the keys to read, by default all clouds and vectors; images are read only when named here, or
        where there is nothing else
    :param image_size: features per image, when images are read
    :raises ValueError: for another space than Dict, a key that doesn't exist, a kind of key that cannot be read, or
        when nothing is left to read
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        sizes: Sequence[int] = (32, 64, 128),
        input_transform: bool = False,
        state_arch: Sequence[int] = (),
        keys: Sequence[str] | None = None,
        image_size: int = 64,
    ) -> None:
        kinds = _kinds_of_keys(observation_space, keys)
        clouds = [key for key, kind in kinds.items() if kind == "cloud"]
        vectors = [key for key, kind in kinds.items() if kind == "vector"]
        images = [key for key, kind in kinds.items() if kind == "image"]
        n_vector = sum(get_flattened_obs_dim(observation_space[key]) for key in vectors)
        n_state = state_arch[-1] if state_arch and n_vector else n_vector
        super().__init__(observation_space, len(clouds) * sizes[-1] + len(images) * image_size + n_state)

        self.player_keys: tuple[str, ...] = tuple(kinds)
        self.cloud_keys, self.vector_keys, self.image_keys = clouds, vectors, images
        # lists, since a key may hold signs that a module's name may not
        self.clouds = nn.ModuleList(PointNet(_box(observation_space, key).shape[1], sizes, input_transform) for key in clouds)
        self.images = nn.ModuleList(ImageEncoder(_box(observation_space, key), image_size) for key in images)
        layers = create_mlp(n_vector, -1, list(state_arch)) if state_arch and n_vector else []
        self.state = nn.Sequential(*layers)

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """
        :param observations: the tensors of ``player_keys``, shape ``(batch, *key_shape)``; others may be missing
        :return: shape ``(batch, features_dim)``
        """
        parts = [net(observations[key].float()) for key, net in zip(self.cloud_keys, self.clouds, strict=True)]
        parts += [net(observations[key]) for key, net in zip(self.image_keys, self.images, strict=True)]
        if self.vector_keys:
            parts.append(self.state(th.cat([observations[key].float() for key in self.vector_keys], dim=1)))
        return th.cat(parts, dim=1)


class _Remembered:
    """Features of the newest batch, which actor and critic both need. Copies of a policy have none."""

    def __init__(self) -> None:
        self.obs: PyTorchObs | None = None
        self.features: th.Tensor | None = None
        self.versions: list[int] = []

    def __deepcopy__(self, memo: dict[int, Any]) -> "_Remembered":
        return _Remembered()

    def keep(self, obs: PyTorchObs, features: th.Tensor, extractor: nn.Module) -> None:
        self.obs, self.features, self.versions = obs, features, _versions(extractor)

    def recall(self, obs: PyTorchObs, extractor: nn.Module | None) -> th.Tensor | None:
        """:return: features of these very observations, and if an extractor is given, as it is now"""
        if self.obs is not obs or (extractor is not None and self.versions != _versions(extractor)):
            return None
        return self.features


def _versions(module: nn.Module) -> list[int]:
    """What counts the changes of its parameters."""
    return [parameter._version for parameter in module.parameters()]


class FrugalCritic(ContinuousCritic):
    """SB3's critic, which also builds the extractor's graph where its gradients are thrown away: same numbers, less work."""

    #: Where the actor reads this critic's extractor.
    remembered: _Remembered | None = None

    def features(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        :param obs: shape ``(batch, *obs_shape)``
        :param actions: that are to be rated with them
        :return: shape ``(batch, features_dim)``, with a graph where somebody wants its gradients
        """
        # Two cases need no graph: targets (SB3 computes them within `no_grad`, but its critic switches gradients on again),
        # and the actor's loss (the actions carry a gradient, and SB3 clears the critic's before its next step).
        wanted = th.is_grad_enabled() and not self.share_features_extractor and not actions.requires_grad
        if self.remembered is not None and th.is_grad_enabled():
            # the actor's loss takes those from before the critic's step
            found = self.remembered.recall(obs, self.features_extractor if wanted else None)
            if found is not None:
                return found if wanted else found.detach()
        with th.set_grad_enabled(wanted):
            return self.extract_features(obs, self.features_extractor)

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        q_value_input = th.cat([self.features(obs, actions), actions], dim=1)
        return tuple(q_net(q_value_input) for q_net in self.q_networks)


class ReadingActor(Actor):
    """An actor that reads the critic's features: its own losses do not train them, a clone of its actions does."""

    remembered: _Remembered
    _of_loss = False

    def action_log_prob(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        self._of_loss = True
        try:
            return super().action_log_prob(obs)
        finally:
            self._of_loss = False

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        features = super().extract_features(obs, features_extractor)
        if not (self._of_loss and th.is_grad_enabled()):
            return features
        self.remembered.keep(obs, features, features_extractor)  # with the graph that the critic's loss needs
        return features.detach()


class PointNetPolicy(MultiInputPolicy):
    """
    SAC's ``MultiInputPolicy`` with :class:`PointNetExtractor` as the default extractor; all arguments as in SB3. TD3, DDPG and
    TQC have policies of their own: give them ``"MultiInputPolicy"`` and
    ``policy_kwargs=dict(features_extractor_class=PointNetExtractor)``.

    Actor and critic have an extractor each (SB3's default as well): SB3 trains a shared one by the actor's loss alone, a
    weak signal for something as large as a PointNet. With ``critics_extractor`` they share one that the critic's loss alone
    trains, as is usual for images (Yarats et al. 2021): three passes per update in place of five.

    :param observation_space: Dict space
    :param action_space: Box space
    :param lr_schedule: learning rate schedule
    :param features_extractor_class: :class:`PointNetExtractor` unless told otherwise
    :param critics_extractor: whether the actor reads the critic's features, and has no extractor of its own
    :param kwargs: further arguments of ``MultiInputPolicy``
    :raises ValueError: for ``critics_extractor`` with SB3's ``share_features_extractor``
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        features_extractor_class: type[BaseFeaturesExtractor] = PointNetExtractor,
        critics_extractor: bool = False,
        **kwargs: Any,
    ) -> None:
        if critics_extractor and kwargs.get("share_features_extractor"):
            raise ValueError(
                "critics_extractor and share_features_extractor are two ways of sharing: SB3's trains the features by the "
                "actor's loss, ours by the critic's. Leave one out."
            )
        self.critics_extractor = critics_extractor
        super().__init__(
            observation_space, action_space, lr_schedule, features_extractor_class=features_extractor_class, **kwargs
        )

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        if not self.critics_extractor:
            return
        actor, critic = self.actor, self.critic
        assert isinstance(actor, ReadingActor) and isinstance(critic, FrugalCritic)
        actor.features_extractor = critic.features_extractor
        actor.remembered = critic.remembered = _Remembered()
        own = [one for name, one in actor.named_parameters() if not name.startswith("features_extractor.")]
        actor.optimizer = self.optimizer_class(own, lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "critics_extractor": self.critics_extractor}

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        kind = ReadingActor if self.critics_extractor else Actor
        return kind(**self._update_features_extractor(self.actor_kwargs, features_extractor)).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        return FrugalCritic(**self._update_features_extractor(self.critic_kwargs, features_extractor)).to(self.device)

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """As in SB3, but keys that the extractor doesn't read are neither copied nor moved to the device."""
        player_keys = getattr(self.actor.features_extractor, "player_keys", None)
        if player_keys is not None and isinstance(observation, dict):
            observation = {key: observation[key] for key in player_keys}
        return super().obs_to_tensor(observation)


def _kinds_of_keys(space: spaces.Space, keys: Sequence[str] | None) -> dict[str, str]:
    """
    :return: "cloud", "vector" or "image" for every key to read, in the order of the space
    :raises ValueError: see :class:`PointNetExtractor`
    """
    if not isinstance(space, spaces.Dict):
        raise ValueError(
            f"PointNetExtractor reads Dict observations, not {space}. "
            "sb3_cpm.envs.wrappers.DictObservation turns a Box into a Dict."
        )
    missing = [key for key in keys or () if key not in space.spaces]
    if missing:
        raise ValueError(f"PointNetExtractor was told to read {missing}, but the observation has {list(space.spaces)}")
    kinds = {key: _kind(subspace) for key, subspace in space.spaces.items()}
    if keys is not None:
        chosen = {key: kind for key, kind in kinds.items() if key in keys}
        unreadable = [f"{key}: {space[key]}" for key, kind in chosen.items() if kind == "other"]
        if unreadable:
            raise ValueError(f"PointNetExtractor reads clouds, vectors and images, not {unreadable}")
    else:
        chosen = {key: kind for key, kind in kinds.items() if kind in ("cloud", "vector")}
        chosen = chosen or {key: kind for key, kind in kinds.items() if kind == "image"}
        for key in (key for key, kind in chosen.items() if kind == "cloud" and not looks_like_cloud(space[key])):
            warnings.warn(
                f"PointNetExtractor reads {key!r} ({space[key]}) as a point cloud: the order of its rows is lost. If it is "
                "something else (stacked states, say), flatten it (gymnasium.wrappers.FlattenObservation, before it goes into "
                "the Dict); if it is a cloud, say so by naming all `keys`.",
                stacklevel=3,
            )
    if not chosen:
        raise ValueError(
            f"PointNetExtractor found neither a point cloud (2-D float Box) nor a vector (1-D Box) nor a uint8 image in "
            f"{kinds}. Add one to the observation, or take the policy MultiInputPolicy."
        )
    return chosen


def _box(space: spaces.Dict, key: str) -> spaces.Box:
    box = space[key]
    assert isinstance(box, spaces.Box)
    return box


def _kind(space: spaces.Space) -> str:
    if is_image_space(space):
        return "image"
    if is_cloud(space):
        return "cloud"
    return "vector" if is_vector(space) else "other"
