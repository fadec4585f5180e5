"""The file a trace is written to: opened so that nothing is lost by mistake, every byte accounted.

User code runs in the same process, and may close, delete, cut or rename whatever it likes. So who
writes, to which file and where is checked before each write, and before a trace is said to be there
the file is looked at once more. A trace that is replaced stays until the new one is whole: that is
written beside it, and takes its name at the end.

Errors here are the user's (no room, no permission, a file in the way), so each says what to do.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
from contextlib import suppress
from pathlib import Path

from rsltrace.errors import OutputError
from rsltrace.trace.mcap.checksum import crc32, joined_crc
from rsltrace.trace.mcap.descriptor import Descriptor
from rsltrace.trace.mcap.records import MAGIC

if sys.platform != "win32":
    import fcntl

_OPEN = os.O_RDWR | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
_OPEN |= getattr(os, "O_NOFOLLOW", 0)
_READ_BACK_BYTES = 32 << 20
"""Files up to this size are read back at the end, larger ones if somebody else has touched them."""
_PIECE_BYTES = 1 << 20
_PARTS_MAX = 512
"""How many parts one call writes; Linux takes 1024."""


def unfinished(path: Path) -> Path:
    """Return where the trace that is to replace the one at ``path`` is, until it is whole."""
    real = Path(os.path.realpath(path)) if path.is_symlink() else path
    return real.with_name(f"{real.stem}.unfinished{real.suffix}")


class Sink:
    """An append-only file. ``offset`` is the bytes written, ``crc`` their CRC-32.

    ``place`` is where they are: ``path``, or beside it as long as they replace a file.
    """

    def __init__(self, path: Path, *, force: bool) -> None:
        """Create the file; with ``force``, a trace (or other MCAP file) may be there.

        A killed run must leave a readable file under a name that the user knows, so the file has
        no other name while it is written. Raises OutputError when it cannot be created.
        """
        self.path = self.place = path
        self.offset = 0
        self.crc = 0
        self._process = os.getpid()
        self._written_ns = -1
        self._touched = False
        replaced = self._replaced = _to_be_replaced(path) if force else None
        flags = _OPEN | os.O_CREAT
        if replaced is None:
            flags |= os.O_EXCL
        else:
            self.place = unfinished(path)
            _check_free(self.place)
        # A node may go to another folder.
        self._final = os.path.realpath(path)
        self._absolute = self._final
        if replaced is not None:
            self._absolute = os.path.join(os.path.dirname(self._final), self.place.name)
        try:
            self._descriptor = Descriptor(os.open(self._absolute, flags, 0o666))
        except OSError as error:
            raise OutputError(_why_not_created(self.place, error)) from error
        self._lock()
        if replaced is not None:
            os.truncate(self._descriptor.number, 0)
            with suppress(OSError):
                os.chmod(self._descriptor.number, stat.S_IMODE(replaced.st_mode))

    @property
    def closed(self) -> bool:
        """Whether the file was closed."""
        return self._descriptor.number < 0

    @property
    def kept(self) -> str:
        """What to say of the file that was to be replaced, as long as it is not; else ""."""
        if self._replaced is None or self.place == self.path:
            return ""
        with suppress(OSError):
            if _version(os.stat(self._final)) == _version(self._replaced):
                return f"{self.path} is as it was"
        return f"{self.path} was changed or deleted while the run went on, but not by rsltrace"

    def write(self, *parts: bytes, crc: int | None = None) -> None:
        """Append ``parts``, which need not be joined before: they may be large.

        ``crc`` is the CRC-32 of all of them, if it is known. Raises OSError; ``offset`` then counts
        what reached the file.

        :raises OutputError: if the file is not as it was left.
        """
        self._check()
        number = self._descriptor.number
        if crc is None:
            for part in parts:
                self.crc = crc32(part, self.crc)
        else:
            self.crc = joined_crc(self.crc, crc, sum(map(len, parts)))
        rest = [memoryview(part) for part in parts if part]
        while rest:
            # A disk that fills up takes a part first and refuses the rest at the next call.
            count = os.pwritev(number, rest[:_PARTS_MAX], self.offset)
            self.offset += count
            while rest and count >= len(rest[0]):
                count -= len(rest.pop(0))
            if rest:
                rest[0] = rest[0][count:]
        self._written_ns = os.fstat(number).st_mtime_ns

    def finish(self, *, replace: bool = True) -> None:
        """Make sure that the file is what was written, close it and give it its name.

        Without ``replace``, a trace that was there stays, and the new one where it is.

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
        """Make sure that it is us who write, and where we left off; return the file's status."""
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
        """Open the file once more: a node has closed our descriptor, or used its number."""
        if self.closed:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        again = Descriptor(os.open(self._absolute, _OPEN))
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
        """Say to other runs that this file is being written; gone with the descriptor."""
        if not _locked(self._descriptor.number):
            self._descriptor.close()
            raise _busy(self.place)
        with suppress(OSError):
            if os.path.samestat(os.lstat(self._absolute), os.fstat(self._descriptor.number)):
                return
        self._descriptor.close()  # renamed by who had the lock before us, or deleted
        raise _busy(self.place)


def _version(status: os.stat_result) -> tuple[int, ...]:
    """Return what tells a file from another one, or from itself with other bytes."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _locked(fd: int) -> bool:
    """Lock a file for writing; False if somebody else has. Some file systems have no locks."""
    if sys.platform == "win32":
        return True
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def _busy(path: Path) -> OutputError:
    return OutputError(
        f"cannot write the trace {path}: another run is writing it; wait, or choose another place "
        "with -o"
    )


def _to_be_replaced(path: Path) -> os.stat_result | None:
    """Return the status of the trace that is there, None if nothing is.

    :raises OutputError: if it is no trace (``-o job.yaml`` is a slip of the pen), or in the making.
    """
    try:
        status = path.stat()
    except OSError:
        return None  # creating it says what is wrong
    _check_free(path)
    return status


def _check_free(path: Path) -> None:
    """Make sure that what is there, if anything, is a trace that nobody writes."""
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
            f"cannot write the trace {path}: what is there is no trace (it is not MCAP); "
            "remove it yourself, or choose another place with -o"
        )
    if not free:
        raise _busy(path)


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
            "create it or choose another place with -o"
        )
    if not folder.is_dir():
        return f"cannot write the trace {path}: {folder} is not a folder; choose another with -o"
    reason = error.strerror or str(error)
    return f"cannot write the trace {path}: {reason}; choose another place with -o"
