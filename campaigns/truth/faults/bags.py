"""Bags whose messages differ: the bag is the cause, not a callback."""

from __future__ import annotations

import random

from campaigns.truth.faults.planting import ALWAYS_FALSE, NOT_DETERMINISTIC, Planted, Truth, fault
from campaigns.truth.graph import MS, World, random_world

NEVER = (*ALWAYS_FALSE, NOT_DETERMINISTIC)


def _two(rng: random.Random) -> tuple[World, World, int]:
    a = random_world(rng, bag=True)
    return a, a.copy(), rng.randrange(1, 6)


@fault("bag: value")
def value(rng: random.Random) -> Planted:
    a, b, at = _two(rng)
    stamp, topic, data = b.bag[at]
    b.bag[at] = (stamp, topic, data + 0.125)
    truth = Truth(("different-input",), "", topic, says=(r"bag",), values=topic, never=NEVER)
    return Planted(a, b, truth)


@fault("bag: time")
def time(rng: random.Random) -> Planted:
    a, b, at = _two(rng)
    stamp, topic, data = b.bag[at]
    b.bag[at] = (stamp + 4 * MS, topic, data)
    truth = Truth(("timing",), "", topic, first=(r"4 ms later",), says=(r"bag",), never=NEVER)
    return Planted(a, b, truth)


@fault("bag: missing")
def missing(rng: random.Random) -> Planted:
    a, b, at = _two(rng)
    del b.bag[at]
    truth = Truth(("missing",), "", "/b0", says=(r"only the bag of a",), never=NEVER)
    return Planted(a, b, truth)


@fault("bag: extra")
def extra(rng: random.Random) -> Planted:
    a, b, at = _two(rng)
    stamp, topic, data = b.bag[at]
    b.bag.insert(at + 1, (stamp + 3 * MS, topic, data + 0.3))
    truth = Truth(("extra",), "", "/b0", says=(r"only the bag of b",), never=NEVER)
    return Planted(a, b, truth)


@fault("bag: two swapped")
def swapped(rng: random.Random) -> Planted:
    a, b, at = _two(rng)
    (first, topic, one), (second, _, other) = b.bag[at], b.bag[at + 1]
    b.bag[at], b.bag[at + 1] = (first, topic, other), (second, topic, one)
    truth = Truth(
        ("different-input", "timing", "schedule"),
        "",
        "/b0",
        says=(r"bag", r"swapped|order"),
        never=NEVER,
    )
    return Planted(a, b, truth)


@fault("bag: cut short")
def short(rng: random.Random) -> Planted:
    a, b, at = _two(rng)
    del b.bag[at:]
    truth = Truth(("missing",), "", "/b0", says=(r"only the bag of a",), never=NEVER)
    return Planted(a, b, truth)
