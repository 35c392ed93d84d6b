"""Watching the world model while it learns: a video in TensorBoard now and then."""

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat

from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.run.watch import MOST_FRAMES, check_frames, dream_of, log_animation, numbers


class WatchCallback(BaseCallback):
    """
    Logs what the world model believes it would see in the newest episode, beside what was there: numbers to every logger, and
    where there are images and TensorBoard is on, an animation. Uses no random numbers, so that a watched run is the same run.

    ::

        challenger = ChallengerCallback()
        model.learn(100_000, callback=[challenger, WatchCallback(challenger)])

    :param challenger: the callback that brings the challenger; list it before this one
    :param every: environment steps between two videos
    :param context: states that the model is shown at first
    :param frames: states in all, 16 to 64; episodes may be shorter
    :raises ValueError: for arguments out of range
    """

    def __init__(self, challenger: ChallengerCallback, every: int = 1000, context: int = 5, frames: int = MOST_FRAMES) -> None:
        super().__init__()
        if every < 1:
            raise ValueError(f"every={every}: expected 1 or more environment steps")
        check_frames(context, frames)
        self.challenger, self.every, self.context, self.frames = challenger, every, context, frames
        self._last = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        challenger = self.challenger.challenger
        if challenger is None or challenger.trained_updates == 0 or self.num_timesteps - self._last < self.every:
            return
        buffer = self.challenger.buffer
        episodes = [one for one in buffer.episodes if one.length >= self.context]
        if not episodes:
            return
        self._last = self.num_timesteps
        newest = max(episodes, key=lambda one: (one.ordinal, one.env_idx))
        dream = dream_of(challenger, buffer, newest, self.context, self.frames)
        for name, value in numbers(challenger, [dream]).items():
            self.logger.record(f"watch/{name}", value)
        for output in self.logger.output_formats:
            if isinstance(output, TensorBoardOutputFormat) and dream.images:
                log_animation(output.writer, "watch/open_loop", dream, self.num_timesteps)
