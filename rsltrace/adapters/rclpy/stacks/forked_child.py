"""A process that a node forks is not part of the run: it ends where it would come back into it.

Natively it would go on as a second copy of every node. Here the run is its parent's alone, and so
is the trace; what a child does within the callback that forked it is its own affair.
"""

from __future__ import annotations

import os
import sys
from _thread import get_ident
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from rsltrace.terminal import tell

if TYPE_CHECKING:
    from rsltrace.adapters.rclpy.stacks.runners import Stacks

_worlds: list[Stacks] = []


@contextmanager
def forked_children_end(stacks: Stacks) -> Iterator[None]:
    """Let what is forked within the ``with`` block end with the event that forked it."""
    _worlds.append(stacks)
    try:
        yield
    finally:
        _worlds.remove(stacks)


def _in_child() -> None:
    for stacks in _worlds:
        if stacks.event.handle is not None and stacks.runners.thread == get_ident():
            stacks.dispatcher.record(None)
            stacks.event.on_end = lambda stacks=stacks: _end(stacks)


def _end(stacks: Stacks) -> None:
    who = stacks.event.handle.describe() if stacks.event.handle is not None else "a node"
    with suppress(Exception):
        sys.stdout.flush()
        tell(
            f"rsltrace: note: a process that {who} forked came back into the run, and was ended; "
            "the run is its parent's"
        )
    os._exit(1)


os.register_at_fork(after_in_child=_in_child)
