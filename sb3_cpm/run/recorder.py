"""
What happened, episode by episode and proposal by proposal, on disk at once.

Three CSV files grow while the run goes on (every row is flushed, so that not even a crash loses one), and a few proposals
are kept in memory with their camera frames for the challenge gallery.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first

from sb3_cpm.buffers import EXECUTED_ACTION, Episode
from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.challenges import REWARD_TERMS, Proposal
from sb3_cpm.files import GrowingFile


class CSVTable:
    """
    A CSV file whose columns are those of its first row; complete after every row, or as soon as the disk takes it.

    :param path: the file, which must not exist yet
    """

    def __init__(self, path: Path) -> None:
        self._file = GrowingFile(path)
        self._columns: list[str] | None = None

    def add(self, row: dict[str, Any]) -> None:
        text = io.StringIO()
        if self._columns is None:
            self._columns = list(row)
            csv.writer(text).writerow(self._columns)
        values = {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()}
        csv.DictWriter(text, self._columns, extrasaction="ignore").writerow(values)
        self._file.append(text.getvalue())

    def close(self) -> None:
        self._file.close()


@dataclass(frozen=True)
class Shot:
    """
    A proposal as the gallery shows it.

    :param step: environment steps of the run when it was made
    :param number: how many proposals came before it, and itself
    :param episode: where it was made from
    :param proposal: what was thought of it
    :param frames: camera images of all its states by key, each of shape ``(n_steps + 1, height, width, channels)``, uint8
    """

    step: int
    number: int
    episode: Episode
    proposal: Proposal
    frames: dict[str, np.ndarray]


@dataclass
class ShotKeeper:
    """
    Keeps a few proposals that tell the story: one that was kept from every part of the run, and some that were dropped.

    :param n_parts: parts that the run is divided into
    """

    n_parts: int = 4
    _shots: dict[tuple[int, bool], Shot] = field(default_factory=dict)

    def wants(self, progress: float, accepted: bool) -> bool:
        """Is this the first of its kind in this part of the run? (progress in [0, 1])"""
        return (self._part(progress), accepted) not in self._shots

    def add(self, progress: float, shot: Shot) -> None:
        self._shots[self._part(progress), shot.proposal.accepted] = shot

    def choose(self, n_shots: int) -> list[Shot]:
        """:return: at most ``n_shots`` in order of time, a third of them dropped ones where there are enough of both"""
        kept = [self._shots[key] for key in sorted(self._shots) if key[1]]
        dropped = [self._shots[key] for key in sorted(self._shots) if not key[1]]
        n_dropped = min(len(dropped), max(n_shots // 3, n_shots - len(kept)))
        chosen = _spread(kept, n_shots - n_dropped) + _spread(dropped, n_dropped)
        return sorted(chosen, key=lambda shot: shot.number)

    def _part(self, progress: float) -> int:
        return min(int(progress * self.n_parts), self.n_parts - 1)


class Recorder(BaseCallback):
    """
    Writes ``episodes.csv``, ``proposals.csv`` and ``coefficients.csv``; to be listed after the ``ChallengerCallback``.

    :param folder: where the files go
    :param challenger: the callback that makes the proposals
    :param total_steps: length of the run, to spread the gallery's proposals over it
    """

    def __init__(self, folder: Path, challenger: ChallengerCallback, total_steps: int) -> None:
        super().__init__()
        self.challenger = challenger
        self.total_steps = total_steps
        self.shots = ShotKeeper()
        self.n_proposals = 0
        self.n_episodes = 0
        self._n_actions = self._n_explored = 0
        self._tables = {name: CSVTable(folder / f"{name}.csv") for name in ("episodes", "proposals", "coefficients")}
        self._explored: np.ndarray = np.zeros(0)
        self._episode_ended = False

    @property
    def explored_share(self) -> float | None:
        """Share of all actions so far that C gave, None before the first."""
        return self._n_explored / self._n_actions if self._n_actions else None

    def close(self) -> None:
        for table in self._tables.values():
            table.close()

    def _on_training_start(self) -> None:
        self._explored = np.zeros(self.training_env.num_envs)

    def _on_step(self) -> bool:
        for env_idx, info in enumerate(self.locals["infos"]):
            explored = EXECUTED_ACTION in info
            self._explored[env_idx] += explored
            self._n_explored += explored
            self._n_actions += 1
            if "episode" in info:
                length = int(info["episode"]["l"])
                self._tables["episodes"].add(
                    {
                        "step": self.num_timesteps,
                        "env": env_idx,
                        "return": float(info["episode"]["r"]),
                        "length": length,
                        "success": _optional_int(info.get("is_success")),
                        "explored_share": self._explored[env_idx] / length,
                        "epsilon": self.challenger.epsilon,
                    }
                )
                self._explored[env_idx] = 0
                self._episode_ended = True
                self.n_episodes += 1
        return True

    def _on_rollout_end(self) -> None:
        with self.challenger.stopwatch.section("bookkeeping"):
            for episode, proposal in self.challenger.proposals:
                self.n_proposals += 1
                self._tables["proposals"].add({"step": self.num_timesteps, **_proposal_row(episode, proposal)})
                self._capture(episode, proposal)
            if self._episode_ended:
                self._tables["coefficients"].add(self._coefficients())
                self._episode_ended = False

    def _coefficients(self) -> dict[str, Any]:
        """Everything that moves, as it is now; called after every rollout in which an episode ended."""
        challenger, buffer = self.challenger.challenger, self.challenger.buffer
        return {
            "step": self.num_timesteps,
            "epsilon": self.challenger.epsilon,
            **buffer.coefficients,
            # the scale k before the exponential function belongs to the default estimator; others may have none
            "k": _number(getattr(getattr(challenger, "uncertainty", None), "k", None)),
            "proposed": buffer.counters.proposed,
            "kept": buffer.counters.kept,
            "in_buffer": len(buffer.challenges),
            "challenger_updates": 0 if challenger is None else challenger.trained_updates,
        }

    def _capture(self, episode: Episode, proposal: Proposal) -> None:
        progress = self.num_timesteps / max(self.total_steps, 1)
        if not self.shots.wants(progress, proposal.accepted):
            return
        space = self.training_env.observation_space
        assert isinstance(space, spaces.Dict)
        keys = [key for key, subspace in space.spaces.items() if is_image_space(subspace)]
        observations = self.challenger.buffer.episode_observations(episode, keys)
        frames = {key: _channels_last(observations[key], space[key]) for key in keys}
        self.shots.add(progress, Shot(self.num_timesteps, self.n_proposals, episode, proposal, frames))


def _proposal_row(episode: Episode, proposal: Proposal) -> dict[str, Any]:
    counted = slice(proposal.first, None)
    artificial = proposal.artificial
    return {
        "env": episode.env_idx,
        "episode": episode.ordinal,
        "length": episode.length,
        "goal": proposal.goal,
        "accepted": int(proposal.accepted),
        **{name: int(verdict) for name, verdict in proposal.verdicts.items()},
        "mean_reward": float(proposal.rewards[counted].mean()),
        "mean_uncertainty": float(proposal.uncertainty[counted].mean()),
        "mean_disagreement": float(proposal.disagreement[counted].mean()),
        "mean_kl": float(proposal.kl[counted].mean()),
        "mean_score": float(proposal.score[counted].mean()),
        "goal_score": float(proposal.score[proposal.goal]),
        **{f"artificial_{name}": _mean_of(artificial, name) for name in ("total", *REWARD_TERMS, "constant")},
        **{name: float(value) for name, value in proposal.coefficients.items()},
    }


def _mean_of(artificial: Any, name: str) -> float | None:
    return None if artificial is None else float(np.mean(getattr(artificial, name)))


def _channels_last(frames: np.ndarray, space: spaces.Space) -> np.ndarray:
    assert isinstance(space, spaces.Box)
    return np.moveaxis(frames, 1, -1) if is_image_space_channels_first(space) else frames


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def _optional_int(value: Any) -> int | None:
    return None if value is None else int(value)


def _spread(shots: Sequence[Shot], n: int) -> list[Shot]:
    """:return: n of them, evenly spread"""
    if n >= len(shots):
        return list(shots)
    return [shots[round(index)] for index in np.linspace(0, len(shots) - 1, n)]
