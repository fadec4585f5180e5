"""Putting all replacements in place for the time of a run, and taking them back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from rsltrace.guard.recorded.descriptors import recorded_descriptors
from rsltrace.guard.recorded.files import recorded_files
from rsltrace.guard.recorded.polls import recorded_polls
from rsltrace.guard.recorded.processes import recorded_processes
from rsltrace.guard.recorded.sockets import recorded_sockets
from rsltrace.guard.virtual.clocks import clocks
from rsltrace.guard.virtual.folders import folders
from rsltrace.guard.virtual.module_caches import memories
from rsltrace.guard.virtual.randomness import randomness
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
