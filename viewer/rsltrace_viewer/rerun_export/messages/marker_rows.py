"""Markers, logged: each at the time and event of its message, and gone when its life is over."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from rsltrace_viewer.rerun_export.columns import EVENT, SIM_TIME, Clock
from rsltrace_viewer.rerun_export.frames import FrameTree
from rsltrace_viewer.rerun_export.messages.markers import MarkerBoard
from rsltrace_viewer.rerun_export.paths import join


class MarkerRows:
    """Logs the markers of one run, a row at a time: they are of many kinds, and few."""

    def __init__(
        self,
        label: str,
        start_ns: int,
        clock: Clock,
        recording: rr.RecordingStream,
        frames: FrameTree,
    ) -> None:
        """``start_ns`` is that of the run; ``frames`` takes note of where markers are."""
        self._label = label
        self._start_ns = start_ns
        self._clock = clock
        self._recording = recording
        self._frames = frames
        self._boards: dict[str, MarkerBoard] = {}
        self._expiring: dict[str, int] = {}
        self._shown_in: dict[str, str] = {}

    def log(self, path: str, message: dict[str, Any], stamp_ns: int, event: int) -> None:
        """Log what a message on the topic at ``path`` changes."""
        board = self._boards.setdefault(path, MarkerBoard())
        for change in board.changes(message, stamp_ns):
            at = path + join(*change.parts)
            self._expire(at, stamp_ns)
            if change.what is not None:
                if change.frame:
                    self._note_frame(at, change.frame)
                self._set_time(stamp_ns)
                self._recording.set_time(EVENT, sequence=event)
                self._recording.log(at, change.what)
                self._log_frame(at)
            if change.expires_ns is not None:
                self._expiring[at] = change.expires_ns
        self._recording.reset_time()

    def end(self, end_ns: int) -> None:
        """Clear the markers whose life ended before the run did."""
        for path in list(self._expiring):
            self._expire(path, end_ns + 1)
        self._recording.reset_time()

    def _expire(self, path: str, before_ns: int) -> None:
        """Clear a marker whose life ended before it was replaced. No event does that, so it is on
        the timeline of simulated time only."""
        expires_ns = self._expiring.pop(path, None)
        if expires_ns is not None and expires_ns < before_ns:
            self._recording.reset_time()
            self._set_time(expires_ns)
            self._recording.log(path, rr.Clear(recursive=False))
            self._log_frame(path)

    def _note_frame(self, path: str, frame: str) -> None:
        first = path not in self._shown_in
        self._shown_in[path] = frame
        if first:
            self._frames.frames[path] = frame
            self._frames.drawn.add(path)
            self._set_time(self._start_ns)
            self._recording.set_time(EVENT, sequence=0)
            self._log_frame(path)

    def _log_frame(self, path: str) -> None:
        """Log in which frame a marker is; once more after clearing it, or a view would complain
        that the nothing that is left is in no frame."""
        frame = self._shown_in.get(path)
        if frame is not None:
            name = f"{self._label}/{frame}" if self._label else frame
            self._recording.log(path, rr.CoordinateFrame(frame=name))

    def _set_time(self, stamp_ns: int) -> None:
        if self._clock.dated:
            self._recording.set_time(SIM_TIME, timestamp=np.datetime64(stamp_ns, "ns"))
        else:
            self._recording.set_time(SIM_TIME, duration=np.timedelta64(stamp_ns, "ns"))
