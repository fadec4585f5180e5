"""Where the command begins: to record, it starts once more, pinned, before anything is loaded."""

from __future__ import annotations

import sys
from typing import NoReturn

from rsltrace.guard.pin import pin_recording


def main() -> NoReturn:
    """Run the command line and exit."""
    pin_recording(sys.argv[1:])
    from rsltrace.cli.main import main as run_command

    run_command()
    raise AssertionError("it exits")
