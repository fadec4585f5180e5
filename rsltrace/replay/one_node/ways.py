"""The sources of a one-node replay: a trace, a trace with a bag, a job with a bag."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rsltrace.diff.options import DiffOptions
from rsltrace.errors import ReplayError
from rsltrace.job import Job, load_job
from rsltrace.replay.one_node.from_bag import replay_from_bag
from rsltrace.replay.one_node.replaying import replay_node
from rsltrace.replay.one_node.result import NodeReplayResult
from rsltrace.replay.preparation import prepare_replay, without_bags


def is_job(path: Path) -> bool:
    return path.suffix in (".yaml", ".yml", ".json")


def load_without_bags(path: Path) -> Job:
    """Load a job file without its bags.

    :raises JobError: it cannot be used.
    """
    return without_bags(lambda to: load_job(path, overrides=to))


def replay_one(
    source: Path,
    node: str,
    *,
    bags: Sequence[Path],
    until_diverged: bool,
    options: DiffOptions | None,
    output: Path | None,
    force: bool,
    job: Job | None,
    job_folder: Path | None,
    trust: bool,
    echo: bool,
) -> NodeReplayResult:
    """Replay one node: of a trace, of a trace with bags, or of a job with bags.

    :raises RsltraceError: as ``rsltrace.replay``.
    """
    if bags and is_job(source):
        return replay_from_bag(
            job or load_without_bags(source),
            node,
            bags,
            options=options,
            output=output,
            force=force,
            echo=echo,
        )
    with prepare_replay(source, job_folder, job, bags=False) as plan:
        if plan.distrust and not trust:
            raise ReplayError(f"{source} would run code, and {plan.distrust}: give trust=True")
        if bags:
            return replay_from_bag(
                plan.job, node, bags, options=options, output=output, force=force, echo=echo
            )
        return replay_node(
            plan,
            node,
            until_diverged=until_diverged,
            options=options,
            output=output,
            force=force,
            echo=echo,
        )
