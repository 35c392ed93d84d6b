"""
PPO's policies for the baselines: classes with the right features extractor as their default, since ``--optimize`` of rl_zoo3
replaces ``policy_kwargs``, in which it would otherwise stand.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

from gymnasium import spaces
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule

from sb3_cpm.extractors import PointNetExtractor


class CameraExtractor(PointNetExtractor):
    """
    Features of all images and vectors of a Dict observation, point clouds left aside; sizes after ManiSkill 2's tutorial
    ``sb3_ppo_liftcube_rgbd.py``: 128 features per picture, 64 of the state.

    :param observation_space: Dict space
    :param keys: the keys to read; by default all images and vectors
    :param image_size: features per image
    :param state_arch: layer sizes of an MLP for the vectors
    :raises ValueError: see :class:`~sb3_cpm.extractors.PointNetExtractor`
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        keys: Sequence[str] | None = None,
        image_size: int = 128,
        state_arch: Sequence[int] = (64,),
    ) -> None:
        if keys is None and isinstance(observation_space, spaces.Dict):
            keys = [
                key for key, space in observation_space.spaces.items() if is_image_space(space) or len(space.shape or ()) == 1
            ]
        super().__init__(observation_space, keys=keys, image_size=image_size, state_arch=state_arch)


class PointNetActorCriticPolicy(MultiInputActorCriticPolicy):
    """
    ``MultiInputPolicy`` of PPO and A2C with :class:`~sb3_cpm.extractors.PointNetExtractor` as the default extractor.

    :param observation_space: Dict space
    :param action_space: action space
    :param lr_schedule: learning rate schedule
    :param features_extractor_class: None: see above
    :param kwargs: further arguments of ``MultiInputPolicy``
    """

    default_extractor: ClassVar[type[BaseFeaturesExtractor]] = PointNetExtractor

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        **kwargs: Any,
    ) -> None:
        extractor = features_extractor_class or self.default_extractor
        super().__init__(observation_space, action_space, lr_schedule, features_extractor_class=extractor, **kwargs)


class CameraActorCriticPolicy(PointNetActorCriticPolicy):
    """The same with :class:`CameraExtractor` as the default extractor."""

    default_extractor = CameraExtractor
