"""``rsltrace check``: a job and its graph, without running it."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.job_source import JobArguments, RosArgsCommand, job_options
from rsltrace.cli.output.exit_status import tell_error
from rsltrace.cli.output.text_file import write_text
from rsltrace.errors import EXIT_USAGE, RunError
from rsltrace.terminal import say, tell, tell_notes
from rsltrace.trace.model.texts import format_duration, format_seconds, printable
from rsltrace.trace.words.phrases import notes_on, table

if TYPE_CHECKING:
    from rsltrace.job import Job
    from rsltrace.run.checking import CheckedJob
    from rsltrace.simulation.middleware.overview import GraphLink


@click.command(cls=RosArgsCommand)
@job_options
@click.option(
    "--format",
    "form",
    type=click.Choice(("text", "json")),
    default="text",
    show_default=True,
    help="Print text, or JSON with every default filled in.",
)
@click.option(
    "--graph",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.svg",
    help="Draw the graph of nodes and topics into an SVG file.",
)
@click.option(
    "--job",
    "other",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="JOB",
    help="Evaluate the checks of this job on the trace, instead of the trace's own.",
)
@click.option(
    "--all",
    "everything",
    is_flag=True,
    help="Include what every node has: /rosout, parameter services and so on.",
)
def check(
    given: JobArguments,
    form: str,
    graph: Path | None,
    other: Path | None,
    everything: bool,
) -> int:
    """Check JOB (or a launch file) and print the complete job and the graph of its nodes.

    The nodes are constructed but no callback runs, so the graph lacks what nodes create in
    callbacks.

    Given a trace instead (rsltrace check run.mcap), evaluate the job's checks (checks:) on it.
    Checks that are Python functions run only if --job names the job file.

    Problems of a graph are: incompatible QoS, a subscription without a publisher, a client
    without a server, a topic that both a bag and a node publish, a rule that matches nothing.

    Exit status: 0 if there are no problems, 1 if a check fails or the graph has a problem, 2 if
    the job cannot run.
    """
    from rsltrace.checks.evaluate import check_texts, wrong_checks
    from rsltrace.checks.metrics import check_metrics
    from rsltrace.conditions.names import RunNames, loaded_fields
    from rsltrace.diff.file_kind import is_trace
    from rsltrace.run.checking import check_job

    if graph is not None and graph.suffix != ".svg":
        raise click.BadParameter(f"{graph} should end in .svg", param_hint="--graph")
    words = given.words
    if len(words) == 1 and is_trace(words[0]):
        if graph is not None or everything or given.overrides or given.launch is not None:
            raise click.UsageError(
                f"{words[0]} is a trace: --graph, --all, --set and --launch need a job"
            )
        return _check_trace(Path(words[0]), other, form)
    if other is not None:
        raise click.UsageError("--job needs a trace: rsltrace check run.mcap --job job.yaml")
    loaded, _ = given.job()
    check_texts(loaded)
    check_metrics(loaded)
    try:
        checked = check_job(loaded, everything=everything)
        shown = (*checked.overview.of_kind("topic"), *checked.overview.of_kind("service"))
        names = RunNames(
            nodes=tuple(node.name for node in checked.overview.nodes),
            topics=tuple(dict.fromkeys([*(link.name for link in shown), *checked.interfaces])),
            are_all=True,
            interfaces=checked.interfaces,
            fields=loaded_fields,
        )
        wrong = tuple(wrong_checks(checked.job, names))
        checked = replace(checked, unused=(*checked.unused, *wrong))
    except RunError as error:
        tell_error(error)
        return EXIT_USAGE
    if graph is not None:
        _draw(checked, graph)
    if form == "json":
        say(json.dumps(_values(checked.job, checked), indent=2))
    else:
        for note in checked.notes:
            tell(f"rsltrace: note: {note}")
        say("\n".join(map(printable, _text(checked.job, checked))))
        if not checked.problems and given.launch is None and not given.overrides:
            tell(f"next: rsltrace record {shlex.join(words)}")
    return 1 if checked.problems else 0


def _check_trace(path: Path, other: Path | None, form: str) -> int:
    """Evaluate checks on a trace without running code that its own job names."""
    from rsltrace.checks.evaluate import job_of_checks
    from rsltrace.cli.output.checks import CheckReport
    from rsltrace.job import load_job
    from rsltrace.trace.reader import Trace

    with Trace.open(path) as trace:
        tell_notes(notes_on(trace))
        job = job_of_checks(trace) if other is None else load_job(other)
    if not (job.checks or job.metrics):
        named = other if other is not None else f"the job of {path}"
        none = f"{named} has neither checks (checks:) nor metrics"
        tell(f"rsltrace: error: {none}; use --job to name another job")
        return EXIT_USAGE
    checked = CheckReport(job, path, functions=other is not None)
    if form == "json":
        say(json.dumps(checked.values(), indent=2))
    else:
        say("\n".join(checked.lines()))
    return 1 if checked.violated else 0


def _draw(checked: CheckedJob, path: Path) -> None:
    from rsltrace.cli.output.graph_svg import graph_svg

    picture = graph_svg(checked.overview)
    write_text(path, picture)


def _values(job: Job, checked: CheckedJob) -> dict[str, Any]:
    return {
        "job": job.resolved(),
        "start_ns": checked.start_ns,
        "graph": asdict(checked.overview),
        "unused": list(checked.unused),
        "notes": list(checked.notes),
    }


def _text(job: Job, checked: CheckedJob) -> list[str]:
    found = checked.overview
    lines = ["job:", *(f"  {line}" for line in job.to_yaml().splitlines()), ""]
    lines += [f"starts at simulated time {format_seconds(checked.start_ns)} s", ""]
    lines.append("nodes:" if found.nodes else "nodes: none, no entry makes one")
    for node in found.nodes:
        lines.append(f"  {node.name}  {node.type}".rstrip())
        lines += [
            f"    timer {name} every {format_duration(period)}" for name, period in node.timers
        ]
    for kind in ("topic", "service", "action"):
        links = found.of_kind(kind)
        if links:
            lines += ["", f"{kind}s:"]
            lines += [f"  {line}" for line in table([_row(link) for link in links])]
    for wait in found.waiting:
        lines += ["", *f"still {wait}".splitlines()]
    lines.append("")
    if checked.problems:
        lines += ["to look at:", *(f"  {problem}" for problem in checked.problems)]
        if checked.unused:
            lines.append("(what nodes create later, in callbacks, is not there yet)")
    else:
        lines.append("no problems found")
    return lines


def _row(link: GraphLink) -> list[str]:
    senders, receivers = (
        ", ".join(dict.fromkeys(end.node for end in ends)) or "(none)"
        for ends in (link.senders, link.receivers)
    )
    return [link.name, link.type, senders, "->", receivers]
