"""One executable of a job: its ``main``, and what a process of its own would have.

All mains of a job run in one process. What rclpy and Python keep per process (the default context,
the global executor, ``sys.argv``) is exchanged whenever the loop goes over to another main, so each
finds its own. The nodes that the job itself constructs share one program, the host.
"""

from __future__ import annotations

import sys
from collections import deque
from functools import lru_cache
from typing import TYPE_CHECKING

from greenlet import getcurrent, greenlet

from rsltrace.model.entity import Entity, EntityKind
from rsltrace.model.event import EventKind

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.context import ContextHandle
    from rsltrace.doors.rclpy.core import Core
    from rsltrace.doors.rclpy.entry import Entry
    from rsltrace.doors.rclpy.error_text import Raised
    from rsltrace.doors.rclpy.stacks.blocking_calls import Wait
    from rsltrace.doors.rclpy.stacks.exit_handlers import Handler

_FAILURES_MAX = 16
"""A main may go on after each of a million exceptions; what ends it is one of the last."""


class Program:
    """A process in the simulation: one main, or the host of the nodes a job constructs."""

    def __init__(
        self,
        core: Core,
        entry: Entry | None = None,
    ) -> None:
        self.core = core
        self.entry = entry
        self.name = "the run" if entry is None else entry.name
        arguments = [] if entry is None else entry.arguments
        self.ros_words = [word for part in arguments[:1] for word in part.arguments]
        """What the job adds to the ROS arguments of every ``rclpy.init`` of this program."""
        self.parameters = arguments[1:]
        """The job's own parameters, which come after those of all files."""
        self.entity_id = 0
        self.announced = True
        self.contexts: list[ContextHandle] = []
        self.failures: deque[Raised] = deque(maxlen=_FAILURES_MAX)
        """What callbacks have raised out of a spin of this program, most recent last."""
        self.exit_handlers: list[Handler] = []
        self.signal_handlers: dict[int, object] = {}
        self.stack: greenlet | None = None
        self.begun = False
        self.spun = False
        """Whether an executor of this program has looked for work."""
        self.ended = False
        self.exit_code = 0
        self._main = None if entry is None else entry.make
        self._argv = None if entry is None else entry.argv
        self._kept: list[object] | None = None

    # -- what a process has of its own -----------------------------------------------------------

    def enter(self) -> None:
        """Make this the program that runs: whoever ran before puts its things away."""
        core = self.core
        before, core.program = core.program, self
        places = _places()
        before._kept = [names[name] for names, name, _ in places]
        if self._kept is None:
            self._kept = [first for _, _, first in places]
            self._kept[0] = self._argv
        for (names, name, _), value in zip(places, self._kept, strict=True):
            names[name] = value

    # -- its life --------------------------------------------------------------------------------

    def describe(self) -> str:
        """Name the program for people."""
        return self.name

    def begin(self) -> None:
        """Run main until it ends or blocks for the first time, as one event."""
        core = self.core
        self.begun = True
        self.entity_id = core.new_entity_id()
        core.pending.append(self)

        def body() -> None:
            self.enter()
            kind, entity = EventKind.CONSTRUCT, self.entity_id
            core.run_outside(self.describe, kind, entity, None, self._run, entry=self.entry)
            core.host.enter()
            getcurrent().parent = core.runners.pop()

        core.runners.append(getcurrent())
        self.stack = greenlet(body)
        self.stack.switch()

    def _run(self) -> None:
        from rsltrace.doors.rclpy.stacks.program_end import end_program, finish_process

        assert self._main is not None
        error: BaseException | None = None
        try:
            self._main()
        except BaseException as raised:
            error = raised
        try:
            finish_process(self, error)
        except BaseException as raised:
            error = raised
        end_program(self, error)

    def settle(self) -> bool:
        """Return whether the owner is known: a main has none."""
        return True

    def entity(self) -> Entity:
        """Return the main as the trace describes it."""
        now_ns = self.core.loop.now_ns
        return Entity(self.entity_id, 0, EntityKind.MAIN, self.name, "", now_ns, {})

    def forget(self) -> None:
        """Let go of everything user code made, so that its finalizers run."""
        self._kept = self._main = self.entry = self.stack = None
        self.signal_handlers.clear()
        self.contexts.clear()
        self.failures.clear()

    def blocked(self) -> Wait | None:
        """Return the call in which main is blocked, if it is."""
        return next((w for w in self.core.blocked if w.stack is self.stack), None)


@lru_cache(maxsize=1)
def _places() -> list[tuple[dict[str, object], str, object]]:
    """Return where process-wide values are kept, and their first values."""
    import rclpy
    import rclpy.context
    import rclpy.utilities

    return [
        (vars(sys), "argv", []),
        (vars(rclpy), "__executor", None),
        (vars(rclpy.utilities), "g_default_context", None),
        (vars(rclpy.context), "g_logging_ref_count", 0),
    ]
