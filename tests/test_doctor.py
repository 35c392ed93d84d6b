"""The doctor on this machine, and on machines that lack something."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from sb3_cpm.extras import install_command
from sb3_cpm.machine import doctor, rendering
from sb3_cpm.machine.memory import memory_gib

WORKS = rendering.Probe(rendering.Renderer("cpu", "llvmpipe", True), "Mesa 25.0.7", "", 1.0)


@pytest.mark.maniskill
def test_all_is_well_here(capsys: pytest.CaptureFixture[str]) -> None:
    status = doctor.run_doctor()
    output = capsys.readouterr().out
    assert status == 0, output
    assert "All is well." in output and "FAIL" not in output
    for what in ("Python", "torch", "sapien", "Vulkan driver", "SAPIEN renders", "memory", "disk", "ffmpeg"):
        assert what in output


@pytest.mark.maniskill
def test_no_vulkan_is_not_well(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent.json")
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent.json")
    assert doctor.run_doctor() == 1
    output = capsys.readouterr().out
    assert "FAIL  SAPIEN renders" in output and "cure: The environment names" in output
    assert "Not well: SAPIEN renders." in output


def test_each_lack_has_a_cure(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(rendering, "probe_renderer", lambda: WORKS._replace(renderer=None, problem="It died of SIGSEGV."))
    monkeypatch.setattr(doctor, "memory_gib", lambda: (0.5, 8.0))
    monkeypatch.setattr(doctor, "PYTHONS", ((3, 7), (3, 8)))
    monkeypatch.setattr(doctor, "OPTIONAL", ("a-package-that-nobody-has",))
    monkeypatch.setattr(doctor, "DISK", 1e9)
    assert doctor.run_doctor() == 1
    lines = capsys.readouterr().out.splitlines()
    bad = [i for i, line in enumerate(lines) if line.startswith("FAIL")]
    assert len(bad) >= 5
    assert all(lines[i + 1].strip().startswith("cure: ") for i in bad)
    assert any("a-package-that-nobody-has" in line and "not installed" in line for line in lines)


def test_without_maniskill_nothing_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    package = doctor._package

    def without(name: str, cure: str) -> doctor.Finding:
        return doctor.Finding(name, False, "not installed", cure) if name in doctor.SIMULATION else package(name, cure)

    def never(*_: Any) -> None:
        raise AssertionError("there is nothing to try")

    monkeypatch.setattr(doctor, "_package", without)
    monkeypatch.setattr(rendering, "probe_renderer", never)
    findings = {finding.what: finding for finding in doctor.examine()}
    assert not findings["SAPIEN renders"].well and findings["SAPIEN renders"].cure == install_command("maniskill")


def test_submodules_are_attributes() -> None:
    code = "import sb3_cpm; print(sb3_cpm.buffers.CPMBuffer is sb3_cpm.CPMBuffer, hasattr(sb3_cpm, 'nonsense'))"
    child = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=600)
    assert child.stdout.strip() == "True False", child.stderr


def test_the_package_imports_without_maniskill() -> None:
    """With ManiSkill and SAPIEN forbidden everything works but making an environment, which says what it needs."""
    code = """
import sys
sys.modules["mani_skill"] = sys.modules["sapien"] = None  # as if not installed
import sb3_cpm, sb3_cpm.envs, sb3_cpm.extras, sb3_cpm.machine.doctor
from sb3_cpm.machine import rendering
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name: None if name in ("mani_skill", "sapien") else found(name)
try:
    sb3_cpm.envs.make_maniskill_env("PickCube-v1")
except ImportError as error:
    assert sb3_cpm.extras.install_command("maniskill") in str(error), error
    print("said so")
"""
    child = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=600)
    assert child.stdout.strip() == "said so", child.stderr


def test_a_broken_torch_is_a_finding(tmp_path: Path) -> None:
    """Even where ``import torch`` fails, doctor and help answer."""
    (tmp_path / "torch").mkdir()
    (tmp_path / "torch/__init__.py").write_text("raise OSError('libcudnn.so.9: cannot open shared object file')")
    path = os.pathsep.join((str(tmp_path), str(Path(doctor.__file__).parents[2])))
    run = partial(subprocess.run, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, timeout=600)
    child = run([sys.executable, "-m", "sb3_cpm", "doctor"])
    assert "FAIL  torch                 libcudnn.so.9" in child.stdout, child.stderr
    assert "Not well: " in child.stdout and child.returncode == 1
    assert "train" in run([sys.executable, "-m", "sb3_cpm", "--help"]).stdout


def test_a_container_limit_counts(tmp_path: Path) -> None:
    free, total = memory_gib()
    assert 0 < free <= total
    (tmp_path / "memory.max").write_text(f"{2**28}\n")
    (tmp_path / "memory.current").write_text(f"{2**27}\n")
    assert memory_gib(tmp_path) == (0.125, 0.25)
    (tmp_path / "memory.stat").write_text(f"anon 0\ninactive_file {2**26}\n")  # cache, given back when it is needed
    assert memory_gib(tmp_path) == (0.1875, 0.25)
    (tmp_path / "memory.max").write_text("max\n")
    assert memory_gib(tmp_path)[1] == total
