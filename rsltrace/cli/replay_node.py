"""``rsltrace replay --node``: one node of a trace alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rsltrace.cli.output.exit_status import reopen_standard_streams, status_without_output
from rsltrace.cli.record import interruptible, progress
from rsltrace.diff.options import DiffOptions
from rsltrace.errors import NodeError
from rsltrace.terminal import say, tell

if TYPE_CHECKING:
    from rsltrace.errors import RunError
    from rsltrace.replay.preparation import Preparation


def check_options(
    node: str | None,
    until: str | None,
    first: str | None,
    edits: tuple[str, ...],
    of_node: tuple[bool, ...],
) -> None:
    """Refuse options that have nothing to do.

    :raises click.UsageError: naming them.
    """
    if node is None and any(of_node):
        raise click.UsageError("--until-diverged, --all and --ignore go with --node")
    if node is not None and (until is not None or first is not None):
        raise click.UsageError("--from and --until go without --node; it has --until-diverged")
    if node is not None and edits:
        raise click.UsageError("--edit goes without --node: the other nodes are to see the change")


def replay_one(
    plan: Preparation,
    node: str,
    *,
    until_diverged: bool,
    options: DiffOptions | None,
    output: Path | None,
    force: bool,
    quiet: bool,
    as_json: bool,
    everything: bool,
) -> int:
    """Replay one node, and print what it did."""
    from rsltrace.cli.output import node_replay
    from rsltrace.replay.one_node.replaying import replay_node
    from rsltrace.run import Observer

    silent = quiet or as_json
    with interruptible() as on_interrupt, progress(quiet=silent, what="replaying") as show:
        result = replay_node(
            plan,
            node,
            until_diverged=until_diverged,
            options=options,
            output=output,
            force=force,
            echo=not silent,
            observer=Observer(progress=show, interrupt=on_interrupt),
        )
    reopen_standard_streams()
    try:
        if as_json:
            say(node_replay.as_json(result))
            return result.exit_code
        tell_of_run(result.error, result.diverged, result.notes, result.path)
        for line in node_replay.as_text(result, everything=everything):
            say(line)
    except OSError as error:
        return status_without_output(error, result.exit_code)
    return result.exit_code


def tell_of_run(
    error: RunError | None, diverged: bool, notes: tuple[str, ...], path: Path | None
) -> None:
    """Tell how a run went, whose events have been compared."""
    if error is not None:
        if diverged and isinstance(error, NodeError) and error.traceback_text:
            tell(error.traceback_text.rstrip())
        as_recorded = "" if diverged else ", as recorded"
        tell(f"rsltrace: the run failed{as_recorded}: {error}")
    for note in notes:
        tell(f"note: {note}")
    if path is not None:
        tell(f"wrote {path}")
