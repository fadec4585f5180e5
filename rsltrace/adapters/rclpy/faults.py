"""Faults of nodes, as the job says: crash, hang, restart.

A fault affects the node's process. Each entry of a job stands for one, whether the job constructs
its nodes, a main makes them, or they are in a real process. Each fault is an event of its own,
before anything else that is ready.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

from rsltrace.adapters.rclpy.concurrency.blocking_calls import abandon
from rsltrace.adapters.rclpy.concurrency.mailbox import Mailbox, SpinningExecutor
from rsltrace.adapters.rclpy.concurrency.mains import crash_program
from rsltrace.adapters.rclpy.concurrency.program import SimulatedProgram
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, Runtime
from rsltrace.adapters.rclpy.entry import JobEntry
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.world import World
from rsltrace.errors import RunError
from rsltrace.simulation.middleware.entity import Runnable, on_no_executor
from rsltrace.simulation.middleware.events.event import OutsideEvent
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder
from rsltrace.simulation.middleware.participant import Participant
from rsltrace.trace.model.event import NO_EVENT, EventKind, RandomDecision, encode_decision
from rsltrace.trace.model.texts import format_seconds


class FaultedNodes:
    """The nodes (handles) of one process that crashes or hangs: a ``program``, or the nodes of an
    ``entry`` in the host.

    A process that is killed runs nothing any more, no ``finally`` either, so its blocked calls are
    abandoned. One that hangs is stopped between two instructions: arrivals wait, timers are late,
    and its calls return when it goes on.
    """

    def __init__(
        self, runtime: Runtime, nodes: list[Any], program: SimulatedProgram, entry: JobEntry | None
    ) -> None:
        self._runtime = runtime
        self._nodes = nodes
        self._program = None if program is runtime.programs.host else program
        self._entry = entry
        self._running: list[Any] = []
        self._spinning: list[tuple[Mailbox, SpinningExecutor]] = []

    @property
    def are_destroyed(self) -> bool:
        return all(node.destroyed for node in self._nodes)

    def hold(self) -> None:
        """Run nothing of them until ``release``."""
        self._keep_what_comes()
        for node in self._nodes:
            if node.mailbox is not None:
                if node.mailbox.driver is not None:
                    self._spinning.append((node.mailbox, node.mailbox.driver))
                    node.mailbox.driver = None
            elif node.wrapper is not None:
                self._running.append(node.wrapper)
                self._runtime.executor.remove_node(node.wrapper)

    def release(self) -> None:
        """Let them go on: kept items are ready now."""
        for node in self._running:
            if not node.handle.destroyed:
                self._runtime.executor.add_node(node)
        holders = self._nodes if self._program is None else [self._program, *self._nodes]
        for holder in holders:
            held, holder.held = holder.held, None
            self._runtime.loop.tasks.extend(held or ())
        for mailbox, driver in self._spinning:
            if not mailbox.closed:
                mailbox.driver = driver
                driver.wake()

    def crash(self) -> None:
        """Remove them from the run, as a killed process."""
        self._keep_what_comes()
        runtime = self._runtime
        for blocked in [one for one in runtime.runners.blocked if self._is_ours(one)]:
            del runtime.runners.blocked[blocked]
            abandon(blocked.stack)
            blocked.stop_waiting()
        for run in [one for one in runtime.coroutines.suspended if one.node in self._nodes]:
            del runtime.coroutines.suspended[run]
        for thread in list(runtime.threads.alive):
            if thread.node in self._nodes or thread.program is self._program:
                thread.end()
        for node in self._nodes:
            if node.wrapper is not None and node.mailbox is None:
                runtime.executor.remove_node(node.wrapper)
            if node.mailbox is not None:
                node.mailbox.close()
            for endpoint in runtime.domain.graph.endpoints_of(node):
                endpoint.destroy()
            node.destroy()

    def _keep_what_comes(self) -> None:
        """Keep their items that the loop dispatches from now on."""
        if self._program is not None:
            self._program.held = []
        for node in self._nodes:
            node.held = []

    def _is_ours(self, blocked: BlockedCall) -> bool:
        if self._program is not None:
            return blocked.program is self._program
        return blocked.event[2] in self._nodes or (
            self._entry is not None and blocked.constructing is self._entry
        )


_DRAWS = {
    "crash": RandomDecision.CRASH,
    "hang": RandomDecision.HANG,
    "restart": RandomDecision.RESTART,
}


class RealProcess(Protocol):
    """A real process with nodes."""

    key: str

    def crash(self) -> None:
        """End at once, within the current event."""


@dataclass(frozen=True, slots=True)
class NodeFault:
    """A fault of a node: ``kind`` is ``crash``, ``hang`` or ``restart``. It happens at a time,
    after an event, or after a message (from 1) of a topic. ``where`` is its line in the job."""

    kind: str
    node: str
    where: str
    at_ns: int | None = None
    event: int | None = None
    topic: str = ""
    message: int = 0
    for_ns: int | None = None


class NodeFaults(EventObserver):
    """The node faults of a run. Make it before the first node."""

    order = ObserverOrder.FAULTS

    def __init__(self, world: World, faults: Sequence[NodeFault], start_ns: int) -> None:
        self.world = world
        self._strikes = [_ScheduledFault(self, fault) for fault in faults]
        self._counts: dict[str, int] = {}
        by_event = [strike for strike in self._strikes if strike.fault.event is not None]
        self._by_event = sorted(by_event, key=lambda strike: -(strike.fault.event or 0))
        if self._by_event:
            world.domain.dispatcher.add_observer(self)
        for strike in self._strikes:
            if strike.fault.at_ns is not None:
                world.domain.loop.schedule(start_ns + strike.fault.at_ns, strike.come)
        for topic in dict.fromkeys(s.fault.topic for s in self._strikes if s.fault.topic):
            world.domain.watch(topic, self._sent)

    def missed(self) -> Iterator[tuple[str, str]]:
        """Yield the place in the job of each fault that did not happen, and why."""
        for strike in self._strikes:
            if strike.missed:
                yield strike.fault.where, strike.missed

    def after_event(self) -> None:
        events = self.world.domain.loop.events
        while self._by_event and events > (self._by_event[-1].fault.event or 0):
            self._by_event.pop().come()
        if not self._by_event:
            self.world.domain.dispatcher.remove_observer(self)

    def _sent(self, publisher: Any, data: bytes) -> None:
        topic = publisher.topic
        count = self._counts[topic] = self._counts.get(topic, 0) + 1
        for strike in self._strikes:
            if strike.fault.topic == topic and strike.fault.message == count:
                strike.come()


class _ScheduledFault:
    """A fault that the loop dispatches at its time."""

    def __init__(self, faults: NodeFaults, fault: NodeFault) -> None:
        self._world = faults.world
        self.fault = fault
        self.missed = "the run ended before it"
        self._faulted: FaultedNodes | None = None

    def come(self) -> None:
        """Dispatch it next, before anything else that is ready."""
        if self._world.domain.loop.stopped is None:
            self._world.domain.loop.tasks.append(self)

    def dispatch(self) -> None:
        """Apply the fault as one event, or end a hang."""
        if self._faulted is not None:
            faulted, self._faulted = self._faulted, None
            if not faulted.are_destroyed:
                self._event(self._node(), RandomDecision.GOES_ON, 0, faulted.release)
            return
        node = self._node()
        if node is None:
            at = format_seconds(self._world.domain.loop.stamp)
            self.missed = f"there was no node {self.fault.node} at {at} s"
            return
        self.missed = ""
        for_ns = self.fault.for_ns or 0
        self._event(node, _DRAWS[self.fault.kind], for_ns, lambda: self._strike(node))

    def runnable(self) -> Runnable:
        return on_no_executor(None, self.describe())

    def describe(self) -> str:
        return f"{self.fault.kind} of {self.fault.node}"

    def _node(self) -> Participant | None:
        return self._world.domain.graph.node_named(self.fault.node)

    def _event(
        self,
        node: Participant | None,
        draw: RandomDecision,
        value_ns: int,
        body: Callable[[], None],
    ) -> None:
        dispatcher = self._world.domain.dispatcher
        entity = 0 if node is None else node.entity_id

        def happen() -> None:
            dispatcher.draw(entity, encode_decision(draw, value_ns))
            body()

        event = OutsideEvent(self.describe)
        dispatcher.run_outside(event, EventKind.FAULT, entity, None, happen, (NO_EVENT, 0))

    def _strike(self, node: Participant) -> None:
        fault, world = self.fault, self._world
        entry = self._entry(node)
        if fault.kind == "restart":
            if entry is None:
                raise self._cannot("no entry of nodes: has made it")
            world.starts.add_at(entry, world.domain.loop.now_ns + (fault.for_ns or 0))
        if not isinstance(node, NodeHandle):
            if node.process is None:
                raise self._cannot("it plays a bag, or drives the run")
            if fault.kind == "hang":
                raise self._cannot("it is in a process of its own; crash and restart are possible")
            cast("RealProcess", node.process).crash()
            return
        faulted = FaultedNodes(world.runtime, self._nodes(node, entry), node.process, entry)
        if fault.kind == "hang":
            faulted.hold()
            if fault.for_ns is not None:
                self._faulted = faulted
                world.domain.loop.schedule(world.domain.loop.now_ns + fault.for_ns, self.come)
            return
        faulted.crash()
        if node.process is not world.runtime.programs.host:
            crash_program(world.runtime, node.process)
            if fault.kind == "restart":
                world.renew(node.process)
        elif entry is not None:
            world.runtime.programs.tell("ended", entry.key)

    def _nodes(self, node: NodeHandle, entry: JobEntry | None) -> list[Any]:
        """Return the nodes of a node's process."""
        own = [one for one in self._world.domain.graph.nodes if one.process is node.process]
        if node.process.entry is not None:
            return own
        same = [one for one in own if isinstance(one, NodeHandle) and one.entry is entry]
        return [node] if entry is None else same

    def _entry(self, node: Participant) -> JobEntry | None:
        if not isinstance(node, NodeHandle):
            if node.process is None:
                return None
            key = cast("RealProcess", node.process).key
            return next(one for one in self._world.constructed if one.key == key)
        return node.process.entry or node.entry

    def _cannot(self, why: str) -> RunError:
        return RunError(f"{self.fault.where}: {self.fault.node} cannot {self.fault.kind}: {why}")
