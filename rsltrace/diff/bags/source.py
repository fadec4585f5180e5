"""Where the messages of a recording come from: a bag, a bag that was cut off, or a trace.

All are the same to the comparison: topics with types and counts, messages in order, a decoder.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace.diff.file_kind import is_trace
from rsltrace.errors import RsltraceError, TraceError
from rsltrace.trace.format import PREFIX_OWN, PREFIX_REQUEST, PREFIX_RESPONSE
from rsltrace.trace.mcap.records import SCHEMA_ENCODING
from rsltrace.trace.recordings import open_bag

if TYPE_CHECKING:
    from rsltrace.trace.reader import Trace


@dataclass(frozen=True, slots=True)
class SourceTopic:
    """A topic and how to decode its messages: ``schema`` is its ros2msg text, if there is
    one; that of a message without fields is empty."""

    name: str
    type: str
    schema: str | None = None


@dataclass(slots=True)
class RecordingSource:
    """A recording to compare; a context manager. Reading may raise BagError or TraceError.

    ``read`` yields (log time in ns, index in ``topics``, CDR) of the topics whose indexes it is
    given, each topic's messages in the order of time.
    """

    path: str
    kind: str
    topics: tuple[SourceTopic, ...]
    read: Callable[[Collection[int]], Iterator[tuple[int, int, bytes]]]
    close: Callable[[], None]
    complete: bool = True
    notes: tuple[str, ...] = ()
    _decoders: dict[int, Callable[[bytes], object]] = field(default_factory=dict)

    def __enter__(self) -> RecordingSource:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def decode(self, topic: int, data: bytes) -> object:
        """Return a decoded message. Raises TraceError saying why it cannot be."""
        if topic not in self._decoders:
            self._decoders[topic] = _decoder(self.topics[topic])
        return self._decoders[topic](data)


def open_source(path: str | os.PathLike[str]) -> RecordingSource:
    """Open a recording: a bag's folder, one of its files, or a trace.

    Raises BagError or TraceError naming the file and what is wrong with it.
    """
    if is_trace(path):
        return _trace_source(path)
    # Of a folder all is wanted; a file that was cut off can be compared as far as it goes.
    bag = open_bag(path, recover=Path(path).is_file())
    return RecordingSource(
        path=os.fspath(path),
        kind=bag.storage_id,
        topics=tuple(
            SourceTopic(
                topic.name,
                topic.type_name,
                topic.schema_text if topic.schema_encoding == SCHEMA_ENCODING else None,
            )
            for topic in bag.topics
        ),
        read=lambda wanted: (m for m in bag.messages() if m[1] in wanted),
        close=bag.close,
        complete=not bag.notes,
        notes=bag.notes,
    )


def _trace_source(path: str | os.PathLike[str]) -> RecordingSource:
    from rsltrace.trace.reader import Trace

    trace = Trace.open(os.fspath(path))
    return replace(source_of(trace, services=False), close=trace.close)


def source_of(trace: Trace, *, services: bool) -> RecordingSource:
    """Return the messages of an open trace, with or without requests and responses."""
    topics_by_name: dict[str, SourceTopic] = {}
    for channel in trace.channels.values():
        own = channel.topic.startswith(PREFIX_OWN)
        service = channel.topic.startswith((PREFIX_REQUEST, PREFIX_RESPONSE))
        if not own or (services and service):
            topic = SourceTopic(channel.topic, channel.type, channel.schema_text)
            topics_by_name.setdefault(channel.topic, topic)
    topics = tuple(topics_by_name.values())

    def read(wanted: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        for number in sorted(wanted):
            for stamp_ns, _, data in trace.messages(topics[number].name):
                yield stamp_ns, number, data

    return RecordingSource(
        path=trace.name,
        kind="trace",
        topics=topics,
        read=read,
        close=lambda: None,
        complete=trace.complete,
        notes=_payload_notes(trace),
    )


def _payload_notes(trace: Trace) -> tuple[str, ...]:
    """Say so where the job had messages left out: what is missing is not missing in the run."""
    import json

    with suppress(ValueError, AttributeError, TypeError):
        record = json.loads(trace.job.get("resolved", "{}")).get("record") or {}
        if not record.get("payloads", True):
            return (f"{trace.name} was recorded without payloads (record.payloads is false)",)
        if record.get("topics", ["*"]) != ["*"] or record.get("exclude"):
            return (
                f"{trace.name} holds the messages of some topics only (record.topics, "
                "record.exclude)",
            )
    return ()


# -- decoding --------------------------------------------------------------------------------------


def _decoder(topic: SourceTopic) -> Callable[[bytes], object]:
    if topic.schema is not None:
        from rsltrace.trace.decode import Decoder
        from rsltrace.trace.index import ChannelInfo

        return Decoder(
            ChannelInfo(0, topic.name, topic.type, SCHEMA_ENCODING, topic.schema, {})
        ).decode
    store = _known_types()
    if topic.type not in store.types:
        raise TraceError(
            f"messages on {topic.name} cannot be decoded: the recording does not define "
            f"{topic.type or 'their type'}, and it is no type that ROS 2 brings along"
        )

    def decode(data: bytes) -> object:
        try:
            decoded: object = store.deserialize_cdr(data, topic.type)
        except RsltraceError:
            raise
        except Exception as error:  # what its generated code raises has no common base
            raise TraceError(
                f"a message on {topic.name} does not fit its type {topic.type}: {error}"
            ) from error
        return decoded

    return decode


@lru_cache(maxsize=1)
def _known_types() -> Any:
    """Return the types of ROS 2 Jazzy, for recordings that do not carry their schemas."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)
