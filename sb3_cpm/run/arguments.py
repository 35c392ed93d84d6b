"""Misspelt names in settings that are handed on as arguments, told before anything is trained."""

import contextlib
import inspect
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

from sb3_cpm.arguments import nearest


def check_arguments(setting: str, given: Mapping[str, Any], taker: Callable[..., Any], excluded: Collection[str] = ()) -> None:
    """
    :param setting: where they come from, for the message
    :param given: arguments by name
    :param taker: what they are for
    :param excluded: names of arguments that are not for this setting
    :raises ValueError: for a name that is not among the arguments, with the nearest
    """
    parameters = inspect.signature(taker).parameters.values()
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    valid = [parameter.name for parameter in parameters if parameter.name not in excluded]
    for name in given:
        if name not in valid:
            raise ValueError(f"{setting}: unknown name {name!r}.{nearest(name, valid)} Valid: {', '.join(valid)}.")


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
