"""The event under way: whose code runs, what caused it, and how it will be recorded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rsltrace.simulation.loop.loop import Dispatchable
from rsltrace.trace.model.event import NO_EVENT


class Door(Protocol):
    """Speaks for participants: it is asked for what only it can know of their code."""

    def raised(self, error: BaseException, handle: Dispatchable) -> None:
        """Decide what becomes of the run now that the event under way has raised ``error``."""


class State(Protocol):
    """The state of a participant, where it is hashed after each of its events."""

    def after_event(self) -> int:
        """Return its hash now, 0 if there is none."""


class Owner(Protocol):
    """A participant as those see it who record what its code does."""

    entity_id: int
    fully_qualified_name: str
    state: State | None
    door: Door


class Event:
    """The event under way. There is one object of it, which each event fills anew.

    What it sends leaves ``busy_ns`` later (execution times), and its executor is busy for
    ``took_ns``. A ``quiet`` event is recorded only if something comes of it. ``on_end`` is called
    once it is over. ``node`` is a participant (an ``Owner``), whose door may know more of it.
    """

    __slots__ = (
        "busy_ns",
        "cause_event",
        "cause_output",
        "entity",
        "flags",
        "handle",
        "input_hash",
        "kind",
        "node",
        "on_end",
        "quiet",
        "took_ns",
    )

    def __init__(self) -> None:
        self.handle: Dispatchable | None = None
        self.entity = 0
        self.node: Any = None
        self.kind = 0
        self.cause_event = NO_EVENT
        self.cause_output = 0
        self.input_hash = 0
        self.flags = 0
        self.quiet = False
        self.on_end: Callable[[], None] | None = None
        self.busy_ns = 0
        self.took_ns = 0


class OutsideEvent:
    """Stands for a handle in an event that is no entity's callback: construction, shutdown, a clock
    jump, a main, a thread."""

    def __init__(self, describe: Callable[[], str]) -> None:
        self.describe = describe

    def dispatch(self) -> None:
        """Fail: the loop never has it in a queue."""
        raise AssertionError("never in a queue")
