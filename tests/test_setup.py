"""What `make` does before there is a Python environment."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def in_shell(command: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True, timeout=600)


def test_an_interpreter_may_lie_in_a_folder_with_a_space(tmp_path: Path) -> None:
    python = tmp_path / "my pythons/python"
    python.parent.mkdir()
    python.symlink_to(Path(sys.executable).resolve())
    found = in_shell(f'"{ROOT}/scripts/find_python.sh" "{python}"', tmp_path)
    assert found.stdout.strip() == str(python), found.stderr
    missing = in_shell(f'"{ROOT}/scripts/find_python.sh" "{python} that is not there"', tmp_path)
    assert missing.returncode == 1 and f"looked for: {python} that is not there" in missing.stderr


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_a_half_made_environment_is_made_again(tmp_path: Path) -> None:
    """The disk was full, say: the next `make` must not take what is there for an environment."""
    for name in ("Makefile", "scripts"):
        (tmp_path / name).symlink_to(ROOT / name)
    python = Path(sys.executable).resolve()
    failed = in_shell(f"ulimit -f 200; make .venv/bin/python PYTHON={python}", tmp_path)
    assert failed.returncode != 0 and (tmp_path / ".venv").exists(), failed.stderr
    assert not (tmp_path / ".venv/bin/python").exists()
