"""
Many runs: in this process one after the other, or in processes of their own, several at a time.

A run that crashes is recorded in its folder and the others go on.
"""

import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from sb3_cpm.experiments.specification import RunResult, RunSpec
from sb3_cpm.files import DamagedRunError, LockedError
from sb3_cpm.run.folder import CRASHED, OtherResultError, is_finished, write_crashed

Tell = Callable[[str], None]
#: What a worker process ends with, by outcome; every other status is a crash.
STATUS = {"finished": 0, "skipped": 10, "refused": 11, "unchecked": 12}


def perform_all(
    specs: Sequence[RunSpec], results: Path, jobs: int = 1, tell: Tell = print, device: str = "cpu"
) -> list[RunResult]:
    """
    Make runs.

    :param specs: the runs
    :param results: folder of all results
    :param jobs: how many processes at a time; 0: in this process
    :param tell: is given lines about the progress
    :param device: PyTorch device of the runs
    :return: what became of each, in the order of ``specs``
    :raises ValueError: for a negative number of jobs
    """
    if jobs < 0:
        raise ValueError(f"jobs={jobs}: expected 0 (in this process) or more")
    if jobs == 0:
        return [attempt(spec, results, tell, device) for spec in specs]
    return _Pool(specs, results, jobs, tell, device).run()


def attempt(spec: RunSpec, results: Path, tell: Tell = print, device: str = "cpu") -> RunResult:
    """As :func:`~sb3_cpm.experiments.single_run.perform`, but whatever goes wrong becomes a result."""
    from sb3_cpm.experiments.single_run import perform  # brings PyTorch, which nobody needs who only draws

    folder = spec.folder(results)
    try:
        return perform(spec, results, tell, device)
    except (OtherResultError, LockedError, DamagedRunError) as error:
        return RunResult(spec, "refused", str(error), folder)
    except Exception as error:
        if is_finished(folder):
            told = f"its result is there; whether it was made with what is asked for now cannot be told ({error})"
            return RunResult(spec, "unchecked", told, folder)
        return _crashed(spec, folder, traceback.format_exc(), error)


def _crashed(spec: RunSpec, folder: Path, text: str, error: Exception) -> RunResult:
    see = f" (see {folder / 'crashed.txt'})" if write_crashed(folder, text) else ""
    return RunResult(spec, "crashed", f"{type(error).__name__}: {error}{see}", folder)


class _Pool:
    """Worker processes, each for one run, so that memory is given back and a killed one takes nobody along."""

    def __init__(self, specs: Sequence[RunSpec], results: Path, jobs: int, tell: Tell, device: str) -> None:
        self.specs, self.results, self.jobs, self.tell, self.device = list(specs), results, jobs, tell, device
        self._outcomes: dict[int, RunResult] = {}
        self._running: dict[int, subprocess.Popen] = {}

    def run(self) -> list[RunResult]:
        waiting = list(range(len(self.specs)))
        try:
            while waiting or self._running:
                while waiting and len(self._running) < self.jobs:
                    index = waiting.pop(0)
                    self._running[index] = self._start(self.specs[index])
                time.sleep(0.05)
                self._collect()
        finally:  # Ctrl-C: workers have got it, too, and end by themselves; a second one finds them ended
            for process in self._running.values():
                process.terminate()
                process.communicate()
        return [self._outcomes[index] for index in range(len(self.specs))]

    def _start(self, spec: RunSpec) -> subprocess.Popen:
        job = json.dumps({"spec": spec.as_dict(), "results": str(self.results), "device": self.device})
        environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
        command = [sys.executable, "-m", "sb3_cpm.experiments.worker", job]
        return subprocess.Popen(command, stdin=subprocess.PIPE, env=environment)  # nothing is written, see end_with_parent()

    def _collect(self) -> None:
        for index, process in list(self._running.items()):
            status = process.poll()
            if status is None:
                continue
            process.communicate()
            del self._running[index]
            spec = self.specs[index]
            folder = spec.folder(self.results)
            outcome = next((name for name, code in STATUS.items() if code == status), "crashed")
            if outcome == "crashed" and status != 1:  # it could not write that itself
                how = f"signal {-status}" if status < 0 else f"status {status}"
                write_crashed(folder, f"The process of this run ended with {how}.\n")
            told = f"see {folder / CRASHED}" if outcome == "crashed" and (folder / CRASHED).exists() else "see above"
            self._outcomes[index] = RunResult(spec, outcome, f"process ended with {status}, {told}", folder)
            self.tell(f"[{len(self._outcomes)}/{len(self.specs)}] {spec.name}: {outcome}")
