"""
The state of the curator and its parts as plain data: every attribute of every object, so that none can be forgotten.

What an object is made of (which options, which functions) comes from its constructor; what it has come to know since is this.
"""

import copy
from typing import Any


def state_of(value: Any) -> Any:
    """
    :param value: an object of this package: its attributes, theirs if they are such objects, and so on; or a value
    :return: nested dicts of copies of the values; functions are left out
    """
    if _has_state(value):
        return {name: state_of(part) for name, part in vars(value).items() if not _is_function(part)}
    if type(value) is dict:
        return {name: state_of(part) for name, part in value.items()}
    if type(value) in (list, tuple):
        return type(value)(state_of(part) for part in value)
    return copy.deepcopy(value)


def restored(value: Any, state: Any, name: str = "") -> Any:
    """
    :param value: as :func:`state_of` takes it; objects are changed in place. Attributes that the state does not have, since
        its writer was older, stay as they are
    :param state: what :func:`state_of` returned
    :param name: of the value, for messages
    :return: the value with that state
    :raises ValueError: for attributes that the object does not have
    """
    if _has_state(value):
        unknown = sorted({*state} - {*vars(value)}) if type(state) is dict else [repr(state)]
        if unknown:
            raise ValueError(f"The saved {name or 'state'} has {', '.join(unknown)}, unknown to this version of sb3_cpm.")
        for key, part in state.items():
            object.__setattr__(value, key, restored(vars(value)[key], part, f"{name}.{key}".lstrip(".")))  # frozen, perhaps
        return value
    if type(value) is type(state) is dict and any(map(_has_state, value.values())):
        return {key: restored(value.get(key), part, f"{name}[{key!r}]") for key, part in state.items()}
    if type(value) is type(state) and type(value) in (list, tuple) and any(map(_has_state, value)):
        parts = zip(value, state, strict=True)
        return type(value)(restored(one, part, f"{name}[{i}]") for i, (one, part) in enumerate(parts))
    return copy.deepcopy(state)


def _has_state(value: Any) -> bool:
    return type(value).__module__.partition(".")[0] == __name__.partition(".")[0] and hasattr(value, "__dict__")


def _is_function(value: Any) -> bool:
    return callable(value) and not _has_state(value)
