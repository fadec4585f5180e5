"""An MCAP writer without a file: it buffers the records until a file is opened.

Many runs may share one beginning. It is recorded once, and each run's file begins with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rsltrace.trace.mcap.chunk_builder import ChunkBody
from rsltrace.trace.mcap.writer import McapWriter


class BufferedWriter(McapWriter):
    """Buffers calls of ``McapWriter`` until ``write_to``. Metadata and attachments of the same name
    replace each other."""

    def __init__(self, *, compression: str, profile: str, library: str) -> None:
        self._prepare(compression, progress=lambda: "nothing is on the disk")
        self._about = {"profile": profile, "library": library}
        self._records: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        self._channels = 0
        self._chunks = 0

    @property
    def bytes_written(self) -> int:
        """0: there is no file."""
        return 0

    def channel(
        self, topic: str, type_name: str, schema_text: str, metadata: Mapping[str, str]
    ) -> int:
        """Buffer a channel; return its future id."""
        self._add(McapWriter.channel, topic, type_name, schema_text, metadata)
        self._channels += 1
        return self._channels

    def metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        self._add(McapWriter.metadata, name, mapping)

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        self._add(McapWriter.attachment, name, media_type, data)

    def chunk(self, body: ChunkBody) -> tuple[int, int]:
        """Buffer a chunk; return its number, and 0: its offset is known after ``write_to``."""
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

    def write_to(
        self, path: Path, *, force: bool, progress: Callable[[], str]
    ) -> tuple[McapWriter, list[tuple[int, int]]]:
        """Create the file; return its writer, and where each chunk is.

        :raises OutputError: the disk refuses, or something else has that name.
        """
        writer = McapWriter(
            path, force=force, compression=self._compression, progress=progress, **self._about
        )
        try:
            found = [(write, write(writer, *what)) for write, what in self._records]
        except BaseException:
            writer.abort()
            raise
        writer.copy_compressibility(self)
        return writer, [where for write, where in found if write is McapWriter.packed_chunk]

    def abort(self) -> None:
        """Do nothing: there is no file."""

    def poison(self) -> None:
        """Do nothing: no record can be half written."""
