"""
Installing software Vulkan (Mesa's lavapipe) with apt: as anybody into a private folder that :mod:`sb3_cpm.machine.vulkan` then
uses, or, if root asks for it, for the whole machine.

SAPIEN needs Mesa 24.3 or newer. Debian 12 has that in its backports suite only; Debian 13 and an updated Ubuntu 24.04 have it
as they are. Nothing here asks a question, and nothing names a server: mirrors and signing keys are those that the machine
already uses. So what is downloaded is checked by apt as everything else is on this machine.
"""

import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from sb3_cpm.machine.vulkan import cache_folder, private_folder

MINIMUM_MESA = (24, 3)
"""The first Mesa whose lavapipe SAPIEN accepts."""

DRIVER = "mesa-vulkan-drivers"
LIBRARIES = ("libvulkan1", "libgl1", "libegl1", "libx11-6", "libglib2.0-0")
"""Beside the driver: Vulkan's loader, what SAPIEN links (X11, even without a display) and what opencv links (GL, glib)."""


def install_system(say: Callable[[str], None]) -> None:
    """
    Install software Vulkan for the whole machine, as root; adds Debian's backports suite if only that has a new enough Mesa.

    :param say: told what is being done
    :raises RuntimeError: if this machine's package sources have none
    """
    _run(["apt-get", "update"], say)
    suite = _suite_with_driver([])
    if suite is None:
        backports = backports_source(_apt_sources(), _codename())
        if backports is not None:
            name, text = backports
            say(f"  adding Debian's backports suite: /etc/apt/sources.list.d/{name}")
            Path("/etc/apt/sources.list.d", name).write_text(text)
            _run(["apt-get", "update"], say)
            suite = _suite_with_driver([])
    if suite is None:
        raise RuntimeError(_too_old())
    install = ["apt-get", "install", "-y", "--no-install-recommends"]
    _run([*install, *LIBRARIES], say)
    _run([*install, "-t", suite, DRIVER], say)


def install_private(say: Callable[[str], None]) -> None:
    """
    Install software Vulkan into the private folder, as anybody: apt computes and downloads what this machine lacks,
    with all its own state in a private folder, and the packages are unpacked instead of installed.

    :param say: told what is being done
    :raises RuntimeError: if there is no apt, or this machine's package sources have no new enough Mesa
    """
    with tempfile.TemporaryDirectory(dir=cache_folder()) as temporary:
        work = Path(temporary)
        apt = _private_apt(work)
        _run(["apt-get", *apt, "update"], say)
        suite = _suite_with_driver(apt)
        if suite is None:
            raise RuntimeError(_too_old())
        download = ["apt-get", *apt, "install", "-y", "--no-install-recommends", "--download-only"]
        # two sets, unpacked in this order: where both hold a library, the one made for the newer driver stays
        for number, options in enumerate(([*LIBRARIES], ["-t", suite, "--reinstall", DRIVER])):
            _run([*download, "-o", f"Dir::Cache::archives={_folder(work / f'debs{number}/partial').parent}", *options], say)
            for package in sorted((work / f"debs{number}").glob("*.deb")):
                _run(["dpkg-deb", "-x", str(package), str(_folder(work / "result/root"))])
        _write_icd(work / "result")
        shutil.rmtree(private_folder(), ignore_errors=True)
        os.rename(work / "result", private_folder())
        _write_icd(private_folder())  # its paths are absolute


def _private_apt(work: Path) -> list[str]:
    """Options that keep apt's hands off the machine: its own lists and sources, but the machine's installed packages."""
    sources = _folder(work / "sources.list.d")
    found = _apt_sources()
    for name, text in found.items():
        (sources / name).write_text(text)
    backports = backports_source(found, _codename())
    if backports is not None:
        (sources / backports[0]).write_text(backports[1])
    options = {
        "Dir::Etc::sourcelist": "/dev/null",
        "Dir::Etc::sourceparts": str(sources),
        "Dir::State::lists": str(_folder(work / "lists/partial").parent),
        "Dir::Cache": str(_folder(work / "cache")),
        "Debug::NoLocking": "true",
        # without root apt could not switch to its own user anyway
        "APT::Sandbox::User": "",
    }
    return [part for key, value in options.items() for part in ("-o", f"{key}={value}")]


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


def _write_icd(folder: Path) -> None:
    """Vulkan's description of the driver, with an absolute path since the library is in none of the system's folders."""
    found = sorted((folder / "root/usr/share/vulkan/icd.d").glob("lvp_icd*.json"))
    libraries = sorted(folder.glob("root/usr/lib/*/libvulkan_lvp.so"))
    if not found or not libraries:
        raise RuntimeError(
            "The downloaded packages hold no lavapipe driver: the distribution has changed them, please report."
        )
    description = json.loads(found[0].read_text())
    description["ICD"]["library_path"] = str(libraries[0])
    (folder / "icd.json").write_text(json.dumps(description, indent=2))


# ---------------------------------------------------------------------- package sources
def _apt_sources() -> dict[str, str]:
    """:return: file name to text of all package sources of this machine"""
    files = [Path("/etc/apt/sources.list"), *sorted(Path("/etc/apt/sources.list.d").glob("*"))]
    return {f.name: f.read_text() for f in files if f.suffix in (".list", ".sources") and f.is_file()}


def _codename() -> str | None:
    """:return: Debian's code name of this machine's system, None if it is not Debian"""
    release = Path("/etc/os-release")
    fields = dict(line.split("=", 1) for line in release.read_text().splitlines() if "=" in line) if release.exists() else {}
    return fields.get("VERSION_CODENAME", "").strip('"') or None if fields.get("ID") == "debian" else None


def backports_source(sources: dict[str, str], codename: str | None) -> tuple[str, str] | None:
    """
    A source of Debian's backports: the entry of the release itself (mirror, signing key, options) with another suite.

    :param sources: file name to text, both of apt's formats
    :param codename: e.g. ``"bookworm"``, None for a system that is not Debian
    :return: name and text of a new file; None if there is no entry to copy or backports are there already
    """
    if codename is None:
        return None
    backports = f"{codename}-backports"
    for text in sources.values():
        active = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#"))
        if backports in active:
            return None
    for name, text in sources.items():
        for entry in re.split(r"\n\s*\n", text) if name.endswith(".sources") else text.splitlines():
            changed = _with_suite(entry, codename, backports)
            if changed is not None:
                return f"sb3-cpm-backports{Path(name).suffix}", changed + "\n"
    return None


def _with_suite(entry: str, codename: str, suite: str) -> str | None:
    """One entry with its suites replaced by one, None if it is not the release's own entry."""
    lines = [line for line in entry.splitlines() if not line.lstrip().startswith("#")]
    suites = [line for line in lines if line.lower().startswith("suites:")]
    if suites:
        if codename not in suites[0].split()[1:] or any(line.lower().startswith("enabled: no") for line in lines):
            return None
        return "\n".join(f"Suites: {suite}" if line == suites[0] else line for line in lines)
    match = re.match(rf"(deb\s+(?:\[[^]]*\]\s+)?\S+\s+){re.escape(codename)}(\s+.*)", "\n".join(lines))
    return None if match is None else f"{match[1]}{suite}{match[2]}"


def _suite_with_driver(apt_options: Sequence[str]) -> str | None:
    """:return: the suite with the newest driver that is new enough, None if none is"""
    listing = _run(["apt-cache", *apt_options, "madison", DRIVER])
    return newest_suite(listing)


def newest_suite(listing: str) -> str | None:
    """
    :param listing: what ``apt-cache madison`` says, a line per version: ``package | version | url suite/component arch``
    :return: the suite that has the newest version, None if that is older than :data:`MINIMUM_MESA`
    """
    found = []
    for line in listing.splitlines():
        fields = [field.strip() for field in line.split("|")]
        if len(fields) == 3 and fields[2].endswith("Packages"):
            numbers = re.findall(r"\d+", fields[1].split(":")[-1])
            found.append((tuple(map(int, numbers[:3])), fields[2].split()[1].split("/")[0]))
    version, suite = max(found, default=((0,), None))
    return suite if version >= MINIMUM_MESA else None


def _too_old() -> str:
    return (
        f"The package sources of this machine have no {DRIVER} of version {MINIMUM_MESA[0]}.{MINIMUM_MESA[1]} or newer. "
        "Debian 12 and later and an updated Ubuntu 24.04 have one; on others install a newer Mesa (its 'lavapipe' driver), "
        "or use a machine with a graphics driver that supports Vulkan."
    )


def _run(command: list[str], say: Callable[[str], None] | None = None) -> str:
    """Run a command that asks nothing; its output goes nowhere unless it fails."""
    if say is not None:
        # the options that make apt private would only bury what is being done
        words = [w for i, w in enumerate(command) if w != "-o" and (i == 0 or command[i - 1] != "-o")]
        say(f"  $ {' '.join(words)}")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C"}
    try:
        done = subprocess.run(command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=900)
    except FileNotFoundError:
        raise RuntimeError(
            f"{command[0]} is not on this machine, so software Vulkan cannot be installed automatically. Install Mesa's "
            f"lavapipe driver, {MINIMUM_MESA[0]}.{MINIMUM_MESA[1]} or newer, with the system's package manager (Fedora: "
            "mesa-vulkan-drivers, Arch: vulkan-swrast)."
        ) from None
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"{' '.join(command)} did not come back within 15 minutes.") from None
    if done.returncode != 0:
        lines = "\n".join((done.stdout + done.stderr).splitlines()[-8:])
        raise RuntimeError(f"{' '.join(command)} failed with status {done.returncode}:\n{lines}")
    return done.stdout
