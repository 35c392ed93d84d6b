"""Misspelt names in settings that are handed on as arguments, told before anything is trained."""

import contextlib
import re
from collections.abc import Iterator, Mapping
from typing import Any


@contextlib.contextmanager
def misspelt_names_told(settings: Mapping[str, Any]) -> Iterator[None]:
    """
    For arguments within arguments, whose takers are known to those who call them only.

    :param settings: by name; a TypeError about an argument that is named in one of them becomes a ValueError that says so
    """
    try:
        yield
    except TypeError as error:
        name = unexpected_argument(error)
        for setting, given in settings.items():
            if name is not None and isinstance(given, Mapping) and name in _names(given):
                raise ValueError(f"{setting}: unknown name {name!r} ({error})") from error
        raise


def unexpected_argument(error: TypeError) -> str | None:
    """:return: the argument that a call has refused, None for other errors"""
    found = re.search(r"unexpected keyword argument '(\w+)'", str(error))
    return None if found is None else found[1]


def _names(given: Mapping[str, Any]) -> set[str]:
    return {*given, *(name for value in given.values() if isinstance(value, Mapping) for name in _names(value))}
