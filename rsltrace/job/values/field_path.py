"""A field within a message, as a job names it, and what a job may put there."""

from __future__ import annotations

import math
import re
from typing import Any

from rsltrace.job.values.problem import describe

Step = tuple[str, "int | str | None"]
"""The name of a field, and which of its items: a number, ``*`` for all, None for it as a whole."""

_STEP = re.compile(r"([A-Za-z][A-Za-z0-9_]*)(?:\[(-?[0-9]{1,9}|\*)\])?", re.ASCII)
_WORDS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def check_field(text: str) -> None:
    """Raise ValueError unless ``text`` names a field: ``pose.position.x``, ``ranges[3]``."""
    field_steps(text)


def field_steps(text: str) -> tuple[Step, ...]:
    """Return the way to a field, step by step.

    :raises ValueError: it names none.
    """
    steps: list[Step] = []
    for part in text.split("."):
        found = _STEP.fullmatch(part)
        if found is None:
            raise ValueError(
                f"{text!r} is not a field: write pose.position.x, ranges[3], ranges[-1] for the "
                "last or ranges[*] for all"
            )
        name, item = found.groups()
        steps.append((name, item if item in (None, "*") else int(item)))
    return tuple(steps)


def field_value(value: Any) -> Any:
    """Return a value for a field as a job keeps it. What JSON has no number for is a word.

    :raises ValueError: it is neither text, number, truth value nor a list of these.
    """
    if isinstance(value, (list, tuple)):
        return [_single(item) for item in value]
    return _single(value)


def _single(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    raise ValueError(f"expected text, a number, true or false, or a list, got {describe(value)}")


def number_of(value: Any) -> float | int | None:
    """Return the number that a value for a field is, None if it is none."""
    if isinstance(value, str):
        return _WORDS.get(value)
    return None if isinstance(value, bool) or not isinstance(value, (int, float)) else value
