"""The CSV files of an experiment as tables, with everything odd about them said."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_cpm.experiments.run_folder import CONFIG, is_finished, read_yaml
from sb3_cpm.experiments.specification import Experiment, options_of

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
    :param notes: what a reader of the figure should know: unfinished runs, versions that are mixed, runs left out, agents that
        were run for different numbers of steps or evaluated differently
    """

    tables: dict[str, pd.DataFrame]
    notes: list[str]


def collect(experiment: Experiment, results: str | Path, version: str = "full", task: str | None = None) -> Data:
    """
    Read all runs of an experiment.

    Runs of the same agent and task that were made with other settings than most are left out, with a note. Unfinished runs
    count as far as they got.

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
    configs = {folder: read_yaml(folder / CONFIG) for folder in folders}
    notes: list[str] = []
    kept = _same_settings(configs, notes)
    _note_versions(configs, kept, notes)
    _note_protocols(configs, kept, notes)
    unfinished = [_name(folder) for folder in kept if not is_finished(folder)]
    if unfinished:
        notes.append(f"not finished yet: {', '.join(unfinished)}")
    tables = {name: _read_all(kept, name) for name in ("evaluations", "training", "diagnostics")}
    if tables["evaluations"].empty:
        raise NoDataError(f"No run in {root} has been evaluated yet.")
    return Data(tables, notes)


def has_data(experiment: Experiment, results: str | Path, version: str, task: str | None = None) -> bool:
    """:return: whether :func:`collect` finds anything"""
    return not _read_all(_folders(experiment, results, version, task), "evaluations").empty


def _folders(experiment: Experiment, results: str | Path, version: str, task: str | None) -> list[Path]:
    """Those of the experiment's runs, of its own agents."""
    agents = [contender.name for contender in experiment.contenders]
    found = sorted((Path(results) / experiment.folder_name(version)).glob(f"*/{task or '*'}/seed*/{CONFIG}"))
    return [path.parent for path in found if path.parts[-4] in agents]


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


def _same_settings(configs: dict[Path, dict[str, Any]], notes: list[str]) -> list[Path]:
    """The folders whose settings are those of most seeds of their agent and task."""
    kept: list[Path] = []
    for parent in dict.fromkeys(folder.parent for folder in configs):
        prints = {folder: configs[folder].get("fingerprint") for folder in configs if folder.parent == parent}
        most = Counter(prints.values()).most_common(1)[0][0]
        kept += [folder for folder, one in prints.items() if one == most]
        others = [_name(folder) for folder, one in prints.items() if one != most]
        if others:
            notes.append(f"left out, made with other settings than the rest: {', '.join(others)}")
    return kept


def _note_versions(configs: dict[Path, dict[str, Any]], kept: list[Path], notes: list[str]) -> None:
    versions: dict[str, list[str]] = {}
    for folder in kept:
        versions.setdefault(str(configs[folder].get("sb3_cpm")), []).append(_name(folder))
    if len(versions) > 1:
        told = "; ".join(f"{version}: {len(names)} runs" for version, names in sorted(versions.items()))
        notes.append(f"results of several versions of sb3_cpm are mixed ({told})")


def _note_protocols(configs: dict[Path, dict[str, Any]], kept: list[Path], notes: list[str]) -> None:
    for key in PROTOCOL:
        agents: dict[Any, list[str]] = {}
        for folder in kept:
            value = (configs[folder].get("protocol") or {}).get(key)
            agents.setdefault(value, []).append(folder.parts[-3])
        if len(agents) > 1:
            told = "; ".join(f"{value}: {', '.join(dict.fromkeys(names))}" for value, names in agents.items())
            notes.append(f"runs with different {key} are drawn together ({told})")


def _read_all(folders: list[Path], name: str) -> pd.DataFrame:
    parts = []
    for folder in folders:
        path = folder / f"{name}.csv"
        if not path.exists():
            continue
        table = pd.read_csv(path)
        agent, env, seed = folder.parts[-3:]
        parts.append(table.assign(agent=agent, env=env, seed=int(seed.removeprefix("seed"))))
    parts = [part for part in parts if len(part)]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=[*IDENTITY, "step"])
