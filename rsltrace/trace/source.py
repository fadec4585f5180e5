"""Where the bytes of a trace come from: the one narrow place between reader and storage.

The reader asks for ranges and nothing else, so a source that fetches ranges over the network can
take the file's place.
"""

from __future__ import annotations

import os
import stat
import sys
import threading
from pathlib import Path
from typing import Protocol

from rsltrace.errors import TraceError


class ByteSource(Protocol):
    """Random access to bytes that do not change. ``name`` is what error messages call it."""

    @property
    def name(self) -> str:
        """A path or address."""
        ...

    @property
    def size(self) -> int:
        """Length in bytes."""
        ...

    @property
    def bytes_read(self) -> int:
        """How many bytes were fetched from the storage so far."""
        ...

    def read_at(self, offset: int, length: int) -> bytes:
        """Return exactly ``length`` bytes from ``offset``. Raises TraceError if it cannot."""
        ...

    def close(self) -> None:
        """Let go of the storage; a second call does nothing."""
        ...


def check_within(source: ByteSource, offset: int, length: int) -> None:
    """Raise TraceError if a range is not in the file: where it says that something is."""
    if offset + length > source.size:
        raise TraceError(
            f"{source.name}: {length} bytes at offset {offset} reach beyond the end of the file "
            f"({source.size} bytes); the file is damaged"
        )


class FileSource:
    """A file on disk."""

    def __init__(self, path: Path) -> None:
        """Open ``path``. Raises TraceError if it is missing, not a file or not readable."""
        self._path = path
        self._lock = threading.Lock()
        self._bytes_read = 0
        try:
            # Looked at before it is opened: opening a named pipe would wait for a writer.
            status = path.stat()
            if stat.S_ISDIR(status.st_mode):
                raise TraceError(f"{path} is a folder; {_folder_hint(path)}")
            if not stat.S_ISREG(status.st_mode):
                raise TraceError(
                    f"{path} is not a regular file; a trace is read out of order, so save it to a "
                    "file first"
                )
            self._file = open(path, "rb", buffering=0)  # noqa: SIM115  # closed by close()
        except FileNotFoundError as error:
            raise TraceError(f"{path} does not exist") from error
        except OSError as error:
            raise TraceError(f"{path} cannot be read: {error.strerror or error}") from error
        self._size = status.st_size

    @property
    def name(self) -> str:
        """The path as it was given."""
        return str(self._path)

    @property
    def size(self) -> int:
        """Length in bytes when the file was opened."""
        return self._size

    @property
    def bytes_read(self) -> int:
        """How many bytes were read from the file so far."""
        return self._bytes_read

    def read_at(self, offset: int, length: int) -> bytes:
        """Return ``length`` bytes from ``offset``. Raises TraceError if the file ends before."""
        check_within(self, offset, length)
        try:
            data = self._read(offset, length)
        except (OSError, ValueError) as error:
            raise TraceError(f"{self._path} cannot be read at offset {offset}: {error}") from error
        self._bytes_read += len(data)
        if len(data) < length:
            raise TraceError(f"{self._path} became shorter while it was read; open it again")
        return data

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, offset: int, length: int) -> bytes:
        pieces = []
        while length:
            if sys.platform == "win32":
                with self._lock:
                    self._file.seek(offset)
                    piece = self._file.read(length)
            else:
                # Does not move a file position, which a forked process would share.
                piece = os.pread(self._file.fileno(), length, offset)
            if not piece:
                break
            pieces.append(piece)
            offset += len(piece)
            length -= len(piece)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def open_source(place: Path | str) -> ByteSource:
    """Open a file, or an address such as ``https://…`` or ``s3://…``. Raises TraceError.

    Raises SetupError for an address when fsspec, which reads it, is not installed.
    """
    if isinstance(place, str) and "://" in place:
        from rsltrace.trace.remote import open_remote  # a library that local files do not need

        return open_remote(place)
    return FileSource(Path(place))


def _folder_hint(path: Path) -> str:
    if (path / "metadata.yaml").exists():
        return (
            "it holds a rosbag2 recording; a trace is one .mcap file that `rsltrace record` wrote"
        )
    return "name the .mcap file in it"
