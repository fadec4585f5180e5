"""What several processes tell becomes one order of events, whoever tells first."""

from __future__ import annotations

import pickle
import random
import socket
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsltrace.native.observed_entities import ObservedEntities
from rsltrace.native.processes import run as merging
from rsltrace.native.processes.run import SpanMerger
from rsltrace.native.processes.wire import Link, LinkError, SpanDecoder, SpanEncoder
from rsltrace.native.span_recorder import (
    CallbackError,
    CallbackSpan,
    EmittedLog,
    ReceivedInput,
    SentMessage,
    SpanRecorder,
    TaskCreation,
    now_ns,
)
from rsltrace.simulation.middleware.interface import MessageType
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind
from tests.tiers import cases

TIMER, TASK = int(EventKind.TIMER), int(EventKind.TASK)


def span(start_ns: int) -> CallbackSpan:
    return CallbackSpan(TIMER, None, start_ns, 0, 1, None, end_ns=start_ns + 1)


@settings(max_examples=cases(10, 40))
@given(st.lists(st.lists(st.integers(0, 200)), min_size=1, max_size=5), st.randoms())
def test_all_is_in_order_and_nothing_is_lost(
    starts: list[list[int]], chance: random.Random
) -> None:
    begun_ns = now_ns() + 10**12
    merge = SpanMerger()
    left = [(merge.source(), sorted(begun_ns + one for one in own)) for own in starts]
    found: list[int] = []
    while left:
        source, own = chance.choice(left)
        part = [own.pop(0) for _ in range(chance.randint(0, len(own)))]
        merge.add(source, [span(one) for one in part], own[0] if own else begun_ns + 1000)
        if not own:
            merge.end(source)
            left.remove((source, own))
        found += [one.start_ns for one in merge.finished(0)]
    found += [one.start_ns for one in merge.finished(None)]
    assert found == sorted(begun_ns + one for own in starts for one in own)
    assert merge.late == 0


def test_who_has_told_nothing_keeps_the_others_back() -> None:
    merge = SpanMerger()
    silent, other = merge.source(), merge.source()
    later_ns = now_ns() + 10**10
    merge.add(other, [span(later_ns)], later_ns + 1)
    assert merge.finished(0) == []
    merge.add(silent, [], later_ns + 1)
    assert [one.start_ns for one in merge.finished(0)] == [later_ns]


def test_who_stands_still_does_not_keep_them_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    merge = SpanMerger()
    silent, other = merge.source(), merge.source()
    begun_ns = now_ns()
    merge.add(other, [span(begun_ns)], begun_ns + 1)
    monkeypatch.setattr(merging, "now_ns", lambda: begun_ns + merging.STALLED_NS + 10**9)
    merge.add(other, [], begun_ns + merging.STALLED_NS + 10**9)
    assert [one.start_ns for one in merge.finished(0)] == [begun_ns]
    merge.add(silent, [span(begun_ns - 5)], begun_ns)  # others are in the file already
    assert [one.start_ns for one in merge.finished(None)] == [begun_ns]
    assert merge.late == 1


def test_who_is_read_late_on_a_busy_machine_keeps_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    merge = SpanMerger()
    behind, other = merge.source(), merge.source()
    begun_ns = now_ns()
    at_ns = begun_ns + 2 * merging.STALLED_NS
    monkeypatch.setattr(merging, "now_ns", lambda: at_ns)
    merge.add(other, [span(begun_ns + 3)], at_ns)
    merge.add(behind, [span(begun_ns + 1)], begun_ns + 2)
    assert [one.start_ns for one in merge.finished(0)] == [begun_ns + 1]
    at_ns += 2 * merging.STALLED_NS
    behind.is_being_read = True
    assert merge.finished(0) == []
    merge.add(behind, [span(begun_ns + 2)], at_ns)
    assert [one.start_ns for one in merge.finished(0)] == [begun_ns + 2, begun_ns + 3]
    assert merge.late == 0


def test_spans_are_the_same_on_the_other_side() -> None:
    log = pytest.importorskip("rcl_interfaces.msg").Log
    recorder = SpanRecorder()
    entities = ObservedEntities(recorder.add)
    writer = SpanEncoder(entities)
    node = entities.add((), None, EntityKind.NODE, "/node")
    topic = entities.add((), node, EntityKind.PUBLISHER, "/topic", "std_msgs/msg/String")
    rosout = entities.add((), node, EntityKind.PUBLISHER, "/rosout")
    topic.sends, topic.gid = MessageType("std_msgs/msg/String", lambda: ("string data", "")), b"me"
    recorder.finished(None)
    taken = ReceivedInput(topic, 1, 2, "1 /topic", 3, 4, 5, 6, b"gid")
    recorder.begin(TIMER, topic, taken)
    sent = SentMessage(1, topic, 7, b"data", 8, 9, 10)
    recorder.sent(recorder.sending(), sent)
    recorder.add(EmittedLog(rosout, 20, "name", "text", "function", "file", 3))
    cause = recorder.add(TaskCreation())
    recorder.end(CallbackError("ValueError", "no", "trace"))
    recorder.begin(TASK, topic, None, cause)
    recorder.end()
    spans = recorder.finished(None)
    told = pickle.loads(pickle.dumps((writer.definitions(), [writer.plain(one) for one in spans])))

    reader = SpanDecoder(count(100), count(7), log)
    reader.define(told[0])
    first, second = (reader.span(one) for one in told[1])
    assert (first.entity, second.entity) == (first.entity, first.entity)
    assert first.entity is not None
    assert (first.entity.id, first.entity.node, first.entity.gid) == (101, 100, b"me")
    assert first.entity.sends is not None
    assert first.entity.sends.describe() == ("string data", "")
    assert first.thread == 7
    assert second.cause == (first, 2)
    assert first.taken == ReceivedInput(first.entity, 1, 2, "1 /topic", 3, 4, 5, 6, b"gid")
    assert [type(one) for one in first.outputs] == [
        SentMessage,
        EmittedLog,
        TaskCreation,
        CallbackError,
    ]


class Evil:
    """Runs code when it is read."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return print, ("!",)


def test_frames_are_whole_and_run_no_code() -> None:
    here, there = socket.socketpair()
    with here, there:
        sender, receiver = Link(here), Link(there)
        there.settimeout(0.01)
        here.sendall(b"\x05\x00")
        with pytest.raises(TimeoutError):
            receiver.receive()
        here.sendall(b"\x00\x00hello")
        with pytest.raises(LinkError):
            receiver.receive()
        sender.send("spans", b"x" * 10_000, [1, (2.5, None)])
        sender.send("next")
        assert receiver.receive() == ("spans", b"x" * 10_000, [1, (2.5, None)])
        assert receiver.receive() == ("next",)
        sender.send("what", Evil())
        with pytest.raises(LinkError, match="no plain value"):
            receiver.receive()
        here.close()
        assert receiver.receive() is None
