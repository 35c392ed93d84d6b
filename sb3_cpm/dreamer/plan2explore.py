"""
Plan2Explore as an SB3 algorithm (Sekar et al. 2020; report, B.2): acts where its world model will learn something new.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_cpm.dreamer.algorithm import DreamerAlgorithm
from sb3_cpm.dreamer.policies import DreamerPolicy
from sb3_cpm.dreamer.start import StartFrom
from sb3_cpm.presets import PresetLike
from sb3_cpm.uncertainty.base import Uncertainty


class Plan2Explore(DreamerAlgorithm):
    """
    Explores without reward: acts with a behaviour that climbs the novelty of imagined transitions.

    It does not act for rewards. The world model still learns to predict them, so that :class:`~sb3_cpm.dreamer.Dreamer` can
    turn to the task afterwards; with ``train_task_behavior=True`` a behaviour for the task is learnt along the way, in
    imagination only::

        explorer = Plan2Explore("MlpPolicy", env, train_task_behavior=True).learn(10_000)
        explorer.save("explorer")
        model = Dreamer("MlpPolicy", env, start_from="explorer.zip").learn(5_000)

    Predicting rewards shapes the latents, and by that a little of what is new; ``preset={"reward_gradient": False}`` ends it.

    :param policy: as for Dreamer
    :param env: as for Dreamer
    :param learning_rate: as for Dreamer
    :param buffer_size: as for Dreamer
    :param learning_starts: as for Dreamer
    :param train_freq: as for Dreamer
    :param gradient_steps: as for Dreamer
    :param pretrain_steps: as for Dreamer
    :param action_noise: as for Dreamer
    :param replay_buffer_class: as for Dreamer
    :param replay_buffer_kwargs: as for Dreamer
    :param uncertainty_class: what is new: "plan2explore", "rnd", "prediction_error", "observation_ensemble" or a subclass of
        :class:`~sb3_cpm.uncertainty.base.Uncertainty`. By default that of ``start_from``, "plan2explore" where there is none
    :param uncertainty_kwargs: its arguments, on top of the preset's and of those of ``start_from``
    :param train_task_behavior: also learn a behaviour for the task
    :param preset: as for Dreamer
    :param keys: as for Dreamer
    :param start_from: as for Dreamer; exploration behaviour and uncertainty are taken over too, where there are such
    :param policy_kwargs: as for Dreamer
    :param stats_window_size: as for Dreamer
    :param tensorboard_log: as for Dreamer
    :param verbose: as for Dreamer
    :param seed: as for Dreamer
    :param device: as for Dreamer
    :param _init_setup_model: as for Dreamer
    :raises ValueError: for spaces and arguments that cannot work
    """

    behavior: ClassVar[str] = "exploration"
    default_preset: ClassVar[str] = "default"

    def __init__(
        self,
        policy: str | type[DreamerPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule | None = None,
        buffer_size: int = 100_000,
        learning_starts: int = 1000,
        train_freq: int | tuple[int, str] = 5,
        gradient_steps: int = 1,
        pretrain_steps: int = 0,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        uncertainty_class: str | type[Uncertainty] | None = None,
        uncertainty_kwargs: Mapping[str, Any] | None = None,
        train_task_behavior: bool = False,
        preset: PresetLike | None = None,
        keys: Sequence[str] | None = None,
        start_from: StartFrom | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            pretrain_steps=pretrain_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            preset=preset,
            entries={"train_task_behavior": train_task_behavior, "train_exploration_behavior": True},
            keys=keys,
            start_from=start_from,
            policy_kwargs={
                "uncertainty_class": uncertainty_class,
                "uncertainty_kwargs": uncertainty_kwargs,
                **(policy_kwargs or {}),
            },
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )
