"""
What the challenger does, proposal by proposal, on disk at once.

Two CSV files grow while the run goes on (every row is flushed, so that not even a crash loses one), and a few proposals are
kept in memory with their camera frames for the challenge gallery.
"""

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
from sb3_cpm.challenges import REWARD_TERMS, ArtificialRewards, Proposal
from sb3_cpm.packing import pack, unpack
from sb3_cpm.run.tables import GrownTable


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


#: What a :class:`Shot` consists of, for files.
_SHOT_CLASSES = (Shot, Episode, Proposal, ArtificialRewards)


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

    def choose(self, n_shots: int = 6) -> list[Shot]:
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
    Writes ``proposals.csv`` and ``coefficients.csv``; to be listed after the ``ChallengerCallback``.

    :param folder: where the files go
    :param challenger: the callback that makes the proposals
    :param total_steps: length of the run, to spread the gallery's proposals over it
    :param state: what :meth:`state` gave at the checkpoint that the run goes on from
    :raises DamagedFileError: if the files are not what they were at that checkpoint
    """

    def __init__(
        self, folder: Path, challenger: ChallengerCallback, total_steps: int, state: dict[str, Any] | None = None
    ) -> None:
        super().__init__()
        state = state or {}
        self.challenger = challenger
        self.total_steps = total_steps
        self.shots = ShotKeeper(_shots=unpack(state["shots"], _SHOT_CLASSES) if "shots" in state else {})
        self.n_proposals: int = state.get("n_proposals", 0)
        #: Actions so far, and those of them that C gave: since the beginning, and since the last row of ``coefficients.csv``.
        self._actions: list[int] = state.get("actions", [0, 0])
        self._recent: list[int] = state.get("recent", [0, 0])
        tables = state.get("tables", {})
        names = ("proposals", "coefficients")
        self._tables = {name: GrownTable(folder / f"{name}.csv", **tables.get(name, {})) for name in names}
        self._episode_ended: bool = state.get("episode_ended", False)

    @property
    def explored_share(self) -> float | None:
        """Share of all actions so far that C gave, None before the first."""
        return self._actions[1] / self._actions[0] if self._actions[0] else None

    def state(self) -> dict[str, Any]:
        """
        :return: plain data for a checkpoint
        :raises NotWrittenError: if a row is not on the disk
        """
        return {
            "n_proposals": self.n_proposals,
            "actions": list(self._actions),
            "recent": list(self._recent),
            "episode_ended": self._episode_ended,
            "shots": pack(self.shots._shots, _SHOT_CLASSES, "the gallery"),
            "tables": {name: table.state() for name, table in self._tables.items()},
        }

    def close(self) -> None:
        for table in self._tables.values():
            table.close()

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            for counted in (self._actions, self._recent):
                counted[0] += 1
                counted[1] += EXECUTED_ACTION in info
            self._episode_ended |= "episode" in info
        return True

    def _on_rollout_end(self) -> None:
        with self.challenger.stopwatch.section("bookkeeping"):
            for episode, proposal in self.challenger.proposals:
                self.n_proposals += 1
                self._tables["proposals"].add_row({"step": self.num_timesteps, **_proposal_row(episode, proposal)})
                self._capture(episode, proposal)
            if self._episode_ended:
                self._tables["coefficients"].add_row(self._coefficients())
                self._recent = [0, 0]
                self._episode_ended = False

    def _coefficients(self) -> dict[str, Any]:
        """Everything that moves, as it is now; called after every rollout in which an episode ended."""
        challenger, buffer = self.challenger.challenger, self.challenger.buffer
        return {
            "step": self.num_timesteps,
            "epsilon": self.challenger.epsilon,
            "explored_share": self._recent[1] / max(self._recent[0], 1),
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
        "env": -1 if episode.demonstrated else episode.env_idx,
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


def _spread(shots: Sequence[Shot], n: int) -> list[Shot]:
    """:return: n of them, evenly spread"""
    if n >= len(shots):
        return list(shots)
    return [shots[round(index)] for index in np.linspace(0, len(shots) - 1, n)]
