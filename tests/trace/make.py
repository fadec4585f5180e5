"""Traces for tests, written through TraceWriter as a recorder would, with what they must hold.

``Feeder`` does the bookkeeping of a recorder (numbers, hashes) and remembers all it wrote.
``write_run`` makes a plausible run of two nodes with it: a timer that publishes, a subscription
that calls a service and logs, and in the end an exception.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from rsltrace.trace.cdr import log_content
from rsltrace.trace.chain import hash64, output_hash
from rsltrace.trace.format import (
    ATTACHMENT_JOB,
    EVENT_REST,
    METADATA_ENVIRONMENT,
    METADATA_JOB,
    OUTPUT,
    OUTPUT_HASHED,
    PREFIX_REQUEST,
    PREFIX_RESPONSE,
    TOPIC_ROSOUT,
)
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import (
    NO_EVENT,
    NO_SEQUENCE,
    EventFlag,
    EventKind,
    EventRecord,
    Output,
    OutputKind,
)
from rsltrace.trace.writer import TraceWriter

MS = 1_000_000
START_NS = 10_000_000_000
CDR = b"\x00\x01\x00\x00"
QOS_YAML = """\
- history: keep_last
  depth: 10
  reliability: reliable
  durability: volatile
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
"""
UINT64_HASH = "RIHS01_fbdc52018fc13755dce18024d1a671c856aa8b4aaf63adfb095b608f98e8c943"
LOG_SCHEMA = f"""\
byte INFO=20  # a constant
builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
TRIGGER_RESPONSE_SCHEMA = "bool success\nstring message\n"


def cdr_string(data: bytes, text: str) -> bytes:
    """Append a string to CDR bytes (which begin with the CDR header)."""
    data += bytes(-(len(data) - 4) % 4)
    encoded = text.encode() + b"\0"
    return data + struct.pack("<I", len(encoded)) + encoded


def uint64_message(value: int) -> bytes:
    return CDR + struct.pack("<Q", value % 2**64)


def log_message(stamp_ns: int, level: int, name: str, text: str) -> bytes:
    data = CDR + struct.pack("<iIB", *divmod(stamp_ns, 1_000_000_000), level)
    for part in (name, text, "node.py", "callback"):
        data = cdr_string(data, part)
    data += bytes(-(len(data) - 4) % 4)
    return data + struct.pack("<I", 7)


def trigger_response(text: str) -> bytes:
    return cdr_string(CDR + b"\x01", text)


@dataclass
class Feeder:
    """Feeds a writer and remembers what it was given."""

    writer: TraceWriter
    events: list[EventRecord] = field(default_factory=list)
    outputs: list[list[Output]] = field(default_factory=list)
    payloads: dict[int, list[tuple[int, bytes]]] = field(default_factory=dict)
    details: list[tuple[int, int, str]] = field(default_factory=list)
    entities: dict[int, Entity] = field(default_factory=dict)
    pending: list[Output] = field(default_factory=list)

    def entity(
        self,
        kind: EntityKind,
        name: str,
        *,
        node: int | None = None,
        type_: str = "",
        created_ns: int = START_NS,
        detail: dict[str, object] | None = None,
    ) -> int:
        entity_id = len(self.entities) + 1
        owner = entity_id if node is None else node
        entity = Entity(entity_id, owner, kind, name, type_, created_ns, detail or {})
        self.entities[entity_id] = entity
        self.writer.add_entity(entity)
        return entity_id

    def payload(self, channel: int, stamp_ns: int, data: bytes) -> int:
        sequence = self.writer.add_payload(channel, stamp_ns, data)
        kept = self.payloads.setdefault(channel, [])
        assert sequence == len(kept)
        kept.append((stamp_ns, data))
        return sequence

    def output(
        self, kind: OutputKind, entity: int, content: bytes | int, sequence: int = NO_SEQUENCE
    ) -> None:
        """Add what was sent; of a draw its number."""
        number = content if isinstance(content, int) else hash64(content)
        output = Output(len(self.events), entity, kind, number, sequence)
        self.pending.append(output)
        self.writer.add_output(pack_output(output)[OUTPUT_HASHED])
        if kind is not OutputKind.DRAW:
            self.writer.add_sequence(sequence)

    def detail(self, kind: OutputKind, entity: int, stamp_ns: int, text: str) -> None:
        event, nth = len(self.events), len(self.pending)
        self.details.append((event, nth, text))
        sequence = self.writer.add_detail(event, nth, stamp_ns, text)
        self.output(kind, entity, text.encode(), sequence)

    def event(
        self,
        kind: EventKind,
        entity: int,
        stamp_ns: int,
        *,
        input_hash: int = 0,
        cause: tuple[int, int] = (NO_EVENT, 0),
        flags: EventFlag = EventFlag.NONE,
        state_hash: int = 0,
    ) -> int:
        """End an event, which owns all outputs since the last; returns its index."""
        index = len(self.events)
        folded = output_hash(map(pack_output, self.pending))
        rest = EVENT_REST.pack(
            index,
            stamp_ns,
            cause[0],
            input_hash,
            folded,
            state_hash,
            entity,
            cause[1],
            len(self.pending),
            kind,
            flags,
        )
        chain_hash = hash64(rest, self.events[-1].chain_hash if self.events else 0)
        event = EventRecord(
            index=index,
            stamp_ns=stamp_ns,
            entity=entity,
            kind=kind,
            flags=flags,
            cause_event=cause[0],
            cause_output=cause[1],
            outputs=len(self.pending),
            input_hash=input_hash,
            output_hash=folded,
            state_hash=state_hash,
            chain_hash=chain_hash,
        )
        self.events.append(event)
        self.outputs.append(self.pending)
        self.pending = []
        self.writer.add_event(rest, chain_hash)
        return index

    @property
    def digest(self) -> str:
        return f"{self.events[-1].chain_hash if self.events else 0:016x}"


def pack_output(output: Output) -> bytes:
    return OUTPUT.pack(output.event, output.hash, output.entity, output.kind, output.sequence)


class Opened:
    """Context manager: a writer with its feeder, given up if the test does not close it."""

    def __init__(self, path: Path, *, force: bool = False, compression: str = "zstd") -> None:
        self.feeder = Feeder(TraceWriter(path, force=force, compression=compression))

    def __enter__(self) -> Feeder:
        return self.feeder

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.feeder.writer.abort()


def write_run(
    path: Path,
    events: int,
    *,
    close: bool = True,
    compression: str = "zstd",
    force: bool = False,
    checks: str = "",
) -> Feeder:
    """Write a run of at least ``events`` events to ``path``; without ``close`` as if it was killed.

    Every 20 ms a timer of /talker publishes on /count; /listener receives it, calls /check every
    fifth time and logs every seventh. The last event raises. ``checks`` are those of its job, in
    YAML.
    """
    with Opened(path, force=force, compression=compression) as feeder:
        _feed(feeder, events, checks)
        if close:
            feeder.writer.close(
                result={
                    "start_time": str(START_NS),
                    "end_time": str(START_NS + 20 * MS * events),
                    "stop_reason": "/listener raised ValueError",
                    "exit_code": "3",
                }
            )
    return feeder


def _feed(feeder: Feeder, events: int, checks: str) -> None:
    writer = feeder.writer
    job = "nodes:\n  - node: demo:Talker\n  - node: demo:Listener\n" + checks
    writer.add_metadata(METADATA_JOB, {"name": "job.yaml", "resolved": "{}"})
    writer.add_metadata(METADATA_ENVIRONMENT, {"python": "3.12.3", "ros_distro": "jazzy"})
    writer.add_attachment(ATTACHMENT_JOB, "application/yaml", job.encode())

    talker = feeder.entity(EntityKind.NODE, "/talker")
    rosout = feeder.entity(
        EntityKind.PUBLISHER, TOPIC_ROSOUT, node=talker, type_="rcl_interfaces/msg/Log"
    )
    publisher = feeder.entity(
        EntityKind.PUBLISHER,
        "/count",
        node=talker,
        type_="std_msgs/msg/UInt64",
        detail={"qos": {"depth": 10, "reliability": "reliable"}},
    )
    timer = feeder.entity(EntityKind.TIMER, "tick", node=talker, detail={"period_ns": 20 * MS})
    server = feeder.entity(EntityKind.SERVICE, "/check", node=talker, type_="std_srvs/srv/Trigger")
    for created in (talker, rosout, publisher, timer, server):
        feeder.output(OutputKind.ENTITY, created, b"identity")
    feeder.event(EventKind.CONSTRUCT, 0, START_NS)
    listener = feeder.entity(EntityKind.NODE, "/listener")
    subscription = feeder.entity(
        EntityKind.SUBSCRIPTION, "/count", node=listener, type_="std_msgs/msg/UInt64"
    )
    client = feeder.entity(EntityKind.CLIENT, "/check", node=listener, type_="std_srvs/srv/Trigger")
    for created in (listener, subscription, client):
        feeder.output(OutputKind.ENTITY, created, b"identity")
    feeder.event(EventKind.CONSTRUCT, 0, START_NS)

    count_channel = writer.add_channel(
        "/count", "std_msgs/msg/UInt64", "uint64 data\n", qos_yaml=QOS_YAML, type_hash=UINT64_HASH
    )
    log_channel = writer.add_channel(TOPIC_ROSOUT, "rcl_interfaces/msg/Log", LOG_SCHEMA)
    request_channel = writer.add_channel(
        f"{PREFIX_REQUEST}/check", "std_srvs/srv/Trigger_Request", ""
    )
    response_channel = writer.add_channel(
        f"{PREFIX_RESPONSE}/check", "std_srvs/srv/Trigger_Response", TRIGGER_RESPONSE_SCHEMA
    )

    step = 0
    while len(feeder.events) < events - 1:
        step += 1
        stamp_ns = START_NS + 20 * MS * step
        value = hash64(step.to_bytes(8, "little"))
        message = uint64_message(value)
        sequence = feeder.payload(count_channel, stamp_ns, message)
        feeder.output(OutputKind.MESSAGE, publisher, message, sequence)
        cause = feeder.event(EventKind.TIMER, timer, stamp_ns, input_hash=hash64(b"%d" % stamp_ns))
        if step % 5 == 0:
            request = CDR + b"\0"
            sequence = feeder.payload(request_channel, stamp_ns, request)
            feeder.output(OutputKind.REQUEST, client, request, sequence)
        if step % 7 == 0:
            log = log_message(stamp_ns, 20, "listener", f"received {value}")
            feeder.output(
                OutputKind.LOG, rosout, log_content(log), feeder.payload(log_channel, stamp_ns, log)
            )
        received = feeder.event(
            EventKind.SUBSCRIPTION,
            subscription,
            stamp_ns,
            input_hash=hash64(message),
            cause=(cause, 0),
        )
        if step % 5 == 0:
            response = trigger_response(str(value))
            sequence = feeder.payload(response_channel, stamp_ns, response)
            feeder.output(OutputKind.RESPONSE, server, response, sequence)
            answered = feeder.event(
                EventKind.SERVICE, server, stamp_ns, input_hash=1, cause=(received, 0)
            )
            feeder.event(
                EventKind.CLIENT, client, stamp_ns, input_hash=hash64(response), cause=(answered, 0)
            )
    text = 'Traceback (most recent call last):\n  File "demo.py", line 7\nValueError: too many\n'
    stamp_ns = START_NS + 20 * MS * (step + 1)
    feeder.detail(OutputKind.EXCEPTION, subscription, stamp_ns, text)
    feeder.event(EventKind.SUBSCRIPTION, subscription, stamp_ns, flags=EventFlag.RAISED)


def boundaries(data: bytes) -> list[int]:
    """Return the offsets at which the records of an MCAP file begin, and its end."""
    offsets = [8]
    while offsets[-1] < len(data) - 8:
        (length,) = struct.unpack_from("<Q", data, offsets[-1] + 1)
        offsets.append(offsets[-1] + 9 + length)
    return offsets


def opcodes(data: bytes, offsets: Sequence[int]) -> list[int]:
    """Return the opcode at each offset but the last."""
    return [data[offset] for offset in offsets[:-1]]
