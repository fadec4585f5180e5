"""What a folder holds that can be looked at: traces, bags and other recordings, newest first."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from rsltrace.diff.file_kind import is_recording, is_trace
from rsltrace.errors import RsltraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.texts import format_duration, printable
from rsltrace.trace.native import run_name
from rsltrace.trace.reader import Trace

# Where one has been, to go back and forward through, and the events one marked.
#
# Events, not places: these change as two runs are aligned, and with which run is shown.

Event = tuple[bool, int]
"""An event: whether it is of run b, and its index."""

_KEPT = 500


class VisitedEvents:
    """Events visited. Going somewhere new after going back drops what lay ahead, as in browsers."""

    def __init__(self) -> None:
        self._back: list[Event] = []
        self._ahead: list[Event] = []

    def leave(self, event: Event) -> None:
        """Remember ``event`` before jumping away from it."""
        if not self._back or self._back[-1] != event:
            self._back.append(event)
            del self._back[:-_KEPT]
        self._ahead.clear()

    def back(self, event: Event) -> Event | None:
        """Return where to go back to from ``event``; None at the beginning."""
        while self._back and self._back[-1] == event:
            self._back.pop()
        if not self._back:
            return None
        self._ahead.append(event)
        return self._back.pop()

    def forward(self, event: Event) -> Event | None:
        """Return where one came back from; None if there is nothing ahead."""
        if not self._ahead:
            return None
        self._back.append(event)
        return self._ahead.pop()


class Bookmarks:
    """Marked events. A row of two runs is marked with all events in it."""

    def __init__(self) -> None:
        self.events: set[Event] = set()

    def of(self, row: Iterable[Event]) -> bool:
        return bool(self.events) and not self.events.isdisjoint(row)

    def toggle(self, row: Iterable[Event]) -> bool:
        """Set or remove the mark of a row; return whether it is set now."""
        row = set(row)
        if self.of(row):
            self.events -= row
            return False
        self.events |= row
        return True


_LOOKED_AT_MAX = 200
_OPENED_BYTES_MAX = 64 << 20
"""Larger recordings may have to be read to the end to be counted: their size is shown."""
_FILES = ("*.mcap", "*.db3", "*.mcap.zstd", "*.db3.zstd")


@dataclass(frozen=True, slots=True)
class Found:
    """A trace or a recording: its path, how much is in it, how long it is, and what else to say."""

    path: Path
    amount: str
    length: str
    what: str

    @property
    def name(self) -> str:
        """The path; that of a folder ends in a slash."""
        return printable(f"{self.path}/" if self.path.is_dir() else str(self.path))


def found_in(folder: Path) -> list[Found]:
    """Return the traces and recordings in a folder and the folders in it, the newest first. What
    cannot be read is left out."""
    paths = sorted(_paths_in(folder), key=lambda path: (-path.stat().st_mtime, str(path)))
    found = []
    for path in paths[:_LOOKED_AT_MAX]:
        with suppress(RsltraceError, OSError):
            if path.is_file() and is_trace(path):
                found.append(_trace(path))
            elif is_recording(path):
                found.append(_recording(path))
    return found


def _paths_in(folder: Path) -> Iterator[Path]:
    from rsltrace.trace.recordings.metadata import NAME  # loads what reads all kinds of bags

    bags = {path.parent for deep in ("", "*/", "*/*/") for path in folder.glob(f"{deep}{NAME}")}
    yield from bags
    for pattern in _FILES:
        for deep in ("", "*/"):
            for path in folder.glob(f"{deep}{pattern}"):
                if path.parent not in bags and path.is_file():
                    yield path


def _trace(path: Path) -> Found:
    with Trace.open(path) as trace:
        state = "" if trace.complete else "  not finished"
        length = format_duration(trace.end_ns - trace.start_ns)
        return Found(path, f"{trace.event_count:,} events", length, f"{run_name(trace)}{state}")


def _recording(path: Path) -> Found:
    size = sum(one.stat().st_size for one in ([path] if path.is_file() else path.iterdir()))
    if size > _OPENED_BYTES_MAX or path.suffix == ".zstd":
        return Found(path, f"{size / 1e6:,.1f} MB", "", "recording")
    from rsltrace.trace.recordings import open_bag

    bag = open_bag(path, recover=path.is_file())
    try:
        length = format_duration(bag.recording_end_ns - bag.recording_start_ns)
        state = "  incomplete" if bag.notes else ""
        return Found(
            path, f"{bag.message_count:,} messages", length, f"{bag.storage_id} recording{state}"
        )
    finally:
        bag.close()
