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
from types import FrameType
from typing import TYPE_CHECKING, Any

from greenlet import getcurrent, greenlet

from rsltrace.errors import EXIT_RUN, NodeError, OutputError, RsltraceError, RunError
from rsltrace.loop.loop import NOTHING_LEFT, Dispatchable, EventLoop
from rsltrace.loop.stop import Stop
from rsltrace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind
from rsltrace.model.finding import Policy
from rsltrace.model.stamp import format_seconds
from rsltrace.ros.blocking import RunEnded
from rsltrace.ros.failure import end_child, exit_status, text_of, user_traceback
from rsltrace.ros.missing import hint_for
from rsltrace.ros.program import Program, failure_of
from rsltrace.ros.waitables import OWN_WAITABLES, sync_waitables
from rsltrace.trace.chain import hash64
from rsltrace.trace.recorder import Recorder

if TYPE_CHECKING:
    from rsltrace.ros.arguments import RosArguments
    from rsltrace.ros.blocking import Wait
    from rsltrace.ros.context import ContextHandle
    from rsltrace.ros.entity_handle import EntityHandle
    from rsltrace.ros.entry import Entry
    from rsltrace.ros.executor import SimExecutor
    from rsltrace.ros.graph import Graph
    from rsltrace.ros.links import Network
    from rsltrace.ros.logs import Logs
    from rsltrace.ros.node import NodeHandle
    from rsltrace.ros.node_clocks import NodeClocks
    from rsltrace.ros.stating import NodeState
    from rsltrace.ros.tasks import TaskRun
    from rsltrace.ros.threads import SimThread

_RAISED = int(EventFlag.RAISED)
_LIFE = frozenset((EventKind.CONSTRUCT, EventKind.SHUTDOWN, EventKind.CLOCK_JUMP))
_ERROR = 40
_pack_value = struct.Struct("<Bq").pack


class Core:
    """The state of one simulated ROS world.

    ``recorder`` is None in a run that records nothing, ``network`` in one without delay models.
    ``current_*`` describe the event under way; what it sends leaves ``busy_ns`` later.
    """

    def __init__(self, loop: EventLoop, *, base_dir: Path, seed: int = 0) -> None:
        self.loop = loop
        self.seed = seed
        self.process = os.getpid()
        self.thread = get_ident()
        self.recorder: Recorder | None = None
        self.base_dir = base_dir
        self.graph: Graph
        self.executor: SimExecutor
        self.network: Network | None = None
        self.clocks: NodeClocks | None = None
        self.busy_ns = 0
        self.took_ns = 0
        self.current_node: NodeHandle | None = None
        self.current_entity = 0
        self.current_handle: Dispatchable | None = None
        self.kind = 0
        self.cause_event = NO_EVENT
        self.cause_output = 0
        self.input_hash = 0
        self.flags = 0
        self.on_end: Callable[[], None] | None = None
        self.blocked: dict[Wait, None] = {}
        self.runners: list[greenlet] = []
        self.runner_maker: greenlet | None = None
        self.main: greenlet | None = None
        self.runner_error: BaseException | None = None
        self.ending = False
        self.ended_after: int | None = None
        self.shutdown_ns = 0
        self.refused = 0
        self.stuck: list[str] = []
        self.error: RunError | None = None
        self.logs: Logs
        self.main_context: ContextHandle | None = None
        self.node_arguments: list[RosArguments] = []
        self.log_exceptions = False
        self.host = Program(self)
        self.program = self.host
        self.programs: list[Program] = []
        self.notes: list[str] = []
        self.closing = False
        self.grace_ns = 0
        self.importing = False
        self.threads: dict[SimThread, None] = {}
        self.thread_stacks: dict[greenlet, SimThread] = {}
        self.thread_count = 0
        self.fed = False
        self.arrivals = 0
        self.quiet = False
        self.unrecorded = 0
        self.raised: BaseException | None = None
        self.suspended: dict[TaskRun, None] = {}
        self.polled: list[TaskRun] = []
        self.polls = 0
        self.polling = False
        self.poll_stage: tuple[int, int] | None = None
        self.pending: list[EntityHandle | Program | SimThread] = []
        self.unowned: list[EntityHandle | Program | SimThread] = []
        self.default_policy = Policy()
        self.states: dict[str, NodeState] = {}
        self.watchers: dict[str, Callable[[Any, bytes], None]] = {}
        self._entity_count = 0
        self._parked: dict[object, list[Callable[[], None]]] = {}
        self._channels: dict[str, int] = {}
        self._uuids: dict[str, random.Random] = {}

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
        self.kind = kind
        self.cause_event = cause_event
        self.cause_output = cause_output
        self.input_hash = input_hash
        try:
            callback(*args)
        except BaseException as error:
            self._failed(error, handle)
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
            self.stuck = self.who_waits()

    def who_waits(self) -> list[str]:
        """Say of every suspended coroutine and blocked call what it waits for."""
        runs = [run.waits_for() for run in self.suspended if not run.task.cancelled()]
        runs += [blocked.waits_for() for blocked in self.blocked if not blocked.is_patient()]
        return runs + [f"(before: {note})" for note in self.notes] if runs else []

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
        channel = self._channels.get(topic)
        if channel is None:
            text, type_hash = schema()
            channel = recorder.writer.add_channel(
                topic, type_name, text, qos_yaml=qos_yaml, type_hash=type_hash
            )
            self._channels[topic] = channel
        return channel

    # -- outputs other than messages -----------------------------------------------------------

    def note(self, kind: OutputKind, entity: int, operation: int = 0, value: int = 0) -> int:
        """Add a small output (a timer changed, a task was made); return its position."""
        if self.recorder is None:
            self.unrecorded += 1
            return 0
        return self.recorder.output(kind, entity, hash64(_pack_value(operation, value)))

    def graph_name_of_future(self, future: object) -> str:
        """Say what would complete a future: the service it is a request to, if it is one."""
        if future is None:
            return "something that is not an rclpy Future"
        for client in self.graph.all_clients():
            if future in getattr(client.wrapper, "_pending_requests", {}).values():
                if client.queue:
                    return (
                        f"the response of {client.service}, which has arrived, but its client "
                        "shares a mutually exclusive callback group with this callback, which "
                        "keeps the group busy; give the client a callback group of its own"
                    )
                servers = len(self.graph.services(client.service))
                return f"the response of {client.service} ({servers} servers)"
        for action in (action for node in self.graph.nodes for action in node.actions):
            what: str = action.waits_for(future)
            if what:
                return what
        return "a Future that nobody completes"

    def called_service(self, frame: FrameType | None) -> str:
        """Say which service a stack waits for in ``Client.call``; empty if it is not there."""
        from rclpy.client import Client

        while frame is not None:
            if frame.f_code is Client.call.__code__:
                service = frame.f_locals["self"].handle.service
                servers = len(self.graph.services(service))
                return f"the response to a service call, of {service} ({servers} servers)"
            frame = frame.f_back
        return ""

    # -- callback groups -----------------------------------------------------------------------

    def park(self, group: object, retry: Callable[[], None]) -> None:
        """Keep an event whose callback group is busy; ``retry`` runs when the group is free."""
        self._parked.setdefault(group, []).append(retry)

    def group_freed(self, group: object) -> None:
        """Let the events run that waited for ``group``, before anything else that is ready."""
        waiting = self._parked.pop(group, None)
        if waiting:
            for retry in reversed(waiting):
                retry()

    def waiting_for_group(self, group: object) -> int:
        """Return how many events wait until ``group`` is free."""
        return len(self._parked.get(group, ()))

    # -- failures ------------------------------------------------------------------------------

    def _failed(self, error: BaseException, handle: Dispatchable) -> None:
        if isinstance(error, RunEnded):
            return
        if isinstance(error, OutputError):
            raise error  # the trace cannot be written: no event may be lost quietly
        if os.getpid() != self.process:
            end_child(error)
        self.flags |= _RAISED
        name = self.current_node.fully_qualified_name if self.current_node else ""
        label = handle.describe()
        stamp_ns = self.loop.now_ns
        text = user_traceback(error)
        said = text_of(error)
        if self.recorder is not None:
            content = f"{type(error).__qualname__}\0{said}"
            self.recorder.detail(
                OutputKind.EXCEPTION, self.current_entity, stamp_ns, text, hash64(content.encode())
            )
        if self._belongs_to_executor(handle) and not self._goes_on(error):
            # It comes out of the spin of whoever runs the callback; what becomes of it is theirs.
            self.raised = error
            self.program.failures.append((error, label, stamp_ns, text, name))
            return
        if isinstance(error, SystemExit):
            reason = f"{label} raised SystemExit"
            if error.code is not None and not isinstance(error.code, int):
                reason += f": {said}"  # what Python would print
            self.loop.stop(Stop(reason, exit_status(error)))
            return
        if isinstance(error, KeyboardInterrupt):
            self.loop.stop(Stop("interrupted", 130))
            return
        if self._goes_on(error):
            assert self.current_node is not None
            message = f"{label} raised {type(error).__qualname__}: {said}"
            self.logs.log(_ERROR, self.current_node.logger_name(), message, "", "", 0)
            return
        where = f"{label}, at simulated time {format_seconds(stamp_ns)} s"
        earlier = failure_of(self.program, error)
        if earlier is not None:
            self.error = earlier
        elif isinstance(error, RsltraceError):
            # Raised by the middleware itself: the message says what to do, this says where.
            failure = type(error).__new__(type(error))
            failure.__dict__.update(error.__dict__)
            Exception.__init__(failure, f"{said}\n  in {where}")
            self.error = failure if isinstance(failure, RunError) else RunError(str(failure))
        else:
            self.error = NodeError(
                f"{where} raised {type(error).__qualname__}: {said}{hint_for(error)}",
                node=name,
                entity=label,
                stamp_ns=stamp_ns,
                traceback_text=text,
            )
        self.error.__cause__ = error
        self.loop.stop(Stop(f"{label} raised {type(error).__qualname__}", self.error.exit_code))

    def outside(self, describe: Callable[[], str], entry: Entry | None) -> Dispatchable:
        """Return what stands for an event that is no entity's callback."""
        return _Outside(describe, entry)

    def is_thread(self, stack: greenlet) -> bool:
        """Return whether a stack is that of a thread which user code has started."""
        return stack in self.thread_stacks

    def program_of(self, stack: greenlet) -> Program | None:
        """Return the program whose main runs on a stack, if it is one's."""
        return next((program for program in self.programs if program.stack is stack), None)

    def in_callback(self) -> bool:
        """Return whether the event under way is a callback's, not a main's or a thread's."""
        return not isinstance(self.current_handle, _Outside)

    def _belongs_to_executor(self, handle: Any) -> bool:
        """Say whether an event was run by an executor of the user's own."""
        if isinstance(handle, _Outside):
            return False
        mailbox = getattr(handle, "mailbox", None)
        if mailbox is None and getattr(handle, "node", None) is not None:
            mailbox = handle.node.mailbox
        return mailbox is not None

    def _goes_on(self, error: BaseException) -> bool:
        """Say whether an exception is only logged: of a callback whose job entry says so.

        What rsltrace itself refuses always ends the run; so does a node that was never made.
        """
        node = self.current_node
        if node is None or not node.log_exceptions or self.kind in _LIFE:
            return False
        return isinstance(error, Exception) and not isinstance(error, RsltraceError)

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
        self.execute(_Outside(describe, entry), entity, node, kind, callback, (), NO_EVENT, 0, 0)


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


class _Outside:
    """A nameable stand-in for an entity in ``run_outside``."""

    def __init__(self, describe: Callable[[], str], entry: Entry | None) -> None:
        self.describe = describe
        self.entry = entry

    def dispatch(self) -> None:
        raise AssertionError("never in a queue")
