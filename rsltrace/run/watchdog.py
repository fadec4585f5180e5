"""Warn about a callback that does not return: which one, and at which line it is.

Simulated time stands still during a callback, so an endless one would hang a run in silence. A
thread looks every two seconds of real time whether anything has happened. It interrupts a callback
that goes on after a signal has ended the run: ``timeout`` and ``docker stop`` send only one.

It must not influence the run. So it touches nothing but numbers as long as all is well, and keeps
no object of the run alive between looks: addresses decide the order of some sets. It counts its
looks instead of reading a clock, so a suspended process or machine causes no alarm.
"""

from __future__ import annotations

import ctypes
import os
import sys
from _thread import allocate_lock, start_new_thread
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from types import FrameType
from typing import TYPE_CHECKING

from rsltrace.guard.callers import in_import, is_user_file
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.terminal import tell
from rsltrace.trace.model.texts import format_seconds

if TYPE_CHECKING:
    from rsltrace.simulation.middleware.domain import Domain

LOOK_EVERY_S = 2.0
_LOOKS_BEFORE_NOTE = 5
_LOOKS_BETWEEN_NOTES = 30
_LOOKS_BEFORE_END = 3
"""Some five seconds after a signal: docker kills after ten."""
_LOOKS_MAX = 250
"""Longer is not counted. (Python keeps one object of each number up to this forever.)"""

_FRAMES_MAX = 100
"""So many of our own at most: those of a recursion are too many to look at."""

_JOIN_S = 1.0
_raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc
_NO_PACKAGES: frozenset[str] = frozenset()
_DEBUGGERS = ("/pdb.py", "/bdb.py", "/pudb/", "/ipdb/", "/IPython/", "/pydevd", "/debugpy/")


class Watchdog:
    """Watches one run, from a thread of its own."""

    def __init__(self, domain: Domain, thread: int) -> None:
        self._domain = domain
        self._thread = thread
        self._process = os.getpid()
        self.has_warned = False
        """Whether a note on the current callback was printed."""
        self.signal = 0
        """The signal that has ended the run, until its callback was interrupted for that."""
        self._running = False
        self._stopping = allocate_lock()
        self._ended = allocate_lock()

    @contextmanager
    def on_duty(self) -> Iterator[None]:
        ready = allocate_lock()
        for lock in (self._stopping, self._ended, ready):
            lock.acquire()
        start_new_thread(self._look, (ready,))
        ready.acquire()
        try:
            yield
        finally:
            self._stopping.release()
            if os.getpid() == self._process:
                self._ended.acquire(timeout=_JOIN_S)  # it may be stuck in printing

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Expect events within the ``with`` block."""
        self._running = True
        try:
            yield
        finally:
            self._running = False

    def _look(self, ready: object) -> None:
        seen = array("q", (-1, -1))
        still, since_note, ending = 0, _LOOKS_BETWEEN_NOTES, 0
        ready.release()  # type: ignore[attr-defined]
        del ready
        while not self._stopping.acquire(timeout=LOOK_EVERY_S):
            loop = self._domain.loop
            if self._running and loop.events == seen[0] and loop.now_ns == seen[1]:
                still = min(still + 1, _LOOKS_MAX)
            else:
                seen[0], seen[1] = loop.events, loop.now_ns
                still, self.has_warned = 0, False
            del loop
            if self.signal and still:
                ending += 1
                if ending >= _LOOKS_BEFORE_END and not self._is_handling_error():
                    self.signal = 0  # once
                    if not self.has_warned:
                        with suppress(Exception):
                            self._tell(int(still * LOOK_EVERY_S))
                    # Not as a signal: ``timeout`` has sent two, and the third would kill.
                    _raise_in(ctypes.c_ulong(self._thread), ctypes.py_object(KeyboardInterrupt))
            since_note = min(since_note + 1, _LOOKS_BETWEEN_NOTES)
            if still >= _LOOKS_BEFORE_NOTE and since_note == _LOOKS_BETWEEN_NOTES:
                with suppress(Exception):
                    if self._tell(int(still * LOOK_EVERY_S)):
                        since_note, self.has_warned = 0, True
        self._ended.release()

    def _is_handling_error(self) -> bool:
        """Whether the callback is over already: what it raised is described, which takes seconds
        after a deep recursion. (Another exception would leave the trace without its end.)"""
        frames = islice(_frames(sys._current_frames().get(self._thread)), _FRAMES_MAX)
        return any(frame.f_code is Dispatcher._raised.__code__ for frame in frames)

    def _tell(self, for_s: int) -> bool:
        """Report where the run is; return whether there was anything to report."""
        domain = self._domain
        frames = list(_frames(sys._current_frames().get(self._thread)))
        if any(part in frame.f_code.co_filename for frame in frames for part in _DEBUGGERS):
            return False  # a debugger stands still on purpose
        if frames and in_import(frames[0], _NO_PACKAGES):
            return False  # importing a large library takes time
        in_event = any(frame.f_code in _CALLS for frame in frames)
        handle = domain.event.handle if in_event else None
        who = "the run, outside of any callback," if handle is None else handle.describe()
        where = _place(frames)
        if process := _process_asked(frames):
            who, where = f"{process}, in {who},", ""
        tell(
            f"rsltrace: note: {who} has not returned for {for_s} s of real time; simulated time "
            f"stands still at {format_seconds(domain.loop.stamp)} s{where}. Ctrl-C ends the run"
        )
        return True


_CALLS = (Dispatcher.call_back.__code__, Dispatcher.call_back_with.__code__)


def _frames(frame: FrameType | None) -> Iterator[FrameType]:
    while frame is not None:
        yield frame
        frame = frame.f_back


def _process_asked(frames: Iterable[FrameType]) -> str:
    """Name the process that the run waits for, or ""."""
    adapter = sys.modules.get("rsltrace.adapters.processes.process")  # not loaded: there is none
    if adapter is None:
        return ""
    asks = adapter.Process._converse.__code__
    asked = next((f.f_locals["self"] for f in frames if f.f_code is asks), None)
    return "" if asked is None else f"process {asked.name} (pid {asked.child.pid})"


def place_of(thread: int | None) -> str:
    """Say at which line of the user's code a thread is, to follow a sentence."""
    return _place(list(_frames(sys._current_frames().get(thread or 0))))


def _place(frames: Sequence[FrameType]) -> str:
    for frame in [*(f for f in frames if is_user_file(f.f_code.co_filename)), *frames[:1]]:
        return f", now at {frame.f_code.co_filename}:{frame.f_lineno} in {frame.f_code.co_name}"
    return ""
