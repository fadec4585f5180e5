"""Faults by class: each makes two worlds that differ by one thing, and says what is true of it."""

from __future__ import annotations

from campaigns.truth.faults.planting import FAMILIES, FAULTS, Planted, Truth

__all__ = ["FAMILIES", "FAULTS", "Planted", "Truth", "load"]


def load() -> None:
    """Fill ``FAULTS``."""
    from campaigns.truth.faults import (
        actions,
        answers,
        bags,
        behaviour,
        delivery,
        endings,
        equal,
        graphs,
        lifecycle,
        mains,
        messages,
        mixed,
        origins,
        outside,
        pairs,
        programs,
        recordings,
        rules,
        sensors,
        settings,
        starts,
        systems,
        timing,
        unrelated,
        waiting,
    )

    families = (
        *(bags, behaviour, delivery, endings, equal, graphs, messages, origins, outside, pairs),
        *(recordings, rules, settings, waiting, actions, lifecycle, mains, timing),
        *(answers, sensors, unrelated, systems, mixed, programs, starts),
    )
    assert all(families)
