"""``rsltrace check`` and ``rsltrace audit``: a job, its graph and the sources of its nodes, without
running it."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.job_source import JobArguments, RosArgsCommand, job_options
from rsltrace.cli.output.exit_status import tell_error
from rsltrace.cli.output.text_file import write_text
from rsltrace.errors import EXIT_USAGE, RunError
from rsltrace.terminal import say, tell, tell_notes
from rsltrace.trace.model.texts import counted, format_duration, format_seconds, printable
from rsltrace.trace.words.phrases import notes_on, table

if TYPE_CHECKING:
    from rsltrace.guard.audit.audit import AuditFinding, AuditReport
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
    from rsltrace.checks.conditions.names import RunNames, loaded_fields
    from rsltrace.checks.evaluate import check_texts, wrong_checks
    from rsltrace.checks.metrics import check_metrics
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


_FORMATS = ("text", "json", "github")


@click.command(cls=RosArgsCommand)
@job_options
@click.option(
    "--format",
    "form",
    type=click.Choice(_FORMATS),
    default="text",
    show_default=True,
    help="Print text, JSON or GitHub annotations.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON (the same as --format json).")
@click.option(
    "--unguarded",
    is_flag=True,
    help="Show only what the guard does not make deterministic.",
)
def audit(given: JobArguments, form: str, as_json: bool, unguarded: bool) -> int:
    """Scan the sources of JOB's nodes, a .py file or a folder for nondeterminism.

    \b
      rsltrace audit job.yaml      scan the nodes' modules and their imports below search_path
      rsltrace audit src/my_robot  scan every Python file below a folder

    Nothing is executed. Each finding has the file and line, the call, what the guard does about it
    (virtual, pinned, recorded, detected, refused, nothing) and what to write instead. To silence a
    finding, add the comment "# rsltrace: allow" or "# rsltrace: allow clock" to its line.

    Exit status: 0 without findings, 1 with findings, 2 for an error.
    """
    result = _look(given)
    from rsltrace.guard.audit.audit import SAFE_TREATMENTS

    found = [one for one in result.found if not (unguarded and one.treatment in SAFE_TREATMENTS)]
    for trouble in result.troubles:
        tell(f"rsltrace: error: {printable(trouble)}")
    for note in result.notes:
        tell(f"rsltrace: note: {printable(note)}")
    if as_json or form == "json":
        say(_as_json(result, found))
    elif form == "github":
        say("".join(map(_annotation, found)), end="")
    else:
        say("\n".join([*map(_line, found), _summary(result, found)]))
    return EXIT_USAGE if result.troubles else 1 if found else 0


def _look(given: JobArguments) -> AuditReport:
    from rsltrace.guard.audit.audit import audit_job, audit_path

    words = given.words
    only = Path(words[0]) if len(words) == 1 and given.launch is None else None
    if only is not None and (only.is_dir() or only.suffix == ".py"):
        if given.overrides:
            raise click.UsageError(f"--set needs a job, and {only} is not one")
        return audit_path(only)
    from rsltrace.run.inputs import expand_launch_files
    from rsltrace.run.plans.executables import executable_source
    from rsltrace.run.process import search_path

    job, _ = given.job()
    expanded = expand_launch_files(job)
    with search_path(job):
        from rsltrace.adapters.workspace.installs import module_folders

        return audit_job(
            expanded.job,
            lambda target, where: executable_source(target, where=where),
            module_folders,
        )


def _line(one: AuditFinding) -> str:
    text = (
        f"{_shown(one.path)}:{one.line}:{one.column}: {one.kind}: {one.call}; "
        f"guard: {one.treatment.value}, {one.does}; instead: {one.instead}"
    )
    return printable(text)


def _summary(result: AuditReport, found: Sequence[AuditFinding]) -> str:
    files = counted(result.files, "file")
    silenced = f"; {result.allowed} allowed by a comment" if result.allowed else ""
    if not found:
        return f"nothing found in {files}{silenced}"
    counts = Counter(one.treatment.value for one in found)
    treated = ", ".join(f"{counts[name]} {name}" for name in counts)
    return f"{counted(len(found), 'finding')} in {files} (guard: {treated}){silenced}"


def _as_json(result: AuditReport, found: Sequence[AuditFinding]) -> str:
    findings = [
        {**asdict(one), "path": _shown(one.path), "treatment": one.treatment.value} for one in found
    ]
    return json.dumps(
        {
            "files": result.files,
            "findings": findings,
            "allowed": result.allowed,
            "troubles": list(result.troubles),
        },
        indent=2,
    )


def _annotation(one: AuditFinding) -> str:
    from rsltrace.diff.report.ci import command_data, command_property
    from rsltrace.guard.audit.audit import SAFE_TREATMENTS

    level = "notice" if one.treatment in SAFE_TREATMENTS else "warning"
    place = f"file={command_property(printable(_shown(one.path)))},line={one.line},col={one.column}"
    title = command_property(printable(f"rsltrace {one.kind}: {one.call}"))
    text = f"guard: {one.treatment.value}, {one.does}; instead: {one.instead}"
    return f"::{level} {place},title={title}::{command_data(printable(text))}\n"


def _shown(path: Path) -> str:
    """Return a path relative to the working directory, if it is below that."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except ValueError:
        return str(path)
