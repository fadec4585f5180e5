"""Reading an MCAP file as a rosbag2 storage: topics, and messages by chunk.

The rosbags and mcap packages read MCAP too. This reader exists because order and completeness
decide what a simulation does: rosbags passes over chunks that are indexed without their messages,
and neither refuses a chunk whose messages lie outside the times its index promises.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from rsltrace.errors import BagError
from rsltrace.trace.mcap.chunk import cut_messages, read_chunk
from rsltrace.trace.mcap.records import Channel, CutOff, Damaged
from rsltrace.trace.mcap.source import FileSource
from rsltrace.trace.model.stamp import format_seconds
from rsltrace.trace.recordings.mcap_index import read_index
from rsltrace.trace.recordings.mcap_scan import McapIndex, Part
from rsltrace.trace.recordings.merge import Message
from rsltrace.trace.recordings.qos import parse_qos
from rsltrace.trace.recordings.storage import Extent, StoredTopic


class McapFile:
    """One open ``.mcap`` file. Raises ``BagError`` when it is no ROS 2 recording or damaged."""

    def __init__(self, path: Path, *, recover: bool = False) -> None:
        """Open ``path``; with ``recover``, what is whole of a file that was cut off."""
        self.path = path
        self._recover = recover
        self.with_publish_time = False
        self._closed = False
        self._source = FileSource(path, BagError)
        try:
            self._index = self._read_index()
            self._parts = {part.span.offset: part for part in self._index.parts}
            channels = self._index.definitions.channels.values()
            self.topics = [self._topic(channel) for channel in channels]
        except BaseException:
            self.close()
            raise
        self.message_count = self._index.counts.total()
        self.start_ns, self.end_ns = self._index.start_ns, self._index.end_ns
        self.cut_off = self._index.cut_off

    def close(self) -> None:
        """Close the file."""
        self._closed = True
        self._source.close()

    def extents(self, wanted: Mapping[int, int], first_ns: int) -> list[Extent]:
        """Return the chunks that may hold wanted messages, in file order."""
        extents = []
        for part in self._index.parts:
            known = part.channels is None or not part.channels.isdisjoint(wanted)
            if known and part.end_ns >= first_ns:
                extents.append(Extent(*part.span, max(part.start_ns, first_ns), part.end_ns))
        return extents

    def read(self, extent: Extent, wanted: Mapping[int, int], first_ns: int) -> Iterator[Message]:
        """Yield the wanted messages of a chunk by time, equal times in file order."""
        yield from self._messages(self._parts[extent.offset], wanted, first_ns)

    def count(self, wanted: Mapping[int, int], first_ns: int) -> int:
        """Return how many wanted messages there are."""
        count = sum(self._index.counts[channel] for channel in wanted)
        for part in self._index.parts if first_ns > self.start_ns else []:
            if part.start_ns < first_ns:
                messages = self._messages(part, wanted, 0)
                count -= sum(stamp_ns < first_ns for stamp_ns, _, _ in messages)
        return count

    def last_ns(self, wanted: Mapping[int, int], first_ns: int) -> int | None:
        """Return the time of the last wanted message."""
        last_ns: int | None = None
        extents = self.extents(wanted, first_ns)
        for extent in sorted(extents, key=lambda extent: extent.end_ns, reverse=True):
            if last_ns is not None and extent.end_ns <= last_ns:
                break
            messages = self._messages(self._parts[extent.offset], wanted, first_ns)
            if messages:
                last_ns = max(messages[-1][0], last_ns or 0)
        return last_ns

    def _messages(self, part: Part, wanted: Mapping[int, int], first_ns: int) -> list[Message]:
        if self._closed:
            raise ValueError(f"{self.path} is closed")
        try:
            if part.is_chunk:
                records = read_chunk(self._source, part.span, strict=False)
            else:
                records = self._source.read_at(*part.span)
            messages = cut_messages(
                records, wanted, first_ns, with_publish_time=self.with_publish_time
            )
            # The order of the whole stream rests on these two times.
            if messages and not (part.start_ns <= messages[0][0] <= messages[-1][0] <= part.end_ns):
                raise Damaged("messages lie outside the times the index promises")
        except Damaged as error:
            raise BagError(
                f"{self.path}: {error}, in the {'chunk' if part.is_chunk else 'messages'} at byte "
                f"{part.span.offset} (log time {format_seconds(part.start_ns)} to "
                f"{format_seconds(part.end_ns)}); repair it with 'mcap recover'"
            ) from None
        return messages

    def _read_index(self) -> McapIndex:
        try:
            index = read_index(self._source, recover=self._recover)
        except CutOff as error:
            raise BagError(
                f"{self.path}: the recording was cut off, its footer and index are missing: "
                f"{error}. Repair it with 'mcap recover {self.path.name} -o repaired.mcap' (and "
                "'ros2 bag reindex' if it belongs to a bag folder)"
            ) from None
        except Damaged as error:
            raise BagError(f"{self.path}: {error}; repair it with 'mcap recover'") from None
        if index.profile not in ("ros2", ""):
            ros1 = index.profile == "ros1"
            advice = "; convert it with 'rosbags-convert'" if ros1 else ""
            raise BagError(
                f"{self.path}: not a ROS 2 recording: its MCAP profile is {index.profile!r}{advice}"
            )
        return index

    def _topic(self, channel: Channel) -> StoredTopic:
        schema = self._index.definitions.schemas.get(channel.schema_id)
        try:
            offered = parse_qos(channel.metadata.get("offered_qos_profiles", ""))
        except ValueError as error:
            raise BagError(f"{self.path}: topic {channel.topic}: {error}") from None
        return StoredTopic(
            id=channel.id,
            name=channel.topic,
            type_name=schema.name if schema else "",
            serialization_format=channel.message_encoding,
            offered_qos=offered,
            message_count=self._index.counts[channel.id],
            schema_text=schema.text if schema and schema.text else None,
            schema_encoding=schema.encoding if schema and schema.text else "",
            type_hash=channel.metadata.get("topic_type_hash", ""),
        )
