"""A viewer of Rerun's that is started here and told what to show, over its gRPC service."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any

from rsltrace.errors import SetupError
from rsltrace.forking import die_with_parent
from rsltrace_viewer.rerun_export.sdk import LOOPBACK, require, require_control, viewer

LOADED_S_MAX = 120.0
_UP_S_MAX = 60.0
_END_S_MAX = 5.0
_TIME_MAX = 2**63 - 1


class Viewer:
    """A viewer that runs. ``client`` is Rerun's own; its calls raise RuntimeError, after 15 s at
    the latest."""

    def __init__(self, client: Any, process: subprocess.Popen[bytes]) -> None:
        self.client = client
        self._process = process
        self._recording: str | None = None

    @property
    def status(self) -> int | None:
        """How its process has ended, None while it runs."""
        return self._process.poll()

    def open(self, recording: Path) -> None:
        found = self.client.open(str(recording.absolute()))
        self._recording = next(iter(found.store_ids), None)

    def timeline(self) -> str | None:
        """Return the timeline on which the cursor is, None if there is none yet."""
        return next(
            (
                one.current_timeline
                for one in self.client.get_state().recordings
                if self._recording in (None, one.store_id)
            ),
            None,
        )

    def seek(self, timeline: str, value: int) -> None:
        """Move the cursor of the recording to an event, or a simulated time in nanoseconds.

        It stands still there.
        """
        # What Rerun's client calls a sequence is a number of whatever the timeline counts.
        self.client.set_time(
            timeline,
            sequence=min(value, _TIME_MAX),
            play_state="paused",
            recording=self._recording,
        )


@contextmanager
def controlled(*arguments: str, pause: Callable[[float], None] = time.sleep) -> Iterator[Viewer]:
    """Start a viewer, which ends with the ``with`` block; ``pause`` waits so many seconds.

    It listens at this machine's own address only, which ``ViewerClient.spawn`` cannot be told.

    :raises SetupError: it is missing, or does not start.
    """
    require_control()
    require()
    from rerun.experimental import ViewerClient

    port = free_port()
    with (
        tempfile.TemporaryDirectory(prefix="rsltrace-") as folder,  # for what it leaves behind
        tempfile.TemporaryFile() as complaints,
    ):
        process = subprocess.Popen(
            [
                *(str(viewer()), "--hide-welcome-screen"),
                *("--bind", LOOPBACK, "--port", str(port), *arguments),
            ],
            env=dict(os.environ, RERUN_APP_ONLY="true", TMPDIR=folder),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=complaints,
            preexec_fn=partial(die_with_parent, os.getpid()) if sys.platform == "linux" else None,
        )
        try:
            _wait_for(port, process, pause, complaints)
            yield Viewer(ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy"), process)
        finally:
            process.terminate()
            try:
                process.wait(_END_S_MAX)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait_for(
    port: int,
    process: subprocess.Popen[bytes],
    pause: Callable[[float], None],
    complaints: IO[bytes],
) -> None:
    """Wait until the viewer listens. Raises SetupError if it ends or does not come up."""
    until = time.monotonic() + _UP_S_MAX
    while process.poll() is None:
        try:
            socket.create_connection((LOOPBACK, port), timeout=1).close()
            return
        except OSError:
            if time.monotonic() > until:
                raise SetupError(f"Rerun's viewer does not answer within {_UP_S_MAX:g} s") from None
            pause(0.05)
    complaints.seek(0)
    lines = complaints.read().decode(errors="replace").splitlines()
    why = next((line.strip() for line in reversed(lines) if line.strip()), "it says no more")
    raise SetupError(
        f"Rerun's viewer ended with status {process.returncode} as it started ({why}); without a "
        "graphics driver it needs a software one (Debian: apt install mesa-vulkan-drivers)"
    )


def free_port() -> int:
    """Return a port of this machine's own address that nobody listens at."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])
