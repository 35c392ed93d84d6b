"""
What a run has left, as it is drawn and handed on: whole, or not at all.

A file that was cut off, edited or lost would otherwise become a result like any other.
"""

import io
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from sb3_cpm.files import DamagedRunError
from sb3_cpm.run.folder import CONFIG, CRASHED, FINISHED, is_finished, read_yaml
from sb3_cpm.run.specification import fingerprint
from sb3_cpm.run.tables import COLUMNS


class StoredRun(NamedTuple):
    """
    :param config: content of ``config.yml``
    :param tables: ``evaluations``, ``training``, ``diagnostics``; of an evaluation that was cut off nothing
    :param finished: whether it came to its end
    :param crashed: whether its last try ended badly
    """

    config: dict[str, Any]
    tables: dict[str, pd.DataFrame]
    finished: bool
    crashed: bool

    @property
    def last_step(self) -> int:
        """Of its evaluations; 0 where it has none."""
        return int(self.tables["evaluations"]["step"].max()) if len(self.tables["evaluations"]) else 0


def read_run(folder: Path) -> StoredRun:
    """
    :param folder: of a run, finished or not
    :return: all that it holds
    :raises DamagedRunError: if a file is missing, cut off, or does not fit the others
    """
    try:
        return _read(folder)
    except DamagedRunError:
        raise
    except (OSError, ValueError) as error:  # of YAML, CSV and texts that are none
        raise DamagedRunError(str(error).strip().splitlines()[0]) from error


def _read(folder: Path) -> StoredRun:
    if not (folder / CONFIG).exists():
        raise DamagedRunError(f"there is no {CONFIG}")
    config = read_yaml(folder / CONFIG)
    protocol = config.get("protocol")
    if not isinstance(protocol, dict) or config.get("fingerprint") != fingerprint(protocol):
        raise DamagedRunError(f"{CONFIG} was cut off or edited: its settings do not fit their fingerprint")
    finished = is_finished(folder)
    tables = {name: _read_table(folder / f"{name}.csv", columns, finished) for name, columns in COLUMNS.items()}
    evaluations = tables["evaluations"]
    sizes = evaluations.groupby("step")["episode"].transform("size")
    whole = sizes == protocol["eval_episodes"]
    if finished:
        steps = read_yaml(folder / FINISHED).get("steps")
        if not whole.all() or evaluations.empty or evaluations["step"].iloc[-1] != steps:
            raise DamagedRunError(
                f"evaluations.csv does not have {protocol['eval_episodes']} episodes at every step up to the last one, {steps}"
            )
    tables["evaluations"] = evaluations[whole]
    return StoredRun(config, tables, finished, (folder / CRASHED).exists())


def _read_table(path: Path, columns: tuple[str, ...], finished: bool) -> pd.DataFrame:
    if not path.exists():
        if finished:
            raise DamagedRunError(f"there is no {path.name}")
        return pd.DataFrame(columns=list(columns))  # nothing was written yet
    text = path.read_bytes()
    if b"\0" in text or (finished and not text.endswith(b"\n")):
        raise DamagedRunError(f"{path.name} was cut off")
    table = pd.read_csv(io.BytesIO(text[: text.rfind(b"\n") + 1]))
    if tuple(table.columns) != columns:
        raise DamagedRunError(f"{path.name} has the columns {', '.join(table.columns)}; expected {', '.join(columns)}")
    return table
