"""Recordings that know nothing of rsltrace, with one thing changed in the second."""

from __future__ import annotations

import random

from campaigns.truth.faults.planting import Planted, Truth, fault
from campaigns.truth.graph import MS, World
from campaigns.truth.recordings import Messages, Recordings
from rsltrace import DiffOptions

NOTHING = World([], {})


def _two(rng: random.Random) -> tuple[Messages, Messages, str, list[int]]:
    """Return two equal recordings of three topics, one of these, and where its messages are."""
    a: Messages = []
    for number in range(3):
        period, phase = rng.choice((7, 10, 13)), rng.randint(0, 5)
        repeats = rng.choice((5, 1000))
        a += [
            ((phase + n * period) * MS, f"/t{number}", n % repeats + 0.25 * number)
            for n in range(rng.randint(15, 40))
        ]
    a.sort()
    topic = f"/t{rng.randrange(3)}"
    return a, list(a), topic, [place for place, one in enumerate(a) if one[1] == topic]


def _planted(truth: Recordings) -> Planted:
    return Planted(NOTHING, NOTHING, Truth(), recordings=truth)


@fault("recordings: value")
def value(rng: random.Random) -> Planted:
    a, b, topic, places = _two(rng)
    at = rng.randrange(len(places))
    stamp, _, data = b[places[at]]
    b[places[at]] = (stamp, topic, data + 100.5)
    first = (rf"message {at} has a different data",)
    return _planted(Recordings(a, b, topic, {"differing": 1}, first=first, place=at))


@fault("recordings: several values")
def values(rng: random.Random) -> Planted:
    a, b, topic, places = _two(rng)
    chosen = sorted(rng.sample(range(len(places)), 3))
    for at in chosen:
        stamp, _, data = b[places[at]]
        b[places[at]] = (stamp, topic, data + 100.5 + at)
    first = (rf"message {chosen[0]} has a different data",)
    return _planted(Recordings(a, b, topic, {"differing": 3}, first=first, place=chosen[0]))


@fault("recordings: missing")
def missing(rng: random.Random) -> Planted:
    a, b, topic, places = _two(rng)
    at = rng.randrange(len(places) - 1)
    del b[places[at]]
    first = (r"message \d+ of a is missing in b",)
    return _planted(Recordings(a, b, topic, {"only_a": 1}, first=first, place=at))


@fault("recordings: extra")
def extra(rng: random.Random) -> Planted:
    a, b, topic, places = _two(rng)
    at = rng.randrange(1, len(places))
    stamp = b[places[at]][0]
    b.insert(places[at], (stamp, topic, -77.5))
    first = (rf"message {at} of b is not in a",)
    return _planted(Recordings(a, b, topic, {"only_b": 1}, first=first, place=at))


@fault("recordings: two swapped")
def swapped(rng: random.Random) -> Planted:
    a, b, topic, places = _two(rng)
    at = rng.randrange(len(places) - 1)
    (early, _, one), (late, _, other) = b[places[at]], b[places[at + 1]]
    b[places[at]], b[places[at + 1]] = (early, topic, other), (late, topic, one)
    first = (rf"messages {at} and {at + 1} are swapped",)
    return _planted(Recordings(a, b, topic, {"moved": 1}, first=first, place=at))


@fault("recordings: moved")
def moved(rng: random.Random) -> Planted:
    a, b, topic, places = _two(rng)
    for place in places:  # no two are the same
        a[place] = (a[place][0], topic, a[place][2] + place * 0.001)
    contents = [a[place][2] for place in places]
    at, to = rng.sample(range(len(places)), 2)
    while abs(at - to) < 3:
        at, to = rng.sample(range(len(places)), 2)
    contents.insert(to, contents.pop(at))
    b = list(a)
    for place, data in zip(places, contents, strict=True):
        b[place] = (b[place][0], topic, data)
    first = (rf"message {at} of a is message {to} of b",)
    return _planted(Recordings(a, b, topic, {"moved": 1}, first=first, place=at))


@fault("recordings: other log times")
def times(rng: random.Random) -> Planted:
    a, b, topic, _ = _two(rng)
    b = [(stamp + 5 * MS, name, data) for stamp, name, data in b]
    return _planted(Recordings(a, b, topic, {}, "equal", first=(r"equal",)))


@fault("recordings: within tolerance")
def tolerated(rng: random.Random) -> Planted:
    a, b, topic, places = _two(rng)
    chosen = rng.sample(places, 4)
    for place in chosen:
        stamp, _, data = b[place]
        b[place] = (stamp, topic, data + 1e-4)
    options = DiffOptions(absolute=(("data", 1e-3),))
    truth = Recordings(
        a,
        b,
        topic,
        {"tolerated": 4},
        "equal-within-tolerance",
        (r": 4 of \d+ messages",),
        None,
        options,
    )
    return _planted(truth)


@fault("recordings: ignored")
def ignored(rng: random.Random) -> Planted:
    a, b, topic, places = _two(rng)
    chosen = rng.sample(places, 4)
    for place in chosen:
        stamp, _, data = b[place]
        b[place] = (stamp, topic, data + 100.5)
    options = DiffOptions(ignore=(f"{topic}:data",))
    truth = Recordings(
        a,
        b,
        topic,
        {"ignored": 4},
        "equal-within-tolerance",
        (r"equal except for ignored fields, not identical: 4 of \d+ messages",),
        None,
        options,
    )
    return _planted(truth)


@fault("recordings: end missing")
def end(rng: random.Random) -> Planted:
    a, b, topic, places = _two(rng)
    count = rng.randint(2, 5)
    for place in reversed(places[-count:]):
        del b[place]
    at = len(places) - count
    first = (rf"message {at} of a is missing in b",)
    truth = Recordings(a, b, topic, {"only_a": count}, first=first, place=at)
    return _planted(truth)


@fault("recordings: NaN")
def not_a_number(rng: random.Random) -> Planted:
    a, b, topic, places = _two(rng)
    at = rng.randrange(len(places))
    b[places[at]] = (b[places[at]][0], topic, float("nan"))
    first = (rf"message {at} has a different data",)
    return _planted(Recordings(a, b, topic, {"differing": 1}, first=first, place=at))
