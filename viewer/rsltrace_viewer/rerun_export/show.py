"""Opening a recording in Rerun's viewer: as a window, or in a browser on this machine."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from urllib.parse import quote

from rsltrace.errors import SetupError
from rsltrace.terminal import say
from rsltrace_viewer.rerun_export.control import free_port
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
    if platform in ("darwin", "win32"):
        return True
    return bool(environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY"))


def command(recording: Path, ports: tuple[int, int] | None) -> list[str]:
    """Return the command line that opens a recording, bound to this machine either way: in a
    window, or for a browser, with the recording served at the first of two ``ports`` and the page
    at the second."""
    line = [str(viewer()), "--bind", LOOPBACK, str(recording)]
    if ports is None:
        return [*line, "--new"]
    data, page = map(str, ports)
    # The server holds the recording for the browser; over 1 GB it would drop the beginning.
    held = ("--server-memory-limit", "50%")
    return [*line, "--port", data, "--web-viewer", "--web-viewer-port", page, *held]


def address(ports: tuple[int, int]) -> str:
    """Return what a browser opens: the page, with the address of the recording."""
    data, page = ports
    return (
        f"http://{LOOPBACK}:{page}/?url={quote(f'rerun+http://{LOOPBACK}:{data}/proxy', safe='')}"
    )


@contextmanager
def temporary_recording() -> Iterator[Path]:
    """Give the path of a recording that goes away with the viewer that shows it."""
    with tempfile.TemporaryDirectory(prefix="rsltrace-") as folder:
        yield Path(folder) / "run.rrd"


def open_viewer(recording: Path, how: How) -> None:
    """Show a recording and wait until the viewer is closed (Ctrl-C closes a web viewer). Rerun
    opens a browser where it finds one, and does not say at which address: this does.

    Raises SetupError if the viewer fails.
    """
    ports = (free_port(), free_port()) if how is How.BROWSER else None
    process = subprocess.Popen(command(recording, ports))
    try:
        if ports is not None and _answers(process, ports[1]):
            say(f"open {address(ports)} in a browser on this machine; Ctrl-C ends it")
        status = process.wait()
    except KeyboardInterrupt:
        # The terminal sent it to the viewer as well; give it a moment to end by itself.
        process.wait(timeout=5)
        return
    if status:
        raise SetupError(f"Rerun's viewer ended with status {status}; see its message above")


def _answers(process: subprocess.Popen[bytes], port: int) -> bool:
    """Wait until the viewer serves its page; return False if it ends before."""
    while process.poll() is None:
        try:
            socket.create_connection((LOOPBACK, port), timeout=1).close()
        except OSError:
            time.sleep(0.05)
        else:
            return True
    return False
