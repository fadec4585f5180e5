"""One executable of a job: its ``main``, and what a process of its own would have.

All mains of a job run in one process. What rclpy and Python keep per process (the default context,
the global executor, ``sys.argv``, ``sys.path``, ``sys.stdin``, the module ``__main__``) is
exchanged whenever the loop goes over to another main, so each finds its own. The nodes that the job
itself constructs share one program, the host.
"""

from __future__ import annotations

import builtins
import sys
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from types import ModuleType
from typing import Any, Protocol

from greenlet import greenlet

from rsltrace.adapters.rclpy.entry import Entry
from rsltrace.simulation.middleware.events.failure import Raised
from rsltrace.simulation.middleware.interface import source_of
from rsltrace.trace.model.entity import Entity, EntityKind

_FAILURES_MAX = 16
"""A main may go on after each of a million exceptions; what ends it is one of the last."""

ExitHandler = tuple[Callable[..., object], tuple[Any, ...], dict[str, Any]]
"""What ``atexit.register`` was given."""


class ProgramContext(Protocol):
    """A context that a program has initialized."""

    def ok(self) -> bool:
        """Return whether it has not been shut down."""

    def end(self) -> None:
        """Shut down from outside, as a signal does."""


class SimulatedPrograms:
    """The processes in the simulation. ``present`` is the one whose code runs, ``host`` that of the
    nodes which the job constructs, ``all`` are those with a main.

    ``constructing`` is the entry under construction; while modules are ``importing``, what they
    make belongs to the run, too. The shutdown of ``main_context`` ends the run. ``fed`` says that
    messages come from outside (bags). ``to_come`` are the keys of entries that will start while the
    run goes on; ``listeners`` are called with "started" or "ended" and an entry's key.
    """

    def __init__(self) -> None:
        self.places = _places()
        self.host = SimulatedProgram(self)
        self.present = self.host
        self.all: list[SimulatedProgram] = []
        self.constructing: Entry | None = None
        self.importing = False
        self.main_context: ProgramContext | None = None
        self.fed = False
        self.to_come: list[str] = []
        self.listeners: list[Callable[[str, str], None]] = []
        self.stdin_of: Callable[[SimulatedProgram], Any] = lambda program: sys.stdin
        """Returns the ``sys.stdin`` that a program begins with."""
        self.on_enter: Callable[[SimulatedProgram], None] | None = None
        """Told which program's code is going to run, if somebody has to know."""

    def tell(self, what: str, key: str) -> None:
        """Say in the event under way that an entry has "started" or "ended"."""
        for listener in self.listeners:
            listener(what, key)

    def on_stack(self, stack: greenlet) -> SimulatedProgram | None:
        """Return the program whose main runs on a stack, if it is one's."""
        return next((program for program in self.all if program.stack is stack), None)

    @property
    def is_hosted(self) -> bool:
        """Whether the code that runs is that of nodes which the job constructs."""
        return self.present is self.host

    def leave(self) -> None:
        """Go back to the host."""
        if self.present is not self.host:
            self.host.enter()


class SimulatedProgram:
    """A process in the simulation: one main, or the host of the nodes a job constructs."""

    def __init__(self, programs: SimulatedPrograms, entry: Entry | None = None) -> None:
        self._programs = programs
        self.entry = entry
        self.name = "the run" if entry is None else entry.name
        self.label = self.name if entry is None else entry.key or entry.name
        """What notes call it: entries of one target have numbers."""
        arguments = [] if entry is None else entry.arguments
        self.ros_words = [word for part in arguments[:1] for word in part.arguments]
        """What the job adds to the ROS arguments of every ``rclpy.init`` of this program."""
        self.parameters = arguments[1:]
        """The job's own parameters, which come after those of all files."""
        self.entity_id = 0
        self.begun_ns: int | None = None
        self.announced = True
        self.contexts: list[ProgramContext] = []
        self.failures: deque[Raised] = deque(maxlen=_FAILURES_MAX)
        """What callbacks have raised out of a spin of this program, most recent last."""
        self.exit_handlers: list[ExitHandler] = []
        self.signal_handlers: dict[int, object] = {}
        self.stack: greenlet | None = None
        self.spun = False
        """Whether an executor of this program has looked for work."""
        self.ended = False
        self.held: list[Any] | None = None
        """What would run of it if it did not hang; of one that has crashed nothing ever does."""
        self.exit_code = 0
        self._kept: tuple[Any, ...] | None = None

    # -- what a process has of its own -----------------------------------------------------------

    def enter(self) -> None:
        """Make this the program that runs: whoever ran before puts its things away."""
        programs = self._programs
        before, programs.present = programs.present, self
        kept = self._kept
        if kept is None:
            kept = self._first_values()
        system, modules, rclpy, utilities, context, loops = programs.places
        # Every callback of a main comes by here twice, so there is no loop.
        before._kept = (
            system["argv"],
            system["path"],
            system["stdin"],
            modules["__main__"],
            rclpy["__executor"],
            utilities["g_default_context"],
            context["g_logging_ref_count"],
            loops["_event_loop_policy"],
        )
        (
            system["argv"],
            system["path"],
            system["stdin"],
            modules["__main__"],
            rclpy["__executor"],
            utilities["g_default_context"],
            context["g_logging_ref_count"],
            loops["_event_loop_policy"],
        ) = kept
        if programs.on_enter is not None:
            programs.on_enter(self)

    def _first_values(self) -> tuple[Any, ...]:
        """Return what a process begins with."""
        argv = None if self.entry is None else self.entry.argv
        main = ModuleType("__main__")
        vars(main).update(__builtins__=builtins, __annotations__={})
        return argv, list(sys.path), self._programs.stdin_of(self), main, None, None, 0, None

    # -- its life --------------------------------------------------------------------------------

    def describe(self) -> str:
        return self.name

    def settle(self) -> bool:
        """Return whether the owner is known: a main has none."""
        return True

    def entity(self) -> Entity:
        source = "" if self.entry is None else source_of(self.entry.make)
        detail: dict[str, object] = {"source": source} if source else {}
        return Entity(self.entity_id, 0, EntityKind.MAIN, self.name, "", self.begun_ns or 0, detail)

    def forget(self) -> None:
        """Let go of everything user code made, so that its finalizers run."""
        self._kept = self.entry = self.stack = None
        self.signal_handlers.clear()
        self.contexts.clear()
        self.failures.clear()


@lru_cache(maxsize=1)
def _places() -> tuple[dict[str, Any], ...]:
    """Return where process-wide values are kept; asyncio's policy has a thread's event loop."""
    import asyncio.events

    import rclpy
    import rclpy.context
    import rclpy.utilities

    modules: dict[str, Any] = sys.modules
    context, loops = vars(rclpy.context), vars(asyncio.events)
    return vars(sys), modules, vars(rclpy), vars(rclpy.utilities), context, loops
