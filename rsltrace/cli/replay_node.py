"""``rsltrace replay --node``: one node alone, with its input from a trace or a bag."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rsltrace.cli.output.exit_status import reopen_standard_streams, status_without_output
from rsltrace.cli.output.search_progress import interruptible, progress
from rsltrace.diff.options import DiffOptions
from rsltrace.errors import NodeError, RunError
from rsltrace.guard.pin import unpin
from rsltrace.terminal import say, tell

if TYPE_CHECKING:
    from rsltrace.replay.one_node.result import NodeReplayResult
    from rsltrace.replay.preparation import ReplayPlan
    from rsltrace.run import RunCallbacks


@dataclass(frozen=True, slots=True)
class NodeReplayOptions:
    """The options of a replay of one node; ``node`` is empty for the whole job."""

    node: str
    bags: tuple[Path, ...]
    until_diverged: bool
    everything: bool
    options: DiffOptions | None
    output: Path | None
    force: bool
    quiet: bool
    as_json: bool

    def check(self, until: str | None, first: str | None, edits: tuple[str, ...]) -> None:
        """Refuse options that have no effect together.

        :raises click.UsageError: there are some.
        """
        of_node = (self.bags, self.until_diverged, self.everything, self.options)
        if not self.node and any(of_node):
            raise click.UsageError("--bag, --until-diverged, --all, --ignore and --abs need --node")
        if self.node and (until is not None or first is not None):
            raise click.UsageError(
                "--from and --until have no effect with --node; use --until-diverged"
            )
        if self.node and edits:
            raise click.UsageError("--edit needs the whole run: leave out --node")
        if self.bags and self.until_diverged:
            raise click.UsageError("--until-diverged has no effect with --bag")


def replay_one(plan: ReplayPlan, ways: NodeReplayOptions) -> int:
    """Replay one node of a trace, and print the result."""
    from rsltrace.replay.one_node.from_bag import replay_from_bag
    from rsltrace.replay.one_node.replaying import replay_node

    def go(echo: bool, observer: RunCallbacks) -> NodeReplayResult:
        if ways.bags:
            return replay_from_bag(
                plan.job,
                ways.node,
                ways.bags,
                options=ways.options,
                output=ways.output,
                force=ways.force,
                echo=echo,
                observer=observer,
            )
        return replay_node(
            plan,
            ways.node,
            until_diverged=ways.until_diverged,
            options=ways.options,
            output=ways.output,
            force=ways.force,
            echo=echo,
            observer=observer,
        )

    return _shown(go, ways)


def replay_from_job(path: Path, ways: NodeReplayOptions, *, no_pin: bool) -> int:
    """Run one node of a job file with input from bags, and print the result."""
    from rsltrace.replay.one_node.from_bag import replay_from_bag
    from rsltrace.replay.one_node.ways import load_without_bags

    job = load_without_bags(path)
    if no_pin or not job.guard.pins:
        unpin()

    def go(echo: bool, observer: RunCallbacks) -> NodeReplayResult:
        return replay_from_bag(
            job,
            ways.node,
            ways.bags,
            options=ways.options,
            output=ways.output,
            force=ways.force,
            echo=echo,
            observer=observer,
        )

    return _shown(go, ways)


def _shown(go: Callable[[bool, RunCallbacks], NodeReplayResult], ways: NodeReplayOptions) -> int:
    from rsltrace.replay.one_node import result as report
    from rsltrace.run import RunCallbacks

    silent = ways.quiet or ways.as_json
    with interruptible() as on_interrupt, progress(quiet=silent, what="replaying") as show:
        result = go(not silent, RunCallbacks(progress=show, interrupt=on_interrupt))
    reopen_standard_streams()
    try:
        if ways.as_json:
            say(report.as_json(result))
            return result.exit_code
        tell_of_run(result.error, result.diverged, result.notes, result.path)
        for line in report.as_text(result, everything=ways.everything):
            say(line)
    except OSError as error:
        return status_without_output(error, result.exit_code)
    return result.exit_code


def tell_of_run(
    error: RunError | None, diverged: bool, notes: tuple[str, ...], path: Path | None
) -> None:
    """Print the failure, notes and output file of a replay."""
    if error is not None:
        if diverged and isinstance(error, NodeError) and error.traceback_text:
            tell(error.traceback_text.rstrip())
        as_recorded = "" if diverged else ", as recorded"
        tell(f"rsltrace: the run failed{as_recorded}: {error}")
    for note in notes:
        tell(f"note: {note}")
    if path is not None:
        tell(f"wrote {path}")
