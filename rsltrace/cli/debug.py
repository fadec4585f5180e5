"""``rsltrace debug``: breakpoints, inspection of nodes, steps backwards."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from rsltrace.cli.options import job_folder_option, set_option, trust_option
from rsltrace.cli.replay import agree, code_lines
from rsltrace.terminal import tell
from rsltrace.trace.model.finding import decode_unseen
from rsltrace.trace.model.texts import printable


@click.command()
@click.argument("source", metavar="TRACE|JOB", type=click.Path(path_type=Path))
@click.option(
    "-c",
    "--command",
    "commands",
    multiple=True,
    metavar="COMMAND",
    help="Run this command first: -c 'break node /ekf' -c continue. Repeatable.",
)
@job_folder_option
@trust_option
@set_option
@click.option(
    "--checkpoints",
    type=click.IntRange(min=0),
    default=64,
    show_default=True,
    metavar="N",
    help="Keep at most N checkpoints to step back to; with 0, step back by running again from "
    "the start.",
)
@click.option(
    "--memory",
    type=click.IntRange(min=0),
    default=2048,
    show_default=True,
    metavar="MIB",
    help="Limit the memory of all checkpoints.",
)
@click.option("-q", "--quiet", is_flag=True, help="Do not print the log records of the nodes.")
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
    """Run JOB, or the job in TRACE, under a debugger that can step backwards.

    Step by event, node or time. Break on messages, logs, exceptions or the state of a node.
    Evaluate expressions in nodes. Step backwards, and find the callback that changed an attribute
    or sent a message. Enter "help" at the prompt for the commands. You can also pipe commands in:
    each is printed with its result, and the first that fails ends the session.

    As with "rsltrace replay", every event is compared with TRACE, and code that TRACE names runs
    only if you agree.

    Exit status: 0 when the session ends, 1 if the run diverged from TRACE, 2 for an error: the
    session could not start, or a command of a script failed.
    """
    from rsltrace.checks.conditions.names import names_of
    from rsltrace.debug.client import DebugSession
    from rsltrace.debug.prompt.shell import DebugPrompt
    from rsltrace.diff.file_kind import is_trace
    from rsltrace.replay.preparation import prepare_replay

    if overrides and is_trace(source):
        raise click.UsageError("--set is for a JOB: a trace holds the job that was run")
    if (job_folder is not None or trust) and not is_trace(source):
        raise click.UsageError("--job-folder and --trust are for a TRACE")
    with ExitStack() as stack:
        names, shown = None, set()
        if is_trace(source):
            plan = stack.enter_context(prepare_replay(source, job_folder))
            for line in code_lines(plan, "debugging"):
                tell(line)
            agree(plan, trust=trust)
            shown = {f"{one.name} {one.change}" for one in plan.code}
            unseen = decode_unseen(plan.trace.result)
            names = names_of(plan.trace.entities.values(), unseen=unseen)
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
        for note in (note for note in session.notes if note not in shown):
            tell(f"note: {note}")
        return DebugPrompt(session, commands, names).run()


def _on_notice(notice: Mapping[str, Any]) -> None:
    text = str(notice.get("text", ""))
    if notice.get("notice") == "output":
        tell(text, end="")
    elif text:
        tell(f"note: {printable(text)}")
