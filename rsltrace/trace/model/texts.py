"""Texts of traces, safe to print on a terminal, and times and durations as text."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable
from typing import Any, TypeVar

Text = TypeVar("Text", str, "str | None")

NS_PER_S = 1_000_000_000
_IN_FULL_NS = 1_000_000 * NS_PER_S
_DIGITS = 6
_DIGITS_MAX = 17
_SECRET = re.compile("key|token|secret|pass|credential|auth", re.IGNORECASE)


_ROS_RELEASES = {"3": "humble", "4": "iron", "7": "jazzy", "8": "rolling", "9": "kilted"}


def ros_release(version: str) -> str:
    """Return the release of ROS 2 that has this version of rclpy, or ""."""
    return _ROS_RELEASES.get(version.partition(".")[0], "")


class Stamp(int):
    """A simulated time (ns) of a run that starts at ``start_ns``: as text it counts from there."""

    start_ns: int

    def __new__(cls, stamp_ns: int, start_ns: int = 0) -> Stamp:
        self = super().__new__(cls, stamp_ns)
        self.start_ns = start_ns
        return self


def format_seconds(stamp_ns: int) -> str:
    """Return a time as exact seconds with nine decimals: ``1.500000000``, and a ``Stamp`` as what
    commands take: the time since the start of its run."""
    if isinstance(stamp_ns, Stamp):
        stamp_ns = stamp_ns - stamp_ns.start_ns
    sign = "-" if stamp_ns < 0 else ""
    whole, fraction = divmod(abs(stamp_ns), NS_PER_S)
    return f"{sign}{whole}.{fraction:09d}"


def waiting_ns(seconds: float) -> int:
    """Return ``seconds`` in nanoseconds, at least one if it is more than 0.

    Code that waits for the rest of a timeout (``Semaphore.acquire``, ``Condition.wait_for``) may
    find 1e-17 s left: rounded to 0, it would ask forever and time would never pass.
    """
    return int(seconds * NS_PER_S) or int(seconds > 0)


def format_duration(duration_ns: float, digits: int = _DIGITS, *, signed: bool = False) -> str:
    """Return a duration rounded to some digits: ``12.5 s``, ``3.2 ms``, ``250 ns``.

    A million seconds and more are written in full: they are times since 1970.
    """
    sign = "+" if signed else ""
    if abs(duration_ns) >= _IN_FULL_NS:
        plus = sign if duration_ns > 0 else ""
        return f"{plus}{format_seconds(int(duration_ns)).rstrip('0').rstrip('.')} s"
    rounded = float(f"{duration_ns:.{digits}g}")
    for unit, scale in (("s", NS_PER_S), ("ms", 1_000_000), ("us", 1_000)):
        if abs(rounded) >= scale:
            return f"{rounded / scale:{sign}.{digits}g} {unit}"
    return f"{round(rounded):{sign}d} ns"


def format_milliseconds(duration_ns: int | None) -> str:
    """Return a duration for a column in milliseconds."""
    if duration_ns is None:
        return "-"
    return f"{duration_ns / 1e6:.{4 if abs(duration_ns) < 10 * NS_PER_S else 9}g}"


def counted(count: int, what: str) -> str:
    """Return a number of things: ``1 run``, ``2,000 runs``."""
    return f"{count:,} {what}{'s' * (count != 1)}"


def contrasting(a: Any, b: Any, text: Callable[[Any, int], Text]) -> tuple[Text, Text]:
    """Return two values with as many digits as it takes to see the difference; ``text`` returns a
    value rounded to some digits."""
    for digits in range(_DIGITS, _DIGITS_MAX):
        shown = text(a, digits), text(b, digits)
        if shown[0] != shown[1] or a == b:
            break
    return shown


def contrasting_durations(a_ns: int, b_ns: int) -> tuple[str, str]:
    """Return two durations with as many digits as it takes to see the difference."""
    return contrasting(a_ns, b_ns, format_duration)


# Fields of message classes that no message definition contains.

NO_FIELD = "structure_needs_at_least_one_member"
"""rosidl adds it to messages without fields."""
PLACEHOLDERS = frozenset((NO_FIELD, "__msgtype__"))
"""Also the field in which rosbags' classes keep the type's name."""


# Texts, which ``re`` compiles at their first use: hardly any text needs it.
_NOT_PRINTABLE = r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\u202a-\u202e\u2066-\u2069]"
_NOT_IN_LINES = f"(?![\n\t]){_NOT_PRINTABLE}"
_SHORT = {"\n": r"\n", "\r": r"\r", "\t": r"\t"}


def printable(text: str) -> str:
    """Return ``text`` on one line, with control characters escaped.

    Names and log texts come from the trace, and a trace may come from anybody.
    """
    return text if text.isprintable() else re.sub(_NOT_PRINTABLE, _escaped, text)


def printable_lines(text: str) -> str:
    """Return ``text`` with control characters escaped, except line breaks and tabs."""
    return text if text.isprintable() else re.sub(_NOT_IN_LINES, _escaped, text)


def yaml_problem(error: Exception) -> str:
    """Return what a YAML parser complains about, and the line, on one line."""
    mark, text = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    where = f" in line {mark.line + 1}" if mark else ""
    return " ".join(str(text or error).split()) + where


def shortened(text: str, width: int) -> str:
    """Return ``text`` cut to ``width`` characters, with an ellipsis if it was longer."""
    return text if len(text) <= width else text[: max(width - 1, 0)] + "…"


def contrasting_texts(a: str, b: str, width: int = 40, before: int = 20) -> tuple[str, str]:
    """Return two different texts, printable and cut to ``width`` characters in which they differ:
    long ones from ``before`` characters before the difference."""
    a, b = printable(a), printable(b)
    at = next(
        (i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b))
    )
    if max(len(a), len(b)) > width and at > width - before:
        a, b = (f"…{text[at - before :]}" for text in (a, b))
    return shortened(a, width), shortened(b, width)


def _escaped(match: re.Match[str]) -> str:
    character = match.group()
    return _SHORT.get(character) or character.encode("unicode_escape").decode("ascii")


def variable_text(name: str | bytes, value: str | bytes) -> str:
    """Return an environment variable's value as evidence; only a hash if it may be a secret."""
    if _SECRET.search(os.fsdecode(name)) or len(value) > 200:
        return f"SHA-256 {hashlib.sha256(os.fsencode(value)).hexdigest()[:16]}"
    return repr(value)
