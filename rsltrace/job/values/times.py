"""Times in a job are read exactly: text to integer nanoseconds, never through a float.

``0.1`` and ``10.000000001`` have no exact binary float, so the number is taken from the text it was
written as: from the YAML source (``ExactFloat``) or from a Python float's ``repr``.
"""

from __future__ import annotations

import re
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from typing import NamedTuple

from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.job.values.problem import JobProblem, describe
from rsltrace.trace.model.texts import NS_PER_S, format_seconds

# Sizes in a job: a number of bytes, or a number with a unit (``4MiB``).

UNITS = {
    "B": 1,
    "kB": 10**3,
    "MB": 10**6,
    "GB": 10**9,
    "TB": 10**12,
    "KiB": 2**10,
    "MiB": 2**20,
    "GiB": 2**30,
    "TiB": 2**40,
}
SIZE_MAX = 2**63 - 1

SIZE_SCHEMA: dict[str, object] = {
    "x-words": "size",
    "anyOf": [
        {"type": "integer", "minimum": 1},
        {"type": "string", "pattern": r"^\s*[0-9]+(\.[0-9]+)?\s*([kMGT]B|[KMGT]iB|B)\s*$"},
    ],
}

_SIZE_TEXT = re.compile(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([A-Za-z]*)\s*", re.ASCII)
_SIZES_EXPECTED = (
    f"expected a size: a number of bytes, or a number with a unit ({', '.join(UNITS)})"
)


def parse_size(value: object) -> int:
    """Return a size of a job in bytes. Raises ``ValueError`` unless it is a whole number."""
    if isinstance(value, bool) or not isinstance(value, (int, str)):
        raise JobProblem(f"{_SIZES_EXPECTED}, got {describe(value)}")
    if isinstance(value, int):
        return _sizes_checked(Fraction(value), str(value))
    match = _SIZE_TEXT.fullmatch(value)
    if match is None:
        raise JobProblem(f"{_SIZES_EXPECTED}, got {describe(value)}")
    number, unit = match.groups()
    if not unit:
        raise JobProblem(f"{value!r} has no unit: write '{number}B' for bytes")
    if unit not in UNITS:
        near = [known for known in UNITS if known.lower() in (unit.lower(), f"{unit.lower()}b")]
        hint = f"did you mean {' or '.join(near)}?" if near else f"units are {', '.join(UNITS)}"
        raise JobProblem(f"unknown unit {unit!r} in {value!r}; {hint}")
    return _sizes_checked(Fraction(number) * UNITS[unit], value.strip())


def format_size(size: int) -> str:
    """Return the shortest text that ``parse_size`` reads back exactly: ``4MiB``."""
    for unit, factor in sorted(UNITS.items(), key=lambda item: -item[1]):
        if size % factor == 0:
            return f"{size // factor}{unit}"
    raise AssertionError("bytes divide every size")


def _sizes_checked(size: Fraction, shown: str) -> int:
    if size.denominator != 1:
        raise JobProblem(f"{shown} is not a whole number of bytes")
    if not 1 <= size <= SIZE_MAX:
        raise JobProblem(f"a size must be from 1B to {format_size(2**62)}, got {shown}")
    return int(size)


parse_size.schema = SIZE_SCHEMA  # type: ignore[attr-defined]


TimeLike = str | int | float
"""A time in Python as in YAML: seconds as a number, or text with a unit."""

TIME_NS_MAX = 2**63 - 1
"""ROS keeps a time in a signed 64-bit count of nanoseconds."""

UNITS_NS = {
    "ns": 1,
    "us": 1_000,
    "ms": 1_000_000,
    "s": NS_PER_S,
    "min": 60 * NS_PER_S,
    "h": 3600 * NS_PER_S,
}

_TIME_TEXT = re.compile(
    r"\s*([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*([A-Za-zµμ]*)\s*"
)
_COMMA = re.compile(r"\s*([0-9]+),([0-9]+ ?[A-Za-z]*)\s*")
_CLOCK = re.compile(r"\s*([0-9]{1,6}):([0-5][0-9])\s*")
_MICRO = re.compile("[µμ]")  # the sign, and the Greek letter
_WORDS = {
    "ns": ("nsec", "nsecs", "nanosecond", "nanoseconds"),
    "us": ("usec", "usecs", "microsecond", "microseconds"),
    "ms": ("msec", "msecs", "millisecond", "milliseconds", "millis"),
    "s": ("s", "sec", "secs", "second", "seconds"),
    "min": ("m", "mins", "minute", "minutes"),
    "h": ("hr", "hrs", "hour", "hours"),
}
"""Other words for units, to say what was meant."""

TIME_SCHEMA: dict[str, object] = {
    "anyOf": [
        {"type": "number", "minimum": 0},
        {
            "type": "string",
            "pattern": r"^\s*\+?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?"
            r"\s*(ns|[uµμ]s|ms|s|min|h)\s*$",
        },
    ]
}
"""JSON Schema of what ``parse_time`` takes, as far as a schema can say."""

_EXPECTED = "expected a time: seconds as a number, or a number with a unit (ns, us, ms, s, min, h)"


class ExactFloat(float):
    """A float that remembers the text it was written as."""

    text: str

    def __new__(cls, value: float, text: str) -> ExactFloat:
        self = super().__new__(cls, value)
        self.text = text
        return self

    def __getnewargs__(self) -> tuple[float, str]:  # type: ignore[override]
        return float(self), self.text


@dataclass(frozen=True)
class Nanoseconds:
    """Marks a value that already counts nanoseconds (``duration_ns=``), not seconds."""

    value: object


def parse_time(value: object) -> int:
    """Return a time of a job in nanoseconds.

    ``value`` is a number of seconds, a string with a unit (``5ms``), or ``Nanoseconds``. Raises
    ``ValueError`` when it is anything else, negative, not finite, finer than a nanosecond, or
    beyond 64 bits.
    """
    if isinstance(value, Nanoseconds):
        if isinstance(value.value, bool) or not isinstance(value.value, int):
            raise ValueError(f"expected an integer number of nanoseconds, got {value.value!r}")
        return _checked(value.value, f"{value.value} ns")
    if isinstance(value, bool):
        raise ValueError(f"{_EXPECTED}, got {str(value).lower()}")
    if isinstance(value, int):
        return _checked(value * NS_PER_S, str(value))
    if isinstance(value, float):
        text = value.text if isinstance(value, ExactFloat) else float.__repr__(value)
        return _exact(text.replace("_", ""), NS_PER_S, text)
    if isinstance(value, str):
        return _parse_text(value)
    raise ValueError(f"{_EXPECTED}, got {_kind(value)}")


def parse_measured(text: str, unit: str) -> int:
    """Return a measured time in nanoseconds, rounded; ``unit`` is that of a number without one.

    Programs write measured values with more digits than they mean. Raises ``ValueError``.
    """
    match = _TIME_TEXT.fullmatch(text)
    if match is None:
        raise ValueError(
            f"expected a number, or a number with a unit ({', '.join(UNITS_NS)}), got {text!r}"
        )
    number, own_unit = match.groups()
    own_unit = _MICRO.sub("u", own_unit)
    if own_unit and own_unit not in UNITS_NS:
        return _parse_text(text)
    return _exact(number, UNITS_NS[own_unit or unit], text.strip(), rounded=True)


def format_time(time_ns: int) -> str:
    """Return the shortest text in seconds that ``parse_time`` reads back exactly: ``1.5s``."""
    return format_seconds(time_ns).rstrip("0").rstrip(".") + "s"


def _parse_text(text: str) -> int:
    match = _TIME_TEXT.fullmatch(text)
    if match is None:
        raise ValueError(f"{_EXPECTED}, got {text!r}{_otherwise(text)}")
    number, unit = match.groups()
    unit = _MICRO.sub("u", unit)
    if not unit:
        raise ValueError(f"{text!r} has no unit: write '{number}s' for seconds")
    if unit not in UNITS_NS:
        meant = next((u for u in _WORDS if unit.lower() in (u, *_WORDS[u])), None)
        hint = f"write '{number}{meant}'" if meant else f"units are {', '.join(UNITS_NS)}"
        raise ValueError(f"unknown unit {unit!r} in {text!r}; {hint}")
    return _exact(number, UNITS_NS[unit], text.strip())


def _otherwise(text: str) -> str:
    """Say how to write a decimal comma, or minutes and seconds."""
    comma, clock = _COMMA.fullmatch(text), _CLOCK.fullmatch(text)
    if comma is not None:
        return f"; write {comma[1]}.{comma[2]}"
    if clock is not None:
        return f"; write {60 * int(clock[1]) + int(clock[2])}s"
    return ""


def _exact(number: str, unit_ns: int, shown: str, *, rounded: bool = False) -> int:
    try:
        decimal = Decimal(number.lower().replace(".inf", "inf").replace(".nan", "nan"))
    except InvalidOperation:
        raise ValueError(f"{_EXPECTED}, got {shown}") from None
    if not decimal.is_finite():
        raise ValueError(f"a time must be finite, got {shown}")
    # An exponent of a million digits must not become an integer of a million digits.
    if decimal and decimal.adjusted() > 30:
        raise ValueError(_too_large(shown))
    if decimal and decimal.adjusted() < -30:
        if rounded:
            return 0
        raise ValueError(_too_fine(shown))
    time_ns = Fraction(decimal) * unit_ns
    if rounded:
        return _checked(round(time_ns), shown)
    if time_ns.denominator != 1:
        raise ValueError(_too_fine(shown))
    return _checked(time_ns.numerator, shown)


def _checked(time_ns: int, shown: str) -> int:
    if time_ns < 0:
        raise ValueError(f"a time must not be negative, got {shown}")
    if time_ns > TIME_NS_MAX:
        raise ValueError(_too_large(shown))
    return time_ns


def _too_large(shown: str) -> str:
    return f"{shown} is too large: 64-bit nanoseconds end at {format_time(TIME_NS_MAX)}"


def _too_fine(shown: str) -> str:
    return f"{shown} is finer than a nanosecond, the resolution of simulated time"


def _kind(value: object) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, (list, tuple)):
        return "a list"
    return repr(value)


# Times as people type them: seconds, or a number with a unit as in a job.

_ENDS_OF_NUMBERS = tuple("0123456789.")


_RUN_NS_MAX = 1_000_000 * NS_PER_S
"""As long as a run may be whose end is unknown."""


class TimeError(TraceError, ValueError):
    """A time that a run cannot have."""


class TimeInRun(NamedTuple):
    """A time in a run: counted from its start, or (``is_absolute``) the simulated time itself."""

    time_ns: int
    is_absolute: bool = False

    def stamp_ns(self, start_ns: int, end_ns: int | None = None) -> int:
        """Return the simulated time in a run from ``start_ns`` to ``end_ns`` (None: unknown).

        Raises TimeError for a time before simulated time 0, and for what must be a simulated time
        without its @.
        """
        if self.is_absolute:
            return self.time_ns
        stamp_ns = start_ns + self.time_ns
        if stamp_ns < 0:
            raise TimeError(f"a time must not be negative, got {format_time(self.time_ns)}")
        end_ns = start_ns + _RUN_NS_MAX if end_ns is None else end_ns
        if 0 < start_ns <= self.time_ns <= end_ns < stamp_ns:
            shown = format_time(self.time_ns)
            raise TimeError(f"times count from the start: write @{shown} for that simulated time")
        return stamp_ns


START = TimeInRun(0)


def parse_time_in_run(text: str) -> TimeInRun:
    """Return a time in a run: ``2.5``, ``2.5s`` and ``20ms`` count from its start, ``-0.5`` is
    before it (nodes are constructed there), ``@2.5`` is a simulated time. Raises ValueError."""
    text = text.strip()
    if text.startswith("-"):
        return TimeInRun(-parse_stamp(text[1:]))
    return TimeInRun(parse_stamp(text.removeprefix("@")), text.startswith("@"))


def parse_stamp(text: str) -> int:
    """Return a time such as ``1.5``, ``1.5s``, ``20ms`` in nanoseconds. Raises ValueError."""
    text = text.strip()
    return parse_time(f"{text}s" if text[-1:] in _ENDS_OF_NUMBERS else text)
