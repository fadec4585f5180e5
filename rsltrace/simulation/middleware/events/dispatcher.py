"""How an event is run and recorded.

Each event of a run passes through ``Dispatcher.execute`` once. Keep it small; what only some runs
need is an observer (``observer.py``).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Protocol

from rsltrace.compiled import core
from rsltrace.errors import OutputError
from rsltrace.simulation.loop.loop import Dispatchable, EventLoop
from rsltrace.simulation.middleware.events.event import (
    CurrentEvent,
    EventOwner,
    ExceptionHandler,
    NameRegistry,
    OutsideEvent,
    RunOutcome,
)
from rsltrace.simulation.middleware.events.observer import (
    EventCall,
    EventObserver,
    ObserverOrder,
    overrides,
)
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import NO_EVENT, EventKind, OutputKind
from rsltrace.trace.model.operation import pack_operation
from rsltrace.trace.recorder import Recorder


class Recordable(Protocol):
    """Something with an id in the trace. ``announced``: it is recorded when it is created."""

    announced: bool

    def settle(self) -> bool:
        """Return whether its owner is known by now."""

    def entity(self) -> Entity:
        """Return it as the trace describes it."""


class EntityRegistry:
    """Assigns entity ids, and keeps new entities until they can be recorded.

    ``pending`` were created in the current event, ``unowned`` have no owner yet (a timer that no
    node lists). ``census`` has the run's names if needed; ``observers`` see each entity.
    """

    def __init__(self) -> None:
        self.pending: list[Recordable] = []
        self.unowned: list[Recordable] = []
        self.census: NameRegistry | None = None
        self.observers: tuple[EventObserver, ...] = ()
        self._count = 0

    def new_id(self) -> int:
        """Return the next entity id; 0 is the run itself."""
        self._count += 1
        return self._count

    def settle(self, recorder: Recorder | None) -> None:
        """Record the entities of this event whose owners are known."""
        waiting, self.unowned = self.unowned, []
        created = [*waiting, *self.pending]
        self.pending.clear()
        for one in created:
            if not one.settle():
                self.unowned.append(one)
            elif one.announced and (recorder is not None or self.observers):
                entity = one.entity()
                if recorder is not None:
                    recorder.entity(entity)
                for observer in self.observers:
                    observer.entity_created(entity)

    def look_again(self, node: Any) -> None:
        """Record the unowned entities that turn out to be ``node``'s."""
        if self.unowned:  # a timer made long before its node is spun is written down now
            waiting, self.unowned = self.unowned, []
            for one in waiting:
                owned = getattr(one, "node", None) is node
                (self.pending if owned else self.unowned).append(one)


class PythonEventEnd:
    """How an event runs and ends. The compiled module has an equal class."""

    loop: EventLoop
    event: CurrentEvent
    entities: EntityRegistry
    recorder: Recorder | None
    unrecorded: int
    _pending: list[Recordable]
    _before: tuple[EventObserver, ...]
    _after: tuple[EventObserver, ...]
    ask_and_execute: Callable[..., None]
    _call_back: Callable[..., None]
    _call_back_with: Callable[..., None]

    def execute(
        self,
        handle: Dispatchable,
        entity: int,
        node: EventOwner | None,
        kind: int,
        callback: Callable[..., object],
        args: tuple[Any, ...],
        cause_event: int,
        cause_output: int,
        input_hash: int,
        is_decided: int = False,
    ) -> None:
        """Run one event: call ``callback(*args)`` and record what came of it. ``is_decided``: the
        observers have already been asked."""
        if self._before and not is_decided:
            self.ask_and_execute(
                handle, entity, node, kind, callback, args, cause_event, cause_output, input_hash
            )
            return
        event = self.event
        event.handle = handle
        event.entity = entity
        event.node = node
        event.kind = kind
        event.cause_event = cause_event
        event.cause_output = cause_output
        event.input_hash = input_hash
        if len(args) == 1:
            self._call_back_with(self, handle, callback, args[0])
        else:
            self._call_back(self, handle, callback, args)
        self.end_event()
        if event.on_end is not None:
            on_end, event.on_end = event.on_end, None
            on_end()

    def end_event(self) -> None:
        """Record the current event, possibly a later part of the one ``execute`` began."""
        if self._pending:
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
        if self._after:
            for observer in self._after:
                observer.after_event()


EventEnd = PythonEventEnd
if core is not None and not TYPE_CHECKING:
    EventEnd = core.EventEnd


class Dispatcher(EventEnd):
    """Runs the callbacks of a run, one event at a time, and records the results.

    ``recorder`` is None in an unrecorded run; ``unrecorded`` then counts the outputs of the event.
    ``exception_handler`` handles exceptions of what belongs to no participant (construction,
    mains). Whoever resumes a callback has to call ``resume_observers`` and ``node_observers``.
    """

    def __init__(self, loop: EventLoop) -> None:
        self.loop = loop
        self.event = CurrentEvent()
        self.entities = EntityRegistry()
        self.outcome = RunOutcome()
        self.recorder: Recorder | None = None
        self.unrecorded = 0
        self.exception_handler: ExceptionHandler
        self._pending = self.entities.pending
        self._call_back = Dispatcher.call_back  # compiled code finds it here faster
        self._call_back_with = Dispatcher.call_back_with
        self._observers: list[EventObserver] = []
        self._before: tuple[EventObserver, ...] = ()
        self._after: tuple[EventObserver, ...] = ()
        self.resume_observers: tuple[EventObserver, ...] = ()
        self.node_observers: tuple[EventObserver, ...] = ()

    def record(self, recorder: Recorder | None) -> None:
        """Record with ``recorder`` from now on; None: record nothing."""
        self.recorder = recorder
        if recorder is not None:
            recorder.tell([one.output for one in self._with("output")])

    def add_observer(self, observer: EventObserver) -> None:
        """Add an observer, in the place given by its ``order``."""
        assert all(one is not observer for one in self._observers), "it is there already"
        self._observers.append(observer)
        self._observers.sort(key=lambda one: one.order)  # stable
        self._choose_observers()

    def remove_observer(self, observer: EventObserver) -> None:
        self._observers = [one for one in self._observers if one is not observer]
        self._choose_observers()

    def _choose_observers(self) -> None:
        """List the observers of each hook: hooks without observers cost nothing."""
        self._before = self._with("before_event")[::-1]
        self._after = self._with("after_event")
        self.resume_observers = self._with("resumed")
        self.node_observers = self._with("node_entered")
        self.entities.observers = self._with("entity_created")
        self.record(self.recorder)

    @property
    def is_steered(self) -> bool:
        """Whether somebody may change events, or keep them from running: edits, a debugger."""
        return any(one.order >= ObserverOrder.EDITS for one in self._observers)

    def _with(self, hook: str) -> tuple[EventObserver, ...]:
        return tuple(one for one in self._observers if overrides(one, hook))

    def _accepted_by_observers(self, call: EventCall) -> bool:
        """Ask observers before an event; the first that rejects it is the last one asked."""
        return all(observer.before_event(call) for observer in self._before)

    def ask_and_execute(self, *values: Any) -> None:
        """Run one event unless an observer rejects it."""
        call = EventCall(*values)
        if self._accepted_by_observers(call):
            self.execute(*call.values(), True)
        call.end()

    def call_back(
        self, handle: Dispatchable, callback: Callable[..., object], args: tuple[Any, ...]
    ) -> None:
        """Call a callback. Compiled or not, who looks at a stack finds this frame above it."""
        try:
            if args:
                callback(*args)
            else:
                callback()  # Python calls it without leaving the interpreter's loop
        except BaseException as error:
            self._raised(error, handle)

    def call_back_with(
        self, handle: Dispatchable, callback: Callable[..., object], argument: object
    ) -> None:
        """Call a callback with one argument, as nearly all have: that is faster."""
        try:
            callback(argument)
        except BaseException as error:
            self._raised(error, handle)

    def _raised(self, error: BaseException, handle: Dispatchable) -> None:
        """Let the exception handler decide what happens next."""
        if isinstance(error, OutputError):
            raise error
        node = self.event.node
        exception_handler: ExceptionHandler = (
            self.exception_handler if node is None else node.exception_handler
        )
        exception_handler.raised(error, handle)

    def run_outside(
        self,
        handle: OutsideEvent,
        kind: EventKind,
        entity: int,
        node: Any,
        body: Callable[[], Any],
        cause: tuple[int, int] = (NO_EVENT, 0),
    ) -> None:
        """Run an event that is not an entity's callback."""
        self.execute(handle, entity, node, kind, body, (), *cause, 0)

    def in_callback(self) -> bool:
        return not isinstance(self.event.handle, OutsideEvent)

    def has_outputs(self) -> bool:
        outputs = self.unrecorded if self.recorder is None else self.recorder.outputs
        return bool(outputs or self._pending)

    @contextlib.contextmanager
    def outside_events(self) -> Iterator[None]:
        """Run code that belongs to no event (a stop function, finalizers); it cannot wait."""
        handle, self.event.handle = self.event.handle, None
        try:
            yield
        finally:
            self.event.handle = handle

    def note(self, kind: OutputKind, entity: int, operation: int = 0, value: int = 0) -> int:
        """Add a small output (a timer changed, a task was made); return its position."""
        if self.recorder is None:
            self.unrecorded += 1
            return 0
        return self.recorder.output(kind, entity, hash64(pack_operation(operation, value)))

    def draw(self, entity: int, draw: int) -> None:
        """Record a random draw as an output of the current event."""
        if self.recorder is not None:
            self.recorder.draw(entity, draw)
