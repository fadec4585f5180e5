"""State hashes: equal for equal states, different for different ones, and right about where."""

from __future__ import annotations

import _threading_local
import array
import collections
import copy
import dataclasses
import enum
import math
import random
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsltrace.guard.state.hashing import StateHasher
from tests.tiers import cases

GOLDEN = {
    "plain": "8b37d7770a17ec3c",
    "object": "304ec163611d6c9e",
    "array": "038ece37059066d2",
    "bytes": "74f273b3904d399f",
}


def digest(value: object) -> int:
    return StateHasher().digest(value, "x")


@dataclasses.dataclass
class Point:
    x: float
    tags: list[str] = dataclasses.field(default_factory=list)


class Slotted:
    __slots__ = ("__private", "a")

    def __init__(self, a: object, private: object = None) -> None:
        self.a = a
        self.__private = private


class Colour(enum.Enum):
    RED = 1
    BLUE = 2


PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary()
HASHABLE = st.integers() | st.text() | st.tuples(st.integers(), st.text())
VALUES = st.recursive(
    PLAIN,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(HASHABLE, inner, max_size=4)
        | st.sets(HASHABLE, max_size=4)
        | st.builds(Point, st.floats(), st.lists(st.text(), max_size=2))
        | st.builds(Slotted, inner, inner)
        | st.lists(inner, max_size=3).map(collections.deque)
        | st.lists(st.floats(), max_size=5).map(np.array)
    ),
    max_leaves=12,
)


@pytest.mark.long
@given(VALUES)
def test_a_copy_hashes_alike(value: Any) -> None:
    hasher = StateHasher()
    first = hasher.digest(value, "x")
    assert first == hasher.digest(copy.deepcopy(value), "x") == digest(value)


@given(VALUES, VALUES)
def test_what_differs_hashes_differently(a: Any, b: Any) -> None:
    if repr(a) != repr(b) and not has_objects(a) and not has_objects(b) and a != b:
        assert digest(a) != digest(b)


def has_objects(value: Any) -> bool:
    text = repr(value)
    return "0x" in text or "array" in text or "-0.0" in text or "{" in text


DIFFERENT: list[Callable[[], Any]] = [
    list,
    lambda: (),
    dict,
    lambda: set(),
    lambda: "",
    lambda: b"",
    lambda: 0,
    lambda: 0.0,
    lambda: False,
    lambda: None,
    lambda: "0",
    lambda: [[]],
    lambda: ["a", "b"],
    lambda: ["ab"],
    lambda: {"a": 1, "b": 2},
    lambda: {"b": 2, "a": 1},
    lambda: Colour.RED,
    lambda: Colour.BLUE,
    lambda: Point(0.0),
    lambda: Point(0.0, [""]),
    lambda: Slotted(1),
    lambda: Slotted(1, 1),
    lambda: collections.deque([1], maxlen=2),
    lambda: collections.OrderedDict(a=1),
    lambda: collections.Counter("ab"),
    lambda: np.zeros(3),
    lambda: np.zeros(3, np.float32),
    lambda: np.zeros((3, 1)),
    lambda: np.array(["a", "b"]),
    lambda: np.array(["a", "c"]),
    lambda: np.array([1, "a", None], dtype=object),
    lambda: np.array([(1, 2.0)], dtype=[("i", "i4"), ("f", "f8")]),
    lambda: np.float64(1.5),
    lambda: np.datetime64("2020-01-01"),
    lambda: np.longdouble(1) / 3,
    lambda: array.array("d", [1.0]),
    lambda: random.Random(1),
    lambda: random.Random(2),
    lambda: np.random.default_rng(1),
    lambda: np.random.default_rng(2),
    lambda: np.random.RandomState(1),
    lambda: (np.arange(200_000.0),),
    lambda: (np.arange(200_000.0)[::-1],),
    lambda: 1j,
    lambda: range(3),
    lambda: Path("a"),
]


def test_each_of_many_values_is_stable_and_unlike_the_others() -> None:
    digests = [digest(make()) for make in DIFFERENT]
    assert digests == [digest(make()) for make in DIFFERENT]
    # () and [] hold the same values; everything else differs.
    assert digests[0] == digests[1]
    assert len(set(digests)) == len(digests) - 1


def test_zeros_and_nans_have_one_form() -> None:
    nan = float("nan")
    odd = np.frombuffer(np.uint64(0xFFF8000000000123).tobytes(), np.float64)[0]
    assert digest(-0.0) == digest(0.0)
    assert digest(nan) == digest(float(odd)) == digest(-nan)
    for dtype in (np.float16, np.float32, np.float64, np.longdouble, np.complex128):
        big = np.zeros(100_000, dtype)
        other = big.copy()
        other[70_000] = -0.0
        assert digest(big) == digest(other)
        big[5], other[5] = nan, odd
        assert digest(big) == digest(other)
        other[6] = 1
        assert digest(big) != digest(other)


def test_one_element_of_a_large_array_is_seen_wherever_it_is() -> None:
    hasher, data = StateHasher(), np.random.default_rng(1).random(131_072)
    seen = {hasher.digest(data, "x")}
    for place in [0, 1, 8191, 8192, 65_535, 131_071]:
        data[place] = np.nextafter(data[place], 2)
        seen.add(hasher.digest(data, "x"))
    data[[3, 9000]] = data[[9000, 3]]
    seen.add(hasher.digest(data, "x"))
    assert len(seen) == 8
    assert hasher.digest(data, "x") == digest(data.copy())
    assert digest(data) == digest(np.stack([data, data], axis=1)[:, 0])


FLOATS = ["<f2", "<f4", "<f8", ">f2", ">f4", ">f8", "<c8", ">c16", "g"]


def in_one_form(data: Any) -> Any:
    """Write an array with plain numbers: slowly, and beyond doubt."""
    plain = np.empty_like(data)
    for place, value in np.ndenumerate(data):
        parts = [value.real, value.imag] if data.dtype.kind == "c" else [value]
        parts = [math.nan if part != part else 0.0 if part == 0 else part for part in parts]
        plain[place] = complex(*parts) if data.dtype.kind == "c" else parts[0]
    return plain


@pytest.mark.parametrize("dtype", FLOATS)
@settings(max_examples=12)
@given(data=st.data())
def test_an_array_hashes_as_the_numbers_in_it(dtype: str, data: st.DataObject) -> None:
    odd = st.sampled_from([-0.0, 0.0, math.nan, -math.nan, math.inf, 1.0, -1.0])
    values = data.draw(st.lists(odd, min_size=1, max_size=8))
    length = data.draw(st.sampled_from([1, 20_000]))
    array = np.ones(length * len(values), dtype)
    at = data.draw(st.integers(0, len(array) - len(values)))
    array[at : at + len(values)] = values
    plain = array.copy()
    plain[at : at + len(values)] = in_one_form(array[at : at + len(values)])
    hasher = StateHasher()
    assert hasher.digest(array, "x") == hasher.digest(plain, "x") == digest(array)
    strided = np.zeros((len(array), 2), dtype)
    strided[:, 1] = array
    assert digest(strided[:, 1]) == digest(array)
    array[at] = 2.0
    assert hasher.digest(array, "x") == digest(array) != digest(plain)


def test_every_bit_pattern_of_nan_is_the_same_and_none_warns() -> None:
    with np.errstate(all="raise"):
        for kind, pattern in (("<f8", 0x7FF0000000000001), ("<f4", 0x7F800001), (">f2", 0x7C01)):
            bits = np.zeros(10, kind.replace("f", "u"))
            bits[3] = pattern  # a signalling one
            quiet = np.zeros(10, kind)
            quiet[3] = math.nan
            assert digest(bits.view(kind)) == digest(quiet)
        assert digest(np.array([math.inf, math.nan], "g"))


def test_hashes_stay_what_they_are() -> None:
    # Traces keep them, and are compared with those of later versions.
    data = np.arange(100_000.0)
    data[7] = -0.0
    values: dict[str, Any] = {
        "plain": [1, 2.5, "a", b"b", None, True, {"k": (1j, {"s"})}],
        "object": random.Random(1),
        "array": data,
        "bytes": np.arange(5, dtype=np.uint8),
    }
    assert {name: f"{digest(value):016x}" for name, value in values.items()} == GOLDEN


def test_cycles_and_depth_end() -> None:
    one: list[Any] = [1]
    one.append(one)
    other: list[Any] = [1]
    other.append(other)
    assert digest(one) == digest(other) != digest([1, [1]])
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    hasher = StateHasher()
    hasher.digest(deep, "deep")
    assert hasher.skipped == {"deep": "builtins.list"}


def test_what_has_no_value_is_left_out_and_listed() -> None:
    hasher = StateHasher()
    things = {
        "lock": threading.Lock(),
        "generator": (i for i in [1]),
        "thread": threading.Thread(),
        "stop": threading.Event(),
        "local": _threading_local.local(),  # what threading.local is in a run; it has addresses
    }
    first = {name: hasher.digest([thing], name) for name, thing in things.items()}
    assert set(first.values()) == {digest([threading.Lock()])}
    assert hasher.skipped == {
        "lock": "_thread.lock",
        "generator": "builtins.generator",
        "thread": "threading.Thread",
        "stop": "threading.Event",
        "local": "_threading_local.local",
    }


def test_an_object_may_say_itself_what_its_state_is() -> None:
    class Cached:
        def __init__(self, value: int) -> None:
            self.value, self.cache = value, random.random()

        def rsltrace_state(self) -> int:
            return self.value

    assert digest(Cached(1)) == digest(Cached(1)) != digest(Cached(2))


# -- in runs --------------------------------------------------------------------------------------

PLANTINGS = cases(20, 100)

PLANTED: dict[str, Any] = {"at": -1, "change": lambda node: None}

CHANGES: list[tuple[str, Callable[[Any], Any]]] = [
    ("estimator.P[2][2]", lambda node: node.estimator.P.__setitem__((2, 2), 1.0000000000000002)),
    ("seen['b'].x", lambda node: setattr(node.seen["b"], "x", 7.5)),
    ("queue[1]", lambda node: node.queue.__setitem__(1, "new")),
    ("big[100000]", lambda node: node.big.__setitem__(100_000, -1.0)),
    ("names", lambda node: node.names.add("more")),
    ("message.pose.position.x", lambda node: setattr(node.message.pose.position, "x", 0.25)),
    ("path[1]", lambda node: node.path.__setitem__(1, 9)),
    ("hidden", lambda node: setattr(node, "_hidden", None)),
    ("extra", lambda node: setattr(node, "extra", 1)),
]


def planted_node() -> Any:
    pytest.importorskip("rclpy")
    from geometry_msgs.msg import PoseStamped
    from rclpy.node import Node
    from std_msgs.msg import UInt64

    class Estimator:
        def __init__(self) -> None:
            self.P = np.eye(3)

    class Planted(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("planted")
            self.estimator = Estimator()
            self.seen = {"a": Point(1.0), "b": Point(2.0)}
            self.queue = collections.deque(["x", "y", "z"], maxlen=3)
            self.big = np.zeros(131_072)
            self.names = {"one", "two"}
            self.message = PoseStamped()
            self.path = [1, 2]
            self._hidden = 1
            self.lock = threading.Lock()
            self.count = 0
            self.out = self.create_publisher(UInt64, "count", 10)
            self.create_subscription(UInt64, "count", self.step, 10)
            self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            self.count += 1
            self.big[self.count] = self.count
            self.out.publish(UInt64(data=self.count))
            self.step(None)

        def step(self, message: object) -> None:
            PLANTED["at"] -= 1
            if PLANTED["at"] == 0:
                PLANTED["change"](self)

    return Planted


def recorded(path: Path, node: Any, state: object, at: int, change: Callable[[Any], Any]) -> Path:
    from rsltrace import Job, NodeSpec, StopSpec, record

    PLANTED.update(at=at, change=change)
    job = Job(nodes=[NodeSpec(node=node, guard={"state": state})], stop=StopSpec(duration="1s"))
    record(job, path, force=True)
    return path


@pytest.mark.long
@pytest.mark.ros
@pytest.mark.repeated
def test_the_first_diverging_event_is_the_planted_one(tmp_path: Path) -> None:
    from rsltrace.diff import diff_files

    node, chance = planted_node(), random.Random(1)
    plain = recorded(tmp_path / "plain.mcap", node, True, 0, lambda node: None)
    for number in range(PLANTINGS):
        step = chance.randrange(1, 20)
        _, change = chance.choice(CHANGES)
        path = recorded(tmp_path / "planted.mcap", node, True, step, change)
        found = diff_files(str(plain), str(path))
        # Steps alternate between the timer's events and the subscription's; 0 is the constructor.
        assert found.agreeing == step, f"planting {number}"
        assert "left its node in a different state" in found.sentence


@pytest.mark.few(1)
@pytest.mark.ros
@pytest.mark.parametrize(("path", "change"), CHANGES)
def test_recorded_states_name_the_attribute(
    tmp_path: Path, path: str, change: Callable[[Any], Any]
) -> None:
    from rsltrace.diff import diff_files

    node = planted_node()
    plain = recorded(tmp_path / "plain.mcap", node, "record", 0, lambda node: None)
    other = recorded(tmp_path / "planted.mcap", node, "record", 6, change)
    (found,) = diff_files(str(plain), str(other)).divergences
    assert [one.path.lstrip("_") for one in found.state] == [path]
    assert found.state[0].a != found.state[0].b
    assert other.stat().st_size < 100_000, "an array is not written again for one element"


@pytest.mark.ros
def test_state_hashes_are_off_by_default_and_listed_in_info(tmp_path: Path) -> None:
    from click.testing import CliRunner

    from rsltrace.cli.info import info
    from rsltrace.trace.reader import Trace

    node = planted_node()
    off = recorded(tmp_path / "off.mcap", node, None, 0, lambda node: None)
    on = recorded(tmp_path / "on.mcap", node, True, 0, lambda node: None)
    with Trace.open(off) as trace:
        assert {int(h) for events in trace.events() for h in events["state_hash"]} == {0}
    with Trace.open(on) as trace:
        hashes = [int(h) for events in trace.events() for h in events["state_hash"]]
        assert len(set(hashes)) > 10
        assert (
            trace.metadata("rsltrace:guard")["left_out"]
            == '{"/planted": {"lock": "rsltrace.adapters.rclpy.concurrency.locks.SimLock"}}'
        )
    shown = CliRunner().invoke(info, [str(on)]).output
    assert (
        'state hashes leave out: {"/planted": {"lock": "rsltrace.adapters.rclpy.concurrency.locks.SimLock"}}'  # noqa: E501
        in shown
    )


STEPS: list[Callable[[Any], object]] = [
    lambda node: setattr(node, "text", "a" * 1000),
    lambda node: None,
    lambda node: setattr(node, "text", "b"),
    lambda node: setattr(node, "text", "a" * 1000),
    lambda node: setattr(node, "more", True),
    lambda node: delattr(node, "more"),
    lambda node: setattr(node, "more", 1),
    lambda node: setattr(node, "more", 1.0),
]


@pytest.mark.ros
def test_an_attribute_that_is_set_again_removed_and_added_is_seen(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    from rclpy.node import Node

    from rsltrace.trace.model.event import EventKind
    from rsltrace.trace.reader import Trace

    class Changing(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("changing")
            PLANTED["steps"] = iter(STEPS)  # not in the node: it would be state
            self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            next(PLANTED["steps"], lambda node: None)(self)

    path = recorded(tmp_path / "run.mcap", Changing, True, 0, lambda node: None)
    with Trace.open(path) as trace:
        events = np.concatenate(list(trace.events()))
    hashes = events["state_hash"][events["kind"] == EventKind.TIMER].tolist()
    first, same, other, back, more, less, one, real = hashes[: len(STEPS)]
    assert first == same == back == less
    assert len({first, other, more, one, real}) == 5


@pytest.mark.long
@pytest.mark.ros
def test_a_node_may_say_itself_what_its_state_is(tmp_path: Path) -> None:
    from rsltrace.diff import diff_files

    base = planted_node()

    class Own(base):  # type: ignore[misc,valid-type]
        def rsltrace_state(self) -> dict[str, int]:
            return {"count": self.count}

    plain = recorded(tmp_path / "plain.mcap", Own, "record", 0, lambda node: None)
    other = recorded(tmp_path / "b.mcap", Own, "record", 3, lambda node: node.names.clear())
    assert diff_files(str(plain), str(other)).identical
    other = recorded(tmp_path / "c.mcap", Own, "record", 3, lambda n: setattr(n, "count", 99))
    (found,) = diff_files(str(plain), str(other)).divergences
    assert [one.path for one in found.state] == ["count"]
