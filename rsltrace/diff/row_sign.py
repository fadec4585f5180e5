"""How a row of two runs, or of two recordings, compares."""

from __future__ import annotations

from enum import Enum


class RowSign(Enum):
    """The value is what is printed, so no colour is needed."""

    MATCH = "="
    DIFFERS = "≠"
    ONLY_A = "-"
    ONLY_B = "+"
    MOVED = "~"
    """Both runs did the same, at another place in the order or at another time."""
    UNKNOWN = "?"
    """Beyond the part of the runs that was aligned."""
