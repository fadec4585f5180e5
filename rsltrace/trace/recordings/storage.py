"""What a bag needs from a storage format: one file of it, as topics and pieces."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

from rsltrace.trace.recordings.merge import Message
from rsltrace.trace.recordings.topic import BagQos


@dataclass(frozen=True, slots=True)
class StoredTopic:
    """A topic (in MCAP: a channel) of one storage file; ``id`` is the file's own."""

    id: int
    name: str
    type_name: str
    serialization_format: str
    offered_qos: tuple[BagQos, ...]
    message_count: int
    schema_text: str | None
    schema_encoding: str
    type_hash: str


@dataclass(frozen=True, slots=True)
class Extent:
    """A part of a storage file that is read as one: its place and the times it may hold."""

    offset: int
    length: int
    start_ns: int
    end_ns: int


class Storage(Protocol):
    """One open storage file. Every method raises ``BagError`` naming the file.

    ``wanted`` maps the file's topic ids to the indices given to messages; messages before
    ``first_ns`` are left out.
    """

    topics: list[StoredTopic]
    message_count: int
    start_ns: int
    end_ns: int
    cut_off: str
    """What is left of a file that was cut off, in words; empty for a whole one."""
    with_publish_time: bool
    """Set it to get the publish time in front of each message: 8 bytes, little-endian."""

    def extents(self, wanted: Mapping[int, int], first_ns: int) -> list[Extent]:
        """Return the parts that may hold wanted messages, in file order."""

    def read(self, extent: Extent, wanted: Mapping[int, int], first_ns: int) -> Iterator[Message]:
        """Yield the wanted messages of a part in time order, equal times in file order."""

    def count(self, wanted: Mapping[int, int], first_ns: int) -> int:
        """Return how many wanted messages there are."""

    def last_ns(self, wanted: Mapping[int, int], first_ns: int) -> int | None:
        """Return the time of the last wanted message."""

    def close(self) -> None:
        """Close the file."""
