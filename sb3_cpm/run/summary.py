"""What a run achieved and where its time went: on the terminal, as text and as JSON."""

import json
import resource
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_cpm.files import write_text
from sb3_cpm.run.tables import read_csv

#: Rows of the time table in this order, where there are such; all other sections of the stopwatch follow.
SECTIONS = (
    "set-up",
    "simulate+render",
    "P acts",
    "P trains",
    "C acts",
    "C evaluates",
    "C trains",
    "buffer",
    "bookkeeping",
    "evaluation",
    "pictures and saving",
)
#: What doesn't count for the speed of training.
NOT_TRAINING = ("set-up", "evaluation", "pictures and saving")


@dataclass(frozen=True)
class Summary:
    """
    The numbers of a run.

    :param title: what was trained
    :param outcome: "finished", or what ended it early
    :param steps: environment steps taken
    :param episodes: episodes that training completed
    :param seconds: wall-clock time from start to end, evaluations and pictures included
    :param steps_per_second: steps over the time of training, which is all but set-up, evaluations and pictures
    :param first_success: success rate of the first evaluation, None without one
    :param success: of the last
    :param first_return: mean return of the first evaluation
    :param mean_return: of the last
    :param proposed: challenges proposed
    :param kept: challenges that the filter kept
    :param rejected_by: how many each criterion alone would have rejected
    :param explored_share: share of the training actions that C gave
    :param challenger_updates: updates of the challenger
    :param player_updates: updates of the player
    :param time: wall-clock seconds by what they were spent on
    :param peak_memory_gb: of the main process
    :param folder: where everything is
    """

    title: str
    outcome: str
    steps: int
    episodes: int
    seconds: float
    steps_per_second: float
    first_success: float | None
    success: float | None
    first_return: float | None
    mean_return: float | None
    proposed: int
    kept: int
    rejected_by: dict[str, int]
    explored_share: float | None
    challenger_updates: int
    player_updates: int
    time: dict[str, float]
    peak_memory_gb: float
    folder: str

    def facts(self) -> list[tuple[str, str]]:
        """:return: what there is to say, as (name, text)"""
        rejected = ", ".join(f"{name} {count}" for name, count in self.rejected_by.items()) or "nothing"
        return [
            ("outcome", self.outcome),
            ("environment steps", f"{self.steps} in {self.episodes} episodes"),
            ("evaluated success", _from_to(self.first_success, self.success, "{:.0%}")),
            ("evaluated return", _from_to(self.first_return, self.mean_return, "{:.2f}")),
            ("challenges", f"{self.proposed} proposed, {self.kept} kept"),
            ("said no", rejected),
            ("actions by C", "-" if self.explored_share is None else f"{self.explored_share:.0%}"),
            ("updates", f"{self.player_updates} of the player, {self.challenger_updates} of the challenger"),
            ("speed", f"{self.steps_per_second:.1f} steps/s while training, {self.seconds:.0f} s in all"),
            ("peak memory", f"{self.peak_memory_gb:.2f} GB"),
        ]

    def time_table(self) -> list[tuple[str, float, float]]:
        """:return: (section, seconds, share of all)"""
        total = max(sum(self.time.values()), 1e-9)
        return [(name, seconds, seconds / total) for name, seconds in self.time.items()]

    def as_text(self) -> str:
        """:return: the summary as plain text"""
        lines = [self.title, "=" * len(self.title)]
        lines += [f"{name:<20} {text}" for name, text in self.facts()]
        lines += ["", f"{'where the time went':<22}{'seconds':>9}{'share':>8}"]
        lines += [f"{name:<22}{seconds:>9.1f}{share:>8.1%}" for name, seconds, share in self.time_table()]
        lines += ["", f"Everything is in {self.folder}"]
        return "\n".join(lines) + "\n"

    def write(self, folder: Path) -> None:
        """Write summary.txt and summary.json."""
        write_text(folder / "summary.txt", self.as_text())
        write_text(folder / "summary.json", json.dumps(asdict(self), indent=2) + "\n")

    def show(self) -> None:
        """Print it, with colours where the terminal has them."""
        try:
            from rich.console import Console
            from rich.table import Table
        except ImportError:
            print(self.as_text())
            return
        facts = Table(show_header=False, title=self.title, title_justify="left", title_style="bold")
        facts.add_column(style="cyan", no_wrap=True)
        facts.add_column()
        for name, text in self.facts():
            facts.add_row(name, text)
        times = Table("where the time went", title=None, header_style="bold")
        times.add_column("seconds", justify="right")
        times.add_column("share", justify="right")
        for name, seconds, share in self.time_table():
            times.add_row(name, f"{seconds:.1f}", f"{share:.1%}")
        console = Console()
        console.print(facts)
        console.print(times)
        console.print(f"Everything is in {self.folder}", soft_wrap=True)


class Evaluated(NamedTuple):
    """
    One evaluation.

    :param mean_return: over its episodes, None where there was no evaluation
    :param success: share of them that were a success at their end, None where the environment doesn't say
    """

    mean_return: float | None
    success: float | None


def evaluated(folder: Path) -> tuple[Evaluated, Evaluated]:
    """
    :param folder: of a run
    :return: its first and its last evaluation
    """
    table = read_csv(folder / "evaluations.csv")
    if not table or len(table["step"]) == 0:
        return Evaluated(None, None), Evaluated(None, None)
    first, last = (table["step"] == step for step in (table["step"].min(), table["step"].max()))
    return _evaluated(table, first), _evaluated(table, last)


def _evaluated(table: dict[str, np.ndarray], rows: np.ndarray) -> Evaluated:
    told = table["success_at_end"][rows]
    told = told[np.isfinite(told)]
    return Evaluated(float(table["return"][rows].mean()), float(told.mean()) if len(told) else None)


def complete_times(seconds: dict[str, float], total: float) -> dict[str, float]:
    """
    :param seconds: by section
    :param total: seconds of the whole run
    :return: in the order of ``SECTIONS``, with what belongs to no section as "other"
    """
    names = [name for name in SECTIONS if name in seconds] + [name for name in seconds if name not in SECTIONS]
    table = {name: seconds[name] for name in names}
    return {**table, "other": max(total - sum(table.values()), 0.0)}


def peak_memory_gb() -> float:
    """:return: greatest resident memory of this process so far"""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e9 if sys.platform == "darwin" else 1e6)


def _from_to(first: float | None, last: float | None, form: str) -> str:
    if last is None or first is None:
        return "-"
    return f"{form.format(first)} in the first evaluation, {form.format(last)} in the last"
