"""One process of a run: what it says becomes outputs, and it goes on when the loop lets it."""

from __future__ import annotations

import signal
import struct
from collections.abc import Callable, Sequence
from typing import Protocol

from rsltrace.adapters.processes import graph_answers
from rsltrace.adapters.processes.child import Batch, ProcessEnd, ProcessHandle
from rsltrace.adapters.processes.endpoints import (
    ProcessClient,
    ProcessService,
    ProcessTimer,
    WaitableEntity,
)
from rsltrace.adapters.processes.process_entities import (
    EntityFactory,
    GraphChange,
    ProcessEntities,
    WakingTimer,
)
from rsltrace.adapters.processes.source_lines import report_text, stack_text
from rsltrace.adapters.processes.wire import (
    GO,
    GRAPH_ID,
    HEAD,
    NEVER_NS,
    RECORD,
    CommandKind,
    RecordKind,
    RecordReader,
    WakeReason,
    WireError,
    gid_of,
    packed_qos,
)
from rsltrace.errors import NodeError, RunError
from rsltrace.simulation.middleware.participant import Participant
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventFlag, EventKind
from rsltrace.trace.model.finding import NondeterminismSource, unseen_text
from rsltrace.trace.model.texts import format_seconds, variable_text

_RESUME = int(EventKind.RESUME)
_SUSPENDED = int(EventFlag.SUSPENDED)
_GRACE_S = 5.0
"""How long a process may take (in real time) to end on command."""
_WAITER = struct.Struct("<IIqI")
_DEADLINE = struct.Struct("<Iq")
_REQUEST_ID = struct.Struct("<I16sq")
_HELLO = struct.Struct("<qQIII")
_SHOWN = struct.Struct("<qI")
_SOURCES = (
    NondeterminismSource.RANDOM,
    NondeterminismSource.CLOCK,
    NondeterminismSource.PID,
    NondeterminismSource.ENVIRONMENT,
)
"""What is drawn, by the numbers of ``native/call_sites.h``."""
_RECORD_SIZE = RECORD.size
_PUBLISH, _WAIT = int(RecordKind.PUBLISH), int(RecordKind.WAIT)
_head, _number = RECORD.unpack_from, HEAD.unpack_from
_NOT_A_BATCH = (WireError, LookupError, ValueError, TypeError, AttributeError, struct.error)
"""What reading raises if something else than the library has written to the link."""
_CRASHES = (signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV)
_WROTE = "wrote something of its own to"

Question = Callable[[RecordReader], bytes]


def _as_traceback(stack: Sequence[str]) -> str:
    """Return lines of a C++ stack as Python prints its own."""
    lines = ["Traceback (most recent call last):\n"] if stack else []
    for one in reversed(stack):
        place, _, function = one.partition(" in ")
        file, _, number = place.rpartition(":")
        line = f'"{file}", line {number}, in {function}' if function else f'"{place}"'
        lines.append(f"  File {line}\n")
    return "".join(lines)


class ProcessRun(EntityFactory, Protocol):
    """What a process finds in its run."""

    log: Callable[[int, str, str], None]
    follows_clock: Callable[[str], bool]
    note_answer: Callable[[NondeterminismSource, str, str, str, str, int], None]
    clock: Callable[[str | None, bool], tuple[int, bool]] | None

    def seed_of(self, key: str) -> int:
        """Return the number from which a process draws what others take for entropy."""

    def has_ended(self, process: Process) -> None:
        """Take note that a process has ended, in the event under way."""

    def begin_others(self, running: Process) -> None:
        """Let others begin with what comes next for them while one computes."""


class Process:
    """An executable that runs beside rsltrace; in the trace, a main.

    ``things`` are its nodes, endpoints and timers.
    """

    def __init__(
        self,
        adapter: ProcessRun,
        name: str,
        key: str,
        *,
        log_failure: bool,
        instant_sleep: bool = False,
        intra_process: bool = False,
    ) -> None:
        self.adapter = adapter
        self.dispatcher = adapter.domain.dispatcher
        self.name = name
        self.key = key
        self.log_failure = log_failure
        self.instant_sleep = instant_sleep
        self.intra_process = intra_process
        self.entity_id = 0
        self.announced = True
        self.begun_ns = 0
        self.has_begun = False
        """Whether it computes before its turn (``ProcessAdapter.begin_others``)."""
        self.child: ProcessHandle
        self.ended: ProcessEnd | None = None
        self.things = ProcessEntities(adapter, self)
        self._wanted: dict[int, int] = {}
        """Which thread waits for a thing."""
        self._waits: tuple[tuple[int, int], ...] = ()
        self._sets: dict[int, tuple[int, ...]] = {}
        self._waking: dict[int, WakingTimer] = {}
        self._held: list[WaitableEntity] = []
        self._running_thread = 0
        self._same_wait = b""
        """What it waited for last, if that has no end."""
        self._waking_soon = False
        self._last: WaitableEntity | None = None
        self._is_stopping = False
        self.code_files: set[str] = set()
        """What it had loaded when it started and when the run ended."""
        self._crashed_at: list[str] = []
        """The lines of its own code, innermost first."""
        self._graph = GraphChange(self)
        adapter.domain.graph.changed.append(self._graph.note)
        self._questions: dict[int, Question] = {
            RecordKind.HELLO: self._hello,
            RecordKind.TAKE: self._take,
            RecordKind.READY: self._ready,
            RecordKind.GID: lambda fields: gid_of(self.things[fields.number()].entity_id),
            RecordKind.QOS: self._qos,
            RecordKind.MATCHED: self._matched,
            RecordKind.FOLLOWS: lambda fields: HEAD.pack(
                adapter.follows_clock(self.things.last_name)
            ),
            RecordKind.CLOCK: self._clock,
            RecordKind.CLOCK_OWNER: self._owner_of_new_clock,
            RecordKind.GRAPH: lambda fields: graph_answers.answer(adapter.domain.graph, fields),
        }
        self._records: dict[int, Callable[[RecordReader], None]] = {
            **self.things.records,
            RecordKind.GONE: self._gone,
            RecordKind.REQUEST: self._request,
            RecordKind.RESPONSE: self._response,
            RecordKind.LOG: self._log,
            RecordKind.REPORT: self._report,
            RecordKind.TIMER_PASSED: self._timer_passed,
            RecordKind.TIMER_NEXT: self._timer_next,
            RecordKind.WAIT_SET: self._wait_set,
            RecordKind.ALIVE: self._alive,
            RecordKind.UNSEEN: self._unseen,
            RecordKind.DRAW: self._draw,
            RecordKind.CRASH: self._crash,
            RecordKind.DROPPED: lambda fields: self.things[fields.number()].drop(),
        }

    # -- as the trace has it ---------------------------------------------------------------------

    def describe(self) -> str:
        """Name the process for people."""
        return self.name

    def settle(self) -> bool:
        """Return whether its owner is known: it has none."""
        return True

    def entity(self) -> Entity:
        """Return the process as the trace describes it."""
        return Entity(self.entity_id, 0, EntityKind.MAIN, self.name, "", self.begun_ns, {})

    @property
    def has_failed(self) -> bool:
        """Whether it has ended as it should not, while the run went on."""
        return self.ended is not None and self.ended.failed and not self._is_stopping

    # -- going on --------------------------------------------------------------------------------

    def begin(self, child: Callable[[], ProcessHandle]) -> None:
        """Start it, and let it run up to its first wait, within the event under way."""
        self.child = child()
        self._converse()

    @property
    def waits_for_graph(self) -> bool:
        """Whether one of its threads waits for a change of the graph now."""
        return GRAPH_ID in self._wanted

    def wants(self, thing: WaitableEntity) -> bool:
        """Return whether one of its threads waits for a thing now."""
        return thing.number in self._wanted

    def hold(self, thing: WaitableEntity) -> None:
        """Keep what is ready until the process waits for it."""
        self._held.append(thing)

    def go_on_with(self, number: int, ready: WakeReason, item: bytes) -> None:
        """Let the thread that waits for a thing go on, until the process waits again."""
        thing = self.things[number]
        self._last = thing
        self._go(self._wanted[number], ready, number, item)

    def wake(self, thread: int) -> None:
        """Let a thread go on whose time has come."""
        self._go(thread, WakeReason.TIMEOUT, 0, b"")

    def see_graph(self) -> None:
        """Let those threads go on that wait for a change of the graph."""
        self._go(self._wanted[GRAPH_ID], WakeReason.GRAPH, GRAPH_ID, b"")

    def own(self, timer: ProcessTimer) -> None:
        """Give a timer whose callback has run to a node."""
        self.things.own(timer)

    def was_no_callback(self) -> None:
        """Note that the event under way is no callback's: an executor's own timer was due."""
        event = self.dispatcher.event
        event.kind, event.entity, event.node, event.input_hash = _RESUME, self.entity_id, None, 0

    def _go(self, thread: int, ready: WakeReason, number: int, item: bytes) -> None:
        waking = self._waking.get(thread)
        if waking is not None:
            waking.off()
        self._running_thread = thread
        if self.has_begun:
            self.has_begun = False
        else:
            self._send_go(thread, ready, number, item)
        self.adapter.begin_others(self)
        self._converse()

    def begin_with(self, number: int, ready: WakeReason, item: bytes) -> None:
        """Let the thread that waits for a thing go on already; ``go_on_with`` follows."""
        self.has_begun = True
        self._send_go(self._wanted[number], ready, number, item)

    def _send_go(self, thread: int, ready: WakeReason, number: int, item: bytes) -> None:
        now_ns = self.dispatcher.loop.now_ns
        head = GO.pack(GO.size - 8 + len(item), CommandKind.GO, now_ns, thread, ready, number)
        self.child.send(head + item)

    def _converse(self) -> None:
        """Take what the process says until it waits again, or has ended."""
        while True:
            try:
                batch = self.child.receive()
                answer = b"" if batch is None else self._take_batch(batch)
                if batch is not None and answer == b"":
                    raise WireError("a process has sent half a batch")
            except _NOT_A_BATCH:
                self.child.kill()
                self._has_ended(_WROTE)
                return
            if batch is None:
                self._has_ended()
                return
            self.child.said.taken()
            if answer is None:
                return
            self.child.send(answer)

    def _take_batch(self, batch: Batch) -> bytes | None:
        """Do what a batch says; return the answer to the question at its end, None if it waits."""
        said, place, end = batch
        while place < end:
            kind, size = _head(said, place)
            begin, place = place + _RECORD_SIZE, place + _RECORD_SIZE + size
            if kind == _PUBLISH:
                self.things[_number(said, begin)[0]].send(said[begin + 4 : place])
                continue
            body = said[begin:place]
            if kind == _WAIT:
                if body != self._same_wait or self._held:
                    self._wait(RecordReader(body))
                    self._same_wait = b"" if self._waking_soon else body
                return None
            fields = RecordReader(body)
            question = self._questions.get(kind)
            if question is not None:
                answer = question(fields)
                return RECORD.pack(len(answer), CommandKind.ANSWER) + answer
            self._records[kind](fields)
        return b""

    # -- waiting ---------------------------------------------------------------------------------

    def _wait_set(self, fields: RecordReader) -> None:
        thread, number, count = fields.number(), fields.number(), fields.number()
        ids = fields.unpack(struct.Struct(f"<{count}I"))
        self._sets = {n: s for n, s in self._sets.items() if s[:1] != (thread,)}
        self._sets[number] = (thread, *ids)

    def _wait(self, fields: RecordReader) -> None:
        """Take note of what its threads wait for."""
        event = self.dispatcher.event
        waits = []
        self._waking_soon = False
        timed = set()
        for _ in range(fields.number()):
            thread, number, deadline_ns, size = fields.unpack(_WAITER)
            fields.unpack(struct.Struct(f"{size}s"))
            waits.append((thread, number))
            if number == 0 and thread == self._running_thread:
                event.flags |= _SUSPENDED
            if number == 0 or deadline_ns != NEVER_NS:
                self._waking_soon = True
            if deadline_ns != NEVER_NS:
                self._wake_at(thread, deadline_ns, asleep=number == 0)
                timed.add(thread)
        for thread in self._waking.keys() - timed:  # another thread has woken it
            self._waking[thread].off()
        if self._waits != tuple(waits):
            self._waits = tuple(waits)
            self._wanted = {
                thing: thread
                for thread, number in waits
                if number
                for thing in self._sets[number][1:]
            }
        if self._held:
            self._release()
        self._graph.look()

    def _wake_at(self, thread: int, deadline_ns: int, *, asleep: bool) -> None:
        waking = self._waking.get(thread)
        if waking is None:
            waking = self._waking[thread] = WakingTimer(self, thread)
        waking.at(deadline_ns, asleep=asleep)

    def _release(self) -> None:
        """Let go of what was held back and is waited for now."""
        loop = self.dispatcher.loop
        held, self._held = self._held, []
        for thing in held:
            if thing.destroyed:
                continue
            if thing.number not in self._wanted:
                self._held.append(thing)
            elif isinstance(thing, ProcessTimer):
                if not thing.state.canceled:
                    loop.timers.add(thing.state)
            else:
                loop.ready.append(thing)

    # -- its end ---------------------------------------------------------------------------------

    def _has_ended(self, broken_link: str = "") -> None:
        """Take it out of the graph, within the event under way; ``broken_link``: ``ProcessEnd``.

        :raises NodeError: if it has failed, and the job does not say to go on.
        """
        ended = self.child.reap()
        try:
            self._take_batch(self.child.said.batch())
        except _NOT_A_BATCH:
            broken_link = _WROTE
        self.ended = ProcessEnd(ended.status, broken_link or ended.broken_link)
        self.vanish()
        self.adapter.has_ended(self)
        where = f" at {self._crashed_at[0]}" if self._crashed_at else ""
        if self._is_stopping:
            if -ended.status in _CRASHES:  # a destructor, after SIGINT
                note = f"process {self.name} {ended.said} when the run was over{where}"
                self.adapter.domain.outcome.notes.append(note)
            return
        at = format_seconds(self.dispatcher.loop.now_ns)  # of ROS: the text is hashed
        if not self.ended.failed:
            self.adapter.domain.outcome.notes.append(f"process {self.name} ended at {at} s")
            return
        last = "its start" if self._last is None else self._last.describe()
        happened = f"process {self.name} {self.ended.said} at {at} s"
        text = f"{happened}; the last that it ran was {last}"
        if self.log_failure:
            self.adapter.log(40, self.name, text)
            if where:
                self.adapter.domain.outcome.notes.append(f"process {self.name} crashed{where}")
        else:
            raise NodeError(
                text,
                node="",
                entity=self.name,
                stamp_ns=self.dispatcher.loop.now_ns,
                traceback_text=_as_traceback(self._crashed_at),
            )

    def stop(self) -> None:
        """Tell it as whoever starts nodes does that the run is over (Ctrl-C), and end it once it
        waits again."""
        self._is_stopping = True
        self.child.give_up_after(_GRACE_S)
        if self.has_begun:  # an event that the run does not have any more
            recorder, self.dispatcher.recorder = self.dispatcher.recorder, None
            try:
                self._converse()
            finally:
                self.dispatcher.recorder = recorder
            if self.ended is not None:
                return
        self.code_files |= self.child.code_files()
        self.child.send(RECORD.pack(0, CommandKind.STOP))
        self._converse()
        if self.ended is None:
            self.child.dismiss()
            self.vanish()

    def crash(self) -> None:
        """Be gone at once, as after SIGKILL, within the event under way."""
        self._is_stopping = True
        self.child.kill()
        self._has_ended()

    def vanish(self) -> None:
        """Destroy all that it has made."""
        for waking in self._waking.values():
            waking.off()
        self.things.give_all_up()
        self._wanted.clear()

    # -- what it asks ----------------------------------------------------------------------------

    def _hello(self, fields: RecordReader) -> bytes:
        self.code_files |= self.child.code_files()
        adapter, now_ns = self.adapter, self.dispatcher.loop.now_ns
        seed, own_clocks = adapter.seed_of(self.key), adapter.clock is not None
        return _HELLO.pack(now_ns, seed, own_clocks, self.instant_sleep, self.intra_process)

    def _clock(self, fields: RecordReader) -> bytes:
        """Answer what a clock shows: that of a node, or of the running one."""
        node = self.things.get(fields.number()) or self._running_node()
        assert self.adapter.clock is not None, "it asks where there are such clocks"
        name = None if node is None else node.fully_qualified_name
        return _SHOWN.pack(*self.adapter.clock(name, bool(fields.number())))

    def _running_node(self) -> Participant | None:
        """Return the node whose callback runs, else the one that was made last."""
        node = self.dispatcher.event.node
        return node if isinstance(node, Participant) else self.things.last_node

    def _owner_of_new_clock(self, fields: RecordReader) -> bytes:
        return HEAD.pack(self.things.number_of(self.things.newest_node or self._running_node()))

    def _take(self, fields: RecordReader) -> bytes:
        item = self.things[fields.number()].take()
        return HEAD.pack(0) if item is None else HEAD.pack(1) + item

    def _ready(self, fields: RecordReader) -> bytes:
        """Answer which of these entities are ready, in the order the loop would run them."""
        asked = [self.things[fields.number()] for _ in range(fields.number())]
        order = dict.fromkeys((*self._held, *self.dispatcher.loop.ready))
        places = {thing: place for place, thing in enumerate(order)}
        ready = [thing.number for thing in asked if thing.may_run()]
        ready.sort(key=lambda number: (places.get(self.things[number], len(places)), number))
        return struct.pack(f"<{1 + len(ready)}I", len(ready), *ready)

    def _qos(self, fields: RecordReader) -> bytes:
        end = self.things[fields.number()]
        return packed_qos(
            end.profile if isinstance(end, ProcessService | ProcessClient) else end.qos
        )

    def _matched(self, fields: RecordReader) -> bytes:
        end = self.things[fields.number()]
        others = end.subscriptions if isinstance(end, Publisher) else end.publishers
        return HEAD.pack(len(others))

    def _gone(self, fields: RecordReader) -> None:
        self.things.give_up(fields.number())
        self._waits, self._same_wait = (), b""

    # -- what it does ----------------------------------------------------------------------------

    def _request(self, fields: RecordReader) -> None:
        self.things[fields.number()].request(fields.rest())

    def _response(self, fields: RecordReader) -> None:
        number, gid, sequence = fields.unpack(_REQUEST_ID)
        self.things[number].answer(gid, sequence, fields.rest())

    def _log(self, fields: RecordReader) -> None:
        self.adapter.log(fields.number(), fields.text(), fields.text())

    def _report(self, fields: RecordReader) -> None:
        notes = self.adapter.domain.outcome.notes
        note = f"process {self.name}: {report_text(fields.text())}"
        if note not in notes:  # it waits for the same again after the signal that ends the run
            notes.append(note)

    def _timer_passed(self, fields: RecordReader) -> None:
        self.things[fields.number()].is_callback = False

    def _timer_next(self, fields: RecordReader) -> None:
        number, deadline_ns = fields.unpack(_DEADLINE)
        timer = self.things[number]
        if deadline_ns == NEVER_NS:
            timer.cancel()
        else:
            timer.due_at(deadline_ns)

    def _draw(self, fields: RecordReader) -> None:
        source, calls = _SOURCES[fields.number()], fields.number()
        call = fields.text()
        if source is NondeterminismSource.ENVIRONMENT:
            is_set, value = fields.number(), fields.text()
            answer = variable_text(call, value) if is_set else repr(None)
            call = f"getenv({call!r})"
        else:
            answer = fields.text()
        running = self._running_node()
        node = running.key if running is not None else ""
        self.adapter.note_answer(source, call, answer, stack_text(fields.rest()), node, calls)

    def _crash(self, fields: RecordReader) -> None:
        self._crashed_at = stack_text(fields.rest()).splitlines()

    def _alive(self, fields: RecordReader) -> None:
        self.things[fields.number()].assert_liveliness()

    def _unseen(self, fields: RecordReader) -> None:
        """Take note of a publisher whose messages do not leave the process.

        :raises RunError: if a rule of the job goes by them.
        """
        publisher = self.things[fields.number()]
        topic = publisher.topic
        self.adapter.domain.outcome.unseen.setdefault(topic, self.name)
        if publisher.observers is not None and publisher.observers.watchers:
            raise RunError(f"{unseen_text([topic], self.name)}; a rule of the job goes by {topic}")
