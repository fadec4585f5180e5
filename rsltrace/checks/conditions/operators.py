"""The operators of expressions, on numbers, texts, sequences and arrays, within bounds."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from typing import Any

from rsltrace.checks.conditions.bounds import (
    INT_BITS_MAX,
    SIZE_MAX,
    LimitError,
    StepBudget,
    within_limits,
)

Operate = Callable[[StepBudget, Any, Any], Any]
_REALS = frozenset((int, float, bool))
_TEXTS = (str, bytes, bytearray)
_SEQUENCES = (list, tuple, range)
_INT64 = range(-(2**63), 2**64)


def is_array(value: object) -> bool:
    """Whether a value is an array, or a number, of numpy's."""
    return type(value).__module__ == "numpy" and hasattr(value, "dtype")


def _binary(sign: str, apply: Callable[[Any, Any], Any], guard: Any = None) -> Operate:
    def operate(budget: StepBudget, a: Any, b: Any) -> Any:
        if type(a) in _REALS and type(b) in _REALS:
            if guard is not None:
                guard(a, b)
            found = apply(a, b)
            return found if type(found) is float else within_limits(found)
        return within_limits(_other(budget, sign, apply, a, b))

    return operate


def _other(budget: StepBudget, sign: str, apply: Callable[[Any, Any], Any], a: Any, b: Any) -> Any:
    """Return what an operator makes of two values that are not both plain numbers."""
    if is_array(a) or is_array(b):
        a, b = numeric(a, sign), numeric(b, sign)
        fits(a, b)
        budget.spend(max(getattr(a, "size", 1), getattr(b, "size", 1)) >> 6)
        return plain(apply(a, b))
    for one in (a, b):
        if isinstance(one, (*_TEXTS, *_SEQUENCES)):
            return _of_sequences(budget, sign, a, b)
    if isinstance(a, (dict, type(None))) or isinstance(b, (dict, type(None))):
        raise _unsupported(sign, a, b)
    return apply(a, b)  # of objects that a node holds: what their class says


def _of_sequences(budget: StepBudget, sign: str, a: Any, b: Any) -> Any:
    if sign == "+" and type(a) is type(b) and type(a) in (str, bytes, list, tuple):
        budget.make(len(a) + len(b), text=isinstance(a, _TEXTS))
        return a + b
    if sign == "*" and type(a) is int:
        a, b = b, a
    if sign == "*" and type(a) in (str, bytes, list, tuple) and type(b) is int:
        budget.make(len(a) * max(b, 0), text=isinstance(a, _TEXTS))
        return a * b
    raise _unsupported(sign, a, b)


def _unsupported(sign: str, a: Any, b: Any) -> TypeError:
    return TypeError(f"{sign} is not for {type(a).__name__} and {type(b).__name__}")


def plain(value: Any) -> Any:
    """Return a number of numpy's as one of Python's, which compares and counts the same whatever
    the release of numpy; anything else as it is."""
    return value.item() if is_array(value) and not value.ndim else value


def numeric(value: Any, what: str) -> Any:
    """Return a value that may be computed with beside arrays: numbers only.

    :raises TypeError: it is none.
    """
    if type(value) is int:
        return value if value in _INT64 else float(value)
    if type(value) in (float, bool):
        return value
    if not is_array(value):
        import numpy

        if not isinstance(value, (list, tuple, range)) or len(value) > SIZE_MAX:
            raise TypeError(f"{what} is not for {type(value).__name__}")
        value = numpy.asarray(value)
    if value.dtype.kind not in "biuf":
        raise TypeError(f"{what} is for numbers only")
    return value


def fits(a: Any, b: Any) -> None:
    """Refuse two arrays that would make a larger one together.

    :raises LimitError: they would.
    """
    if getattr(a, "ndim", 0) > 1 or getattr(b, "ndim", 0) > 1:
        import numpy

        size = 1
        for length in numpy.broadcast_shapes(numpy.shape(a), numpy.shape(b)):
            size *= length
        if size > max(SIZE_MAX, numpy.size(a), numpy.size(b)):
            raise LimitError(f"it makes an array of {size:,} items")


def _powers(a: Any, b: Any) -> None:
    if float in (type(a), type(b)) or b <= 0 or abs(a) <= 1:
        return
    if b * int(a).bit_length() > 2 * INT_BITS_MAX:
        raise LimitError(f"it makes a number of more than {INT_BITS_MAX} bits")


def _shifts(a: Any, b: Any) -> None:
    if b > INT_BITS_MAX:
        raise LimitError(f"it makes a number of more than {INT_BITS_MAX} bits")


BINARY: Mapping[type[ast.operator], Operate] = {
    ast.Add: _binary("+", operator.add),
    ast.Sub: _binary("-", operator.sub),
    ast.Mult: _binary("*", operator.mul),
    ast.Div: _binary("/", operator.truediv),
    ast.FloorDiv: _binary("//", operator.floordiv),
    ast.Mod: _binary("%", operator.mod),
    ast.Pow: _binary("**", operator.pow, _powers),
    ast.LShift: _binary("<<", operator.lshift, _shifts),
    ast.RShift: _binary(">>", operator.rshift),
    ast.BitAnd: _binary("&", operator.and_),
    ast.BitOr: _binary("|", operator.or_),
    ast.BitXor: _binary("^", operator.xor),
}
USUAL: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
"""Those that need no bounds where one side is of 64 bits (``float``)."""
UNARY: Mapping[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.Not: operator.not_,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Invert: operator.invert,
}
COMPARE: Mapping[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
    ast.In: lambda item, among: item in among,
    ast.NotIn: lambda item, among: item not in among,
}


def element(budget: StepBudget, value: Any, index: Any) -> Any:
    """Return ``value[index]``.

    :raises LimitError: it makes too much.
    """
    if is_array(value):
        if index is None or (type(index) is tuple and None in index):
            raise TypeError("an array has numbers, slices and masks as indexes")
        found = value[index]
        if not found.ndim:
            return found.item()
        if not isinstance(index, slice):
            budget.spend(found.size)
        return found
    if type(index) is slice:
        found = value[index]
        budget.make(len(found), text=isinstance(value, _TEXTS))
        return found
    if isinstance(value, type):
        raise TypeError("a class has no elements")
    return value[index]
