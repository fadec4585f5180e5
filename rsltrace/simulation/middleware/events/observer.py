"""How others watch and steer a run: one protocol, in one order.

Everything but the recorder that has to know of events, or decides about them, is an observer of the
dispatcher: edits, the debugger, faults, execution times, the comparison with a recording.
``Dispatcher.add_observer`` and ``remove_observer`` are the only ways in and out. An observer is
called for the hooks that its class overrides and for no others, so a run without observers pays for
none, and one with an observer of events pays nothing at each output.

Rejected: letting each of them replace methods of the dispatcher. Then the order is whatever the
order of construction happens to be, and whoever puts an old method back removes what came later.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any

from rsltrace.simulation.loop.loop import Dispatchable
from rsltrace.trace.model.entity import Entity


class ObserverOrder(IntEnum):
    """Who comes first. Before an event the last is asked first: what the debugger and the edits
    decide is what the others see. After an event, and at everything else, the first is told first:
    the recorder has written the event down before anybody looks at it."""

    RECORDER = 0
    """No observer, but where it stands: the dispatcher calls it without asking."""
    VERIFICATION = 1
    """Whether the event was as recorded: it may end the recording."""
    CENSUS = 2
    STATE_SAMPLES = 3
    LINE_SWITCHES = 4
    GENERATORS = 5
    """The states of random generators that belong to nodes."""
    RECORDED_ORDER = 6
    """Whether the run follows the order of a recording."""
    RATES = 7
    EXECUTION_TIMES = 8
    FAULTS = 9
    SCRIPT = 10
    """The recorded events that one node is fed with."""
    OUTPUTS = 11
    """Whether the outputs of one node were as recorded."""
    EDITS = 12
    DEBUGGER = 13


ExecuteArguments = tuple[Any, int, Any, int, Callable[..., object], tuple[Any, ...], int, int, int]


class EventCall:
    """An event that is about to run; an observer may change what runs.

    ``on_end`` are called once it is over, the last one first: on the stack that it ran on, after
    ``after_event``, and also if a later observer decides that it does not happen.
    """

    __slots__ = (
        "args",
        "callback",
        "cause_event",
        "cause_output",
        "entity",
        "handle",
        "input_hash",
        "kind",
        "node",
        "on_end",
    )

    def __init__(
        self,
        handle: Dispatchable,
        entity: int,
        node: Any,
        kind: int,
        callback: Callable[..., object],
        args: tuple[Any, ...],
        cause_event: int,
        cause_output: int,
        input_hash: int,
    ) -> None:
        self.handle: Any = handle
        self.entity = entity
        self.node = node
        self.kind = kind
        self.callback = callback
        self.args = args
        self.cause_event = cause_event
        self.cause_output = cause_output
        self.input_hash = input_hash
        self.on_end: list[Callable[[], None]] = []

    def values(self) -> ExecuteArguments:
        """Return what ``Dispatcher.execute`` takes."""
        return (
            self.handle,
            self.entity,
            self.node,
            self.kind,
            self.callback,
            self.args,
            self.cause_event,
            self.cause_output,
            self.input_hash,
        )

    def end(self) -> None:
        """Call all of ``on_end``."""
        for ended in reversed(self.on_end):
            ended()


class EventObserver:
    """Watches the events of a run, or steers them. ``order`` says when it is called."""

    order: ObserverOrder

    def before_event(self, call: EventCall) -> bool:
        """Look at an event before it runs; return whether it happens."""
        raise NotImplementedError

    def after_event(self) -> None:
        """Look at the event that has ended; ``Dispatcher.event`` still describes it. A callback
        that waits makes several events of one call."""
        raise NotImplementedError

    def resumed(self) -> None:
        """Look at a callback that goes on after a wait, on its own stack."""
        raise NotImplementedError

    def node_entered(self, node: Any, *, is_made: bool) -> None:
        """Take note that the code of a node goes on (after a wait), or that a node ``is_made``."""
        raise NotImplementedError

    def entity_created(self, entity: Entity) -> None:
        """Take note of an entity, at the end of the event that created it."""
        raise NotImplementedError

    def output(self, kind: int, entity: int, content_hash: int) -> None:
        """Take note of an output of the event under way. Of a run that is recorded only."""
        raise NotImplementedError


def overrides(observer: EventObserver, hook: str) -> bool:
    """Return whether an observer has a hook of its own."""
    return getattr(type(observer), hook) is not getattr(EventObserver, hook)
