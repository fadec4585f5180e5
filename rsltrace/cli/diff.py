"""``rsltrace diff``: where two runs diverge, and why."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.options import complete_files
from rsltrace.cli.output.text_file import write_text
from rsltrace.diff.options import BY_ORDER, BY_STAMP, DiffOptions, exit_code_of_several
from rsltrace.errors import EXIT_USAGE, RsltraceError, TraceError, TraceFormatError
from rsltrace.terminal import say, tell
from rsltrace.trace.model.regular_file import check_not_input
from rsltrace.trace.model.texts import printable

if TYPE_CHECKING:
    from rsltrace.diff.report.line import Line
    from rsltrace.diff.result import BagDiff, Diff
    from rsltrace.trace.reader import Trace

_FORMATS = ("text", "json", "markdown", "junit", "github", "html")
_CI_FORMATS = ("junit", "github")
_WIDTH, _WIDTH_MIN, _WIDTH_MAX = 100, 60, 200
_ONE_LINE = 10_000
_HEIGHT_MIN = 21
_PROMPTS = 3
"""Lines a terminal shows beside the report: the command, perhaps on two lines, and the prompt."""
_ASCII = str.maketrans({"└": "`-", "…": "...", "→": "->", "≠": "!=", "↓": "v", "↑": "^"})


class Tolerance(click.ParamType):  # type: ignore[type-arg]  # not generic before click 8.2
    """``FIELD=TOL``: a glob of fields and a number."""

    name = "tolerance"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float]:
        """Return the glob and the tolerance, or end with a usage error."""
        if isinstance(value, tuple):
            return value
        field, equals, text = str(value).rpartition("=")
        try:
            if not (equals and field):
                raise ValueError
            return field, float(text)
        except ValueError:
            self.fail(f"{value!r} is not FIELD=TOL, as in pose.*=1e-6", param, ctx)


@click.command()
@click.argument("golden", metavar="A", shell_complete=complete_files)
@click.argument("others", metavar="B...", nargs=-1, required=True, shell_complete=complete_files)
@click.option(
    "--format",
    "form",
    type=click.Choice(_FORMATS),
    default="text",
    show_default=True,
    help="Format of the report.",
)
@click.option(
    "--context",
    type=click.IntRange(min=0),
    default=5,
    show_default=True,
    metavar="N",
    help="Show N events before the divergence (for recordings: messages).",
)
@click.option(
    "--all", "everything", is_flag=True, help="Show every independent divergence in full."
)
@click.option(
    "--node",
    "nodes",
    multiple=True,
    metavar="GLOB",
    help="Compare only events of these nodes. Repeatable.",
)
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="GLOB",
    help="Compare only these topics and services. Repeatable.",
)
@click.option(
    "--ignore",
    multiple=True,
    metavar="FIELD",
    help="Do not compare these fields: header.stamp, *.covariance, /odom:twist. Repeatable.",
)
@click.option(
    "--abs",
    "absolute",
    multiple=True,
    type=Tolerance(),
    metavar="FIELD=TOL",
    help="Tolerate |a-b| <= TOL in these fields (times in seconds). Repeatable.",
)
@click.option(
    "--rel",
    "relative",
    multiple=True,
    type=Tolerance(),
    metavar="FIELD=TOL",
    help="Tolerate |a-b| <= TOL * max(|a|, |b|) in these fields. Repeatable.",
)
@click.option(
    "--by",
    type=click.Choice((BY_ORDER, BY_STAMP)),
    default=BY_ORDER,
    show_default=True,
    help="Match the messages of recordings by order or by log time.",
)
@click.option(
    "--check",
    is_flag=True,
    help="First verify all checksums, hashes and messages of both traces.",
)
@click.option(
    "--allow-truncated",
    is_flag=True,
    help="Accept truncated files that agree up to their ends.",
)
@click.option(
    "--again",
    metavar="FILE",
    help="Show whether a third trace FILE follows A, B or neither where they diverge.",
)
@click.option(
    "--history",
    metavar="PLACE",
    help="Append a line on each B, as a run of the test with the golden trace A, to this history: "
    'see "rsltrace history".',
)
@click.option("--failed", default="", hidden=True)  # why B failed itself, for the history
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write the report to FILE and print only its first sentence.",
)
def diff(
    golden: str,
    others: tuple[str, ...],
    form: str,
    context: int,
    everything: bool,
    nodes: tuple[str, ...],
    topics: tuple[str, ...],
    ignore: tuple[str, ...],
    absolute: tuple[tuple[str, float], ...],
    relative: tuple[tuple[str, float], ...],
    by: str,
    check: bool,
    allow_truncated: bool,
    again: str | None,
    history: str | None,
    failed: str,
    output: Path | None,
) -> int:
    """Compare two traces and show where they first diverge, and why.

    A and B are traces (files, or addresses such as https:// and s3://), rosbag2 recordings
    (folders, .mcap or .db3 files), or one of each. With several B, A is the reference: each B is
    compared with it, and the report is a table.

    FIELD is a glob on field paths (pose.pose.position.x, ranges[17]). It may start with a glob of
    topics and a colon.

    Exit status: 0 if they are identical; 1 if they diverge, or if a file is truncated (unless
    --allow-truncated); 2 for an error; 3 if they are equal within tolerance but not identical.
    """
    if again is not None:
        return _which(golden, others, again)
    options = DiffOptions(
        context=context,
        everything=everything,
        nodes=nodes,
        topics=topics,
        ignore=ignore,
        absolute=absolute,
        relative=relative,
        by=by,
        allow_truncated=allow_truncated,
    )
    return _diff(golden, others, form, options, output, history, check=check, failed=failed)


def _diff(
    golden: str,
    others: Sequence[str],
    form: str,
    options: DiffOptions,
    output: Path | None,
    history: str | None,
    *,
    check: bool,
    failed: str,
) -> int:
    if output is not None:
        check_not_input(output, [Path(one) for one in (golden, *others) if "://" not in one])
    done: list[Diff | BagDiff] = []
    errors: dict[str, str] = {}
    for other in others:
        try:
            # The golden trace is not checked again for each of the others.
            check_a = check and not done
            if history is None:
                done.append(_compare(golden, other, options, check=check, check_a=check_a))
                continue
            from rsltrace.search.history.run_record import recorded

            file = Path() if "://" in golden else Path(golden)
            with recorded(history, "diff", file, lambda path: [str(path(golden))]) as run:
                done.append(_compare(golden, other, options, check=check, check_a=check_a))
                run.digest = getattr(done[-1].b, "digest", "")
                if done[-1].failed or failed:
                    run.fails(failed or done[-1].sentence)
        except RsltraceError as error:
            if len(others) == 1 and form not in _CI_FORMATS:
                raise
            # One unreadable file must not hide the results of the others.
            tell(f"rsltrace: error: {error}")
            errors[f"{other} agrees with {golden}"] = str(error)
    if done or form in _CI_FORMATS:
        print_diffs(done, form, options, output, errors)
    return EXIT_USAGE if errors else exit_code_of_several(one.exit_code for one in done)


def _which(a: str, others: Sequence[str], again: str) -> int:
    """Print which of two traces a third one follows."""
    from rsltrace.diff.file_kind import is_recording
    from rsltrace.diff.traces.diff import reproduction
    from rsltrace.trace.words.phrases import as_sentence

    if len(others) != 1 or any(map(is_recording, (a, *others, again))):
        raise click.UsageError("--again needs two traces to compare a third one with")
    with _opened(a) as one, _opened(others[0]) as other, _opened(again) as third:
        found = reproduction(one, other, third)
    say(_encodable(as_sentence(found.sentence)))
    return found.exit_code


def _compare(a: str, b: str, options: DiffOptions, *, check: bool, check_a: bool) -> Diff | BagDiff:
    from rsltrace.diff.file_kind import is_recording

    if is_recording(a) or is_recording(b):
        if options.nodes:
            raise click.UsageError("--node needs two traces: a recording has no nodes")
        if check:
            raise click.UsageError("--check needs two traces: a recording has no hashes")
        from rsltrace.diff.bags.comparison import diff_bags

        return diff_bags(a, b, options)
    if options.by != BY_ORDER:
        raise click.UsageError("--by needs a recording: the events of two traces are aligned")
    from rsltrace.diff.traces.diff import diff_traces

    with _opened(a) as trace_a, _opened(b) as trace_b:
        for trace, wanted in ((trace_a, check_a), (trace_b, check)):
            if not (trace.complete or trace.event_count):
                raise TraceError(
                    f"{printable(trace.name)} is truncated before its first event, so there is "
                    "nothing to compare; record the job again"
                )
            if wanted:
                from rsltrace.cli.output.search_progress import working
                from rsltrace.trace.contents import check_contents

                with working(f"checking {trace.name}"):
                    trace.check()
                    check_contents(trace)
        return diff_traces(trace_a, trace_b, options)


def _opened(place: str) -> Trace:
    from rsltrace.trace.reader import Trace

    try:
        return Trace.open(place)
    except TraceFormatError as error:
        if "://" not in place:
            raise
        raise TraceFormatError(
            f"{error}; only traces can be read from an address: download the recording first"
        ) from error


def print_diffs(
    diffs: Sequence[Diff | BagDiff],
    form: str,
    options: DiffOptions,
    output: Path | None,
    errors: Mapping[str, str] | None = None,
) -> None:
    """Print diffs in a form, with the ``errors`` of what could not be compared in those of CI; on a
    terminal, text has its size and colours."""
    from rsltrace.diff.report import render, report_lines
    from rsltrace.diff.report.line import plain_text

    one_or_all = diffs[0] if len(diffs) == 1 else diffs
    if output is not None:
        write_text(output, _rendered(diffs, form, options, errors))
        if not diffs:
            return
        first = plain_text(report_lines(one_or_all, options, width=_ONE_LINE)).splitlines()[0]
        say(_encodable(first))
    elif form != "text":
        say(_rendered(diffs, form, options, errors), end="")
    elif sys.stdout.isatty():
        width, height = _screen()
        _show(report_lines(one_or_all, options, width=width, height=height))
    else:
        say(_encodable(render(one_or_all, "text", options)), end="")


def _rendered(
    diffs: Sequence[Diff | BagDiff],
    form: str,
    options: DiffOptions,
    errors: Mapping[str, str] | None,
) -> str:
    if form == "html":
        from rsltrace_viewer.pages.diff_page import diff_page

        return diff_page(diffs, options)
    if form in _CI_FORMATS and errors:
        from rsltrace.diff.report.ci import github, junit

        return (junit if form == "junit" else github)(diffs, options, errors)
    from rsltrace.diff.report import render

    return render(diffs, form, options)


def _screen() -> tuple[int, int]:
    """Return width and height for a report on a terminal, with room for the prompts around it."""
    import shutil

    from rsltrace.diff.report.line import HEIGHT

    size = shutil.get_terminal_size((_WIDTH, HEIGHT + _PROMPTS))
    width = min(max(size.columns, _WIDTH_MIN), _WIDTH_MAX)
    return width, max(size.lines - _PROMPTS, _HEIGHT_MIN)


def _encodable(text: str) -> str:
    """Return text with plain signs in place of those a terminal without Unicode cannot show."""
    encoding = (sys.stdout.encoding or "").lower()
    return text if encoding.startswith("utf") else text.translate(_ASCII)


def _show(lines: list[Line]) -> None:
    """Print on a terminal, in colour unless NO_COLOR or the terminal says otherwise."""
    from rich.console import Console
    from rich.text import Text

    from rsltrace.diff.report.line import Style

    styles = {
        Style.TITLE: "bold",
        Style.GOOD: "bold green",
        Style.BAD: "bold red",
        Style.SIDE_A: "cyan",
        Style.SIDE_B: "magenta",
        Style.FAINT: "dim",
        Style.COMMAND: "bold",
    }
    console = Console(highlight=False, soft_wrap=True)
    for row in lines:
        pieces = ((_encodable(text), styles.get(style, "")) for text, style in row)
        console.print(Text.assemble(*pieces))
