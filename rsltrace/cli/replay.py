"""``rsltrace replay``: run the job of a trace again and verify every event."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.diff import Tolerance, print_diffs
from rsltrace.cli.options import job_folder_option, json_option, no_pin_option, trust_option
from rsltrace.cli.output.exit_status import reopen_standard_streams, status_without_output
from rsltrace.cli.output.search_progress import interruptible, progress
from rsltrace.cli.replay_node import (
    NodeReplayOptions,
    replay_from_job,
    replay_one,
    tell_of_run,
)
from rsltrace.diff.options import DiffOptions
from rsltrace.errors import ReplayError
from rsltrace.guard.pin import unpin
from rsltrace.terminal import say, tell
from rsltrace.trace.model.texts import printable

if TYPE_CHECKING:
    from rsltrace.replay.edits import Edit
    from rsltrace.replay.preparation import ReplayPlan
    from rsltrace.replay.replaying import ReplayResult

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
    from rsltrace.replay.one_node.ways import is_job
    from rsltrace.replay.preparation import event_count_to, prepare_replay

    node = ", ".join(nodes)
    ways = NodeReplayOptions(
        node=node,
        bags=bags,
        until_diverged=until_diverged,
        everything=everything,
        options=DiffOptions(ignore=ignore, absolute=absolute) if ignore or absolute else None,
        output=output,
        force=force,
        quiet=quiet,
        as_json=as_json,
    )
    ways.check(until, first, edits)
    changes = [parse_edit(text) for text in edits]
    if bags and is_job(trace):
        return replay_from_job(trace, ways, no_pin=no_pin)
    with prepare_replay(trace, job_folder, bags=not nodes) as plan:
        if no_pin or not plan.job.guard.pins:
            unpin()
        count = None if until is None else event_count_to(plan.trace, until)
        check_edits(changes, plan.trace)
        begin = 0 if first is None else event_count_to(plan.trace, first) - 1
        if not as_json:
            for line in code_lines(plan, "replaying", node or None):
                tell(line)
        is_native = _is_native(plan, until or first or edits or ways.options or bags)
        agree(plan, trust=trust)
        if nodes and not is_native:
            return replay_one(plan, ways)
        result = _replayed(
            plan, count, max(begin, 0), changes, nodes, output, force=force, quiet=quiet or as_json
        )
        reopen_standard_streams()
        status = result.exit_code
        try:
            if as_json:
                say(json.dumps(_values(result, plan)))
            else:
                _print(result)
        except OSError as error:
            status = status_without_output(error, status)
    return status


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


def _replayed(
    plan: ReplayPlan,
    until: int | None,
    first: int,
    edits: Sequence[Edit],
    nodes: Sequence[str],
    output: Path | None,
    *,
    force: bool,
    quiet: bool,
) -> ReplayResult:
    from rsltrace.replay.replaying import replay_native, replay_prepared
    from rsltrace.run import RunCallbacks
    from rsltrace.trace.native import is_native

    with interruptible() as on_interrupt, progress(quiet=quiet, what="replaying") as show:
        if is_native(plan.trace):
            return replay_native(
                plan,
                nodes,
                output=output,
                force=force,
                echo=not quiet,
                observer=RunCallbacks(progress=show, interrupt=on_interrupt),
            )
        return replay_prepared(
            plan,
            until=until,
            first=first,
            output=output,
            force=force,
            echo=not quiet,
            observer=RunCallbacks(progress=_from(first, show), interrupt=on_interrupt),
            edits=edits,
        )


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


def _print(result: ReplayResult) -> None:
    tell_of_run(result.error, result.diverged, result.notes, result.path)
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
