"""A trace for Perfetto: what its own definitions read back."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from trace_maker import MS, START_NS, Opened, write_run

import rsltrace.trace.exports.perfetto as perfetto
from rsltrace import Trace
from rsltrace.cli.main import cli
from rsltrace.errors import OutputError, SetupError, TraceError
from rsltrace.trace.exports.perfetto import export_perfetto
from rsltrace.trace.format import METADATA_NATIVE, TIMING
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import (
    NO_EVENT,
    EventKind,
    OutputKind,
    RandomDecision,
    encode_decision,
)
from rsltrace.trace.model.finding import Finding, GuardMode, NondeterminismSource

messages = pytest.importorskip(
    "perfetto.protos.perfetto.trace.perfetto_trace_pb2",
    reason="needs pip install 'rsltrace[perfetto]'",
)
EVIL = "\x1b]0;owned\x07\x1b[2J\u202e</script>"


@dataclass
class Mark:
    """A slice or instant: its track's name and number, times, and the ends of its arrows."""

    name: str
    track: str
    number: int
    begin_ns: int
    end_ns: int
    event: int
    leaves: list[int]
    arrives: list[int]


@dataclass
class Shown:
    """What Perfetto shows of a file."""

    marks: list[Mark] = field(default_factory=list)
    counters: dict[str, list[tuple[int, float]]] = field(default_factory=lambda: defaultdict(list))
    callbacks: list[Mark] = field(default_factory=list)

    def on(self, track: str) -> list[Mark]:
        return [mark for mark in self.marks if mark.track == track]


def read(path: Path) -> Shown:
    """Read a file as Perfetto does: sorted by time, equal times in the order of the file."""
    trace = messages.Trace.FromString(path.read_bytes())
    shown, tracks, names, open_slices = Shown(), {}, {}, defaultdict(list)
    for packet in trace.packet:
        assert packet.trusted_packet_sequence_id == 1
        for one in packet.interned_data.event_names:
            names[one.iid] = one.name
        if packet.HasField("track_descriptor"):
            one = packet.track_descriptor
            assert one.uuid not in tracks
            parent = f"{tracks[one.parent_uuid]} > " if one.parent_uuid else ""
            tracks[one.uuid] = parent + one.name
    kinds = messages.TrackEvent
    for packet in sorted(trace.packet, key=lambda one: one.timestamp):
        if not packet.HasField("track_event"):
            continue
        one, at_ns = packet.track_event, packet.timestamp
        track = tracks[one.track_uuid]
        if one.type == kinds.TYPE_COUNTER:
            shown.counters[track].append((at_ns, one.double_counter_value))
        elif one.type == kinds.TYPE_SLICE_END:
            open_slices[one.track_uuid].pop().end_ns = at_ns
        else:
            name = names[one.name_iid] if one.name_iid else one.name
            (annotation,) = one.debug_annotations
            mark = Mark(
                name, track, one.track_uuid, at_ns, at_ns, annotation.uint_value,
                list(one.flow_ids), list(one.terminating_flow_ids),
            )  # fmt: skip
            shown.marks.append(mark)
            if one.name_iid:  # stored once: of a callback
                shown.callbacks.append(mark)
            if one.type == kinds.TYPE_SLICE_BEGIN:
                assert not open_slices[one.track_uuid], "slices of one track overlap"
                open_slices[one.track_uuid].append(mark)
    assert not any(open_slices.values())
    return shown


def exported(trace: Path, **more: Any) -> Shown:
    output = trace.with_suffix(".pftrace")
    export_perfetto(trace, output, force=True, **more)
    return read(output)


def causes(trace: Path) -> set[tuple[int, int]]:
    with Trace.open(trace) as opened:
        return {
            (int(row["cause_event"]), int(row["index"]))
            for events in opened.events()
            for row in events[events["cause_event"] != NO_EVENT]
        }


def arrows(shown: Shown) -> set[tuple[int, int]]:
    begins = {flow: mark.event for mark in shown.callbacks for flow in mark.leaves}
    assert len(begins) == sum(len(mark.leaves) for mark in shown.callbacks)
    ends = {flow: mark.event for mark in shown.callbacks for flow in mark.arrives}
    assert begins.keys() == ends.keys()
    return {(begins[flow], ends[flow]) for flow in begins}


def test_every_event_and_every_cause(tmp_path: Path) -> None:
    write_run(tmp_path / "run.mcap", 9000)
    shown = exported(tmp_path / "run.mcap")
    with Trace.open(tmp_path / "run.mcap") as opened:
        stamps = [int(stamp) for events in opened.events() for stamp in events["stamp"]]
    assert [mark.event for mark in shown.callbacks] == list(range(len(stamps)))
    assert [mark.begin_ns for mark in shown.callbacks] == stamps
    assert all(mark.end_ns == mark.begin_ns for mark in shown.callbacks)
    assert arrows(shown) == causes(tmp_path / "run.mcap")
    assert shown.callbacks[0].track == "/talker > callbacks"
    assert {mark.name for mark in shown.on("/talker > callbacks")} == {
        "construct /talker", "timer tick", "service /check",
    }  # fmt: skip
    logs = shown.on("/listener > log")
    assert len(logs) > 500
    assert logs[0].name.startswith("INFO received ")
    (error,) = shown.on("/listener > errors")
    assert (error.name, error.event) == ("exception ValueError: too many", len(stamps) - 1)
    first, last = shown.counters["topics > /count rate"]
    assert first == (START_NS + 20 * MS, 50.0)
    assert last[1] == 0
    assert "/listener > /count waiting" not in shown.counters  # received when it was sent


def test_what_is_caused_too_late_has_no_arrow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(perfetto, "_EVENTS_AHEAD", 4096)
    with Opened(tmp_path / "run.mcap") as feeder:
        node = feeder.entity(EntityKind.NODE, "/a")
        timer = feeder.entity(EntityKind.TIMER, "tick", node=node)
        for number in range(9000):
            cause = (0, 0) if number else (NO_EVENT, 0)
            feeder.event(EventKind.TIMER, timer, START_NS + number, cause=cause)
        feeder.writer.close(result={})
    shown = exported(tmp_path / "run.mcap")
    assert len(shown.callbacks) == 9000
    assert arrows(shown) == {(0, number) for number in range(1, 8192)}


def test_execution_times_overlaps_and_waiting_messages(tmp_path: Path) -> None:
    with Opened(tmp_path / "run.mcap") as feeder:
        source = feeder.entity(EntityKind.NODE, "/source")
        timer = feeder.entity(EntityKind.TIMER, "tick", node=source)
        publisher = feeder.entity(EntityKind.PUBLISHER, "/x", node=source)
        sink = feeder.entity(EntityKind.NODE, "/sink")
        subscription = feeder.entity(
            EntityKind.SUBSCRIPTION, "/x", node=sink, detail={"group": "reentrant 1"}
        )
        sent = []
        for number in range(3):  # at 0, 10 and 20 ms, each takes 5 ms
            feeder.output(OutputKind.MESSAGE, publisher, b"x")
            feeder.output(OutputKind.DRAW, timer, encode_decision(RandomDecision.EXECUTION, 5 * MS))
            at_ns = START_NS + number * 10 * MS
            sent.append(feeder.event(EventKind.TIMER, timer, at_ns))
        for number, at_ms in enumerate((30, 40, 90)):
            took = encode_decision(RandomDecision.EXECUTION, 50 * MS)
            feeder.output(OutputKind.DRAW, subscription, took)
            feeder.event(
                EventKind.SUBSCRIPTION, subscription, START_NS + at_ms * MS, cause=(sent[number], 0)
            )
        feeder.writer.close(result={})
    shown = exported(tmp_path / "run.mcap")
    assert [(m.end_ns - m.begin_ns) // MS for m in shown.callbacks] == [5, 5, 5, 50, 50, 50]
    one, two, three = shown.on("/sink > reentrant 1")
    assert one.number != two.number  # side by side
    assert three.number == one.number  # which is free again
    waiting = [((at - START_NS) // MS, n) for at, n in shown.counters["/sink > /x waiting"]]
    assert waiting == [(5, 1), (15, 2), (25, 3), (30, 2), (40, 1), (90, 0)]
    rates = [((at - START_NS) // MS, n) for at, n in shown.counters["topics > /x rate"]]
    assert rates == [(5, 100), (25, 0)]


def test_a_callback_that_goes_on_is_no_message(tmp_path: Path) -> None:
    with Opened(tmp_path / "run.mcap") as feeder:
        node = feeder.entity(EntityKind.NODE, "/a")
        subscription = feeder.entity(EntityKind.SUBSCRIPTION, "/x", node=node)
        first = feeder.event(EventKind.TASK, node, START_NS)
        for number, kind in enumerate((EventKind.RESUME, EventKind.SUBSCRIPTION), 1):
            feeder.event(kind, subscription, START_NS + number * MS, cause=(first, 0))
        feeder.writer.close(result={})
    shown = exported(tmp_path / "run.mcap")
    assert shown.counters["/a > /x waiting"] == [(START_NS, 1), (START_NS + 2 * MS, 0)]
    assert arrows(shown) == {(0, 1), (0, 2)}


def test_a_native_run_has_threads_with_real_durations(tmp_path: Path) -> None:
    with Opened(tmp_path / "run.mcap") as feeder:
        feeder.writer.add_metadata(METADATA_NATIVE, {"mode": "native"})
        nodes = [feeder.entity(EntityKind.NODE, name) for name in ("/a", "/b")]
        timers = [feeder.entity(EntityKind.TIMER, "tick", node=node) for node in nodes]
        for number in range(4):
            at_ns = START_NS + number * MS
            row = (number, 7, 8, 1000 + number, 0, 0, 0, 0, 1 + number // 2)
            feeder.writer.add_timing(TIMING.pack(*row), at_ns)
            feeder.event(EventKind.TIMER, timers[number % 2], at_ns)
        feeder.writer.close(result={})
    shown = exported(tmp_path / "run.mcap")
    assert [(m.track, m.name, m.end_ns - m.begin_ns) for m in shown.callbacks] == [
        ("thread 1", "/a: timer tick", 1000),
        ("thread 1", "/b: timer tick", 1001),
        ("thread 2", "/a: timer tick", 1002),
        ("thread 2", "/b: timer tick", 1003),
    ]


def test_names_from_anybody_and_findings(tmp_path: Path) -> None:
    with Opened(tmp_path / "run.mcap") as feeder:
        node = feeder.entity(EntityKind.NODE, f"/a{EVIL}")
        group = {"group": EVIL * 1000}
        timer = feeder.entity(EntityKind.TIMER, EVIL, node=node, detail=group)
        publisher = feeder.entity(EntityKind.PUBLISHER, f"/x{EVIL}", node=node)
        feeder.output(OutputKind.MESSAGE, publisher, b"x")
        for mode in (GuardMode.WARN, GuardMode.VIRTUAL):
            found = Finding(
                0, timer, f"/a{EVIL}", NondeterminismSource.CLOCK, mode, f"time{EVIL}", "", ""
            )
            feeder.writer.add_finding(found, START_NS)
        feeder.event(EventKind.TIMER, timer, START_NS)
        feeder.event(EventKind.TIMER, 4_000_000, START_NS)  # nobody has described that one
        feeder.writer.close(result={})
    shown = exported(tmp_path / "run.mcap")
    (finding,) = [mark for mark in shown.marks if mark.track.endswith(" > findings")]
    assert finding.name.startswith(r"clock time\x1b]0;owned\x07")
    assert finding.track.startswith(r"/a\x1b")
    assert [mark.track for mark in shown.callbacks][1] == "(run) > callbacks"
    texts = [*shown.counters, *(text for mark in shown.marks for text in (mark.name, mark.track))]
    assert all(text.isprintable() and len(text) < 3000 for text in texts)


def test_what_no_run_contains_is_refused(tmp_path: Path) -> None:
    def made(stamp_ns: int, duration_ns: int, *, native: bool) -> Path:
        with Opened(tmp_path / "run.mcap", force=True) as feeder:
            if native:
                feeder.writer.add_metadata(METADATA_NATIVE, {"mode": "native"})
            node = feeder.entity(EntityKind.NODE, "/a")
            if duration_ns:
                row = (0, 0, 0, duration_ns, 0, 0, 0, 0, 1)
                feeder.writer.add_timing(TIMING.pack(*row), START_NS)
            feeder.event(EventKind.TASK, node, stamp_ns)
            feeder.writer.close(result={})
        return tmp_path / "run.mcap"

    with pytest.raises(TraceError, match="later than any time"):
        exported(made(2**64 - 1, 0, native=False))
    with pytest.raises(TraceError, match="timings are not those"):
        exported(made(START_NS, 0, native=True))
    assert len(exported(made(START_NS, 2**64 - 1, native=True)).callbacks) == 1


def test_the_file_appears_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trace, output = tmp_path / "run.mcap", tmp_path / "run.pftrace"
    write_run(trace, 50)
    export_perfetto(trace, output)
    before = output.read_bytes()
    with pytest.raises(OutputError, match="exists; use --force"):
        export_perfetto(trace, output)
    os.mkfifo(tmp_path / "pipe")
    for place, message in (
        (trace, "is the trace itself"),
        (tmp_path / "pipe", "a named pipe"),
        (Path("/dev/null"), "not a regular file"),
        (tmp_path, "is a folder"),
        (tmp_path / "none" / "run.pftrace", "does not exist"),
    ):
        with pytest.raises(OutputError, match=message):
            export_perfetto(trace, place, force=True)

    def fail(*arguments: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(perfetto._Packets, "flush", fail)
    with pytest.raises(OutputError, match="No space left"):
        export_perfetto(trace, output, force=True)
    monkeypatch.undo()
    assert output.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pipe", "run.mcap", "run.pftrace"]
    monkeypatch.setitem(sys.modules, "perfetto.protos.perfetto.trace", None)
    with pytest.raises(SetupError, match=r"pip install 'rsltrace\[perfetto\]'"):
        export_perfetto(trace, output, force=True)


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "run.mcap", 50)

    def call(*words: str) -> tuple[int, str]:
        done = CliRunner().invoke(cli, ["export", "run.mcap", *words])
        return done.exit_code, done.output

    status, said = call("--perfetto", "run.pftrace", "--layout", "layout.json", "-o", "bag")
    assert status == 0, said
    assert "wrote run.pftrace: 5" in said
    assert (tmp_path / "layout.json").exists()
    assert (tmp_path / "bag" / "metadata.yaml").exists()
    for words, message in (
        ((), "give --bag, --perfetto or --layout"),
        (("--perfetto", "x", "--layout", "./x"), "need different names"),
        (("--perfetto", "x", "--topic", "/a"), "--topic and --exclude need --bag or --layout"),
        (("--perfetto", "x", "--layout", "layout.json"), "layout.json exists"),
        (("--perfetto", "x", "-o", "bag"), "cannot write the bag bag"),
    ):
        status, said = call(*words)
        assert (status, (tmp_path / "x").exists()) == (2, False)
        assert message in said
    data = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(data[:-300])
    status, said = call("--perfetto", "cut.pftrace")
    assert (status, "the export ends with it after" in said) == (1, True), said
    assert read(tmp_path / "cut.pftrace").callbacks


@pytest.mark.long
def test_memory_is_bounded(tmp_path: Path) -> None:
    write_run(tmp_path / "run.mcap", 200_000)
    code = (
        "from pathlib import Path;"
        "from rsltrace.trace.exports.perfetto import export_perfetto as export;"
        "export(Path('run.mcap'), Path('run.pftrace'));"
        "status = Path('/proc/self/status').read_text().split('VmHWM:')[1];"
        "print(status.split()[0])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 120 << 10  # KiB
    assert (tmp_path / "run.pftrace").stat().st_size > 8_000_000


@pytest.mark.ros
def test_a_real_job(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    from rclpy.callback_groups import ReentrantCallbackGroup
    from rclpy.node import Node
    from std_msgs.msg import UInt64

    from rsltrace import Job, NodeSpec, StopSpec, record

    class Source(Node):
        def __init__(self) -> None:
            super().__init__("source")
            self.out = self.create_publisher(UInt64, "x", 10)
            self.create_timer(0.1, lambda: self.out.publish(UInt64(data=1)))

    class Sink(Node):
        def __init__(self) -> None:
            super().__init__("sink")
            group = ReentrantCallbackGroup()
            self.create_subscription(UInt64, "x", self.take, 10, callback_group=group)

        def take(self, message: UInt64) -> None:
            self.get_logger().warn("took it")

    job = Job(
        nodes=[NodeSpec(node=lambda: [Source()]), NodeSpec(node=lambda: [Sink()])],
        stop=StopSpec(duration="1s"),
        execution={"nodes": {"/sink": "150ms"}},
    )
    record(job, tmp_path / "run.mcap")
    shown = exported(tmp_path / "run.mcap")
    taken = shown.on("/sink > reentrant 1")
    assert {mark.end_ns - mark.begin_ns for mark in taken} == {150 * MS}
    assert arrows(shown) == causes(tmp_path / "run.mcap")
    assert [mark.name for mark in shown.on("/sink > log")] == ["WARN took it"] * len(taken)
    assert max(value for _, value in shown.counters["/sink > /x waiting"]) >= 2
    assert shown.counters["topics > /x rate"][0] == (100 * MS, 10.0)
