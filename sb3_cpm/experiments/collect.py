"""The CSV files of an experiment as tables, with everything odd about them said."""

import contextlib
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_cpm.experiments.specification import Experiment, options_of
from sb3_cpm.files import DamagedRunError
from sb3_cpm.run.stored_run import StoredRun, read_run
from sb3_cpm.run.tables import COLUMNS

IDENTITY = ["agent", "env", "seed"]
#: Of what a run was made with, what agents that are drawn together should have in common.
PROTOCOL = ("steps", "eval_every", "eval_episodes", "eval_seed")


class NoDataError(ValueError):
    """There is nothing to draw."""


@dataclass(frozen=True)
class Data:
    """
    What is there of an experiment.

    :param tables: ``evaluations``, ``training``, ``diagnostics``; with columns ``agent, env, seed``
    :param notes: what a reader of the figure should know: unfinished, crashed and damaged runs, versions that are mixed, runs
        left out, agents that were run for different numbers of steps or evaluated differently, returns that are no numbers
    """

    tables: dict[str, pd.DataFrame]
    notes: list[str]


def collect(experiment: Experiment, results: str | Path, version: str = "full", task: str | None = None) -> Data:
    """
    Read all runs of an experiment.

    Runs of the same agent and task that were made with other settings than most are left out, and so are damaged ones, with a
    note. Unfinished runs count as far as they got.

    :param experiment: whose contenders and tasks are looked for
    :param results: folder of all results
    :param version: which of the experiment's versions
    :param task: only the runs on this one
    :return: the tables
    :raises ValueError: where there is no data, with the version that there is data of, and the command that makes it
    """
    root = Path(results) / experiment.folder_name(version)
    folders = _folders(experiment, results, version, task)
    if not folders:
        of_task = f" on {task!r}" if task else ""
        place = "" if str(results) == "results" else f" --results {results}"
        raise NoDataError(
            f"There is no data for {experiment.name!r}{of_task} in {root}{_instead(experiment, results, version, task)} "
            f"make it with `python -m sb3_cpm reproduce --figure {experiment.name}{options_of(version)}{place}` "
            f"({experiment.plan(version).cost})."
        )
    notes: list[str] = []
    runs = _same_settings(_read(folders, notes), notes)
    _note_versions(runs, notes)
    _note_protocols(runs, notes)
    _note_unfinished(runs, notes)
    tables = {name: _join(runs, name) for name in COLUMNS}
    if tables["evaluations"].empty:
        told = f" ({'; '.join(notes)})" if notes else ""
        raise NoDataError(f"No run in {root} has been evaluated yet{told}.")
    _note_diverged(tables["evaluations"], notes)
    return Data(tables, notes)


def has_data(experiment: Experiment, results: str | Path, version: str, task: str | None = None) -> bool:
    """:return: whether :func:`collect` finds anything"""
    for folder in _folders(experiment, results, version, task):
        with contextlib.suppress(DamagedRunError):
            if len(read_run(folder).tables["evaluations"]):
                return True
    return False


def _folders(experiment: Experiment, results: str | Path, version: str, task: str | None) -> list[Path]:
    """Those of the experiment's runs, of its own agents, but for runs that crashed before they began."""
    agents = [contender.name for contender in experiment.contenders]
    found = sorted((Path(results) / experiment.folder_name(version)).glob(f"*/{task or '*'}/seed*"))
    return [path for path in found if path.parts[-3] in agents and any((*path.glob("*.csv"), *path.glob("*.yml")))]


def _instead(experiment: Experiment, results: str | Path, version: str, task: str | None) -> str:
    """The best other version that can be drawn, and how: making what is missing may take days."""
    for other in experiment.plans:
        if other != version and has_data(experiment, results, other, task):
            without, add = options_of(version), options_of(other)
            how = " and ".join([f"leave out{without}"] * bool(without) + [f"add{add}"] * bool(add))
            return f", but there is of the {other} version: {how} to draw that, or"
    return ":"


def _name(folder: Path) -> str:
    return "/".join(folder.parts[-3:])


def _read(folders: list[Path], notes: list[str]) -> dict[Path, StoredRun]:
    """Those that are whole."""
    runs, damaged = {}, []
    for folder in folders:
        try:
            if not re.fullmatch(r"seed\d+", folder.name):
                raise DamagedRunError("the folder of a run is called seedN")
            runs[folder] = read_run(folder)
        except DamagedRunError as error:
            damaged.append(f"{_name(folder)} ({error})")
    if damaged:
        notes.append(f"left out, damaged: {', '.join(damaged)}")
    return runs


def _same_settings(runs: dict[Path, StoredRun], notes: list[str]) -> dict[Path, StoredRun]:
    """Those whose settings are those of most seeds of their agent and task."""
    kept: dict[Path, StoredRun] = {}
    for parent in dict.fromkeys(folder.parent for folder in runs):
        prints = {folder: run.config["fingerprint"] for folder, run in runs.items() if folder.parent == parent}
        most = Counter(prints.values()).most_common(1)[0][0]
        kept.update({folder: runs[folder] for folder, one in prints.items() if one == most})
        others = [_name(folder) for folder, one in prints.items() if one != most]
        if others:
            notes.append(f"left out, made with other settings than the rest: {', '.join(others)}")
    return kept


def _note_versions(runs: dict[Path, StoredRun], notes: list[str]) -> None:
    """Between releases the digest tells states of the code apart; the first results did not record it."""
    for what, values in {
        "versions of sb3_cpm": [run.config.get("sb3_cpm") for run in runs.values()],
        "states of its code": [run.config["code"] for run in runs.values() if "code" in run.config],
        "versions of PyTorch": [(run.config.get("versions") or {}).get("torch") for run in runs.values()],
    }.items():
        counted = Counter(map(str, values))
        if len(counted) > 1:
            told = "; ".join(f"{value}: {number} runs" for value, number in sorted(counted.items()))
            notes.append(f"results of several {what} are mixed ({told})")


def _note_protocols(runs: dict[Path, StoredRun], notes: list[str]) -> None:
    for key in PROTOCOL:
        agents: dict[Any, list[str]] = {}
        for folder, run in runs.items():
            agents.setdefault(run.config["protocol"].get(key), []).append(folder.parts[-3])
        if len(agents) > 1:
            told = "; ".join(f"{value}: {', '.join(dict.fromkeys(names))}" for value, names in agents.items())
            notes.append(f"runs with different {key} are drawn together ({told})")


def _note_unfinished(runs: dict[Path, StoredRun], notes: list[str]) -> None:
    """A curve ends where the first of its seeds does."""
    for words, crashed in (("not finished yet", False), ("crashed", True)):
        names = [
            f"{_name(folder)} (at step {run.last_step} of {run.config['protocol']['steps']})"
            for folder, run in runs.items()
            if not run.finished and run.crashed == crashed
        ]
        if names:
            notes.append(f"{words}, and drawn as far as they came: {', '.join(names)}")


def _note_diverged(evaluations: pd.DataFrame, notes: list[str]) -> None:
    diverged = evaluations[~np.isfinite(evaluations["return"])]
    if len(diverged):
        names = {f"{agent}/{env}/seed{seed}" for agent, env, seed in diverged[IDENTITY].itertuples(index=False)}
        notes.append(f"returns that are no numbers, at which curves end: {', '.join(sorted(names))}")


def _join(runs: dict[Path, StoredRun], name: str) -> pd.DataFrame:
    """One table of all runs."""
    parts = []
    for folder, run in runs.items():
        agent, env, seed = folder.parts[-3:]
        parts.append(run.tables[name].assign(agent=agent, env=env, seed=int(seed.removeprefix("seed"))))
    parts = [part for part in parts if len(part)]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=[*IDENTITY, "step"])
