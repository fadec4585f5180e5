"""Whatever is written is read back: random runs through the writer and the reader."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trace_maker import Opened

from rsltrace.trace import writer as writer_module
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, NO_SEQUENCE, EventFlag, EventKind, OutputKind
from rsltrace.trace.reader import Trace
from tests.tiers import cases

U64 = st.integers(0, 2**64 - 1)
PAYLOAD = st.binary(max_size=40)
OUTPUT = st.tuples(st.sampled_from(OutputKind), st.integers(0, 5), PAYLOAD, st.booleans())
EVENT = st.fixed_dictionaries(
    {
        "kind": st.sampled_from(EventKind),
        "entity": st.integers(0, 5),
        "stamp_ns": U64,
        "input_hash": U64,
        "state_hash": U64,
        "flags": st.sampled_from([EventFlag.NONE, EventFlag.RAISED, EventFlag.SUSPENDED]),
        "cause": st.one_of(st.just((NO_EVENT, 0)), st.tuples(U64, st.integers(0, 2**32 - 1))),
        "outputs": st.lists(OUTPUT, max_size=4),
    }
)


@settings(max_examples=cases(20, 120), deadline=None)
@given(
    events=st.lists(EVENT, max_size=30),
    per_segment=st.integers(1, 7),
    outputs_per_segment=st.integers(1, 20),
    bytes_per_chunk=st.integers(1, 300),
    compression=st.sampled_from(["zstd", ""]),
    close=st.booleans(),
)
def test_what_is_written_is_read(
    events: list[dict],
    per_segment: int,
    outputs_per_segment: int,
    bytes_per_chunk: int,
    compression: str,
    close: bool,
) -> None:
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setattr(writer_module, "EVENTS_PER_SEGMENT", per_segment)
        patch.setattr(writer_module, "OUTPUTS_PER_SEGMENT", outputs_per_segment)
        patch.setattr(writer_module, "PAYLOAD_BYTES_PER_CHUNK", bytes_per_chunk)
        path = Path(folder) / "run.mcap"
        with Opened(path, compression=compression) as feeder:
            for number in range(5):
                feeder.entity(EntityKind.PUBLISHER, f"/topic{number}", node=0, type_="x/msg/T")
            channels = [
                feeder.writer.add_channel(f"/topic{number}", "x/msg/T", "uint8 x\n")
                for number in range(5)
            ]
            for event in events:
                outputs = event.pop("outputs")
                for kind, entity, data, keep in outputs:
                    sequence = NO_SEQUENCE
                    if kind is OutputKind.MESSAGE and keep and entity:
                        sequence = feeder.payload(channels[entity - 1], event["stamp_ns"], data)
                    feeder.output(kind, entity, data, sequence)
                feeder.event(event.pop("kind"), event.pop("entity"), event.pop("stamp_ns"), **event)
            if close:
                feeder.writer.close(result={"exit_code": "0"})
        with Trace.open(path) as trace:
            assert trace.complete == close
            count = trace.event_count
            assert count == len(events) if close else count <= len(events)
            assert [trace.event(i) for i in range(count)] == feeder.events[:count]
            assert [trace.outputs_of(i) for i in range(count)] == feeder.outputs[:count]
            for channel in channels:
                found = [(s, d) for s, _, d in trace.messages(trace.channels[channel].topic)]
                fed = feeder.payloads.get(channel, [])
                assert found == fed if close else found == fed[: len(found)]
            for index in range(count):
                for output in trace.outputs_of(index):
                    if output.sequence != NO_SEQUENCE:
                        topic = f"/topic{output.entity - 1}"
                        channel = channels[output.entity - 1]
                        stamp_ns, data = feeder.payloads[channel][output.sequence]
                        assert trace.payload(output) == (stamp_ns, topic, data)
            trace.check()
