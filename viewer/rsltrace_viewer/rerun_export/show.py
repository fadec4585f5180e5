"""Opening a recording in Rerun's viewer: as a window, or in a browser on this machine."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from pathlib import Path

from rsltrace.errors import SetupError
from rsltrace_viewer.rerun_export.sdk import LOOPBACK, viewer


class How(Enum):
    """Where a recording is opened."""

    WINDOW = "window"
    BROWSER = "browser"


def choose(*, spawn: bool, web: bool, output: Path | None) -> How | None:
    """Return where to open what is exported; None if it is only to be written.

    Raises SetupError if a window is wanted, or nothing was said, and there is no display.
    """
    if web:
        return How.BROWSER
    if spawn or output is None:
        check_display(
            "write a file with -o run.rrd and open it with `rerun run.rrd` where there is one, or "
            "use --web"
        )
        return How.WINDOW
    return None


def check_display(instead: str) -> None:
    """Raise SetupError, which says what to do ``instead``, if no window can be opened."""
    if not has_display(os.environ, sys.platform):
        raise SetupError(f"there is no display here to open Rerun's viewer on; {instead}")


def has_display(environ: Mapping[str, str], platform: str) -> bool:
    """Return whether a window can be opened."""
    if platform in ("darwin", "win32"):
        return True
    return bool(environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY"))


def command(recording: Path, how: How) -> list[str]:
    """Return the command line that opens a recording, bound to this machine either way."""
    line = [str(viewer()), "--bind", LOOPBACK, "--new", str(recording)]
    if how is How.BROWSER:
        # The server holds the recording for the browser; over 1 GB it would drop the beginning.
        return [*line, "--web-viewer", "--web-viewer-port", "0", "--server-memory-limit", "50%"]
    return line


@contextmanager
def temporary_recording() -> Iterator[Path]:
    """Give the path of a recording that goes away with the viewer that shows it."""
    with tempfile.TemporaryDirectory(prefix="rsltrace-") as folder:
        yield Path(folder) / "run.rrd"


def open_viewer(recording: Path, how: How) -> None:
    """Show a recording and wait until the viewer is closed (Ctrl-C closes a web viewer).

    Raises SetupError if the viewer fails.
    """
    process = subprocess.Popen(command(recording, how))
    try:
        status = process.wait()
    except KeyboardInterrupt:
        # The terminal sent it to the viewer as well; give it a moment to end by itself.
        process.wait(timeout=5)
        return
    if status:
        raise SetupError(f"Rerun's viewer ended with status {status}; see its message above")
