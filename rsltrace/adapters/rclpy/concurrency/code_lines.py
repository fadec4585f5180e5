"""Records the lines of user code that send, and the functions that run, once per line.

Looking up a caller costs a tenth of an event, because the guard's audit hook sees it. So it is done
for the first outputs of each entity, and then now and then.
"""

from __future__ import annotations

import sys
from types import CodeType, FrameType, FunctionType, MethodType
from typing import Any

from rsltrace.compiled import SitesFields
from rsltrace.guard.callers import is_user_file, user_frame
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.interface import callback_code, imported_file
from rsltrace.trace.model.event import NO_SEQUENCE, CodeLine

_PLACES_MAX = 1000
"""The most lines recorded per entity: a program may generate code without end."""
_LOOKUPS_FIRST = 32
_STRIDE = 256
"""Callers are looked up for the first 32 outputs of each callback; then for about every 256th."""


class CallSites(SitesFields):
    """The lines from which one entity sends.

    The sender calls ``look`` if its count equals ``due``, or if the entity whose callback runs is
    not ``running``.
    """

    def __init__(self, dispatcher: Dispatcher, entity: int) -> None:
        self._dispatcher = dispatcher
        self._entity = entity
        self._recorded: set[tuple[int, str, int, int]] = set()
        self._lookups: dict[int, int] = {}
        self.due = 0
        self.running = -1

    def look(self, sent: int) -> None:
        """Record the caller of the rclpy method that has called ours the ``sent``-th time."""
        running = self._dispatcher.event.entity
        lookups = self._lookups[running] = self._lookups.get(running, 0) + 1
        is_due = sent == self.due
        if lookups < _LOOKUPS_FIRST:
            self.due = sent + 1
        elif is_due:  # uneven steps, as callbacks may repeat in even ones
            self.due = sent + _STRIDE // 2 + sent * 7919 % _STRIDE
        self.running = running
        if lookups <= _LOOKUPS_FIRST or is_due:
            self._look(sys._getframe(3), running)
        if lookups == _LOOKUPS_FIRST and (recorder := self._dispatcher.recorder) is not None:
            _record_line(self._dispatcher, self._entity, recorder.outputs, "", "")

    def _look(self, frame: FrameType, running: int) -> None:
        recorder = self._dispatcher.recorder
        found = frame if is_user_file(frame.f_code.co_filename) else _caller(frame)
        if recorder is None or found is None:
            return
        code = found.f_code
        key = running, code.co_filename, found.f_lineno, found.f_lasti  # hashing code takes long
        if key not in self._recorded and len(self._recorded) < _PLACES_MAX:
            self._recorded.add(key)
            output = recorder.outputs
            _record_code(
                self._dispatcher, self._entity, code, found.f_globals, found.f_lineno, output
            )


_address = object.__hash__  # as id(), but without an audit event


class FunctionRecorder:
    """Records functions of user code that run beside the callbacks of entities."""

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._dispatcher = dispatcher
        self._known: dict[tuple[int, int], object] = {}  # by id: hashing code takes long
        self._recorded: set[tuple[int, CodeType]] = set()
        self._calls = 0

    def run(self, entity: int, callback: Any, args: tuple[Any, ...] = ()) -> None:
        """Record that the current event runs a function for ``entity``; the function may be in
        ``args`` of one of rclpy's."""
        plain = callback.__func__ if type(callback) is MethodType else callback
        is_plain = type(plain) is FunctionType and not args
        if is_plain and (
            (entity, _address(plain)) in self._known
            or (entity, _address(plain.__code__)) in self._known
        ):
            return
        self._calls += 1
        if self._calls > _LOOKUPS_FIRST and self._calls % _STRIDE:
            return
        for one in (callback, *args):
            found = callback_code(one)
            if is_plain and len(self._known) < _PLACES_MAX:
                # All functions of a decorator have the same code.
                is_itself = found is not None and found[0] is plain.__code__
                kept = plain.__code__ if is_itself else plain
                self._known[entity, _address(kept)] = kept
                if plain.__closure__ is None:  # quick to find, and keeps nothing alive
                    self._known[entity, _address(plain)] = plain
            if found is not None and is_user_file(found[0].co_filename):
                self._record_function(entity, *found)
                return

    def _record_function(self, entity: int, code: CodeType, names: Any) -> None:
        if (entity, code) not in self._recorded and len(self._recorded) < _PLACES_MAX:
            self._recorded.add((entity, code))
            _record_code(self._dispatcher, entity, code, names, code.co_firstlineno, NO_SEQUENCE)


def _record_code(
    dispatcher: Dispatcher, entity: int, code: CodeType, names: Any, line: int, output: int
) -> None:
    if code.co_filename[:1] != "<":
        name = getattr(code, "co_qualname", code.co_name)  # from Python 3.11 on
        _record_line(dispatcher, entity, output, f"{imported_file(code, names)}:{line}", name)


def _record_line(dispatcher: Dispatcher, entity: int, output: int, place: str, name: str) -> None:
    recorder = dispatcher.recorder
    if recorder is not None:
        line = CodeLine(recorder.index, entity, output, place, name)
        recorder.code_line(line, dispatcher.loop.now_ns)


def _caller(frame: FrameType) -> FrameType | None:
    """Return the frame of user code that called rclpy or a library, None if there is none."""
    above: FrameType | None = frame
    while above is not None and str(above.f_globals.get("__name__")).startswith("rclpy."):
        above = above.f_back
    return user_frame(above, frozenset())
