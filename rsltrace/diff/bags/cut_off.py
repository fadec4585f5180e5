"""A recording that was cut off, as a recorder leaves it that was killed: read as far as it goes.

``rsltrace.bag`` refuses such files, since a simulation must not take half of its input for all of
it. A comparison can say so and go on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import BinaryIO

from rsltrace.bag.mcap_chunk import cut_messages, read_chunk
from rsltrace.bag.mcap_records import HEADER, MAGIC, Channel, Fields, Schema
from rsltrace.bag.mcap_scan import McapIndex, Span, scan_file, walk_records
from rsltrace.bag.merge import Message, Piece, merge
from rsltrace.errors import BagError


def is_cut_off(path: Path) -> bool:
    """Whether ``path`` is an MCAP file without the end of one."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                return False
            file.seek(max(path.stat().st_size - len(MAGIC), 0))
            return file.read() != MAGIC
    except OSError:
        return False


class CutOffFile:
    """An MCAP file without an end. Every whole chunk of it is there.

    Raises BagError if nothing can be read, or a whole chunk is damaged (which is no cut).
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as file:
            size = file.seek(0, 2)
            self.whole_bytes = self._whole(file, size)
            self._index = McapIndex("")
            try:
                scan_file(file, len(MAGIC), self.whole_bytes, self._index)
            except ValueError as error:
                raise self._damaged(error) from error
        self.size = size
        self.message_count = self._index.counts.total()
        if not self.message_count:
            raise BagError(
                f"{path}: the recording was cut off before its first whole chunk: nothing can be "
                "read"
            )

    @property
    def channels(self) -> dict[int, Channel]:
        """All channels by id."""
        return self._index.channels

    @property
    def schemas(self) -> Mapping[int, Schema]:
        """All schemas by id."""
        return self._index.schemas

    def messages(self, wanted: Mapping[int, int]) -> Iterator[Message]:
        """Yield (log time, number, CDR) of channels by time; ``wanted`` maps ids to numbers."""
        pieces = [
            Piece(span.start_ns, order, partial(self._read, span, wanted))
            for order, span in enumerate(self._index.spans)
            if span.channels is None or not span.channels.isdisjoint(wanted)
        ]
        return merge(pieces)

    def _read(self, span: Span, wanted: Mapping[int, int]) -> Iterator[Message]:
        try:
            with self.path.open("rb") as file:
                if span.is_chunk:
                    data = read_chunk(file, span.offset, span.length)
                else:
                    file.seek(span.offset)
                    data = file.read(span.length)
            yield from cut_messages(data, wanted, 0)
        except ValueError as error:
            raise self._damaged(error) from error

    def _whole(self, file: BinaryIO, size: int) -> int:
        """Return how many bytes from the start are whole records, and check the first one."""
        end = len(MAGIC)
        try:
            for opcode, start, after in walk_records(file, end, size):
                if end == len(MAGIC):
                    file.seek(start)
                    profile = Fields(file.read(after - start)).text() if opcode == HEADER else None
                    if profile not in ("ros2", ""):
                        raise BagError(
                            f"{self.path}: not a ROS 2 recording: its MCAP profile is {profile!r}"
                        )
                end = after
        except ValueError:
            pass  # the first record that is not whole is where it was cut
        return end

    def _damaged(self, error: ValueError) -> BagError:
        return BagError(
            f"{self.path}: {error} (and the file was cut off); repair it with 'mcap recover'"
        )
