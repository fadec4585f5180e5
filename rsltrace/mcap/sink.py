"""The file a trace is written to: opened so that nothing is lost by mistake, every byte accounted.

Errors here are the user's (no room, no permission, a file in the way), so each says what to do.
"""

from __future__ import annotations

import errno
import os
import zlib
from pathlib import Path

from rsltrace.errors import OutputError
from rsltrace.mcap.records import MAGIC
from rsltrace.mcap.source import not_regular


class Sink:
    """An append-only file. ``offset`` is the bytes written, ``crc`` their CRC-32."""

    def __init__(self, path: Path, *, force: bool) -> None:
        """Create ``path``; with ``force``, empty the trace (or other MCAP file) that is there.

        A killed run must leave a readable file under the name asked for, so the file is written in
        place and not renamed at the end. Raises OutputError when it cannot be created.
        """
        self.path = path
        self.offset = 0
        self.crc = 0
        if force and (why := _why_not_replaced(path)):
            raise OutputError(
                f"cannot write the trace {path}: what is there is no trace ({why}); "
                "remove it yourself, or choose another place with -o"
            )
        flags = os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if force else os.O_EXCL)
        flags |= getattr(os, "O_BINARY", 0)  # Windows alone has it, and needs it
        try:
            self._fd = os.open(path, flags, 0o666)
        except OSError as error:
            raise OutputError(_why_not_created(path, error)) from error

    @property
    def closed(self) -> bool:
        """Whether the file was closed."""
        return self._fd < 0

    def write(self, data: bytes) -> None:
        """Append ``data``. Raises OSError; ``offset`` then counts what reached the file."""
        self.crc = zlib.crc32(data, self.crc)
        rest = memoryview(data)
        while rest:
            # A disk that fills up takes a part first and refuses the rest at the next call.
            count = os.write(self._fd, rest)
            self.offset += count
            rest = rest[count:]

    def close(self) -> None:
        """Close the file; a second call does nothing. Raises OSError (network file systems)."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


def _why_not_replaced(path: Path) -> str:
    """Say what is there if it is no trace, "" if it is: ``-o job.yaml`` is a slip of the pen."""
    try:
        kind = not_regular(path)
        if kind:
            return "" if kind == "a folder" else f"it is {kind}"
        with path.open("rb") as file:
            begin = file.read(len(MAGIC))
    except OSError:
        return ""  # opening it to write says what is wrong
    return "" if MAGIC.startswith(begin) else "it is not MCAP"


def _why_not_created(path: Path, error: OSError) -> str:
    if path.is_dir():
        return f"cannot write the trace {path}: it is a folder; name a file with -o"
    if error.errno == errno.EEXIST:
        force = "--force (in Python: force=True)"
        return f"cannot write the trace {path}: it exists; use {force} to replace it, or -o"
    folder = path.parent
    if not folder.exists():
        return (
            f"cannot write the trace {path}: the folder {folder} does not exist; "
            "create it or choose another place with -o"
        )
    if not folder.is_dir():
        return f"cannot write the trace {path}: {folder} is not a folder; choose another with -o"
    reason = error.strerror or str(error)
    return f"cannot write the trace {path}: {reason}; choose another place with -o"
