"""
How soon each explorer finds the reward of MountainCarContinuous-v0, from the tables of ``reproduce --figure exploration``.

::

    python benchmarks/exploration.py [--results results]

Prints a markdown table, one line per agent: the step at the end of the first training episode that reached the goal, seeds
that solve the task after 10,000 steps (mean return of the evaluation episodes at least 90), and wall-clock seconds of a run,
which are comparable only where runs shared the machine alike.
"""

import argparse
import csv
import statistics
from pathlib import Path

import yaml

SOLVED, SOON = 90.0, 4000


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def run_of(folder: Path) -> tuple[int | None, float, float]:
    """:return: first step at the goal (None: never), return after the last step, seconds"""
    reached = [int(row["step"]) for row in rows(folder / "training.csv") if row["success_once"] == "1"]
    evaluations = rows(folder / "evaluations.csv")
    last = max(int(row["step"]) for row in evaluations)
    returns = [float(row["return"]) for row in evaluations if int(row["step"]) == last]
    finished = yaml.safe_load((folder / "finished.yml").read_text(encoding="utf-8"))
    return (reached[0] if reached else None), statistics.mean(returns), float(finished["seconds"])


def told(step: float | None) -> str:
    return "never" if step is None or step == float("inf") else f"{step:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path(__file__).parents[1] / "results")
    args = parser.parse_args()
    columns = ("agent", "seeds", f"found by step {SOON:,}", "median", "by seed", "solved", "mean return", "seconds")
    print(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}")
    for agent in sorted((args.results / "exploration").iterdir()):
        folders = sorted(path.parent for path in agent.glob("*/seed*/finished.yml"))
        if not folders:
            continue
        found = [run_of(folder) for folder in folders]
        steps = [step for step, _, _ in found]
        middle = statistics.median(float("inf") if step is None else step for step in steps)
        cells = (
            agent.name,
            len(found),
            sum(step is not None and step <= SOON for step in steps),
            told(middle),
            ", ".join(told(step) for step in steps),
            sum(mean >= SOLVED for _, mean, _ in found),
            f"{statistics.mean(mean for _, mean, _ in found):.1f}",
            f"{statistics.median(seconds for _, _, seconds in found):.0f}",
        )
        print(f"| {' | '.join(map(str, cells))} |")


if __name__ == "__main__":
    main()
