"""
Python values as JSON and back, exactly: for what pickles would be used for, if they could not execute code.

Numbers, texts, None, lists and dicts are JSON's own. All else is a dict with the key ``"$"``, which says what it is:
tuples, deques, ordered dicts, bytes, arrays and NumPy's scalars, and instances of those dataclasses that the reader names.
"""

import base64
import dataclasses
import io
from collections import OrderedDict, deque
from collections.abc import Collection
from typing import Any

import numpy as np

_KIND = "$"


def pack(value: Any, classes: Collection[type] = (), name: str = "") -> Any:
    """
    :param value: what to store
    :param classes: dataclasses that it may hold
    :param name: what the user calls it, for messages
    :return: what ``json.dumps`` takes and :func:`unpack` gives back
    :raises ValueError: naming the first part that cannot be stored
    """
    if value is None or type(value) in (bool, int, float, str):
        return value
    if type(value) is list:
        return [pack(part, classes, f"{name}[{i}]") for i, part in enumerate(value)]
    if type(value) is dict and all(type(key) is str and key != _KIND for key in value):
        return {key: pack(part, classes, f"{name}[{key!r}]") for key, part in value.items()}
    if type(value) in (dict, OrderedDict):
        items = [[pack(key, classes, name), pack(part, classes, f"{name}[{key!r}]")] for key, part in value.items()]
        return {_KIND: type(value).__name__, "items": items}
    if type(value) in (tuple, deque):
        packed = {_KIND: type(value).__name__, "items": pack(list(value), classes, name)}
        return {**packed, "maxlen": value.maxlen} if type(value) is deque else packed
    if isinstance(value, bytes):
        return {_KIND: "bytes", "base64": _text(value)}
    if isinstance(value, (np.ndarray, np.generic)) and not np.asarray(value).dtype.hasobject:
        file = io.BytesIO()
        np.lib.format.write_array(file, np.asarray(value), allow_pickle=False)
        return {_KIND: "array" if isinstance(value, np.ndarray) else "scalar", "npy": _text(file.getvalue())}
    if type(value) in classes:
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        packed = {key: pack(part, classes, f"{name}.{key}") for key, part in fields.items()}
        return {_KIND: "dataclass", "name": type(value).__name__, "fields": packed}
    raise ValueError(
        f"{name} is a {type(value).__name__} ({value!r:.60}), which a file without pickles cannot hold. Numbers, texts, "
        "arrays, and lists, tuples and dicts of them can be stored."
    )


def unpack(packed: Any, classes: Collection[type] = ()) -> Any:
    """
    :param packed: what :func:`pack` returned; nothing but the constructors of ``classes`` is called for what it holds
    :param classes: dataclasses that it may hold
    :raises ValueError: if it is something else
    """
    if isinstance(packed, list):
        return [unpack(part, classes) for part in packed]
    if not isinstance(packed, dict):
        return packed
    kind = packed.get(_KIND)
    if kind is None:
        return {key: unpack(part, classes) for key, part in packed.items()}
    if kind in ("dict", "OrderedDict"):
        return (dict if kind == "dict" else OrderedDict)(unpack(packed["items"], classes))
    if kind == "tuple":
        return tuple(unpack(packed["items"], classes))
    if kind == "deque":
        return deque(unpack(packed["items"], classes), packed["maxlen"])
    if kind == "bytes":
        return base64.b64decode(packed["base64"])
    if kind in ("array", "scalar"):
        array = np.lib.format.read_array(io.BytesIO(base64.b64decode(packed["npy"])), allow_pickle=False)
        return array if kind == "array" else array[()]
    for known in classes:
        if kind == "dataclass" and packed["name"] == known.__name__:
            return known(**{key: unpack(part, classes) for key, part in packed["fields"].items()})
    raise ValueError(f"There is no {packed.get('name', kind)!r} to be read here.")


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode()
