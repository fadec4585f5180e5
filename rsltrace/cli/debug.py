"""``rsltrace debug``: stop a run where you like, look into its nodes, go back."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from rsltrace.cli.job_source import set_option
from rsltrace.cli.replay import agree, code_lines
from rsltrace.terminal import tell
from rsltrace.trace.model.texts import printable


@click.command()
@click.argument("source", metavar="TRACE|JOB", type=click.Path(path_type=Path))
@click.option(
    "-c",
    "--command",
    "commands",
    multiple=True,
    metavar="COMMAND",
    help="Carry this out first: -c 'break node /ekf' -c continue.",
)
@click.option(
    "--job-folder",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="The folder of the job file (default: that of the trace, or the present one).",
)
@click.option("--trust", is_flag=True, help="Run the code that TRACE names without being asked.")
@set_option
@click.option(
    "--checkpoints",
    type=click.IntRange(min=0),
    default=64,
    show_default=True,
    metavar="N",
    help="At most N copies of the run to go back to; 0: run again from the beginning.",
)
@click.option(
    "--memory",
    type=click.IntRange(min=0),
    default=2048,
    show_default=True,
    metavar="MIB",
    help="Memory that these copies may take.",
)
@click.option("-q", "--quiet", is_flag=True, help="No log records of the nodes.")
def debug(
    source: Path,
    commands: tuple[str, ...],
    job_folder: Path | None,
    trust: bool,
    overrides: tuple[str, ...],
    checkpoints: int,
    memory: int,
    quiet: bool,
) -> int:
    """Run the job in TRACE (or JOB) under a debugger that can go back.

    Step by event, node or time; stop where messages, logs, exceptions or the state of a node say
    so; evaluate expressions in nodes; go back, and ask who changed an attribute or sent a message.
    "help" at the prompt lists the commands. They may also come from a pipe: each is printed with
    what came of it, and the first that cannot be carried out ends the session.

    As with "rsltrace replay", every event is compared with TRACE, and code that a trace names runs
    only if you agree to it.

    The exit status is 0 when the session ends, 1 if the run has diverged from TRACE in it, and 2
    for trouble: it could not begin, or a command of a script could not be carried out.
    """
    from rsltrace.conditions.names import names_of
    from rsltrace.debug.client import DebugSession
    from rsltrace.debug.prompt.shell import Shell
    from rsltrace.diff.file_kind import is_trace
    from rsltrace.replay.preparation import prepared

    if overrides and is_trace(source):
        raise click.UsageError("--set is for a JOB: a trace holds the job that was run")
    if (job_folder is not None or trust) and not is_trace(source):
        raise click.UsageError("--job-folder and --trust are for a TRACE")
    with ExitStack() as stack:
        names, told = None, set()
        if is_trace(source):
            plan = stack.enter_context(prepared(source, job_folder))
            for line in code_lines(plan, "debugging"):
                tell(line)
            agree(plan, trust=trust)
            told = {f"{one.name} {one.change}" for one in plan.code}
            names = names_of(plan.trace.entities.values())
        session = stack.enter_context(
            DebugSession(
                source,
                job_folder=job_folder,
                trust=True,
                checkpoints=checkpoints,
                memory_mib=memory,
                echo=not quiet,
                overrides=overrides,
                on_notice=_on_notice,
            )
        )
        for note in (note for note in session.notes if note not in told):
            tell(f"note: {note}")
        return Shell(session, commands, names).run()


def _on_notice(notice: Mapping[str, Any]) -> None:
    text = str(notice.get("text", ""))
    if notice.get("notice") == "output":
        tell(text, end="")
    elif text:
        tell(f"note: {printable(text)}")
