"""``rsltrace export``: a trace as a rosbag2 bag, for Perfetto, and as a layout for Foxglove."""

from __future__ import annotations

import os
from pathlib import Path

import click

from rsltrace.terminal import say, tell, tell_notes
from rsltrace.trace.model.texts import format_seconds

EXIT_TRUNCATED = 1


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.option(
    "--bag",
    "-o",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Write the messages to this folder as a bag: metadata.yaml and one MCAP file.",
)
@click.option(
    "--perfetto",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write callbacks, causes, topic rates, waiting messages, logs, findings and exceptions to "
    "this file, for ui.perfetto.dev. Needs pip install 'rsltrace[perfetto]'.",
)
@click.option(
    "--layout",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write a layout (.json) for Foxglove and Lichtblick to this file: plots of what varies, "
    "state transitions, 3D, log. Open TRACE with it.",
)
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="GLOB",
    help="Export only these topics (bag, layout). Repeatable.",
)
@click.option(
    "--exclude",
    multiple=True,
    metavar="GLOB",
    help="Leave out these topics (bag, layout). Repeatable.",
)
@click.option("--force", is_flag=True, help="Replace an existing bag or file.")
def export(
    trace: Path,
    bag: Path | None,
    perfetto: Path | None,
    layout: Path | None,
    topics: tuple[str, ...],
    exclude: tuple[str, ...],
    force: bool,
) -> int:
    """Write TRACE for other tools: a plain rosbag2 bag, a Perfetto file, a Foxglove layout.

    Give at least one of --bag, --perfetto and --layout. Timestamps are simulated times. An output
    appears only when it is complete. A bag lacks messages whose payloads the job did not record
    (record: in the job).

    Exit status: 0 if the output is complete, 1 if TRACE is truncated because its run was killed.
    The output then ends where the trace does.
    """
    outputs = [path for path in (bag, perfetto, layout) if path is not None]
    if not outputs:
        raise click.UsageError("give --bag, --perfetto or --layout: what to write")
    if len({os.path.realpath(path) for path in outputs}) < len(outputs):
        raise click.UsageError("--bag, --perfetto and --layout need different names")
    if (topics or exclude) and bag is None and layout is None:
        raise click.UsageError("--topic and --exclude need --bag or --layout")
    from rsltrace.cli.output.search_progress import working
    from rsltrace.trace.exports.layout import export_layout
    from rsltrace.trace.exports.perfetto import export_perfetto, require_perfetto
    from rsltrace.trace.model.regular_file import check_output_file
    from rsltrace.trace.reader import Trace
    from rsltrace.trace.recordings.export import check_bag_folder, export_bag

    with Trace.open(trace) as opened:
        whole, events, end = (
            opened.complete,
            opened.event_count,
            format_seconds(opened.stamp(opened.end_ns)),
        )
    if perfetto is not None:
        require_perfetto()
        check_output_file(perfetto, [trace], force=force, example="run.pftrace")
    if layout is not None:
        check_output_file(layout, [trace], force=force, example="layout.json")
    if bag is not None:
        check_bag_folder(bag, force=force)
    chosen = topics or ("*",)
    if layout is not None:
        panels = export_layout(trace, layout, topics=chosen, exclude=exclude, force=force)
        tell(f"wrote {layout}: {panels} panels")
    if perfetto is not None:
        with working(f"writing {perfetto}") as progress:
            written = export_perfetto(trace, perfetto, force=force, progress=progress)
        tell(f"wrote {perfetto}: {written} events")
    if bag is not None:
        with working(f"writing {bag}") as progress:
            count = export_bag(
                trace, bag, topics=chosen, exclude=exclude, force=force, progress=progress
            )
        tell(f"wrote {bag}: {count} messages")
    if whole:
        return 0
    # Messages are in the file before the events that sent them.
    ends = f"the export ends with it after {events} events, at {end} s"
    if bag is not None:
        ends = f"the bag has only the {count} messages before the cut"
    tell(f"rsltrace: note: {trace} is truncated: {ends}")
    return EXIT_TRUNCATED


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.argument("other", type=click.Path(path_type=Path), required=False)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write a Rerun recording (.rrd). Open it with `rerun FILE`.",
)
@click.option("--spawn", is_flag=True, help="Open Rerun's viewer (default if there is a display).")
@click.option("--web", is_flag=True, help="Open Rerun in a browser, served to this machine only.")
@click.option("--by-event", is_flag=True, help="Start on the timeline of events instead of time.")
@click.option("--force", is_flag=True, help="Replace the output file if it exists.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing about the written file.")
def rerun(
    trace: Path,
    other: Path | None,
    output: Path | None,
    spawn: bool,
    web: bool,
    by_event: bool,
    force: bool,
    quiet: bool,
) -> None:
    """Show TRACE in Rerun, or TRACE and OTHER side by side.

    The timelines are simulated time and event number: stepping along the events steps through the
    callbacks. Messages are drawn and plotted; logs and events are listed. For two traces, the first
    divergence is marked and explained.

    \b
    Needs Rerun: pip install 'rsltrace[rerun]'
    """
    if spawn and web:
        raise click.UsageError("give --spawn or --web, not both")
    from rsltrace_viewer.rerun_export import sdk

    sdk.require()
    import rsltrace_viewer.rerun_export.show as show
    from rsltrace_viewer.rerun_export.export import export

    from rsltrace.cli.output.search_progress import working

    how = show.choose(spawn=spawn, web=web, output=output)
    traces = [trace] if other is None else [trace, other]
    if output is not None:
        with working(f"writing {output}"):
            done = export(traces, output, force=force, by_event=by_event)
        tell_notes(done.notes)
        if not quiet:
            say(
                f"wrote {output}: {done.events} events, {done.bytes / 1e6:.1f} MB "
                f"({done.bytes / max(done.trace_bytes, 1):.1f} x the trace)"
            )
        if how is not None:
            show.open_viewer(output, how)
    elif how is not None:
        with show.temporary_recording() as target:
            with working("making the recording"):
                done = export(traces, target, by_event=by_event)
            tell_notes(done.notes)
            show.open_viewer(target, how)
