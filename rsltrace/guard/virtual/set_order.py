"""Iteration over sets in a deterministic order.

A set of strings is in the order of their hashes, a set of objects in that of their addresses; both
differ from process to process. Every iteration (loops, ``sorted``, ``Counter``,
``itertools.chain``) asks the type for an iterator. So during a run the set types look up
``__iter__`` by name, like any class with its own, and find a replacement. The same goes for code
that walks the set's table: ``pop``, ``dict.fromkeys``, pickling, and lists made of sets from Python
3.13 on.

Rejected: compile user modules with a call at each loop. It misses functions in C and in libraries.
"""

from __future__ import annotations

import io
import operator
import pickle
import reprlib
import sys
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import chain
from types import FrameType
from typing import Any

from rsltrace.guard import frames
from rsltrace.guard.addresses import has_address_hash
from rsltrace.guard.callers import FILE_OWNERS, OURS
from rsltrace.guard.frames import caller, code_of, replace_member, replace_special_method
from rsltrace.guard.guard import Guard, engage, engaged
from rsltrace.guard.redirect import redirect
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource

_ORDER, _ALLOW, _VIRTUAL = NondeterminismSource.ORDER, GuardMode.ALLOW, GuardMode.VIRTUAL
_TYPES: tuple[type, ...] = (set, frozenset)
_NUMBERS = frozenset((int, float, bool))
"""Their positions in a set are the same in every process, unless one is NaN."""
_TEXTS = frozenset((str,))
_TUPLES = frozenset((tuple,))
_PLAIN = (str, bytes, int, float, bool, type(None))
_PICKLED_SETS = (pickle.EMPTY_SET, b"__builtin__\nset\n", b"builtins\nset\n")
"""The bytes that stand for a set in a pickle, by protocol; elsewhere they may mean anything."""
LISTS_READ_SETS = sys.version_info >= (3, 13)
"""Whether Python makes lists of sets without asking for an iterator."""

_through_set, _through_frozen = set.__iter__, frozenset.__iter__
"""Python's own iteration over a set and a frozenset."""


def _iterating(real: Callable[[Any], Iterator[Any]]) -> Callable[[Any], Iterator[Any]]:
    def __iter__(self: Any, /) -> Iterator[Any]:  # noqa: N807
        if len(self) > 1:
            guard = engaged()
            if guard is not None and not _are_numbers(real(self), real(self)):
                try:
                    frame = frames.next_caller()
                except frames.INTERRUPTED:
                    frame = frames.lost_caller()
                in_order = _order(guard, self, frame)
                if in_order is not None:
                    return _iterate(self, in_order)
        return real(self)

    return __iter__


def _are_numbers(items: Iterable[Any], again: Iterable[Any]) -> bool:
    """Return whether the order of a set of ``items`` is the same in every process."""
    kinds = {*map(type, items)}
    return _NUMBERS.issuperset(kinds) and not (
        float in kinds and any(item != item for item in again)  # NaN
    )


def _elements_in_order(obj: Any) -> list[Any] | None:
    """Return the elements of a set in a fixed order, or None if Python's order stays."""
    if len(obj) < 2 or _are_numbers(_unordered(obj), _unordered(obj)):
        return None
    guard = engaged()
    return None if guard is None else _order(guard, obj, caller())


def _unordered(obj: Any) -> Iterator[Any]:
    """Iterate over a set as Python does."""
    return _through_frozen(obj) if isinstance(obj, frozenset) else _through_set(obj)


def _order(guard: Guard, obj: Any, frame: FrameType | None) -> list[Any] | None:
    """Return the elements in order if user code, or what it calls at ``frame``, iterates."""
    if (
        frame is None
        or FILE_OWNERS[code_of(frame).co_filename] == OURS
        or guard.user_frame_of(frame) is None
    ):
        return None
    mode = guard.mode(_ORDER, frame)
    if mode is _ALLOW:
        return None
    items = [*_unordered(obj)]
    are_texts = _TEXTS.issuperset(map(type, items))
    if not are_texts and (_are_tuples_of_numbers(items) or not any(map(_has_no_order, items))):
        return None
    if mode is _VIRTUAL:
        in_order = sorted(items) if are_texts else _in_order(guard, items)
        if in_order is not None:  # else: objects that differ in nothing but their addresses
            guard.count_call(_ORDER, "order of a set", frame)
            return in_order
    kinds = ", ".join(sorted(dict.fromkeys(type(_referent(one)).__qualname__ for one in items)))
    guard.report_user_call(
        _ORDER, f"order of a {type(obj).__name__} of {kinds}", f"{len(items)} elements", frame
    )
    return None


def _are_tuples_of_numbers(items: list[Any]) -> bool:
    return _TUPLES.issuperset(map(type, items)) and _are_numbers(
        chain.from_iterable(items), chain.from_iterable(items)
    )


def _in_order(guard: Guard, items: list[Any]) -> list[Any] | None:
    try:
        return sorted(items, key=_key)
    except TypeError:
        with engage(None):
            return guard.numbers.in_order(items)


def _has_no_order(item: object) -> bool:
    """Whether an element's position in a set differs from process to process, pinned or not."""
    return isinstance(item, (str, bytes)) or has_address_hash(item)


def _key(item: Any) -> tuple[str, Any]:
    kind = type(item)
    if kind in _PLAIN and item == item:
        return kind.__name__, item
    if kind is tuple:
        return "tuple", tuple(map(_key, item))
    raise TypeError


def _referent(item: Any) -> Any:
    return item() if isinstance(item, weakref.ref) else item


def _iterate(obj: Any, in_order: list[Any]) -> Iterator[Any]:
    """Iterate in order; like a set, raise if its size changes meanwhile."""
    size = len(obj)
    for item in in_order:
        if len(obj) != size:
            raise RuntimeError("Set changed size during iteration")
        yield item


def _popping(real: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def pop(self: Any, /) -> Any:
        in_order = _elements_in_order(self)
        if in_order is None:
            return real(self)
        self.remove(in_order[0])
        return in_order[0]

    return pop


def _from_keys(real: Any) -> Any:
    def fromkeys(cls: Any, iterable: Iterable[Any], value: Any = None, /) -> Any:
        return real.__get__(None, cls)(in_set_order(iterable), value)

    return classmethod(fromkeys)


def _dumping(real: Callable[..., bytes]) -> Callable[..., bytes]:
    def dumps(obj: Any, *arguments: Any, **options: Any) -> bytes:
        data = real(obj, *arguments, **options)
        guard = engaged()
        if guard is None or not any(mark in data for mark in _PICKLED_SETS):
            return data
        if guard.user_frame_of(caller()) is None:
            return data
        file = io.BytesIO()
        pickle._Pickler(file, *arguments, **options).dump(obj)
        return file.getvalue()

    return dumps


def _dumping_into(real: Callable[..., None]) -> Callable[..., None]:
    def dump(obj: Any, file: Any, *arguments: Any, **options: Any) -> None:
        if engaged() is None:
            real(obj, file, *arguments, **options)
        else:
            file.write(pickle.dumps(obj, *arguments, **options))

    return dump


def in_set_order(obj: Any) -> Any:
    """Return a list in order in place of a set, for code that would not ask it for an iterator."""
    return [*iter(obj)] if type(obj) in _TYPES else obj


# -- from Python 3.13 on -------------------------------------------------------------------------


def _making(real: Callable[..., Any]) -> Callable[..., Any]:
    def make(*arguments: Any, **options: Any) -> Any:
        if arguments and type(arguments[-1]) in _TYPES:
            arguments = (*arguments[:-1], in_set_order(arguments[-1]))
        return real(*arguments, **options)

    return make


def _reducing(real: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def __reduce__(self: Any, /) -> Any:  # noqa: N807
        kind, elements, state = real(self)
        in_order = _elements_in_order(self)
        return kind, elements if in_order is None else (in_order,), state

    return __reduce__


def _showing(real: Callable[[Any], str]) -> Callable[[Any], str]:
    @reprlib.recursive_repr("set(...)")
    def __repr__(self: Any, /) -> str:  # noqa: N807
        in_order = _elements_in_order(self)
        if in_order is None:
            return real(self)
        inside = "{" + ", ".join(map(repr, in_order)) + "}"
        return inside if type(self) is set else f"{type(self).__name__}({inside})"

    return __repr__


@contextmanager
def ordered_sets() -> Iterator[None]:
    """Let user code iterate over sets in order."""
    with ExitStack() as stack:
        for kind in _TYPES:
            replace_special_method(stack, kind, "__iter__", _iterating)
        replace_member(stack, set, "pop", _popping)
        replace_member(stack, dict, "fromkeys", _from_keys)
        redirect(stack, pickle.dumps, _dumping)
        redirect(stack, pickle.dump, _dumping_into)
        if LISTS_READ_SETS:
            for function in (sorted, operator.iadd):
                redirect(stack, function, _making)
            replace_special_method(stack, list, "__init__", _making)
            for name in ("extend", "__iadd__"):
                replace_member(stack, list, name, _making)
            for kind in _TYPES:
                replace_special_method(stack, kind, "__repr__", _showing)
                replace_member(stack, kind, "__reduce__", _reducing)
        yield
