"""Numbers that put objects in an order of their own when a program iterates over a set of them.

An object's address decides its position in a set. New objects are distinguished by their contents
(names, numbers, positions) and get numbers in that order, which they keep. Objects with equal
contents cannot be distinguished.
"""

from __future__ import annotations

import enum
import itertools
import re
import sys
import types
import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from rsltrace.guard.state.hashing import attributes_of

_DEPTH_MAX = 4
_PARTS_MAX = 500
"""How much of an object is read to distinguish it."""
_CHARACTERS_MAX = 1000
_ARRAY_BYTES_MAX = 1 << 16
_PLAIN = (str, bytes, int, float, bool, complex, type(None))
_VALUES: tuple[Any, ...] = (str, bytes, int, float, complex)
"""Python's values, of which there are subclasses: ``np.str_``, ``np.float64``."""
_GENERIC = (types.GenericAlias, types.UnionType)
_FRAMES = {types.GeneratorType: "gi_frame", types.CoroutineType: "cr_frame"}
"""Types of running code, and the attribute with their variables."""
_BUILT_IN = (types.BuiltinMethodType, types.MethodWrapperType)
_address = object.__hash__  # like id(), without an audit event


class ObjectNumbers:
    """Numbers of the objects of one run, kept while an object lives."""

    def __init__(self) -> None:
        self._kept: dict[int, tuple[weakref.ref[Any], int]] = {}
        self._next = itertools.count().__next__

    def in_order(self, objects: Iterable[Any]) -> list[Any] | None:
        """Return objects in an order that does not depend on addresses; None if there is none."""
        known: list[tuple[int, Any]] = []
        new: dict[str, Any] = {}
        for obj in objects:
            number = self._number(obj)
            if number is not None:
                known.append((number, obj))
                continue
            text = self._text_of(obj)
            if text in new:
                return None
            new[text] = obj
        known.sort(key=lambda pair: pair[0])
        first = [new[text] for text in sorted(new)]
        for obj in first:
            self._keep(obj)
        return [obj for _, obj in known] + first

    def _number(self, obj: Any) -> int | None:
        kept = self._kept.get(_address(obj))
        if kept is None and isinstance(obj, weakref.ref):
            obj = obj()
            kept = self._kept.get(_address(obj))
        return kept[1] if kept is not None and kept[0]() is obj else None

    def _keep(self, obj: Any) -> None:
        obj = _referent(obj)
        if isinstance(obj, (*_PLAIN, types.MethodType)):
            return
        key, kept = _address(obj), self._kept

        def forget(gone: weakref.ref[Any]) -> None:
            if key in kept and kept[key][0] is gone:
                del kept[key]

        try:
            kept[key] = weakref.ref(obj, forget), self._next()
        except TypeError:
            pass  # it takes no weak reference, so it is looked at each time

    def _text_of(self, obj: Any, depth: int = 0) -> str:
        parts: list[str] = []
        self._describe(obj, parts, depth)
        return ",".join(parts)

    def _describe(self, obj: Any, parts: list[str], depth: int) -> None:
        """Append what distinguishes an object, without running its own code."""
        obj = _referent(obj)
        kind = type(obj)
        if len(parts) >= _PARTS_MAX:
            return
        if kind in _PLAIN:
            start = obj[:_CHARACTERS_MAX] if kind in (str, bytes) else obj
            parts.append(f"{kind.__name__} {start!r}")
            if start is not obj:
                parts.append(str(len(obj)))
        elif isinstance(obj, _VALUES) and not isinstance(obj, enum.Enum):
            parts.append(f"{kind.__module__}.{kind.__qualname__}")
            value = next(base for base in _VALUES if isinstance(obj, base))
            self._describe(value.__getnewargs__(obj), parts, depth + 1)
        elif kind is types.MethodType:
            parts.append(f"method {obj.__func__.__qualname__}")
            self._describe(obj.__self__, parts, depth + 1)
        elif kind in _GENERIC:
            parts.append(kind.__name__)
            self._describe([getattr(obj, "__origin__", None), obj.__args__], parts, depth + 1)
        elif kind in _FRAMES:
            frame = getattr(obj, _FRAMES[kind])
            held = {} if frame is None else dict(frame.f_locals)
            self._describe([obj.__qualname__, held], parts, depth + 1)
        elif _is_task(kind):
            padded = re.sub(r"[0-9]+", lambda number: number[0].zfill(12), obj.get_name())
            parts.append(f"task {padded}")  # they are counted when they are made
        elif kind in _BUILT_IN and not isinstance(obj.__self__, types.ModuleType):
            parts.append(f"{kind.__name__} {obj.__name__}")
            self._describe(obj.__self__, parts, depth + 1)
        elif isinstance(obj, (type, types.FunctionType, types.BuiltinFunctionType)):
            line = obj.__code__.co_firstlineno if isinstance(obj, types.FunctionType) else 0
            parts.append(f"{kind.__name__} {obj.__module__}.{obj.__qualname__} {line}")
            if isinstance(obj, types.FunctionType) and depth < _DEPTH_MAX:
                self._describe(_bound_in(obj), parts, depth + 1)
        elif isinstance(obj, (types.ModuleType, enum.Enum)):
            name = obj.__name__ if isinstance(obj, types.ModuleType) else obj.name
            parts.append(f"{kind.__name__} {name}")
        elif isinstance(obj, np.ndarray):
            data = obj.tobytes().hex() if _has_plain_data(obj) else ""
            parts.append(f"{obj.dtype.str}{obj.shape}{data}")
        elif self._number(obj) is not None and depth:
            parts.append(f"object {self._number(obj)}")
        else:
            self._describe_object(obj, parts, depth)

    def _describe_object(self, obj: Any, parts: list[str], depth: int) -> None:
        kind = type(obj)
        parts.append(f"{kind.__module__}.{kind.__qualname__}")
        if depth >= _DEPTH_MAX:
            return
        if kind is partial:
            obj, kind = [obj.func, obj.args, obj.keywords], list
        if isinstance(obj, (set, frozenset)):
            parts.append(str(len(obj)))
            parts.extend(sorted(self._text_of(one, depth + 1) for one in obj))
            return
        if isinstance(obj, (list, tuple)):
            parts.append(str(len(obj)))
            held: Iterable[tuple[Any, Any]] = enumerate(obj)
        elif isinstance(obj, Mapping) and kind in (dict, types.MappingProxyType):
            parts.append(str(len(obj)))
            held = obj.items()
        else:
            held = attributes_of(obj).items()
        for name, value in held:
            if len(parts) >= _PARTS_MAX:
                return
            if isinstance(name, str):
                parts.append(name)
            self._describe(value, parts, depth + 1)


class TextNumbers:
    """Numbers of objects shown in a text, counted per node."""

    def __init__(self) -> None:
        self._kept: dict[int, tuple[Callable[[], Any], int]] = {}
        self._last: Counter[str] = Counter()
        self.reported = ""
        """The last address that stayed in a text, which is a finding already."""

    def number(self, node: str, obj: Any) -> int | None:
        """Return an object's number, the node's next one if it is new.

        None for objects without weak references: they cannot be recognized again.
        """
        key, kept = _address(obj), self._kept
        found = kept.get(key)
        if found is not None and found[0]() is obj:
            return found[1]
        self._last[node] += 1
        number = self._last[node]

        def forget(gone: weakref.ref[Any]) -> None:
            if key in kept and kept[key][1] == number:
                del kept[key]

        try:
            kept[key] = weakref.ref(obj, forget), number
        except TypeError:
            if type(obj) is not object:  # of these, most are kept anyway, as marks
                return None
            kept[key] = (lambda: obj), number
        return number


def _referent(obj: Any) -> Any:
    """Return the object of a weak reference, which has its hash; others are returned unchanged."""
    return obj() if isinstance(obj, weakref.ref) else obj


def _is_task(kind: type) -> bool:
    asyncio = sys.modules.get("asyncio")
    return asyncio is not None and issubclass(kind, asyncio.Task)


def _bound_in(function: types.FunctionType) -> list[Any]:
    """Return what distinguishes functions of one line: default values and closures."""
    held = []
    for cell in function.__closure__ or ():
        with suppress(ValueError):  # it is empty
            held.append(cell.cell_contents)
    return [function.__defaults__, function.__kwdefaults__, held]


def _has_plain_data(array: np.ndarray[Any, Any]) -> bool:
    return not array.dtype.hasobject and array.nbytes <= _ARRAY_BYTES_MAX
