"""Where in user code things are sent, and which functions run: told to the trace once per place.

Looking at a caller costs as much as a tenth of an event, since the guard's audit hook is told of
each look. So the first outputs of each entity are looked at, later ones now and then.
"""

from __future__ import annotations

import sys
from types import CodeType, FrameType, FunctionType, MethodType
from typing import Any

from rsltrace.guard.callers import is_user_file, user_frame
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.interface import file_of, function_of
from rsltrace.trace.model.event import NO_SEQUENCE, CodeLine

_PLACES_MAX = 1000
"""Code may be made while a program runs, ever anew: no more places of one entity are told."""
_LOOKS_FIRST = 32
_STRIDE = 256
"""So many outputs are looked at first, of each callback that sends some; then about every 256th."""


class CallSites:
    """The places from which one entity sends.

    Who sends compares how often it has sent with ``due`` and the entity whose callback is running
    with ``running``, and calls ``look`` where one of them says so.
    """

    __slots__ = ("_dispatcher", "_entity", "_looks", "_told", "due", "running")

    def __init__(self, dispatcher: Dispatcher, entity: int) -> None:
        self._dispatcher = dispatcher
        self._entity = entity
        self._told: set[tuple[int, str, int, int]] = set()
        self._looks: dict[int, int] = {}
        self.due = 0
        self.running = -1

    def look(self, sent: int) -> None:
        """Take note of who calls rclpy's method that has called ours, its ``sent``-th call."""
        running = self._dispatcher.event.entity
        looks = self._looks[running] = self._looks.get(running, 0) + 1
        is_due = sent == self.due
        if looks < _LOOKS_FIRST:
            self.due = sent + 1
        elif is_due:  # uneven steps, as callbacks may go round in even ones
            self.due = sent + _STRIDE // 2 + sent * 7919 % _STRIDE
        self.running = running
        if looks <= _LOOKS_FIRST or is_due:
            self._look(sys._getframe(3), running)
        if looks == _LOOKS_FIRST and (recorder := self._dispatcher.recorder) is not None:
            _record_line(self._dispatcher, self._entity, recorder.outputs, "", "")

    def _look(self, frame: FrameType, running: int) -> None:
        recorder = self._dispatcher.recorder
        found = frame if is_user_file(frame.f_code.co_filename) else _caller(frame)
        if recorder is None or found is None:
            return
        code = found.f_code
        key = running, code.co_filename, found.f_lineno, found.f_lasti  # hashing code takes long
        if key not in self._told and len(self._told) < _PLACES_MAX:
            self._told.add(key)
            output = recorder.outputs
            _record_code(
                self._dispatcher, self._entity, code, found.f_globals, found.f_lineno, output
            )


_address = object.__hash__  # as id(), but no audit hook is told of it; nor of __code__, if need be


class FunctionRecorder:
    """The functions of the user's that events run beside the callbacks of their entities."""

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._dispatcher = dispatcher
        self._known: dict[tuple[int, int], object] = {}  # by id: hashing code takes long
        self._told: set[tuple[int, CodeType]] = set()
        self._met = 0

    def run(self, entity: int, callback: Any, args: tuple[Any, ...] = ()) -> None:
        """Take note that the event under way runs a function for ``entity``.

        It may be given to a function of rclpy's in ``args``.
        """
        plain = callback.__func__ if type(callback) is MethodType else callback
        is_plain = type(plain) is FunctionType and not args
        if is_plain and (
            (entity, _address(plain)) in self._known
            or (entity, _address(plain.__code__)) in self._known
        ):
            return
        self._met += 1
        if self._met > _LOOKS_FIRST and self._met % _STRIDE:
            return
        for one in (callback, *args):
            found = function_of(one)
            if is_plain and len(self._known) < _PLACES_MAX:
                # A decorator's function has one code, whatever it decorates.
                is_itself = found is not None and found[0] is plain.__code__
                kept = plain.__code__ if is_itself else plain
                self._known[entity, _address(kept)] = kept
                if plain.__closure__ is None:  # found at once, and keeps nothing alive
                    self._known[entity, _address(plain)] = plain
            if found is not None and is_user_file(found[0].co_filename):
                self._record_function(entity, *found)
                return

    def _record_function(self, entity: int, code: CodeType, names: Any) -> None:
        if (entity, code) not in self._told and len(self._told) < _PLACES_MAX:
            self._told.add((entity, code))
            _record_code(self._dispatcher, entity, code, names, code.co_firstlineno, NO_SEQUENCE)


def _record_code(
    dispatcher: Dispatcher, entity: int, code: CodeType, names: Any, line: int, output: int
) -> None:
    if code.co_filename[:1] != "<":
        name = getattr(code, "co_qualname", code.co_name)  # from Python 3.11 on
        _record_line(dispatcher, entity, output, f"{file_of(code, names)}:{line}", name)


def _record_line(dispatcher: Dispatcher, entity: int, output: int, place: str, name: str) -> None:
    recorder = dispatcher.recorder
    if recorder is not None:
        told = CodeLine(recorder.index, entity, output, place, name)
        recorder.code_line(told, dispatcher.loop.now_ns)


def _caller(frame: FrameType) -> FrameType | None:
    """Return the user's frame that called rclpy or a library, None if only the run itself did."""
    above: FrameType | None = frame
    while above is not None and str(above.f_globals.get("__name__")).startswith("rclpy."):
        above = above.f_back
    return user_frame(above, frozenset())
