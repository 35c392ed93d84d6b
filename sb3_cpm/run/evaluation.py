"""The deterministic player on episodes of its own: always the same seeds, which training never uses."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.run.recorder import CSVTable
from sb3_cpm.seeds import FIRST_SEED


class EpisodeResult(NamedTuple):
    """
    One evaluation episode.

    :param episode_return: sum of rewards
    :param length: number of steps
    :param success: whether it was a success at its end, None where the environment doesn't say
    """

    episode_return: float
    length: int
    success: bool | None


def play_episode(model: BaseAlgorithm, env: gym.Env, seed: int, frames: list[np.ndarray] | None = None) -> EpisodeResult:
    """
    Play one episode with the deterministic player.

    :param model: the player
    :param env: the environment
    :param seed: for the reset
    :param frames: pictures of the episode are appended to it, one per state, when it is given
    """
    observation, info = env.reset(seed=seed)
    total, length, done = 0.0, 0, False
    memory, start = None, np.ones(1, dtype=bool)  # of recurrent players such as Dreamer; others ignore both
    while not done:
        _film(env, frames)
        action, memory = model.predict(observation, memory, start, deterministic=True)
        start = np.zeros(1, dtype=bool)
        observation, reward, terminated, truncated, info = env.step(action)
        total += float(reward)
        length += 1
        done = terminated or truncated
    _film(env, frames)
    success = info.get("is_success")
    return EpisodeResult(total, length, None if success is None else bool(success))


def _film(env: gym.Env, frames: list[np.ndarray] | None) -> None:
    if frames is not None:
        frame = env.render()
        assert isinstance(frame, np.ndarray)
        frames.append(frame)


class Evaluator(BaseCallback):
    """
    Evaluates the player at the start, at even distances, and at the end; writes ``evaluations.csv``.

    :param env: environment of its own
    :param folder: where the file goes
    :param challenger: whose stopwatch is charged with "evaluation"
    :param total_steps: length of the run
    :param n_evaluations: how many, start and end included; 0 for none
    :param n_episodes: episodes of each
    :param after_each: called after each with a line about it
    """

    def __init__(
        self,
        env: gym.Env,
        folder: Path,
        challenger: ChallengerCallback,
        total_steps: int,
        n_evaluations: int,
        n_episodes: int,
        after_each: Callable[[str], None] = lambda news: None,
    ) -> None:
        super().__init__()
        self.env = env
        self.challenger = challenger
        self.n_episodes = n_episodes
        self.after_each = after_each
        self.results: list[tuple[int, list[EpisodeResult]]] = []
        #: Steps at which an evaluation is due, the last one excepted, which ``at_end`` makes.
        self._due = [round(total_steps * index / (n_evaluations - 1)) for index in range(n_evaluations - 1)]
        self._at_end = n_evaluations > 0
        self._table = CSVTable(folder / "evaluations.csv")

    def close(self) -> None:
        self._table.close()
        self.env.close()

    def _on_training_start(self) -> None:
        self._evaluate_if_due()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self._evaluate_if_due()

    def at_end(self) -> None:
        """The last evaluation, after training (``on_training_end`` doesn't know whether training came to its end)."""
        if self._at_end:
            self._evaluate()

    def _evaluate_if_due(self) -> None:
        if self._due and self.num_timesteps >= self._due[0]:
            self._due = [step for step in self._due if step > self.num_timesteps]
            self._evaluate()

    def _evaluate(self) -> None:
        with self.challenger.stopwatch.section("evaluation"):
            results = [play_episode(self.model, self.env, FIRST_SEED + index) for index in range(self.n_episodes)]
        self.results.append((self.num_timesteps, results))
        success = success_rate(results)
        returns = [result.episode_return for result in results]
        mean_return = float(np.mean(returns))
        self._table.add(
            {
                "step": self.num_timesteps,
                "mean_return": mean_return,
                "min_return": min(returns),
                "max_return": max(returns),
                "mean_length": float(np.mean([result.length for result in results])),
                "success_rate": success,
                "episodes": len(results),
            }
        )
        self.logger.record("eval/mean_reward", mean_return)
        if success is not None:
            self.logger.record("eval/success_rate", success)
        told = "" if success is None else f", success {success:.0%}"
        self.after_each(f"step {self.num_timesteps}: evaluated return {mean_return:.2f}{told}")


def success_rate(results: list[EpisodeResult]) -> float | None:
    """:return: share of episodes that were a success at their end, None where the environment doesn't say"""
    told = [result.success for result in results if result.success is not None]
    return float(np.mean(told)) if told else None
