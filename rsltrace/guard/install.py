"""Putting all replacements in place for the time of a run, and taking them back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from rsltrace.guard.recorded.descriptors import recorded_descriptors
from rsltrace.guard.recorded.files import recorded_files
from rsltrace.guard.recorded.polls import recorded_polls
from rsltrace.guard.recorded.processes import recorded_processes
from rsltrace.guard.recorded.sockets import recorded_sockets
from rsltrace.guard.virtual.clocks import virtual_clocks
from rsltrace.guard.virtual.directory_listings import sorted_listings
from rsltrace.guard.virtual.module_caches import fresh_module_caches
from rsltrace.guard.virtual.object_hashes import watched_hashes
from rsltrace.guard.virtual.object_texts import numbered_texts
from rsltrace.guard.virtual.own_process_id import own_process_ids
from rsltrace.guard.virtual.processors import same_processors
from rsltrace.guard.virtual.randomness import virtual_randomness
from rsltrace.guard.virtual.set_order import ordered_sets
from rsltrace.guard.watched.functions import watched_calls

_REPLACEMENTS = (
    fresh_module_caches,
    virtual_clocks,
    virtual_randomness,
    sorted_listings,
    numbered_texts,
    watched_hashes,
    ordered_sets,
    own_process_ids,
    watched_calls,
    same_processors,
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
