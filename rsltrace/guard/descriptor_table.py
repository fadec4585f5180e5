"""Numbers for sockets and file descriptors that lead outside of the run, the same in each re-run.

The operating system's numbers differ from run to run. These are given in the order in which a run
first uses its sockets and descriptors.
"""

from __future__ import annotations

import os
import stat
from typing import Any
from weakref import WeakKeyDictionary

from rsltrace.fast_dataclass import dataclass
from rsltrace.guard.redirect import copy_of
from rsltrace.trace.model.finding import NondeterminismSource

_fstat = copy_of(os.fstat)
_Identity = tuple[int, int]


@dataclass(frozen=True, slots=True)
class RecordedDescriptor:
    """An open file descriptor whose answers are recorded; of a folder only ``fstat``."""

    number: int
    source: NondeterminismSource
    identity: _Identity
    is_folder: bool = False


class DescriptorTable:
    """The open descriptors of one run. A reused number is noticed by its inode."""

    def __init__(self) -> None:
        self.processes: set[int] = set()
        """Processes that the run started; in a re-run, those of the recorded run."""
        self._open: dict[int, RecordedDescriptor] = {}
        self._far_ends: dict[int, tuple[_Identity, int]] = {}
        self._numbers: WeakKeyDictionary[Any, int] = WeakKeyDictionary()
        self._last = 0

    def add(
        self, fd: int, source: NondeterminismSource, *, is_folder: bool = False
    ) -> RecordedDescriptor:
        """Register a descriptor whose answers are to be recorded."""
        found = self.find(fd)
        if found is None:
            found = RecordedDescriptor(self._next(), source, _identity(fd), is_folder)
            self._open[fd] = found
        return found

    def find(self, fd: object) -> RecordedDescriptor | None:
        """Return the entry of a descriptor, or of an object that has one."""
        if not self._open:
            return None
        number = number_of(fd)
        found = self._open.get(number)
        if found is None:
            return None
        if _identity(number) != found.identity:
            del self._open[number]
            return None
        return found

    def drop(self, fd: int) -> None:
        """Forget a closed descriptor."""
        self._open.pop(fd, None)
        self._far_ends.pop(fd, None)

    def join(self, one: int, other: int) -> None:
        """Register two ends of one pipe or socket pair."""
        for fd, far in ((one, other), (other, one)):
            self._open.pop(fd, None)
            self._far_ends[fd] = (_identity(fd), far)

    def far_end(self, fd: int) -> int | None:
        """Return the other end of a pipe or pair that the run made."""
        found = self._far_ends.get(fd)
        if found is None or _identity(fd) != found[0]:
            return None
        return found[1]

    def leads_out(self, fd: int) -> bool:
        """Return whether a descriptor's other end is not open in this process."""
        far = self.far_end(fd)
        return far is None or self._far_ends.get(far, (None, 0))[0] != _identity(far)

    def inner_pairs(self) -> list[tuple[int, int]]:
        """Return the pipes and socket pairs with both ends in this process, each once."""
        pairs = ((fd, self.far_end(fd)) for fd in list(self._far_ends) if not self.leads_out(fd))
        return [
            (fd, far)
            for fd, far in pairs
            if far is not None and fd < far and not stat.S_ISCHR(_fstat(fd).st_mode)
        ]

    def is_outside(self, fd: object) -> bool:
        """Return whether a descriptor leads to something that is not part of the run."""
        if self.find(fd) is not None:
            return True
        number = number_of(fd)
        try:
            is_socket = stat.S_ISSOCK(_fstat(number).st_mode)
        except OSError:
            return False
        return is_socket and self.far_end(number) is None

    def number(self, obj: Any) -> int:
        """Return the number of an object without descriptor, or whose descriptor may change."""
        found = self._numbers.get(obj)
        if found is None:
            found = self._numbers[obj] = self._next()
        return found

    def _next(self) -> int:
        self._last += 1
        return self._last


def number_of(fd: object) -> int:
    """Return the number of a descriptor or of an object that has one, or -1."""
    if isinstance(fd, int):
        return fd
    try:
        return int(fd.fileno())  # type: ignore[attr-defined]
    except (AttributeError, ValueError, OSError):
        return -1


def _identity(fd: int) -> _Identity:
    try:
        found = _fstat(fd)
    except OSError:
        return -1, -1
    return found.st_dev, found.st_ino
