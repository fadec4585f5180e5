"""``rsltrace export``: what is in a trace, in the formats of others."""

from __future__ import annotations

from pathlib import Path

import click

from rsltrace.terminal import tell


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
) -> None:
    """Write the messages of TRACE as a plain rosbag2 bag, without what rsltrace keeps of its own.

    Stamps are simulated time. The bag appears when it is complete, or not at all. Messages whose
    payloads the job did not keep (record: in a job) are not in it.
    """
    from rsltrace.bag.export import export_bag

    count = export_bag(trace, bag, topics=topics or ("*",), exclude=exclude, force=force)
    tell(f"wrote {bag}: {count} messages")
