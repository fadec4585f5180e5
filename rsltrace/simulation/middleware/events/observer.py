"""How others watch and steer a run: one protocol, in one order.

Everything except the recorder that watches events or decides about them is an observer of the
dispatcher: edits, the debugger, faults, execution times, the comparison with a recording.
``Dispatcher.add_observer`` and ``remove_observer`` are the only ways in and out. An observer is
called only for the hooks that its class overrides, so unused hooks cost nothing.

Rejected: replacing methods of the dispatcher. The order would depend on the order of construction,
and restoring an old method would remove later replacements.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from enum import IntEnum
from typing import Any

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.entity import Entity


class ObserverOrder(IntEnum):
    """The order of observers. Before an event the last is asked first: the others see what the
    debugger and the edits decide. All other hooks are called first to last."""

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


@dataclass(eq=False, slots=True)
class EventCall:
    """An event that is about to run; an observer may change it.

    ``on_end`` are called after the event, the last one first, on its stack; also if a later
    observer rejects the event.
    """

    handle: Any
    entity: int
    node: Any
    kind: int
    callback: Callable[..., object]
    args: tuple[Any, ...]
    cause_event: int
    cause_output: int
    input_hash: int
    on_end: list[Callable[[], None]] = field(default_factory=list)

    def values(self) -> ExecuteArguments:
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
        for ended in reversed(self.on_end):
            ended()


class EventObserver:
    """Watches the events of a run, or steers them. ``order`` says when it is called."""

    order: ObserverOrder

    def before_event(self, call: EventCall) -> bool:
        """Look at an event before it runs; return whether it runs."""
        raise NotImplementedError

    def after_event(self) -> None:
        """Look at the event that has ended (``Dispatcher.event``). A callback that waits makes
        several events."""
        raise NotImplementedError

    def resumed(self) -> None:
        """Look at a callback that resumes after a wait, on its own stack."""
        raise NotImplementedError

    def node_entered(self, node: Any, *, is_made: bool) -> None:
        """Note that a node's code resumes, or that a node ``is_made``."""
        raise NotImplementedError

    def entity_created(self, entity: Entity) -> None:
        """Note an entity, at the end of the event that created it."""
        raise NotImplementedError

    def output(self, kind: int, entity: int, content_hash: int) -> None:
        """Note an output of the current event; only in recorded runs."""
        raise NotImplementedError


def overrides(observer: EventObserver, hook: str) -> bool:
    return getattr(type(observer), hook) is not getattr(EventObserver, hook)
