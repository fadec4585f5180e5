"""The functions of expressions: this list, and nothing else.

``np.NAME`` and ``math.NAME`` are spellings of names in it; no module is ever reached. Functions get
the budget first.
"""

from __future__ import annotations

import ast
import builtins
import math
from collections.abc import Callable, Mapping
from types import GeneratorType
from typing import Any

from rsltrace.checks.conditions.bounds import INT_BITS_MAX, LimitError, StepBudget, within_limits
from rsltrace.checks.conditions.operators import BINARY, fits, is_array, numeric, plain

Function = Callable[..., Any]

CONSTANTS: Mapping[str, float] = {
    "pi": math.pi,
    "e": math.e,
    "tau": math.tau,
    "inf": math.inf,
    "nan": math.nan,
}

# -- sequences -------------------------------------------------------------------------------------


def items(budget: StepBudget, value: Any) -> Any:
    """Return a value to be gone through, and pay for it. Items of an array are plain numbers.

    :raises TypeError: it is no sequence.
    """
    if is_array(value):
        budget.spend(len(value) >> 5)
        return value.tolist() if value.ndim == 1 else value
    if type(value) is not GeneratorType:
        if isinstance(value, (set, frozenset)):
            raise TypeError("a set has no order: say sorted(...)")
        budget.spend(len(value) >> 5)
    return value


def _listed(budget: StepBudget, value: Any) -> list[Any]:
    if type(value) is GeneratorType:
        return list(value)  # each step of it has paid
    budget.spend(len(value))
    return list(items(budget, value) if is_array(value) else value)


def _extreme(name: str) -> Function:
    builtin = getattr(builtins, name)

    def extreme(budget: StepBudget, *values: Any, **options: Any) -> Any:
        if set(options) - {"default"}:
            raise TypeError(f"{name} takes default= at most")
        if len(values) == 1:
            value = values[0]
            if is_array(value) and value.ndim == 1 and value.size and value.dtype.kind in "biuf":
                budget.spend(value.size >> 8)
                found = getattr(value, name)()
                if found == found:  # else it depends on where nan stands, as in Python
                    return found.item()
            if isinstance(value, (set, frozenset)):
                return builtin(value, **options)
            return builtin(items(budget, value), **options)
        return builtin(*values)

    return extreme


def _truth(name: str) -> Function:
    builtin = getattr(builtins, name)

    def truth(budget: StepBudget, value: Any) -> Any:
        if is_array(value):
            budget.spend(value.size >> 8)
            return bool(getattr(value, name)())
        return builtin(items(budget, value))

    return truth


def _sum(budget: StepBudget, value: Any, start: Any = 0) -> Any:
    value = items(budget, value)
    add = BINARY[ast.Add]
    if type(value) is list and (not value or type(value[0]) in (int, float, bool)):
        return within_limits(sum(value, start))
    for one in value:
        start = add(budget, start, one)
    return start


def _of_list(make: Callable[[list[Any]], Any]) -> Function:
    def compute(budget: StepBudget, value: Any = ()) -> Any:
        return make(_listed(budget, value))

    return compute


def _sorted(budget: StepBudget, value: Any, *, reverse: bool = False) -> list[Any]:
    return sorted(_listed(budget, value), reverse=reverse)


def _reversed(budget: StepBudget, value: Any) -> list[Any]:
    return _listed(budget, value)[::-1]


def _enumerate(budget: StepBudget, value: Any, start: int = 0) -> list[tuple[int, Any]]:
    return list(enumerate(_listed(budget, value), start))


def _zip(budget: StepBudget, *values: Any) -> list[tuple[Any, ...]]:
    return list(zip(*(_listed(budget, value) for value in values), strict=False))


def _range(budget: StepBudget, *bounds: int) -> range:
    found = range(*bounds)
    try:
        size = len(found)
    except OverflowError:
        size = 2**63
    budget.make(size)
    return found


def _tolist(budget: StepBudget, value: Any) -> list[Any]:
    if is_array(value):
        budget.spend(value.size)
        found: list[Any] = value.tolist()
        return found
    return _listed(budget, value)


def _same(builtin: Callable[..., Any]) -> Function:
    """A function of Python's that costs nothing."""

    def compute(budget: StepBudget, value: Any) -> Any:
        return builtin(value)

    return compute


# -- numbers ---------------------------------------------------------------------------------------


def _round(budget: StepBudget, value: Any, ndigits: int | None = None) -> Any:
    if ndigits is not None and abs(ndigits) > INT_BITS_MAX:
        raise LimitError(f"it rounds to {ndigits} digits (at most {INT_BITS_MAX})")
    return round(value) if ndigits is None else round(value, ndigits)


def _int(budget: StepBudget, value: Any = 0, base: int = 10) -> int:
    if isinstance(value, str):
        if len(value) > INT_BITS_MAX:
            raise LimitError(f"it makes a number of more than {INT_BITS_MAX} bits")
        return int(value, base)
    return int(value)


def _float(budget: StepBudget, value: Any = 0.0) -> float:
    return float(value)


def _bool(budget: StepBudget, value: Any = False) -> bool:
    return bool(value)


def _str(budget: StepBudget, value: Any = "") -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, (int, float, bool, type(None))) or (is_array(value) and not value.ndim):
        return str(value)
    raise TypeError(f"str is for numbers here, not for {type(value).__name__}")


def _divmod(budget: StepBudget, a: Any, b: Any) -> tuple[Any, Any]:
    return BINARY[ast.FloorDiv](budget, a, b), BINARY[ast.Mod](budget, a, b)


def _prod(budget: StepBudget, value: Any, start: Any = 1) -> Any:
    multiply = BINARY[ast.Mult]
    for one in items(budget, value):
        start = multiply(budget, start, one)
    return start


# -- texts -----------------------------------------------------------------------------------------


def _text(name: str) -> Function:
    def of_text(budget: StepBudget, value: Any, *words: Any) -> Any:
        if type(value) is not str or not all(type(word) in (str, tuple) for word in words):
            raise TypeError(f"{name} is for texts")
        return getattr(str, name)(value, *words)

    return of_text


# -- of one number, or of arrays -------------------------------------------------------------------


def _of_math(name: str) -> Function:
    function = getattr(math, name)

    def compute(budget: StepBudget, *values: Any) -> Any:
        return within_limits(function(*values))

    return compute


def _of_many(name: str) -> Function:
    """A function of math that takes a sequence."""
    function = getattr(math, name)

    def compute(budget: StepBudget, *values: Any) -> Any:
        return function(*(items(budget, value) for value in values))

    return compute


def _of_numpy(name: str, takes: int = 1) -> Function:
    """A function of numpy whose result is not larger than what it is given: ``takes`` so many
    numbers and arrays at most, so that none of them is where it writes to."""

    def compute(budget: StepBudget, *values: Any, axis: int | None = None) -> Any:
        import numpy

        if len(values) > takes:
            raise TypeError(f"{name} takes {takes} values at most")
        numbers = []
        for value in values:
            value = list(value) if type(value) is GeneratorType else value
            one = numeric(value, name)
            budget.spend(getattr(one, "size", 1) >> 6)
            numbers.append(one)
        for one in numbers[1:]:
            fits(numbers[0], one)
        function: Any = numpy
        for part in name.split("."):
            function = getattr(function, part)
        options = {} if axis is None else {"axis": int(axis)}
        return plain(function(*numbers, **options))

    return compute


def _diff(budget: StepBudget, value: Any, n: int = 1) -> Any:
    if n > _DIFFERENCES_MAX:
        raise LimitError(f"it takes {n} differences (at most {_DIFFERENCES_MAX})")
    for _ in range(n):
        value = _of_numpy("diff")(budget, value)
    return value


_DIFFERENCES_MAX = 10


def _of_either(name: str) -> Function:
    """A function of math for numbers, of numpy for arrays."""
    of_number = getattr(math, name)
    of_array = _of_numpy(_NAMED_IN_NUMPY.get(name, name), 2 if name in _OF_TWO else 1)

    def compute(budget: StepBudget, *values: Any) -> Any:
        for value in values:
            if type(value) is not float and is_array(value) and value.ndim:
                return of_array(budget, *values)
        return of_number(*values)

    return compute


_OF_NUMBERS = (
    "acos acosh asin asinh atan atan2 atanh ceil copysign cos cosh degrees exp expm1 fabs floor "
    "fmod hypot isfinite isinf isnan log log10 log1p log2 radians sin sinh sqrt tan tanh trunc"
).split()
_OF_TWO = ("atan2", "copysign", "fmod", "hypot")
_NAMED_IN_NUMPY = {
    name: name.replace("a", "arc", 1)
    for name in ("acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh")
}
_ONLY_OF_MATH = "isclose remainder ldexp isqrt erf erfc gamma lgamma".split()
_OF_SEQUENCES = "dist fsum".split()
_OF_ARRAYS = {
    **dict.fromkeys("count_nonzero nan_to_num unique".split(), 1),
    **dict.fromkeys("argmax argmin cross cumsum dot mean median nanmax nanmean nanmin".split(), 2),
    **dict.fromkeys("nanstd nansum percentile quantile std var".split(), 2),
    **dict.fromkeys("clip where".split(), 3),
}
"""How many values each takes."""
_ONLY_OF_NUMPY = {
    **dict.fromkeys("abs absolute array asarray cbrt deg2rad fabs rad2deg sign square".split(), 1),
    **dict.fromkeys("logical_not rint signbit".split(), 1),
    **dict.fromkeys("all any array_equal flip isin logical_and logical_or max maximum".split(), 2),
    **dict.fromkeys("min minimum nanargmax nanargmin nanmedian power ptp round sort".split(), 2),
    **dict.fromkeys("amax amin float_power mod searchsorted subtract sum".split(), 2),
    **dict.fromkeys("interp".split(), 3),
    **dict.fromkeys("allclose isclose".split(), 4),
    "linalg.norm": 2,
}
_OF_NUMPY = {**_OF_ARRAYS, **_ONLY_OF_NUMPY}

FUNCTIONS: dict[str, Function] = {
    "abs": _same(abs),
    "all": _truth("all"),
    "any": _truth("any"),
    "bool": _bool,
    "bytes": _of_list(bytes),
    "chr": _same(chr),
    "divmod": _divmod,
    "enumerate": _enumerate,
    "float": _float,
    "hex": _same(hex),
    "int": _int,
    "len": _same(len),
    "list": _of_list(list),
    "max": _extreme("max"),
    "min": _extreme("min"),
    "norm": _of_numpy("linalg.norm", 2),
    "ord": _same(ord),
    "pow": BINARY[ast.Pow],
    "prod": _prod,
    "range": _range,
    "reversed": _reversed,
    "round": _round,
    "set": _of_list(frozenset),
    "sorted": _sorted,
    "str": _str,
    "sum": _sum,
    "tuple": _of_list(tuple),
    "zip": _zip,
    "diff": _diff,
    **{name: _of_either(name) for name in _OF_NUMBERS},
    **{name: _of_numpy(name, takes) for name, takes in _OF_ARRAYS.items()},
    **{name: _of_many(name) for name in _OF_SEQUENCES},
    **{name: _of_math(name) for name in _ONLY_OF_MATH},
}
"""By name."""

OF_FLOATS: Mapping[Function, Callable[[float], Any]] = {
    FUNCTIONS[name]: getattr(math, name, abs)
    for name in "abs cos fabs isfinite isinf isnan sin sqrt".split()
}
"""What some of them are of a single ``float``, which needs no bounds."""

OF_MODULES: dict[str, dict[str, Function]] = {
    "math": {
        **{name: FUNCTIONS[name] for name in (*_OF_NUMBERS, *_ONLY_OF_MATH, *_OF_SEQUENCES)},
        "pow": BINARY[ast.Pow],
        "prod": _prod,
    },
    "np": {
        **{name: _of_numpy(name, takes) for name, takes in _OF_NUMPY.items()},
        **{
            numpy_name: _of_numpy(numpy_name, 2 if name in _OF_TWO else 1)
            for name in _OF_NUMBERS
            for numpy_name in (_NAMED_IN_NUMPY.get(name, name),)
        },
        "diff": _diff,
        "prod": _prod,
    },
}
"""By the name of a module and the name in it: ``np.linalg.norm`` is there, too."""

METHODS: dict[str, Function] = {
    **{
        name: FUNCTIONS[name]
        for name in "all any argmax argmin max mean min round std sum var".split()
    },
    **{name: _text(name) for name in "startswith endswith lower upper strip".split()},
    "tolist": _tolist,
}
"""``ranges.min()`` is another spelling of ``min(ranges)``."""

FUNCTIONS.update({name: METHODS[name] for name in "startswith endswith lower upper strip".split()})
