"""A simulated ROS world: constructs the nodes, jumps to the start time, runs and destroys them."""

from __future__ import annotations

import gc
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from greenlet import getcurrent, greenlet

from rsltrace.adapters.rclpy.boundary.boundary import BoundaryContext, RclpyBoundary
from rsltrace.adapters.rclpy.boundary.installation import installed
from rsltrace.adapters.rclpy.callback_errors import RclpyExceptionHandler
from rsltrace.adapters.rclpy.concurrency.asyncio_loops import simulated_event_loops
from rsltrace.adapters.rclpy.concurrency.blocking_calls import end_blocked, simulated_waiting
from rsltrace.adapters.rclpy.concurrency.endless_waits import note_waits
from rsltrace.adapters.rclpy.concurrency.entry_starts import ConstructionEvent, EntryStarts
from rsltrace.adapters.rclpy.concurrency.line_switches import switches_at_lines
from rsltrace.adapters.rclpy.concurrency.mains import begin_program, end_programs, own_exit_handlers
from rsltrace.adapters.rclpy.concurrency.process_exit import own_process_ends, own_signal_handlers
from rsltrace.adapters.rclpy.concurrency.program import SimulatedProgram
from rsltrace.adapters.rclpy.concurrency.runtime import Runtime
from rsltrace.adapters.rclpy.concurrency.threads import cooperative_threads
from rsltrace.adapters.rclpy.entry import JobEntry
from rsltrace.adapters.rclpy.executors.user_executors import note_replaced_functions, own_executors
from rsltrace.adapters.rclpy.handles.logs import RosoutLogs
from rsltrace.adapters.rclpy.handles.node import Parameters, parameters_of
from rsltrace.adapters.rclpy.handles.node_state import NodeStates
from rsltrace.adapters.rclpy.hints import constructor_of, is_unmade
from rsltrace.adapters.rclpy.node_clocks import ClockRule, NodeClocks
from rsltrace.adapters.rclpy.terminals import Terminals, simulated_terminals
from rsltrace.errors import DeadlockError, JobError, RunError
from rsltrace.guard.redirect import replace_attribute
from rsltrace.simulation.chance.channel import NetworkPlan
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.loop.ordered import OrderedLoop
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.events.event import OutsideEvent
from rsltrace.simulation.middleware.links import Network
from rsltrace.simulation.middleware.scheduling import Scheduling, SchedulingPlan
from rsltrace.trace.model.event import NO_EVENT, EventKind


class World:
    """Nodes in an event loop. Within its ``with`` block, rclpy is simulated.

    ``domain`` is shared by all participants, ``runtime`` is the runtime of user code, ``states``
    holds the hashed states of nodes. ``clocks`` is None if all clocks show simulated time.

    :param base_dir: the job's folder; source paths in logs are relative to it.
    :param echo: print log records on stderr.
    """

    def __init__(
        self, loop: EventLoop, *, base_dir: Path, seed: int = 0, echo: bool = True
    ) -> None:
        self.domain = Domain(loop)
        self.runtime = Runtime(self.domain)
        self.states = NodeStates()
        self.clocks: NodeClocks | None = None
        self.nodes: list[Any] = []
        self.parameters: dict[str, Parameters] = {}
        self._seed = seed
        self._logs = RosoutLogs(self.domain, base_dir=base_dir, echo=echo)
        self.domain.dispatcher.exception_handler = RclpyExceptionHandler(self.runtime, self._logs)
        self._surroundings = BoundaryContext(self.runtime, self._logs, self.states)
        self._boundary: RclpyBoundary
        self._terminals: Terminals
        self._stack = ExitStack()
        self.constructed: list[JobEntry] = []
        """The entries in the order of their construction."""
        self.starts = EntryStarts(self.runtime, self.construct)
        self.start_process: Callable[[JobEntry, tuple[int, int]], None]
        """Start an entry that runs as a process of its own, as one event."""

    def __enter__(self) -> World:
        runtime = self.runtime
        with ExitStack() as stack:
            self._boundary = stack.enter_context(installed())
            stack.enter_context(_fresh_rclpy(self._boundary))
            stack.callback(runtime.programs.leave)
            self._boundary.enter(self._surroundings)
            stack.callback(self._boundary.leave)
            import rclpy

            from rsltrace.adapters.rclpy.executors.sim_executor import SimExecutor

            stack.enter_context(simulated_waiting(runtime, self._seed))
            stack.enter_context(own_executors(runtime))
            stack.enter_context(cooperative_threads(runtime))
            stack.enter_context(simulated_event_loops(runtime))
            stack.enter_context(own_exit_handlers(runtime))
            stack.enter_context(own_process_ends(runtime))
            stack.enter_context(own_signal_handlers(runtime))
            self._terminals = stack.enter_context(simulated_terminals(runtime))
            rclpy.init(args=[])
            runtime.runners.main = getcurrent()
            runtime.executor = SimExecutor(runtime, rclpy.get_default_context())
            setattr(rclpy, "__executor", runtime.executor)  # what rclpy.spin* use
            stack.callback(self._close)
            # The executor's own guard conditions are no entities.
            self.domain.entities.pending.clear()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def _close(self) -> None:
        import rclpy

        programs, error = self.runtime.programs, self.error
        programs.main_context = None  # from here on a shutdown is ours
        self.domain.event.handle = None
        self.runtime.runners.close()
        self.runtime.executor.shutdown()
        for node in self.nodes:  # has been destroyed, as far as it could be
            untrack = getattr(node.context, "untrack_node", None)
            if untrack is not None:  # from ROS 2 Kilted on, a shutdown destroys nodes once more
                untrack(node)
        rclpy.try_shutdown()
        # Finalizers of objects that user code left behind must run while rclpy is still simulated.
        if error is not None and error.__cause__ is not None:
            traceback.clear_frames(error.__cause__.__traceback__)
        self.nodes.clear()
        for program in (programs.host, *programs.all):
            program.forget()
        gc.collect()

    def use_network(self, plan: NetworkPlan) -> None:
        """Delay and lose messages. Call it before the first node is made."""
        self.domain.transport.network = Network(self.domain.dispatcher, plan)

    def plan(self, entries: Sequence[JobEntry], start_ns: int) -> None:
        """Register the mains before the first begins: one that ends must know of later ones."""
        programs = self.runtime.programs
        programs.all = [
            SimulatedProgram(programs, entry)
            for entry in entries
            if entry.argv is not None and entry.program is None
        ]
        self._terminals.make(programs.all, start_ns)

    @contextmanager
    def importing(self) -> Iterator[None]:
        """Let objects that modules make at import (locks, threads) belong to the run."""
        programs = self.runtime.programs
        programs.importing = True
        try:
            yield
        finally:
            programs.importing = False

    def use_clocks(self, rules: tuple[ClockRule, ...], start_ns: int) -> None:
        """Give some nodes other clocks. Call it before the first node is made."""
        if rules:
            self.clocks = NodeClocks(self.domain, rules, seed=self._seed, start_ns=start_ns)
            self._surroundings.clocks = self.clocks

    def use_scheduling(self, loop: OrderedLoop, plan: SchedulingPlan) -> None:
        """Use a scheduling policy and execution times. Call it before the first node is made."""
        Scheduling(self.domain.dispatcher, loop, plan)
        if plan.execution and self.domain.transport.network is None:
            # A callback's messages leave when it is over, which takes links.
            self.use_network(NetworkPlan())

    def switch_at_lines(self, loop: OrderedLoop, packages: frozenset[str]) -> None:
        """Switch threads at lines of user code; ``packages`` count as user code, too."""
        self._stack.enter_context(switches_at_lines(self.runtime, loop, packages))

    def show_log(self, severity: int, name: str, text: str) -> None:
        self._logs.show(severity, name, text)

    def echo_logs(self, echo: bool) -> None:
        self._logs.echo = echo

    # -- the stages of a run ---------------------------------------------------------------------

    def construct(self, entry: JobEntry, cause: tuple[int, int] = (NO_EVENT, 0)) -> bool:
        """Construct an entry as one event; return False if that ended the run.

        ``cause``: the event and output that it follows from.
        """
        runtime = self.runtime
        self.constructed.append(entry)
        if entry.program is not None:
            self.start_process(entry, cause)
            return runtime.loop.stopped is None
        if entry.argv is not None:
            program = next(one for one in runtime.programs.all if one.entry is entry)
            begin_program(runtime, program, cause)
            return runtime.loop.stopped is None

        def build() -> None:
            made = entry.make()
            for node in made if isinstance(made, (list, tuple)) else [made]:
                self._adopt(node, entry.name)
            runtime.programs.tell("started", entry.key)

        def construct() -> None:
            event = ConstructionEvent(lambda: f"constructing {entry.name}", entry)
            runtime.dispatcher.run_outside(event, EventKind.CONSTRUCT, 0, None, build, cause)
            # The stack that switched here goes on: this function, or the loop after a wait.
            runtime.runners.step_aside()

        # If a constructor blocks (on a service, say), the others are constructed meanwhile.
        runtime.programs.constructing = entry
        runtime.runners.waiting.append(getcurrent())
        greenlet(construct).switch()
        runtime.programs.constructing = None
        return runtime.loop.stopped is None

    def run_outside(self, name: str, kind: EventKind, body: Callable[[], object]) -> None:
        """Run ``body`` as one event that is no entity's callback."""
        self.domain.dispatcher.run_outside(OutsideEvent(lambda: name), kind, 0, None, body)

    def _adopt(self, node: Any, name: str) -> None:
        from rclpy.node import Node

        if not isinstance(node, Node):
            raise JobError(
                f"{name} returned an object of type {type(node).__qualname__}, not an rclpy Node: "
                "name a Node subclass or a function that returns a node (or a list of nodes)"
            )
        if is_unmade(node):
            raise RunError(f"{constructor_of(node)} has not called super().__init__(name)")
        self.nodes.append(node)
        self.runtime.executor.add_node(node)

    def all_nodes(self) -> list[Any]:
        """Return the rclpy nodes, in the order of their construction."""
        wrappers = [getattr(handle, "wrapper", None) for handle in self.domain.graph.nodes]
        return [wrapper for wrapper in wrappers if wrapper is not None]

    def keep(self, node: Any) -> None:
        """Destroy ``node`` at the end, although its callbacks do not run."""
        self.nodes.append(node)

    def renew(self, program: SimulatedProgram) -> None:
        """Prepare a crashed main to be started again."""
        programs = self.runtime.programs
        new = SimulatedProgram(programs, program.entry)
        programs.all[programs.all.index(program)] = new
        self._terminals.hand_over(program, new)

    def jump(self, time_ns: int) -> None:
        """Move from construction time to the start of the run, and run jump callbacks."""
        loop = self.domain.loop
        delta_ns = time_ns - loop.now_ns
        loop.jump(time_ns)
        if delta_ns:
            self.run_outside(
                "the jump to the start",
                EventKind.CLOCK_JUMP,
                lambda: self._boundary.jump_clocks(delta_ns),
            )

    def go_on(self) -> None:
        """Run the loop until it ends or its gate pauses it; call it again after a pause.

        The loop never runs on this stack, so no callback can block it. If the loop runs out of
        events while a call still waits, that is a deadlock.
        """
        runtime, outcome = self.runtime, self.domain.outcome
        runners, ending = runtime.runners, runtime.ending
        runners.next().switch()
        runtime.programs.leave()  # it may have ended between two programs
        if runtime.loop.stopped is None and runners.error is None:
            return  # paused
        outcome.note_end(runtime.loop.events)
        if outcome.error is None:
            note_waits(runtime, outcome)
        note_replaced_functions(runtime, hosted=bool(self.nodes))
        self.parameters = parameters_of(self.domain.graph)
        end_programs(runtime)
        end_blocked(runtime)
        if runners.error is not None:
            raise runners.error
        if ending.stuck and outcome.error is None:
            outcome.error = DeadlockError(_deadlock(ending.stuck))

    def waiting(self) -> str:
        """Describe the deadlock: which call waits for what."""
        return _deadlock(self.runtime.who_waits())

    def blocked(self) -> list[str]:
        """Describe the blocked calls that may not wait for ever."""
        return [one.waits_for() for one in self.runtime.runners.blocked if not one.is_patient()]

    def destroy(self) -> None:
        """Destroy the nodes in creation order, each as one event."""
        runtime, outcome = self.runtime, self.domain.outcome
        outcome.note_end(runtime.loop.events)
        end_programs(runtime)
        end_blocked(runtime)  # constructors that still wait, if the run never began
        for node in self.nodes:
            runtime.ending.shutdown_ns = 0
            handle = node.handle
            if handle.destroyed or outcome.error is not None:
                continue
            event = OutsideEvent(handle.describe)
            runtime.dispatcher.run_outside(
                event, EventKind.SHUTDOWN, handle.entity_id, handle, node.destroy_node
            )

    @property
    def exit_code(self) -> int:
        """The first exit status other than 0 with which a main ended."""
        return next((p.exit_code for p in self.runtime.programs.all if p.exit_code), 0)

    @property
    def error(self) -> RunError | None:
        return self.domain.outcome.error


def _deadlock(waits: list[str]) -> str:
    lines = "\n".join(f"  {text}" for text in waits[:20])
    return f"deadlock: nothing can happen any more, and these calls still wait:\n{lines}"


@contextmanager
def _fresh_rclpy(boundary: RclpyBoundary) -> Iterator[None]:
    """Reset rclpy's module globals for a run, and restore them afterwards."""
    import rclpy
    import rclpy.context
    import rclpy.utilities

    with ExitStack() as stack:
        replace_attribute(stack, rclpy.utilities, "g_default_context", None)
        replace_attribute(stack, rclpy.context, "g_logging_ref_count", 0)
        replace_attribute(stack, rclpy, "__executor", None)
        boundary.ros_clocks.clear()
        boundary.rclpy_logging_shutdown()  # forget the log levels of an earlier run
        yield
