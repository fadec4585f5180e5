"""File descriptors of rsltrace, out of the way of user code.

A node may close every descriptor by number, or replace it by a file of its own. So these have high
numbers, are checked before use, and are closed in every child process.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from weakref import WeakSet

if sys.platform != "win32":
    import fcntl
    import resource

_NUMBERS_MAX = 4096
"""The kernel keeps a table up to the highest number, and copies it at every fork."""
_ROOM = 64


class PrivateDescriptor:
    """A descriptor that belongs to this process alone."""

    def __init__(self, fd: int) -> None:
        """Take over an open descriptor, and give it a high number."""
        status = os.fstat(fd)
        self.identity = (status.st_dev, status.st_ino)
        """The file, whatever its name."""
        self.number = _moved(fd)
        _all.add(self)

    @classmethod
    def copy_of(cls, fd: int) -> PrivateDescriptor:
        """Return a descriptor of the file of ``fd``, which stays open."""
        return cls(os.dup(fd))

    def status(self) -> os.stat_result | None:
        """Return the file's status, or None if the descriptor now belongs to another file."""
        try:
            status = os.fstat(self.number)
        except OSError:
            return None
        return status if (status.st_dev, status.st_ino) == self.identity else None

    def restore(self, number: int) -> None:
        """Make ``number`` a descriptor of the same file again, if it is not."""
        try:
            there = os.fstat(number)
        except OSError:
            there = None
        same = there is not None and (there.st_dev, there.st_ino) == self.identity
        if not same and self.status() is not None:
            os.dup2(self.number, number)

    def close(self) -> None:
        """Close it; harmless if it is closed or belongs to another file.

        :raises OSError: if written data did not reach the disk (network file systems).
        """
        ours = self.number >= 0 and self.status() is not None
        number, self.number = self.number, -1
        if ours:
            os.close(number)


def _moved(fd: int) -> int:
    """Return a copy of ``fd`` with a high number and close it; ``fd`` if that fails."""
    if sys.platform == "win32":
        return fd
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if limit < 0 or limit > _NUMBERS_MAX:
        limit = _NUMBERS_MAX
    try:
        number = fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, limit - _ROOM)
    except OSError:
        return fd
    os.close(fd)
    return number


_all: WeakSet[PrivateDescriptor] = WeakSet()


def _close_in_child() -> None:
    for descriptor in list(_all):
        with suppress(OSError):
            descriptor.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_in_child)
