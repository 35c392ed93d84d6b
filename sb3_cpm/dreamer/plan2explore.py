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

    :param policy: "MlpPolicy", "CnnPolicy" or "MultiInputPolicy", as SB3 users expect; the observation space alone decides
        what is built, and a Dict may mix images and vectors
    :param env: environment, or a name registered in gymnasium
    :param learning_rate: of the world model, a number or a function of the remaining progress; the preset's by default. The
        other learning rates keep the preset's ratios to it
    :param buffer_size: number of transitions to keep
    :param learning_starts: random steps at the beginning, over all environments. Learning also waits for the first
        episode to end
    :param train_freq: steps (of each environment) between two rounds of updates, or ``(n, "episode")``
    :param gradient_steps: updates per round; -1: as many as transitions were collected
    :param pretrain_steps: further updates at the very first round, before the behaviour acts for the first time: a behaviour
        that has learnt from a model that knew nothing yet may collect data that teach it nothing else (DreamerV2 has 100)
    :param action_noise: added to the actions of ``learn()`` within [-1, 1]; the policy is stochastic without it
    :param replay_buffer_class: a :class:`~sb3_cpm.buffers.CPMBuffer`
    :param replay_buffer_kwargs: its arguments, for example ``storage_dtypes`` or ``memmap_dir``
    :param uncertainty_class: what is new: "plan2explore", "rnd", "prediction_error", "observation_ensemble" or a subclass of
        :class:`~sb3_cpm.uncertainty.base.Uncertainty`. By default that of ``start_from``, "plan2explore" where there is none
    :param uncertainty_kwargs: its arguments, on top of the preset's and of those of ``start_from``
    :param train_task_behavior: also learn a behaviour for the task
    :param preset: sizes and constants, a name or a dict of entries that differ, see :mod:`sb3_cpm.presets`
    :param keys: keys of a Dict observation to read; all images and vectors by default
    :param start_from: a saved model of this class or of :class:`~sb3_cpm.dreamer.Dreamer`, a challenger saved by
        ``ChallengerCallback.save``, or one of these objects: its sizes, keys, world model and, where it has them, behaviours
        and uncertainty are taken over, with their optimizers. ``preset`` may then change single entries
    :param policy_kwargs: further arguments for the policy
    :param stats_window_size: number of episodes that rollout statistics average over
    :param tensorboard_log: folder for TensorBoard
    :param verbose: 0 none, 1 messages, 2 debug messages
    :param seed: for all random numbers
    :param device: PyTorch device; a GPU that is not there is an error unless "auto"
    :param _init_setup_model: build the networks now
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
