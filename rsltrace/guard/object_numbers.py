"""An order for objects that have none: numbers, given when a set with them is gone through.

Where an object lies in memory decides its place in a set. Those that are met for the first time
together are told apart by what they hold (names, numbers, positions), and get a number each that
they keep, whatever becomes of them. Objects that hold the same cannot be told apart.
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
"""What is looked at of one object; what differs only beyond that cannot be told apart."""
_CHARACTERS_MAX = 1000
_ARRAY_BYTES_MAX = 1 << 16
_PLAIN = (str, bytes, int, float, bool, complex, type(None))
_GENERIC = (types.GenericAlias, types.UnionType)
_FRAMES = {types.GeneratorType: "gi_frame", types.CoroutineType: "cr_frame"}
"""What is under way, and where it keeps its variables."""
_BUILT_IN = (types.BuiltinMethodType, types.MethodWrapperType)
_address = object.__hash__  # as id(), but no audit hook is told of it


class ObjectNumbers:
    """Numbers of the objects of one run, kept for as long as an object lives."""

    def __init__(self) -> None:
        self._kept: dict[int, tuple[weakref.ref[Any], int]] = {}
        self._next = itertools.count().__next__

    def in_order(self, things: Iterable[Any]) -> list[Any] | None:
        """Return things in an order that does not depend on addresses; None if there is none."""
        known: list[tuple[int, Any]] = []
        new: dict[str, Any] = {}
        for thing in things:
            number = self._number(thing)
            if number is not None:
                known.append((number, thing))
                continue
            text = self._text_of(thing)
            if text in new:
                return None
            new[text] = thing
        known.sort(key=lambda pair: pair[0])
        first = [new[text] for text in sorted(new)]
        for thing in first:
            self._keep(thing)
        return [thing for _, thing in known] + first

    def _number(self, thing: Any) -> int | None:
        kept = self._kept.get(_address(thing))
        if kept is None and isinstance(thing, weakref.ref):
            thing = thing()
            kept = self._kept.get(_address(thing))
        return kept[1] if kept is not None and kept[0]() is thing else None

    def _keep(self, thing: Any) -> None:
        thing = _referent(thing)
        if isinstance(thing, (*_PLAIN, types.MethodType)):
            return
        key, kept = _address(thing), self._kept

        def forget(gone: weakref.ref[Any]) -> None:
            if key in kept and kept[key][0] is gone:
                del kept[key]

        try:
            kept[key] = weakref.ref(thing, forget), self._next()
        except TypeError:
            pass  # it takes no weak reference, so it is looked at each time

    def _text_of(self, thing: Any, depth: int = 0) -> str:
        parts: list[str] = []
        self._describe(thing, parts, depth)
        return ",".join(parts)

    def _describe(self, thing: Any, parts: list[str], depth: int) -> None:
        """Write down what tells an object apart, without asking its own code."""
        thing = _referent(thing)
        kind = type(thing)
        if len(parts) >= _PARTS_MAX:
            return
        if kind in _PLAIN:
            start = thing[:_CHARACTERS_MAX] if kind in (str, bytes) else thing
            parts.append(f"{kind.__name__} {start!r}")
            if start is not thing:
                parts.append(str(len(thing)))
        elif kind is types.MethodType:
            parts.append(f"method {thing.__func__.__qualname__}")
            self._describe(thing.__self__, parts, depth + 1)
        elif kind in _GENERIC:
            parts.append(kind.__name__)
            self._describe([getattr(thing, "__origin__", None), thing.__args__], parts, depth + 1)
        elif kind in _FRAMES:
            frame = getattr(thing, _FRAMES[kind])
            held = {} if frame is None else dict(frame.f_locals)
            self._describe([thing.__qualname__, held], parts, depth + 1)
        elif _is_task(kind):
            padded = re.sub(r"[0-9]+", lambda number: number[0].zfill(12), thing.get_name())
            parts.append(f"task {padded}")  # they are counted when they are made
        elif kind in _BUILT_IN and not isinstance(thing.__self__, types.ModuleType):
            parts.append(f"{kind.__name__} {thing.__name__}")
            self._describe(thing.__self__, parts, depth + 1)
        elif isinstance(thing, (type, types.FunctionType, types.BuiltinFunctionType)):
            line = thing.__code__.co_firstlineno if isinstance(thing, types.FunctionType) else 0
            parts.append(f"{kind.__name__} {thing.__module__}.{thing.__qualname__} {line}")
            if isinstance(thing, types.FunctionType) and depth < _DEPTH_MAX:
                self._describe(_bound_in(thing), parts, depth + 1)
        elif isinstance(thing, (types.ModuleType, enum.Enum)):
            name = thing.__name__ if isinstance(thing, types.ModuleType) else thing.name
            parts.append(f"{kind.__name__} {name}")
        elif isinstance(thing, np.ndarray):
            data = thing.tobytes().hex() if _has_plain_data(thing) else ""
            parts.append(f"{thing.dtype.str}{thing.shape}{data}")
        elif self._number(thing) is not None and depth:
            parts.append(f"object {self._number(thing)}")
        else:
            self._describe_object(thing, parts, depth)

    def _describe_object(self, thing: Any, parts: list[str], depth: int) -> None:
        kind = type(thing)
        parts.append(f"{kind.__module__}.{kind.__qualname__}")
        if depth >= _DEPTH_MAX:
            return
        if kind is partial:
            thing, kind = [thing.func, thing.args, thing.keywords], list
        if isinstance(thing, (set, frozenset)):
            parts.append(str(len(thing)))
            parts.extend(sorted(self._text_of(one, depth + 1) for one in thing))
            return
        if isinstance(thing, (list, tuple)):
            parts.append(str(len(thing)))
            held: Iterable[tuple[Any, Any]] = enumerate(thing)
        elif isinstance(thing, Mapping) and kind in (dict, types.MappingProxyType):
            parts.append(str(len(thing)))
            held = thing.items()
        else:
            held = attributes_of(thing).items()
        for name, value in held:
            if len(parts) >= _PARTS_MAX:
                return
            if isinstance(name, str):
                parts.append(name)
            self._describe(value, parts, depth + 1)


class TextNumbers:
    """Numbers of the objects that were shown in a text, by the node that first did."""

    def __init__(self) -> None:
        self._kept: dict[int, tuple[Callable[[], Any], int]] = {}
        self._last: Counter[str] = Counter()

    def number(self, node: str, thing: Any) -> int | None:
        """Return an object's number, the next of the node if it has none; None for those that
        cannot be recognised, since they take no weak reference."""
        key, kept = _address(thing), self._kept
        found = kept.get(key)
        if found is not None and found[0]() is thing:
            return found[1]
        self._last[node] += 1
        number = self._last[node]

        def forget(gone: weakref.ref[Any]) -> None:
            if key in kept and kept[key][1] == number:
                del kept[key]

        try:
            kept[key] = weakref.ref(thing, forget), number
        except TypeError:
            if type(thing) is not object:  # of these, most are kept anyway, as marks
                return None
            kept[key] = (lambda: thing), number
        return number


def _referent(thing: Any) -> Any:
    """Return what a weak reference refers to, whose hash it has; another object is itself."""
    return thing() if isinstance(thing, weakref.ref) else thing


def _is_task(kind: type) -> bool:
    asyncio = sys.modules.get("asyncio")
    return asyncio is not None and issubclass(kind, asyncio.Task)


def _bound_in(function: types.FunctionType) -> list[Any]:
    """Return what tells functions of one line apart: default values, variables around them."""
    held = []
    for cell in function.__closure__ or ():
        with suppress(ValueError):  # it is empty
            held.append(cell.cell_contents)
    return [function.__defaults__, function.__kwdefaults__, held]


def _has_plain_data(array: np.ndarray[Any, Any]) -> bool:
    return not array.dtype.hasobject and array.nbytes <= _ARRAY_BYTES_MAX
