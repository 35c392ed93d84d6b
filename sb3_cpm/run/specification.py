"""What one run is: plain data that is written into its folder, so that it can be repeated and gone on with."""

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sb3_cpm.seeds import FIRST_SEED


@dataclass(frozen=True)
class RunSpec:
    """
    Everything that determines one run, except the versions of the packages.

    :param experiment: what it belongs to, ``"train"`` for a run of its own
    :param agent: for people, e.g. ``"CPM-SAC"``
    :param env: for people, e.g. ``"PickCube-v1"``
    :param seed: rules the whole run
    :param config: the agent's file, a name in ``zoo_configs/`` or a path
    :param env_id: a gymnasium id
    :param overrides: hyperparameters that differ from the file's
    :param steps: environment steps to train for, over all environments
    :param eval_every: environment steps between two evaluations; 0: never
    :param eval_episodes: episodes of each
    :param eval_seed: of the first of them, the others' follow
    :param checkpoint_every: environment steps between two checkpoints, each of which begins new episodes; None: one at each
        evaluation
    :param module: what is to be imported first, because it registers the task
    """

    experiment: str
    agent: str
    env: str
    seed: int
    config: str
    env_id: str
    overrides: dict[str, Any] = field(default_factory=dict)
    steps: int = 10_000
    eval_every: int = 0
    eval_episodes: int = 5
    eval_seed: int = FIRST_SEED
    checkpoint_every: int | None = None
    module: str = ""

    @property
    def name(self) -> str:
        """For people: which run this is."""
        return f"{self.experiment}/{self.agent}/{self.env}/seed{self.seed}"

    def folder(self, results: Path) -> Path:
        """:return: where the results of this run of an experiment are"""
        return results / self.experiment / self.agent / self.env / f"seed{self.seed}"

    def as_dict(self) -> dict[str, Any]:
        """:return: plain data"""
        return asdict(self)


def fingerprint(protocol: dict[str, Any]) -> str:
    """
    :param protocol: plain data that says what a result was made with
    :return: twelve characters that differ whenever it does
    """
    return hashlib.sha256(json.dumps(protocol, sort_keys=True, default=str).encode()).hexdigest()[:12]
