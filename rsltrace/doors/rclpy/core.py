"""One simulated ROS world: what its handles share, and how a callback is run.

``Core.execute`` is the middle of everything: each event of a run passes through it once. Keep it
small; what only some events need belongs elsewhere.
"""

from __future__ import annotations

import contextlib
import os
import random
import struct
import uuid
from _thread import get_ident
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greenlet import getcurrent, greenlet

from rsltrace.doors.rclpy.boundary.outside_event import OutsideEvent
from rsltrace.doors.rclpy.boundary.waitables import OWN_WAITABLES, sync_waitables
from rsltrace.doors.rclpy.callback_errors import failed
from rsltrace.doors.rclpy.stacks.blocking_calls import RunEnded
from rsltrace.doors.rclpy.stacks.program import Program
from rsltrace.doors.rclpy.stacks.wait_reasons import who_waits
from rsltrace.errors import EXIT_RUN, RunError
from rsltrace.loop.loop import NOTHING_LEFT, Dispatchable, EventLoop
from rsltrace.loop.stop import Stop
from rsltrace.model.event import NO_EVENT, EventKind, OutputKind
from rsltrace.model.finding import Policy
from rsltrace.trace.chain import hash64
from rsltrace.trace.recorder import Recorder

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.context import ContextHandle
    from rsltrace.doors.rclpy.boundary.entity_handle import EntityHandle
    from rsltrace.doors.rclpy.boundary.node import NodeHandle
    from rsltrace.doors.rclpy.entry import Entry
    from rsltrace.doors.rclpy.logs import Logs
    from rsltrace.doors.rclpy.node_clocks import NodeClocks
    from rsltrace.doors.rclpy.node_state import NodeState
    from rsltrace.doors.rclpy.stacks.blocking_calls import Wait
    from rsltrace.doors.rclpy.stacks.executor import SimExecutor
    from rsltrace.doors.rclpy.stacks.tasks import TaskRun
    from rsltrace.doors.rclpy.stacks.threads import SimThread
    from rsltrace.middleware.census import Met, Parameters
    from rsltrace.middleware.graph import Graph
    from rsltrace.middleware.links import Network

# What waits for its callback group: the handle, since when (ns), and what to do when it is free.
Parked = tuple[Dispatchable, int, Callable[[], None]]

_pack_value = struct.Struct("<Bq").pack


class Core:
    """The state of one simulated ROS world.

    ``recorder`` is None in a run that records nothing, ``network`` in one without delay models,
    ``clocks`` where all of them are right. What the event under way sends leaves ``busy_ns`` later
    (execution times), and its executor is busy for ``took_ns``. A ``quiet`` event is recorded only
    if something comes of it. ``fed`` says that messages come from outside (bags).
    """

    def __init__(self, loop: EventLoop, *, base_dir: Path, seed: int = 0) -> None:
        # The run.
        self.loop = loop
        self.seed = seed
        self.base_dir = base_dir
        self.graph: Graph
        self.executor: SimExecutor
        self.logs: Logs
        self.network: Network | None = None
        self.clocks: NodeClocks | None = None
        self.default_policy = Policy()
        self.states: dict[str, NodeState] = {}
        self.notes: list[str] = []

        # The process: what happens in others, or in real threads, is not simulated.
        self.process = os.getpid()
        self.thread = get_ident()

        # The event under way, and what is done when it is over.
        self.current_node: NodeHandle | None = None
        self.on_node: Callable[..., None] | None = None
        """Told which node's code is going to run (or ``is_made``), if somebody has to know."""
        self.current_entity = 0
        self.current_handle: Dispatchable | None = None
        self.kind = 0
        self.cause_event = NO_EVENT
        self.cause_output = 0
        self.input_hash = 0
        self.flags = 0
        self.on_end: Callable[[], None] | None = None
        self.quiet = False
        self.busy_ns = 0
        self.took_ns = 0
        self.raised: BaseException | None = None

        # The trace: what has been created in this event, and what still has no owner.
        self.recorder: Recorder | None = None
        self.unrecorded = 0
        self.pending: list[EntityHandle | Program | SimThread] = []
        self.unowned: list[EntityHandle | Program | SimThread] = []
        self._entity_count = 0
        self.met: Met | None = None
        self.parameters: dict[str, Parameters] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._uuids: dict[str, random.Random] = {}
        self.watchers: dict[str, Callable[[Any, bytes], None]] = {}

        # Blocked calls, and the stacks that run the loop meanwhile.
        self.blocked: dict[Wait, None] = {}
        self.main: greenlet | None = None
        self.runners: list[greenlet] = []
        self.runner_maker: greenlet | None = None
        self.runner_error: BaseException | None = None
        self.parked: dict[object, list[Parked]] = {}
        self.arrivals = 0

        # Suspended coroutines, and those that are looked at when nothing else is ready.
        self.suspended: dict[TaskRun, None] = {}
        self.polled: list[TaskRun] = []
        self.polls = 0
        self.polling = False
        self.poll_stage: tuple[int, int] | None = None

        # What is being constructed, and programs and threads of user code.
        self.constructing: Entry | None = None
        self.importing = False
        self.main_context: ContextHandle | None = None
        self.host = Program(self)
        self.program = self.host
        self.programs: list[Program] = []
        self.threads: dict[SimThread, None] = {}
        self.thread_stacks: dict[greenlet, SimThread] = {}
        self.thread_count = 0

        # The end of the run.
        self.error: RunError | None = None
        self.stuck: list[str] = []
        self.ending = False
        self.ended_after: int | None = None
        self.closing = False
        self.grace_ns = 0
        self.shutdown_ns = 0
        self.refused = 0
        self.fed = False

    # -- the hot path ------------------------------------------------------------------------

    def execute(
        self,
        handle: Dispatchable,
        entity: int,
        node: NodeHandle | None,
        kind: int,
        callback: Callable[..., object],
        args: tuple[Any, ...],
        cause_event: int,
        cause_output: int,
        input_hash: int,
    ) -> None:
        """Run one event: call ``callback(*args)`` and record what came of it."""
        self.current_handle = handle
        self.current_entity = entity
        self.current_node = node
        if self.on_node is not None:
            self.on_node(node)
        self.kind = kind
        self.cause_event = cause_event
        self.cause_output = cause_output
        self.input_hash = input_hash
        try:
            callback(*args)
        except BaseException as error:
            failed(self, error, handle)
        self.end_event()
        if self.on_end is not None:
            on_end, self.on_end = self.on_end, None
            on_end()

    def end_event(self) -> None:
        """Record the event under way, which may be a later part of the one ``execute`` began."""
        if self.pending:
            self.settle()
        loop = self.loop
        recorder = self.recorder
        node = self.current_node
        state_hash = 0
        if node is not None and node.state is not None:
            state_hash = node.state.after_event()
        if recorder is None:
            self.unrecorded = 0
        else:
            recorder.end_event(
                loop.now_ns,
                self.kind,
                self.flags,
                self.current_entity,
                self.cause_event,
                self.cause_output,
                self.input_hash,
                state_hash,
            )
        loop.events += 1
        self.flags = 0
        self.quiet = False

    def said_anything(self) -> bool:
        """Return whether the event under way has had outputs."""
        outputs = self.unrecorded if self.recorder is None else self.recorder.outputs
        return bool(outputs or self.pending)

    @contextlib.contextmanager
    def outside_events(self) -> Iterator[None]:
        """Run what belongs to no event (a stop function, finalizers): it cannot wait."""
        handle, self.current_handle = self.current_handle, None
        try:
            yield
        finally:
            self.current_handle = handle

    # -- blocked calls -------------------------------------------------------------------------

    def next_runner(self) -> greenlet:
        """Return the stack to switch to when a callback blocks: who runs the loop from then on.

        New runners all begin on the stack of one maker, so that however many calls are blocked, the
        next callback does not run deeper (in Python's recursion limit, and in C).
        """
        if self.runners:
            return self.runners.pop()
        if self.runner_maker is None:
            self.runner_maker = greenlet(self._make_runners, self.main)
        return self.runner_maker

    def end_runners(self) -> None:
        """Let go of the stack that makes runners, or it would keep this world alive for ever."""
        maker, self.runner_maker = self.runner_maker, None
        if maker is not None:
            maker.throw()

    def _make_runners(self) -> None:
        while True:
            greenlet(self.take_over, self.main).switch()

    def take_over(self) -> None:
        """Run the loop on a stack of its own, because its runner's callback has blocked.

        When the loop ends, whatever stack it ran on, the stack that began the run goes on.
        """
        try:
            self.loop.run()
            self.note_end()
            self.note_stuck()
        except RunEnded:
            pass
        except BaseException as error:
            self.runner_error = error
            self.loop.stop(Stop("the run failed", EXIT_RUN))
        if any(blocked.stack is self.main for blocked in self.blocked):
            self.ending = True
        getcurrent().parent = self.main

    def note_end(self) -> None:
        """Remember how many events there were when the run ended: what follows is the ending."""
        if self.ended_after is None:
            self.ended_after = self.loop.events

    def note_stuck(self) -> None:
        """Remember who still waits if the run has ended because nothing can happen any more."""
        stopped = self.loop.stopped
        if stopped is not None and stopped.reason == NOTHING_LEFT and not self.stuck:
            self.stuck = who_waits(self)

    @property
    def entry(self) -> Entry | None:
        """The entry of the job whose constructor runs, as long as it has made no node."""
        return getattr(self.current_handle, "entry", None)

    @property
    def policy(self) -> Policy | None:
        """The guard's policy for whoever runs, or None for the job's."""
        if self.current_node is not None:
            return self.current_node.policy
        entry = self.entry
        return entry.policy if entry is not None else None

    # -- entities ----------------------------------------------------------------------------

    def new_entity_id(self) -> int:
        """Return the next entity id; 0 is the run itself."""
        self._entity_count += 1
        return self._entity_count

    def settle(self) -> None:
        """Write down the entities created in this event, now that their owners are known."""
        waiting = self.unowned
        self.unowned = []
        created, self.pending = self.pending, []
        for handle in [*waiting, *created]:
            if handle.settle():
                if self.met is not None and handle.announced:
                    self.met.add(handle.entity())
                if self.recorder is not None and handle.announced:
                    self.recorder.entity(handle.entity())
            else:
                self.unowned.append(handle)

    def random_uuid(self) -> uuid.UUID:
        """Return a random UUID from the stream of the present node: goals need ids."""
        name = self.current_node.fully_qualified_name if self.current_node is not None else ""
        stream = self._uuids.setdefault(name, random.Random(f"goal ids {self.seed} {name}"))
        return uuid.UUID(int=stream.getrandbits(128), version=4)

    def watch(self, topic: str, watcher: Callable[[Any, bytes], None]) -> None:
        """Call ``watcher(message class, canonical bytes)`` for every message on a topic."""
        first = self.watchers.get(topic)
        self.watchers[topic] = watcher if first is None else _both(first, watcher)
        for publisher in self.graph.publishers(topic):
            publisher._watcher = self.watchers[topic]

    def activate_node(self, node: NodeHandle) -> None:
        """Run the callbacks of a node from now on: an executor of this run has it."""
        for handle in _handles(node):
            if handle.wrapper is None:
                handle.node = handle.node or node
                handle.find_wrapper()
        if self.unowned:  # a timer made long before its node is spun is written down now
            self.pending += [one for one in self.unowned if getattr(one, "node", None) is node]
            self.unowned = [one for one in self.unowned if one not in self.pending]
        sync_waitables(self, node)

    def deactivate_node(self, node: NodeHandle) -> None:
        """Stop running the callbacks of a node; what it has received stays in its queues."""
        for handle in _handles(node):
            handle.deactivate()
        node.wrapper = None
        sync_waitables(self, node)

    def channel(
        self, topic: str, type_name: str, schema: Callable[[], tuple[str, str]], qos_yaml: str
    ) -> int:
        """Return the trace's channel for a topic, or -1 if its payloads are not kept.

        ``schema`` gives the schema text and the type hash when a channel has to be made.
        """
        recorder = self.recorder
        if recorder is None or not recorder.keep_payload(topic):
            return -1
        channel = self._channels.get((topic, type_name))
        if channel is None:
            text, type_hash = schema()
            channel = recorder.writer.add_channel(
                topic, type_name, text, qos_yaml=qos_yaml, type_hash=type_hash
            )
            self._channels[topic, type_name] = channel
        return channel

    # -- outputs other than messages -----------------------------------------------------------

    def note(self, kind: OutputKind, entity: int, operation: int = 0, value: int = 0) -> int:
        """Add a small output (a timer changed, a task was made); return its position."""
        if self.recorder is None:
            self.unrecorded += 1
            return 0
        return self.recorder.output(kind, entity, hash64(_pack_value(operation, value)))

    # -- callback groups -----------------------------------------------------------------------

    def park(self, group: object, handle: Dispatchable, retry: Callable[[], None]) -> None:
        """Keep an event whose callback group is busy; ``retry`` runs when the group is free."""
        self.parked.setdefault(group, []).append((handle, self.loop.now_ns, retry))

    def group_freed(self, group: object) -> None:
        """Let the events run that waited for ``group``, before anything else that is ready."""
        waiting = self.parked.pop(group, None)
        if waiting:
            for _, _, retry in reversed(waiting):
                retry()

    def waiting_for_group(self, group: object) -> int:
        """Return how many events wait until ``group`` is free."""
        return len(self.parked.get(group, ()))

    # -- who runs ------------------------------------------------------------------------------

    def outside(self, describe: Callable[[], str], entry: Entry | None) -> Dispatchable:
        """Return what stands for an event that is no entity's callback."""
        return OutsideEvent(describe, entry)

    def is_thread(self, stack: greenlet) -> bool:
        """Return whether a stack is that of a thread which user code has started."""
        return stack in self.thread_stacks

    def program_of(self, stack: greenlet) -> Program | None:
        """Return the program whose main runs on a stack, if it is one's."""
        return next((program for program in self.programs if program.stack is stack), None)

    def in_callback(self) -> bool:
        """Return whether the event under way is a callback's, not a main's or a thread's."""
        return not isinstance(self.current_handle, OutsideEvent)

    def run_outside(
        self,
        describe: Callable[[], str],
        kind: EventKind,
        entity: int,
        node: NodeHandle | None,
        callback: Callable[[], object],
        *,
        entry: Entry | None = None,
    ) -> None:
        """Run an event that is no entity's callback: construction, shutdown, a clock jump."""
        self.execute(
            OutsideEvent(describe, entry), entity, node, kind, callback, (), NO_EVENT, 0, 0
        )


def _both(
    first: Callable[[Any, bytes], None], second: Callable[[Any, bytes], None]
) -> Callable[[Any, bytes], None]:
    def watch(message_class: Any, data: bytes) -> None:
        first(message_class, data)
        second(message_class, data)

    return watch


def _handles(node: NodeHandle) -> Iterator[Any]:
    """Yield what runs callbacks of a node, in creation order of each kind."""
    for lists in ("subscriptions", "timers", "clients", "services", "guards"):
        for wrapper in getattr(node.wrapper, lists):
            yield wrapper.handle
    for waitable in node.wrapper.waitables:
        for name in OWN_WAITABLES:
            handle = getattr(waitable, name, None)
            if handle is not None:
                yield from getattr(handle, "parts", [handle])
