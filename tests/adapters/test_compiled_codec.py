"""The compiled plans against the generated functions: same bytes, values and errors, whatever a
field or the bytes hold."""

from __future__ import annotations

import array
import enum
import gc
import random
import struct
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rclpy")
pytest.importorskip("rclpy._rclpy_pybind11")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Path
from sensor_msgs.msg import Image, Imu, JointState
from std_msgs.msg import Float32, Float64, String
from test_msgs.msg import Arrays, BoundedSequences, Nested, UnboundedSequences, WStrings

from rsltrace import compiled
from rsltrace.adapters.rclpy.messages import codec as codecs
from rsltrace.adapters.rclpy.messages.codec import codec_for, compiled_plan
from rsltrace.adapters.rclpy.messages.decoder_source import make_deserializer
from rsltrace.adapters.rclpy.messages.encoder_source import make_serializer
from rsltrace.adapters.rclpy.messages.interfaces import type_name
from rsltrace.adapters.rclpy.messages.message_spec import HEADER, message_spec
from tests.adapters.test_codec import CLASSES, QUICK, Shouting, every_class, random_message, same
from tests.tiers import cases

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(compiled.core is None, reason="no compiler has built rsltrace._core"),
]

BROAD = [Imu, JointState, Path, Arrays, BoundedSequences, UnboundedSequences, Nested]
broad = pytest.mark.parametrize("cls", BROAD, ids=type_name)


def named(value: Any) -> str:
    return str(getattr(value, "__name__", type(value).__name__))


def outcome(call: Callable[[Any], Any], argument: Any) -> Any:
    """What a call returns, or the type and text of its error."""
    try:
        return call(argument)
    except Exception as error:
        return type(error), str(error), error.__context__ is None


def test_all_classes_have_plans_but_those_with_wide_texts() -> None:
    without = [type_name(cls) for cls in CLASSES if compiled_plan(cls) is None]
    assert without == ["test_msgs/msg/WStrings"]
    assert codec_for(WStrings).deserialize(codec_for(WStrings).serialize(WStrings())) == WStrings()


@pytest.mark.few(30)
@every_class
@settings(QUICK, max_examples=3)
@given(seed=st.integers(0, 2**32))
def test_usual_messages_need_no_python(
    cls: type, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    if compiled_plan(cls) is None:
        return

    def refuse(*args: Any) -> Any:
        raise AssertionError("the compiled code did not handle this")

    spec, plan = message_spec(cls), compiled_plan(cls)
    monkeypatch.setattr(codecs, "_serializer", refuse)
    monkeypatch.setattr(codecs, "_deserializer", refuse)
    rng = random.Random(seed)
    for _ in range(3):  # of several sizes: the plan guesses that of the last one
        message = random_message(spec, rng)
        raw = make_serializer(spec)(message)
        assert plan.serialize(message) == raw
        read = plan.deserialize(raw)
        assert same(read, make_deserializer(spec)(raw))
        assert gc.is_tracked(read) == gc.is_tracked(cls())


class Level(enum.IntEnum):
    HIGH = 7


class Real(float):
    pass


class Many(list[Any]):
    pass


SIGNALING = struct.unpack("<d", struct.pack("<Q", 0x7FF0_0000_0000_0001))[0]
NOTHING = object()

ODD: list[Any] = [
    NOTHING,
    *(None, True, False, np.True_, 0, -1, 127, 128, 255, 256, -129, 2**15, 2**16, -(2**31)),
    *(2**31, 2**32, 2**63, -(2**63), -(2**63) - 1, 2**64 - 1, 2**64, 2**70, Level.HIGH),
    *(np.int64(3), np.uint8(3), 1.5, -0.0, float("nan"), float("-inf"), 3.5e38, 1e300, SIGNALING),
    *(
        Real(2.5),
        np.float64(2.5),
        np.float32(2.5),
        1j,
        "",
        "a",
        "a\0",
        "ä€😀",
        "\ud800",
        np.str_("n"),
    ),
    *(Shouting("s"), b"", b"a", b"ab", b"\1\0\1", bytearray(b"abc"), memoryview(b"abc")),
    *(
        [],
        (),
        [1],
        [1.0, 2.0, 3.0],
        ["a", "b", "c"],
        ("a", "b", "c"),
        [b"a", b"b", b"c"],
        [True] * 3,
    ),
    *(
        (True, False, True),
        [True] * 2 + [1],
        [None] * 3,
        ["a"] * 4,
        Many(["a", "b", "c"]),
        {},
        {1: 2},
    ),
    *([Point()] * 3, [Time()] * 3, Point(), Time(), Point, object, {"a": 1}.items(), range(3)),
    *(array.array(code, [1, 2, 3]) for code in "bBhHiIlLqQfd"),
    *(array.array("d"), array.array("d", range(300))),
    *(np.zeros(9), np.zeros(3), np.zeros(3, "u1"), np.zeros(3, "f4"), np.zeros(9, ">f8")),
    *(np.zeros((3, 3)), np.arange(18.0)[::2], np.arange(9.0)[::-1], np.zeros(0), np.float64(1)),
    *(np.zeros(9, dtype=object), np.array(["a", "b", "c"]), np.ma.zeros(9), np.zeros(36)[::4]),
]


def spoil(message: Any, rng: random.Random) -> None:
    """Put something odd into one of the slots, at any depth."""
    while True:
        spec = message_spec(type(message))
        if not spec.fields:
            return
        field = rng.choice(spec.fields)
        value = getattr(message, field.slot)
        inner = value[0] if type(value) is list and value else value
        if hasattr(inner, "SLOT_TYPES") and rng.random() < 0.8:
            message = inner
            continue
        odd = rng.choice(ODD)
        if type(value) is list and value and rng.random() < 0.5:
            value[rng.randrange(len(value))] = odd
        elif odd is NOTHING:
            delattr(message, field.slot)
        else:
            setattr(message, field.slot, odd)
        return


@pytest.mark.few(30)
@every_class
@settings(QUICK, max_examples=cases(2, 20))
@given(seed=st.integers(0, 2**32))
def test_whatever_a_field_holds_gives_the_same_bytes_or_error(cls: type, seed: int) -> None:
    rng = random.Random(seed)
    generated = make_serializer(message_spec(cls))
    for _ in range(20):
        message = random_message(message_spec(cls), rng)
        spoil(message, rng)
        assert outcome(codec_for(cls).serialize, message) == outcome(generated, message)


@pytest.mark.parametrize("odd", [*BROAD, None, 5, NOTHING], ids=named)
def test_what_is_no_message_of_the_class_gives_the_same_error(odd: Any) -> None:
    generated = make_serializer(message_spec(String))
    value = odd() if isinstance(odd, type) else odd
    assert outcome(codec_for(String).serialize, value) == outcome(generated, value)


@pytest.mark.few(30)
@every_class
@settings(QUICK, max_examples=cases(2, 20))
@given(seed=st.integers(0, 2**32))
def test_spoiled_bytes_give_the_same_message_or_error(cls: type, seed: int) -> None:
    rng = random.Random(seed)
    generated = make_deserializer(message_spec(cls))
    whole = codec_for(cls).serialize(random_message(message_spec(cls), rng))
    for _ in range(20):
        raw = bytearray(whole[: rng.choice((len(whole), rng.randrange(len(whole) + 1)))])
        for _ in range(rng.randrange(4)):
            place = rng.randrange(len(raw) + 1)
            if rng.random() < 0.2:
                raw[place:place] = rng.randbytes(rng.randrange(9))
            else:
                raw[place : place + 1] = rng.choice((b"\0", b"\1", b"\5", b"\x7f", b"\xff"))
        found = outcome(codec_for(cls).deserialize, bytes(raw))
        assert same(found, outcome(generated, bytes(raw)))


@broad
def test_every_truncation_gives_the_same_error(cls: type) -> None:
    generated = make_deserializer(message_spec(cls))
    whole = codec_for(cls).serialize(random_message(message_spec(cls), random.Random(5)))
    for size in range(len(whole)):
        found = outcome(codec_for(cls).deserialize, whole[:size])
        assert found == outcome(generated, whole[:size])


@pytest.mark.parametrize("odd", [bytearray, memoryview, bytes.hex, len], ids=named)
def test_bytes_of_other_types_are_read_alike(odd: Callable[[bytes], Any]) -> None:
    raw = odd(codec_for(Imu).serialize(Imu()))
    generated = make_deserializer(message_spec(Imu))
    assert same(outcome(codec_for(Imu).deserialize, raw), outcome(generated, raw))


@pytest.mark.parametrize("bits", [0x7F800001, 0xFFA00000, 0x7FC00001, 0xFFFFFFFF, 0x7F800000, 1])
def test_bits_of_a_float32_are_kept_as_struct_keeps_them(bits: int) -> None:
    raw = HEADER + struct.pack("<I", bits)
    read = codec_for(Float32).deserialize(raw)
    assert same(read, make_deserializer(message_spec(Float32))(raw))
    assert codec_for(Float32).serialize(read) == make_serializer(message_spec(Float32))(read)


@pytest.mark.parametrize("sizes", [(2 << 20, 1 << 20, 5 << 20, 0, 7), (4095, 4096, 4097, 1)])
def test_large_messages_after_small_ones_and_the_other_way_round(sizes: tuple[int, ...]) -> None:
    for size in sizes:
        message = Image(encoding="x" * (size % 5), data=random.Random(size).randbytes(size))
        raw = codec_for(Image).serialize(message)
        assert raw == make_serializer(message_spec(Image))(message)
        assert same(codec_for(Image).deserialize(raw), message)


def test_an_array_that_was_read_can_grow_and_one_that_was_written_is_free_again() -> None:
    message = codec_for(JointState).deserialize(
        codec_for(JointState).serialize(JointState(position=[1.0, 2.0], effort=[3.0] * 2000))
    )
    codec_for(JointState).serialize(message)
    for values in (message.position, message.velocity, message.effort):
        count = len(values)
        values.extend([0.5] * 1000)  # BufferError if somebody still looked at it
        assert len(values) == count + 1000
    message.velocity[0] = 2.0
    assert codec_for(JointState).deserialize(
        codec_for(JointState).serialize(JointState())
    ).velocity == (array.array("d"))


@broad
def test_no_reference_is_lost_or_kept(cls: type) -> None:
    rng = random.Random(3)
    codec, spec = codec_for(cls), message_spec(cls)
    messages = [random_message(spec, rng) for _ in range(20)]
    for message in messages[10:]:
        spoil(message, rng)
    whole = codec.serialize(messages[0])
    spoiled = [whole[:size] for size in range(0, len(whole), 7)]
    counted = [cls, PoseStamped, Point, None, True, 0, "", (), b"a", np.ndarray, array.array]
    counted += [np.dtype("f8"), np.dtype("u1"), messages[0], whole]
    counted += [getattr(messages[0], field.slot) for field in spec.fields]

    def work() -> None:
        for message in messages:
            outcome(codec.serialize, message)
        for raw in (whole, *spoiled):
            outcome(codec.deserialize, raw)

    work()
    gc.collect()
    before = [sys.getrefcount(value) for value in counted]
    for _ in range(50):
        work()
    gc.collect()
    after = [sys.getrefcount(value) for value in counted]
    assert max(abs(one - other) for one, other in zip(before, after, strict=True)) < 40


def test_a_class_without_such_slots_has_no_plan() -> None:
    fields = (("_nothing", "d", 8, 0, 1, 8, None),)
    with pytest.raises(AttributeError, match="_nothing"):
        compiled.core.MessagePlan(Float64, None, fields, None, None)
