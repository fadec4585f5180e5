"""``rsltrace replay``: run the job of a trace again and verify every event."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import click

from rsltrace.cli.diff import Tolerance, print_diffs
from rsltrace.cli.options import job_folder_option, json_option, no_pin_option, trust_option
from rsltrace.cli.output.exit_status import reopen_standard_streams, status_without_output
from rsltrace.cli.output.search_progress import interruptible, progress
from rsltrace.diff.options import DiffOptions
from rsltrace.errors import NodeError, ReplayError
from rsltrace.guard.pin import unpin
from rsltrace.terminal import say, tell
from rsltrace.trace.model.texts import printable

if TYPE_CHECKING:
    from rsltrace.replay.one_node.result import NodeReplayResult
    from rsltrace.replay.preparation import ReplayOutput, ReplayPlan
    from rsltrace.replay.replaying import ReplayResult

    _Result = TypeVar("_Result", ReplayResult, NodeReplayResult)

_SHOWN_MAX = 12


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.option(
    "--until",
    metavar="INDEX|TIME",
    help="Stop with success after this event (812) or time of the run (60s, 2.5). @60s is a "
    "simulated time.",
)
@click.option(
    "--from",
    "first",
    metavar="INDEX|TIME",
    help="Show progress and the nodes' log records only from here on. Events before are "
    "verified, too.",
)
@click.option(
    "--edit",
    "edits",
    multiple=True,
    metavar="EDIT",
    help="Branch the run at this event: '812: message.data = 3.0'. See docs/what-if.md. "
    "Repeatable.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Write the trace of the replay to this file.",
)
@click.option("--force", is_flag=True, help="Replace an existing output file (never TRACE itself).")
@job_folder_option
@trust_option
@click.option(
    "--node",
    "nodes",
    metavar="NAME",
    multiple=True,
    help="Run this node alone, with its recorded input. Repeatable for a native TRACE.",
)
@click.option(
    "--bag",
    "bags",
    multiple=True,
    type=click.Path(path_type=Path),
    help="With --node: take the input from this rosbag2 recording. A job file may then stand in "
    "place of TRACE. Repeatable.",
)
@click.option(
    "--until-diverged", is_flag=True, help="With --node: stop at the first output that differs."
)
@click.option("--all", "everything", is_flag=True, help="With --node: show all differences.")
@click.option(
    "--ignore",
    multiple=True,
    metavar="FIELD",
    help="With --node: do not compare these fields (header.stamp, /odom:twist). Repeatable.",
)
@click.option(
    "--abs",
    "absolute",
    multiple=True,
    type=Tolerance(),
    metavar="FIELD=TOL",
    help="With --node: tolerate |a-b| <= TOL in these fields (times in seconds). Repeatable.",
)
@json_option
@no_pin_option
@click.option(
    "-q", "--quiet", is_flag=True, help="Show no progress and no log records of the nodes."
)
def replay(
    trace: Path,
    until: str | None,
    first: str | None,
    edits: tuple[str, ...],
    output: Path | None,
    force: bool,
    job_folder: Path | None,
    trust: bool,
    nodes: tuple[str, ...],
    bags: tuple[Path, ...],
    until_diverged: bool,
    everything: bool,
    ignore: tuple[str, ...],
    absolute: tuple[tuple[str, float], ...],
    as_json: bool,
    no_pin: bool,
    quiet: bool,
) -> int:
    """Run the job in TRACE again and compare every event with the recorded one.

    The job, launch arguments, parameters, seeds, order and recorded external values come from
    TRACE. The code of nodes, bags and files are read from this machine, as they are now. The
    replay stops at the first event that diverges and explains it as "rsltrace diff" does.

    A replay runs code. It first prints which code, from where, and what has changed since the
    recording. It asks for confirmation (or --trust) unless a job file in the working directory or
    --job-folder names the same code.

    With --node, run only that node. It receives its recorded messages, requests and responses at
    the recorded times and in the recorded order, and its outputs are compared. Unchanged code
    gives the same outputs; after a change, you see its effects. With --bag, the node receives
    the messages that a recording of the robot has on its topics.

    With --edit, verify the events before the first edit, then branch: the run continues with the
    edits and is compared with TRACE. -o keeps the trace of the branch.

    If TRACE is of a native run, simulate its nodes: each callback runs at its recorded time and
    with its recorded message. With --node, the other nodes are played from TRACE.

    Exit status: 0 if every event was as recorded (including a recorded failure); 1 if the replay
    diverged or the edits changed something; 2 for an error; 130, 143 or 129 if interrupted.
    """
    from rsltrace.replay.edits import check_edits, parse_edit
    from rsltrace.replay.one_node.from_bag import replay_from_bag
    from rsltrace.replay.one_node.replaying import replay_node
    from rsltrace.replay.one_node.result import as_json as node_json
    from rsltrace.replay.preparation import (
        event_count_to,
        is_job,
        load_without_bags,
        prepare_replay,
    )
    from rsltrace.replay.replaying import replay_native, replay_prepared

    node = ", ".join(nodes)
    options = DiffOptions(ignore=ignore, absolute=absolute) if ignore or absolute else None
    of_node = bool(bags or until_diverged or everything or options)
    _check_options(node, until, first, edits, of_node=of_node)
    if bags and until_diverged:
        raise click.UsageError("--until-diverged has no effect with --bag")
    changes = [parse_edit(text) for text in edits]
    to = _Destination(output, force, silent=quiet or as_json)

    def report_node(result: NodeReplayResult) -> None:
        if as_json:
            say(node_json(result))
        else:
            _print_node(result, everything=everything)

    if bags and is_job(trace):
        job = load_without_bags(trace)
        if no_pin or not job.guard.pins:
            unpin()
        return _replayed(
            lambda to: replay_from_bag(job, node, bags, options=options, to=to), to, report_node
        )
    with prepare_replay(trace, job_folder, bags=not nodes) as plan:
        if no_pin or not plan.job.guard.pins:
            unpin()
        count = None if until is None else event_count_to(plan.trace, until, "--until")
        check_edits(changes, plan.trace)
        begin = 0 if first is None else max(event_count_to(plan.trace, first, "--from") - 1, 0)
        if not as_json:
            for line in code_lines(plan, "replaying", node or None):
                tell(line)
        is_native = _is_native(plan, until or first or edits or options or bags)
        agree(plan, trust=trust)
        if nodes and not is_native:
            return _replayed(
                lambda to: replay_node(
                    plan, node, bags, until_diverged=until_diverged, options=options, to=to
                ),
                to,
                report_node,
            )

        def report(result: ReplayResult) -> None:
            if as_json:
                say(json.dumps(_values(result, plan)))
            else:
                _print(result)

        if is_native:
            return _replayed(lambda to: replay_native(plan, nodes, to=to), to, report)
        return _replayed(
            lambda to: replay_prepared(plan, until=count, first=begin, to=to, edits=changes),
            to,
            report,
            first=begin,
        )


def _check_options(
    node: str, until: str | None, first: str | None, edits: Sequence[str], *, of_node: bool
) -> None:
    """Raise a usage error for options that have no effect together."""
    if not node and of_node:
        raise click.UsageError("--bag, --until-diverged, --all, --ignore and --abs need --node")
    if node and (until is not None or first is not None):
        raise click.UsageError(
            "--from and --until have no effect with --node; use --until-diverged"
        )
    if node and edits:
        raise click.UsageError("--edit needs the whole run: leave out --node")


def _is_native(plan: ReplayPlan, options: object) -> bool:
    """Whether a trace is of a native run, which is replayed without most ``options``.

    :raises ReplayError: there are some.
    """
    from rsltrace.trace.native import is_native

    found = is_native(plan.trace)
    if found and options:
        raise ReplayError(
            f"{plan.trace.name} is of a native run: replay it with -o again.mcap first, and "
            "again.mcap with these options"
        )
    return found


def agree(plan: ReplayPlan, *, trust: bool) -> None:
    """Ask the user to run the code that a trace names, unless it is trusted.

    :raises ReplayError: the user does not agree.
    """
    if not plan.distrust or trust:
        return
    name = printable(plan.trace.name)
    why = printable(plan.distrust)
    if sys.stdin is None or not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ReplayError(
            f"{name} would run code, and {why}: nothing was run; use --trust if you know where "
            "the trace comes from"
        )
    tell(f"{name} would run this code, and {why}.")
    if not click.confirm("Run it?", default=False, err=True):
        raise ReplayError("nothing was run")


class _Destination(NamedTuple):
    path: Path | None
    force: bool
    silent: bool


def _replayed(
    replay: Callable[[ReplayOutput], _Result],
    to: _Destination,
    report: Callable[[_Result], None],
    *,
    first: int = 0,
) -> int:
    """Replay and report the result; progress is shown from event ``first`` on."""
    from rsltrace.replay.preparation import ReplayOutput
    from rsltrace.run import RunCallbacks

    with interruptible() as on_interrupt, progress(quiet=to.silent, what="replaying") as show:
        observer = RunCallbacks(progress=_from(first, show), interrupt=on_interrupt)
        result = replay(ReplayOutput(to.path, to.force, not to.silent, observer))
    reopen_standard_streams()
    try:
        report(result)
    except OSError as error:
        return status_without_output(error, result.exit_code)
    return result.exit_code


_Show = Callable[[int, int | None, int], None]


def _from(first: int, show: _Show | None) -> _Show | None:
    """Return a progress function that shows nothing before an event."""
    if show is None or not first:
        return show

    def later(now_ns: int, end_ns: int | None, events: int) -> None:
        if events >= first:
            show(now_ns, end_ns, events)

    return later


# -- output --------------------------------------------------------------------------------------


def code_lines(plan: ReplayPlan, doing: str, node: str | None = None) -> Iterator[str]:
    """Yield which code will run, from where, and what has changed since the recording."""
    trace = plan.trace
    job = trace.job.get("name", "") or "a job"
    what = f"{trace.name}: {trace.event_count} events of {job} in {plan.folder}"
    if node is not None:
        what = f"{node} of {trace.name} alone ({job} in {plan.folder})"
    yield printable(f"{doing} {what}, with the code of")
    code = [(one.name, str(_near(one.file)) if one.file else "-", one.change) for one in plan.code]
    width = min(max((len(name) for name, _, _ in code), default=0), 40)
    for name, file, change in code[:_SHOWN_MAX]:
        yield printable(f"  {name:<{width}}  {file}{f'  ({change})' if change else ''}")
    if len(code) > _SHOWN_MAX:
        changed = [name for name, _, change in code[_SHOWN_MAX:] if change]
        more = f" (changed or not here: {', '.join(changed[:_SHOWN_MAX])})" if changed else ""
        yield printable(f"  and {len(code) - _SHOWN_MAX} more{more}")
    if plan.edits:
        yield printable(f"with the edits {'; '.join(edit.text for edit in plan.edits)}")
    if plan.job.bags:
        yield printable(f"and the bags {', '.join(bag.path for bag in plan.job.bags)}")
    if plan.changes:
        changes = (f"{c.name} {c.recorded or '-'} -> {c.present or '-'}" for c in plan.changes)
        yield printable(f"changed since the recording: {', '.join(changes)}")


def _near(file: Path) -> Path:
    """Return a path relative to the working directory, if it is below that."""
    return file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file


def _print_node(result: NodeReplayResult, *, everything: bool) -> None:
    from rsltrace.replay.one_node.result import as_text

    _print_end(result)
    for line in as_text(result, everything=everything):
        say(line)


def _print_end(result: ReplayResult | NodeReplayResult) -> None:
    """Print the failure, notes and output file of a replay."""
    error, diverged = result.error, result.diverged
    if error is not None:
        if diverged and isinstance(error, NodeError) and error.traceback_text:
            tell(error.traceback_text.rstrip())
        as_recorded = "" if diverged else ", as recorded"
        tell(f"rsltrace: the run failed{as_recorded}: {error}")
    for note in result.notes:
        tell(f"note: {note}")
    if result.path is not None:
        tell(f"wrote {result.path}")


def _print(result: ReplayResult) -> None:
    _print_end(result)
    if result.edits:
        _print_branch(result)
        return
    compared = result.native or result.diff
    if compared is not None:
        print_diffs([compared], "text", DiffOptions(), None)
        if result.native is None:
            say(f"\nnext: {_next(result)}")
        return
    say(result.sentence)
    say(f"digest {result.digest}  events {result.verified}  sim {result.sim_seconds}")


def _print_branch(result: ReplayResult) -> None:
    for edit in result.edits:
        say(f"edit {edit}")
    if result.diff is None:
        say(result.sentence)
    else:
        say(f"the first {result.verified} events are those of {result.trace}")
        print_diffs([result.diff], "text", DiffOptions(), None)
    say(f"digest {result.digest}  ended: {result.ended}, at {result.sim_seconds} s")


def _next(result: ReplayResult) -> str:
    if result.path is not None:
        return shlex.join(["rsltrace", "view", result.trace, str(result.path)])
    again = ["rsltrace", "replay", result.trace, "-o", "replay.mcap"]
    view = ["rsltrace", "view", result.trace, "replay.mcap"]
    return printable(f"{shlex.join(again)}; {shlex.join(view)}")


def _values(result: ReplayResult, plan: ReplayPlan) -> dict[str, Any]:
    difference = None
    if result.diff is not None:
        from rsltrace.diff.report import render

        difference = json.loads(render(result.diff, "json"))
    return {
        "trace": result.trace,
        "verified": result.verified,
        "events": result.events,
        "digest": result.digest,
        "end_ns": result.end_ns,
        "ended": result.ended,
        "is_whole": result.is_whole,
        "diverged_at": result.verified if result.diverged else None,
        "exit_code": result.exit_code,
        "error": None if result.error is None else str(result.error),
        "path": None if result.path is None else str(result.path),
        "notes": list(result.notes),
        "edits": list(result.edits),
        "code": [
            {"name": one.name, "file": str(one.file) if one.file else None, "change": one.change}
            for one in plan.code
        ],
        "changes": [
            {"name": one.name, "recorded": one.recorded, "present": one.present}
            for one in plan.changes
        ],
        "diff": difference,
    }
