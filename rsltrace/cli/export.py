"""``rsltrace export``: the messages of a trace as a rosbag2 bag."""

from __future__ import annotations

from pathlib import Path

import click

from rsltrace.terminal import tell
from rsltrace.trace.model.texts import format_seconds

EXIT_TRUNCATED = 1


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.option(
    "--bag",
    "-o",
    type=click.Path(path_type=Path),
    required=True,
    metavar="FOLDER",
    help="Write the bag to this folder: metadata.yaml and one MCAP file.",
)
@click.option(
    "--topic", "topics", multiple=True, metavar="GLOB", help="Export only these topics. Repeatable."
)
@click.option(
    "--exclude", multiple=True, metavar="GLOB", help="Leave out these topics. Repeatable."
)
@click.option("--force", is_flag=True, help="Replace an existing bag.")
def export(
    trace: Path, bag: Path, topics: tuple[str, ...], exclude: tuple[str, ...], force: bool
) -> int:
    """Write the messages of TRACE to a plain rosbag2 bag.

    Timestamps are simulated times. The bag appears only when it is complete. It lacks messages
    whose payloads the job did not record (record: in the job).

    Exit status: 0 if the bag is complete, 1 if TRACE is truncated because its run was killed. The
    bag then ends where the trace does.
    """
    from rsltrace.cli.output.search_progress import working
    from rsltrace.trace.reader import Trace
    from rsltrace.trace.recordings.export import export_bag

    with Trace.open(trace) as opened:
        whole, events, end = opened.complete, opened.event_count, format_seconds(opened.end_ns)
    with working(f"writing {bag}") as progress:
        count = export_bag(
            trace,
            bag,
            topics=topics or ("*",),
            exclude=exclude,
            force=force,
            progress=progress,
        )
    tell(f"wrote {bag}: {count} messages")
    if whole:
        return 0
    tell(
        f"rsltrace: note: {trace} is truncated: the bag ends with it after {events} events, "
        f"at {end} s"
    )
    return EXIT_TRUNCATED
