"""What differs between two decoded messages, and by how much."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys.store import Typestore

from rsltrace.diff.bags.comparison import ContentKeys
from rsltrace.diff.facts.evidence import FieldDifference, MessageDifference, Presence
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.sentences.event_differences import event_differences_text
from rsltrace.diff.sentences.values import notes_text
from rsltrace.diff.values.fields import diff_messages, preview
from rsltrace.diff.values.globs import FieldRules
from rsltrace.diff.values.numbers import ulp_distance
from rsltrace.errors import TraceError
from rsltrace.trace.decode import Decoder
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.model.event import OutputKind
from tests.tiers import cases

SCHEMA = f"""\
std_msgs/Header header
float32 single
float64 double
uint64 big
int8 small
bool flag
string text
float32[] ranges
float64[9] covariance
int64[] counts
bool[] bits
uint8[] data
string[] names
geometry_msgs/Point[] points
{"=" * 80}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
{"=" * 80}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
"""
ONLY = DiffOptions()


def decoder(schema: str = SCHEMA, name: str = "pkg/msg/All") -> Decoder:
    return Decoder(ChannelInfo(1, "/all", name, "ros2msg", schema, {}))


ALL = decoder()
STORE = Typestore()
STORE.register(ALL.types)


def message(**changes: Any) -> Any:
    """A message as decoding gives it, with some fields set by their paths."""
    types = STORE.types
    point = types["geometry_msgs/msg/Point"]
    fields: dict[str, Any] = {
        "header": types["std_msgs/msg/Header"](
            types["builtin_interfaces/msg/Time"](sec=10, nanosec=500), "map"
        ),
        "single": 0.0,
        "double": 0.0,
        "big": 0,
        "small": 0,
        "flag": False,
        "text": "",
        "ranges": np.zeros(4, dtype=np.float32),
        "covariance": np.zeros(9),
        "counts": np.zeros(0, dtype=np.int64),
        "bits": np.zeros(3, dtype=bool),
        "data": np.zeros(0, dtype=np.uint8),
        "names": [],
        "points": [point(1.0, 2.0, 3.0), point(4.0, 5.0, 6.0)],
    }
    fields.update(changes)
    name = "pkg/msg/All"
    raw = STORE.serialize_cdr(types[name](**fields), name)
    return ALL.decode(bytes(raw))


def only(a: Any, b: Any, options: DiffOptions = ONLY) -> FieldDifference:
    found, more = diff_messages(a, b, options)
    assert len(found) == 1, found
    assert more == 0
    return found[0]


def test_equal_messages_have_no_differences() -> None:
    assert diff_messages(message(), message(), ONLY) == ((), 0)


@pytest.mark.parametrize(
    ("field", "a", "b", "text_a", "text_b", "ulp"),
    [
        ("single", 0.1, 0.2, "0.1", "0.2", 8388608),
        ("double", 0.1, 0.1 + 2**-56, "0.1", "0.10000000000000002", 1),
        ("double", 1e300, -1e300, "1e+300", "-1e+300", None),
        ("single", 16777216.0, 16777218.0, "16777216.0", "16777218.0", 1),
    ],
)
def test_floats_are_shown_in_full_and_measured_in_their_own_width(
    field: str, a: float, b: float, text_a: str, text_b: str, ulp: int | None
) -> None:
    found = only(message(**{field: a}), message(**{field: b}))
    assert (found.path, found.a, found.b) == (field, text_a, text_b)
    if ulp is not None:
        assert found.ulp == ulp
    width = np.float32 if field == "single" else np.float64
    assert found.absolute == abs(float(width(a)) - float(width(b)))
    assert width(found.a) == width(a)
    assert width(found.b) == width(b)


@pytest.mark.parametrize("field", ["single", "double"])
@pytest.mark.parametrize(
    ("a", "b", "note"),
    [
        (math.nan, 1.0, "NaN in a only"),
        (1.0, math.nan, "NaN in b only"),
        (0.0, -0.0, "sign of zero"),
        (math.inf, 1.0, "infinite in a only"),
        (math.inf, -math.inf, "infinities of opposite sign"),
    ],
)
def test_special_floats_are_called_out(field: str, a: float, b: float, note: str) -> None:
    found = only(message(**{field: a}), message(**{field: b}))
    assert notes_text(found) == note
    if note == "sign of zero":
        assert (found.a, found.b, found.absolute, found.ulp) == ("0.0", "-0.0", 0.0, 0)
    else:
        assert found.absolute is None
        assert found.ulp is None


def nan_of(bits: int) -> float:
    value: float = struct.unpack("<d", struct.pack("<Q", bits))[0]
    return value


def test_nan_equals_a_nan_of_the_same_bits_only() -> None:
    assert diff_messages(message(double=math.nan), message(double=math.nan), ONLY) == ((), 0)
    found = only(message(double=math.nan), message(double=nan_of(0x7FF8000000000001)))
    assert notes_text(found) == "NaN with a different payload"
    assert (found.a, found.b) == ("nan", "nan(0x7ff8000000000001)")
    array = np.full(4, np.nan, dtype=np.float32)
    assert diff_messages(message(ranges=array), message(ranges=array), ONLY) == ((), 0)


def test_integers_and_truth_values() -> None:
    found = only(message(big=2**64 - 1), message(big=2**64 - 3))
    assert (found.a, found.b) == ("18446744073709551615", "18446744073709551613")
    assert (found.absolute, found.ulp) == (2.0, None)
    assert only(message(small=-128), message(small=127)).absolute == 255.0
    found = only(message(flag=True), message(flag=False))
    assert (found.a, found.b, found.absolute) == ("true", "false", None)


def test_times_are_one_field_in_seconds() -> None:
    a, b = message(), message()
    b.header.stamp.sec, b.header.stamp.nanosec = 9, 999_999_999
    found = only(a, b)
    assert (found.path, found.a, found.b) == ("header.stamp", "10.000000500", "9.999999999")
    assert found.absolute == pytest.approx(501e-9)
    close = DiffOptions(absolute=(("header.stamp", 1e-6),))
    assert only(a, b, close).within_tolerance
    assert not only(a, b, DiffOptions(absolute=(("header.stamp", 1e-7),))).within_tolerance
    for glob in ("header.stamp", "header", "*.stamp.*", "*stamp", "header.stamp.*"):
        assert diff_messages(a, b, DiffOptions(ignore=(glob,))) == ((), 0), glob
    b.header.stamp.nanosec = 2_000_000_000  # no time in its normal form: as numbers then
    assert [d.path for d in diff_messages(a, b, ONLY)[0]] == [
        "header.stamp.sec",
        "header.stamp.nanosec",
    ]


def test_texts_say_where_they_part() -> None:
    found = only(message(text="left"), message(text="right\x1b[31m\n"))
    assert (found.a, found.b, found.notes) == ('"left"', '"right\\x1b[31m\\n"', ())
    long = "x" * 200
    found = only(message(text=long), message(text=long[:120] + "y" + long[121:150]))
    assert notes_text(found) == "first at character 120; length 200 and 150"
    assert "xy" in found.b
    assert len(found.a) < 70


@pytest.mark.parametrize(
    ("a", "b", "is_reordered"),
    [
        ("left, right, top", "top, left, right", True),
        ("['near', 'far']", "['far', 'near']", True),
        ("x=1;y=2", "y=2;x=1", True),
        ("left right", "left  right", False),
        ("1.25", "25.1", False),
        ("left, left, top", "left, top, top", False),
    ],
)
def test_texts_that_list_the_same_in_another_order_say_so(
    a: str, b: str, is_reordered: bool
) -> None:
    assert only(message(text=a), message(text=b)).is_reordered is is_reordered


def test_one_element_is_named_by_its_index() -> None:
    ranges = np.zeros(4, dtype=np.float32)
    ranges[2] = 0.5
    found = only(message(), message(ranges=ranges))
    assert (found.path, found.a, found.b, found.absolute) == ("ranges[2]", "0.0", "0.5", 0.5)
    assert found.elements == (1, 4)


def test_arrays_are_summarised() -> None:
    a = np.arange(100, dtype=np.float32)
    b = a.copy()
    b[[3, 50]] += 0.5
    b[7] = np.nan
    b[0] = -0.0
    b[99] = np.inf
    found = only(message(ranges=a), message(ranges=b))
    assert found.path == "ranges"
    assert found.elements == (5, 100)
    assert found.first == (
        (0, "0.0", "-0.0"),
        (3, "3.0", "3.5"),
        (7, "7.0", "nan"),
        (50, "50.0", "50.5"),
        (99, "99.0", "inf"),
    )
    assert (found.smallest, found.largest) == (0.0, 0.5)
    assert found.ulp == 2097152
    assert notes_text(found) == "NaN in b only: 1; infinite in b only: 1; sign of zero: 1"
    assert found.a == "[0.0, 1.0, 2.0, 3.0, … 100 in all]"


def test_arrays_of_other_length_show_what_is_beyond() -> None:
    a = np.arange(5, dtype=np.float32)
    found = only(message(ranges=a), message(ranges=a[:3]))
    assert notes_text(found) == "length 5 and 3"
    assert found.elements == (2, 5)
    assert found.first == ((3, "3.0", "absent"), (4, "4.0", "absent"))
    assert not found.within_tolerance
    assert not only(
        message(ranges=a), message(ranges=a[:3]), DiffOptions(absolute=(("*", 1e9),))
    ).within_tolerance


def test_differences_of_64_bit_integers_do_not_wrap() -> None:
    low, high = -(2**63), 2**63 - 1
    a = np.array([low, 0, low], dtype=np.int64)
    b = np.array([high, 0, low + 1], dtype=np.int64)
    found = only(message(counts=a), message(counts=b))
    assert (found.smallest, found.largest) == (1.0, float(2**64 - 1))
    found = only(
        message(bits=np.array([True, False, True])), message(bits=np.array([False, True, True]))
    )
    assert found.elements == (2, 3)
    assert (found.ulp, found.smallest) == (None, None)


def test_long_binary_fields_are_shown_as_a_hex_dump() -> None:
    a = np.arange(200, dtype=np.uint8)
    b = a.copy()
    b[[18, 20, 150]] = 255
    found = only(message(data=a), message(data=b))
    assert (found.a, found.b, found.elements) == ("200 bytes", "200 bytes", (3, 200))
    assert notes_text(found) == "first at byte 18"
    assert [offset for offset, _, _ in found.first] == [16, 144]
    assert found.first[0][1].startswith("10 11 12 13 14")
    assert found.first[0][2].startswith("10 11 ff 13 ff")
    found = only(message(data=a), message(data=a[:100]))
    assert notes_text(found) == "length 200 and 100"
    assert found.first[0][0] == 96
    # short ones are numbers
    assert only(message(data=a[:8]), message(data=b[:0])).a == "[0, 1, 2, 3, … 8 in all]"


def test_messages_in_arrays_are_compared_one_by_one() -> None:
    a, b = message(), message()
    b.points[1].y = 7.0
    assert only(a, b).path == "points[1].y"
    b.points.append(b.points[0])
    found, _ = diff_messages(a, b, ONLY)
    assert [one.path for one in found] == ["points", "points[1].y"]
    assert (found[0].a, found[0].b, notes_text(found[0])) == (
        "2 items",
        "3 items",
        "length 2 and 3",
    )
    assert found[0].first == ((2, "absent", "x: 1.0, y: 2.0, z: 3.0"),)
    names = only(message(names=["a", "b"]), message(names=["a", "c"]))
    assert (names.path, names.a, names.b) == ("names[1]", '"b"', '"c"')


def test_globs_reach_into_arrays_with_and_without_indexes() -> None:
    a, b = message(), message()
    b.points[1].y = 7.0
    for glob in ("points", "points[1]", "points[*].y", "points.y", "*.y", "point?[1].y"):
        assert diff_messages(a, b, DiffOptions(ignore=(glob,))) == ((), 0), glob
    for glob in ("point", "points[0]", "points.x", "y", "points[1].yy"):
        assert diff_messages(a, b, DiffOptions(ignore=(glob,)))[0], glob
    ranges = np.zeros(4, dtype=np.float32)
    ranges[[1, 2]] = 1.0
    found = only(message(), message(ranges=ranges), DiffOptions(ignore=("ranges[1]",)))
    assert found.path == "ranges[2]"
    assert only(
        message(), message(ranges=ranges), DiffOptions(absolute=(("ranges[*]", 1.0),))
    ).within_tolerance
    assert not only(
        message(), message(ranges=ranges), DiffOptions(absolute=(("ranges[2]", 1.0),))
    ).within_tolerance


def test_tolerances() -> None:
    a, b = message(double=100.0), message(double=101.0)
    assert only(a, b, DiffOptions(absolute=(("double", 1.0),))).within_tolerance
    assert not only(a, b, DiffOptions(absolute=(("double", 0.99),))).within_tolerance
    assert only(a, b, DiffOptions(relative=(("*", 0.01),))).within_tolerance
    assert not only(a, b, DiffOptions(relative=(("*", 0.009),))).within_tolerance
    # the most generous of several counts
    both = DiffOptions(absolute=(("double", 0.0), ("*", 2.0)))
    assert only(a, b, both).within_tolerance
    nan = message(double=math.nan)
    assert not only(a, nan, DiffOptions(absolute=(("*", 1e300),))).within_tolerance


def test_what_is_not_covered_comes_first() -> None:
    a = message(single=1.0, double=1.0, big=1)
    b = message(single=2.0, double=2.0, big=9)
    found, more = diff_messages(a, b, DiffOptions(absolute=(("*", 1.0),)), limit=2)
    assert [one.path for one in found] == ["big", "single"]
    assert [one.within_tolerance for one in found] == [False, True]
    assert more == 1


def test_globs_of_one_topic() -> None:
    options = DiffOptions(ignore=("/odom:header", "text"), absolute=(("/sca*:ranges", 1.0),))
    assert options.for_topic("/odom").ignore == ("header", "text")
    assert options.for_topic("/scan").ignore == ("text",)
    assert options.for_topic("/scan").absolute == (("ranges", 1.0),)
    assert options.for_topic("/odom").absolute == ()


@pytest.mark.parametrize(
    "wrong",
    [
        {"context": -1},
        {"window": 0},
        {"by": "name"},
        {"absolute": (("*", -1.0),)},
        {"relative": (("*", math.nan),)},
    ],
)
def test_options_that_make_no_sense(wrong: dict[str, Any]) -> None:
    with pytest.raises(TraceError):
        DiffOptions(**wrong)


def test_types_that_differ() -> None:
    other = decoder("float64 x\n", "pkg/msg/Other").decode(b"\0\1\0\0" + struct.pack("<d", 1.0))
    same = decoder("float64 x\nfloat64 y\n", "pkg/msg/Other").decode(
        b"\0\1\0\0" + struct.pack("<dd", 1.0, 2.0)
    )
    found = only(other, same)
    assert (found.path, found.a, found.b) == ("y", "absent", "2.0")
    found = only(same, other)
    assert (found.path, found.a, found.b) == ("y", "2.0", "absent")
    float32 = decoder("float32 x\n", "pkg/msg/Third").decode(b"\0\1\0\0" + struct.pack("<f", 1.0))
    found = only(other, float32)
    assert (found.path, found.a, found.b) == ("(whole)", "pkg/msg/Other", "pkg/msg/Third")


def test_words_of_python_are_fields_by_their_ros_names() -> None:
    with_class = decoder("int32 class\n", "pkg/msg/Word")
    a, b = (with_class.decode(b"\0\1\0\0" + struct.pack("<i", value)) for value in (1, 2))
    assert only(a, b).path == "class"
    assert preview(a) == "class: 1"


def test_plain_texts_are_compared_too() -> None:
    found = only("ValueError: 1", "ValueError: 2")
    assert (found.path, found.a, found.b) == ("(whole)", '"ValueError: 1"', '"ValueError: 2"')


def test_preview_is_one_short_line() -> None:
    shown = preview(message(text="a\nb", single=0.1), 300)
    assert shown.startswith('header: {stamp: 10.000000500, frame_id: "map"}, single: 0.1, ')
    assert 'text: "a\\nb"' in shown
    assert "points: [{x: 1.0, y: 2.0, z: 3.0}, {x: 4.0" in shown
    assert len(preview(message(), 20)) == 20
    assert preview(message(), 20).endswith("…")


floats = st.floats(allow_nan=False, allow_infinity=False)


@given(floats, floats)
def test_ulp_distance_counts_the_floats_between(a: float, b: float) -> None:
    distance = ulp_distance(a, b, 64)
    assert distance == ulp_distance(b, a, 64)
    assert (distance == 0) == (a == b)
    step = math.nextafter(a, b) if hasattr(math, "nextafter") else float(np.nextafter(a, b))
    if a != b:
        assert ulp_distance(step, b, 64) == distance - 1  # type: ignore[operator]


arrays = st.lists(
    st.floats(width=32) | st.sampled_from([0.0, -0.0, math.nan, math.inf]), max_size=12
)


@settings(max_examples=cases(10, 60), deadline=None)
@given(arrays, arrays, floats, floats, st.text(max_size=5), st.text(max_size=5))
def test_no_difference_is_found_exactly_when_the_bytes_are_equal(
    ranges_a: list[float], ranges_b: list[float], x: float, y: float, s: str, t: str
) -> None:
    s, t = s.replace("\0", ""), t.replace("\0", "")
    a = message(ranges=np.array(ranges_a, dtype=np.float32), double=x, text=s)
    b = message(ranges=np.array(ranges_b, dtype=np.float32), double=y, text=t)
    raw = [bytes(STORE.serialize_cdr(m, "pkg/msg/All")) for m in (a, b)]
    found, _ = diff_messages(a, b, ONLY)
    assert (raw[0] == raw[1]) == (not found)
    swapped, _ = diff_messages(b, a, ONLY)
    assert [(d.path, d.b, d.a, d.absolute) for d in swapped] == [
        (d.path, d.a, d.b, d.absolute) for d in found
    ]


@settings(max_examples=cases(25, 150), deadline=None)
@given(
    st.lists(st.sampled_from([0.0, -0.0, 1.0, math.nan]), min_size=1, max_size=3),
    st.lists(st.sampled_from([0.0, -0.0, 1.0, math.nan]), min_size=1, max_size=3),
    st.sampled_from([0.0, -0.0, 1.0, math.nan]),
    st.sampled_from([0.0, -0.0, 1.0, math.nan]),
    st.sampled_from([(), ("double",), ("ranges",), ("ranges[0]",), ("points",), ("*",)]),
)
def test_content_keys_are_equal_exactly_when_nothing_compared_differs(
    ranges_a: list[float], ranges_b: list[float], x: float, y: float, ignore: tuple[str, ...]
) -> None:
    a = message(ranges=np.array(ranges_a, dtype=np.float32), double=x)
    b = message(ranges=np.array(ranges_b, dtype=np.float32), double=y)
    options = DiffOptions(ignore=ignore)
    keys = [ContentKeys(FieldRules(options)).key(one) for one in (a, b)]
    assert (keys[0] == keys[1]) == (diff_messages(a, b, options) == ((), 0))


def test_content_keys_see_every_kind_of_field() -> None:
    changes: list[dict[str, Any]] = [
        {"single": 1.0},
        {"big": 1},
        {"small": -1},
        {"flag": True},
        {"text": "x"},
        {"ranges": np.array([0, 0, 0, 1], dtype=np.float32)},
        {"covariance": np.full(9, -0.0)},
        {"counts": np.array([7])},
        {"bits": np.array([False, True, False])},
        {"data": np.array([1], dtype=np.uint8)},
        {"names": ["", ""]},
        {"points": []},
    ]
    keys = ContentKeys(FieldRules(ONLY))
    seen = {keys.key(message(**change)) for change in ({}, *changes)}
    assert len(seen) == 1 + len(changes)
    ignoring = ContentKeys(FieldRules(DiffOptions(ignore=("ranges[2]",))))
    one, other, third = (
        message(ranges=np.array(values, dtype=np.float32))
        for values in ([1, 2, 3], [1, 2, 9], [1, 3, 3])
    )
    assert ignoring.key(one) == ignoring.key(other) != ignoring.key(third)


def test_tolerances_in_arrays_do_not_cover_what_has_no_distance() -> None:
    everything = DiffOptions(absolute=(("*", 1e300),), relative=(("*", 1e300),))

    def tolerated(a: list[float], b: list[float]) -> bool:
        left, right = (message(covariance=np.array(side + [0.0] * 7)) for side in (a, b))
        return only(left, right, everything).within_tolerance

    assert tolerated([1.0, 2.0], [3.0, 4.0])
    assert not tolerated([1.0, math.inf], [3.0, -math.inf])
    assert not tolerated([1.0, math.nan], [3.0, 4.0])
    assert not tolerated([1.0, math.inf], [3.0, 4.0])
    odd = nan_of(0x7FF8000000000001)
    assert tolerated([1.0, math.nan], [3.0, odd])


@pytest.mark.parametrize(
    ("a", "b", "text", "brief"),
    [
        ("0.123456789", "2.5", "x 0.1235 → 2.5", "x 0.1235 → 2.5"),
        ("1.4375", "1.437500001", "x 1.4375 → 1.437500001", "x 1.4375 → 1.437500001"),
        ("1.8125", "1.81250000075", "x 1.8125 → 1.812500001", "x 1.8125 → 1.812500001"),
        ("2.5", "2.5000000000000004", "x 2.5 → 2.5000000000000004", "x 2.5 → …0004"),
        ("0.0", "-0.0", "x 0.0 → -0.0", "x 0.0 → -0.0"),
        (
            *("1700000000123456789", "1700000000223456789"),
            *("x 1.7000000001e+18 → 1.7000000002e+18", "x …0001234567… → …0002234567…"),
        ),
        (
            *("-0.19956212899502732", "-0.19956212899502734"),
            *("x -0.19956212899502732 → -0.19956212899502734", "x …2732 → …2734"),
        ),
        ("nan", "1.23456789", "x nan → 1.235", "x nan → 1.235"),
    ],
)
def test_rounded_numbers_of_a_row_are_not_further_from_each_other_than_the_exact_ones(
    a: str, b: str, text: str, brief: str
) -> None:
    fields = (FieldDifference("x", a, b),)
    one = MessageDifference(
        OutputKind.MESSAGE, "/t", "a_msgs/msg/X", 0, Presence.BOTH, 1, 2, fields
    )
    assert event_differences_text([one]) == f"/t {text}"
    assert event_differences_text([one], brief=True) == brief
    received = replace(one, position=-1)
    assert event_differences_text([received]) == f"got /t {text}"
    assert event_differences_text([received], brief=True) == f"got /t {brief}"


def test_what_was_drawn_in_one_run_only_does_not_read_as_an_event_in_one_run_only() -> None:
    fields = (FieldDifference("draw", "none", "lost"),)
    one = MessageDifference(
        OutputKind.DRAW, "subscription /t", "", 1, Presence.ONLY_B, None, 2, fields
    )
    assert event_differences_text([one], brief=True) == "draw none → lost"
