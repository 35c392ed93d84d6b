"""
What arguments are called and what they must be, said in words. They come from YAML files and command lines, where a slip is no
syntax error, and are handed on from one constructor to the next.
"""

import contextlib
import difflib
import functools
import inspect
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from numbers import Integral, Real
from typing import Any, NamedTuple, ParamSpec, TypeVar

# ---------------------------------------------------------------------- values


class Rule(NamedTuple):
    """What a value must be, in words and as a test."""

    words: str
    holds: Callable[[Any], bool]


def integer(least: int) -> Rule:
    """:return: the rule for integers, NumPy's included, of at least ``least``"""
    return Rule(
        f"an integer of at least {least}",
        lambda value: isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least,
    )


def number(words: str, holds: Callable[[float], bool]) -> Rule:
    """:return: the rule for numbers, NumPy's included, of which ``holds`` is true"""
    return Rule(words, lambda value: isinstance(value, Real) and not isinstance(value, bool) and holds(float(value)))


def choice(*valid: Any) -> Rule:
    """:return: the rule for values that are among ``valid``"""
    return Rule(f"one of {valid}", lambda value: value in valid)


SHARE = number("a number from 0 to 1", lambda value: 0.0 <= value <= 1.0)
AT_LEAST_0 = number("a finite number of at least 0", lambda value: 0.0 <= value < math.inf)
ABOVE_0 = number("a finite number above 0", lambda value: 0.0 < value < math.inf)


def check(name: str, value: Any, rule: Rule) -> None:
    """
    :param name: how the user calls it
    :param value: what came
    :param rule: what it must be
    :raises ValueError: saying both, and how to write it where the value is only written wrongly
    """
    if not rule.holds(value):
        raise ValueError(f"{name} must be {rule.words}, got {value!r}.{_how_to_write(value, rule)}")


def check_each(rule: Rule, **values: Any) -> None:
    """
    :param rule: what all of them must be
    :param values: by name
    :raises ValueError: see :func:`check`
    """
    for name, value in values.items():
        check(name, value, rule)


def _how_to_write(value: Any, rule: Rule) -> str:
    if not isinstance(value, (str, float)):
        return ""
    with contextlib.suppress(ValueError, OverflowError):
        if isinstance(value, str) and (rule.holds(float(value)) or rule.holds(int(float(value)))):
            # YAML 1.1, which PyYAML reads, takes 1e-2 and 1.0e2 for text
            whole = "" if rule.holds(float(value)) else f"; a whole number has none: {int(float(value))}"
            return f" That is text: leave quotes away, and give an exponent a point and a sign, as in 1.0e-2{whole}."
        if isinstance(value, float) and value.is_integer() and rule.holds(int(value)):
            return f" Write {int(value)}."
    return ""


# ---------------------------------------------------------------------- names


def nearest(name: str, valid: Iterable[str], cutoff: float = 0.4) -> str:
    """:return: a sentence with the most similar name, "" where nothing is; ``cutoff`` 0 always finds one"""
    matches = difflib.get_close_matches(name, list(valid), n=1, cutoff=cutoff)
    return f" Did you mean {matches[0]!r}?" if matches else ""


def check_names(where: str, given: Any, valid: Iterable[str], explained: Mapping[str, str] | None = None) -> None:
    """
    :param where: where they come from, for the message
    :param given: arguments by name
    :param valid: names that there are
    :param explained: what to say of names that are no slips, but belong elsewhere
    :raises ValueError: for a name that is not among them, with the nearest; if ``given`` is no mapping
    """
    if not isinstance(given, Mapping):
        raise ValueError(f"{where} must be arguments by name (a mapping), got {given!r}.")
    valid = sorted(valid)
    for key in given:
        if key in (explained or {}):
            raise ValueError(f"{where}: {explained[key]}")  # type: ignore[index]
        if key not in valid:
            raise ValueError(f"{where}: unknown key {key!r}.{nearest(str(key), valid)} Valid: {', '.join(valid)}.")


def check_arguments(where: str, given: Any, taker: Callable[..., Any], excluded: Collection[str] = ()) -> None:
    """
    :param where: where they come from, for the message
    :param given: arguments by name; None for none
    :param taker: what they are for
    :param excluded: names of arguments that it gets from elsewhere
    :raises ValueError: see :func:`check_names`, and for those that it gets from elsewhere
    """
    valid = argument_names(taker)
    if given is None or valid is None:
        return
    for key in excluded:
        if isinstance(given, Mapping) and key in given:
            raise ValueError(f"{where}: {key!r} is set elsewhere, leave it out here.")
    check_names(where, given, valid - {*excluded}, getattr(getattr(taker, "__init__", None), "explained", None))


def argument_names(taker: Callable[..., Any]) -> set[str] | None:
    """:return: names of the arguments, of parents as far as they are passed on; None where there is no end of them"""
    functions = (
        [vars(kind)["__init__"] for kind in taker.__mro__ if "__init__" in vars(kind)] if isinstance(taker, type) else [taker]
    )
    names: set[str] = set()
    for function in functions:
        parameters = inspect.signature(function).parameters.values()
        collecting = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
        names |= {parameter.name for parameter in parameters if parameter.kind not in collecting} - {"self"}
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            return names
    return None


@contextlib.contextmanager
def error_prefix(where: str) -> Iterator[None]:
    """
    For constructors that do not know what their arguments were read from.

    :param where: is put before the message of a ValueError
    """
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


P = ParamSpec("P")
R = TypeVar("R")


def names_checked(**explained: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """
    For constructors: an argument that there is not becomes a ValueError that names the nearest, which Python's TypeError does
    not do.

    :param explained: what to say of names that are no slips, but belong elsewhere
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        valid = set(inspect.signature(function).parameters) - {"self"}

        @functools.wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            if not kwargs.keys() <= valid:
                check_names(type(args[0]).__name__, kwargs, valid, explained)
            return function(*args, **kwargs)

        checked.explained = explained  # type: ignore[attr-defined]
        return checked

    return decorate
