"""``rsltrace export``: what is in a trace, in the formats of others."""

from __future__ import annotations

from pathlib import Path

import click

from rsltrace.terminal import tell
from rsltrace.trace.model.texts import format_seconds

EXIT_CUT = 1


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.option(
    "--bag",
    "-o",
    type=click.Path(path_type=Path),
    required=True,
    metavar="FOLDER",
    help="Write a rosbag2 bag: metadata.yaml and one MCAP file.",
)
@click.option("--topics", multiple=True, metavar="GLOB", help="Only these topics (repeatable).")
@click.option("--exclude", multiple=True, metavar="GLOB", help="Not these topics (repeatable).")
@click.option("--force", is_flag=True, help="Replace an existing bag.")
def export(
    trace: Path, bag: Path, topics: tuple[str, ...], exclude: tuple[str, ...], force: bool
) -> int:
    """Write the messages of TRACE as a plain rosbag2 bag, without what rsltrace keeps of its own.

    Stamps are simulated time. The bag appears when it is complete, or not at all. Messages whose
    payloads the job did not keep (record: in a job) are not in it.

    The exit status is 0 if the bag is all there is, 1 if TRACE is cut (its run was killed): the bag
    then ends where the trace does.
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
    tell(f"rsltrace: note: {trace} is cut: the bag ends with it, after {events} events, at {end} s")
    return EXIT_CUT
