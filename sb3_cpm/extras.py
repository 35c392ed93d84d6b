"""Packages that come with an extra of setup.cfg: what is said where one is missing."""

import contextlib
import importlib.util
from collections.abc import Iterator, Sequence


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
    return MissingExtra(f'{what} need {package}, which is not installed: pip install "sb3_cpm[{extra}]"', name=package)
