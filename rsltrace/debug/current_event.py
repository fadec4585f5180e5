"""The event that is about to run, or has just ended, as conditions see it."""

from __future__ import annotations

import inspect
import os
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from types import CodeType, FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

from rsltrace.adapters.rclpy.concurrency.coroutines import TaskRun
from rsltrace.adapters.rclpy.concurrency.threads import SimThread
from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.adapters.rclpy.messages.interfaces import get_message_class
from rsltrace.checks.conditions.view import SentOutput
from rsltrace.trace.format import EVENT_REST
from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.words.logs import parse_log
from rsltrace.trace.words.phrases import exception_of

if TYPE_CHECKING:
    from rsltrace.debug.event_history import EventLedger, Payload
    from rsltrace.run.session import RunSession

_LINES_MAX = 400
_FLAGS = 10
_SUSPENDED = int(EventFlag.SUSPENDED)
_PYTHON = os.path.dirname(threading.__file__) + os.sep
_PACKAGES = f"{os.sep}site-packages{os.sep}"


def code_of(callback: Any) -> CodeType | None:
    """Return the Python code of a callback, or None."""
    callback = getattr(callback, "func", callback)
    callback = inspect.unwrap(getattr(callback, "__func__", callback))
    code = getattr(callback, "__code__", None)
    return code if isinstance(code, CodeType) else None


def source(view: CurrentEventView, ledger: EventLedger) -> dict[str, Any] | None:
    """Return file, first line, name and lines of the user function of the current event.

    ``at`` is the line where it waits or is about to resume, else None.
    """
    frame = _frame(view) if _is_inside(view, ledger) else None
    code = code_of(_function(view)) if frame is None else frame.f_code
    if code is None or not is_users(code):
        return None
    try:
        lines, first = inspect.getsourcelines(code)
    except (OSError, TypeError):
        lines, first = [], code.co_firstlineno
    return {
        "file": code.co_filename,
        "line": max(first, 1),  # 0: a whole file
        "name": getattr(code, "co_qualname", code.co_name),
        "lines": [line.rstrip("\n") for line in lines[:_LINES_MAX]],
        "at": None if frame is None else frame.f_lineno,
    }


def _function(view: CurrentEventView) -> Any:
    """Return the called function; for the construction of a node, its constructor."""
    if view.kind == EventKind.CONSTRUCT:
        made = view.nodes().get(view.node or view.entity_name)
        return None if made is None else type(made).__init__
    return view.call.callback


def _is_inside(view: CurrentEventView, ledger: EventLedger) -> bool:
    """Whether the run stands inside the callback: it waits, or is about to resume."""
    if view.is_next:
        return view.kind == EventKind.RESUME
    return bool(ledger.rest) and bool(EVENT_REST.unpack(ledger.rest)[_FLAGS] & _SUSPENDED)


def _frame(view: CurrentEventView) -> FrameType | None:
    """Return the innermost user frame, on this stack or in the coroutine."""
    if view.call.task is not None:
        found = None
        coroutine = view.call.task.task._handler
        while (frame := getattr(coroutine, "cr_frame", None)) is not None:
            found = frame if is_users(frame.f_code) else found
            coroutine = coroutine.cr_await
        return found
    here: FrameType | None = sys._getframe()
    while here is not None and not is_users(here.f_code):
        here = here.f_back
    return here


def is_users(code: CodeType) -> bool:
    """Whether code is the user's: not Python's, rclpy's or rsltrace's."""
    file = code.co_filename
    if file.startswith(("<frozen", *_between())):
        return False
    return not file.startswith(_PYTHON) or _PACKAGES in file


@cache
def _between() -> tuple[str, ...]:
    """Return the folders of rsltrace and rclpy."""
    import rclpy

    import rsltrace

    return tuple(os.path.dirname(str(one.__file__)) + os.sep for one in (rsltrace, rclpy))


class CallbackCall(NamedTuple):
    """What an event calls, with its arguments; ``task`` runs it if it is a coroutine."""

    callback: Any
    args: tuple[Any, ...]
    task: TaskRun | None = None


NO_CALL = CallbackCall(None, ())


class CurrentEventView:
    """The ``EventView`` of a run: the event that has just ended, or (``is_next``) is about to run.

    One object serves the whole run. ``call`` is the function that the event calls.
    """

    def __init__(self, session: RunSession, ledger: EventLedger) -> None:
        self.start_ns = session.start_ns
        self._domain = session.world.domain
        self._event = self._domain.event
        self._ledger = ledger
        self.is_next = False
        self.call = NO_CALL

    @property
    def stamp_ns(self) -> int:
        return self._domain.loop.now_ns

    def nodes(self) -> Mapping[str, object]:
        """Return the nodes by name, also those that no executor spins yet."""
        found = {}
        for handle in self._domain.graph.nodes:
            node = getattr(handle, "made", None)
            if node is not None:
                found[handle.key] = node
        return found

    @property
    def index(self) -> int:
        return self._ledger.events - (not self.is_next)

    @property
    def kind(self) -> int:
        return self._event.kind

    @property
    def entity(self) -> int:
        return self._event.entity

    @property
    def entity_name(self) -> str:
        entity = self._ledger.entities.get(self._event.entity)
        return entity.name if entity is not None else ""

    @property
    def entity_kind(self) -> str:
        entity = self._ledger.entities.get(self._event.entity)
        return entity.kind.label if entity is not None and entity.id else ""

    @property
    def node(self) -> str:
        """The full name of its node, or ""."""
        node = self._event.node
        if self._event.kind == EventKind.RESUME:  # a main is no node's, whichever it has made
            entity = self._ledger.entities.get(self._event.entity)
            if entity is not None and not entity.node:
                return ""
        return "" if node is None else str(node.fully_qualified_name)

    @property
    def output_hash(self) -> int:
        return 0 if self.is_next else self._ledger.output_hash

    def received(self) -> tuple[str, object] | None:
        """Return (topic or service, message) of its input, or None; for a callback that resumes,
        the input it began with."""
        message = self.call.args[0] if self.call.args else None
        if not hasattr(message, "get_fields_and_field_types"):
            return None
        return self.entity_name, message

    def sent(self) -> Sequence[SentOutput]:
        if self.is_next:
            return ()
        return [self._sent(*output) for output in self._ledger.outputs_of_last()]

    def _sent(
        self, kind: int, entity_id: int, content_hash: int, kept: Payload | str | None
    ) -> SentOutput:
        entity = self._ledger.entities.get(entity_id)
        name = entity.name if entity is not None else ""
        if isinstance(kept, str):
            return SentOutput(kind, name, content_hash, exception_of(kept))
        if kept is None:
            return SentOutput(kind, name, content_hash)
        if kind == OutputKind.LOG:
            record = parse_log(kept[1])
            return SentOutput(kind, name, content_hash, record.text, record.level)
        type_name = self._ledger.channels[kept[0]][1]
        return SentOutput(kind, name, content_hash, message=partial(_decoded, type_name, kept[1]))

    def findings(self) -> Sequence[str]:
        return () if self.is_next else [one.source.value for one in self._ledger.findings]

    def __repr__(self) -> str:
        if self.index < 0:
            return "nothing has run yet"
        node, kind = self.node and f"{self.node}: ", EventKind(self.kind).label
        what = f"{node}{kind} {self.entity_name}".rstrip()
        return f"event {self.index}  {format_seconds(self.stamp_ns - self.start_ns)}  {what}"


def call_of(callback: Any, args: tuple[Any, ...]) -> CallbackCall:
    """Return the user function that an event calls; a task calls a coroutine."""
    task = getattr(callback, "__self__", None)
    if isinstance(task, SimThread) and task.thread is not None:
        thread: Any = task.thread
        return CallbackCall(getattr(thread, "_target", None) or thread.run, ())
    return (
        CallbackCall(*task.called, task)
        if isinstance(task, TaskRun)
        else CallbackCall(callback, args)
    )


def _decoded(type_name: str, data: bytes) -> object:
    decode: Callable[[bytes], object] = codec_for(get_message_class(type_name)).deserialize
    return decode(data)
