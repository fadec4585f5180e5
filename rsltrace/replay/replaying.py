"""Run a trace's job again and check every event."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from rsltrace.diff.facts.remarks import EndedByException
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import Diff
from rsltrace.diff.traces.diff import diff_traces
from rsltrace.errors import ReplayError, RunError
from rsltrace.replay.editing import EditObserver
from rsltrace.replay.edits import Edit, check_edits, edits_metadata
from rsltrace.replay.one_node.from_bag import node_topics
from rsltrace.replay.preparation import NOT_KEPT, ReplayOutput, ReplayPlan
from rsltrace.replay.verification import EventVerification, interruption
from rsltrace.run import RunResult
from rsltrace.run.process import preserved_process
from rsltrace.run.session import RunSession
from rsltrace.trace.chain import digest_text
from rsltrace.trace.format import METADATA_EDITS, METADATA_RECORDED_INPUTS
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.operation import NODE_TOPICS
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.reader import Trace

# The result of a replay.


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """How far a run did, event by event, what the trace ``trace`` (a path) says.

    ``verified`` is how many events, counted from 0, are the same in every hashed field; the trace
    has ``events``. ``digest`` is the chain hash of the last of these, 16 hex digits (zeros: none),
    ``end_ns`` its simulated time in nanoseconds, ``start_ns`` that of the start. ``ended`` says in
    words why the replay ended there. ``is_whole`` is true if that is the end of the trace's run;
    otherwise it diverged, ``until`` was reached, the trace was cut off or one of the runs was
    ended from outside.

    ``diff`` is None unless the run diverged; then it compares the trace (a) with the replay (b),
    which ends with the event that differs, number ``verified``. ``path`` is the replay's own trace,
    None if none was asked for. ``error`` is what went wrong in the run, which is no divergence if
    it did in the recorded run, too. ``notes`` are texts for people.

    With ``edits``, the run was verified up to the first of them and went on as a branch: ``digest``
    and ``end_ns`` are the branch's, and ``diff`` compares all of it with the trace, None if the
    edits have changed nothing.

    Of a native run, ``verified`` is how many callbacks ran in its order, ``native`` compares
    it with the replay (also times), and ``diff`` is that if messages or the order differ.
    """

    trace: str
    verified: int
    events: int
    digest: str
    start_ns: int
    end_ns: int
    ended: str
    is_whole: bool
    path: Path | None = None
    diff: Diff | None = None
    error: RunError | None = field(default=None, compare=False)
    notes: tuple[str, ...] = ()
    interrupted: int = 0
    """The exit status of a replay that was itself interrupted (130: Ctrl-C), else 0."""
    edits: tuple[str, ...] = ()
    native: Diff | None = field(default=None, compare=False)

    @property
    def sim_seconds(self) -> str:
        """Simulated duration in seconds, with nine decimals."""
        return format_seconds(self.end_ns - self.start_ns)

    @property
    def diverged(self) -> bool:
        """Whether the run did something else than the trace says (of a branch: because of it)."""
        return self.diff is not None

    @property
    def exit_code(self) -> int:
        """0 verified as far as it went, 1 diverged; of an interrupted replay 130, 143 or 129."""
        return 1 if self.diverged else self.interrupted

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        if self.native is not None:
            return self.native.sentence
        if self.edits:
            if self.diff is None:
                return f"the edits change nothing: the branch has the digest {self.digest}, too"
            return f"a branch from event {self.verified} on: {self.diff.sentence}"
        if self.diff is not None:
            how_far = f"the first {self.verified} events of {self.events} agree"
            return f"diverged at event {self.verified} ({how_far}): {self.diff.sentence}"
        of = "all" if self.verified == self.events else "the first"
        count = f"{of} {self.verified} events"
        if self.verified != self.events:
            count += f" of {self.events}"
        return f"verified {count}, to {self.sim_seconds} s ({self.ended})"


def replay_native(
    plan: ReplayPlan,
    nodes: Sequence[str] = (),
    *,
    to: ReplayOutput = NOT_KEPT,
) -> ReplayResult:
    """Simulate what a native run did, in its order; with ``nodes``, only the entries of the job
    that make these, and the others are played from the trace.

    :raises ReplayError: the job makes no such node.
    :raises JobError, SetupError, OutputError: the run cannot start or be written.
    """
    job, topics = plan.job, set[str]()
    if nodes:
        found = [node_topics(job.with_values(policy=None), node) for node in nodes]
        entries = sorted({one.entry for one in found})
        job = job.with_values(nodes=tuple(job.nodes[entry] for entry in entries))
        own = {one.node for one in found}
        publishers = [e for e in plan.trace.entities.values() if e.kind is EntityKind.PUBLISHER]
        others = {e.name for e in publishers if plan.trace.node_of(e).name not in own}
        topics = {name for one in found for name in one.published} - others - {*NODE_TOPICS} or {""}
    with to.place() as path, preserved_process():
        with RunSession(job, path, force=to.force, echo=to.echo, observer=to.observer) as session:
            session.begin()
            if not session.ended:
                session.go_on()
            run = session.finish()
        place = run.path or path
        with Trace.open(place) as again:
            compared = diff_traces(plan.trace, again, DiffOptions(topics=tuple(sorted(topics))))
    kept = to.kept(place)
    native = compared.native
    assert native is not None, "one of them is native"
    if kept is None:  # there is nothing to compare again
        content = replace(native.content, next_step="")
        compared = replace(
            compared,
            b=replace(compared.b, path=THE_REPLAY),
            native=replace(native, content=content),
        )
    differs = compared.diverged or native.moved > 0
    return ReplayResult(
        trace=plan.trace.name,
        verified=native.compared - native.moved,
        events=plan.trace.event_count,
        digest=run.digest,
        start_ns=run.start_ns,
        end_ns=run.end_ns,
        ended=run.stop_reason,
        is_whole=not differs,
        path=kept,
        diff=compared if differs else None,
        error=run.error,
        notes=tuple(dict.fromkeys([*plan.notes, *run.notes])),
        interrupted=interruption(run),
        native=compared,
    )


THE_REPLAY = "the replay"
THE_BRANCH = "the branch"
_CONTEXT = 5


def replay_prepared(
    plan: ReplayPlan,
    *,
    until: int | None = None,
    first: int = 0,
    to: ReplayOutput = NOT_KEPT,
    edits: Sequence[Edit] = (),
) -> ReplayResult:
    """Run a job as its trace says, ``until`` so many events are verified (None: to the end).

    This runs user code: see ``trust``. What the nodes log is printed from event number ``first``
    on. With ``edits`` it is verified up to the first of them, and then goes on as a
    branch of its own, which is compared with the trace.

    :raises ReplayError: it is the trace of one node alone.
    :raises EditError: an edit cannot be made.
    :raises JobError, SetupError, BagError, OutputError: the run cannot start or be written.
    """
    node = plan.trace.metadata(METADATA_RECORDED_INPUTS).get("node")
    if node is not None:
        raise ReplayError(
            f"{plan.trace.name} is a replay of {node} alone, without the nodes that it subscribes "
            f"to: replay it with --node {node}"
        )

    def on_first(session: RunSession) -> None:
        session.world.echo_logs(to.echo)

    verification = EventVerification(plan.trace, until, first=first, on_first=on_first)
    editing = EditObserver(
        (*plan.edits, *edits), known=len(plan.edits), on_new=verification.branch_off
    )
    check_edits(edits, plan.trace)
    with to.place() as path:
        run = _run(plan, verification, editing, path, to)
        place = run.path or path
        kept = to.kept(place)
        if verification.has_branched_off:
            return _branch(plan, verification, editing, run, place, kept)
        compared = _diverged(plan.trace, verification)
        difference = _difference(plan.trace, place, kept=kept is not None) if compared else None
    return _result(plan, verification, run, difference, kept)


def _run(
    plan: ReplayPlan,
    verification: EventVerification,
    editing: EditObserver,
    path: Path,
    to: ReplayOutput,
) -> RunResult:
    recorded = Path(os.path.abspath(plan.trace.name)) if plan.job.guard.enabled else None
    edits = editing.unmade
    metadata = {METADATA_EDITS: edits_metadata(edits, plan.trace)} if edits else {}
    with (
        preserved_process(),
        RunSession(
            plan.job,
            path,
            force=to.force,
            observer=to.observer,
            replay=recorded,
            metadata=metadata,
        ) as session,
    ):
        verification.attach(session)
        if editing.all:  # else they would cost time at every event
            editing.attach(session)
        if editing.branches and (end := verification.end_of_branch()) is not None:
            session.loop.stop_conditions += (end,)
        session.begin()
        if not session.ended:
            session.go_on()
        error = editing.error
        if error is None and not (verification.diverged or verification.interrupted):
            error = editing.failure()
        if error is None:
            return session.finish(cut_short=verification.has_cut_short)
        place = session.place
    if place is not None:  # no half of a branch
        place.unlink(missing_ok=True)
    raise error


def _diverged(trace: Trace, verification: EventVerification) -> bool:
    """Whether a finished run did something else, or ended before the trace does."""
    if verification.diverged:
        return True
    return not verification.has_cut_short and verification.verified < trace.event_count


def _difference(trace: Trace, place: Path, *, kept: bool) -> Diff:
    """Return the diff of the trace and the replay, which ends at the first differing event."""
    with Trace.open(place) as replayed:
        found = diff_traces(trace, replayed, DiffOptions(context=_CONTEXT, window=1))
    name = str(place) if kept else THE_REPLAY
    return replace(
        found,
        b=replace(found.b, path=name),
        counts=(),
        resync_index=None,
        remarks=tuple(
            one
            for one in found.remarks
            if not (isinstance(one, EndedByException) and one.run == "b")
        ),
        divergences=tuple(replace(one, next_step="", reaches=()) for one in found.divergences[:1]),
    )


def _branch(
    plan: ReplayPlan,
    verification: EventVerification,
    editing: EditObserver,
    run: RunResult,
    place: Path,
    kept: Path | None,
) -> ReplayResult:
    with Trace.open(place) as branch:
        found = diff_traces(plan.trace, branch, DiffOptions(context=_CONTEXT))
    name = THE_BRANCH if kept is None else str(kept)
    found = replace(found, b=replace(found.b, path=name))
    difference = None if found.identical else found
    return replace(
        _result(plan, verification, run, difference, kept),
        digest=run.digest,
        start_ns=run.start_ns,
        end_ns=run.end_ns,
        is_whole=False,
        notes=tuple(dict.fromkeys([*plan.notes, *run.notes])),
        edits=tuple(edit.text for edit in editing.all),
    )


def _result(
    plan: ReplayPlan,
    verification: EventVerification,
    run: RunResult,
    difference: Diff | None,
    path: Path | None,
) -> ReplayResult:
    trace = plan.trace
    notes = [*plan.notes, *run.notes]
    whole = trace.complete and verification.verified == trace.event_count
    recorded = trace.result.get("stop_reason", "")
    if verification.is_last and not whole:
        notes.append(
            "the nodes' shutdown differs after the run was ended from outside "
            f"(event {verification.verified})"
        )
    elif whole and run.stop_reason != recorded:
        notes.append(f"the recorded run ended with {recorded!r}, this one with {run.stop_reason!r}")
    return ReplayResult(
        trace=trace.name,
        verified=verification.verified,
        events=trace.event_count,
        digest=digest_text(verification.chain_hash),
        start_ns=trace.start_ns,
        end_ns=verification.end_ns,
        ended=run.stop_reason,
        is_whole=whole and difference is None,
        path=path,
        diff=difference,
        error=run.error,
        notes=tuple(dict.fromkeys(notes)),
        interrupted=verification.interrupted,
    )
