"""``rsltrace analyze``: worst-case response times, beside those that runs have shown."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.options import set_option
from rsltrace.cli.output.text_file import check_picture, save_picture
from rsltrace.errors import TraceError
from rsltrace.job.values.times import parse_time
from rsltrace.terminal import say, tell, tell_notes
from rsltrace.trace.model.texts import format_duration, printable
from rsltrace.trace.words.phrases import table

if TYPE_CHECKING:
    from rsltrace.job import Job
    from rsltrace.native.timing.bounds import ChainResult, TimingAnalysis, WorstResponse
    from rsltrace.native.timing.chains import ObservedChains
    from rsltrace.native.timing.system import Supply


@click.command()
@click.argument("job", type=click.Path(path_type=Path))
@click.argument("traces", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--times",
    type=click.Choice(("job", "max", "p99")),
    help="Take the execution times of callbacks from the job's execution: (default if it has one), "
    "or from TRACES: the maximum or the 99 % quantile.",
)
@click.option(
    "--deadline",
    "deadlines",
    multiple=True,
    metavar="[END=]TIME",
    help="Set the deadline of all chains, or of those that end in a topic, service or node: "
    "/cmd_vel=50ms. Default: the period of each chain. Repeatable.",
)
@click.option(
    "--reservation",
    metavar="BUDGET/PERIOD",
    help="Give each executor a CPU reservation, such as 2ms/5ms, instead of a CPU of its own.",
)
@click.option(
    "--one-processor",
    is_flag=True,
    help="Let all executors share one CPU. Those with faster timers preempt the others.",
)
@set_option
@click.option(
    "--plot",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Plot bounds and observations as .png, .svg or .pdf (needs matplotlib).",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(("text", "json")),
    default="text",
    show_default=True,
    help="Print a table, or JSON (times in nanoseconds).",
)
def analyze(
    job: Path,
    traces: tuple[Path, ...],
    times: str | None,
    deadlines: tuple[str, ...],
    reservation: str | None,
    one_processor: bool,
    overrides: tuple[str, ...],
    plot: Path | None,
    form: str,
) -> None:
    """Compute the worst-case response time of each callback chain of JOB.

    A response time runs from the release of a timer (or an external message) to the end of the
    last callback of the chain. The table also shows the worst response time of a simulated run
    and of each of the native TRACES.

    The job is simulated to find its chains, unless one of the TRACES is a simulated one. The
    analysis depends on the job's policy (see docs/real-time.md).

    Exit status: 0 if every chain meets its deadline, 1 if one does not or may not.

    \b
      rsltrace analyze job.yaml
      rsltrace analyze job.yaml native.mcap --times max --plot bounds.png
    """
    from rsltrace.job import load_job
    from rsltrace.native.timing import bounds as timing
    from rsltrace.native.timing.model import ProcessorModel, check_job
    from rsltrace.run.inputs import expand_launch_files

    supply = _supply(reservation)
    by_end = dict(_deadline(text) for text in deadlines)
    if plot is not None:
        check_picture(plot)
    loaded = expand_launch_files(load_job(job, overrides=list(overrides))).job
    check_job(loaded)
    with ExitStack() as stack:
        simulated, native = _opened(traces, stack)
        measured = times if times is not None else "job" if loaded.execution else "max"
        given = None
        if measured != "job":
            sources = native or simulated
            if not sources:
                raise click.UsageError(
                    "the execution times of callbacks are unknown: give native traces of the job "
                    "(rsltrace record --native), or add execution: to it"
                )
            given = timing.measured_times(sources, measured)
            loaded = timing.with_times(loaded, given)
        elif not loaded.execution:
            raise click.UsageError(f"{job} has no execution:, which --times job needs")
        shown = simulated[0] if simulated else _simulated(loaded, stack)
        found = timing.analyze(
            loaded,
            shown,
            native,
            times=given,
            deadlines=by_end,
            wanted=ProcessorModel(supply, one_processor),
        )
    if form == "json":
        say(json.dumps(_as_json(found, measured), indent=2))
    else:
        _print(found, measured, [one.trace.name for one in native])
    if plot is not None:
        save_picture(_picture_of(found), plot)
        tell(f"wrote {plot}")
    sys.exit(0 if found.all_meet else 1)


def _supply(reservation: str | None) -> Supply:
    from rsltrace.native.timing.system import PROCESSOR, Supply

    if reservation is None:
        return PROCESSOR
    try:
        budget, period = (parse_time(word) for word in reservation.split("/"))
        if not 0 < budget <= period:
            raise ValueError
    except ValueError:
        raise click.BadParameter(
            f"{reservation!r} is not a reservation: give budget and period, such as 2ms/5ms",
            param_hint="--reservation",
        ) from None
    return Supply(budget, period)


def _deadline(text: str) -> tuple[str, int]:
    end, _, time = text.rpartition("=")
    try:
        return end, parse_time(time)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--deadline") from None


def _opened(
    traces: Sequence[Path], stack: ExitStack
) -> tuple[list[ObservedChains], list[ObservedChains]]:
    """Return what the simulated and the native ones of some traces show.

    :raises TraceError: there are several simulated ones, or one is damaged.
    """
    from rsltrace.native.timing.chains import ObservedChains
    from rsltrace.trace.native import is_native
    from rsltrace.trace.reader import Trace

    simulated: list[ObservedChains] = []
    native: list[ObservedChains] = []
    for path in traces:
        trace = stack.enter_context(Trace.open(path))
        (native if is_native(trace) else simulated).append(ObservedChains(trace))
    if len(simulated) > 1:
        raise TraceError(
            f"{simulated[0].trace.name} and {simulated[1].trace.name} are both simulated runs: "
            "give at most one, and any number of native ones"
        )
    return simulated, native


def _simulated(job: Job, stack: ExitStack) -> ObservedChains:
    """Run a job, and return what that shows.

    :raises RunError: the run fails.
    """
    from rsltrace.native.timing.chains import ObservedChains
    from rsltrace.run import record
    from rsltrace.trace.reader import Trace

    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="rsltrace-"))
    path = Path(folder) / "run.mcap"
    record(job, path)
    return ObservedChains(stack.enter_context(Trace.open(path)))


def _print(found: TimingAnalysis, times: str, native: Sequence[str]) -> None:
    say("\n".join(map(printable, _as_text(found, times, native))))
    tell_notes(found.notes)


# The report: chains with bounds and worst observed response times.


_NS_PER_MS = 1e6


def _picture_of(found: TimingAnalysis) -> Any:
    """Return a matplotlib figure of the chains: bound, observations and deadline of each."""
    from matplotlib.figure import Figure

    chains = list(reversed(found.chains))
    figure = Figure(figsize=(9, 1.2 + 0.5 * len(chains)), layout="constrained")
    axes = figure.add_subplot()
    rows = range(len(chains))
    bounds = [(one.bound_ns or 0) / _NS_PER_MS for one in chains]
    axes.barh(rows, bounds, height=0.6, color="#c6d4e1", label="bound")
    for row, one in zip(rows, chains, strict=True):
        marks = [(one.simulated, "o", "#1b6ca8", "simulated, worst")]
        marks += [(seen, "x", "#b5482a", "native, worst") for seen in one.native]
        for seen, mark, color, label in marks:
            if seen is not None:
                axes.plot(seen.worst_ns / _NS_PER_MS, row, mark, color=color, label=label)
        if one.deadline_ns is not None:
            at = one.deadline_ns / _NS_PER_MS
            axes.plot([at, at], [row - 0.4, row + 0.4], color="black", label="deadline")
        if one.bound_ns is None:
            axes.text(0, row, " no bound", va="center", color="#b5482a")
    axes.set_yticks(list(rows), [fill(one.name, 45) for one in chains])
    axes.set_xlabel("response time in ms")
    handles, labels = axes.get_legend_handles_labels()
    shown = dict(zip(labels, handles, strict=True))
    figure.legend(shown.values(), shown.keys(), loc="outside upper center", ncols=len(shown))
    return figure


_TIMES = {
    "job": "maximum of the job's execution:",
    "max": "maximum measured",
    "p99": "99 % quantile measured; bounds hold only as often",
}


def _as_text(found: TimingAnalysis, times: str, native: Sequence[str]) -> list[str]:
    """Return a table of chains, of executors, and how many chains meet their deadlines."""
    columns = ["native" if len(native) == 1 else f"native {n + 1}" for n in range(len(native))]
    rows = [("chain", "period", "bound", "simulated", *columns, "deadline", "", "by")]
    for one in found.chains:
        rows.append(
            (
                one.name,
                _time(one.period_ns),
                "none" if one.bound_ns is None else _time(one.bound_ns),
                _seen(one.simulated),
                *map(_seen, one.native),
                _time(one.deadline_ns),
                one.verdict,
                one.method,
            )
        )
    right = frozenset(range(1, len(columns) + 5))
    lines = [f"execution times: {_TIMES[times]}", "", *table(rows, right=right), ""]
    loads = ", ".join(f"{name} {part:.1%}" for name, part in found.load.items())
    if loads:
        lines.append(f"maximum load: {loads}")
    late = [one for one in found.chains if one.verdict in ("misses", "may miss")]
    if late:
        lines += [_why(one) for one in late]
    else:
        lines.append("every chain meets its deadline")
    return lines


def _why(one: ChainResult) -> str:
    deadline = format_duration(one.deadline_ns or 0)
    if one.verdict == "misses":
        seen = format_duration(one.seen_ns or 0)
        return f"{one.name} misses its deadline of {deadline}: it took {seen}"
    if one.bound_ns is None:
        return f"{one.name} may miss its deadline of {deadline}: there is no bound"
    bound = format_duration(one.bound_ns)
    return f"{one.name} may miss its deadline of {deadline}: it takes up to {bound}"


def _as_json(found: TimingAnalysis, times: str) -> dict[str, Any]:
    """Return the analysis as JSON-compatible values; times in nanoseconds."""
    return {
        "times": times,
        "meets": found.all_meet,
        "chains": [
            {
                "name": one.name,
                "callbacks": [callback._asdict() for callback in one.chain],
                "period_ns": one.period_ns,
                "deadline_ns": one.deadline_ns,
                "bound_ns": one.bound_ns,
                "analysis": one.method,
                "simulated": None if one.simulated is None else asdict(one.simulated),
                "native": [None if seen is None else asdict(seen) for seen in one.native],
                "verdict": one.verdict,
            }
            for one in found.chains
        ],
        "executors": dict(found.load),
        "execution_ns": [
            {**callback._asdict(), "longest_ns": longest_ns}
            for callback, longest_ns in found.times.items()
        ],
        "notes": list(found.notes),
    }


def _time(time_ns: int | None) -> str:
    return "-" if time_ns is None else format_duration(time_ns)


def _seen(seen: WorstResponse | None) -> str:
    return "-" if seen is None else format_duration(seen.worst_ns)
