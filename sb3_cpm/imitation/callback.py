"""Demonstrations for an agent that a configuration describes: they come when ``learn()`` begins."""

import warnings
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cpm.arguments import check, integer, names_checked
from sb3_cpm.buffers import CPMBuffer, Demonstration
from sb3_cpm.imitation.loading import Source, load_demonstrations
from sb3_cpm.randomness import random_state, restore_random_state
from sb3_cpm.training_env import begin_episodes


def demonstrations_for(
    model: BaseAlgorithm, source: Source, n_episodes: int | None = None, seed: int | None = None, hold: bool = False
) -> list[Demonstration]:
    """
    :func:`load_demonstrations` for callbacks, in ``_on_training_start``: an expert acts in the model's own environments, and
    the run that follows is the one that would have been without that: same random numbers, same first episodes.

    :param model: that is about to learn
    :param source: see :func:`load_demonstrations`
    :param n_episodes: how many
    :param seed: for an expert; None: the model's
    :param hold: for an expert
    :return: the demonstrations
    :raises ValueError: see :func:`load_demonstrations`
    """
    assert model.env is not None
    state = random_state(model.action_space)
    begun = model._last_obs is not None
    try:
        return load_demonstrations(source, model.env, n_episodes, model.seed if seed is None else seed, hold)
    finally:
        # the episodes that the model begins with, or others where it has been learning already
        model.env.seed(model.seed if model.num_timesteps == 0 else None)
        restore_random_state(state, model.action_space)
        if begun:
            begin_episodes(model)


class DemonstrationsCallback(BaseCallback):
    """
    Puts demonstrations into the model's :class:`~sb3_cpm.buffers.CPMBuffer` when ``learn()`` begins, as
    :meth:`~sb3_cpm.buffers.CPMBuffer.add_demonstrations` does. A buffer that has some already keeps these, so that a run that
    is resumed, whose buffer comes from a checkpoint, goes on with its own.

    In a configuration::

        replay_buffer_kwargs: {challenge_ratio: 0, demonstration_ratio: 0.5, mix: row}
        callback:
          - sb3_cpm.imitation.DemonstrationsCallback: {demonstrations: expert, n_episodes: 200}

    :param demonstrations: ``"expert"``, a file, or a list, see :func:`load_demonstrations`
    :param n_episodes: how many; None: all that there are
    :param seed: for an expert; None: the model's
    :param hold: whether an expert goes on to the end of the episode, see :func:`record_demonstrations`
    :param verbose: as SB3's callbacks have it
    :raises ValueError: for arguments that cannot work; in ``learn()``, for models without a CPMBuffer, and see
        :func:`load_demonstrations`
    """

    @names_checked()
    def __init__(
        self,
        demonstrations: Source = "expert",
        n_episodes: int | None = None,
        seed: int | None = None,
        hold: bool = False,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if n_episodes is not None:
            check("n_episodes", n_episodes, integer(1))
        self.demonstrations = demonstrations
        self.n_episodes = n_episodes
        self.seed = seed
        self.hold = hold

    def _on_training_start(self) -> None:
        buffer: Any = getattr(self.model, "replay_buffer", None)
        if not isinstance(buffer, CPMBuffer):
            raise ValueError(
                f"DemonstrationsCallback fills a CPMBuffer, {type(self.model).__name__} has "
                f"{'no replay buffer' if buffer is None else type(buffer).__name__}: make it with "
                "replay_buffer_class=CPMBuffer, replay_buffer_kwargs=dict(challenge_ratio=0, demonstration_ratio=0.5)."
            )
        if buffer.demonstration_ratio == 0:
            warnings.warn(
                "The replay buffer has demonstration_ratio=0, so that no demonstration is ever sampled. Give it a share: "
                "replay_buffer_kwargs=dict(demonstration_ratio=0.5).",
                stacklevel=2,
            )
        if buffer.demonstrations is None:
            buffer.add_demonstrations(
                demonstrations_for(self.model, self.demonstrations, self.n_episodes, self.seed, self.hold)
            )

    def _on_step(self) -> bool:
        return True
