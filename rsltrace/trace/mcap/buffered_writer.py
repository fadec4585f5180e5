"""An MCAP file that has no place yet: what is written waits, and is poured into a file later.

The beginning of a run that many others go on from is recorded once; each of them has a file of its
own, which begins with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rsltrace.trace.mcap.chunk import ChunkBody
from rsltrace.trace.mcap.writer import McapWriter


class DeferredWriter(McapWriter):
    """Takes what an ``McapWriter`` takes up to ``pour``, as it would be on the disk. Metadata or an
    attachment of a name that was there takes its place."""

    def __init__(self, *, compression: str, profile: str, library: str) -> None:
        self._prepare(compression, progress=lambda: "nothing is on the disk")
        self._about = {"profile": profile, "library": library}
        self._records: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        self._channels = 0
        self._chunks = 0

    @property
    def bytes_written(self) -> int:
        """Nothing is written before there is a file."""
        return 0

    def channel(
        self, topic: str, type_name: str, schema_text: str, metadata: Mapping[str, str]
    ) -> int:
        """Take a channel; return the id that it will have."""
        self._add(McapWriter.channel, topic, type_name, schema_text, metadata)
        self._channels += 1
        return self._channels

    def metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        """Take a metadata record."""
        self._add(McapWriter.metadata, name, mapping)

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Take an attachment."""
        self._add(McapWriter.attachment, name, media_type, data)

    def chunk(self, body: ChunkBody) -> tuple[int, int]:
        """Take a chunk; return which one it is, and 0: where it is turns out in ``pour``."""
        self._add(McapWriter.packed_chunk, body, *self.packed(body))
        self._chunks += 1
        return self._chunks - 1, 0

    def _add(self, write: Callable[..., Any], *what: Any) -> None:
        if write in (McapWriter.metadata, McapWriter.attachment):
            for index, (other, there) in enumerate(self._records):
                if other is write and there[0] == what[0]:
                    self._records[index] = (write, what)
                    return
        self._records.append((write, what))

    def pour(
        self, path: Path, *, force: bool, progress: Callable[[], str]
    ) -> tuple[McapWriter, list[tuple[int, int]]]:
        """Create the file; return who goes on writing it, and where each chunk is.

        :raises OutputError: the disk refuses, or there is something else.
        """
        writer = McapWriter(
            path, force=force, compression=self._compression, progress=progress, **self._about
        )
        try:
            found = [(write, write(writer, *what)) for write, what in self._records]
        except BaseException:
            writer.abort()
            raise
        writer.trust_as(self)
        return writer, [where for write, where in found if write is McapWriter.packed_chunk]

    def abort(self) -> None:
        """There is no file to close."""

    def poison(self) -> None:
        """Nothing can be half written."""
