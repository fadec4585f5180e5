"""``rsltrace analyze``: worst-case response times, beside those that runs have shown."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rsltrace.cli.options import set_option
from rsltrace.cli.output.text_file import check_picture, save_picture
from rsltrace.errors import TraceError
from rsltrace.job.values.times import parse_time
from rsltrace.terminal import say, tell, tell_notes
from rsltrace.trace.model.texts import printable

if TYPE_CHECKING:
    from rsltrace.job import Job
    from rsltrace.native.timing.analysis import TimingAnalysis
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
    from rsltrace.native.timing import analysis as timing
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
        from rsltrace.cli.output.analysis_text import as_json

        say(json.dumps(as_json(found, measured), indent=2))
    else:
        _print(found, measured, [one.trace.name for one in native])
    if plot is not None:
        from rsltrace.cli.output.analysis_text import picture_of

        save_picture(picture_of(found), plot)
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
    from rsltrace.cli.output.analysis_text import text

    say("\n".join(map(printable, text(found, times, native))))
    tell_notes(found.notes)
