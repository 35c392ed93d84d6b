"""
DreamerV2 as an SB3 algorithm (Hafner et al. 2021; report, B.1): acts with the behaviour that was learnt in imagination.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_cpm.dreamer.algorithm import DreamerAlgorithm
from sb3_cpm.dreamer.policies import DreamerPolicy
from sb3_cpm.dreamer.start import StartFrom
from sb3_cpm.presets import PresetLike


class Dreamer(DreamerAlgorithm):
    """
    DreamerV2: a world model, and an actor-critic that learns in its imagination.

    ::

        model = Dreamer("MlpPolicy", "Pendulum-v1", verbose=1)
        model.learn(10_000)
        action, state = model.predict(obs, state, episode_start, deterministic=True)

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
    :param preset: sizes and constants, a name or a dict of entries that differ, see :mod:`sb3_cpm.presets`
    :param keys: keys of a Dict observation to read; all images and vectors by default
    :param start_from: a saved model of :class:`~sb3_cpm.dreamer.Plan2Explore` or of this class, a challenger saved by
        ``ChallengerCallback.save``, or one of these objects: its sizes, keys, world model and, where it has one, task
        behaviour are taken over, with their optimizers. ``preset`` may then change single entries
    :param policy_kwargs: further arguments for the policy
    :param stats_window_size: number of episodes that rollout statistics average over
    :param tensorboard_log: folder for TensorBoard
    :param verbose: 0 none, 1 messages, 2 debug messages
    :param seed: for all random numbers
    :param device: PyTorch device; a GPU that is not there is an error unless "auto"
    :param _init_setup_model: build the networks now
    :raises ValueError: for spaces and arguments that cannot work
    """

    behavior: ClassVar[str] = "task"
    default_preset: ClassVar[str] = "dreamer"

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
            entries={"train_task_behavior": True, "train_exploration_behavior": False},
            keys=keys,
            start_from=start_from,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )
