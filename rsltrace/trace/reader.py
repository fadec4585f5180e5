"""Read a trace: one read-only object that fetches only what is asked for.

Opening reads the summary at the end of the file, so the digest of a million events costs as much as
that of ten. A trace whose run was killed has no summary: the file is scanned once and then read in
the same way, with ``complete`` false.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from mcap.opcode import Opcode

from rsltrace.errors import TraceError
from rsltrace.trace.cdr import unpack_code_line, unpack_detail, unpack_entity, unpack_finding
from rsltrace.trace.chain import digest_text
from rsltrace.trace.format import (
    ATTACHMENT_JOB,
    METADATA_EDITS,
    METADATA_ENVIRONMENT,
    METADATA_GUARD,
    METADATA_JOB,
    METADATA_NATIVE,
    METADATA_OWN,
    METADATA_RESULT,
    PREFIX_OWN,
    PREFIX_REQUEST,
    PREFIX_RESPONSE,
    TOPIC_CODE_LINES,
    TOPIC_DETAILS,
    TOPIC_ENTITIES,
    TOPIC_EVENTS,
    TOPIC_FINDINGS,
    TOPIC_OUTPUTS,
    TOPIC_ROSOUT,
)
from rsltrace.trace.index import (
    ChannelInfo,
    TraceIndex,
    damage_error,
    read_attachment,
    read_metadata,
    read_summary,
)
from rsltrace.trace.mcap.open import open_source
from rsltrace.trace.mcap.reader import McapSummary, check_data, has_end, read_body, walk_records
from rsltrace.trace.mcap.records import (
    ENTITY_ID_MAX,
    MAGIC,
    DamageError,
    McapHeader,
    parse_channel,
    parse_schema,
)
from rsltrace.trace.mcap.source import ByteSource
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_SEQUENCE, CodeLine, EventRecord, Output, OutputKind
from rsltrace.trace.model.finding import Finding, GuardCount, GuardMode, parse_counts
from rsltrace.trace.model.texts import Stamp, format_seconds
from rsltrace.trace.payloads import PayloadReader

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from rsltrace.trace.decode import Decoder, Decoders, ValueField
    from rsltrace.trace.segments import SegmentReader
    from rsltrace.trace.tables import TraceTables

# Checking a whole trace: every byte against the file's checksum, every event against its hashes.
# Other reads check what they read; this also finds a changed environment or job, and events whose
# hashes do not match their contents.

_DEFINITIONS = frozenset((Opcode.SCHEMA, Opcode.CHANNEL))


def check_data_section(source: ByteSource, summary_start: int) -> None:
    """Raise TraceError unless the bytes before the summary match its checksum."""
    try:
        check_data(source, summary_start)
    except DamageError as error:
        raise damage_error(source, 0, "the data section", error) from error


def check_records(source: ByteSource, index: TraceIndex) -> None:
    """Raise TraceError unless the records before the summary are contiguous and define the channels
    and schemas of the summary.

    A checksum may cover bytes that are no MCAP file, and sequential readers see no summary.
    """
    summary = McapSummary()
    try:
        for opcode, span in walk_records(source, len(MAGIC), index.summary_start):
            if opcode in _DEFINITIONS:
                _add_unique(summary, opcode, read_body(source, span, opcode))
    except DamageError as error:
        raise damage_error(source, 0, "the data section", error) from error
    found = TraceIndex(complete=True, header=index.header)
    found.take(summary)
    if found.channels != index.channels:
        raise damage_error(
            source, index.summary_start, "the summary", "its channels are not those before it"
        )


def _add_unique(summary: McapSummary, opcode: int, body: bytes) -> None:
    """Add a channel or schema. Raises DamageError if its id has another definition."""
    if opcode == Opcode.SCHEMA:
        schema = parse_schema(body)
        is_only = summary.schemas.setdefault(schema.id, schema) == schema
    else:
        channel = parse_channel(body)
        is_only = summary.channels.setdefault(channel.id, channel) == channel
    if not is_only:
        raise DamageError("a channel or schema is defined twice, in two ways")


_P = ParamSpec("_P")
_T = TypeVar("_T")

RUN = Entity(0, 0, EntityKind.SYSTEM, "", "", 0, {})
"""The run itself, which owns what belongs to no node, in traces that do not describe it."""


class Trace:
    """An open trace. A context manager; every method may raise TraceError for damage.

    ``complete`` is false for an interrupted run, which is readable up to its last whole segment.
    Times are simulated nanoseconds, hashes unsigned 64-bit integers.
    """

    def __init__(self, source: ByteSource) -> None:
        """Read the index of ``source``, and own it from now on."""
        self._source = source
        try:
            if has_end(source):
                index = read_summary(source)
            else:
                from rsltrace.trace.scan import scan  # which whole traces do not need

                index = scan(source)
            ids: dict[str, list[int]] = {}
            for channel in index.channels.values():
                ids.setdefault(channel.topic, []).append(channel.id)
            for topic in (TOPIC_EVENTS, TOPIC_OUTPUTS, TOPIC_ENTITIES, TOPIC_DETAILS):
                # A run killed at once may have entities but no events, or neither.
                if topic not in ids and index.complete:
                    raise TraceError(f"{source.name} has no channel {topic}; it is no whole trace")
            self._index = index
            self._ids_of_topic = ids
            self._payloads = PayloadReader(source, index)
            self._decoders: Decoders | None = None
            if not index.complete:  # a name may be damaged, too
                for name in index.metadata:
                    self.metadata(name)
            self._check_result()
        except BaseException:
            source.close()
            raise

    @classmethod
    def open(cls, path: Path | str) -> Trace:
        """Open the trace at ``path``, or at an address (``https://…``) given as a string.

        Raises TraceError if it is missing or damaged, TraceFormatError if it is something else (a
        plain recording, no MCAP) or has another format version, SetupError for an address without
        fsspec.
        """
        return cls(open_source(path))

    def close(self) -> None:
        """Close the file. Arrays returned before stay valid."""
        self._source.close()
        if "_segments" in vars(self):
            self._segments.forget()

    def __enter__(self) -> Trace:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def name(self) -> str:
        """The path as it was given."""
        return self._source.name

    @property
    def size(self) -> int:
        """Size of the file in bytes."""
        return self._source.size

    @property
    def bytes_read(self) -> int:
        """The number of bytes fetched from the file so far."""
        return self._source.bytes_read

    @property
    def complete(self) -> bool:
        """Whether the run ended properly; false if the file was cut off or is still written."""
        return self._index.complete

    @property
    def header(self) -> McapHeader:
        """The profile (``ros2``) and the writing library (``rsltrace 0.1.0``)."""
        return self._index.header

    @property
    def digest(self) -> str:
        """The last chain hash as 16 hex digits, equal for equal runs (no events: zeros)."""
        hashes = self._index.segments.column("chain_hash")
        return digest_text(hashes[-1] if hashes else 0)

    @cached_property
    def event_count(self) -> int:
        """The number of events."""
        return sum(self._index.segments.column("events"))

    @cached_property
    def output_count(self) -> int:
        """The number of outputs of all events."""
        return sum(self._index.segments.column("outputs"))

    @cached_property
    def start_ns(self) -> int:
        """The start of the run, by its result or its earliest event (0: none)."""
        starts = self._index.segments.column("start_stamp")
        return self._result_ns("start_time", min(starts, default=0))

    @cached_property
    def end_ns(self) -> int:
        """The end of the run, by its result or its latest event (0: none)."""
        ends = self._index.segments.column("end_stamp")
        return self._result_ns("end_time", max(ends, default=0))

    @property
    def ended_after(self) -> int | None:
        """The number of events before the nodes were shut down; None if unknown."""
        text = self.result.get("ended_after", "")
        return int(text) if text.isascii() and text.isdigit() else None

    def stamp(self, stamp_ns: int) -> Stamp:
        """Return a simulated time of this run as what texts count from its start."""
        return Stamp(stamp_ns, self.start_ns)

    @cached_property
    def result(self) -> dict[str, str]:
        """How the run ended: the metadata ``rsltrace:result``; empty for an interrupted run."""
        return self.metadata(METADATA_RESULT)

    @cached_property
    def environment(self) -> dict[str, str]:
        """The environment of the run: the metadata ``rsltrace:environment``, and numerical
        libraries that the run imported, from the result."""
        numerics = self.result.get("numerics")
        late = {"numerics": numerics} if numerics else {}
        return {**self.metadata(METADATA_ENVIRONMENT), **late}

    @cached_property
    def job(self) -> dict[str, str]:
        """The requested job: the metadata ``rsltrace:job``."""
        return self.metadata(METADATA_JOB)

    @property
    def edits(self) -> tuple[str, ...]:
        """The texts of a branch's edits (the metadata ``rsltrace:edits``); none of other traces."""
        texts = sorted(self.metadata(METADATA_EDITS).items())
        return tuple(text for key, text in texts if key != "of")

    @cached_property
    def job_text(self) -> str:
        """The job file, or an empty text if there was none."""
        data = self.attachment(ATTACHMENT_JOB)
        return data.decode("utf-8", "replace") if data is not None else ""

    def metadata(self, name: str) -> dict[str, str]:
        """Return a metadata record, or an empty mapping if there is none of that name."""
        span = self._index.metadata.get(name)
        if span is None:
            return {}
        checked = self._index.checksums and name.startswith(METADATA_OWN)
        return read_metadata(self._source, span, checked=checked)

    def attachment(self, name: str) -> bytes | None:
        """Return the bytes of an attachment, or None if there is none of that name."""
        span = self._index.attachments.get(name)
        return read_attachment(self._source, span) if span else None

    def check(self) -> None:
        """Read the whole file and raise TraceError at the first damage.

        An interrupted trace has no checksum over the file; its hashes are checked all the same.
        """
        if self._index.summary_start:
            check_data_section(self._source, self._index.summary_start)
            check_records(self._source, self._index)
        from rsltrace.trace.segments import check_hashes

        check_hashes(self._source, self._segments)
        self._payloads.check()

    @cached_property
    def entities(self) -> dict[int, Entity]:
        """All entities by id, in creation order. Id 0, the run, is always there."""
        entities = {RUN.id: RUN}
        for stamp_ns, _, data in self.messages(TOPIC_ENTITIES):
            entity = self._named(unpack_entity, data, stamp_ns)
            if entity.id > ENTITY_ID_MAX:  # tables by id would be as large as it says
                raise TraceError(
                    f"{self.name}: an entity has the id {entity.id}, and no run has so many; the "
                    "trace is damaged"
                )
            entities[entity.id] = entity
        return entities

    def entity(self, entity_id: int) -> Entity:
        """Return one entity. Raises TraceError if the trace has none of that id."""
        entity = self.entities.get(entity_id)
        if entity is None:
            raise TraceError(f"{self.name} has no entity {entity_id}")
        return entity

    def node_of(self, entity: Entity) -> Entity:
        """Return the node that owns ``entity``: a node itself, or the run."""
        return self.entity(entity.node)

    @property
    def segments(self) -> npt.NDArray[np.void]:
        """The table of segments: SEGMENT_DTYPE, shape (segments,)."""
        return self._segments.table

    @cached_property
    def _segments(self) -> SegmentReader:
        # It needs numpy, which takes as long to load as all else that an equal run is found with.
        from rsltrace.trace.segments import SegmentReader

        return SegmentReader(
            self._source,
            self._index.segments,
            self._ids_of_topic.get(TOPIC_EVENTS, [0])[0],
            self._ids_of_topic.get(TOPIC_OUTPUTS, [0])[0],
        )

    def events(self, first: int = 0, last: int | None = None) -> Iterator[npt.NDArray[np.void]]:
        """Yield the events ``first <= index < last`` as arrays of EVENT_DTYPE, one per segment.

        The arrays are read-only views of the file's bytes, and not contiguous.
        """
        for segment, begin, end in self._pieces(first, last):
            yield self._segments.cached_events(segment)[begin:end]

    def outputs(self, first: int = 0, last: int | None = None) -> Iterator[npt.NDArray[np.void]]:
        """Yield the outputs of the events ``first <= index < last``: OUTPUT_DTYPE, per segment."""
        for segment, begin, end in self._pieces(first, last):
            start = int(self.segments["first_event"][segment])
            yield self._segments.outputs_between(segment, start + begin, start + end)

    def event(self, index: int) -> EventRecord:
        """Return event number ``index``. Raises IndexError if there is none."""
        return self._segments.event(self._segment_of(index), index)

    def outputs_of(self, index: int) -> list[Output]:
        """Return the outputs of event ``index``, in order. Raises IndexError if there is none."""
        return self._segments.outputs_of(self._segment_of(index), index)

    @cached_property
    def findings(self) -> dict[int, list[Finding]]:
        """The guard's findings by event, in order; without entries for events that have none."""
        kept = {
            event: [finding for finding in answers if finding.mode is not GuardMode.VIRTUAL]
            for event, answers in self.answers.items()
        }
        return {event: findings for event, findings in kept.items() if findings}

    @cached_property
    def finding_places(self) -> dict[tuple[str, str], list[str]]:
        """The lines of the findings, by node and call, in the order they were met."""
        places: dict[tuple[str, str], dict[str, None]] = {}
        for finding in chain.from_iterable(self.findings.values()):
            if finding.place:
                places.setdefault((finding.node, finding.call), {})[finding.place] = None
        return {call: list(found) for call, found in places.items()}

    @cached_property
    def answers(self) -> dict[int, list[Finding]]:
        """The findings, and answers from outside that the run put in order."""
        answers: dict[int, list[Finding]] = {}
        for _, finding in self.answers_in_order():
            answers.setdefault(finding.event, []).append(finding)
        return answers

    def answers_in_order(self) -> Iterator[tuple[int, Finding]]:
        """Yield each of ``answers`` after its simulated time, without keeping them."""
        for stamp_ns, _, data in self.messages(TOPIC_FINDINGS):
            yield stamp_ns, self._named(unpack_finding, data)

    @cached_property
    def code_lines(self) -> dict[int, list[CodeLine]]:
        """The code lines that the run noted, by entity and in order."""
        lines: dict[int, list[CodeLine]] = {}
        for _, _, data in self.messages(TOPIC_CODE_LINES):
            line = self._named(unpack_code_line, data)
            lines.setdefault(line.entity, []).append(line)
        return lines

    @cached_property
    def output_lines(self) -> dict[tuple[int, int], list[CodeLine]]:
        """The code lines that outputs came from, by their entity and the one whose callback ran."""
        lines: dict[tuple[int, int], list[CodeLine]] = {}
        for line in chain.from_iterable(self.code_lines.values()):
            if line.output != NO_SEQUENCE and line.event < self.event_count:
                key = line.entity, self.event(line.event).entity
                lines.setdefault(key, []).append(line)
        return lines

    @cached_property
    def switches(self) -> dict[int, str]:
        """The lines (``module.py:31``) before which another thread continued, by the event that
        ended there."""
        lines = self.code_lines.get(0, [])
        return {line.event: line.place for line in lines if line.output != NO_SEQUENCE}

    @cached_property
    def guarded(self) -> tuple[GuardCount, ...]:
        """How often the guard saw each call; empty for a run without guard, or cut off."""
        return self._named(parse_counts, self.metadata(METADATA_GUARD).get("calls", "[]"))

    @property
    def channels(self) -> Mapping[int, ChannelInfo]:
        """All channels by id."""
        return self._index.channels

    @property
    def message_counts(self) -> Mapping[int, int]:
        """The number of messages by channel id (absent: none)."""
        return self._index.message_counts

    def channel_of(self, output: Output) -> ChannelInfo | None:
        """Return the channel with the payloads of an output, or None."""
        if output.kind is OutputKind.LOG:
            return self._channel(TOPIC_ROSOUT, "")
        entity = self.entity(output.entity)
        if output.kind is OutputKind.MESSAGE:
            return self._channel(entity.name, entity.type)
        if output.kind is OutputKind.REQUEST:
            return self._channel(PREFIX_REQUEST + entity.name, f"{entity.type}_Request")
        if output.kind is OutputKind.RESPONSE:
            return self._channel(PREFIX_RESPONSE + entity.name, f"{entity.type}_Response")
        return self._channel(TOPIC_DETAILS, "")

    def payload(self, output: Output) -> tuple[int, str, bytes] | None:
        """Return (stamp in ns, topic, data) of an output's message, None if it was not recorded."""
        if output.sequence == NO_SEQUENCE:
            return None
        channel = self.channel_of(output)
        if channel is None:
            return None
        stamp_ns, data = self._payloads.message(channel.id, output.sequence)
        return stamp_ns, channel.topic, data

    def message(self, channel_id: int, sequence: int) -> tuple[int, bytes]:
        """Return (stamp in ns, data) of message number ``sequence`` of a channel.

        Raises TraceError if there is none.
        """
        return self._payloads.message(channel_id, sequence)

    def detail(self, output: Output) -> str | None:
        """Return the text of an output that is no message, or None if it has none."""
        found = self.payload(output)
        if not found or found[1] != TOPIC_DETAILS:
            return None
        return self._named(unpack_detail, found[2])[2]

    def messages(self, topic: str) -> Iterator[tuple[int, int, bytes]]:
        """Yield (stamp in ns, sequence, data) of every message on ``topic``, in file order."""
        channels = frozenset(self._ids_of_topic.get(topic, ()))
        for _, stamp_ns, sequence, data in self.messages_of(channels):
            yield stamp_ns, sequence, data

    def messages_with_text(self, channel: int, first: int, last: int, text: bytes) -> Iterator[int]:
        """Yield the numbers ``first`` … ``last`` of a channel's messages whose bytes contain
        ``text``, which is lower case, in any case; it may span two messages."""
        yield from self._payloads.messages_with_text(channel, first, last, text)

    def messages_of(self, channels: frozenset[int]) -> Iterator[tuple[int, int, int, bytes]]:
        """Yield (channel, stamp in ns, sequence, data) of every message of some channels."""
        yield from self._payloads.messages(channels)

    def fields_of(self, interface: str) -> Mapping[str, str] | None:
        """Return the fields of an interface (``nav_msgs/msg/Odometry``) with their message types
        (others: empty); None if no readable schema of the trace defines it."""
        package = interface.partition("/")[0]
        for channel in self.channels.values():
            if channel.type == interface or package in channel.schema_text:
                with suppress(TraceError):
                    fields = self._decoder(channel).fields_of(interface)
                    if fields is not None:
                        return fields
        return None

    def leaves(self, topic: str) -> list[ValueField]:
        """Return the fields of a topic's messages that hold values.

        Raises TraceError if the topic has no messages here, or no usable schema.
        """
        found = self._channel(topic, "")
        if found is None:
            raise TraceError(f"{self.name} has no messages on {topic}")
        return self._decoder(found).leaves()

    def decode(self, channel: ChannelInfo | str | int, data: bytes) -> object:
        """Return ``data`` decoded by the schema of a channel (or its id, or its topic).

        Raises TraceError if there is no such channel, or the data does not fit.
        """
        if isinstance(channel, str):
            found = self._channel(channel, "")
        elif isinstance(channel, int):
            found = self.channels.get(channel)
        else:
            found = channel
        if found is None:
            raise TraceError(f"{self.name} has no topic {channel}")
        try:
            return self._decoder(found).decode(data)
        except TraceError as error:
            raise TraceError(f"{self.name}: {error}") from error

    @property
    def tables(self) -> TraceTables:
        """Its events, outputs, entities and decoded messages as tables for Arrow and pandas."""
        from rsltrace.trace.tables import TraceTables

        return TraceTables(self, self._decoder)

    def _repr_html_(self) -> str:
        """Return what a notebook shows, or why the trace cannot be read."""
        from rsltrace.trace.model.html import HtmlSheet

        sheet = HtmlSheet(f"trace {Path(self.name).name}")
        if not self.complete:
            sheet.line("cut off: the run was killed or crashed, or is still going on")
        try:
            native = bool(self.metadata(METADATA_NATIVE))
            start, end = (format_seconds(self.stamp(at)) for at in (self.start_ns, self.end_ns))
            sheet.facts(
                (
                    ("ended", self.result.get("stop_reason", "")),
                    ("digest", "none, it is a native run" if native else self.digest),
                    ("recorded" if native else "simulated", f"{start} s to {end} s"),
                    ("events", self.event_count),
                    ("outputs", self.output_count),
                )
            )
            nodes = [entity for entity in self.entities.values() if entity.kind is EntityKind.NODE]
            sheet.table(("node", "class"), ((node.name, node.type) for node in nodes))
            topics = [c for c in self.channels.values() if not c.topic.startswith(PREFIX_OWN)]
            sheet.table(
                ("topic", "type", "messages"),
                ((one.topic, one.type, self.message_counts.get(one.id, 0)) for one in topics),
            )
        except TraceError as error:  # it is closed, say
            sheet.line(str(error))
        return sheet.html()

    def _decoder(self, channel: ChannelInfo) -> Decoder:
        if self._decoders is None:
            # Its library takes as long to import as opening a trace.
            from rsltrace.trace.decode import Decoders

            self._decoders = Decoders()
        return self._decoders.of(channel)

    def _named(self, read: Callable[_P, _T], *args: _P.args, **more: _P.kwargs) -> _T:
        """Call a reader; errors begin with the name of the file, since two may be open."""
        try:
            return read(*args, **more)
        except TraceError as error:
            raise TraceError(f"{self.name}: {error}") from error

    def _channel(self, topic: str, type_name: str) -> ChannelInfo | None:
        """Return the channel of a topic: of several the one with that type."""
        ids = self._ids_of_topic.get(topic, ())
        if len(ids) == 1:
            return self.channels[ids[0]]
        found = [self.channels[i] for i in ids]
        return next((c for c in found if c.type == type_name), found[0] if found else None)

    def _segment_of(self, index: int) -> int:
        if not 0 <= index < self.event_count:
            raise IndexError(f"{self.name} has no event {index}, it has {self.event_count}")
        return self._segments.segment_of(index)

    def _pieces(self, first: int, last: int | None) -> Iterator[tuple[int, int, int]]:
        """Yield (segment, begin, end) of the parts of segments in a range of events."""
        count = self.event_count
        last = count if last is None else min(last, count)
        first = max(first, 0)
        if first >= last:
            return
        for segment in range(self._segments.segment_of(first), len(self.segments)):
            start = int(self.segments["first_event"][segment])
            if start >= last:
                return
            end = start + int(self.segments["events"][segment])
            yield segment, max(first - start, 0), min(last, end) - start

    def _result_ns(self, key: str, otherwise: int) -> int:
        text = self.result.get(key, "")
        if text.isascii() and text.isdigit():
            return int(text)
        return otherwise

    def _check_result(self) -> None:
        """Check the digest in the result, which no checksum covers, against the events."""
        said = self.result.get("digest")
        if self.complete and said != self.digest:
            raise TraceError(
                f"{self.name} contradicts itself: its result says digest {said}, its events have "
                f"{self.digest}; the file is damaged"
            )
