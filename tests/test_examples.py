"""The scripts of examples/, shortened."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: Arguments that shorten a script, and what it says at the end.
EXAMPLES = {
    "own_environment": (["--steps", "450"], "it stands for"),
    "images": (["--steps", "230"], "the challenger reads ('camera',), the player ('state',)"),
    "clouds": (["--steps", "220"], "return "),
    "demonstrations": (["--steps", "200"], "trained: success"),
    "resume": (["--steps", "400"], "400 steps are done"),
    "custom_uncertainty": (["--steps", "330"], "InverseModelError after"),
}


def run(name: str, arguments: list[str], folder: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "ignore", str(ROOT / "examples" / f"{name}.py"), *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_all_are_here_and_short() -> None:
    scripts = {path.stem: len(path.read_text().splitlines()) for path in (ROOT / "examples").glob("*.py")}
    assert set(scripts) == set(EXAMPLES) and max(scripts.values()) <= 60


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in EXAMPLES if name != "resume"])
def test_example_runs(name: str, tmp_path: Path) -> None:
    arguments, said = EXAMPLES[name]
    assert said in run(name, arguments, tmp_path)


@pytest.mark.slow
def test_resume_goes_on(tmp_path: Path) -> None:
    run("resume", ["--steps", "400"], tmp_path)
    assert "going on at step 400" in run("resume", ["--steps", "600"], tmp_path)
