"""Faults by class: each makes two worlds that differ by one thing, and says what is true of it."""

from __future__ import annotations

from tests.truth.faults.planting import FAULTS, Planted, Truth

__all__ = ["FAULTS", "Planted", "Truth", "load"]


def load() -> None:
    """Fill ``FAULTS``."""
    from tests.truth.faults import (
        bags,
        behaviour,
        delivery,
        endings,
        equal,
        graphs,
        outside,
        settings,
    )

    families = (bags, behaviour, delivery, endings, equal, graphs, outside, settings)
    assert all(families)
