"""A simulated ROS world from its first node to its last: construction, the jump to the start, the
run, and the destruction of the nodes."""

from __future__ import annotations

import gc
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from greenlet import getcurrent, greenlet

from rsltrace.chance.clock import ClockModel
from rsltrace.chance.network import NetworkPlan
from rsltrace.doors.rclpy.boundary.boundary import Boundary
from rsltrace.doors.rclpy.core import Core
from rsltrace.doors.rclpy.entry import Entry
from rsltrace.doors.rclpy.installation import installed
from rsltrace.doors.rclpy.logs import Logs
from rsltrace.doors.rclpy.node_clocks import NodeClocks
from rsltrace.doors.rclpy.stacks.asyncio_loops import simulated_event_loops
from rsltrace.doors.rclpy.stacks.blocked_groups import held_back
from rsltrace.doors.rclpy.stacks.blocking_calls import end_blocked
from rsltrace.doors.rclpy.stacks.exit_handlers import own_exit_handlers
from rsltrace.doors.rclpy.stacks.process_exit import own_process_ends
from rsltrace.doors.rclpy.stacks.program import Program
from rsltrace.doors.rclpy.stacks.program_end import end_programs
from rsltrace.doors.rclpy.stacks.signals import own_signal_handlers
from rsltrace.doors.rclpy.stacks.simulated_sleep import simulated_waiting
from rsltrace.doors.rclpy.stacks.threads import cooperative_threads
from rsltrace.doors.rclpy.stacks.user_executors import own_executors
from rsltrace.doors.rclpy.stacks.wait_reasons import who_waits
from rsltrace.errors import DeadlockError, JobError, RunError
from rsltrace.loop.loop import EventLoop
from rsltrace.loop.ordered import OrderedLoop
from rsltrace.middleware.census import parameters_of
from rsltrace.middleware.graph import Graph
from rsltrace.middleware.links import Network
from rsltrace.middleware.scheduling import Scheduling, SchedulingPlan
from rsltrace.model.event import EventKind


class World:
    """Nodes in a loop. Use as a context manager: within it, rclpy is simulated.

    :param base_dir: the job's folder; source paths in logs are relative to it.
    :param echo: print log records on stderr.
    """

    def __init__(
        self, loop: EventLoop, *, base_dir: Path, seed: int = 0, echo: bool = True
    ) -> None:
        self.core = Core(loop, base_dir=base_dir, seed=seed)
        self.core.graph = Graph()
        self.core.logs = Logs(self.core, echo=echo)
        self._boundary: Boundary
        self._stack = ExitStack()
        self.nodes: list[Any] = []
        self._begun = 0

    def __enter__(self) -> World:
        with ExitStack() as stack:
            self._boundary = stack.enter_context(installed())
            stack.enter_context(_fresh_rclpy(self._boundary))
            stack.callback(_leave_program, self.core)
            self._boundary.enter(self.core)
            stack.callback(self._boundary.leave)
            import rclpy

            from rsltrace.doors.rclpy.stacks.executor import SimExecutor

            stack.enter_context(simulated_waiting(self.core))
            stack.enter_context(own_executors(self.core))
            stack.enter_context(cooperative_threads(self.core))
            stack.enter_context(simulated_event_loops(self.core))
            stack.enter_context(own_exit_handlers(self.core))
            stack.enter_context(own_process_ends(self.core))
            stack.enter_context(own_signal_handlers(self.core))
            rclpy.init(args=[])
            self.core.main = getcurrent()
            self.core.executor = SimExecutor(self.core, rclpy.get_default_context())
            setattr(rclpy, "__executor", self.core.executor)  # what rclpy.spin* use
            stack.callback(self._close)
            self.core.pending.clear()  # the executor's own guard conditions are no entities
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def _close(self) -> None:
        import rclpy

        self.core.main_context = None  # from here on a shutdown is ours
        self.core.current_handle = None
        self.core.end_runners()
        self.core.executor.shutdown()
        for node in self.nodes:  # has been destroyed, as far as it could be
            untrack = getattr(node.context, "untrack_node", None)
            if untrack is not None:  # from ROS 2 Kilted on, a shutdown destroys nodes once more
                untrack(node)
        rclpy.try_shutdown()
        # What user code has left behind must meet its finalizers while rclpy is still simulated.
        if self.core.error is not None and self.core.error.__cause__ is not None:
            traceback.clear_frames(self.core.error.__cause__.__traceback__)
        self.nodes.clear()
        for program in (self.core.host, *self.core.programs):
            program.forget()
        gc.collect()

    def use_network(self, plan: NetworkPlan) -> None:
        """Give what nodes send delays and losses. Before the first node is made."""
        self.core.network = Network(self.core, plan)

    def plan(self, entries: Sequence[Entry]) -> None:
        """Say what will be constructed: a main that ends must know of those that begin later."""
        self.core.programs = [
            Program(self.core, entry) for entry in entries if entry.argv is not None
        ]

    @contextmanager
    def importing(self) -> Iterator[None]:
        """Let what modules make when they are imported (a lock, a thread) belong to the run."""
        self.core.importing = True
        try:
            yield
        finally:
            self.core.importing = False

    def use_clocks(self, rules: tuple[tuple[str, ClockModel], ...], start_ns: int) -> None:
        """Let the clocks of some nodes (globs) be wrong. Before the first node is made."""
        if rules:
            self.core.clocks = NodeClocks(self.core, rules, start_ns=start_ns)

    def use_scheduling(self, loop: OrderedLoop, plan: SchedulingPlan) -> None:
        """Let a plan say what runs when, and how long it takes. Before the first node is made."""
        Scheduling(self.core, loop, plan)
        if plan.execution and self.core.network is None:
            # What a callback sends leaves when it is over: that takes links.
            self.use_network(NetworkPlan())

    # -- the stages of a run ---------------------------------------------------------------------

    def construct(self, entry: Entry) -> bool:
        """Construct one entry of the job as one event; return False if that ended the run."""
        core = self.core
        if entry.argv is not None:
            core.programs[self._begun].begin()
            self._begun += 1
            return core.loop.stopped is None

        def build() -> None:
            made = entry.make()
            for node in made if isinstance(made, (list, tuple)) else [made]:
                self._adopt(node, entry.name)

        def construct() -> None:
            name = f"constructing {entry.name}"
            core.run_outside(lambda: name, EventKind.CONSTRUCT, 0, None, build, entry=entry)
            # Whoever switched here goes on: this function, or the loop's runner after a wait.
            getcurrent().parent = core.runners.pop()

        # A constructor that blocks (on a service, say) is left waiting while others go on.
        core.constructing = entry
        core.runners.append(getcurrent())
        greenlet(construct).switch()
        core.constructing = None
        return core.loop.stopped is None

    def _adopt(self, node: Any, name: str) -> None:
        from rclpy.node import Node

        if not isinstance(node, Node):
            raise JobError(
                f"{name} gave a {type(node).__qualname__}, not an rclpy Node: name a Node subclass "
                "or a function that returns a node (or a list of nodes)"
            )
        self.nodes.append(node)
        self.core.executor.add_node(node)

    def all_nodes(self) -> list[Any]:
        """Return the nodes there are, in the order of their construction."""
        return [handle.wrapper for handle in self.core.graph.nodes if handle.wrapper is not None]

    def keep(self, node: Any) -> None:
        """Destroy ``node`` with the others at the end, although it is not run."""
        self.nodes.append(node)

    def jump(self, time_ns: int) -> None:
        """Move from construct time to the start of the run, telling clocks of the jump."""
        delta_ns = time_ns - self.core.loop.now_ns
        self.core.loop.jump(time_ns)
        if delta_ns:
            self.core.run_outside(
                lambda: "the jump to the start",
                EventKind.CLOCK_JUMP,
                0,
                None,
                lambda: self._boundary.jump_clocks(delta_ns),
            )

    def go_on(self) -> None:
        """Run the loop until it ends or its gate pauses it; afterwards this may be called again.

        The loop never runs on this stack, so that no callback can keep it from going on. A quiet
        end with somebody still waiting is a deadlock.
        """
        core = self.core
        core.next_runner().switch()
        if core.loop.stopped is None and core.runner_error is None:
            return  # paused
        core.note_end()
        if core.error is None and not core.stuck:
            core.notes += held_back(core)
        core.parameters = parameters_of(core)
        end_programs(core)
        end_blocked(core)
        if core.runner_error is not None:
            raise core.runner_error
        if core.stuck and core.error is None:
            core.error = DeadlockError(_deadlock(core.stuck))

    def waiting(self) -> str:
        """Say who waits for what, where nothing can happen any more."""
        return _deadlock(who_waits(self.core))

    def destroy(self) -> None:
        """Destroy the nodes in creation order, each as one event."""
        core = self.core
        core.note_end()
        end_programs(core)
        end_blocked(core)  # constructors that still wait, if the run never began
        for node in self.nodes:
            core.shutdown_ns = 0
            handle = node.handle
            if handle.destroyed or core.error is not None:
                continue
            core.run_outside(
                handle.describe, EventKind.SHUTDOWN, handle.entity_id, handle, node.destroy_node
            )

    @property
    def exit_code(self) -> int:
        """The first exit status other than 0 with which a main ended."""
        return next((p.exit_code for p in self.core.programs if p.exit_code), 0)

    @property
    def error(self) -> RunError | None:
        """What went wrong, if anything did."""
        return self.core.error


def _deadlock(waits: list[str]) -> str:
    lines = "\n".join(f"  {text}" for text in waits[:20])
    return f"nothing can happen any more, but somebody waits:\n{lines}"


def _leave_program(core: Core) -> None:
    if core.program is not core.host:
        core.host.enter()


@contextmanager
def _fresh_rclpy(boundary: Boundary) -> Iterator[None]:
    """Give rclpy's module globals their first values for a run, and their old ones afterwards."""
    import rclpy
    import rclpy.context
    import rclpy.utilities

    first_values: list[tuple[Any, str, Any]] = [
        (rclpy.utilities, "g_default_context", None),
        (rclpy.context, "g_logging_ref_count", 0),
        (rclpy, "__executor", None),
    ]
    saved = [(module, name, getattr(module, name, None)) for module, name, _ in first_values]
    for module, name, first in first_values:
        setattr(module, name, first)
    boundary.ros_clocks.clear()
    boundary.real.rclpy_logging_shutdown()  # forget the log levels of an earlier run
    boundary.real.rclpy_logging_initialize()
    try:
        yield
    finally:
        for module, name, old in saved:
            setattr(module, name, old)
