"""Memory that a process and the loop both see (``native/shared.h``): files in memory that grow."""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
from contextlib import suppress

from rsltrace.adapters.processes.wire import WireError

_LENGTH = struct.Struct("<Q")
_SIZE = 1 << 16


class Shared:
    """A file in memory, mapped; it never shrinks."""

    def __init__(self, name: str) -> None:
        self.fd = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(self.fd, _SIZE)
        fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)  # what is mapped stays there
        self._look_again()

    def _look_again(self) -> None:
        self.data = mmap.mmap(self.fd, 0)
        self.size = len(self.data)

    def grow(self, size: int) -> None:
        """Have room for so many bytes."""
        if size > self.size:
            os.ftruncate(self.fd, 2 * size)
            self._look_again()

    def has(self, size: int) -> bool:
        """Return whether there are so many bytes; the process may have made it grow."""
        if size > self.size:
            with suppress(OSError, ValueError):
                self._look_again()
        return size <= self.size

    def close(self) -> None:
        """Give the file back; what is mapped goes with its last user."""
        if self.fd >= 0:
            os.close(self.fd)
        self.fd = -1


class Said(Shared):
    """What a process has said and nobody has taken: the length, then whole records."""

    def batch(self, size: int) -> memoryview:
        """Return what is there; it holds until ``taken``.

        :raises WireError: if it is not of this size.
        """
        if size != _LENGTH.unpack_from(self.data)[0] or not self.has(_LENGTH.size + size):
            raise WireError("a process has sent what is no batch")
        return memoryview(self.data)[_LENGTH.size : _LENGTH.size + size]

    def left(self) -> memoryview:
        """Return what is there of a process that has ended: whole records."""
        size: int = _LENGTH.unpack_from(self.data)[0]
        return self.batch(size)

    def taken(self) -> None:
        """Make room for the next batch."""
        _LENGTH.pack_into(self.data, 0, 0)
