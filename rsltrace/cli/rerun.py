"""``rsltrace rerun``: a trace, or two side by side, in Rerun."""

from __future__ import annotations

from pathlib import Path

import click

from rsltrace.terminal import say, tell_notes


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
