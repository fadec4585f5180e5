"""Tables hold what the trace holds, row by row, and say what is missing."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from trace_maker import START_NS, Opened, write_run

from rsltrace.errors import SetupError, TraceError
from rsltrace.trace.decode import to_plain
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, NO_SEQUENCE, EventFlag, EventKind, OutputKind
from rsltrace.trace.reader import Trace

pa = pytest.importorskip("pyarrow")
EVENTS = 9000
"""More than two segments."""


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Trace]:
    path = tmp_path_factory.mktemp("tables") / "run.mcap"
    write_run(path, EVENTS)
    with Trace.open(path) as opened:
        yield opened


def node_of(trace: Trace, entity: int) -> str | None:
    return trace.node_of(trace.entity(entity)).name or None


def test_events_are_rows(trace: Trace) -> None:
    table = trace.tables.events().to_arrow()
    table.validate(full=True)
    assert table.num_rows == trace.event_count
    assert table.column("index").num_chunks == len(trace.segments) > 2
    rows = table.take([*range(30), *range(4090, 4100), trace.event_count - 1]).to_pylist()
    assert len({row["index"] for row in rows}) == len(rows)
    for row in rows:
        event = trace.event(row["index"])
        caused = event.cause_event != NO_EVENT
        assert row == {
            "index": event.index,
            "stamp_ns": event.stamp_ns,
            "kind": event.kind.label,
            "node": node_of(trace, event.entity),
            "name": trace.entity(event.entity).name or None,
            "entity": event.entity,
            "cause_event": event.cause_event if caused else None,
            "cause_output": event.cause_output if caused else None,
            "outputs": event.outputs,
            "raised": EventFlag.RAISED in event.flags,
            "suspended": False,
            "input_hash": event.input_hash,
            "output_hash": event.output_hash,
            "state_hash": None,
            "chain_hash": event.chain_hash,
        }
    assert rows[-1]["raised"]


def test_outputs_are_rows(trace: Trace) -> None:
    table = trace.tables.outputs().to_arrow()
    assert table.num_rows == trace.output_count
    wanted = [output for index in range(40) for output in trace.outputs_of(index)]
    for row, output in zip(table.slice(0, len(wanted)).to_pylist(), wanted, strict=True):
        entity = trace.entity(output.entity)
        assert row == {
            "event": output.event,
            "stamp_ns": trace.event(output.event).stamp_ns,
            "kind": output.kind.label,
            "node": node_of(trace, output.entity),
            "name": entity.name,
            "type": entity.type or None,
            "entity": output.entity,
            "sequence": None if output.sequence == NO_SEQUENCE else output.sequence,
            "hash": output.hash,
        }


def test_a_range_begins_and_ends_within_segments(trace: Trace) -> None:
    events = trace.tables.events(4000, 8200).to_arrow()["index"].to_pylist()
    assert events == list(range(4000, 8200))
    outputs = trace.tables.outputs(4000, 8200).to_arrow().to_pydict()
    wanted = [output.hash for index in events for output in trace.outputs_of(index)]
    assert outputs["hash"] == wanted
    stamps = [trace.event(event).stamp_ns for event in outputs["event"]]
    assert outputs["stamp_ns"] == stamps
    assert trace.tables.events(5, 5).to_arrow().num_rows == 0


def test_messages_are_rows_with_the_event_that_sent_them(
    trace: Trace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rsltrace.trace.tables.messages._ROWS_PER_BATCH", 1000)
    rows = trace.tables.messages("/count").to_arrow().to_pylist()
    assert len(rows) == sum(1 for _ in trace.messages("/count")) > 3000
    assert [row["sequence"] for row in rows] == list(range(len(rows)))
    for row in (*rows[:10], *rows[995:1005], rows[-1]):
        stamp_ns, data = trace.message(_channel(trace, "/count"), row["sequence"])
        assert (row["stamp_ns"], row["node"]) == (stamp_ns, "/talker")
        assert row["data"] == trace.decode("/count", data).data  # type: ignore[attr-defined]
        (sent,) = trace.outputs_of(row["event"])
        assert (sent.kind, sent.sequence) == (OutputKind.MESSAGE, row["sequence"])


@pytest.mark.parametrize(
    ("topic", "kind"),
    [
        ("/rosout", OutputKind.LOG),
        ("/rsltrace/request/check", OutputKind.REQUEST),
        ("/rsltrace/response/check", OutputKind.RESPONSE),
    ],
)
def test_logs_and_services_are_messages_too(trace: Trace, topic: str, kind: OutputKind) -> None:
    row = trace.tables.messages(topic).to_arrow().to_pylist()[3]
    sent = [output for output in trace.outputs_of(row["event"]) if output.kind is kind]
    assert [output.sequence for output in sent] == [3]
    assert row["node"] == node_of(trace, sent[0].entity)


def test_fields_are_those_asked_for(trace: Trace) -> None:
    tables = trace.tables
    own = ["stamp_ns", "event", "node", "sequence"]
    assert tables.messages("/rosout", ["msg", "stamp"]).to_arrow().column_names == [
        *own,
        "msg",
        "stamp.sec",
        "stamp.nanosec",
    ]
    with pytest.raises(TraceError, match=r"no field stamp\.sek; did you mean 'stamp\.sec'"):
        tables.messages("/rosout", ["stamp.sek"])
    with pytest.raises(TraceError, match="no topic /cound; did you mean '/count'"):
        tables.messages("/cound")
    with pytest.raises(TraceError, match="no messages of std_msgs/msg/Int8"):
        tables.messages("/count", type="std_msgs/msg/Int8")


def test_every_field_of_ros_has_a_column(tmp_path: Path) -> None:
    """Arrays, strings, messages in messages and in arrays: as what ``cat`` shows of them."""
    store: Any = get_typestore(Stores.ROS2_JAZZY)
    name, types = "sensor_msgs/msg/PointCloud2", store.types
    fields = [types["sensor_msgs/msg/PointField"](f, n, 7, 1) for n, f in enumerate("xyz")]
    stamp = types["builtin_interfaces/msg/Time"](3, 4)
    header = types["std_msgs/msg/Header"](stamp, "läser")
    message = types[name](header, 1, 2, fields, False, 8, 16, np.arange(16, dtype=np.uint8), True)
    path = tmp_path / "cloud.mcap"
    with Opened(path) as feeder:
        node = feeder.entity(EntityKind.NODE, "/lidar")
        sender = feeder.entity(EntityKind.PUBLISHER, "/cloud", node=node, type_=name)
        text = store.generate_msgdef(name, ros_version=2)[0]
        channel = feeder.writer.add_channel("/cloud", name, text)
        for _ in range(2):
            data = bytes(store.serialize_cdr(message, name))
            sequence = feeder.payload(channel, START_NS, data)
            feeder.output(OutputKind.MESSAGE, sender, data, sequence)
        feeder.event(EventKind.TIMER, node, START_NS)
        feeder.writer.close(result={})
    with Trace.open(path) as trace:
        first, second = trace.tables.messages("/cloud").to_arrow().to_pylist()
        plain = to_plain(trace.decode("/cloud", data))
        frame = trace.tables.messages("/cloud", ["header"]).to_pandas()
    assert {**first, "sequence": 1} == second
    assert first["header.frame_id"] == plain["header"]["frame_id"] == "läser"
    for field in ("height", "width", "fields", "is_bigendian", "point_step", "data", "is_dense"):
        assert first[field] == plain[field], field
    assert frame["header.stamp.sec"].tolist() == [3, 3]


def test_pandas_keeps_whole_numbers_whole(trace: Trace) -> None:
    pytest.importorskip("pandas")
    frame = trace.tables.events().to_pandas()
    assert len(frame) == trace.event_count
    events = [trace.event(index) for index in range(50)]
    assert frame["chain_hash"].tolist()[:50] == [event.chain_hash for event in events]
    caused = frame[frame["cause_event"].notna()].iloc[3]
    assert caused["cause_event"] == trace.event(caused["index"]).cause_event
    assert str(frame["cause_event"].dtype) == "Int64"
    rates = frame.groupby("name", observed=True).size()
    assert rates["tick"] == (frame["name"] == "tick").sum() > 1000


def test_numbers_are_not_copied_on_their_way_to_pandas(trace: Trace) -> None:
    pytest.importorskip("pandas")
    table = trace.tables.events(0, 100).to_arrow()
    assert np.shares_memory(
        table["chain_hash"].chunk(0).to_numpy(), table["chain_hash"].to_pandas().to_numpy()
    )


def test_entities_are_rows(trace: Trace) -> None:
    rows = trace.tables.entities().to_arrow().to_pylist()
    assert [row["entity"] for row in rows] == list(trace.entities)
    timer = next(row for row in rows if row["kind"] == "timer")
    assert (timer["name"], timer["node"]) == ("tick", "/talker")


def test_other_libraries_take_a_table_as_a_stream(trace: Trace) -> None:
    table = trace.tables.outputs()
    reader = pa.RecordBatchReader.from_stream(table)
    assert reader.read_all() == table.to_arrow()


@pytest.mark.parametrize("package", ["pyarrow", "pandas"])
def test_what_is_not_installed_is_named(
    trace: Trace, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(SetupError, match=rf"tables need {package}: .*'rsltrace\[tables\]'"):
        trace.tables.events().to_pandas()


def test_a_cut_trace_has_tables_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    write_run(path, 9000, close=False)
    with Trace.open(path) as trace:
        assert not trace.complete
        assert trace.tables.events().to_arrow().num_rows == trace.event_count == 8192
        counts = trace.tables.messages("/count").to_arrow()
        assert counts["event"].to_pylist()[-1] < 8192
        assert counts.num_rows == sum(1 for _ in trace.messages("/count")) > 3000


def test_times_and_kinds_of_another_world_are_refused(tmp_path: Path) -> None:
    late, unknown = tmp_path / "late.mcap", tmp_path / "unknown.mcap"
    for path, stamp_ns, kind in ((late, 2**63, EventKind.TIMER), (unknown, 1, 200)):
        with Opened(path) as feeder:
            feeder.event(kind, 0, stamp_ns)  # type: ignore[arg-type]
            feeder.writer.close(result={})
    for path, said in ((late, "later than any time"), (unknown, "200 is not a valid EventKind")):
        with Trace.open(path) as trace, pytest.raises(TraceError, match=said):
            trace.tables.events().to_arrow()


def test_a_schema_that_is_none_is_told_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    with Opened(path) as feeder:
        feeder.writer.add_channel("/odd", "x/msg/Odd", "no schema at all;")
        feeder.event(EventKind.TIMER, 0, 1)
        feeder.writer.close(result={})
    with Trace.open(path) as trace, pytest.raises(TraceError, match=r"odd\.mcap: messages on /odd"):
        trace.tables.messages("/odd")


def test_a_schema_that_unfolds_without_end_is_refused(tmp_path: Path) -> None:
    levels = 30
    parts = [f"x/A{n + 1} one\nx/A{n + 1} two\n" for n in range(levels)] + ["uint8 end\n"]
    separator = "=" * 80
    text = parts[0] + "".join(
        f"{separator}\nMSG: x/A{n}\n{part}" for n, part in enumerate(parts) if n
    )
    path = tmp_path / "bomb.mcap"
    with Opened(path) as feeder:
        channel = feeder.writer.add_channel("/bomb", "x/msg/A0", text)
        feeder.payload(channel, 1, b"\0\1\0\0\0")
        feeder.event(EventKind.TIMER, 0, 1)
        feeder.writer.close(result={})
    with Trace.open(path) as trace, pytest.raises(TraceError, match=r"/bomb have \d+ fields"):
        trace.tables.messages("/bomb")


def _channel(trace: Trace, topic: str) -> int:
    return next(channel.id for channel in trace.channels.values() if channel.topic == topic)
