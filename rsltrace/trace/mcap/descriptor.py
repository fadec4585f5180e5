"""Descriptors of ours where user code does not come across them.

A node may close every descriptor it can count to, or put files of its own in their place. So ours
have high numbers, are asked who they are before they are used, and are gone in every other process.
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


class Descriptor:
    """A descriptor that belongs to this process alone."""

    def __init__(self, fd: int) -> None:
        """Take an open descriptor over, and move it out of the way."""
        status = os.fstat(fd)
        self.identity = (status.st_dev, status.st_ino)
        """Which file it is of, whatever that is called."""
        self.number = _moved(fd)
        _all.add(self)

    @classmethod
    def copy_of(cls, fd: int) -> Descriptor:
        """Return a descriptor of what ``fd`` is of, which stays as it is."""
        return cls(os.dup(fd))

    def status(self) -> os.stat_result | None:
        """Return the file's status, or None if the descriptor is no longer of that file."""
        try:
            status = os.fstat(self.number)
        except OSError:
            return None
        return status if (status.st_dev, status.st_ino) == self.identity else None

    def restore(self, number: int) -> None:
        """Make ``number`` a descriptor of the same file again, unless it is one."""
        try:
            there = os.fstat(number)
        except OSError:
            there = None
        same = there is not None and (there.st_dev, there.st_ino) == self.identity
        if not same and self.status() is not None:
            os.dup2(self.number, number)

    def close(self) -> None:
        """Close it; harmless when it is closed, or another file has its number now.

        :raises OSError: if what was written did not reach the disk (network file systems).
        """
        ours = self.number >= 0 and self.status() is not None
        number, self.number = self.number, -1
        if ours:
            os.close(number)


def _moved(fd: int) -> int:
    """Return a copy of ``fd`` with a high number and close it; or ``fd``, where that fails."""
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


_all: WeakSet[Descriptor] = WeakSet()


def _close_in_child() -> None:
    for descriptor in list(_all):
        with suppress(OSError):
            descriptor.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_in_child)
