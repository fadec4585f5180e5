"""Where the command begins: to record, it starts once more, pinned, before anything is loaded."""

from __future__ import annotations

import gc
import signal
import sys
from typing import NoReturn

_ALLOCATIONS = 200_000
"""How many new objects Python looks at together for garbage: with its own 700, a sixth of what a
short command takes went into looking at modules that were being loaded."""


def main() -> NoReturn:
    """Run the command line and exit."""
    # Until there is something to close, Ctrl-C ends Python where it is, without a traceback.
    is_pythons = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_pythons:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from rsltrace.guard.pin import pin_recording

    pin_recording(sys.argv[1:])
    gc.set_threshold(_ALLOCATIONS)
    from rsltrace.cli.main import main as run_command

    if is_pythons:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run_command()
    raise AssertionError("it exits")
