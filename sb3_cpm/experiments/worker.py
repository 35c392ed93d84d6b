"""One run in a process of its own: ``python -m sb3_cpm.experiments.worker JOB``, which the grid calls."""

import json
import os
import sys
import threading
from pathlib import Path

from sb3_cpm.experiments.grid import STATUS, attempt
from sb3_cpm.experiments.specification import RunSpec


def main(job: str) -> int:
    """
    :param job: JSON with the run, the folder of all results, and the device
    :return: the exit status: that of the outcome, 1 after a crash
    """
    given = json.loads(job)
    result = attempt(RunSpec(**given["spec"]), Path(given["results"]), say, given["device"])
    say(f"{result.spec.name}: {result.outcome}, {result.message}")
    return STATUS.get(result.outcome, 1)


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def end_with_parent() -> None:
    """End this process when the one that started it is gone, however that ended: its end of our standard input closes then."""

    def wait() -> None:
        os.read(sys.stdin.fileno(), 1)  # not through the buffer, whose lock the interpreter wants when it ends
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    end_with_parent()
    sys.exit(main(sys.argv[1]))
