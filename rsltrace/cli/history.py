"""``rsltrace history``: which jobs of a suite changed at which commit, and which fail how often."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import datetime
from pathlib import Path

import click

from rsltrace.cli.options import complete_files
from rsltrace.cli.output.text_file import write_text
from rsltrace.errors import TraceError
from rsltrace.terminal import say, tell
from rsltrace.trace.model.regular_file import check_not_input
from rsltrace.trace.model.texts import printable

_BAD_LINES_MAX = 10


@click.command()
@click.argument(
    "places", metavar="HISTORY...", nargs=-1, required=True, shell_complete=complete_files
)
@click.option("--job", metavar="GLOB", default="*", help="Show only these jobs.")
@click.option("--branch", metavar="GLOB", default="*", help="Show only runs of these branches.")
@click.option(
    "--since",
    type=click.DateTime(["%Y-%m-%d"]),
    metavar="DATE",
    help="Show only runs since DATE (2026-11-01, UTC).",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(("text", "json", "html")),
    default="text",
    show_default=True,
    help="Format of the summary; html is a page for the browser.",
)
@click.option("--json", "form", flag_value="json", help="Print one JSON object.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write the summary to FILE, as a page if its name ends in .html.",
)
def history(
    places: tuple[str, ...],
    job: str,
    branch: str,
    since: datetime | None,
    form: str,
    output: Path | None,
) -> None:
    """Summarize the runs of a suite: which jobs changed their digest at which commit, and which
    fail in which share of their runs and orders.

    HISTORY is what --history of verify, explore and diff, or pytest --rsltrace-history, appends to:
    a file, or a folder or address (s3://…) with a file for each run. Lines of several are read
    together. A job's digest is compared with that of its run before on the same branch.
    """
    from rsltrace.search.history.summary import as_text, summarize

    if output is not None:
        check_not_input(output, [Path(one) for one in places if "://" not in one], "history")
        form = "html" if (form, output.suffix) == ("text", ".html") else form
    bad = 0

    def on_bad(name: str, line: int) -> None:
        nonlocal bad
        bad += 1
        if bad <= _BAD_LINES_MAX:
            text = f"{name}:{line}: skipped, it is cut off or not written by rsltrace"
            tell(printable(f"rsltrace: warning: {text}"))

    day = "" if since is None else f"{since:%Y-%m-%d}"
    found = summarize(places, job=job, branch=branch, since=day, on_bad=on_bad)
    if bad > _BAD_LINES_MAX:
        tell(f"rsltrace: warning: {bad - _BAD_LINES_MAX} more lines were skipped")
    if bad and not found.runs and (job, branch, since) == ("*", "*", None):
        raise TraceError(
            f"{printable(' '.join(places))}: no line of a history; name what --history appends to"
        )
    if form == "html":
        from rsltrace_viewer.pages.history_page import history_page

        text = history_page(found)
    elif form == "json":
        values = asdict(found)
        values["results"] = [
            {"job": name, "commit": commit, **asdict(one)}
            for (name, commit), one in found.results.items()
        ]
        text = json.dumps(values, indent=2) + "\n"
    else:
        text = "".join(f"{printable(line)}\n" for line in as_text(found))
    if output is None:
        say(text, end="")
    else:
        write_text(output, text)
