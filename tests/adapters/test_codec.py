"""The codecs against the real rclpy serializer: every installed type, and whatever a field holds.

rclpy is asked through its C extension itself, so that these tests mean the same when another test
of the session has put rsltrace's middleware in front of it.
"""

from __future__ import annotations

import array
import importlib
import math
import random
import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("rclpy")
native = pytest.importorskip("rclpy._rclpy_pybind11")

from builtin_interfaces.msg import Time  # noqa: E402
from geometry_msgs.msg import Point, Pose, Vector3  # noqa: E402
from rclpy.type_support import check_for_type_support  # noqa: E402
from sensor_msgs.msg import Imu, JointState, LaserScan, NavSatFix, PointCloud2  # noqa: E402
from std_msgs.msg import (  # noqa: E402
    Bool,
    Byte,
    Float32,
    Float64,
    Header,
    Int8,
    Int32,
    String,
    UInt8,
    UInt64,
)
from std_srvs.srv import Trigger  # noqa: E402
from test_msgs.action import Fibonacci  # noqa: E402
from test_msgs.msg import (  # noqa: E402
    Arrays,
    BasicTypes,
    BoundedPlainSequences,
    BoundedSequences,
    Empty,
    UnboundedSequences,
    WStrings,
)

from rsltrace.adapters.rclpy.messages import decoder_source as codec_read  # noqa: E402
from rsltrace.adapters.rclpy.messages import encoder_source as codec_write  # noqa: E402
from rsltrace.adapters.rclpy.messages.checked_codec import decode, encode  # noqa: E402
from rsltrace.adapters.rclpy.messages.codec import codec_for  # noqa: E402
from rsltrace.adapters.rclpy.messages.interfaces import schema_text, type_name  # noqa: E402
from rsltrace.adapters.rclpy.messages.message_spec import (  # noqa: E402  # noqa: E402
    HEADER,
    START,
    ArrayType,
    KnownOffset,
    MessageSpec,
    PrimitiveType,
    StringType,
    message_spec,
)
from tests.tiers import cases  # noqa: E402

pytestmark = pytest.mark.ros

QUICK = settings(
    deadline=None, database=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


# -- every installed message class -----------------------------------------------------------------


def installed_message_classes() -> list[type]:
    """Every message of every interface package, and every part of its services and actions."""
    index = Path(native.__file__).parents[4] / "share/ament_index/resource_index"
    found: dict[str, type] = {}
    for package in sorted(path.name for path in (index / "rosidl_interfaces").iterdir()):
        for kind in ("msg", "srv", "action"):
            try:
                exported = vars(importlib.import_module(f"{package}.{kind}"))
            except ModuleNotFoundError:
                continue
            modules = {v.__module__ for v in exported.values() if isinstance(v, type)}
            for module in sorted(modules):
                for value in vars(sys.modules[module]).values():
                    if hasattr(value, "SLOT_TYPES") and value.__module__ == module:
                        found[type_name(value)] = value
    return [found[name] for name in sorted(found)]


CLASSES = installed_message_classes()


def _case_id(value: object) -> str:
    """Name a parameter; never with an address, which pytest-xdist's workers would not share."""
    return repr(value).split(" object at ")[0]


every_class = pytest.mark.parametrize("cls", CLASSES, ids=type_name)


def test_there_are_many_classes_of_every_kind() -> None:
    kinds = [type_name(cls).split("/")[1] for cls in CLASSES]
    assert kinds.count("msg") > 150
    assert kinds.count("srv") > 40
    assert kinds.count("action") > 15


# -- random messages -------------------------------------------------------------------------------

LETTERS = "abcdefghij_/ äöß€漢😀\U0010ffff"


def random_message(spec: MessageSpec, rng: random.Random) -> Any:
    message = spec.cls()
    for field in spec.fields:
        setattr(message, field.name, random_value(field.type, rng))
    return message


def random_value(type_: Any, rng: random.Random) -> Any:
    if isinstance(type_, PrimitiveType):
        return random_primitive(type_, rng)
    if isinstance(type_, StringType):
        limit = 9 if type_.bound is None else min(9, type_.bound)
        return "".join(rng.choices(LETTERS, k=rng.randint(0, limit)))
    if isinstance(type_, MessageSpec):
        return random_message(type_, rng)
    if isinstance(type_, ArrayType):
        number = type_.length
    else:
        number = rng.choice((0, 0, 1, 2, 3) if type_.bound is None else range(type_.bound + 1))
        number = min(number, 3)
    if isinstance(type_.item, PrimitiveType) and type_.item.typecode:
        raw = rng.randbytes(number * type_.item.size)
        if isinstance(type_, ArrayType):
            return np.frombuffer(raw, type_.item.dtype)
        return array.array(type_.item.typecode, raw)
    return [random_value(type_.item, rng) for _ in range(number)]


def random_primitive(type_: PrimitiveType, rng: random.Random) -> Any:
    if type_.name == "boolean":
        return rng.random() < 0.5
    if type_.name == "octet":
        return rng.randbytes(1)
    if type_.code in "fd":
        return rng.choice((0.0, -0.0, 0.1, -1.5e30, math.inf, -math.inf, math.nan, rng.gauss(0, 1)))
    bits = 8 * type_.size
    low = -(1 << bits - 1) if type_.code.islower() else 0
    return rng.choice((0, low, low + (1 << bits) - 1, low + rng.getrandbits(bits)))


def same(one: Any, other: Any) -> bool:
    """Equal to the last bit, and of the same types throughout."""
    if type(one) is not type(other):
        return False
    if isinstance(one, float):
        return struct.pack("d", one) == struct.pack("d", other)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, array.array):
        return one.typecode == other.typecode and one.tobytes() == other.tobytes()
    if isinstance(one, np.ndarray):
        return (
            one.dtype is other.dtype
            and one.shape == other.shape
            and one.tobytes() == other.tobytes()
            and one.flags == other.flags
        )
    if hasattr(one, "SLOT_TYPES"):
        return all(same(getattr(one, slot), getattr(other, slot)) for slot in one.__slots__)
    return bool(one == other)


# -- rclpy as the oracle ---------------------------------------------------------------------------


def native_serialize(message: Any) -> bytes:
    check_for_type_support(type(message))
    return bytes(native.rclpy_serialize(message, type(message)))


def native_deserialize(raw: bytes, cls: type) -> Any:
    check_for_type_support(cls)
    return native.rclpy_deserialize(raw, cls)


def padding(message: Any) -> list[int]:
    """The indices of padding bytes: where two encodings with different padding differ."""
    spec = message_spec(type(message))
    pairs = zip(encode(spec, message, fill=0), encode(spec, message, fill=255), strict=True)
    return [index for index, (one, other) in enumerate(pairs) if one != other]


def assert_as_native(message: Any, raw: bytes) -> None:
    """``raw`` is what rclpy gives but for padding, which is zero."""
    expected = bytearray(native_serialize(message))
    # It may also return more bytes than it writes (the greatest size of a bounded type, or an
    # estimate that aligns empty sequences), garbage that never reaches the wire.
    assert len(expected) >= len(raw)
    del expected[len(raw) :]
    for index in padding(message):
        expected[index] = 0
        assert raw[index] == 0
    assert raw.hex(" ") == expected.hex(" ")


def fast_only(cls: type, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any]:
    """The generated functions of a class, without the careful ones that would hide their faults."""

    def refuse(*args: Any) -> Any:
        raise AssertionError("the generated code did not handle this")

    with monkeypatch.context() as patch:
        patch.setattr(codec_write, "encode", refuse)
        patch.setattr(codec_read, "decode", refuse)
        spec = message_spec(cls)
        return codec_write.make_serializer(spec), codec_read.make_deserializer(spec)


@pytest.mark.few(30)
@every_class
@settings(QUICK, max_examples=3)
@given(seed=st.integers(0, 2**32))
def test_bytes_and_messages_are_those_of_rclpy(
    cls: type, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    spec = message_spec(cls)
    serialize, deserialize = fast_only(cls, monkeypatch)
    message = random_message(spec, random.Random(seed))

    raw = serialize(message)
    assert_as_native(message, raw)
    assert encode(spec, message) == raw

    expected = native_deserialize(raw, cls)
    assert same(deserialize(raw), expected)
    assert same(decode(spec, raw), expected)
    assert serialize(deserialize(raw)) == raw


@pytest.mark.few(30)
@every_class
@settings(QUICK, max_examples=2)
@given(seed=st.integers(0, 2**32))
def test_dirty_padding_is_cleaned(cls: type, seed: int) -> None:
    rng = random.Random(seed)
    codec = codec_for(cls)
    message = random_message(message_spec(cls), rng)
    raw = codec.serialize(message)

    dirty = bytearray(raw)
    for index in padding(message):
        dirty[index] = rng.randrange(256)
    dirty[2:4] = rng.randbytes(2)  # options of the encapsulation: some say there what they padded
    dirty += rng.randbytes(-len(raw) % 4)
    assert codec.canonical(bytes(dirty)) == raw
    assert codec.canonical(raw) == raw
    assert codec.canonical(native_serialize(message)) == raw
    assert codec.serialize(codec.deserialize(bytes(dirty))) == raw


@every_class
def test_a_big_endian_message_is_read_as_rclpy_reads_it(cls: type) -> None:
    spec = message_spec(cls)
    message = random_message(spec, random.Random(type_name(cls)))
    raw = b"\0\0\0\0" + big_endian(spec, message, bytearray())
    assert same(codec_for(cls).deserialize(raw), native_deserialize(raw, cls))
    assert codec_for(cls).canonical(raw) == codec_for(cls).serialize(message)


def big_endian(type_: Any, value: Any, out: bytearray) -> bytearray:
    """A second, independent encoder: the rules of CDR in the other byte order."""

    def put(code: str, *values: Any) -> None:
        size = struct.calcsize(code)
        for one in values:
            out.extend(bytes(-len(out) % size))
            out.extend(struct.pack(">" + code, one))

    if isinstance(type_, PrimitiveType):
        put(type_.code, value)
    elif isinstance(type_, StringType) and type_.wide:
        units = np.frombuffer(value.encode("utf-16-le"), "<u2").tolist()
        put("I", len(units), *units)
    elif isinstance(type_, StringType):
        put("I", len(value.encode()) + 1)
        out.extend(value.encode() + b"\0")
    elif isinstance(type_, MessageSpec):
        for field in type_.fields:
            big_endian(field.type, getattr(value, field.name), out)
        out.extend(b"" if type_.fields else b"\0")
    else:
        if not isinstance(type_, ArrayType):
            put("I", len(value))
        if isinstance(value, np.ndarray | array.array) and len(value):
            size = type_.item.size
            swapped = np.frombuffer(value.tobytes(), f"u{size}").byteswap().tobytes()
            out.extend(bytes(-len(out) % size) + swapped)
            return out
        for item in value:
            big_endian(type_.item, item, out)
    return out


@pytest.mark.parametrize("length", range(1, 9))
def test_a_nav_sat_fix_hashes_alike_on_a_dirty_heap(length: int) -> None:
    # The finding that made rsltrace write its own serializer.
    message = NavSatFix(header=Header(stamp=Time(sec=5, nanosec=7), frame_id="x" * length))
    message.latitude, message.longitude, message.altitude = 48.1, 11.5, 520.0
    codec = codec_for(NavSatFix)
    expected = codec.serialize(message)
    natives = set()
    for turn in range(300):
        litter = [bytes((turn % 256,)) * (60 + turn % 90) for _ in range(20)]
        natives.add(native_serialize(message))
        del litter
        assert codec.serialize(message) == expected
    assert {codec.canonical(raw) for raw in natives} == {expected}


def test_a_trigger_response_has_no_garbage_after_its_bool() -> None:
    raw = codec_for(Trigger.Response).serialize(Trigger.Response(success=True, message="ok"))
    assert raw == HEADER + b"\1\0\0\0" + b"\3\0\0\0ok\0"


def test_services_and_actions_have_codecs() -> None:
    impl = Fibonacci.Impl
    for cls in (
        Trigger.Request,
        Trigger.Event,
        Fibonacci.Goal,
        impl.SendGoalService.Request,
        impl.GetResultService.Response,
        impl.FeedbackMessage,
    ):
        raw = codec_for(cls).serialize(cls())
        assert same(codec_for(cls).deserialize(raw), native_deserialize(raw, cls))
    assert codec_for(impl.SendGoalService.Request).type_name == (
        "test_msgs/action/Fibonacci_SendGoal_Request"
    )


def test_an_empty_message_is_one_zero_byte() -> None:
    assert codec_for(Empty).serialize(Empty()) == HEADER + b"\0"
    assert codec_for(Empty).canonical(HEADER + b"\x55") == HEADER + b"\0"
    with pytest.raises(ValueError, match="truncated"):
        codec_for(Empty).deserialize(HEADER)


def test_a_codec_is_made_once_per_class() -> None:
    assert codec_for(UInt64) is codec_for(UInt64)
    assert codec_for(UInt64).serialize is codec_for(UInt64).serialize


def test_a_class_that_is_no_message_is_refused() -> None:
    with pytest.raises(TypeError, match="not a ROS interface"):
        codec_for(int)
    with pytest.raises(TypeError, match=r"std_srvs/srv/Trigger is not a message"):
        codec_for(Trigger)


def test_a_message_shares_no_memory_with_its_bytes() -> None:
    codec = codec_for(Imu)
    raw = bytearray(codec.serialize(Imu()))
    message = codec.deserialize(raw)  # type: ignore[arg-type]
    raw[:] = b"\xff" * len(raw)
    assert message == Imu()
    message.orientation_covariance[0] = 1.0  # and it can be changed
    scan = codec_for(LaserScan).deserialize(codec_for(LaserScan).serialize(LaserScan()))
    scan.ranges.append(1.0)


@pytest.mark.parametrize("number", [0, 1, 4095, 4096, 100_000])
def test_long_sequences(number: int) -> None:
    message = PointCloud2(data=bytes(range(256)) * (number // 256) + bytes(number % 256))
    raw = codec_for(PointCloud2).serialize(message)
    assert_as_native(message, raw)
    assert same(codec_for(PointCloud2).deserialize(raw), message)


# -- what a user may have stored in a field --------------------------------------------------------


class Shouting(str):
    __slots__ = ()

    def encode(self, *args: Any) -> bytes:
        return b"!!"


def message_with(cls: type, field: str, value: Any) -> Any:
    message = cls()
    setattr(message, field, value)
    return message


@pytest.mark.parametrize(
    ("cls", "field", "value"),
    [
        (Float64, "data", np.float64(0.1)),
        (Float32, "data", 1e300),
        (Float32, "data", -1e300),
        (Float32, "data", 0.1),
        (UInt64, "data", True),
        (UInt64, "data", 2**64 - 1),
        (UInt8, "data", 300),
        (Int8, "data", 300),
        (Int8, "data", -300),
        (Int32, "data", 2**40 + 7),
        (String, "data", "ab\0cd"),
        (String, "data", "\0"),
        (String, "data", "äö€😀"),
        (String, "data", Shouting("abc")),
        (String, "data", np.str_("abc")),
        (Byte, "data", b"ab"),
        (Byte, "data", b""),
        (Imu, "orientation_covariance", [1] * 9),
        (Imu, "orientation_covariance", tuple(range(12))),
        (Imu, "orientation_covariance", np.arange(18, dtype=np.float64)[::2]),
        (LaserScan, "ranges", [1, 2, 3]),
        (LaserScan, "ranges", np.arange(5, dtype=np.float32)),
        (LaserScan, "ranges", array.array("d", [0.5, 1.5])),
        (PointCloud2, "data", bytearray(b"abc")),
        (JointState, "name", ("a", "bc")),
        (JointState, "name", {"only"}),
        (JointState, "name", "abc"),
        (JointState, "name", np.array(["a", "bcd"])),
        (UnboundedSequences, "bool_values", (True, False)),
        (UnboundedSequences, "bool_values", np.array([True, False, True])),
        (UnboundedSequences, "bool_values", b"\1\0"),
        (UnboundedSequences, "byte_values", b"abc"),
        (UnboundedSequences, "byte_values", [b"ab", b""]),
        (UnboundedSequences, "byte_values", np.array([1.0, 2.0])),
        (UnboundedSequences, "basic_types_values", (BasicTypes(), BasicTypes(int8_value=3))),
        (UnboundedSequences, "_float64_values", [1.0, 2.5]),
        (UnboundedSequences, "_float64_values", np.array([1.0, 2.5])),
        (UnboundedSequences, "_float64_values", array.array("f", [1.0, 2.5])),
        (Arrays, "string_values", ["a", "b", "c", "never sent"]),
        (Arrays, "bool_values", (True, True, False)),
        (Arrays, "bool_values", [True, True, False, True]),
        (Arrays, "byte_values", [b"ab", b"", b"c"]),
        (Arrays, "basic_types_values", tuple(BasicTypes() for _ in range(4))),
        (WStrings, "wstring_value", "aä😀\0b"),
        (WStrings, "wstring_value", "\ufeffa"),
    ],
    ids=_case_id,
)
def test_what_rclpy_converts_is_converted_alike(cls: type, field: str, value: Any) -> None:
    message = message_with(cls, field, value)
    raw = codec_for(cls).serialize(message)
    assert_as_native(message, raw)
    assert same(codec_for(cls).deserialize(raw), native_deserialize(raw, cls))


class MyPoint(Point):
    pass


@pytest.mark.parametrize(
    ("cls", "field", "value", "error", "text"),
    [
        (Float64, "data", 5, TypeError, "must be a float .*, but is int 5"),
        (Float64, "data", np.float32(5), TypeError, "must be a float .*, but is float32"),
        (Float64, "data", None, TypeError, "must be a float .*, but is NoneType None"),
        (UInt64, "data", 5.0, TypeError, "must be an int .*, but is float 5.0"),
        (UInt64, "data", np.uint64(5), TypeError, "must be an int .*, but is uint64"),
        (UInt64, "data", -1, ValueError, "is -1, which is out of range for uint64"),
        (UInt64, "data", 2**64, ValueError, "out of range for uint64"),
        (UInt8, "data", -1, ValueError, "out of range for uint8"),
        (Int32, "data", 2**70, ValueError, "out of range for int32"),
        (Bool, "data", 1, TypeError, "must be a bool .*, but is int 1"),
        (Bool, "data", np.True_, TypeError, "must be a bool .*, but is bool"),
        (Byte, "data", bytearray(b"a"), TypeError, "must be bytes of length 1"),
        (Byte, "data", 1, TypeError, "must be bytes of length 1"),
        (String, "data", b"abc", TypeError, "must be a str, but is bytes b'abc'"),
        (String, "data", None, TypeError, "must be a str, but is NoneType"),
        (String, "data", "a\ud800", UnicodeEncodeError, "surrogates not allowed .*field 'data'"),
        (WStrings, "wstring_value", "\ud800", UnicodeEncodeError, "field 'wstring_value'"),
        (Pose, "position", None, TypeError, "must be a geometry_msgs/msg/Point message"),
        (Pose, "position", Vector3(), TypeError, "must be a geometry_msgs/msg/Point message"),
        (Pose, "position", MyPoint(), TypeError, "must be a geometry_msgs/msg/Point message"),
        (Imu, "orientation_covariance", np.eye(3), ValueError, r"with shape \(3, 3\)"),
        (Imu, "orientation_covariance", [1.0] * 5, ValueError, r"with shape \(5,\)"),
        (
            Imu,
            "_orientation_covariance",
            [1.0] * 9,
            TypeError,
            "must be a numpy array of 9 float64",
        ),
        (Imu, "_orientation_covariance", np.zeros(9, ">f8"), ValueError, "must be a numpy array"),
        (JointState, "name", ["a", 1], TypeError, r"'name\[1\]' must be a str, but is int 1"),
        (JointState, "name", {"a": 1}, TypeError, "must be a sequence, but is dict"),
        (JointState, "name", iter("ab"), TypeError, "must be a sequence"),
        (JointState, "name", None, TypeError, "must be a sequence, but is NoneType"),
        (
            UnboundedSequences,
            "bool_values",
            [1, 0],
            TypeError,
            r"'bool_values\[0\]' must be a bool",
        ),
        (UnboundedSequences, "bool_values", b"\2", ValueError, "other than 0 and 1"),
        (UnboundedSequences, "bool_values", 3, TypeError, "must be a sequence"),
        (UnboundedSequences, "byte_values", [1], TypeError, r"'byte_values\[0\]' must be bytes"),
        (
            UnboundedSequences,
            "byte_values",
            np.arange(8, dtype="u1")[::2],
            ValueError,
            "not C-contiguous",
        ),
        (
            UnboundedSequences,
            "basic_types_values",
            [Point()],
            TypeError,
            r"_values\[0\]' must be a",
        ),
        (UnboundedSequences, "_float64_values", [1], TypeError, r"_values\[0\]' must be a float"),
        (UnboundedSequences, "_float64_values", array.array("f", [1]), ValueError, "whole number"),
        (BoundedSequences, "uint8_values", [1] * 4, ValueError, "4 items, more than its bound 3"),
        (
            BoundedSequences,
            "string_values",
            ["a"] * 4,
            ValueError,
            "4 items, more than its bound 3",
        ),
        (
            BoundedSequences,
            "basic_types_values",
            [BasicTypes()] * 4,
            ValueError,
            "4 items, more than its bound 3",
        ),
        (Arrays, "string_values", ["a"], ValueError, "has 1 items instead of 3"),
        (
            Arrays,
            "bool_values",
            np.array([True] * 3),
            TypeError,
            r"'bool_values\[0\]' must be a bool",
        ),
    ],
    ids=_case_id,
)
def test_what_rclpy_cannot_convert_is_refused_by_name(
    cls: type, field: str, value: Any, error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text) as caught:
        codec_for(cls).serialize(message_with(cls, field, value))
    assert f"{type_name(cls)}: field '{field.lstrip('_')}" in str(caught.value)
    assert caught.value.__context__ is None or isinstance(caught.value, ValueError | TypeError)


def test_an_error_names_the_whole_path_to_the_field() -> None:
    message = UnboundedSequences(basic_types_values=[BasicTypes(), BasicTypes()])
    message.basic_types_values[1].float64_value = 7
    with pytest.raises(TypeError) as caught:
        codec_for(UnboundedSequences).serialize(message)
    assert str(caught.value) == (
        "test_msgs/msg/UnboundedSequences: field 'basic_types_values[1].float64_value' must be "
        "a float (convert integers and numpy.float32), but is int 7"
    )


def test_a_message_of_another_class_is_refused() -> None:
    with pytest.raises(TypeError, match="expected a message of type std_msgs/msg/UInt64"):
        codec_for(UInt64).serialize(UInt8())


def test_a_deleted_field_is_named() -> None:
    message = UInt64()
    del message._data
    with pytest.raises(ValueError, match="field 'data' has no value"):
        codec_for(UInt64).serialize(message)


# -- hostile bytes ---------------------------------------------------------------------------------

SAMPLES = [UInt64, Imu, JointState, PointCloud2, UnboundedSequences, Arrays, WStrings, Empty]


@pytest.mark.parametrize("cls", SAMPLES, ids=type_name)
def test_truncated_bytes_are_refused_at_every_length(cls: type) -> None:
    raw = codec_for(cls).serialize(random_message(message_spec(cls), random.Random(1)))
    for size in range(len(raw)):
        with pytest.raises(ValueError, match=f"^{type_name(cls)}: .*(truncated|too short)"):
            codec_for(cls).deserialize(raw[:size])
        with pytest.raises(ValueError):
            codec_for(cls).canonical(raw[:size])


def test_truncation_is_located() -> None:
    with pytest.raises(ValueError) as caught:
        codec_for(UInt64).deserialize(HEADER + bytes(5))
    assert str(caught.value) == (
        "std_msgs/msg/UInt64: truncated: field 'data' needs 8 bytes at offset 4, "
        "but only 5 are left"
    )


def test_trailing_bytes_are_refused_unless_they_pad_to_a_multiple_of_four() -> None:
    raw = codec_for(String).serialize(String(data="abcd"))  # 13 bytes
    assert codec_for(String).deserialize(raw + b"xyz").data == "abcd"
    for extra in (1, 2, 4, 7, 100):
        with pytest.raises(ValueError, match=r"ends at offset 13, but there are \d+ bytes"):
            codec_for(String).deserialize(raw + bytes(extra))
    for extra in (1, 4):
        with pytest.raises(ValueError, match="ends at offset 12"):
            codec_for(UInt64).deserialize(HEADER + bytes(8 + extra))


@pytest.mark.parametrize(
    "message",
    [
        JointState(),
        JointState(name=["a", "bc"], effort=[1.0]),
        BoundedPlainSequences(uint8_values=[1, 2]),
        WStrings(wstring_value="abc"),
        UInt8(data=7),
    ],
)
def test_the_oversized_buffers_that_rclpy_returns_are_read(message: Any) -> None:
    codec = codec_for(type(message))
    raw = native_serialize(message)
    assert len(raw) > len(codec.serialize(message))
    assert codec.deserialize(raw) == message
    assert codec.canonical(raw) == codec.serialize(message)
    with pytest.raises(ValueError, match="ends at offset"):
        codec.deserialize(raw + bytes(4))


@pytest.mark.parametrize(
    ("header", "name"),
    [(b"\0\2", "PL_CDR"), (b"\0\3", "PL_CDR"), (b"\0\7", "XCDR2"), (b"\0\x09", "delimited XCDR2")],
)
def test_other_encapsulations_are_named(header: bytes, name: str) -> None:
    with pytest.raises(ValueError, match=rf"0x{header.hex()} \({name}\) is not supported"):
        codec_for(UInt64).deserialize(header + bytes(10))


def test_bytes_that_are_no_cdr_at_all_are_refused() -> None:
    with pytest.raises(ValueError, match="encapsulation 0xff01 is not supported"):
        codec_for(UInt64).deserialize(b"\xff\1" + bytes(10))
    with pytest.raises(ValueError, match="0 bytes are too short"):
        codec_for(UInt64).deserialize(b"")


@pytest.mark.few(2)
@pytest.mark.parametrize("cls", [String, *SAMPLES[2:7], BoundedSequences], ids=type_name)
def test_a_hostile_length_allocates_nothing(cls: type) -> None:
    message = random_message(message_spec(cls), random.Random(2))
    raw = codec_for(cls).serialize(message)
    codec_for(cls).deserialize(raw)
    tracemalloc.start()
    for offset in range(4, len(raw) - 3, 4):
        for length in (2**32 - 1, 2**31, 2**24):
            hostile = raw[:offset] + struct.pack("<I", length) + raw[offset + 4 :]
            try:
                codec_for(cls).deserialize(hostile)
            except ValueError as error:
                assert type_name(cls) in str(error)  # noqa: PT017
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000


@pytest.mark.parametrize("cls", SAMPLES, ids=type_name)
@settings(QUICK, max_examples=cases(10, 60))
@given(seed=st.integers(0, 2**32))
def test_flipped_bytes_are_read_as_rclpy_reads_them_or_refused(cls: type, seed: int) -> None:
    rng = random.Random(seed)
    raw = bytearray(codec_for(cls).serialize(random_message(message_spec(cls), rng)))
    for _ in range(rng.randint(1, 3)):
        raw[rng.randrange(4, len(raw))] = rng.choice((0, 1, 2, 127, 128, 255))
    try:
        message = codec_for(cls).deserialize(bytes(raw))
    except ValueError as error:
        assert type_name(cls) in str(error)  # noqa: PT017
    else:
        assert same(message, native_deserialize(bytes(raw), cls))


@pytest.mark.parametrize(
    ("cls", "data", "expected"),
    [
        (Bool, "02", [True]),
        (String, "00000000", [""]),
        (String, "03000000 616263", ["abc"]),
        (String, "06000000 616200636400", ["ab"]),
        (String, "04000000 61620000", ["ab"]),
        (String, "05000000 61ff62e200", ["a\ufffdb\ufffd"]),
    ],
)
def test_odd_values_are_read_as_rclpy_reads_them(cls: type, data: str, expected: list[Any]) -> None:
    raw = HEADER + bytes.fromhex(data)
    assert same(codec_for(cls).deserialize(raw), native_deserialize(raw, cls))
    assert codec_for(cls).deserialize(raw).data == expected[0]


@pytest.mark.parametrize("unit", ["00d80000", "61000100"], ids=["surrogate", "more than 16 bits"])
def test_a_wstring_that_is_not_utf_16_is_refused(unit: str) -> None:
    raw = HEADER + bytes.fromhex("01000000" + unit) + bytes(200)
    with pytest.raises(ValueError, match="field 'wstring_value' at offset 8 is not UTF-16 text"):
        codec_for(WStrings).deserialize(raw)


# -- layout ----------------------------------------------------------------------------------------


def test_what_is_known_of_a_place_is_true_of_every_position_it_stands_for() -> None:
    places = [KnownOffset(modulus, rest) for modulus in (1, 2, 4, 8) for rest in range(modulus)]

    def positions(place: KnownOffset) -> set[int]:
        return {p for p in range(64) if p % place.modulus == place.rest}

    for place in places:
        for position in positions(place):
            for size in (1, 2, 4, 8):
                aligned = position + -position % size
                assert aligned % 64 in positions(place.aligned(size))
                assert (position + size) % 64 in positions(place.moved(size))
        for other in places:
            assert positions(place) | positions(other) <= positions(place.joined(other))
    assert START.joined(KnownOffset(8, 4)) == KnownOffset(4, 0)


# -- other readers ---------------------------------------------------------------------------------


def has_wide_text(type_: Any) -> bool:
    if isinstance(type_, MessageSpec):
        return any(has_wide_text(field.type) for field in type_.fields)
    return has_wide_text(type_.item) if hasattr(type_, "item") else getattr(type_, "wide", False)


def assert_foreign_equals(foreign: Any, type_: Any, value: Any) -> None:
    """A message decoded by another library holds the same values, in whatever types it uses."""
    if isinstance(type_, MessageSpec):
        for field in type_.fields:
            assert_foreign_equals(getattr(foreign, field.name), field.type, value_of(value, field))
    elif hasattr(type_, "item"):
        assert len(foreign) == len(value)
        for one, other in zip(foreign, value, strict=True):
            assert_foreign_equals(one, type_.item, other)
    elif isinstance(type_, PrimitiveType) and type_.size == 1:
        number = value[0] if isinstance(value, bytes) else int(value)
        assert int(foreign) % 256 == number % 256  # some take byte and char for signed
    elif isinstance(type_, PrimitiveType) and type_.code in "fd":
        rounded = struct.unpack(type_.code, struct.pack(type_.code, value))[0]
        assert foreign == rounded or (math.isnan(foreign) and math.isnan(rounded))
    else:
        assert foreign == value


def value_of(message: Any, field: Any) -> Any:
    return getattr(message, field.name)


@pytest.mark.few(8)
@every_class
def test_rosbags_reads_the_schema_and_the_bytes(cls: type) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    spec, name = message_spec(cls), type_name(cls)
    types = get_types_from_msg(schema_text(cls), name)
    name = name if name in types else name.replace("/srv/", "/srv/msg/")  # as rosbags has it
    if has_wide_text(spec):
        return  # rosbags does not read wstrings
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    message = random_message(spec, random.Random(type_name(cls)))
    foreign = store.deserialize_cdr(codec_for(cls).serialize(message), name)
    assert_foreign_equals(foreign, spec, message)


@pytest.mark.parametrize(
    "cls",
    [
        UInt64,
        Imu,
        JointState,
        PointCloud2,
        UnboundedSequences,
        BasicTypes,
        Trigger.Response,
        Trigger.Request,
    ],
    ids=type_name,
)
def test_mcap_ros2_reads_the_schema_and_the_bytes(cls: type) -> None:
    from mcap.records import Schema

    factory = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    schema = Schema(data=schema_text(cls).encode(), encoding="ros2msg", id=1, name=type_name(cls))
    decoder = factory.decoder_for("cdr", schema)
    message = random_message(message_spec(cls), random.Random(3))
    assert_foreign_equals(decoder(codec_for(cls).serialize(message)), message_spec(cls), message)
