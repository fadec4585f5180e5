"""Two recordings, topic by topic: what differs, what is missing, what only looks different."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsltrace.diff.bags.comparison import diff_bags
from rsltrace.diff.bags.sequences import Gap, gaps_by_order, gaps_by_stamp
from rsltrace.diff.bags.source import RecordingSource, SourceTopic
from rsltrace.diff.facts.bags import BagVerdict
from rsltrace.diff.facts.evidence import Presence
from rsltrace.diff.file_kind import is_recording, is_trace
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import BagDiff
from rsltrace.diff.sentences.values import notes_text
from rsltrace.errors import BagError, TraceError
from tests.tiers import cases

POINT = "geometry_msgs/msg/PointStamped"
UINT64 = "std_msgs/msg/UInt64"
SECOND = 10**9

KEYS = "rsltrace.diff.bags.comparison.ContentKeys"


def point(stamp: int, x: float, *, padding: int = 0, frame: str = "ab") -> bytes:
    """A PointStamped; between frame and point lies padding, which recorders do not clear."""
    text = frame.encode() + b"\0"
    head = struct.pack("<iII", stamp, 0, len(text)) + text
    return b"\0\1\0\0" + head + bytes([padding]) * (-len(head) % 8) + struct.pack("<3d", x, 0, 0)


def uint64(value: int) -> bytes:
    return b"\0\1\0\0" + struct.pack("<Q", value)


Sample = tuple[int, str, bytes]
"""Log time in ns, topic, CDR. Topics that begin with /n hold numbers, others points."""


def write(path: Path, samples: Sequence[Sample], storage: str = "mcap") -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    typestore = get_typestore(Stores.ROS2_JAZZY)
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connections: dict[str, Any] = {}
        for stamp_ns, topic, data in samples:
            if topic not in connections:
                kind = UINT64 if topic.startswith("/n") else POINT
                connections[topic] = writer.add_connection(topic, kind, typestore=typestore)
            writer.write(connections[topic], stamp_ns, data)
    return path


def points(
    count: int, topic: str = "/p", *, skip: Sequence[int] = (), padding: int = 0, **changed: float
) -> list[Sample]:
    """Points with x = their number; ``changed`` maps ``x7`` to another x of number 7."""
    return [
        ((1 + i) * SECOND, topic, point(i, changed.get(f"x{i}", float(i)), padding=padding))
        for i in range(count)
        if i not in skip
    ]


@pytest.fixture
def compare(tmp_path: Path) -> Callable[..., BagDiff]:
    """Write two bags and compare them."""
    count = 0

    def go(
        a: Sequence[Sample],
        b: Sequence[Sample],
        options: DiffOptions | None = None,
        storages: tuple[str, str] = ("mcap", "mcap"),
    ) -> BagDiff:
        nonlocal count
        count += 1
        paths = [
            write(tmp_path / f"{name}{count}", samples, storage)
            for name, samples, storage in (("a", a, storages[0]), ("b", b, storages[1]))
        ]
        return diff_bags(paths[0], paths[1], options)

    return go


def counts(diff: BagDiff, topic: str = "/p") -> tuple[int, int, int, int, int]:
    (found,) = (one for one in diff.topics if one.topic == topic)
    return found.equal, found.tolerated, found.differing, found.only_a, found.only_b


@pytest.mark.parametrize("storages", [("mcap", "mcap"), ("sqlite3", "mcap"), ("sqlite3",) * 2])
def test_padding_is_no_difference(compare: Any, storages: tuple[str, str]) -> None:
    diff = compare(points(20, padding=0xAA), points(20, padding=0x55), None, storages)
    assert diff.verdict is BagVerdict.EQUAL
    assert diff.exit_code == 0
    assert diff.identical
    assert counts(diff) == (20, 0, 0, 0, 0)
    assert diff.sentence == "The recordings are equal: 20 messages on 1 topic."
    assert (diff.a.kind, diff.b.kind) == storages


def test_a_changed_message_is_named_with_its_fields(compare: Any) -> None:
    diff = compare(points(20), points(20, x7=7.5, x9=0.0, padding=3))
    assert diff.verdict is BagVerdict.DIFFERENT
    assert diff.exit_code == 1
    assert counts(diff) == (18, 0, 2, 0, 0)
    first = diff.first
    assert first is not None
    assert (first.topic, first.type, first.presence) == ("/p", POINT, Presence.BOTH)
    assert first.a is not None
    assert first.b is not None
    assert (first.a.index, first.b.index, first.a.stamp_ns) == (7, 7, 8 * SECOND)
    assert first.after_ns == 7 * SECOND
    assert [(f.path, f.a, f.b, f.absolute) for f in first.fields] == [
        ("point.x", "7.0", "7.5", 0.5)
    ]
    assert [message.index for message in first.before] == [2, 3, 4, 5, 6]
    assert 'frame_id: "ab"' in first.before[-1].preview
    assert "message 7 has a different point.x" in diff.sentence


@pytest.mark.parametrize("missing", [[0], [7], [7, 8, 12], [19]])
def test_missing_messages_do_not_make_those_after_them_differ(
    compare: Any, missing: list[int]
) -> None:
    diff = compare(points(20, padding=1), points(20, skip=missing, padding=2))
    assert counts(diff) == (20 - len(missing), 0, 0, len(missing), 0)
    assert diff.first is not None
    assert diff.first.presence is Presence.ONLY_A
    assert diff.first.a is not None
    assert diff.first.b is None
    assert diff.first.a.index == missing[0]
    assert "is missing in b" in diff.sentence
    back = compare(points(20, skip=missing), points(20))
    assert counts(back) == (20 - len(missing), 0, 0, 0, len(missing))
    assert back.first is not None
    assert back.first.presence is Presence.ONLY_B
    assert "is not in a" in back.sentence


def test_missing_beside_changed_is_told_apart_by_header_stamps(compare: Any) -> None:
    # Number 7 is missing and 8 and 9 are changed: only their stamps say which is which.
    diff = compare(points(20), points(20, skip=[7], x8=0.5, x9=0.5))
    assert counts(diff) == (17, 0, 2, 1, 0)
    assert diff.first is not None
    assert diff.first.a is not None
    assert (diff.first.presence, diff.first.a.index) == (Presence.ONLY_A, 7)


def test_messages_that_repeat_are_aligned(compare: Any) -> None:
    a = [(i * SECOND, "/n", uint64(i // 3 % 2)) for i in range(1, 60)]
    b = a[:20] + a[21:]
    diff = compare(a, b)
    assert counts(diff, "/n") == (58, 0, 0, 1, 0)


def test_the_earliest_divergence_of_all_topics_leads(compare: Any) -> None:
    late, early = points(20, "/p"), points(20, "/q")
    changed = points(20, "/q", x5=0.0)
    diff = compare(late + early, points(20, "/p", x4=9.0) + changed)
    assert diff.first is not None
    assert diff.first.topic == "/p"
    assert [topic.first is not None for topic in diff.topics] == [True, True]
    diff = compare(late + early, points(20, "/p", x6=9.0) + changed)
    assert diff.first is not None
    assert diff.first.topic == "/q"
    # Counted from the start of each recording, whenever that was.
    shifted = [(stamp + 1000 * SECOND, topic, data) for stamp, topic, data in changed]
    diff = compare(early, shifted)
    assert diff.first is not None
    assert diff.first.after_ns == 5 * SECOND


def test_topics_of_one_side_are_a_difference(compare: Any) -> None:
    diff = compare(points(5) + points(5, "/q"), points(5))
    assert diff.verdict is BagVerdict.DIFFERENT
    assert diff.first is None
    assert [(t.topic, t.type, t.messages) for t in diff.topics_only_a] == [("/q", POINT, 5)]
    assert diff.sentence == "5 messages on 1 topic agree, but /q is only in a."
    assert compare(points(5) + points(5, "/q"), points(5), DiffOptions(topics=("/p",))).identical
    nothing = compare(points(5), points(5, "/q"))
    assert nothing.sentence == "/p is only in a, /q is only in b."
    with pytest.raises(TraceError, match="no topic that matches /zz; they have /p"):
        compare(points(5), points(5), DiffOptions(topics=("/zz",)))


def test_ignored_fields(compare: Any) -> None:
    a, b = points(10), points(10, x3=0.0, x4=1.0)
    for glob in ("point.x", "/p:point"):
        diff = compare(a, b, DiffOptions(ignore=(glob,)))
        assert (diff.verdict, diff.exit_code) == (BagVerdict.WITHIN_TOLERANCE, 3)
        assert diff.sentence == (
            "The recordings are equal except for ignored fields, not identical: 2 of 10 messages "
            "on 1 topic differ there."
        )
        assert counts(diff) == (8, 0, 0, 0, 0)
        assert diff.topics[0].ignored == 2
    both = DiffOptions(ignore=("header",), absolute=(("*", 5.0),))
    near = compare(a, [(t, topic, point(9, i + 0.5)) for i, (t, topic, _) in enumerate(a)], both)
    assert (near.exit_code, near.topics[0].tolerated) == (3, 10)
    same = compare(a, a, DiffOptions(ignore=("point.x",)))
    assert (same.verdict, same.exit_code) == (BagVerdict.EQUAL, 0)
    padded = compare(a, points(10, padding=7), DiffOptions(ignore=("point.x",)))
    assert padded.identical, "padding is nothing that is ignored"
    assert compare(a, b, DiffOptions(ignore=("/q:point",))).verdict is BagVerdict.DIFFERENT
    # A message that is missing is found among others of which nothing but the stamp is equal.
    c = points(10, skip=[5], **{f"x{i}": 0.25 for i in range(10)})
    diff = compare(a, c, DiffOptions(ignore=("point",)))
    assert counts(diff) == (0, 0, 0, 1, 0)
    assert diff.topics[0].ignored == 9
    assert diff.first is not None
    assert diff.first.a is not None
    assert diff.first.a.index == 5


@pytest.mark.few(8)
@pytest.mark.parametrize("first", [0, 4, 8])
@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize("tolerance", [(), (("*", 1e-3),)])
def test_neighbours_that_changed_places_are_swapped_and_not_missing(
    compare: Any, first: int, padding: int, tolerance: Any
) -> None:
    a = points(10)
    b = points(10, padding=padding)
    (early, topic, one), (late, _, other) = b[first : first + 2]
    b[first : first + 2] = [(early, topic, other), (late, topic, one)]
    for x, y in ((a, b), (b, a)):
        diff = compare(x, y, DiffOptions(absolute=tolerance))
        assert diff.sentence == (
            f"The recordings first diverge on /p, {first}.000000000 s after the start: messages "
            f"{first} and {first + 1} are swapped."
        )
        assert counts(diff) == (9, 0, 0, 0, 0)
        assert (diff.topics[0].moved, diff.exit_code) == (1, 1)
        assert diff.first is not None
        assert diff.first.presence is Presence.BOTH


def test_a_message_that_moved_far_is_in_both(compare: Any) -> None:
    a = points(10)
    b = [(stamp, topic, a[other][2]) for (stamp, topic, _), other in zip(a, ORDER, strict=True)]
    diff = compare(a, b)
    assert counts(diff) == (9, 0, 0, 0, 0)
    assert "message 2 of a is message 7 of b (different order)" in diff.sentence
    c = [*b, (11 * SECOND, "/p", point(99, 1.0))]
    assert counts(compare(a, c)) == (9, 0, 0, 0, 1)


ORDER = [0, 1, 3, 4, 5, 6, 7, 2, 8, 9]


def test_messages_that_repeat_are_swapped_too(compare: Any) -> None:
    """Most of the values are there several times, so that nothing but the place tells."""
    values = [1, 2, 1, 2, 3, 1, 2, 1, 1]
    other = [1, 2, 1, 3, 2, 1, 2, 1, 1]
    a, b = ([(i + 1, "/n", uint64(v)) for i, v in enumerate(side)] for side in (values, other))
    diff = compare(a, b)
    assert "messages 3 and 4 are swapped" in diff.sentence
    assert counts(diff, "/n") == (8, 0, 0, 0, 0)


def test_tolerances(compare: Any) -> None:
    a = points(30)
    b = points(30, **{f"x{i}": i + 1e-6 for i in range(10, 30)})
    diff = compare(a, b, DiffOptions(absolute=(("point.*", 1e-5),)))
    assert diff.verdict is BagVerdict.WITHIN_TOLERANCE
    assert diff.exit_code == 3
    assert not diff.identical
    assert diff.first is None
    assert counts(diff) == (10, 20, 0, 0, 0)
    assert "equal within tolerance, not identical: 20 of 30 messages" in diff.sentence
    assert compare(a, a, DiffOptions(absolute=(("*", 1.0),))).verdict is BagVerdict.EQUAL
    c = points(30, x20=99.0, **{f"x{i}": i + 1e-6 for i in range(10, 20)})
    diff = compare(a, c, DiffOptions(relative=(("point.x", 1e-6),)))
    assert diff.verdict is BagVerdict.DIFFERENT
    assert counts(diff) == (19, 10, 1, 0, 0)
    assert diff.first is not None
    assert diff.first.a is not None
    assert diff.first.a.index == 20
    assert [message.index for message in diff.first.before] == [15, 16, 17, 18, 19]


def test_tolerances_and_a_missing_message(compare: Any) -> None:
    """All x differ a little, so no key is equal; the missing one must still be found."""
    b = points(60, skip=[25, 26], **{f"x{i}": i + 1e-6 for i in range(60)})
    diff = compare(points(60), b, DiffOptions(absolute=(("point.x", 1e-5),)))
    assert counts(diff) == (0, 58, 0, 2, 0)
    assert diff.first is not None
    assert diff.first.a is not None
    assert (diff.first.presence, diff.first.a.index) == (Presence.ONLY_A, 25)


@pytest.mark.few(2)
@pytest.mark.parametrize("at", range(1, 9))
def test_one_missing_here_and_another_there_among_noise(compare: Any, at: int) -> None:
    """Both recordings are of one length, and no two messages of them are equal."""
    noisy = {f"x{i}": i + 0.001 for i in range(12)}
    a = points(12, skip=[at])
    b = points(12, skip=[10 if at < 5 else 0], **noisy)
    for sample in (a, b):  # without stamps that would tell them apart
        sample[:] = [(stamp, topic, point(0, _x(data))) for stamp, topic, data in sample]
    diff = compare(a, b, DiffOptions(absolute=(("point.x", 0.01),)))
    assert counts(diff) == (0, 10, 0, 1, 1)
    mirrored = compare(b, a, DiffOptions(absolute=(("point.x", 0.01),)))
    assert counts(mirrored) == (0, 10, 0, 1, 1)


def _x(data: bytes) -> float:
    return float(struct.unpack_from("<d", data, len(data) - 24)[0])


def test_changed_messages_among_noise_are_not_missing(compare: Any) -> None:
    noisy = {f"x{i}": i + 0.001 for i in range(30)}
    changed = {f"x{i}": i + 500.0 for i in (3, 4, 9, 29)}
    a, b = points(30), points(30, **{**noisy, **changed})
    for sample in (a, b):
        sample[:] = [(stamp, topic, point(0, _x(data))) for stamp, topic, data in sample]
    diff = compare(a, b, DiffOptions(absolute=(("point.x", 0.01),)))
    assert counts(diff) == (0, 26, 4, 0, 0)


def test_of_several_messages_of_one_log_time_that_which_is_missing_is_named(compare: Any) -> None:
    a = [(SECOND * (n // 3), "/p", point(n, float(n))) for n in range(3, 12)]
    for missing in range(len(a)):
        diff = compare(a, a[:missing] + a[missing + 1 :], DiffOptions(by="stamp"))
        assert counts(diff) == (8, 0, 0, 1, 0)
        assert diff.first is not None
        assert diff.first.a is not None
        assert diff.first.a.index == missing


def test_of_two_topics_that_diverge_at_once_the_same_leads_in_both_orders(compare: Any) -> None:
    one, other = points(3, "/p"), points(3, "/q")
    changed = points(3, "/q", x1=5.0), points(3, "/p", x1=5.0)
    a = sorted([*one, *other], key=lambda sample: sample[0])
    b = sorted([*changed[0], *changed[1]], key=lambda sample: sample[0])
    assert [sample[1] for sample in a] != [sample[1] for sample in b]
    firsts = [compare(*sides).first for sides in ((a, b), (b, a))]
    assert [first and (first.topic, first.after_ns) for first in firsts] == [("/p", SECOND)] * 2


def test_by_stamp(compare: Any) -> None:
    a, b = points(20), points(20, skip=[4], x9=0.0)
    diff = compare(a, b, DiffOptions(by="stamp"))
    assert counts(diff) == (18, 0, 1, 1, 0)
    late = [(stamp + (5 if stamp == 8 * SECOND else 0), *rest) for stamp, *rest in a]
    assert compare(a, late).identical
    assert any("log times are not compared" in note for note in compare(a, late).notes)
    headless = compare(a, a[3:], DiffOptions(by="stamp"))
    assert counts(headless) == (17, 0, 0, 3, 0)
    # Both count from the earliest message of the two, here one of /q.
    longer = points(20, "/q") + points(20, x9=0.0)[3:]
    changed = compare(a[3:], longer, DiffOptions(by="stamp"))
    assert [topic.first.after_ns for topic in changed.topics if topic.first] == [9 * SECOND]
    diff = compare(a, late, DiffOptions(by="stamp"))
    assert counts(diff) == (19, 0, 0, 1, 1)
    assert diff.first is not None
    assert diff.first.after_ns == 7 * SECOND


def test_types_that_differ_are_said(compare: Any, tmp_path: Path) -> None:
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    path = tmp_path / "other"
    with Writer(path, version=9) as writer:
        connection = writer.add_connection("/p", UINT64, typestore=store)
        for i in range(3):
            writer.write(connection, i + 1, uint64(i))
    diff = diff_bags(write(tmp_path / "a", points(3)), path)
    assert counts(diff) == (0, 0, 3, 0, 0)
    assert diff.first is not None
    assert notes_text(diff.first.fields[0]) == "different types"
    assert f"/p is {POINT} in a, {UINT64} in b" in diff.notes


def test_messages_of_unknown_type_are_compared_by_their_bytes(
    tmp_path: Path, mcap_without_schema: Callable[..., Path]
) -> None:
    a = mcap_without_schema(tmp_path / "a.mcap", [b"\0\1\0\0abcd", b"\0\1\0\0efgh"])
    b = mcap_without_schema(tmp_path / "b.mcap", [b"\0\1\0\0abcd", b"\0\1\0\0efgi"])
    assert diff_bags(a, a).identical
    diff = diff_bags(a, b)
    assert counts(diff, "/x") == (1, 0, 1, 0, 0)
    assert diff.first is not None
    assert "cannot be decoded" in diff.first.error
    assert any("byte by byte" in note for note in diff.notes)


def test_python_takes_what_the_command_takes(tmp_path: Path) -> None:
    """Recordings, too; what needs two traces is refused."""
    import rsltrace

    a = write(tmp_path / "a", points(9))
    b = write(tmp_path / "b", points(9, x4=4.5), storage="sqlite3")
    found = rsltrace.diff(str(a), b)
    assert isinstance(found, BagDiff)
    assert found == diff_bags(a, b)
    assert rsltrace.diff(a, b, by="stamp", absolute={"point.x": 1.0}).exit_code == 3
    for refused in ({"nodes": "/n"}, {"check": True}):
        with pytest.raises(TraceError, match="need two traces"):
            rsltrace.diff(a, b, **refused)
    pair = Path(__file__).parent.parent.parent / "sample_traces" / "schedule"
    with pytest.raises(TraceError, match="is for recordings"):
        rsltrace.diff(pair / "a.mcap", pair / "b.mcap", by="stamp")
    assert rsltrace.diff(pair / "a.mcap", pair / "b.mcap", check=True).diverged


@pytest.fixture
def mcap_without_schema() -> Callable[..., Path]:
    from mcap.writer import Writer

    def make(path: Path, messages: Sequence[bytes]) -> Path:
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start(profile="ros2", library="test")
            schema = writer.register_schema("own_msgs/msg/Secret", "ros2msg", b"")
            channel = writer.register_channel("/x", "cdr", schema)
            for number, data in enumerate(messages):
                writer.add_message(channel, number + 1, data, number + 1)
            writer.finish()
        return path

    return make


def one_file(folder: Path) -> Path:
    (file,) = folder.glob("*.mcap")
    return file


def test_a_recording_that_was_cut_off_is_compared_as_far_as_it_goes(tmp_path: Path) -> None:
    from mcap.writer import Writer

    def record(path: Path, count: int) -> Path:
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=2000)
            writer.start(profile="ros2", library="test")
            schema = writer.register_schema(UINT64, "ros2msg", b"uint64 data\n")
            channel = writer.register_channel("/n", "cdr", schema)
            for i in range(count):
                writer.add_message(channel, i + 1, uint64(i), i + 1)
            writer.finish()
        return path

    whole = record(tmp_path / "whole.mcap", 1000)
    cut = tmp_path / "cut.mcap"
    data = whole.read_bytes()
    for size in (len(data) // 2, len(data) // 2 + 7, len(data) - 5):
        cut.write_bytes(data[:size])
        diff = diff_bags(whole, cut)
        assert not diff.b.complete
        equal, _, differing, only_a, only_b = counts(diff, "/n")
        assert (differing, only_b) == (0, 0)
        assert equal + only_a == 1000
        assert 0 < equal <= 1000
        assert any("was cut off" in note for note in diff.notes)
    cut.write_bytes(data[:60])
    with pytest.raises(BagError, match="cut off before its first whole chunk"):
        diff_bags(whole, cut)
    damaged = bytearray(data[: len(data) // 2])
    damaged[200] ^= 0xFF
    cut.write_bytes(damaged)
    with pytest.raises(BagError, match="in the chunk at byte"):
        diff_bags(whole, cut)


def test_files_that_are_no_recordings(tmp_path: Path) -> None:
    good = write(tmp_path / "good", points(3))
    ros1 = tmp_path / "old.bag"
    ros1.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(BagError, match="ROS 1 bag"):
        diff_bags(good, ros1)
    with pytest.raises(BagError, match=r"metadata\.yaml"):
        diff_bags(good, tmp_path)
    other = tmp_path / "other.mcap"
    from mcap.writer import Writer

    with other.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1", library="test")
        writer.finish()
    with pytest.raises(BagError, match="not a ROS 2 recording"):
        diff_bags(good, other)
    assert is_recording(good)
    assert is_recording(one_file(good))
    assert not is_trace(one_file(good))
    assert not is_recording(tmp_path / "nothing")


@pytest.mark.long
def test_many_topics_and_messages_take_one_pass_where_nothing_differs(tmp_path: Path) -> None:
    samples = [(i + 1, f"/n{i % 20}", uint64(i)) for i in range(20_000)]
    a, b = write(tmp_path / "a", samples), write(tmp_path / "b", samples)
    with mock.patch(KEYS, side_effect=AssertionError("decoded")):
        assert diff_bags(a, b).identical
    other = write(tmp_path / "c", [*samples[:-1], (20_000, "/n19", uint64(7))])
    with (
        mock.patch(KEYS, side_effect=AssertionError("decoded")),
        pytest.raises(AssertionError, match="decoded"),
    ):
        diff_bags(a, other)


def keys(values: Sequence[int]) -> Any:
    return np.array(values, dtype=np.uint64)


def rebuilt(a: list[int], b: list[int], gaps: list[Gap]) -> bool:
    """Whether everything outside of the gaps is equal, in order."""
    i = j = 0
    for gap in gaps:
        if a[i : gap.a_start] != b[j : gap.b_start]:
            return False
        i, j = gap.a_end, gap.b_end
    return a[i:] == b[j:]


small = st.lists(st.integers(0, 6), max_size=25)


@settings(max_examples=cases(50, 300))
@given(small, small)
def test_outside_of_gaps_sequences_are_equal(a: list[int], b: list[int]) -> None:
    gaps = gaps_by_order(keys(a), keys(b))
    assert rebuilt(a, b, gaps)
    assert (gaps == []) == (a == b)
    assert all(gap.a_end > gap.a_start or gap.b_end > gap.b_start for gap in gaps)


@settings(max_examples=cases(30, 200))
@given(st.lists(st.integers(0, 2**64 - 1), unique=True, min_size=1), st.data())
def test_removed_keys_are_found_exactly(a: list[int], data: Any) -> None:
    removed = data.draw(st.sets(st.integers(0, len(a) - 1)))
    b = [key for place, key in enumerate(a) if place not in removed]
    gaps = gaps_by_order(keys(a), keys(b))
    found = {place for gap in gaps for place in range(gap.a_start, gap.a_end)}
    assert found == removed
    assert all(gap.b_start == gap.b_end for gap in gaps)


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 3))), st.data())
def test_gaps_by_stamp_never_match_different_stamps(a: list[tuple[int, int]], data: Any) -> None:
    b = data.draw(st.permutations(a))[: data.draw(st.integers(0, len(a)))]
    a, b = sorted(a), sorted(b)
    columns = [keys([pair[at] for pair in side]) for at in (1, 0) for side in (a, b)]
    gaps = gaps_by_stamp(*columns)
    assert rebuilt([p[1] for p in a], [p[1] for p in b], gaps)
    for gap in gaps:
        if gap.surplus == 0:
            assert a[gap.a_start][0] == b[gap.b_start][0]


def test_a_damaged_length_at_the_head_is_no_traceback(tmp_path: Path) -> None:
    path = one_file(write(tmp_path / "a", [(1, "/n", uint64(1))]))
    data = bytearray(path.read_bytes())
    data[9:17] = b"\xff" * 7 + b"\x7f"  # the length of the header
    path.write_bytes(data)
    assert not is_trace(path)
    with pytest.raises(BagError):
        diff_bags(path, path)


def test_a_definition_without_fields_is_one() -> None:
    """As that of a request of ``std_srvs/srv/Trigger``."""
    topic = SourceTopic("/rsltrace/request/ask", "std_srvs/srv/Trigger_Request", "")
    recording = RecordingSource("a.mcap", "mcap", (topic,), lambda wanted: [], lambda: None)
    assert type(recording.decode(0, b"\0\1\0\0\0")).__name__.endswith("Trigger_Request")
