"""How an event is run and recorded.

``Dispatcher.execute`` is the middle of everything: each event of a run passes through it once. Keep
it small; what only some events need belongs elsewhere.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from rsltrace.errors import OutputError
from rsltrace.loop.loop import Dispatchable, EventLoop
from rsltrace.middleware.events.entity_book import EntityBook
from rsltrace.middleware.events.event import Door, Event, OutsideEvent, Owner
from rsltrace.middleware.events.outcome import Outcome
from rsltrace.model.event import NO_EVENT, EventKind, OutputKind
from rsltrace.model.operation import pack_operation
from rsltrace.trace.chain import hash64
from rsltrace.trace.recorder import Recorder


class Dispatcher:
    """Runs the callbacks of one run, one event at a time, and records what comes of them.

    ``recorder`` is None in a run that records nothing; ``unrecorded`` then counts the outputs of
    the event under way. ``door`` speaks for what belongs to no participant (construction, mains).
    """

    def __init__(self, loop: EventLoop) -> None:
        self.loop = loop
        self.event = Event()
        self.entities = EntityBook()
        self.outcome = Outcome()
        self.recorder: Recorder | None = None
        self.unrecorded = 0
        self.on_node: Callable[..., None] | None = None
        """Told which node's code is going to run (or ``is_made``), if somebody has to know."""
        self.on_resume: Callable[[], None] | None = None
        """Told, on its own stack, that a callback goes on after a wait, if somebody has to know."""
        self.door: Door

    def execute(
        self,
        handle: Dispatchable,
        entity: int,
        node: Owner | None,
        kind: int,
        callback: Callable[..., object],
        args: tuple[Any, ...],
        cause_event: int,
        cause_output: int,
        input_hash: int,
    ) -> None:
        """Run one event: call ``callback(*args)`` and record what came of it."""
        event = self.event
        event.handle = handle
        event.entity = entity
        event.node = node
        if self.on_node is not None:
            self.on_node(node)
        event.kind = kind
        event.cause_event = cause_event
        event.cause_output = cause_output
        event.input_hash = input_hash
        try:
            callback(*args)
        except BaseException as error:
            self._raised(error, handle)
        self.end_event()
        if event.on_end is not None:
            on_end, event.on_end = event.on_end, None
            on_end()

    def _raised(self, error: BaseException, handle: Dispatchable) -> None:
        """Let a door decide what becomes of an exception.

        :raises OutputError: the trace cannot be written; no event may be lost quietly.
        """
        if isinstance(error, OutputError):
            raise error
        node = self.event.node
        door: Door = self.door if node is None else node.door
        door.raised(error, handle)

    def end_event(self) -> None:
        """Record the event under way, which may be a later part of the one ``execute`` began."""
        if self.entities.pending:
            self.entities.settle(self.recorder)
        event = self.event
        loop = self.loop
        recorder = self.recorder
        node = event.node
        state_hash = 0
        if node is not None and node.state is not None:
            state_hash = node.state.after_event()
        if recorder is None:
            self.unrecorded = 0
        else:
            recorder.end_event(
                loop.now_ns,
                event.kind,
                event.flags,
                event.entity,
                event.cause_event,
                event.cause_output,
                event.input_hash,
                state_hash,
            )
        loop.events += 1
        event.flags = 0
        event.quiet = False

    def run_outside(
        self,
        handle: OutsideEvent,
        kind: EventKind,
        entity: int,
        node: Any,
        body: Callable[[], Any],
        cause: tuple[int, int] = (NO_EVENT, 0),
    ) -> None:
        """Run an event that is no entity's callback; most of them nothing in the run has caused."""
        self.execute(handle, entity, node, kind, body, (), *cause, 0)

    def in_callback(self) -> bool:
        """Return whether the event under way is a callback's, not a main's or a thread's."""
        return not isinstance(self.event.handle, OutsideEvent)

    def has_outputs(self) -> bool:
        """Return whether the event under way has had outputs."""
        outputs = self.unrecorded if self.recorder is None else self.recorder.outputs
        return bool(outputs or self.entities.pending)

    @contextlib.contextmanager
    def outside_events(self) -> Iterator[None]:
        """Run what belongs to no event (a stop function, finalizers): it cannot wait."""
        handle, self.event.handle = self.event.handle, None
        try:
            yield
        finally:
            self.event.handle = handle

    # -- outputs other than messages -----------------------------------------------------------

    def note(self, kind: OutputKind, entity: int, operation: int = 0, value: int = 0) -> int:
        """Add a small output (a timer changed, a task was made); return its position."""
        if self.recorder is None:
            self.unrecorded += 1
            return 0
        return self.recorder.output(kind, entity, hash64(pack_operation(operation, value)))

    def draw(self, entity: int, draw: int) -> None:
        """Write down what chance has decided, as an output of the event under way."""
        if self.recorder is not None:
            self.recorder.draw(entity, draw)
