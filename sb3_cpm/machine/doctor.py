"""
``python -m sb3_cpm doctor``: what works on this machine, what does not, and the cure.

Nothing here changes anything, and every finding is one row: what was looked at, whether it is well, what was found, and what
to do about it. Works without ManiSkill, a renderer and the optional packages, since those are what it looks for.
"""

import importlib.metadata
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from typing import NamedTuple

from sb3_cpm.extras import install_command
from sb3_cpm.machine.memory import memory_gib

PYTHONS = ((3, 10), (3, 12))
"""Oldest and newest Python that the package is tested with."""

REQUIRED = ("stable-baselines3", "gymnasium", "numpy")
OPTIONAL = ("sb3-contrib", "tensorboard", "matplotlib")
SIMULATION = ("mani_skill", "sapien", "trimesh", "fast-simplification")

MEMORY = 2.0
"""GiB that should be free: a training run on PickCube's images takes about that."""

DISK = 1.0
"""GiB that should be free for the results of some runs."""


class Finding(NamedTuple):
    """
    One row of the report.

    :param what: what was looked at
    :param well: whether it is as it should be
    :param found: what was found
    :param cure: what to do if it is not well
    """

    what: str
    well: bool
    found: str
    cure: str = ""


def run_doctor() -> int:
    """
    Print what works and what does not.

    :return: exit status, 0 only if all is well
    """
    findings = []
    for finding in examine():
        findings.append(finding)
        mark = "ok  " if finding.well else "FAIL"
        print(f"{mark}  {finding.what:<22}{finding.found}", flush=True)
        if not finding.well and finding.cure:
            print(f"{'':<6}{'':<22}cure: {finding.cure}", flush=True)
    bad = [finding.what for finding in findings if not finding.well]
    print(f"\nNot well: {', '.join(bad)}. The cures are above." if bad else "\nAll is well.")
    return 1 if bad else 0


def examine() -> Iterator[Finding]:
    """:return: the findings, one by one, since the last ones take some seconds"""
    yield _python()
    yield from (_package(name, install_command()) for name in REQUIRED)
    th = _torch()
    yield th
    yield from (_package(name, install_command("run", "contrib")) for name in OPTIONAL)
    yield from (_package(name, install_command("maniskill")) for name in SIMULATION)
    yield _memory()
    yield _disk()
    yield _video()
    yield from _rendering(th.well)


def _python() -> Finding:
    oldest, newest = (".".join(map(str, version)) for version in PYTHONS)
    well = PYTHONS[0] <= sys.version_info[:2] <= PYTHONS[1]
    system = f"{platform.system()} {platform.machine()}"
    return Finding("Python", well, f"{platform.python_version()} on {system}", f"use Python {oldest} to {newest}")


def _package(name: str, cure: str) -> Finding:
    try:
        return Finding(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, False, "not installed", cure)


def _torch() -> Finding:
    try:
        import torch as th
    except (ImportError, OSError) as error:  # OSError: a CUDA library that is not there
        return Finding("torch", False, str(error).splitlines()[0], "install torch, see https://pytorch.org")
    if th.cuda.is_available():
        device = ", ".join(th.cuda.get_device_name(i) for i in range(th.cuda.device_count()))
    else:
        device = f"no GPU, {th.get_num_threads()} CPU threads of {os.cpu_count()} cores"
    return Finding("torch", True, f"{th.__version__}, {device}")


def _memory() -> Finding:
    free, total = memory_gib()
    found = f"{free:.1f} of {total:.1f} GiB free"
    return Finding("memory", free >= MEMORY, found, f"a training run needs about {MEMORY:g} GiB: close other programs")


def _disk() -> Finding:
    free = shutil.disk_usage(".").free / 2**30
    return Finding("disk", free >= DISK, f"{free:.1f} GiB free in {os.getcwd()}", f"free at least {DISK:g} GiB for results")


def _video() -> Finding:
    path = shutil.which("ffmpeg")
    if path is None:
        try:
            import imageio_ffmpeg

            path = imageio_ffmpeg.get_ffmpeg_exe()
        except (ImportError, RuntimeError):
            return Finding("ffmpeg (videos)", False, "not found", f"{install_command('run')}, or install ffmpeg")
    return Finding("ffmpeg (videos)", True, str(path))


def _rendering(torch_works: bool) -> Iterator[Finding]:
    if not torch_works:
        yield Finding("SAPIEN renders", False, "not tried without torch", "see torch")
        return
    if not all(_package(name, "").well for name in ("mani_skill", "sapien")):
        yield Finding("SAPIEN renders", False, "not tried without ManiSkill", install_command("maniskill"))
        return
    from sb3_cpm.machine import rendering, vulkan

    try:
        vulkan.cache_folder()
    except RuntimeError as error:
        yield Finding("cache folder", False, *str(error).rsplit(". ", 1))
        return
    probe = rendering.probe_renderer()
    if probe.renderer is None:
        yield Finding("SAPIEN renders", False, probe.problem, rendering.cure())
        return
    private = "" if not vulkan.private_in_use() else f", private in {vulkan.private_folder()}"
    yield Finding("Vulkan driver", True, f"{probe.renderer.name}, {probe.driver or 'version unknown'}{private}")
    how = "in software" if probe.renderer.software else "with a GPU"
    yield Finding("SAPIEN renders", True, f"{how}, tried in a child process ({probe.seconds:.1f} s)")
