"""Replay one node of a trace."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rsltrace.diff.options import DiffOptions
from rsltrace.errors import ReplayError
from rsltrace.replay.one_node.from_bag import replay_from_bag
from rsltrace.replay.one_node.output_comparison import (
    NodeOutputs,
    OutputWatch,
    output_changes,
    outputs_of_node,
)
from rsltrace.replay.one_node.result import Column, NodeReplayResult, RecordingColumns
from rsltrace.replay.one_node.script import RecordedScript, ReplayedEntry, check_payloads
from rsltrace.replay.preparation import NOT_KEPT, ReplayOutput, ReplayPlan
from rsltrace.replay.verification import interruption
from rsltrace.run import RunResult
from rsltrace.run.plans.entries import add_job_location, hook_entries, node_entries
from rsltrace.run.plans.recorded_order import definition_of
from rsltrace.run.plans.scheduling import is_ordered, scheduling_plan, switches_at_lines
from rsltrace.run.process import preserved_process
from rsltrace.run.session import RunSession
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.loop.policy import Fifo
from rsltrace.simulation.loop.recorded_input_loop import (
    OrderedRecordedInputLoop,
    RecordedInputLoop,
    stop_at_recorded_end,
)
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder
from rsltrace.simulation.middleware.services import Client
from rsltrace.trace.format import METADATA_RECORDED_INPUTS
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.reader import Trace

_BEGIN = (EventKind.SERVICE, EventKind.ACTION)


class ServiceAnswers:
    """The requests of the node's clients until they are answered."""

    def __init__(self, columns: RecordingColumns, is_own: Callable[[Column], Column]) -> None:
        events, outputs = columns.events, columns.outputs
        self._columns = columns
        self._asked: dict[tuple[int, int], tuple[int, int]] = {}
        """By requesting event and output: (client, number of the request)."""
        counts: dict[int, int] = {}
        places = np.flatnonzero((outputs["kind"] == OutputKind.REQUEST) & is_own(outputs["entity"]))
        for place in places.tolist():
            event, client = int(outputs["event"][place]), int(outputs["entity"][place])
            counts[client] = counts.get(client, 0) + 1
            position = place - int(columns.first_output[event])
            self._asked[event, position] = client, counts[client]
        self._got: dict[tuple[int, int], int] = {}
        """By answering event and output: the client."""
        self._open: dict[int, list[tuple[int, int, int]]] = {}
        """By service: (event that took it, client, number) of open requests, oldest first."""
        self._untaken: dict[int, list[int]] = {}
        """By client, the numbers of requests that no recorded event took."""
        if not self._asked:
            return
        own = is_own(events["entity"])
        for index in np.flatnonzero(own & (events["cause_event"] < len(events))).tolist():
            row = events[index]
            cause = int(row["cause_event"]), int(row["cause_output"])
            self._got.setdefault(cause, int(row["entity"]))
        for index in np.flatnonzero(~own & np.isin(events["kind"], _BEGIN)).tolist():
            row = events[index]
            asked = self._asked.get((int(row["cause_event"]), int(row["cause_output"])))
            if asked is not None:
                self._open.setdefault(int(row["entity"]), []).append((index, *asked))
        taken = {asked[1:] for waiting in self._open.values() for asked in waiting}
        for client, number in self._asked.values():
            if (client, number) not in taken:
                self._untaken.setdefault(client, []).append(number)

    def of(self, event: int, position: int, service: int) -> tuple[int, int] | None:
        """Return (recorded client, number of its request) that a response answers; None if it is
        for another node. Responses must be asked for in order."""
        waiting = self._open.get(service, [])
        for place, (begun, client, number) in enumerate(waiting):
            if begun == event:
                del waiting[place]
                return client, number
        asked_by = self._got.get((event, position))
        if asked_by is None:
            asked_by = self._drawn_for(event, position)
        for place, (begun, client, number) in enumerate(waiting):
            if begun < event and client == asked_by:
                del waiting[place]
                return client, number
        # In the trace of one node alone no event takes the requests: they are answered in order.
        numbers = self._untaken.get(asked_by)
        return (asked_by, numbers.pop(0)) if numbers else None

    def _drawn_for(self, event: int, position: int) -> int:
        """Return the client of the draw that follows a response, or -1."""
        rows = self._columns.outputs_of(event)[position + 1 : position + 2]
        drawn = len(rows) and rows["kind"][0] == OutputKind.DRAW
        return int(rows["entity"][0]) if drawn else -1


class NodeReplaySession(RunSession):
    """A session that runs one entry. The recording replaces the job's bags, stop conditions, policy
    and executors."""

    loop: RecordedInputLoop

    def __init__(
        self,
        plan: ReplayPlan,
        columns: RecordingColumns,
        unit: ReplayedEntry,
        path: Path,
        to: ReplayOutput,
    ) -> None:
        recorded = Path(os.path.abspath(plan.trace.name)) if plan.job.guard.enabled else None
        super().__init__(
            plan.job, path, force=to.force, echo=to.echo, observer=to.observer, replay=recorded
        )
        self._columns = columns
        self._unit = unit
        self._trace = plan.trace
        self.script = RecordedScript(columns, unit, self._perform)
        self._answers = ServiceAnswers(columns, unit.is_own)

    def _open_bags(self, stack: ExitStack, notes: object) -> None:
        self._bags = []
        self._notes = ()
        events = self._columns.events
        jumps = events["stamp"][events["kind"] == EventKind.CLOCK_JUMP]
        self.start_ns = self._trace.start_ns
        if not self._trace.result and len(jumps):
            self.start_ns = int(jumps[0])
        self.end_ns = self.script.end_ns

    def _loop_class(self) -> type[EventLoop]:
        ordered = is_ordered(self.job) or self.job.timer_ties != "creation"
        return OrderedRecordedInputLoop if ordered else RecordedInputLoop

    def _order_events(self, stack: ExitStack) -> None:
        loop = self.loop
        self._recorded = None
        loop.script = self.script
        loop.by_steps, loop.min_step_ns = bool(loop.min_step_ns), 0
        if isinstance(loop, OrderedRecordedInputLoop):
            plan = scheduling_plan(self.job, self.start_ns, Fifo())
            self.world.use_scheduling(loop, replace(plan, occupies=False))
            loop.has_workers = plan.occupies
            policy = self.job.policy
            loop.by_policy = policy is not None and policy.order != "fifo"

    def _import_targets(self) -> None:
        from rsltrace.adapters.stand_ins import StandIns

        job, world = self.job, self.world
        self._stand_ins = StandIns(world.domain, self._definition)
        self.loop.stop_conditions = (stop_at_recorded_end(self.script, self.loop),)  # type: ignore[assignment]
        hooks = int(job.hooks.before is not None)
        nodes = range(hooks, hooks + len(job.nodes))
        with world.importing():
            self._entries = []
            if hooks and 0 in self._unit.entries:
                self._entries += hook_entries(job, "before", job.hooks.before, lambda: job)
            wanted = [place - hooks for place in self._unit.entries if place in nodes]
            self._entries += node_entries(job, wanted)
            if any(place >= nodes.stop for place in self._unit.entries):
                self._entries += hook_entries(job, "after", job.hooks.after, world.all_nodes)

    def _payload_filter(self) -> Callable[[str], bool]:
        return lambda topic: True

    def _open_trace(self, stack: ExitStack, path: Path) -> None:
        super()._open_trace(stack, path)
        assert self._writer is not None
        values = {
            "node": self._unit.node.name,
            "entries": ",".join(map(str, self._unit.entries)),
        }
        self._writer.add_metadata(METADATA_RECORDED_INPUTS, values)
        dispatcher = self.world.domain.dispatcher
        dispatcher.add_observer(_Progress(dispatcher, self.script))

    @property
    def fed(self) -> int:
        """How many recorded messages, requests and responses the node has received."""
        return self._stand_ins.fed

    def unused(self, *, lasted: bool = False) -> tuple[str, ...]:
        return ()

    def begin(self) -> None:
        """Construct the entry at its recorded place, and jump to the start."""
        world, unit = self.world, self._unit
        entries = dict(zip(unit.entries, self._entries, strict=True))
        last = 0
        with self._failures(), self._engaged():
            world.plan(self._entries, self.start_ns)
            world.runtime.programs.fed = True
            for place, event in enumerate(self._columns.constructions):
                entry = entries.get(unit.entry_of(place))
                if self._starts_later(unit.entry_of(place)):
                    if entry is not None:
                        world.starts.add_at(entry, int(self._columns.events["stamp"][event]))
                    continue
                last = event + 1
                if entry is None:
                    continue
                self.script.perform_until(event)
                if not world.construct(entry):
                    add_job_location(self.job, entry, world.error)
                    break
            if not self.ended:
                self.script.perform_until(last)
                world.jump(self.start_ns)
                self.has_begun = not self.ended

    def _starts_later(self, place: int) -> bool:
        """Whether an entry (its place among hooks and nodes) starts after the run does."""
        index = place - int(self.job.hooks.before is not None)
        nodes = self.job.nodes
        return 0 <= index < len(nodes) and nodes[index].start_after is not None

    def _perform(
        self,
        event: int,
        created: list[Entity],
        sent: list[tuple[int, Any]],
        busy_ns: int,
    ) -> None:
        from rsltrace.adapters.stand_ins import Sent

        found = []
        for position, row in sent:
            kind, entity = OutputKind(int(row["kind"])), int(row["entity"])
            answers = None
            if kind is OutputKind.RESPONSE:
                answers = self._answers.of(event, position, entity)
                if answers is None:
                    continue
            data = self._payload(event, position)
            found.append(Sent(kind, entity, data, int(row["hash"]), answers))
        self._stand_ins.perform(created, found, busy_ns, self._client)

    def _payload(self, event: int, position: int) -> Callable[[], bytes]:
        def read() -> bytes:
            data = self._columns.payload(event, position)
            if data is None:
                output = self._trace.outputs_of(event)[position]
                name = self._trace.entity(output.entity).name
                raise ReplayError(
                    f"{self._trace.name} does not hold the messages of {name}, which "
                    f"{self._unit.node.name} asks for now: record once more with them "
                    "(record.topics)"
                )
            return data

        return read

    def _client(self, recorded: int) -> Client | None:
        """Return the client that corresponds to a recorded one, if it exists."""
        present = self.script.present(recorded)
        clients = self.world.domain.graph.clients(self._trace.entity(recorded).name)
        return next((one for one in clients if one.entity_id == present), None)

    def _definition(self, type_name: str) -> tuple[str, str]:
        return definition_of(self._trace, type_name)


class _Progress(EventObserver):
    """Reports the node's entities and events to the script."""

    order = ObserverOrder.SCRIPT

    def __init__(self, dispatcher: Dispatcher, script: RecordedScript) -> None:
        self._dispatcher = dispatcher
        self._script = script
        self._names: dict[int, str] = {0: ""}

    def entity_created(self, entity: Entity) -> None:
        if entity.node == entity.id:
            self._names[entity.id] = entity.name
        self._script.match_entity(entity, self._names.get(entity.node, ""))

    def after_event(self) -> None:
        event = self._dispatcher.event
        if event.kind != EventKind.BAG:
            self._script.happened(event.kind, event.entity, self._dispatcher.loop.now_ns)


def run_node(session: NodeReplaySession, watch: OutputWatch | None = None) -> RunResult:
    with session:
        if watch is not None:
            watch.attach(session)
        session.begin()
        if not session.ended:
            session.go_on()
        return session.finish()


CHANGED = Stop("the first output that is not as recorded", 1)


def replay_node(
    plan: ReplayPlan,
    node: str,
    bags: Sequence[Path] = (),
    *,
    until_diverged: bool = False,
    options: DiffOptions | None = None,
    to: ReplayOutput = NOT_KEPT,
) -> NodeReplayResult:
    """Run one node of a trace alone with its recorded inputs, or those of bags; compare its
    outputs.

    :raises ReplayError: there is no such node, or the trace lacks its inputs.
    :raises JobError, SetupError, OutputError: the run cannot start or be written.
    """
    if bags:
        return replay_from_bag(plan.job, node, bags, options=options, to=to)
    trace = plan.trace
    if plan.edits:
        raise ReplayError(f"{trace.name} is a branch with edits, which replays as a whole only")
    if switches_at_lines(plan.job):
        raise ReplayError(
            f"{trace.name} was made with threads: {{switch: every_line}}: where a callback gives "
            "way depends on all of its process, so it replays as a whole only; leave out --node"
        )
    columns = RecordingColumns(trace)
    unit = ReplayedEntry(columns, plan.job, node, entries_of(trace, columns))
    check_payloads(columns, unit)
    recorded = outputs_of_node(trace, unit.node.name)
    with to.place() as path:
        session = NodeReplaySession(plan, columns, unit, path, to)
        watch = (
            OutputWatch(recorded, unit.node.name, CHANGED)
            if until_diverged and not options
            else None
        )
        with preserved_process():
            run = run_node(session, watch)
        place = run.path or path
        with Trace.open(place) as present:
            puts = outputs_of_node(present, unit.node.name)
            compared = recorded
            if run.stop_reason == CHANGED.reason:
                compared = [put for put in recorded if put.stamp_ns <= run.end_ns]
            elif interruption(run):
                compared = [put for put in recorded if put.stamp_ns < run.end_ns]
                puts = [put for put in puts if put.stamp_ns < run.end_ns]
            found = tuple(
                output_changes(
                    NodeOutputs(trace, compared),
                    NodeOutputs(present, puts),
                    options or DiffOptions(),
                )
            )
    return NodeReplayResult(
        trace=trace.name,
        node=unit.node.name,
        inputs=session.fed,
        compared=len(compared),
        changes=found[:1] if until_diverged else found,
        start_ns=run.start_ns,
        end_ns=run.end_ns,
        ended=run.stop_reason,
        path=to.kept(place),
        error=run.error,
        interrupted=interruption(run),
        notes=tuple(dict.fromkeys([*plan.notes, *_notes(unit, run, bool(found))])),
    )


def entries_of(trace: Trace, columns: RecordingColumns) -> list[int]:
    """Return the job entry of each construction in a trace."""
    entries = trace.metadata(METADATA_RECORDED_INPUTS).get("entries") or trace.result.get(
        "entries", ""
    )
    some = [int(one) for one in entries.split(",") if one.isdecimal()]
    return some or list(range(len(columns.constructions)))


def _notes(unit: ReplayedEntry, run: RunResult, differs: bool) -> Iterator[str]:
    if unit.others:
        yield f"{', '.join(unit.others)} ran with it: the same entry of the job makes them"
    if differs:
        yield (
            "its inputs are the recorded ones, even where other nodes would have reacted to its "
            "changed outputs"
        )
    elsewhere = unit.done_by_others()
    if elsewhere:
        yield (
            f"{elsewhere} of its outputs were made in events of other nodes or of the driver, "
            "which are not replayed"
        )
    yield from run.notes
