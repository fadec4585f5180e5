"""Recordings with all kinds of fields, and a judge that has nothing of ours."""

from __future__ import annotations

import copy
import math
import struct
import tempfile
from pathlib import Path
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from campaigns.truth.graph import write_bag
from rsltrace import DiffOptions, diff_bags
from tests.diff.judged_messages import Rules, encoded, judged, write_mcap, write_sqlite
from tests.tiers import cases

COUNTS = ("equal", "tolerated", "ignored", "differing")


def _narrow(value: float) -> float:
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


_NANS = [struct.unpack("<d", struct.pack("<Q", n))[0] for n in (0x7FF8 << 48, 0x7FF80001 << 32)]
wide = st.sampled_from(
    [0.0, -0.0, 1.0, 1.0 + 2**-52, 1.0005, -3.5, 1e300, 5e-324, math.inf, -math.inf, *_NANS]
)
narrow = st.sampled_from(
    [_narrow(v) for v in (0.0, -0.0, 1.0, 1.0 + 2**-23, 0.1, 1e-40, math.inf, math.nan)]
)
texts = st.sampled_from(("", "a", "ab", "Grüße", "日本語", "\U0001f916", "a\nb", '"q"'))
inner = st.fixed_dictionaries({"x": wide, "s": texts, "more": st.lists(narrow, max_size=6)})
message = st.fixed_dictionaries(
    {
        "stamp": st.tuples(
            st.sampled_from((-(2**31), -1, 0, 1, 2**31 - 1)),
            st.sampled_from((0, 1, 500_000, 999_999_999)),
        ),
        "flag": st.booleans(),
        "small": st.just(0),
        "large": st.sampled_from((0, 1, 2**53, 2**53 + 1, 2**64 - 1)),
        "narrow": narrow,
        "wide": wide,
        "text": texts,
        "numbers": st.lists(wide, max_size=7),
        "triple": st.lists(narrow, min_size=3, max_size=3),
        "flags": st.lists(st.booleans(), max_size=3),
        "bytes": st.lists(st.integers(0, 255), max_size=4),
        "whole": st.lists(st.sampled_from((0, 1, -(2**63), 2**63 - 1, 2**53 + 1)), max_size=4),
        "names": st.lists(texts, max_size=3),
        "inners": st.lists(inner, max_size=3),
    }
)
rules = st.builds(
    Rules,
    ignore=st.lists(
        st.sampled_from(
            "text numbers[1] names[0] names inners.s inners[0] inners[1].more stamp *.x triple[2] "
            "flags bytes[0] inners.more[1] l* w?de".split()
        ),
        max_size=2,
    ).map(tuple),
    absolute=st.lists(
        st.tuples(
            st.sampled_from("* wide numbers numbers[2] inners.x stamp large whole".split()),
            st.sampled_from((0.0, 1e-9, 0.001, 0.5, 1.0, 1e301)),
        ),
        max_size=2,
    ).map(tuple),
    relative=st.lists(
        st.tuples(
            st.sampled_from("* narrow triple inners whole stamp".split()),
            st.sampled_from((0.0, 1e-9, 0.001, 1.0, 2.0)),
        ),
        max_size=1,
    ).map(tuple),
)
storage = st.tuples(
    st.sampled_from(("NONE", "LZ4", "ZSTD", "sqlite")),
    st.sampled_from((0, 64, 900, 1 << 20)),
    st.sampled_from((1, 2)),
    st.sampled_from((0, 0xA5)),
)


@st.composite
def recordings(draw: Any) -> tuple[list[Any], list[Any]]:
    """Return two recordings of as many messages: each is another one in some of its fields."""
    a = draw(st.lists(message, min_size=1, max_size=6))
    for number, one in enumerate(a):
        one["small"] = number  # no two are the same, so that it is clear which belong together
    b = copy.deepcopy(a)
    for at in draw(st.lists(st.integers(0, len(a) - 1), max_size=4)):
        other = draw(message)
        names = st.sampled_from(sorted(other.keys() - {"small"}))
        for name in draw(st.lists(names, min_size=1, max_size=2)):
            b[at][name] = other[name]
        if b[at]["inners"] and draw(st.booleans()):
            draw(st.sampled_from(b[at]["inners"]))["x"] = draw(wide)
        if len(b[at]["inners"]) > 1 and draw(st.booleans()):
            b[at]["inners"].reverse()
    return a, b


def _write(path: Path, messages: list[Any], how: tuple[str, int, int, int]) -> Path:
    compression, chunk, channels, padding = how
    base = 2**31 * 10**9 + 5
    samples = [
        (base + number // 2, "/all", encoded(one, padding)) for number, one in enumerate(messages)
    ]
    if compression == "sqlite":
        path = path.with_suffix(".db3")
        write_sqlite(path, samples)
    else:
        path = path.with_suffix(".mcap")
        write_mcap(path, samples, compression=compression, chunk=chunk, channels=channels)
    return path


@settings(max_examples=cases(10, 25))
@given(recordings(), rules, storage, storage)
def test_every_message_is_judged_as_its_values_are(
    two: tuple[list[Any], list[Any]], rule: Rules, how_a: Any, how_b: Any
) -> None:
    options = DiffOptions(ignore=rule.ignore, absolute=rule.absolute, relative=rule.relative)
    expected = [judged(x, y, rule) for x, y in zip(*two, strict=True)]
    with tempfile.TemporaryDirectory() as folder:
        paths = [
            _write(Path(folder) / name, messages, how)
            for name, messages, how in (("a", two[0], how_a), ("b", two[1], how_b))
        ]
        for by in ("order", "stamp"):
            for one, other in (paths, paths[::-1]):
                found = diff_bags(one, other, DiffOptions(**{**_plain(options), "by": by}))
                (topic,) = found.topics
                told = {name: getattr(topic, name) for name in COUNTS}
                assert told == {name: expected.count(name) for name in COUNTS}, (by, found.sentence)


def _plain(options: DiffOptions) -> dict[str, Any]:
    return {name: getattr(options, name) for name in ("ignore", "absolute", "relative")}


@st.composite
def edited(draw: Any) -> tuple[list[float], list[float]]:
    """Return values, and the same with some missing, extra, changed or in other places, and noise
    of less than 0.001 in some."""
    values = st.sampled_from([0.0, 1.0, 2.0, 3.0, *map(float, range(100, 140))])
    a = draw(st.lists(values, min_size=1, max_size=14))
    b = list(a)
    for _ in range(draw(st.integers(0, 3))):
        at, to = draw(st.integers(0, len(b) - 1)), draw(st.integers(0, len(b) - 1))
        match draw(st.sampled_from(("missing", "extra", "changed", "swapped", "moved"))):
            case "missing" if len(b) > 1:
                del b[at]
            case "extra":
                b.insert(at, draw(values))
            case "changed":
                b[at] = draw(values)
            case "swapped":
                b[at], b[to] = b[to], b[at]
            case "moved":
                b.insert(to, b.pop(at))
    return a, [value + draw(st.sampled_from((0.0, 0.0, 1e-4, -1e-4))) for value in b]


@settings(max_examples=cases(10, 40))
@given(edited(), st.booleans())
def test_both_orders_say_the_same_and_name_where_the_recordings_first_differ(
    two: tuple[list[float], list[float]], tolerant: bool
) -> None:
    options = DiffOptions(absolute=(("data", 1e-3),) if tolerant else ())
    most = 1e-3 if tolerant else 0.0
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / "a.mcap", Path(folder) / "b.mcap"]
        for path, values in zip(paths, two, strict=True):
            write_bag(path, [(5 + 10 * n, "/t", value) for n, value in enumerate(values)])
        (one,) = diff_bags(*paths, options).topics
        (other,) = diff_bags(*paths[::-1], options).topics
    for name in ("equal", "tolerated", "differing", "moved"):
        assert getattr(one, name) == getattr(other, name), name
    assert (one.only_a, one.only_b) == (other.only_b, other.only_a)
    paired = one.equal + one.tolerated + one.differing + one.moved
    assert [paired + one.only_a, paired + one.only_b] == [len(values) for values in two]
    a, b = two
    places = (n for n, (x, y) in enumerate(zip(a, b, strict=False)) if abs(x - y) > most)
    differs = next(places, None if len(a) == len(b) else min(len(a), len(b)))
    assert (one.first is None) == (differs is None)
    if one.first is not None and differs is not None:
        told = [(view.index, side) for view, side in ((one.first.a, a), (one.first.b, b)) if view]
        # Of several that are alike, any may be called the missing one.
        assert any(
            index <= differs and all(abs(side[index] - x) <= 2e-3 for x in side[index:differs])
            for index, side in told
        )
