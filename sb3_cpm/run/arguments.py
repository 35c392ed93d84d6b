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
        refused = re.search(r"unexpected keyword argument '(\w+)'", str(error))
        for setting, given in settings.items():
            if refused is not None and isinstance(given, Mapping) and refused[1] in _names(given):
                raise ValueError(f"{setting}: unknown name {refused[1]!r} ({error})") from error
        raise


def _names(given: Mapping[str, Any]) -> set[str]:
    return {*given, *(name for value in given.values() if isinstance(value, Mapping) for name in _names(value))}
