"""Decoding by embedded schemas, and what a hostile schema can do: nothing."""

from __future__ import annotations

import json
import struct
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from rsltrace.diff.options import DiffOptions
from rsltrace.diff.sentences.values import notes_text
from rsltrace.diff.values.fields import diff_messages
from rsltrace.errors import TraceError
from rsltrace.trace.decode import Decoder, to_plain
from rsltrace.trace.index import ChannelInfo

CDR = b"\x00\x01\x00\x00"
SEPARATOR = "=" * 80


def decoder(text: str, name: str = "x/msg/T", encoding: str = "ros2msg") -> Decoder:
    return Decoder(ChannelInfo(1, "/topic", name, encoding, text, {}))


@pytest.fixture(scope="module")
def jazzy() -> Any:
    return get_typestore(Stores.ROS2_JAZZY)


def zeros(store: Any, name: str) -> Any:
    """A message in which everything is zero or empty."""

    def value(kind: Nodetype, detail: Any) -> Any:
        if kind == Nodetype.NAME:
            return zeros(store, detail)
        if kind == Nodetype.BASE:
            return "" if detail[0] == "string" else 0
        (item_kind, item), size = detail
        count = size if kind == Nodetype.ARRAY else 0
        if item_kind == Nodetype.NAME or item[0] == "string":
            return [value(item_kind, item) for _ in range(count)]
        return np.zeros(count, {"byte": "uint8", "char": "uint8"}.get(item[0], item[0]))

    return store.types[name](*(value(*field) for _, field in store.fielddefs[name][1]))


@pytest.mark.long
def test_every_message_type_of_ros_can_be_decoded(jazzy: Any) -> None:
    for name in jazzy.fielddefs:
        text, _ = jazzy.generate_msgdef(name, ros_version=2)
        made = decoder(text, name)
        decoded = to_plain(made.decode(bytes(jazzy.serialize_cdr(zeros(jazzy, name), name))))
        fields = {field for field, _ in jazzy.fielddefs[name][1]}
        assert decoded.keys() == fields - {"structure_needs_at_least_one_member"}, name


def test_a_message_with_everything_in_it(jazzy: Any) -> None:
    name = "sensor_msgs/msg/JointState"
    types = jazzy.types
    message = types[name](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=-1, nanosec=5), frame_id="a/ü"
        ),
        name=["left", "right"],
        position=np.array([1.0, float("nan")]),
        velocity=np.array([float("inf"), -float("inf")]),
        effort=np.array([]),
    )
    text, _ = jazzy.generate_msgdef(name, ros_version=2)
    made = decoder(text, name)
    plain, other_order = (
        to_plain(made.decode(bytes(jazzy.serialize_cdr(message, name, little_endian=little))))
        for little in (True, False)
    )
    assert other_order == plain
    assert plain == {
        "header": {"stamp": {"sec": -1, "nanosec": 5}, "frame_id": "a/ü"},
        "name": ["left", "right"],
        "position": [1.0, "NaN"],
        "velocity": ["Infinity", "-Infinity"],
        "effort": [],
    }
    json.dumps(plain, allow_nan=False)


def test_scalars_that_json_cannot_hold_become_texts() -> None:
    made = decoder("float64 a\nfloat32 b\nint64 c\nbool d\n")
    data = CDR + struct.pack("<df4xq?", float("nan"), -float("inf"), -(2**63), True)
    assert to_plain(made.decode(data)) == {"a": "NaN", "b": "-Infinity", "c": -(2**63), "d": True}


def test_an_empty_message_is_an_empty_object() -> None:
    assert to_plain(decoder("").decode(CDR + b"\0")) == {}


def test_constants_are_not_part_of_a_message() -> None:
    plain = to_plain(decoder("uint8 A=3\nstring B='x'\nuint8 c\n").decode(CDR + b"\7"))
    assert plain == {"c": 7}


def test_names_of_whole_numbers_are_kept_beside_the_message() -> None:
    made = decoder("uint8 LOW=3\nuint8 HIGH=4\nuint8 c\n")
    (found,), _ = diff_messages(made.decode(CDR + b"\3"), made.decode(CDR + b"\4"), DiffOptions())
    assert (found.path, found.a, found.b, notes_text(found)) == ("c", "3", "4", "LOW → HIGH")


def test_names_that_may_mean_another_field_are_not_told() -> None:
    made = decoder("uint8 LOW=3\nuint8 HIGH=4\nuint8 c\nuint8 d\n")
    (found,), _ = diff_messages(
        made.decode(CDR + b"\3\3"), made.decode(CDR + b"\4\3"), DiffOptions()
    )
    assert notes_text(found) == ""


def test_fields_may_have_names_that_python_reserves() -> None:
    plain = to_plain(decoder("uint8 class\nuint8 self\nuint8 cls\n").decode(CDR + b"\1\2\3"))
    assert list(plain.values()) == [1, 2, 3]


@pytest.mark.parametrize(
    "name", ["std_srvs/srv/Trigger_Response", "p/action/Fibonacci_Goal", "p/msg/T", "p/T"]
)
def test_types_of_services_and_actions_decode(name: str) -> None:
    data = CDR + b"\1\0\0\0\2\0\0\0a\0"
    assert to_plain(decoder("bool success\nstring message\n", name).decode(data)) == {
        "success": True,
        "message": "a",
    }


def test_a_service_may_name_messages_of_its_package_without_the_package() -> None:
    text = f"Inner inner\n{SEPARATOR}\nMSG: p/Inner\nuint8 a\n"
    assert to_plain(decoder(text, "p/srv/S_Request").decode(CDR + b"\5")) == {"inner": {"a": 5}}


def test_two_channels_may_define_a_type_in_two_ways() -> None:
    one = decoder(f"p/I i\n{SEPARATOR}\nMSG: p/I\nuint8 a\n")
    two = decoder(f"p/I i\n{SEPARATOR}\nMSG: p/I\nuint16 b\n")
    assert to_plain(one.decode(CDR + b"\1")) == {"i": {"a": 1}}
    assert to_plain(two.decode(CDR + b"\1\0")) == {"i": {"b": 1}}


def wide(*texts: str) -> bytes:
    """The CDR of a sequence of wide texts, as ROS 2 writes it."""
    units = [
        [*struct.unpack(f"<{len(d) // 2}H", d)] for d in (t.encode("utf-16-le") for t in texts)
    ]
    return struct.pack("<I", len(texts)) + b"".join(
        struct.pack(f"<I{len(some)}I", len(some), *some) for some in units
    )


def test_wide_texts_are_texts() -> None:
    text = (
        'wstring W="a"\nwstring<=7 one "x # y"\nuint8 a\np/I i\nwstring[] more # wstring[]\n'
        f"wstring[2] two\n{SEPARATOR}\nMSG: p/I\nwstring s\nuint8 b\n"
    )
    made = decoder(text)
    data = CDR + wide("Größe")[4:] + b"\1\0\0\0" + wide("")[4:] + b"\2\0\0\0"
    data += wide("日本", "\U0001f916") + wide("p", "q")[4:]
    plain = to_plain(made.decode(data))
    more = ["日本", "\U0001f916"]
    assert plain == {
        "one": "Größe", "a": 1, "i": {"s": "", "b": 2}, "more": more, "two": ["p", "q"]
    }  # fmt: skip
    other = made.decode(data.replace(struct.pack("<I", ord("本")), struct.pack("<I", ord("p"))))
    (found,), _ = diff_messages(made.decode(data), other, DiffOptions())
    assert (found.path, found.a, found.b) == ("more[0]", '"日本"', '"日p"')


@pytest.mark.parametrize("unit", [0xD800, 0x10000, 2**32 - 1])
def test_a_wide_text_that_is_no_utf_16_is_refused(unit: int) -> None:
    with pytest.raises(TraceError, match="does not fit its type"):
        decoder("wstring a\n").decode(CDR + struct.pack("<2I", 1, unit))


HOSTILE_TEXTS = {
    "a type it does not define": "p/Missing a\n",
    "a wide string of nothing": "wstring<=\n",
    "a type that contains itself": "T a\n",
    "types that contain each other": f"p/A a\n{SEPARATOR}\nMSG: p/A\nx/T t\n",
    "a huge array of strings": "string[100000000] a\n",
    "a huge array of messages": f"p/A[100000000] a\n{SEPARATOR}\nMSG: p/A\nuint8 b\n",
    "an array of nothing": "uint8[0] a\n",
    "a negative array": "uint8[-1] a\n",
    "a huge array": "uint8[99999999999999999999] a\n",
    "code in a name": 'uint8 a"""+__import__("os")\n',
    "code in a type": "p/A;import_os a\n",
    "a name that begins with a digit": f"p/A a\n{SEPARATOR}\nMSG: 1p/A\nuint8 a\n",
    "a name of underscores": f"p/A a\n{SEPARATOR}\nMSG: __/__/__\nuint8 a\n",
    "a name of six parts": f"p/A a\n{SEPARATOR}\nMSG: a/b/c/d/e/f\nuint8 a\n",
    "two fields of one name": "uint8 a\nuint16 a\n",
    "no fields at all": "%%%\n",
    "much text": "#" * (2 << 20),
    "a constant of 5000 digits": f"int32 A={'9' * 5000}\nuint8 a\n",
}


@pytest.mark.parametrize("text", HOSTILE_TEXTS.values(), ids=HOSTILE_TEXTS)
def test_schemas_no_interface_has_are_refused(text: str) -> None:
    with pytest.raises(
        TraceError, match=r"/topic cannot be decoded: the trace's schema of x/msg/T"
    ):
        decoder(text)


@pytest.mark.parametrize(
    "name",
    [
        "",
        "T",
        "x/msg/T\nuint8 evil",
        'x/msg/T"""\nimport os\n"""',
        "x/msg/" + "T" * 10 + "\n",
        "x/msg/T;",
        "../../T",
        "x/msg/Té",
    ],
)
def test_type_names_that_are_none_are_refused(name: str) -> None:
    with pytest.raises(TraceError, match="is not usable"):
        decoder("uint8 a\n", name)


def test_only_ros2msg_is_decoded() -> None:
    with pytest.raises(TraceError, match="its encoding is 'ros2idl'"):
        decoder("struct T {};", encoding="ros2idl")


def test_deep_but_sane_nesting_works_and_deeper_is_refused() -> None:
    def nested(depth: int) -> str:
        parts = ["p/A0 a\n"]
        for level in range(depth):
            inner = f"p/A{level + 1} a\np/A{level + 1} b\n" if level + 1 < depth else "uint8 a\n"
            parts.append(f"{SEPARATOR}\nMSG: p/A{level}\n{inner}")
        return "".join(parts)

    decoder(nested(8))
    with pytest.raises(TraceError, match="nested too deeply"):
        decoder(nested(40))  # with two of each, 2^40 paths: it must not walk them


INJECTIONS = st.sampled_from(
    [
        '"""',
        "'",
        "\n",
        ";",
        "__import__('sys').exit()",
        "=",
        "[",
        "]",
        "#",
        "\\",
        "(",
        ")",
        " ",
        "\t",
    ]
)
LINE = st.lists(
    INJECTIONS
    | st.sampled_from(["uint8", "a", "p/A", "[3]", "<=", "string", "1e999", "MSG:", "T"]),
    max_size=6,
).map("".join)


@given(lines=st.lists(LINE, max_size=6), name=st.just("x/msg/T") | LINE)
def test_mangled_schemas_are_refused_or_harmless(lines: list[str], name: str) -> None:
    modules = set(sys.modules)
    try:
        decoder("\n".join(lines), name)
    except TraceError:
        pass
    assert {m for m in set(sys.modules) - modules if not m.startswith("rosbags")} == set()


@given(data=st.binary(max_size=60))
def test_any_bytes_decode_or_are_a_trace_error(data: bytes) -> None:
    made = decoder(
        "string[] a\nuint32[<=4] b\nfloat64[2] c\np/A[] d\n" + f"{SEPARATOR}\nMSG: p/A\nstring s\n"
    )
    for header in (b"", CDR, b"\x00\x00\x00\x00"):
        try:
            plain = to_plain(made.decode(header + data))
        except TraceError:
            continue
        assert isinstance(plain, dict)
        assert list(plain) == ["a", "b", "c", "d"]
        assert (len(plain["b"]) <= 4, len(plain["c"])) == (True, 2)
        json.dumps(plain)


def test_a_count_larger_than_the_message_costs_nothing() -> None:
    for text in ("uint8[] a\n", "string[] a\n", f"p/E[] a\n{SEPARATOR}\nMSG: p/E\n"):
        with pytest.raises(TraceError, match="does not fit"):
            decoder(text).decode(CDR + b"\xff\xff\xff\xff")
