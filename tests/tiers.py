"""How many cases a test tries: few in ``make test``, many in ``make test-all``."""

from __future__ import annotations

many = False
"""Set by ``--many-cases`` (``conftest.py``), before any module of tests is imported."""


def cases(few: int, all_: int) -> int:
    """Return ``few``, or ``all_`` with ``--many-cases``. Such a test is marked ``repeated``."""
    return all_ if many else few
