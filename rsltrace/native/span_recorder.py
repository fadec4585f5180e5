"""What callbacks do, in the order in which they began, whichever thread ran them.

A callback is one *span*, or several: where it awaits, or spins, another one runs in between. Spans
are kept in the order of their starts until all that began before is over, so that what caused a
callback always comes before it.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from types import FrameType

from rsltrace.native.observed_entities import ObservedEntity
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import EventFlag, EventKind

now_ns = time.monotonic_ns
_SUSPENDED = int(EventFlag.SUSPENDED)
_RAISED = int(EventFlag.RAISED)


@dataclass(slots=True)
class SentMessage:
    """A message, request or response that was sent. ``sequence`` is counted by its sender; it left
    between two times of the system clock. ``data`` is canonical CDR."""

    kind: int
    entity: ObservedEntity
    digest: int
    data: bytes
    sequence: int
    after_ns: int
    before_ns: int


@dataclass(slots=True)
class EmittedLog:
    """A log record, and the publisher of /rosout that it went to."""

    entity: ObservedEntity
    severity: int
    name: str
    text: str
    function: str
    file: str
    line: int


@dataclass(slots=True)
class CallbackError:
    """An exception that came out of a callback."""

    kind: str
    said: str
    traceback: str


@dataclass(slots=True)
class TaskCreation:
    """A task that was made."""


Output = SentMessage | EmittedLog | CallbackError | TaskCreation | Entity


@dataclass(slots=True)
class ReceivedInput:
    """What a callback got. ``source_ns`` and ``ready_ns`` are system clock; 0 where unknown.

    Of several messages that an action takes at once all but ``input_hash`` is of the first.
    ``gid`` is the publisher's, empty where the middleware was not asked.
    """

    entity: ObservedEntity
    digest: int = 0
    input_hash: int = 0
    channel: str = ""
    sequence: int = 0
    source_ns: int = 0
    ready_ns: int = 0
    observer_ns: int = 0
    gid: bytes = b""


@dataclass(slots=True)
class CallbackSpan:
    """A callback, or a part of it up to where something else ran. ``start_ns`` and ``end_ns`` are
    of the steady clock, ``wall_ns`` of the system clock; ``cause`` is a span and which of its
    outputs."""

    kind: int
    entity: ObservedEntity | None
    start_ns: int
    wall_ns: int
    thread: int
    owner: RunningCallback | None
    taken: ReceivedInput | None = None
    cause: tuple[CallbackSpan, int] | None = None
    flags: int = 0
    end_ns: int = 0
    observer_ns: int = 0
    outputs: list[Output] = field(default_factory=list)
    sending: int = 0
    """How many messages are being sent at the moment that will be its outputs."""
    index: int = -1
    """Which event of the trace it has become; -1 until then."""


@dataclass(slots=True)
class RunningCallback:
    """A callback under way. ``span`` is None while another one runs in its thread."""

    entity: ObservedEntity | None
    span: CallbackSpan | None = None


class Interrupts:
    """Ctrl-C in the main thread, which is held back within a ``with`` block, or from ``hold`` to
    ``release``. Other threads hold nothing back."""

    def __init__(self) -> None:
        self._main_thread = threading.main_thread().ident
        self._are_held = self._has_come = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Interrupt the main thread as Python does, but not before it may be."""
        if not self._are_held:
            raise KeyboardInterrupt
        self._has_come = True

    def hold(self) -> None:
        """Hold back what comes from now on."""
        if threading.get_ident() == self._main_thread:
            self._are_held = True

    def release(self) -> None:
        """Raise what has come meanwhile."""
        if threading.get_ident() == self._main_thread:
            self._are_held = False
            if self._has_come:
                self._has_come = False
                raise KeyboardInterrupt

    def __enter__(self) -> None:
        self.hold()

    def __exit__(self, *_: object) -> None:
        self.release()


class SpanRecorder:
    """Takes what happens, from any thread."""

    def __init__(self) -> None:
        self.interrupts = Interrupts()
        self._lock = threading.Lock()
        self._spans: deque[CallbackSpan] = deque()
        self._local = threading.local()
        self._threads = 0
        self.stacks: dict[int, list[RunningCallback]] = {}
        """What runs in each thread, the innermost callback last."""
        self.count = 0
        """How many spans are over."""
        self.activity_ns = 0
        """When something was last sent, steady."""
        self.until_ns = 0
        self.main: RunningCallback | None = None
        """The main of this process."""
        self.after_each: Callable[[], object] | None = None
        """Called after what a callback or a thread has sent, logged or made, and after its end."""

    def unlock(self) -> None:
        """Go on in a forked process, where no other thread gives the lock back."""
        self._lock = threading.Lock()
        self.after_each = None

    def now_ns(self) -> int:
        """Read the steady clock."""
        return now_ns()

    def time_ns(self) -> int:
        """Read the system clock."""
        return time.time_ns()

    def begin(
        self,
        kind: int,
        entity: ObservedEntity | None,
        taken: ReceivedInput | None = None,
        cause: tuple[CallbackSpan, int] | None = None,
    ) -> RunningCallback:
        """Note that a callback begins in this thread; what ran there is suspended."""
        stack = self._stack()
        if stack:
            self.cut(stack[-1])
        callback = RunningCallback(entity)
        stack.append(callback)
        with self._lock:
            callback.span = self._open(kind, entity, callback)
            callback.span.taken, callback.span.cause = taken, cause
            if taken is not None:
                callback.span.observer_ns = taken.observer_ns
        return callback

    def suspend(self) -> None:
        """Note that the callback awaits something, and goes on with ``resume``."""
        callback = self._stack().pop()
        self.cut(callback)

    def resume(self, callback: RunningCallback) -> None:
        """Note that a callback goes on that awaited something.

        It is an event once something comes of it: rclpy asks callbacks that wait again and again.
        """
        stack = self._stack()
        if stack:
            self.cut(stack[-1])
        stack.append(callback)

    def end(self, failure: CallbackError | None = None) -> None:
        """Note that the callback that runs in this thread is over."""
        if failure is not None:
            self.add(failure)
        with self.interrupts:
            with self._lock:
                callback = self._local.stack.pop()
                if callback.span is not None:
                    callback.span.flags |= _RAISED if failure is not None else 0
                    self._close(callback.span)
                    callback.span = None
            if self.after_each is not None:
                self.after_each()

    def add(self, output: Output, begun_ns: int = 0) -> tuple[CallbackSpan, int]:
        """Add an output of what runs in this thread; return where it is.

        Outside of all callbacks (a thread of the user's) it is an event of its own. ``begun_ns`` is
        when the observer began with it.
        """
        stack = self._stack()
        with self._lock:
            span = self._under_way(stack)
            if not stack:
                self._close(span)
            span.outputs.append(output)
            if begun_ns:
                span.observer_ns += self.now_ns() - begun_ns
            place = len(span.outputs) - 1
        if self.after_each is not None:
            self.after_each()
        return span, place

    def sending(self) -> CallbackSpan:
        """Return the event that is about to send something, which has begun then: whoever gets it
        at once, in another process, begins later. ``sent`` has to follow."""
        stack = self._stack()
        with self._lock:
            span = self._under_way(stack)
            span.sending += 1
            return span

    def sent(self, span: CallbackSpan, output: SentMessage | None, begun_ns: int = 0) -> None:
        """Add what an event has sent, None if sending it has failed."""
        with self._lock:
            span.sending -= 1
            if output is not None:
                span.outputs.append(output)
                self.activity_ns = self.now_ns()
                if begun_ns:
                    span.observer_ns += self.now_ns() - begun_ns
            if span.owner is None:
                self._close(span)
        if self.after_each is not None:
            self.after_each()

    def current(self) -> RunningCallback | None:
        """Return the callback that runs in this thread."""
        stack = self._stack()
        return stack[-1] if stack else None

    def finished(self, patience_ns: int | None) -> list[CallbackSpan]:
        """Take the spans before which all is over, in order.

        One that goes on for longer than ``patience_ns`` is cut in two: it must not keep all others
        from the file. None takes everything, as it is.
        """
        spans, self.until_ns = self.finished_until(patience_ns)
        return spans

    def finished_until(self, patience_ns: int | None) -> tuple[list[CallbackSpan], int]:
        """Return ``finished``, and the steady time before which no other span begins."""
        with self._lock:
            spans, taken = self._spans, []
            while spans:
                first = spans[0]
                if first.sending and patience_ns is not None:
                    break
                if not first.end_ns:
                    if patience_ns is not None and self.now_ns() - first.start_ns < patience_ns:
                        break
                    first.flags |= _SUSPENDED
                    self._close(first)
                    if first.owner is not None:
                        first.owner.span = None
                taken.append(spans.popleft())
            return taken, spans[0].start_ns if spans else self.now_ns()

    def _stack(self) -> list[RunningCallback]:
        try:
            stack: list[RunningCallback] = self._local.stack
        except AttributeError:
            stack = self._local.stack = self.stacks[threading.get_ident()] = []
            with self._lock:
                self._threads += 1
                self._local.thread = self._threads
        return stack

    def pause(self, entity: ObservedEntity | None = None) -> None:
        """Note that what runs in this thread waits, or only a main: what comes of it afterwards is
        another event."""
        stack = self._stack()
        if stack and entity in (None, stack[-1].entity):
            self.cut(stack[-1])

    def _under_way(self, stack: list[RunningCallback]) -> CallbackSpan:
        """Return what runs in this thread, which begins now if nothing has come of it so far."""
        if not stack:
            return self._open(int(EventKind.OUTSIDE), None, None)
        callback = stack[-1]
        if callback.span is None:
            callback.span = self._open(int(EventKind.RESUME), callback.entity, callback)
        return callback.span

    def cut(self, callback: RunningCallback) -> None:
        """Note, from any thread, that what comes of a callback from now on is another event."""
        with self._lock:
            if callback.span is not None:
                callback.span.flags |= _SUSPENDED
                self._close(callback.span)
                callback.span = None

    def _open(
        self, kind: int, entity: ObservedEntity | None, owner: RunningCallback | None
    ) -> CallbackSpan:
        span = CallbackSpan(kind, entity, self.now_ns(), self.time_ns(), self._local.thread, owner)
        self._spans.append(span)
        return span

    def _close(self, span: CallbackSpan) -> None:
        span.end_ns = self.now_ns()
        self.count += 1
