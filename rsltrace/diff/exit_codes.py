"""The exit status of a comparison: 0 identical, 1 diverged or cut, 3 equal within tolerance."""

from __future__ import annotations

from collections.abc import Iterable

EXIT_DIVERGED = 1

EXIT_WITHIN_TOLERANCE = 3
"""Neither identical (0) nor diverged (1), and not what others use for trouble (2)."""


def exit_code_of_several(codes: Iterable[int]) -> int:
    """Return the worst: diverged, then within tolerance, then identical."""
    found = set(codes)
    return next((code for code in (EXIT_DIVERGED, EXIT_WITHIN_TOLERANCE) if code in found), 0)
