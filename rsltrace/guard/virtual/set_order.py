"""Sets in an order of their own, whoever goes through them.

A set of texts is in the order of their hashes, which differ from process to process; a set of
objects in that of their addresses. Whatever goes through a set, a loop as well as ``sorted``,
``Counter`` or ``itertools.chain``, asks its type for an iterator. So the types are told for the
time of a run to ask ``__iter__`` by name (as every class does that has one of its own), and find
one of ours there. What walks the table of a set itself is told in the same way: ``pop``,
``dict.fromkeys``, pickling, and, from Python 3.13 on, lists that are made of sets.

Rejected: compiling user modules with a call of ours at each loop. A function that goes through a
set in C, or in a library, was none the wiser.
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
from rsltrace.guard.callers import KINDS, OURS
from rsltrace.guard.frames import caller, code_of, exchange, replace_special_method
from rsltrace.guard.guard import Guard, engage, engaged
from rsltrace.guard.redirect import redirect
from rsltrace.trace.model.finding import Mode, Source

_ORDER, _ALLOW, _VIRTUAL = Source.ORDER, Mode.ALLOW, Mode.VIRTUAL
_TYPES: tuple[type, ...] = (set, frozenset)
_NUMBERS = frozenset((int, float, bool))
"""Their places in a set are the same in every process."""
_TEXTS = frozenset((str,))
_TUPLES = frozenset((tuple,))
_PLAIN = (str, bytes, int, float, bool, type(None))
_PICKLED_SETS = (pickle.EMPTY_SET, b"__builtin__\nset\n", b"builtins\nset\n")
"""What stands for a set in what is pickled, by protocol; elsewhere it may mean anything."""
LISTS_READ_SETS = sys.version_info >= (3, 13)
"""Whether Python makes lists of sets without asking these for an iterator."""

_through_set, _through_frozen = set.__iter__, frozenset.__iter__
"""What goes through a set, and a frozen one, as Python does."""


def _iterating(real: Callable[[Any], Iterator[Any]]) -> Callable[[Any], Iterator[Any]]:
    def __iter__(self: Any, /) -> Iterator[Any]:  # noqa: N807
        if len(self) > 1:
            guard = engaged()
            if guard is not None and not _NUMBERS.issuperset(map(type, real(self))):
                try:
                    frame = frames.next_caller()
                except frames.INTERRUPTED:
                    frame = frames.lost_caller()
                in_order = _order(guard, self, frame)
                if in_order is not None:
                    return _iterate(self, in_order)
        return real(self)

    return __iter__


def _elements_in_order(thing: Any) -> list[Any] | None:
    """Return the elements of a set in an order that stays, or None if they are left as they are."""
    if len(thing) < 2 or _NUMBERS.issuperset(map(type, _unordered(thing))):
        return None
    guard = engaged()
    return None if guard is None else _order(guard, thing, caller())


def _unordered(thing: Any) -> Iterator[Any]:
    """Go through a set as Python does."""
    return _through_frozen(thing) if isinstance(thing, frozenset) else _through_set(thing)


def _order(guard: Guard, thing: Any, frame: FrameType | None) -> list[Any] | None:
    """Do ``_elements_in_order`` for code of the user and what that calls: ``frame`` is where it is asked."""
    if (
        frame is None
        or KINDS[code_of(frame).co_filename] == OURS
        or guard.user_frame_of(frame) is None
    ):
        return None
    mode = guard.mode(_ORDER, frame)
    if mode is _ALLOW:
        return None
    items = [*_unordered(thing)]
    are_texts = _TEXTS.issuperset(map(type, items))
    if not are_texts and (_are_tuples_of_numbers(items) or not any(map(_has_no_order, items))):
        return None
    if mode is _VIRTUAL:
        in_order = sorted(items) if are_texts else _in_order(guard, items)
        if in_order is not None:  # else: objects that nothing tells apart but their addresses
            guard.count_call(_ORDER, "order of a set", frame)
            return in_order
    kinds = ", ".join(sorted(dict.fromkeys(type(_referent(one)).__qualname__ for one in items)))
    guard.report_user_call(
        _ORDER, f"order of a {type(thing).__name__} of {kinds}", f"{len(items)} elements", frame
    )
    return None


def _are_tuples_of_numbers(items: list[Any]) -> bool:
    return _TUPLES.issuperset(map(type, items)) and _NUMBERS.issuperset(
        map(type, chain.from_iterable(items))
    )


def _in_order(guard: Guard, items: list[Any]) -> list[Any] | None:
    try:
        return sorted(items, key=_key)
    except TypeError:
        with engage(None):
            return guard.numbers.in_order(items)


def _has_no_order(item: object) -> bool:
    """Whether an element's place in a set differs from process to process, pinned or not."""
    return isinstance(item, (str, bytes)) or has_address_hash(item)


def _key(item: Any) -> tuple[str, Any]:
    kind = type(item)
    if kind in _PLAIN:
        return kind.__name__, item
    if kind is tuple:
        return "tuple", tuple(map(_key, item))
    raise TypeError


def _referent(item: Any) -> Any:
    return item() if isinstance(item, weakref.ref) else item


def _iterate(thing: Any, in_order: list[Any]) -> Iterator[Any]:
    """Go through elements in order; like a set, notice when it changes on the way."""
    size = len(thing)
    for item in in_order:
        if len(thing) != size:
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


def in_set_order(thing: Any) -> Any:
    """Return what stands for ``thing`` for those who would go through a set without asking it."""
    return [*iter(thing)] if type(thing) in _TYPES else thing


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
    """Let sets be gone through in order; which guard wants it is asked at each."""
    with ExitStack() as stack:
        for kind in _TYPES:
            replace_special_method(stack, kind, "__iter__", _iterating)
        exchange(stack, set, "pop", _popping)
        exchange(stack, dict, "fromkeys", _from_keys)
        redirect(stack, pickle.dumps, _dumping)
        redirect(stack, pickle.dump, _dumping_into)
        if LISTS_READ_SETS:
            for function in (sorted, operator.iadd):
                redirect(stack, function, _making)
            replace_special_method(stack, list, "__init__", _making)
            for name in ("extend", "__iadd__"):
                exchange(stack, list, name, _making)
            for kind in _TYPES:
                replace_special_method(stack, kind, "__repr__", _showing)
                exchange(stack, kind, "__reduce__", _reducing)
        yield
