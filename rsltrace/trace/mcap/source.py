"""Sources of bytes: readers ask for ranges, whether of a file or over the network."""

from __future__ import annotations

import os
import re
import sys
import threading
from io import FileIO
from pathlib import Path
from typing import Protocol
from urllib.parse import unquote, urlsplit

from rsltrace.errors import RsltraceError, TraceError
from rsltrace.trace.model.regular_file import not_regular

# Secrets in addresses, kept out of errors and reports.

_SIGNS_MIN = 3
"""Shorter pieces of an address are kept in texts: they occur in any word."""

_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://[^\s'\"<>)\]}]+")


def public_address(address: str) -> str:
    """Return an address without user name, password, query (which may grant access) and fragment.

    An ellipsis replaces a query, so that the result is not mistaken for the whole.
    """
    address = re.sub(r"(?<=://)[^/?#]*@", "", address.partition("#")[0])
    plain, query, _ = address.partition("?")
    return f"{plain}?…" if query else plain


def redacted(text: str, address: str) -> str:
    """Return a library's text about ``address`` without the secrets in it."""
    text = _ADDRESS.sub(
        lambda found: public_address(found[0]), text.replace(address, public_address(address))
    )
    try:
        parts = urlsplit(address)
    except ValueError:  # no address at all
        return text
    pieces = re.split(r"[&=:]", f"{parts.query}&{parts.netloc.rpartition('@')[0]}&{parts.fragment}")
    for piece in sorted({*pieces, *map(unquote, pieces)}, key=len, reverse=True):
        if len(piece) >= _SIGNS_MIN:
            text = text.replace(piece, "…")
    return text


class ByteSource(Protocol):
    """Random access to ``size`` unchanging bytes, of which ``bytes_read`` have been fetched from
    storage so far. ``is_remote``: reading all of it takes long."""

    name: str
    """A path, or an address without secrets, for error messages."""
    size: int
    bytes_read: int
    is_remote: bool

    def read_at(self, offset: int, length: int) -> bytes:
        """Return exactly ``length`` bytes from ``offset``, or raise an error."""
        ...

    def close(self) -> None:
        """Close the storage; a second call does nothing."""
        ...


def range_problem(source: ByteSource, offset: int, length: int) -> str:
    """Return what is wrong with a range that is not in the file, "" if it is."""
    if offset + length <= source.size:
        return ""
    return (
        f"{source.name}: {length} bytes at offset {offset} reach beyond the end of the file "
        f"({source.size} bytes); the file is damaged"
    )


class FileSource:
    is_remote = False

    def __init__(self, path: Path, error: type[RsltraceError] = TraceError) -> None:
        """Open ``path``. Raises ``error``, as all methods do, if it cannot be read."""
        self.name = str(path)
        self._error = error
        self._lock = threading.Lock()
        self.bytes_read = 0
        try:
            kind = not_regular(path)
            if kind == "a folder":
                raise error(f"{path} is a folder; {_folder_hint(path)}")
            if kind:
                raise error(
                    f"{path} is {kind}; it is read out of order, so save it to a file first"
                )
            self._file = FileIO(path, "rb")  # not ``open``, which a node of this run may break
        except FileNotFoundError as reason:
            raise error(f"{path} does not exist") from reason
        except OSError as reason:
            raise error(f"{path} cannot be read: {reason.strerror or reason}") from reason
        self.size = os.fstat(self._file.fileno()).st_size

    def read_at(self, offset: int, length: int) -> bytes:
        if problem := range_problem(self, offset, length):
            raise self._error(problem)
        try:
            data = self._read(offset, length)
        except (OSError, ValueError) as reason:
            raise self._error(
                f"{self.name} cannot be read at offset {offset}: {reason}"
            ) from reason
        self.bytes_read += len(data)
        if len(data) < length:
            raise self._error(f"{self.name} became shorter while it was read; open it again")
        return data

    def close(self) -> None:
        self._file.close()

    def _read(self, offset: int, length: int) -> bytes:
        pieces = []
        while length:
            if sys.platform == "win32":
                with self._lock:
                    self._file.seek(offset)
                    piece = self._file.read(length)
            else:
                # pread does not move the file position, which a forked process would share.
                piece = os.pread(self._file.fileno(), length, offset)
            if not piece:
                break
            pieces.append(piece)
            offset += len(piece)
            length -= len(piece)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def _folder_hint(path: Path) -> str:
    if (path / "metadata.yaml").exists():
        return (
            "it holds a rosbag2 recording, which `rsltrace view` and `rsltrace diff` read; a trace "
            "is one .mcap file that `rsltrace record` wrote"
        )
    return "name the .mcap file in it"
