"""The file of a trace: opened so that nothing is overwritten by mistake, every byte checked.

User code in the same process may close, delete, truncate or rename files. So each write first
checks process, file and offset, and the finished file is checked once more. A replaced trace stays
until the new one is complete: the new one is written beside it and renamed at the end.

Errors here are the user's (no space, no permission, a file in the way), so each says what to do.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
from contextlib import suppress
from pathlib import Path

from rsltrace.errors import OutputError
from rsltrace.trace.mcap.descriptor import PrivateDescriptor
from rsltrace.trace.mcap.records import MAGIC, crc32

if sys.platform != "win32":
    import fcntl

_OPEN = os.O_RDWR | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
_OPEN |= getattr(os, "O_NOFOLLOW", 0)
_READ_BACK_BYTES = 32 << 20
"""Files up to this size are read back at the end, larger ones if something else touched them."""
_PIECE_BYTES = 1 << 20
_PARTS_MAX = 512
"""The number of parts in one call; Linux allows 1024."""
_CACHED_BYTES = 1 << 30
"""Beyond these, what is on the disk does not stay in the kernel's cache: that would take all the
memory that is free, at ten times the cost of the write where a hypervisor has yet to back it."""
_RELEASED_BYTES = 64 << 20
_WRITTEN_BACK_BYTES = 256 << 20
"""How far back it is looked for what has reached the disk meanwhile."""


def unfinished_path(path: Path) -> Path:
    """Return the path of the trace that will replace the one at ``path``, while it is written."""
    real = Path(os.path.realpath(path)) if path.is_symlink() else path
    return real.parent / f"{real.stem}.unfinished{real.suffix}"  # "." has no name to replace


class Sink:
    """An append-only file. ``offset`` is the number of bytes written, ``crc`` their CRC-32.

    ``place`` is the written file: ``path``, or beside it while that is to be replaced.
    """

    def __init__(self, path: Path, *, force: bool) -> None:
        """Create the file; with ``force``, a trace or other MCAP file may be there.

        A killed run must leave a readable file where the user expects it, so a new file has its
        final name from the start. Raises OutputError when it cannot be created.
        """
        self.path = self.place = path
        self.offset = 0
        self.crc = 0
        self._process = os.getpid()
        self._written_ns = -1
        self._touched = False
        self._released = _CACHED_BYTES
        replaced = self._replaced = _replaceable_status(path) if force else None
        flags = _OPEN | os.O_CREAT
        if replaced is None:
            flags |= os.O_EXCL
        else:
            self.place = unfinished_path(path)
            _check_replaceable(self.place)
        # A node may change the working directory.
        self._final = os.path.realpath(path)
        self._absolute = self._final
        if replaced is not None:
            self._absolute = os.path.join(os.path.dirname(self._final), self.place.name)
        try:
            self._descriptor = PrivateDescriptor(os.open(self._absolute, flags, 0o666))
        except OSError as error:
            raise OutputError(_why_not_created(self.place, error)) from error
        self._lock()
        if replaced is not None:
            os.truncate(self._descriptor.number, 0)
            with suppress(OSError):
                os.chmod(self._descriptor.number, stat.S_IMODE(replaced.st_mode))

    @property
    def closed(self) -> bool:
        return self._descriptor.number < 0

    @property
    def kept(self) -> str:
        """What to say about a file that should have been replaced and was not; else ""."""
        if self._replaced is None or self.place == self.path:
            return ""
        with suppress(OSError):
            if _version(os.stat(self._final)) == _version(self._replaced):
                return f"{self.path} is as it was"
        return f"{self.path} was changed or deleted while the run went on, but not by rsltrace"

    def write(self, *parts: bytes, crc: int | None = None) -> None:
        """Append ``parts`` without joining them: they may be large.

        ``crc`` is the file's CRC-32 with them, if known. Raises OSError; ``offset`` then counts the
        written bytes.

        :raises OutputError: if the file was changed.
        """
        self._check()
        number = self._descriptor.number
        if crc is None:
            for part in parts:
                self.crc = crc32(part, self.crc)
        else:
            self.crc = crc
        rest = [memoryview(part) for part in parts if part]
        while rest:
            # A full disk first writes a part, and fails at the next call.
            count = os.pwritev(number, rest[:_PARTS_MAX], self.offset)
            self.offset += count
            while rest and count >= len(rest[0]):
                count -= len(rest.pop(0))
            if rest:
                rest[0] = rest[0][count:]
        if self.offset - self._released >= _RELEASED_BYTES and hasattr(os, "posix_fadvise"):
            # Begins to write what has not been written back, and lets go of what has.
            begin = max(self._released - _WRITTEN_BACK_BYTES, _CACHED_BYTES)
            with suppress(OSError):  # it is advice
                os.posix_fadvise(number, begin, self.offset - begin, os.POSIX_FADV_DONTNEED)
            self._released = self.offset
        self._written_ns = os.fstat(number).st_mtime_ns

    def finish(self, *, replace: bool = True) -> None:
        """Check the file against what was written, close it and give it its final name.

        Without ``replace``, an older trace stays, and so does the new one beside it.

        :raises OSError: if the rest does not reach the disk.
        :raises OutputError: if the file is not what was written.
        """
        status = self._check()
        try:
            there: os.stat_result | None = os.lstat(self._absolute)
        except OSError:
            there = None
        if there is None or not os.path.samestat(there, status):
            raise self._spoilt("it was renamed, or another file has its name")
        if (self._touched or self.offset <= _READ_BACK_BYTES) and not self._reads_back():
            raise self._spoilt("its content is not what was written")
        if replace and self.place != self.path:
            os.fsync(self._descriptor.number)
            os.replace(self._absolute, self._final)
            self.place = self.path
        self._descriptor.close()

    def close(self) -> None:
        """Close the file as it is; a second call does nothing. Raises OSError."""
        if self.offset == 0 and not self.closed and os.getpid() == self._process:
            with suppress(OSError):
                os.unlink(self._absolute)  # there is nothing in it
        self._descriptor.close()

    # -- checks ------------------------------------------------------------------------------------

    def _check(self) -> os.stat_result:
        """Check the process, the file and its size; return the file's status."""
        if os.getpid() != self._process:
            raise OutputError(
                f"a process that was forked in the run has come back into it; the trace "
                f"{self.place} is written by process {self._process} alone"
            )
        status = self._descriptor.status() or self._opened_again()
        if status.st_nlink == 0:
            raise self._spoilt("it was deleted")
        if status.st_size != self.offset:
            raise self._spoilt(f"it has {status.st_size} bytes and should have {self.offset}")
        self._touched |= self._written_ns not in (-1, status.st_mtime_ns)
        return status

    def _opened_again(self) -> os.stat_result:
        """Open the file again: a node closed the descriptor or used its number."""
        if self.closed:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        again = PrivateDescriptor(os.open(self._absolute, _OPEN))
        if again.identity != self._descriptor.identity:
            again.close()
            raise self._spoilt("another file has its name")
        self._descriptor = again
        self._lock()
        return os.fstat(again.number)

    def _reads_back(self) -> bool:
        crc = at = 0
        while piece := os.pread(self._descriptor.number, _PIECE_BYTES, at):
            crc = crc32(piece, crc)
            at += len(piece)
        return (at, crc) == (self.offset, self.crc)

    def _spoilt(self, what: str) -> OutputError:
        return OutputError(
            f"the trace {self.place} was changed while the run went on: {what}; look for what "
            "does so in the nodes or beside them, or choose another place with -o"
            f"{self.kept and f'; {self.kept}'}"
        )

    def _lock(self) -> None:
        """Lock the file against other runs; closing the descriptor unlocks it."""
        if not _locked(self._descriptor.number):
            self._descriptor.close()
            raise _busy_error(self.place)
        with suppress(OSError):
            if os.path.samestat(os.lstat(self._absolute), os.fstat(self._descriptor.number)):
                return
        self._descriptor.close()  # renamed by who had the lock before us, or deleted
        raise _busy_error(self.place)


def _version(status: os.stat_result) -> tuple[int, ...]:
    """Return values that differ for another file, or for changed content."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _locked(fd: int) -> bool:
    """Lock a file for writing; False if another process has. Some file systems have no locks."""
    if sys.platform == "win32":
        return True
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def _busy_error(path: Path) -> OutputError:
    return OutputError(
        f"cannot write the trace {path}: another run is writing it; wait, or choose another place "
        "with -o"
    )


def _replaceable_status(path: Path) -> os.stat_result | None:
    """Return the status of the existing trace, None if there is none.

    :raises OutputError: if it is no trace (``-o job.yaml`` is a slip), or is being written.
    """
    try:
        status = path.stat()
    except OSError:
        return None  # creating it says what is wrong
    _check_replaceable(path)
    return status


def _check_replaceable(path: Path) -> None:
    """Raise OutputError unless the existing file, if any, is a trace that nobody is writing."""
    try:
        kind = path.stat().st_mode
        if not stat.S_ISREG(kind):
            raise OutputError(f"cannot write the trace {path}: {_kind(kind)}")
        with path.open("rb") as file:
            begin = file.read(len(MAGIC))
            free = _locked(file.fileno())
    except OSError:
        return  # creating it says what is wrong
    if not MAGIC.startswith(begin):
        raise OutputError(
            f"cannot write the trace {path}: the existing file is not a trace (not MCAP); "
            "remove it yourself, or choose another place with -o"
        )
    if not free:
        raise _busy_error(path)


def _kind(mode: int) -> str:
    if stat.S_ISDIR(mode):
        return "it is a folder; name a file with -o"
    what = "named pipe" if stat.S_ISFIFO(mode) else "device or socket"
    return f"it is a {what}, and a trace is checked when it is whole; name a file with -o"


def _why_not_created(path: Path, error: OSError) -> str:
    with suppress(OSError):
        kind = path.stat().st_mode
        if not stat.S_ISREG(kind):
            return f"cannot write the trace {path}: {_kind(kind)}"
    if error.errno == errno.EEXIST:
        force = "--force (in Python: force=True)"
        return f"cannot write the trace {path}: it exists; use {force} to replace it, or -o"
    folder = path.parent
    if not folder.exists():
        return (
            f"cannot write the trace {path}: the folder {folder} does not exist; "
            "create it or choose another place"
        )
    if not folder.is_dir():
        return f"cannot write the trace {path}: {folder} is not a folder; choose another with -o"
    reason = error.strerror or str(error)
    if error.errno == errno.ENOENT:
        reason = f"no file can be created in {folder}"
        if path.is_symlink():
            reason = f"it is a link to {os.readlink(path)}, which cannot be created"
    return f"cannot write the trace {path}: {reason}; choose another place with -o"
