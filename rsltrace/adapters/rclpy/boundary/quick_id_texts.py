"""Texts of goal ids without numpy's general formatter.

rclpy's action server makes the text of a goal's id (sixteen octets) five times per goal, for debug
records that hardly anybody sees. numpy takes some 50 µs for one; the same text is made here in 3.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

_OCTETS = 16
_OCTET = np.dtype(np.uint8)
_LINE_MIN = 75
"""numpy's line width unless the user has set another: such a text fits into it."""
_OLD_STYLE = 113
"""Up to this number, numpy's option ``legacy`` means the style of 1.13."""


@contextmanager
def quick_id_texts() -> Iterator[None]:
    """Make the texts of sixteen octets quickly within the ``with`` block."""
    arrayprint: Any = sys.modules.get("numpy._core.arrayprint")
    real = getattr(arrayprint, "_array2string", None)
    if real is None:  # another numpy, which has it elsewhere: then it takes its time
        yield
        return

    def _array2string(a: Any, options: Any, separator: str = " ", prefix: str = "") -> Any:
        if (
            type(a) is np.ndarray
            and a.dtype is _OCTET
            and a.shape == (_OCTETS,)
            and separator == " "
            and not prefix
            and options["formatter"] is None
            and options["linewidth"] >= _LINE_MIN
            and options["threshold"] >= _OCTETS
            and options["legacy"] > _OLD_STYLE
        ):
            return octets_text(a)
        return real(a, options, separator, prefix)

    arrayprint._array2string = _array2string
    try:
        yield
    finally:
        arrayprint._array2string = real


def octets_text(octets: Any) -> str:
    """Return what ``str`` makes of an array of octets that fits into a line."""
    words = [str(octet) for octet in octets.tolist()]
    width = max(map(len, words))
    return f"[{' '.join([word.rjust(width) for word in words])}]"


__all__ = ["octets_text", "quick_id_texts"]
