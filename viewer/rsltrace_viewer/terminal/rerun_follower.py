"""Telling a viewer of Rerun's what is selected: it is driven by a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread

_END_S_MAX = 15.0
"""The viewer gets a moment to end; then whatever is left of it ends with the process."""


class RerunFollower:
    """Has Rerun's cursor follow; ``start`` begins, ``close`` ends all of it."""

    def __init__(self, traces: Sequence[Path]) -> None:
        self._traces = traces
        self._process: subprocess.Popen[bytes] | None = None
        self._closing = False

    def start(self, say: Callable[[str, bool], None]) -> None:
        """Begin. ``say`` is called in a thread, with what there is to know, and whether that is
        the end of it."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rsltrace_viewer.rerun_export.follow", *map(str, self._traces)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is not for it
        )
        assert self._process.stdin is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        Thread(target=self._listen, args=(self._process, say), daemon=True).start()

    def select(self, event: int, stamp_ns: int) -> None:
        """Have the cursor go to an event, or its simulated time, without waiting for it."""
        if self._process is not None and self._process.stdin is not None:
            line = json.dumps({"event": event, "sim_time": stamp_ns}) + "\n"
            with suppress(OSError):  # it has ended, and has said so
                os.write(self._process.stdin.fileno(), line.encode())

    def close(self) -> None:
        """End the viewer and what drives it."""
        self._closing = True
        if self._process is None:
            return
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(_END_S_MAX)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _listen(self, process: subprocess.Popen[bytes], say: Callable[[str, bool], None]) -> None:
        assert process.stdout is not None
        failed = ""
        with process.stdout, suppress(RuntimeError):  # the screen may be gone
            for line in process.stdout:
                found = json.loads(line)
                failed = found.get("failed", "")
                if not failed:
                    say(found["said"], False)
            if not self._closing:
                say(f"{failed or 'Rerun has ended'}; the selection is no longer followed", True)
