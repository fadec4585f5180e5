"""The entry point of the command. To record, it restarts itself pinned before loading anything."""

from __future__ import annotations

import gc
import os
import signal
import sys

TYPE_CHECKING = False  # as in ``rsltrace``
if TYPE_CHECKING:
    from typing import NoReturn

_ALLOCATIONS = 200_000
"""Allocations between garbage collections. With Python's 700, a short command spent a sixth of its
time collecting while it imported modules."""

_ONLY_READS = frozenset("cat diff export fit history info latency view why".split())
"""Commands that run no nodes. They have no use for the threads that numpy's BLAS starts for each
core as it is loaded, and that spin before they sleep: a seventh of a short command's time."""


def main() -> NoReturn:
    # While modules load, Ctrl-C ends the process without a traceback.
    is_pythons = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_pythons:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from rsltrace.adapters.rclpy import boundary
    from rsltrace.guard.pin import THREAD_VARIABLES, pin_recording

    pin_recording(sys.argv[1:])
    if _ONLY_READS.intersection(sys.argv[1:2]):
        for name in THREAD_VARIABLES:
            os.environ.setdefault(name, "1")
    boundary.loads_extension = False
    gc.set_threshold(_ALLOCATIONS)
    from rsltrace.cli.main import main as run_command

    if is_pythons:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run_command()
    raise AssertionError("it exits")
