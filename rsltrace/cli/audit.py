"""``rsltrace audit``: scan the sources of nodes for nondeterminism."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rsltrace.cli.job_source import JobArguments, RosArgsCommand, job_options
from rsltrace.errors import EXIT_USAGE
from rsltrace.terminal import say, tell
from rsltrace.trace.model.texts import printable

if TYPE_CHECKING:
    from rsltrace.guard.audit.audit import AuditFinding, AuditReport

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
    files = f"{result.files} file{'s' * (result.files != 1)}"
    silenced = f"; {result.allowed} allowed by a comment" if result.allowed else ""
    if not found:
        return f"nothing found in {files}{silenced}"
    counts = Counter(one.treatment.value for one in found)
    treated = ", ".join(f"{counts[name]} {name}" for name in counts)
    many = f"{len(found)} finding{'s' * (len(found) != 1)}"
    return f"{many} in {files} (guard: {treated}){silenced}"


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
