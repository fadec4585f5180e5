"""Which event a message came from, for any run and however its messages are handed out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trace_maker
from hypothesis import given, settings
from hypothesis import strategies as st

from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.reader import Trace

pytest.importorskip("rerun")

from rsltrace_viewer.rerun_export.moments import Moments

from tests.tiers import cases

TOPICS = ("/x", "/y")


@given(
    st.lists(
        st.tuples(
            st.integers(0, 2),  # how far time moves on
            st.lists(st.integers(0, 3), max_size=4),  # which publishers send, in order
        ),
        max_size=40,
    ),
    st.lists(st.integers(1, 7), min_size=1, max_size=10),
)
@settings(max_examples=cases(10, 60), deadline=None)
def test_each_message_finds_its_event(
    tmp_path_factory: pytest.TempPathFactory,
    run: list[tuple[int, list[int]]],
    cuts: list[int],
) -> None:
    path = tmp_path_factory.mktemp("moments") / "run.mcap"
    expected: dict[str, list[tuple[int, int, int]]] = {topic: [] for topic in TOPICS}
    with trace_maker.Opened(path, force=True) as feeder:
        node = feeder.entity(EntityKind.NODE, "/n")
        publishers = [
            feeder.entity(EntityKind.PUBLISHER, TOPICS[i % 2], node=node, type_="std_msgs/msg/X")
            for i in range(4)
        ]
        channels = {t: feeder.writer.add_channel(t, "std_msgs/msg/X", "uint8 x") for t in TOPICS}
        stamp = 100
        for moved, senders in run:
            stamp += moved
            for sender in senders:
                topic = TOPICS[sender % 2]
                sequence = feeder.payload(channels[topic], stamp, trace_maker.CDR + b"\1")
                feeder.output(OutputKind.MESSAGE, publishers[sender], b"1", sequence)
                expected[topic].append((stamp, len(feeder.events), publishers[sender]))
            feeder.event(EventKind.TIMER, node, stamp)
        feeder.writer.close(result={"stop_reason": "done", "exit_code": "0"})
    with Trace.open(path) as trace:
        moments = Moments(trace)
        for topic, sent in expected.items():
            stamps = np.array([stamp for stamp, _, _ in sent], dtype=np.int64)
            found: list[tuple[int, int]] = []
            begin = 0
            for size in cuts * len(sent):
                piece = stamps[begin : begin + size]
                events, entities = moments.of_messages(topic, topic, piece)
                found += zip(events.tolist(), entities.tolist(), strict=True)
                begin += size
                if begin >= len(stamps):
                    break
            assert found == [(event, entity) for _, event, entity in sent]


def test_a_message_that_makes_several_rows_stays_at_its_event(tmp_path: Path) -> None:
    feeder = trace_maker.write_run(tmp_path / "run.mcap", 30)
    published = [
        (event.index, event.stamp_ns)
        for event, outputs in zip(feeder.events, feeder.outputs, strict=True)
        if any(output.kind is OutputKind.MESSAGE for output in outputs)
    ]
    with Trace.open(tmp_path / "run.mcap") as trace:
        thrice = np.repeat([stamp for _, stamp in published], 3).astype(np.int64)
        events, _ = Moments(trace).of_messages("/count", "tf", thrice)
    assert events.tolist() == [index for index, _ in published for _ in range(3)]


def test_what_nothing_published_is_at_an_event_before_it(tmp_path: Path) -> None:
    trace_maker.write_run(tmp_path / "run.mcap", 30)
    with Trace.open(tmp_path / "run.mcap") as trace:
        stamps = np.array([trace_maker.START_NS + 1], dtype=np.int64)
        events, entities = Moments(trace).of_messages("/nothing", "s", stamps)
    assert events.tolist() == [0]
    assert entities.tolist() == [0]
