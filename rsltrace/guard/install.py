"""Putting all replacements in place for the time of a run, and taking them back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from rsltrace.guard.clocks import clocks
from rsltrace.guard.folders import folders
from rsltrace.guard.memories import memories
from rsltrace.guard.randomness import randomness
from rsltrace.guard.recorded_descriptors import recorded_descriptors
from rsltrace.guard.recorded_files import recorded_files
from rsltrace.guard.recorded_polls import recorded_polls
from rsltrace.guard.recorded_processes import recorded_processes
from rsltrace.guard.recorded_sockets import recorded_sockets
from rsltrace.guard.watch import watching

_REPLACEMENTS = (
    memories,
    clocks,
    randomness,
    folders,
    watching,
    recorded_files,
    recorded_descriptors,
    recorded_sockets,
    recorded_polls,
    recorded_processes,
)

_users = 0
_stack = ExitStack()


@contextmanager
def installed() -> Iterator[None]:
    """Redirect the sources; the last one to leave takes everything back."""
    global _users, _stack
    if _users == 0:
        with ExitStack() as stack:
            for replacement in _REPLACEMENTS:
                stack.enter_context(replacement())
            _stack = stack.pop_all()
    _users += 1
    try:
        yield
    finally:
        _users -= 1
        if _users == 0:
            _stack.close()
