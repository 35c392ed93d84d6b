"""
A Python that has imported what is heavy, for commands whose own start is not what a test is about: those of rl_zoo3 take 6 CPU
seconds to import and one to run.

Every command has a process of its own, as from a shell (arguments, folder, output, exit status), but one that is forked from
here. Nothing of ours is imported before.
"""

import importlib
import json
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: The last is what PyTorch imports when the first optimizer is made.
HEAVY = ("torch", "stable_baselines3", "sb3_contrib", "matplotlib.pyplot", "optuna", "rl_zoo3.exp_manager", "torch._dynamo")


class WarmPython:
    """The side of the tests: starts it, and hands it commands."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def _start(self) -> "subprocess.Popen[str]":
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-W", "ignore", __file__]
        return subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def run(self, module: str, arguments: list[str], folder: Path, timeout: float = 900) -> "subprocess.CompletedProcess[str]":
        """
        As ``python -m module arguments`` in a folder.

        :param timeout: seconds until it is killed
        """
        if self._process is None or self._process.poll() is not None:  # one that was killed fails the test that it was at
            self._process = self._start()
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None and answers is not None
        with tempfile.TemporaryDirectory() as outputs:
            files = [Path(outputs, name) for name in ("stdout", "stderr")]
            requests.write(json.dumps([module, arguments, str(folder), *map(str, files)]) + "\n")
            requests.flush()
            limit = threading.Timer(timeout, os.kill, (int(answers.readline()), signal.SIGKILL))
            limit.start()
            try:
                status = int(answers.readline())
            finally:
                limit.cancel()  # also where there is no answer: the number may be another process's by then
            return subprocess.CompletedProcess([module, *arguments], status, *(file.read_text() for file in files))

    def close(self) -> None:
        if self._process is not None:
            self._process.communicate()  # it ends where its input does


def serve() -> None:
    """Its own side: lines of JSON come, the number of a process and its exit status go."""
    for name in HEAVY:
        importlib.import_module(name)
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            become(*json.loads(line))
            return
        print(pid, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


def become(module: str, arguments: list[str], folder: str, stdout: str, stderr: str) -> None:
    os.chdir(folder)
    for number, name in enumerate((os.devnull, stdout, stderr)):
        opened = os.open(name, os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT)
        os.dup2(opened, number)
        os.close(opened)
    sys.argv[1:] = arguments
    sys.path[0] = folder
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    serve()
