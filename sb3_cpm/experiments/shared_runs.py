"""
Runs that two experiments have in common are made once: the second experiment takes the first one's tables.

SAC of ``pickcube-state``, for example, is half of the comparison of controllers, and CPM-SAC of ``mountaincar`` is one of the
decay models.
"""

import csv
from pathlib import Path
from typing import Any

from sb3_cpm.experiments.specification import RunSpec
from sb3_cpm.files import write_bytes
from sb3_cpm.run import folder as run_folder
from sb3_cpm.run.stored_run import read_run
from sb3_cpm.run.tables import EVALUATIONS, Table


def find_same_run(spec: RunSpec, config: dict[str, Any], results: Path) -> Path | None:
    """
    :param spec: a run
    :param config: its :func:`~sb3_cpm.run.folder.description`
    :param results: folder of all results
    :return: the folder of a finished run with the same settings, seed, version and code of this package, under another name
    """
    own = spec.folder(results)
    for path in sorted(results.glob(f"*/*/*/{own.name}/{run_folder.CONFIG}")):
        folder = path.parent
        if folder == own or not run_folder.is_finished(folder):
            continue
        try:
            theirs = run_folder.read_yaml(path)
            same = all(theirs.get(key) == config[key] for key in ("fingerprint", "sb3_cpm"))
            if same and theirs.get("code", config["code"]) == config["code"]:
                read_run(folder)
                return folder
        except (OSError, ValueError):  # damaged, which whoever draws it is told
            continue
    return None


def take_over(spec: RunSpec, config: dict[str, Any], other: Path, results: Path) -> str:
    """
    Make a run's folder from its other's. What says that it is finished comes last, so that a killed process leaves no half.

    :param spec: the run
    :param config: its description; ``taken_from`` is added to what is written, and the versions are the other's
    :param other: the same run under another name, from :func:`find_same_run`
    :param results: folder of all results
    :return: the other's name
    """
    folder, name = spec.folder(results), "/".join(other.parts[-4:])
    theirs, finished = (run_folder.read_yaml(other / file) for file in (run_folder.CONFIG, run_folder.FINISHED))
    names = {"experiment": spec.experiment, "agent": spec.agent, "env": spec.env}
    for path in other.glob("*.csv"):
        if path.stem != "evaluations":
            write_bytes(folder / path.name, path.read_bytes())
            continue
        table = Table(folder / path.name, EVALUATIONS)
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                table.add([{**row, **names}[column] for column in EVALUATIONS])
        table.close()
    code = {"code": theirs["code"]} if "code" in theirs else {}
    ours = {key: value for key, value in config.items() if key != "code"}
    run_folder.write_config(folder, {**ours, **code, "versions": theirs["versions"], "taken_from": name})
    run_folder.write_finished(folder, finished)
    return name
