"""Simulated processes: one for each main of a job, and the host of the nodes that it constructs.

All mains of a job run in one real process. The values that rclpy and Python keep per process (the
default context, the global executor, ``sys.argv``, ``sys.path``, ``sys.stdin``, ``__main__``) are
swapped whenever another main runs.
"""

from __future__ import annotations

import builtins
import sys
from collections import deque
from collections.abc import Callable
from types import ModuleType
from typing import Any, Protocol

from greenlet import greenlet

from rsltrace.adapters.rclpy.entry import JobEntry
from rsltrace.simulation.middleware.events.failure import RaisedException
from rsltrace.simulation.middleware.interface import callback_source
from rsltrace.trace.model.entity import Entity, EntityKind

_FAILURES_MAX = 16
"""A main may catch a million exceptions; the one that ends it is one of the last."""

ExitHandler = tuple[Callable[..., object], tuple[Any, ...], dict[str, Any]]
"""The arguments of ``atexit.register``."""


class ProgramContext(Protocol):
    """A context that a program has initialized."""

    def ok(self) -> bool:
        """Return whether it has not been shut down."""

    def end(self) -> None:
        """Shut down from outside, as a signal does."""

    def get_domain_id(self) -> int:
        """Return the number of its DDS domain."""


class SimulatedPrograms:
    """The simulated processes: ``present`` runs, ``host`` has the nodes that the job constructs,
    ``all`` are those with a main.

    ``constructing`` is the entry under construction. While ``importing``, objects that modules make
    belong to the run. The shutdown of ``main_context`` ends the run. ``fed``: messages come from
    bags. ``to_come`` are the keys of entries that will start later. ``listeners`` are called with
    "started" or "ended" and an entry's key.
    """

    def __init__(self) -> None:
        self.places = places()
        self.host = SimulatedProgram(self)
        self.present = self.host
        self.all: list[SimulatedProgram] = []
        self.constructing: JobEntry | None = None
        self.importing = False
        self.main_context: ProgramContext | None = None
        self.fed = False
        self.to_come: list[str] = []
        self.listeners: list[Callable[[str, str], None]] = []
        self.stdin_of: Callable[[SimulatedProgram], Any] = lambda program: sys.stdin
        """Returns the ``sys.stdin`` of a new program."""
        self.on_enter: Callable[[SimulatedProgram], None] | None = None
        """Called with the program that runs next."""

    def tell(self, what: str, key: str) -> None:
        """Call the listeners: an entry has "started" or "ended" in the current event."""
        for listener in self.listeners:
            listener(what, key)

    def on_stack(self, stack: greenlet) -> SimulatedProgram | None:
        """Return the program whose main runs on a stack."""
        return next((program for program in self.all if program.stack is stack), None)

    @property
    def is_hosted(self) -> bool:
        """Whether a node runs that the job constructs."""
        return self.present is self.host

    def leave(self) -> None:
        """Go back to the host."""
        if self.present is not self.host:
            self.host.enter()


class SimulatedProgram:
    """A simulated process: a main, or the host of the nodes that a job constructs."""

    def __init__(self, programs: SimulatedPrograms, entry: JobEntry | None = None) -> None:
        self._programs = programs
        self.entry = entry
        self.name = "the run" if entry is None else entry.name
        self.label = self.name if entry is None else entry.key or entry.name
        """Its name in notes: entries of one target have numbers."""
        arguments = [] if entry is None else entry.arguments
        self.ros_words = [word for part in arguments[:1] for word in part.arguments]
        """Added to the ROS arguments of every ``rclpy.init`` of this program."""
        self.parameters = arguments[1:]
        """The job's own parameters, which override those of files."""
        self.entity_id = 0
        self.begun_ns: int | None = None
        self.announced = True
        self.contexts: list[ProgramContext] = []
        self.failures: deque[RaisedException] = deque(maxlen=_FAILURES_MAX)
        """Exceptions of callbacks that left a spin of this program, the latest last."""
        self.exit_handlers: list[ExitHandler] = []
        self.signal_handlers: dict[int, object] = {}
        self.signals: Any = None
        """The ``SignalHandlerOptions`` of the handlers that rclpy has installed, None for none."""
        self.stack: greenlet | None = None
        self.spun = False
        """Whether an executor of this program has spun."""
        self.ended = False
        self.held: list[Any] | None = None
        """Items that are kept while it hangs, or for ever after a crash; else None."""
        self.exit_code = 0
        self._kept: tuple[Any, ...] | None = None

    # -- what a process has of its own -----------------------------------------------------------

    def enter(self) -> None:
        """Make this the running program: save the values of the one before, restore its own."""
        programs = self._programs
        before, programs.present = programs.present, self
        kept = self._kept
        if kept is None:
            kept = self._first_values()
        system, modules, rclpy, utilities, context, loops = programs.places
        # No loop, as every callback of a main calls this twice.
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
        """Return the values of a new process."""
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
        source = "" if self.entry is None else callback_source(self.entry.make)
        detail: dict[str, object] = {"source": source} if source else {}
        return Entity(self.entity_id, 0, EntityKind.MAIN, self.name, "", self.begun_ns or 0, detail)

    def shuts_down_on(self, signal: str) -> bool:
        """Return whether rclpy shuts its contexts down on ``SIGINT`` or ``SIGTERM``."""
        return getattr(self.signals, "name", "") in (signal, "ALL")

    def forget(self) -> None:
        """Drop all objects of user code, so that finalizers run."""
        self._kept = self.entry = self.stack = None
        self.signal_handlers.clear()
        self.contexts.clear()
        self.failures.clear()


def places() -> tuple[dict[str, Any], ...]:
    """Return the namespaces that hold per-process values."""
    import rclpy
    import rclpy.context
    import rclpy.utilities

    modules: dict[str, Any] = sys.modules
    asyncio = modules.get("asyncio.events")  # not loaded for nodes that do not use it
    context = vars(rclpy.context)
    loops = {"_event_loop_policy": None} if asyncio is None else vars(asyncio)
    return vars(sys), modules, vars(rclpy), vars(rclpy.utilities), context, loops
