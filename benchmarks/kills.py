"""
Runs that are killed at random moments and gone on with until they end: are their tables those of an unbroken run?

::

    python benchmarks/kills.py --kills 20                   of each kind: SIGKILL and SIGTERM, of `train` and of `reproduce`
    python benchmarks/kills.py --kills 5 --front train --n-envs 2

Every run is made unbroken first; then it is begun anew, killed after a random time, gone on with, and so on, until it has been
killed as often as asked (runs that end before are begun anew). Then it goes on to its end, and all CSV files are compared byte
by byte. What a kill has cost is the number of steps between the last row that was written and the checkpoint that the run went
on from. Exit status 1 if a table differs, or if a kill has cost more than a checkpoint interval.
"""

import argparse
import csv
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: A player and a challenger that take seconds.
SMALL_CHALLENGER = "challenger_kwargs={batch_size: 4, sequence_length: 16, imagination_starts: 8, horizon: 5}"
EVERY, STEPS = 100, 500


class Train:
    """
    ``python -m sb3_cpm train``.

    :param folder: of the run
    :param n_envs: parallel environments
    """

    def __init__(self, folder: Path, n_envs: int) -> None:
        self.tables, self.n_envs = folder / "run", n_envs

    def command(self) -> list[str]:
        base = [sys.executable, "-m", "sb3_cpm", "train"]
        if (self.tables / "config.yml").is_file():
            return [*base, "--resume", str(self.tables), "--no-video"]
        sizes = ["--learning-starts", "100", "--train-freq", "10", "--batch-size", "16", "--n-envs", str(self.n_envs)]
        length = ["--steps", str(STEPS), "--checkpoint-freq", str(EVERY), "--evaluations", "3", "--eval-episodes", "2"]
        names = ["--env", "CPMToy-v0", "--run-folder", str(self.tables), "--no-video"]
        return [*base, *names, *length, *sizes, "--callback-kwargs", SMALL_CHALLENGER]


class Reproduce:
    """
    ``python -m sb3_cpm reproduce``, one run of it.

    :param folder: of the results
    :param n_envs: not used
    """

    def __init__(self, folder: Path, n_envs: int) -> None:
        self.results = folder
        self.tables = folder / f"decays-quick-steps{STEPS}" / "CPM linear" / "CPMToy-v0" / "seed0"

    def command(self) -> list[str]:
        which = ["--figure", "decays", "--quick", "--agents", "CPM linear", "--seeds", "1", "--steps", str(STEPS)]
        return [sys.executable, "-m", "sb3_cpm", "reproduce", *which, "--results", str(self.results)]


FRONTS = {"train": Train, "reproduce": Reproduce}


def run(command: list[str], number: int | None = None, after: float = 0.0) -> int:
    """
    :param command: to run
    :param number: of the signal that it gets; None: it ends by itself
    :param after: seconds
    :return: its exit status
    """
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        output, _ = process.communicate(timeout=after if number is not None else None)
    except subprocess.TimeoutExpired:
        process.send_signal(number or signal.SIGKILL)
        output, _ = process.communicate()
    if number is None and process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}:\n{output}")
    return process.returncode


def last_step(folder: Path) -> int:
    path = folder / "training.csv"
    if not path.exists():
        return 0
    with path.open(newline="", encoding="utf-8") as file:
        steps = [row["step"] for row in csv.DictReader(file)]
    return int(steps[-1]) if steps and steps[-1].isdecimal() else 0


def checkpoint_step(folder: Path) -> int:
    from stable_baselines3.common.save_util import load_from_zip_file

    for name in ("checkpoint", "checkpoint.old"):
        if (folder / name / "state.npz").exists():
            data, _, _ = load_from_zip_file(folder / name / "model.zip", device="cpu")
            return int((data or {})["num_timesteps"])
    return 0


def tables(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.csv"))}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20, help="of each kind")
    parser.add_argument("--front", nargs="+", choices=list(FRONTS), default=list(FRONTS))
    parser.add_argument("--n-envs", type=int, default=1, help="of `train`")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    args = parser.parse_args()
    chance, failed = random.Random(args.seed), 0
    with tempfile.TemporaryDirectory() as temporary:
        for front in args.front:
            unbroken = FRONTS[front](Path(temporary, front, "unbroken"), args.n_envs)
            started = time.perf_counter()
            run(unbroken.command())
            seconds, wanted = time.perf_counter() - started, tables(unbroken.tables)
            for number in (signal.SIGKILL, signal.SIGTERM):
                folder = Path(temporary, front, number.name)
                broken, counts, costs, kills = FRONTS[front](folder, args.n_envs), Counter(), [], 0
                while kills < args.kills:
                    status = run(broken.command(), number, chance.uniform(0.1, 0.9) * seconds)
                    ended = (broken.tables / "finished.yml").exists()  # perhaps just before the signal came
                    kills += status != 0
                    counts["killed" if status else "ended before"] += 1
                    if ended:
                        counts["equal" if tables(broken.tables) == wanted else "DIFFERENT"] += 1
                        shutil.rmtree(folder)
                    else:
                        costs.append(max(last_step(broken.tables) - checkpoint_step(broken.tables), 0))
                if broken.tables.exists():
                    run(broken.command())
                    counts["equal" if tables(broken.tables) == wanted else "DIFFERENT"] += 1
                most = max(costs, default=0)
                failed += counts["DIFFERENT"] + (most > (EVERY if front == "train" else STEPS))
                told = ", ".join(f"{name} {count}" for name, count in counts.items())
                cost = f"a kill cost at most {most} steps ({seconds:.0f} s unbroken)"
                print(f"{front} {number.name}: {told}; {cost}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
