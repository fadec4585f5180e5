"""Replaying one node of a trace."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rsltrace.diff.options import DiffOptions
from rsltrace.errors import ReplayError
from rsltrace.replay.one_node.columns import Columns
from rsltrace.replay.one_node.outputs import Side, changes, outputs_of_node
from rsltrace.replay.one_node.result import NodeReplayResult
from rsltrace.replay.one_node.script import check_payloads
from rsltrace.replay.one_node.session import FedSession, run_fed
from rsltrace.replay.one_node.unit import Unit
from rsltrace.replay.one_node.watch import Watch
from rsltrace.replay.preparation import Preparation
from rsltrace.replay.replaying import place_for
from rsltrace.replay.verification import interruption
from rsltrace.run import Observer, RunResult
from rsltrace.run.plans.scheduling import switches_at_lines
from rsltrace.run.process import kept_process
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.format import METADATA_FED
from rsltrace.trace.reader import Trace

CHANGED = Stop("the first output that is not as recorded", 1)


def replay_node(
    plan: Preparation,
    node: str,
    *,
    until_diverged: bool = False,
    options: DiffOptions | None = None,
    output: Path | None = None,
    force: bool = False,
    echo: bool = False,
    observer: Observer | None = None,
) -> NodeReplayResult:
    """Run one node of a trace alone, fed with what it got; compare what it puts out.

    :raises ReplayError: there is no such node, or the trace does not hold what it got.
    :raises JobError, SetupError, OutputError: the run cannot start or be written.
    """
    trace = plan.trace
    if plan.edits:
        raise ReplayError(f"{trace.name} is a branch with edits, which replays as a whole only")
    if switches_at_lines(plan.job):
        raise ReplayError(
            f"{trace.name} was made with threads: {{switch: every_line}}: where a callback gives "
            "way depends on all of its process, so it replays as a whole only; leave out --node"
        )
    columns = Columns(trace)
    unit = Unit(columns, plan.job, node, entries_of(trace, columns))
    check_payloads(columns, unit)
    recorded = outputs_of_node(trace, unit.node.name)
    with place_for(output) as path:
        session = FedSession(plan, columns, unit, path, force=force, echo=echo, observer=observer)
        watch = Watch(recorded, unit.node.name, CHANGED) if until_diverged and not options else None
        with kept_process():
            run = run_fed(session, watch)
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
                changes(Side(trace, compared), Side(present, puts), options or DiffOptions())
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
        path=None if output is None else place,
        error=run.error,
        interrupted=interruption(run),
        notes=tuple(dict.fromkeys([*plan.notes, *_notes(unit, columns, run, bool(found))])),
    )


def entries_of(trace: Trace, columns: Columns) -> list[int]:
    """Return, for each construction in a trace, which entry of the job it was that of."""
    told = trace.metadata(METADATA_FED).get("entries") or trace.result.get("entries", "")
    some = [int(one) for one in told.split(",") if one.isdecimal()]
    return some or list(range(len(columns.constructions)))


def _notes(unit: Unit, columns: Columns, run: RunResult, differs: bool) -> Iterator[str]:
    if unit.others:
        yield f"{', '.join(unit.others)} ran with it: the same entry of the job makes them"
    if differs:
        yield (
            "its inputs are those of the recording, also where others would have answered its "
            "changed outputs in another way"
        )
    elsewhere = unit.done_by_others()
    if elsewhere:
        yield (
            f"{elsewhere} of its outputs came about in events of other nodes or of whoever drove "
            "the run, which are not replayed"
        )
    yield from run.notes
