"""Run a trace again: the same job, with every event checked against the trace.

>>> import rsltrace
>>> result = rsltrace.replay("run.mcap")                  # doctest: +SKIP
>>> result.sentence                                       # doctest: +SKIP

This package is also that function, as ``rsltrace.diff`` is.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, overload

from rsltrace.callable_package import make_callable

if TYPE_CHECKING:
    from rsltrace.diff.options import DiffOptions
    from rsltrace.job import Job
    from rsltrace.replay.one_node.result import NodeReplayResult
    from rsltrace.replay.replaying import ReplayResult


@overload
def replay_trace(
    trace: str | Path,
    *,
    until: int | str | None = None,
    output: str | Path | None = None,
    force: bool = False,
    job: Job | None = None,
    job_folder: str | Path | None = None,
    trust: bool = False,
    echo: bool = False,
    edits: str | Sequence[str] = (),
) -> ReplayResult: ...


@overload
def replay_trace(
    trace: str | Path,
    *,
    node: str,
    bag: str | Path | Sequence[str | Path] | None = None,
    until_diverged: bool = False,
    options: DiffOptions | None = None,
    output: str | Path | None = None,
    force: bool = False,
    job: Job | None = None,
    job_folder: str | Path | None = None,
    trust: bool = False,
    echo: bool = False,
) -> NodeReplayResult: ...


def replay_trace(
    trace: str | Path,
    *,
    node: str | None = None,
    bag: str | Path | Sequence[str | Path] | None = None,
    until: int | str | None = None,
    until_diverged: bool = False,
    options: DiffOptions | None = None,
    output: str | Path | None = None,
    force: bool = False,
    job: Job | None = None,
    job_folder: str | Path | None = None,
    trust: bool = False,
    echo: bool = False,
    edits: str | Sequence[str] = (),
) -> ReplayResult | NodeReplayResult:
    """Run the job of a trace again, and stop at the first event that is not as recorded.

    ``until`` is the last event to verify, by its index (an int, or digits), or a simulated time as
    text (``"2.5"`` seconds, ``"60s"``). ``output`` takes the replay's own trace, ``force`` replaces
    one that is there. ``job_folder`` is the folder of the job's file; without it, that of the trace
    and the present one are tried. ``job`` is the job itself, of one made in Python that cannot be
    loaded from its text. ``echo`` prints the nodes' log records on stderr.

    With ``node``, that node runs alone with its recorded inputs, and its outputs
    are compared, within what ``options`` leave out or tolerate; ``until_diverged`` ends the run at
    the first that differs. Then ``until`` has no meaning, and the result is another one. With
    ``bag`` (one rosbag2 recording or several), the node gets what is in there on the topics that it
    subscribes to; ``trace`` may be a job file, then, and what the recording has on topics that the
    node publishes is compared.

    This runs the code that the trace names. Unless the job file in the working directory (or in
    ``job_folder``) says the same, that takes ``trust=True``.

    ``edits`` change the run, each at an event or a time
    (``'812: message.data = 3.0'``; see ``rsltrace.replay.edits``). The run is then verified up to
    the first of them and goes on as a branch, which is compared with the trace and whose own trace
    (``output``) holds the edits: replaying it makes them again. ``until`` ends the branch, too.

    A native run is simulated in its order and at its times, and compared with the replay.

    Returns a ``rsltrace.ReplayResult``, with ``node`` a ``NodeReplayResult``. A run that fails as
    the recorded one did is verified.

    :raises ReplayError: the trace cannot be replayed here, or is not trusted.
    :raises TraceError: it is missing or damaged.
    :raises EditError: an edit cannot be understood, or not be made.
    :raises JobError, SetupError, BagError, OutputError: its job cannot run, or not be written.
    """
    from rsltrace.errors import ReplayError
    from rsltrace.replay.edits import parse_edit
    from rsltrace.replay.one_node.from_bag import replay_from_bag
    from rsltrace.replay.one_node.replaying import replay_node
    from rsltrace.replay.preparation import (
        ReplayOutput,
        event_count_to,
        is_job,
        load_without_bags,
        prepare_replay,
    )
    from rsltrace.replay.replaying import replay_native, replay_prepared
    from rsltrace.trace.native import is_native

    if node is not None and edits:
        raise ReplayError("edits are for all nodes of a trace: give edits or a node")
    if node is None and bag is not None:
        raise ReplayError("a bag is for one node: say which (node=…)")
    to = ReplayOutput(None if output is None else Path(output), force, echo)
    bags = [Path(one) for one in ([bag] if isinstance(bag, (str, Path)) else bag or ())]
    if node is not None and bags and is_job(Path(trace)):
        job = job or load_without_bags(Path(trace))
        return replay_from_bag(job, node, bags, options=options, to=to)
    folder = None if job_folder is None else Path(job_folder)
    with prepare_replay(trace, folder, job, bags=node is None) as plan:
        if plan.distrust and not trust:
            raise ReplayError(f"{trace} would run code, and {plan.distrust}: give trust=True")
        if node is not None:
            return replay_node(
                plan, node, bags, until_diverged=until_diverged, options=options, to=to
            )
        if is_native(plan.trace):
            if edits or until is not None:
                raise ReplayError(f"{trace} is of a native run: edit a replay of it (output=…)")
            return replay_native(plan, to=to)
        return replay_prepared(
            plan,
            until=None if until is None else event_count_to(plan.trace, until, "until"),
            to=to,
            edits=[parse_edit(edit) for edit in ([edits] if isinstance(edits, str) else edits)],
        )


make_callable(__name__, replay_trace)
