"""Threads that take turns at lines of user code: ``threads: {switch: every_line}`` of a job.

Before each line of the user's own code the loop's policy is asked whether the callback goes on, or
something else does that natively could run at the same time: another thread of its process, or a
callback that an executor of it would run beside this one. In the second case the callback gives way
as one that blocks does, except that it waits for nothing but its turn.

Python tells of lines by ``sys.monitoring`` (3.12 and later) or ``sys.settrace``. While it does, it
tells of no more lines, on no stack, until the function it has called returns; that is put off for
as long as others run by ``sys.call_tracing``.
"""

from __future__ import annotations

import os
import sys
from _thread import get_ident
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CodeType, FrameType
from typing import Any

from greenlet import getcurrent

from rsltrace.adapters.rclpy.stacks.blocking_calls import getpid, wait
from rsltrace.adapters.rclpy.stacks.callback_groups import exclusive_group, is_busy, is_custom
from rsltrace.adapters.rclpy.stacks.mailbox import mailbox_of
from rsltrace.adapters.rclpy.stacks.runtime import BlockedCall, Runtime
from rsltrace.adapters.rclpy.stacks.threads import SimThread
from rsltrace.errors import EXIT_RUN, RunError
from rsltrace.guard.callers import KINDS, USER, is_in
from rsltrace.simulation.loop.ordered import OrderedLoop, Place
from rsltrace.simulation.loop.policy import Candidate
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.observer import EventCall, EventObserver, ObserverOrder
from rsltrace.simulation.middleware.interface import file_of
from rsltrace.trace.model.event import CodeLine, Draw, encode_draw

_OURS = os.path.dirname(os.path.dirname(os.path.dirname(os.path.dirname(__file__)))) + os.sep
_CALLS_BACK = os.path.join(_OURS, "simulation", "middleware", "events", "dispatcher.py")
_ADAPTER = os.path.join(_OURS, "adapters", "rclpy", "")
_IN_BETWEEN = (
    *(os.path.join(_ADAPTER, name, "") for name in ("handles", "executors", "actions", "stacks")),
    os.path.join(_OURS, "run", "plans", "main_programs.py"),
)
"""What may lie between a callback and whoever calls it."""
_CALLBACK_GROUPS = os.path.join(_ADAPTER, "stacks", "callback_groups.py")
_INTERFACES = ("msg", "srv", "action")
_TOOLS = range(5, -1, -1)
_NAME = "rsltrace: switches between threads"


class LineSwitches:
    """Asks at lines of the user's own code who goes on.

    ``packages`` are those of the job's nodes, which are the user's even where they are installed.
    """

    def __init__(self, stacks: Runtime, loop: OrderedLoop, packages: frozenset[str]) -> None:
        self._stacks = stacks
        self._loop = loop
        self._packages = packages
        self._event = stacks.event
        self._owned: dict[str, bool] = {}

    def owns(self, frame: FrameType) -> bool:
        """Return whether a frame's file is of the user's own code."""
        file = frame.f_code.co_filename
        owned = self._owned.get(file)
        if owned is None:
            owned = self._owned[file] = self._is_owned(frame, file)
        return owned

    def _is_owned(self, frame: FrameType, file: str) -> bool:
        folder, name = os.path.split(file)
        if file[:1] == "<" or (name[:1] == "_" and os.path.basename(folder) in _INTERFACES):
            return False  # made by Python or rosidl
        return KINDS[file] == USER or (bool(self._packages) and is_in(frame, self._packages))

    def at_line(self, frame: FrameType, line: int) -> None:
        """Let somebody else go on before a line, if the policy says so."""
        if not self._may_ask():
            return
        places = self._others()
        if not places or not _is_callback(frame):
            return
        event, runners = self._event, self._stacks.runners
        node = "" if event.node is None else event.node.fully_qualified_name
        thread = runners.number_of(getcurrent())
        present = Candidate(node, "", "resume", event.entity, None, (), None, thread)
        try:
            choice = self._loop.choose([present, *(place.candidate for place in places)])
        except RunError as error:  # which is not for user code to catch
            runners.error = error
            self._loop.stop(Stop("the run failed", EXIT_RUN))
            return
        if choice:
            self._loop.run_next(places[choice - 1])
            sys.call_tracing(self._give_way, (frame, line))

    def _may_ask(self) -> bool:
        """Return whether a callback is under way in the loop that could be set aside."""
        stacks, event = self._stacks, self._event
        if get_ident() != stacks.runners.thread or not self._loop.has_begun:
            return False
        if event.handle is None or event.entity == 0 or self._loop.stopped is not None:
            return False
        ending = stacks.ending
        is_ending = ending.unwinding or ending.closing or stacks.programs.present.ended
        return not is_ending and getpid() == stacks.runners.process

    def _give_way(self, frame: FrameType, line: int) -> None:
        dispatcher, event = self._stacks.dispatcher, self._event
        recorder, output = dispatcher.recorder, 0
        if recorder is not None:
            output = recorder.outputs
            code = frame.f_code
            name = getattr(code, "co_qualname", code.co_name)  # from Python 3.11 on
            place = f"{file_of(code, frame.f_globals)}:{line}"
            recorder.code_line(CodeLine(recorder.index, 0, output, place, name), self._loop.now_ns)
        dispatcher.draw(event.entity, encode_draw(Draw.SWITCH, line))
        event.quiet = False
        wait(self._stacks, "its turn", until=lambda blocked: blocked.give_way(output))

    # -- who else could run ------------------------------------------------------------------------

    def _others(self) -> list[Place]:
        places = self._loop.runnable()
        if not places:
            return places
        event = self._event
        process = self._process(self._stacks.programs.present, event.node)
        wrapper: Any = getattr(event.handle, "wrapper", None)
        group = exclusive_group(getattr(wrapper, "callback_group", None))
        return [one for one in places if self._overlaps(one.candidate.item, process, group)]

    def _overlaps(self, item: Any, process: object, group: object | None) -> bool:
        """Return whether an item could run natively while a callback of a process does that keeps a
        mutually exclusive group (or None) busy."""
        if isinstance(item, BlockedCall):
            return process is not None and self._process(item.program, item.event[2]) is process
        if isinstance(item, SimThread):
            return process is not None and self._process(item.program, item.node) is process
        node, wrapper = getattr(item, "node", None), getattr(item, "wrapper", None)
        own = getattr(wrapper, "callback_group", None)
        if node is None or own is None or is_custom(own) or process is None:
            return False
        if self._process(getattr(node, "process", None), node) is not process:
            return False
        if own is group or is_busy(own, wrapper) or not getattr(item, "queue", True):
            return False
        mailbox = mailbox_of(item)
        if mailbox is None:
            return True
        driver: Any = mailbox.driver
        return driver is not None and bool(driver.waits or driver.standby)

    def _process(self, program: object, node: Any) -> object | None:
        """Return what would be the process natively: a program, or one entry of the host's nodes,
        None if nobody knows which."""
        if program is not self._stacks.programs.host:
            return program
        return getattr(node, "entry", None)


def _is_callback(frame: FrameType) -> bool:
    """Return whether a frame runs for a callback (a main, a thread), and nothing in between would
    mind others: no import, no finalizer, nothing that the run asks of user code for itself."""
    above: FrameType | None = frame
    while above is not None:
        code = above.f_code
        file = code.co_filename
        if file == _CALLS_BACK:
            return True
        if code.co_name in ("__del__", "<module>") or file.startswith("<frozen importlib"):
            return False
        if file == _CALLBACK_GROUPS or (
            file.startswith(_OURS) and not file.startswith(_IN_BETWEEN)
        ):
            return False
        above = above.f_back
    return False


@contextmanager
def switches_at_lines(
    stacks: Runtime, loop: OrderedLoop, packages: frozenset[str]
) -> Iterator[None]:
    """Ask at every line of user code who goes on, within the ``with`` block."""
    from weakref import WeakKeyDictionary

    stacks.runners.numbers = WeakKeyDictionary()
    switches = LineSwitches(stacks, loop, packages)
    watched = _monitored if sys.version_info >= (3, 12) else _traced
    with watched(stacks, switches):
        yield


@contextmanager
def _monitored(stacks: Runtime, switches: LineSwitches) -> Iterator[None]:
    monitoring: Any = sys.monitoring  # type: ignore[attr-defined,unused-ignore]
    tool = next((one for one in _TOOLS if monitoring.get_tool(one) is None), None)
    if tool is None:
        raise RunError(
            "threads: {switch: every_line} needs one of the six tools of sys.monitoring, and others"
            " have them all"
        )
    disable = monitoring.DISABLE

    def on_line(code: CodeType, line: int) -> object:
        frame = sys._getframe(1)
        if not switches.owns(frame):
            return disable
        switches.at_line(frame, line)
        return None

    monitoring.use_tool_id(tool, _NAME)
    try:
        monitoring.restart_events()
        monitoring.register_callback(tool, monitoring.events.LINE, on_line)
        monitoring.set_events(tool, monitoring.events.LINE)
        yield
    finally:
        monitoring.set_events(tool, 0)
        monitoring.register_callback(tool, monitoring.events.LINE, None)
        monitoring.free_tool_id(tool)


@contextmanager
def _traced(stacks: Runtime, switches: LineSwitches) -> Iterator[None]:
    before = sys.gettrace()

    def on_line(frame: FrameType, what: str, argument: object) -> Any:
        if what == "line":
            switches.at_line(frame, frame.f_lineno)
        return on_line

    def on_call(frame: FrameType, what: str, argument: object) -> Any:
        return on_line if switches.owns(frame) else None

    tracing = _TraceSetter(on_call)
    stacks.dispatcher.add_observer(tracing)
    try:
        yield
    finally:
        stacks.dispatcher.remove_observer(tracing)
        sys.settrace(before)


class _TraceSetter(EventObserver):
    """Traces each event anew: whether a stack is traced is kept with it."""

    order = ObserverOrder.LINE_SWITCHES

    def __init__(self, on_call: Callable[[FrameType, str, object], Any]) -> None:
        self._on_call = on_call

    def before_event(self, call: EventCall) -> bool:
        """Have what the event calls traced."""
        sys.settrace(self._on_call)
        return True
