"""
Packages that come with an extra of setup.cfg, and what is said where one is missing: a command that works where it is read.

In a checkout it installs the checkout. Elsewhere it names the packages themselves, since whoever got a wheel from somewhere
has no registry that knows ``sb3_cpm``.
"""

import contextlib
import importlib.util
import re
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path


class MissingExtra(ImportError, ValueError):
    """A package is not installed; the message has the command that installs it."""


@contextlib.contextmanager
def needed(what: str, extra: str) -> Iterator[None]:
    """
    Around imports.

    :param what: needs them, for the message
    :param extra: the one that brings them
    :raises MissingExtra: where a module is missing
    """
    try:
        yield
    except MissingExtra:
        raise
    except ModuleNotFoundError as error:
        raise missing(what, (error.name or str(error)).partition(".")[0], extra) from error


def check_installed(what: str, packages: Sequence[str], extra: str) -> None:
    """
    :param what: needs them, for the message
    :param packages: names of modules
    :param extra: the one that brings them
    :raises MissingExtra: for the first that is missing
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise missing(what, package, extra)


def missing(what: str, package: str, extra: str) -> MissingExtra:
    """:return: the error that says so"""
    return MissingExtra(f"{what} need {package}, which is not installed: {install_command(extra)}", name=package)


# ---------------------------------------------------------------------- what to type


def checkout() -> Path | None:
    """:return: the folder of the checkout, or of the unpacked source distribution, that this package lies in"""
    folder = Path(__file__).resolve().parents[1]
    return folder if (folder / "setup.cfg").is_file() and (folder / "zoo_configs").is_dir() else None


def install_command(*extras: str) -> str:
    """
    The one place that says how something is installed.

    :param extras: of setup.cfg; none: what the package itself needs
    :return: a command that installs what is missing of them, in a checkout and without one
    """
    folder = checkout()
    if folder is not None:
        names = f"[{','.join(extras)}]" if extras else ""
        return f'pip install -c "{folder / "constraints.txt"}" -e "{folder}{names}"'
    wanted = _requirements("sb3_cpm", "", *extras)
    # none missing: one is broken, or older than this package wants
    chosen = [requirement for requirement in wanted if not _is_installed(requirement)] or wanted
    if not chosen:  # a bare copy of the folder: nothing says what it needs
        return "install sb3_cpm itself, from its wheel or from a checkout"
    return " ".join(["pip install", *(f'"{requirement}"' for requirement in chosen)])


def _requirements(distribution: str, *extras: str) -> list[str]:
    """What an installed distribution says that its extras bring, "" being what it needs itself; nothing if it is not there."""
    from importlib import metadata  # as long to import as all that `--help` needs

    try:
        lines = metadata.requires(distribution) or []
    except metadata.PackageNotFoundError:
        return []
    split = [[part.strip() for part in line.partition(";")[::2]] for line in lines]  # name and versions, condition
    return [requirement for requirement, condition in split if _extra_of(condition) in extras]


def _extra_of(condition: str) -> str:
    named = re.search(r"""\bextra\s*==\s*["']([^"']+)""", condition)
    return named[1] if named else ""


def _is_installed(requirement: str) -> bool:
    """Whatever its version; with what its own extras bring, as ffmpeg for ``imageio[ffmpeg]>=2.34``."""
    from importlib import metadata

    matched = re.match(r"([\w.-]+)(?:\[([^]]*)\])?", requirement)
    assert matched is not None, requirement
    name, extras = matched[1], [extra.strip() for extra in (matched[2] or "").split(",")]
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return all(_is_installed(one) for one in _requirements(name, *filter(None, extras)))


def config_folder() -> Path:
    """
    A wheel brings the files as package ``sb3_cpm.zoo_configs``. A checkout has them beside the package, and they are read from
    there: where another checkout is installed and ``PYTHONPATH`` names this one, an import would find those of the other.

    :return: ``zoo_configs/``
    :raises ValueError: where there is none
    """
    root = checkout()
    if root is not None:
        return root / "zoo_configs"
    try:
        return Path(str(resources.files("sb3_cpm.zoo_configs")))
    except ModuleNotFoundError as error:
        raise ValueError(f"sb3_cpm came without its zoo_configs: give the path of a file, or {install_command()}.") from error
