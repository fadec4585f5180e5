"""Write a trace as a stream: bounded memory, the same bytes for the same calls.

The loop adds events, outputs and payloads as they happen. Every few thousand events a *segment* is
written: payloads, then outputs, then events, so that whatever an event refers to precedes it in the
file. The file of a killed run is readable up to its last whole segment.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rsltrace._version import __version__
from rsltrace.compiled import core
from rsltrace.errors import OutputError
from rsltrace.trace import segments
from rsltrace.trace.cdr import pack_code_line, pack_detail, pack_entity, pack_finding
from rsltrace.trace.chain import digest_text
from rsltrace.trace.dtypes import EVENT_DTYPE, OUTPUT_CONTENT_DTYPE, SEGMENT_DTYPE
from rsltrace.trace.format import (
    ATTACHMENT_INDEX,
    CDR_HEADER,
    CHECKSUM_KEY,
    CHECKSUMS_KEY,
    EVENTS_PER_SEGMENT,
    FORMAT_VERSION,
    LIBRARY,
    METADATA_ENVIRONMENT,
    METADATA_FORMAT,
    METADATA_RESULT,
    METADATA_ROSBAG2,
    OUTPUTS_PER_SEGMENT,
    PAYLOAD_BYTES_PER_CHUNK,
    PROFILE,
    SCHEMA_CODE_LINE,
    SCHEMA_DETAIL,
    SCHEMA_ENTITY,
    SCHEMA_EVENT,
    SCHEMA_FINDING,
    SCHEMA_OUTPUT,
    SCHEMA_STATE,
    SCHEMA_TEXT,
    SCHEMA_TIMING,
    TOPIC_CODE_LINES,
    TOPIC_DETAILS,
    TOPIC_ENTITIES,
    TOPIC_EVENTS,
    TOPIC_FINDINGS,
    TOPIC_OUTPUTS,
    TOPIC_STATES,
    TOPIC_TIMINGS,
)
from rsltrace.trace.index import metadata_checksum
from rsltrace.trace.mcap.chunk_builder import joined, messages_chunk
from rsltrace.trace.mcap.records import MESSAGE, MESSAGE_BYTES_MAX, MESSAGE_HEAD, RECORD_HEAD
from rsltrace.trace.mcap.writer import BufferedWriter, McapWriter
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import NO_SEQUENCE, CodeLine, OutputKind
from rsltrace.trace.model.finding import Finding
from rsltrace.trace.rosbag2 import KEY, BagTopicMetadata, bag_metadata_yaml, normalized_qos

_HEADER_BYTES = MESSAGE_HEAD.size
_HEADER_REST = _HEADER_BYTES - RECORD_HEAD.size
_pack_header = MESSAGE_HEAD.pack
SEGMENT_MEDIA_TYPE = "application/octet-stream"


class PythonRecordBuffer:
    """What waits to be written. The compiled module has an equal class.

    ``write_segment`` is called when there are ``events_max`` events or ``outputs_max`` outputs,
    ``write_payloads`` when the payloads have ``payload_bytes_max`` bytes, or a channel has no
    sequence left. ``sequences`` are the next ones by channel id, which counts from 1.
    """

    def __init__(
        self,
        write_segment: Callable[[], None],
        write_payloads: Callable[[], None],
        sequences: list[int],
        *,
        events_max: int,
        outputs_max: int,
        payload_bytes_max: int,
    ) -> None:
        self._write_segment, self._write_payloads = write_segment, write_payloads
        self._sequences = sequences
        self._events_max, self._outputs_max = events_max, outputs_max
        self._payload_bytes_max = payload_bytes_max
        # Header and data of each: one flat list has nothing that the garbage collector must visit.
        self._payloads: list[bytes] = []
        self.payload_bytes = 0
        self._events: list[bytes] = []
        self._outputs: list[bytes] = []
        self._output_sequences = array("I")
        self.add_output: Callable[[bytes], None] = self._outputs.append
        self.add_sequence: Callable[[int], None] = self._output_sequences.append

    @property
    def events(self) -> int:
        return len(self._events)

    @property
    def outputs(self) -> int:
        return len(self._outputs)

    def add_payload(self, channel_id: int, stamp_ns: int, data: bytes) -> int:
        sequence, size = self._sequences[channel_id], len(data)
        header = _pack_header(
            MESSAGE, size + _HEADER_REST, channel_id, sequence, stamp_ns, stamp_ns
        )
        self._payloads.extend((header, data))
        self._sequences[channel_id] = following = sequence + 1
        self.payload_bytes += size + _HEADER_BYTES
        if self.payload_bytes >= self._payload_bytes_max or following >= NO_SEQUENCE:
            self._write_payloads()
        return sequence

    def take_payloads(self) -> tuple[bytes, tuple[bytes, ...]]:
        """Return the headers of the payloads and, in parts, the whole messages; forget them."""
        taken = b"".join(self._payloads[0::2]), joined(self._payloads)
        self._payloads.clear()
        self.payload_bytes = 0
        return taken

    def add_event(self, rest: bytes, chain_hash: int) -> None:
        self._events.append(chain_hash.to_bytes(8, "little") + rest)
        if len(self._events) >= self._events_max or len(self._outputs) >= self._outputs_max:
            self._write_segment()

    def rows(self) -> tuple[bytes, bytes, bytes]:
        """Return the events, the outputs, and these' sequences."""
        events, outputs = b"".join(self._events), b"".join(self._outputs)
        return events, outputs, self._output_sequences.tobytes()

    def clear_rows(self) -> None:
        self._events.clear()
        self._outputs.clear()
        del self._output_sequences[:]

    def drop_unfinished(self) -> None:
        """Drop what follows the last whole event: an interrupt may come anywhere."""
        events = np.frombuffer(b"".join(self._events), dtype=EVENT_DTYPE)
        del self._outputs[int(events["outputs"].sum()) :]
        contents = np.frombuffer(b"".join(self._outputs), dtype=OUTPUT_CONTENT_DTYPE)
        numbered = int(np.count_nonzero(contents["kind"] != OutputKind.DRAW))
        del self._output_sequences[numbered:]


RecordBuffer = PythonRecordBuffer
if core is not None and not TYPE_CHECKING:
    RecordBuffer = core.RecordBuffer


class TraceWriter:
    """Writes one trace.

    Add an event's outputs before the event; entities and payloads at any time before the event that
    refers to them. ``add_output`` takes an output of the next event, packed by
    ``format.OUTPUT_CONTENT``; unless it is a draw, ``add_sequence`` takes the sequence of its
    payload (or NO_SEQUENCE). ``add_payload`` takes the channel, the time and the CDR of a message,
    and returns its sequence in the channel; ``add_event`` the next event, packed by
    ``format.EVENT_REST``, and its chain hash. These four are the buffer's own, since a run calls
    them for every message. ``close`` ends the file; leaving the ``with`` block without it leaves
    the file of an interrupted run (``abort``).

    Times are simulated nanoseconds, unsigned 64-bit. Every method may raise OutputError: no space,
    a failing disk, a file too large. The file is then readable up to its last whole segment.
    """

    def __init__(
        self,
        path: Path | None,
        *,
        force: bool,
        compression: str = "zstd",
        events_per_segment: int | None = None,
    ) -> None:
        """Create the file. ``compression`` is ``zstd`` or empty. Without ``path``, buffer until
        ``settle``.

        Raises OutputError if ``path`` exists and ``force`` is false, is a folder, or cannot be
        created. Missing folders are not made: mostly they are typing errors.
        """
        self._sequences = [0]
        # Entities have a chunk of their own: a reader needs them first, and nothing else.
        self._buffer, self._entities = (
            RecordBuffer(
                self._write_segment,
                write,
                self._sequences,
                events_max=events_per_segment or EVENTS_PER_SEGMENT,
                outputs_max=OUTPUTS_PER_SEGMENT,
                payload_bytes_max=PAYLOAD_BYTES_PER_CHUNK,
            )
            for write in (self._write_payloads, self._write_entities)
        )
        buffer = self._buffer
        self.add_event: Callable[[bytes, int], None] = buffer.add_event
        self.add_output: Callable[[bytes], None] = buffer.add_output
        self.add_sequence: Callable[[int], None] = buffer.add_sequence
        self.add_payload: Callable[[int, int, bytes], int] = buffer.add_payload
        self._channel_ids: dict[tuple[str, str], int] = {}
        self._segments: list[bytes] = []
        self._events_written = 0
        self._outputs_written = 0
        self._last_chain_hash = 0
        self._ros_distro = ""
        about = {"profile": PROFILE, "library": f"{LIBRARY} {__version__}"}
        self._stream = (
            BufferedWriter(compression=compression, **about)
            if path is None
            else McapWriter(
                path, force=force, compression=compression, progress=self._progress, **about
            )
        )
        try:
            self.add_metadata(
                METADATA_FORMAT, {"version": str(FORMAT_VERSION), CHECKSUMS_KEY: "xxh3"}
            )
            self._event_channel = self._own_channel(TOPIC_EVENTS, SCHEMA_EVENT)
            self._output_channel = self._own_channel(TOPIC_OUTPUTS, SCHEMA_OUTPUT)
            self._entity_channel = self._own_channel(TOPIC_ENTITIES, SCHEMA_ENTITY)
            self._detail_channel = self._own_channel(TOPIC_DETAILS, SCHEMA_DETAIL)
        except OutputError:
            self._stream.abort()
            raise

    def __enter__(self) -> TraceWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.abort()

    def _progress(self) -> str:
        return f"{self._events_written} events"

    def settle(self, path: Path, *, force: bool) -> None:
        """Create the file of a writer without one, with everything added so far.

        :raises OutputError: as when a trace is created.
        """
        deferred = self._stream
        assert isinstance(deferred, BufferedWriter), "it has no place yet"
        self._stream, chunks_at = deferred.write_to(path, force=force, progress=self._progress)
        rows = np.frombuffer(b"".join(self._segments), dtype=SEGMENT_DTYPE).copy()
        for row in rows:
            for what in ("events", "outputs") if row["outputs"] else ("events",):
                row[f"{what}_offset"], row[f"{what}_length"] = chunks_at[row[f"{what}_offset"]]
        self._segments = [row.tobytes() for row in rows]

    @property
    def place(self) -> Path:
        """The written file: beside the one that it replaces, until it is closed."""
        return self._stream.place

    @property
    def kept(self) -> str:
        """What to say about a trace that should have been replaced and was not; else ""."""
        return self._stream.kept

    @property
    def event_count(self) -> int:
        """The number of events added."""
        return self._events_written + self._buffer.events

    @property
    def output_count(self) -> int:
        """The number of outputs added."""
        return self._outputs_written + self._buffer.outputs

    @property
    def digest(self) -> str:
        """The digest so far: the last chain hash as 16 hex digits."""
        events = np.frombuffer(self._buffer.rows()[0], dtype=EVENT_DTYPE)
        last = events["chain_hash"][-1] if len(events) else self._last_chain_hash
        return digest_text(int(last))

    @property
    def size(self) -> int:
        """The size of the file, without what is collected for the next chunk."""
        return self._stream.bytes_written

    def add_metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        """Write a metadata record with sorted keys: equal mappings give equal bytes."""
        if name == METADATA_ENVIRONMENT:
            self._ros_distro = mapping.get("ros_distro", "")
        checksum = metadata_checksum(name, mapping)
        self._stream.metadata(name, dict(sorted({**mapping, CHECKSUM_KEY: checksum}.items())))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment."""
        self._stream.attachment(name, media_type, data)

    def add_channel(
        self,
        topic: str,
        type_name: str,
        schema_text: str,
        *,
        qos_yaml: str = "",
        type_hash: str = "",
    ) -> int:
        """Return the id of the channel of ``topic``, written now if it is new.

        ``type_name`` is the interface (``std_msgs/msg/String``; ``std_srvs/srv/Trigger_Request``),
        ``schema_text`` its ros2msg definition with dependencies, ``qos_yaml`` the offered QoS
        profiles as rosbag2 stores them, ``type_hash`` the RIHS01 hash. A topic has one channel per
        type, whose first QoS stays.
        """
        key = (topic, type_name)
        channel_id = self._channel_ids.get(key)
        if channel_id is None:
            metadata = {"offered_qos_profiles": normalized_qos(qos_yaml, topic=topic)}
            if type_hash:
                metadata["topic_type_hash"] = type_hash
            channel_id = self._stream.channel(topic, type_name, schema_text, metadata)
            assert channel_id == len(self._sequences)
            self._sequences.append(0)
            self._channel_ids[key] = channel_id
        return channel_id

    def add_entity(self, entity: Entity) -> int:
        """Add an entity before the first event that names it."""
        return self._entities.add_payload(
            self._entity_channel, entity.created_ns, pack_entity(entity)
        )

    def add_detail(self, event: int, output: int, stamp_ns: int, text: str) -> int:
        """Add the text of output number ``output`` of ``event``. Returns its sequence."""
        return self.add_payload(self._detail_channel, stamp_ns, pack_detail(event, output, text))

    def add_finding(self, finding: Finding, stamp_ns: int) -> int:
        """Add a finding of the guard."""
        channel_id = self._own_channel(TOPIC_FINDINGS, SCHEMA_FINDING)
        return self.add_payload(channel_id, stamp_ns, pack_finding(finding))

    def add_code_line(self, line: CodeLine, stamp_ns: int) -> int:
        """Add a code line."""
        channel_id = self._own_channel(TOPIC_CODE_LINES, SCHEMA_CODE_LINE)
        return self.add_payload(channel_id, stamp_ns, pack_code_line(line))

    def add_state(self, event: int, node: int, stamp_ns: int, changes: str) -> int:
        """Add changes of a node's state, as JSON."""
        channel_id = self._own_channel(TOPIC_STATES, SCHEMA_STATE)
        return self.add_payload(channel_id, stamp_ns, pack_detail(event, node, changes))

    def add_timing(self, packed: bytes, stamp_ns: int) -> int:
        """Add the times of the next event, packed by ``format.TIMING``."""
        channel_id = self._own_channel(TOPIC_TIMINGS, SCHEMA_TIMING)
        return self.add_payload(channel_id, stamp_ns, CDR_HEADER + packed)

    def flush(self) -> None:
        """Write the events that there are: they stay if this process is killed."""
        if self._buffer.events:
            self._write_segment()

    def close(self, *, result: Mapping[str, str], replace: bool = True) -> None:
        """Write the rest and the indexes, and close the file.

        ``result`` says how the run ended (``stop_reason``, ``exit_code``; ``start_time`` and
        ``end_time`` in simulated nanoseconds, by default those of the first and last message).
        Version, digest and counts are added here. Outputs of an unfinished event are dropped. With
        ``replace``, the trace replaces an older one. After an OutputError the file is closed, too.
        """
        try:
            self._buffer.drop_unfinished()
            if self._buffer.events:
                self._write_segment()
            self._write_entities()
            self._write_payloads()
            self._stream.attachment(ATTACHMENT_INDEX, SEGMENT_MEDIA_TYPE, b"".join(self._segments))
            self.add_metadata(METADATA_RESULT, self._result(result))
            self._stream.metadata(METADATA_ROSBAG2, {KEY: self._bag_metadata()})
            self._stream.finish(replace=replace)
        finally:
            self._stream.abort()

    def abort(self) -> None:
        """Close the file without an end, as if the run was killed. Harmless when closed."""
        self._stream.abort()

    def _own_channel(self, topic: str, type_name: str) -> int:
        return self.add_channel(topic, type_name, SCHEMA_TEXT[type_name])

    def _write_entities(self) -> None:
        self._write_messages(self._entities)

    def _write_payloads(self) -> None:
        self._write_messages(self._buffer)

    def _write_messages(self, waiting: PythonRecordBuffer) -> None:
        if not waiting.payload_bytes:
            return
        if max(self._sequences) >= NO_SEQUENCE:
            raise OutputError(
                f"a topic has more than {NO_SEQUENCE} messages, more than a trace can number; "
                "leave its payloads out (record: exclude: in the job)"
            )
        if waiting.payload_bytes > MESSAGE_BYTES_MAX + PAYLOAD_BYTES_PER_CHUNK:
            raise OutputError(
                f"a message has more than {MESSAGE_BYTES_MAX} bytes, more than a trace can hold; "
                "leave its topic out (record: exclude: in the job)"
            )
        try:
            self._stream.chunk(messages_chunk(*waiting.take_payloads()))
        except BaseException:
            self._stream.poison()
            raise

    def _write_segment(self) -> None:
        try:
            self._write_entities()
            self._write_payloads()
            self._write_rows(*self._buffer.rows())
            self._buffer.clear_rows()
        except BaseException:
            self._stream.poison()
            raise

    def _write_rows(self, rows: bytes, contents: bytes, sequences: bytes) -> None:
        events = np.frombuffer(rows, dtype=EVENT_DTYPE)
        self._check(events)
        count, outputs_at = int(events["outputs"].sum()), (0, 0)
        assert len(contents) == count * OUTPUT_CONTENT_DTYPE.itemsize, (
            "outputs do not match their events"
        )
        if contents or sequences:
            outputs_at = self._stream.chunk(
                segments.outputs_chunk(
                    contents, sequences, events, self._outputs_written, self._output_channel
                )
            )
        events_at = self._stream.chunk(segments.events_chunk(events, self._event_channel))
        firsts = (self._events_written, self._outputs_written)
        row = segments.segment_row(events, count, firsts, events_at, outputs_at)
        self._segments.append(row.tobytes())
        self._last_chain_hash = int(events["chain_hash"][-1])
        self._events_written += len(events)
        self._outputs_written += count

    def _check(self, events: npt.NDArray[np.void]) -> None:
        """Stop at once if the recorder miscounts: such a trace would mislead."""
        first = self._events_written
        indexes = np.arange(first, first + len(events), dtype=np.uint64)
        assert np.array_equal(events["index"], indexes), "events are not numbered 0, 1, 2, …"

    def _result(self, given: Mapping[str, str]) -> dict[str, str]:
        return {
            "start_time": str(self._stream.start_ns),
            "end_time": str(self._stream.end_ns),
            **given,
            "format_version": str(FORMAT_VERSION),
            "digest": self.digest,
            "events": str(self._events_written),
            "outputs": str(self._outputs_written),
        }

    def _bag_metadata(self) -> str:
        topics = [
            BagTopicMetadata(
                name=channel.topic,
                type=type_name,
                type_hash=channel.metadata.get("topic_type_hash", ""),
                qos_yaml=channel.metadata["offered_qos_profiles"],
                message_count=count,
            )
            for channel, type_name, count in self._stream.channels
        ]
        return bag_metadata_yaml(
            topics,
            start_ns=self._stream.start_ns,
            duration_ns=self._stream.end_ns - self._stream.start_ns,
            ros_distro=self._ros_distro or "rsltrace",
        )
