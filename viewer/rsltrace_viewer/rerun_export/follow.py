"""A viewer of Rerun's that follows what somebody selects: a process of its own.

    python -m rsltrace_viewer.rerun_export.follow TRACE [OTHER]

exports the traces, opens the viewer, and then reads one JSON object per line from its standard
input: ``{"event": 812, "sim_time": 2500000000}``, for two traces with ``row`` in place of
``event``. The newest of them is where the cursor goes, on the timeline that the viewer shows. It
writes such lines as well: ``{"said": text}`` and, the last, ``{"failed": text}``. At the end of its
input, or of the viewer, all of it ends.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

from rsltrace.errors import RsltraceError, SetupError
from rsltrace_viewer.rerun_export.columns import EVENT, ROW
from rsltrace_viewer.rerun_export.control import Viewer, controlled

_STDIN, _STDOUT = 0, 1
_LOOK_S = 0.2
_PIECE_BYTES = 1 << 16


class Gone(Exception):
    """Nobody selects anything any more."""


class Selection:
    """What was selected last, as standard input says."""

    def __init__(self) -> None:
        self._latest: dict[str, int] | None = None
        self._rest = b""

    def look(self, wait_s: float = 0.0) -> None:
        """Read what has come, waiting for it if nothing has. Raises Gone."""
        while select.select([_STDIN], [], [], wait_s)[0]:
            data = os.read(_STDIN, _PIECE_BYTES)
            if not data:
                raise Gone
            *lines, self._rest = (self._rest + data).split(b"\n")
            if lines:
                self._latest = json.loads(lines[-1])
            wait_s = 0.0

    def take(self) -> dict[str, int] | None:
        """Return what has been selected since the last time, or None."""
        latest, self._latest = self._latest, None
        return latest


def follow(traces: list[str]) -> None:
    """Show traces in a viewer until there is nobody, or no viewer, any more.

    :raises SetupError: there can be none.
    """
    selection = Selection()
    with suppress(Gone), tempfile.TemporaryDirectory(prefix="rsltrace-") as folder:
        recording = Path(folder) / "run.rrd"
        _say(said="making a recording for Rerun …")
        _export(traces, recording, selection)
        with controlled(pause=selection.look) as viewer:
            _say(said="Rerun loads the recording …")
            viewer.open(recording)
            _say(said="Rerun follows the selected event")
            _move(viewer, selection, EVENT if len(traces) == 1 else ROW)


def _export(traces: list[str], recording: Path, selection: Selection) -> None:
    """Make a recording of traces, in another process, which ends when nobody waits for it.

    :raises SetupError: it cannot be made.
    """
    command = [sys.executable, "-m", "rsltrace", "rerun", *traces, "--by-event", "-q"]
    command += ["-o", str(recording)]
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=complaints
        )
        try:
            while process.poll() is None:
                selection.look(_LOOK_S)
        finally:
            process.kill()
            process.wait()
        if process.returncode:
            complaints.seek(0)
            lines = complaints.read().decode(errors="replace").splitlines()
            why = lines[-1].removeprefix("rsltrace: error: ") if lines else "no reason was given"
            raise SetupError(f"there is no recording for Rerun: {why}")


def _move(viewer: Viewer, selection: Selection, order: str) -> None:
    """Have the cursor follow the selection: at first in the order of events, as several have the
    same time, then on the timeline that is shown.

    :raises SetupError: the viewer has ended.
    """
    complained, first = "", order
    while viewer.status is None:
        selection.look(_LOOK_S)
        selected = selection.take()
        if selected is None:
            continue
        try:
            timeline = first or viewer.timeline()
            timeline = timeline if timeline in selected else order
            viewer.seek(timeline, selected[timeline])
            first = ""
        except (RuntimeError, OSError) as error:  # whatever its client raises, gRPC or not
            if viewer.status is None and str(error) != complained:
                complained = str(error)
                _say(said=f"Rerun does not follow: {complained}")
    how = f"has ended with status {viewer.status}" if viewer.status else "was closed"
    raise SetupError(f"Rerun's viewer {how}")


def _say(**what: str) -> None:
    try:
        os.write(_STDOUT, json.dumps(what).encode() + b"\n")
    except BrokenPipeError:
        raise Gone from None


def main() -> None:
    with suppress(Gone):
        try:
            follow(sys.argv[1:])
        except (RsltraceError, RuntimeError, OSError) as error:
            _say(failed=str(error))


if __name__ == "__main__":
    main()
