"""Times as people type them: seconds, or a number with a unit."""

from __future__ import annotations

import re
from decimal import Decimal

_UNITS = {"": 10**9, "s": 10**9, "ms": 10**6, "us": 10**3, "µs": 10**3, "ns": 1, "min": 60 * 10**9}
_TIME = re.compile(r"(\d{1,12}(?:\.\d{0,12})?|\.\d{1,12})\s*([a-zµ]*)")


def parse_time(text: str) -> int:
    """Return a time such as ``1.5``, ``1.5s``, ``20ms`` in nanoseconds. Raises ValueError."""
    found = _TIME.fullmatch(text.strip().lower())
    if found is None or found.group(2) not in _UNITS:
        raise ValueError(f"{text!r} is no time; write seconds, or a number with s, ms, us, ns, min")
    return int(Decimal(found.group(1)) * _UNITS[found.group(2)])
