"""``rsltrace fit``: fit the delays and execution times of a job to a native run."""

from __future__ import annotations

import json
import math
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from rsltrace.checks.latency.instances import Durations
from rsltrace.cli.output.text_file import check_picture, save_picture, write_text
from rsltrace.errors import OutputError, RunError, TraceError
from rsltrace.native.fit.comparison import (
    NEAR,
    ChainCheck,
    LatencyCheck,
    SampleComparison,
    chains_of,
    check_latencies,
    mismatched_percentiles,
    need_scipy,
)
from rsltrace.native.fit.fitted_job import Fit, fitted_job, notes, picture_of, time_text, with_files
from rsltrace.native.fit.fitted_job import fit as fitted_to
from rsltrace.native.fit.models import DurationModel, as_job_has_it
from rsltrace.terminal import say, tell, tell_notes
from rsltrace.trace.model.texts import format_duration, printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.phrases import table

if TYPE_CHECKING:
    from rsltrace.job import Job
    from rsltrace.native.fit.comparison import Chains


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.argument("job_file", metavar="[JOB]", type=click.Path(path_type=Path), required=False)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write JOB with the measured times to this file.",
)
@click.option("--force", is_flag=True, help="Replace existing output files.")
@click.option(
    "--as",
    "how",
    type=click.Choice(("tables", "distributions", "series")),
    default="tables",
    show_default=True,
    help="Write times as tables of quantiles, as distributions (uniform, normal, lognormal or "
    "gamma, where one fits), or as series: all measured times in order, in files.",
)
@click.option(
    "--plot",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Plot the measured and the fitted times (.png, .svg, .pdf).",
)
@click.option(
    "--check",
    "second",
    type=click.Path(path_type=Path),
    metavar="SECOND",
    help="Run the fitted job and compare the latencies of its chains with SECOND, another native "
    "run.",
)
@click.option(
    "--simulated",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="With --check: keep the trace of the simulated run.",
)
@click.option("--json", "as_values", is_flag=True, help="Print one JSON object.")
def fit(
    trace: Path,
    job_file: Path | None,
    output: Path | None,
    force: bool,
    how: str,
    plot: Path | None,
    second: Path | None,
    simulated: Path | None,
    as_values: bool,
) -> None:
    """Fit the delay: and execution: of JOB to the times of TRACE, a native run
    (rsltrace record --native).

    A simulation of the fitted job reproduces the measured timing. JOB is the job that was run. If
    you leave it out, the file of that name beside TRACE or in the working directory is used.

    A delay is the time from publishing to reception. An execution time is the time for which a
    callback occupies its executor: the callback itself, and the time that rclpy needs to start it
    when its input has arrived and the executor is free.

    With --check, compare the end-to-end latencies of the simulated run and of a second native run:
    quantiles, their ratio with a 95 % confidence interval, and a two-sample test. The same
    comparison of the two native runs shows how much the robot itself varies.
    """
    from rsltrace.native.fit.measurement import measure_times

    if simulated is not None and second is None:
        raise click.UsageError("--simulated needs --check")
    if second is not None and output is None:
        raise click.UsageError("--check runs the fitted job: name its file with -o fitted.yaml")
    for path in (output, plot, simulated):
        if path is not None and path.exists() and not force:
            raise OutputError(f"{path} exists; use --force to replace it")
    if plot is not None:
        check_picture(plot)
    with ExitStack() as stack:
        first = stack.enter_context(Trace.open(trace))
        wanted = None if second is None else _chains(stack.enter_context(Trace.open(second)))
        found = fitted_to(measure_times(first), how)
        path = _job_file(first, job_file)
        job = _load(path)
        settings, more = _settings(first, path)
        said = [*notes(found, job), *more]
        if output is not None:
            _write(output, found, job, path, first, settings)
        if plot is not None:
            save_picture(picture_of(found, first.name), plot)
        checked = None
        if wanted is not None:
            assert output is not None
            with _simulated(output, simulated, force=force) as made:
                checked = check_latencies(first, wanted, made)
        if as_values:
            say(json.dumps(_as_json(found, said, checked), indent=2))
            return
        say("\n".join(map(printable, _as_text(found))))
        tell_notes(said)
        for written in (output, plot, simulated):
            if written is not None:
                tell(f"wrote {written}")
        if checked is not None:
            say("\n".join(map(printable, ("", *_checked_text(checked)))))
        elif output is not None:
            tell(f"next: rsltrace record {shlex.quote(str(output))}")


def _job_file(trace: Trace, given: Path | None) -> Path:
    """Return the file of the job that was run.

    :raises TraceError: if it is not here.
    """
    if given is not None:
        return given
    name = Path(trace.job.get("name", "")).name
    for folder in (Path(trace.name).parent, Path()):
        if name and name[0] != "<" and (folder / name).is_file():
            return folder / name
    raise TraceError(
        f"the job of {trace.name} ({name or 'without a file'}) is neither beside it nor in the "
        f"working directory; name it: rsltrace fit {shlex.quote(trace.name)} job.yaml"
    )


def _load(path: Path) -> Job:
    from rsltrace.job import load_job

    return load_job(path)


def _settings(trace: Trace, job_file: Path) -> tuple[dict[str, Any], list[str]]:
    """Return the command-line settings of the recorded run as keys of a job, and notes on them.

    Settings that might run code are left out: a trace may come from anybody."""
    from rsltrace.diff.causes.record_command import is_harmless, options_of
    from rsltrace.job import load_job
    from rsltrace.job.reading.override import as_overlay

    options = list(options_of(trace))
    harmless = [option for option in options if is_harmless(option[1])]
    settings, left = as_overlay(harmless)
    left += [" ".join(option) for option in options if option not in harmless]
    if left:
        left = [
            f"the run was recorded with {', '.join(left)}, which the fitted job lacks: add this "
            "when you record it"
        ]
    elif load_job(job_file, overrides=harmless).source_text != trace.job_text:
        left = [f"{job_file} is not the job of the run, or has changed since"]
    return settings, left


def _write(
    output: Path,
    found: Fit,
    job: Job,
    job_file: Path,
    first: Trace,
    settings: Mapping[str, Any],
) -> None:
    """Write the fitted job, and check that it loads."""
    if output.exists() and job_file.exists() and output.samefile(job_file):
        raise OutputError(f"{output} is the job that the fitted one extends: name another file")
    base = os.path.relpath(job_file.absolute(), output.absolute().parent).replace(os.sep, "/")
    head = (
        f"The job {job_file.name} with the times of {Path(first.name).name}, a native run of "
        f"{first.event_count} events:\n"
        "delay: from publishing to reception; execution: how long executors were busy with a "
        "callback.\nMeasured by rsltrace fit."
    )
    found, files = with_files(found, f"{output.stem}.series")
    if files:
        try:
            (output.parent / f"{output.stem}.series").mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"{error.filename} cannot be created: {error.strerror}") from error
    for name, written in files.items():
        write_text(output.parent / name, written)
    before = output.read_bytes() if output.is_file() else None
    write_text(output, fitted_job(found, job, base, head, settings))
    try:
        _load(output)
    except BaseException:
        if before is None:
            output.unlink(missing_ok=True)
        else:
            output.write_bytes(before)
        raise


@contextmanager
def _simulated(job_file: Path, kept: Path | None, *, force: bool) -> Iterator[Trace]:
    """Record a job in a child process; delete the trace afterwards unless it is ``kept``.

    :raises RunError: the run fails.
    """
    with tempfile.TemporaryDirectory(prefix="rsltrace-fit-") as folder:
        path = kept or Path(folder, "simulated.mcap")
        command = [sys.executable, "-m", "rsltrace", "record", str(job_file), "-o", str(path)]
        done = subprocess.run([*command, *["--force"] * force], capture_output=True)
        said = done.stderr.decode("utf-8", "replace")
        if done.returncode:
            raise RunError(
                f"the simulation of {job_file} ended with exit status {done.returncode}\n{said}"
            )
        tell("".join(line for line in said.splitlines(keepends=True) if "note:" in line), end="")
        with Trace.open(path) as trace:
            yield trace


def _chains(second: Trace) -> Chains:
    """Return the chains to check against.

    :raises SetupError: if what compares them is missing.
    :raises TraceError: if there are none.
    """
    need_scipy()
    return chains_of(second)


# The times, and their comparison with a simulation, as text and JSON.


_PERCENT = (50, 95, 99)
_HEAD = ("count", "p50", "p95", "p99", "max")
_NUMBERS = frozenset(range(1, 6))


def _as_text(fit: Fit) -> list[str]:
    """Return links and callbacks with their durations as lines."""
    links: list[tuple[str, ...]] = [("delays", *_HEAD, "waits p50", "fitted as", "D")]
    links += [
        (f"  {link}", *_row(link.delays), _row(link.waits)[1], *_written(model))
        for link, model in fit.links
    ]
    executions: list[tuple[str, ...]] = [("execution", *_HEAD, "callback p50", "fitted as", "D")]
    executions += [
        (f"  {one.node}: {one.kind} {one.entity}", *_row(one.busy), _row(one.runs)[1], *_written(m))
        for one, m in fit.executions
    ]
    right = _NUMBERS | {6}
    return [
        *(table(links, right=right) if fit.links else ["no message was received"]),
        "",
        *table(executions, right=right),
    ]


def _row(durations: Durations) -> tuple[str, ...]:
    if not len(durations):
        return ("0", *("-" for _ in _HEAD[1:]))
    quantiles = [*np.percentile(durations, _PERCENT), durations.max()]
    return str(len(durations)), *(format_duration(one, 4) for one in quantiles)


def _written(model: DurationModel) -> tuple[str, str]:
    said = model.kind
    if model.kind == "empirical":
        said = f"table of {len(model.values['values'])}"
    if model.points:
        said = f"series of {len(model.points)}"
    if model.passed_over:
        said += f" (nearest: {model.passed_over})"
    return said, f"{model.distance:.3f}"


def _checked_text(checked: LatencyCheck) -> list[str]:
    """Return the comparison of a simulation with a second native run as lines."""
    lines: list[str] = []
    for chain in checked.chains:
        lines += [*([""] if lines else []), chain.name]
        lines += _chain(chain)
    return lines


def _chain(chain: ChainCheck) -> list[str]:
    if chain.simulated is None:
        return ["  the simulated run does not have this chain"]
    of = chain.simulated
    rows: list[tuple[str, ...]] = [
        ("  latency", "second run", "simulated", "ratio", "95 % interval", "first run", "interval")
    ]
    natives = chain.native.quantiles if chain.native is not None else (None,) * len(of.quantiles)
    for one, native in zip(of.quantiles, natives, strict=True):
        beside = ("-", "-")
        if native is not None:
            beside = (_ratio(native.ratio), _interval(native.low, native.high))
        rows.append(
            (
                f"  p{one.percent:g}",
                format_duration(one.a_ns, 4),
                format_duration(one.b_ns, 4),
                _ratio(one.ratio),
                _interval(one.low, one.high),
                *beside,
            )
        )
    lines = table(rows, right=frozenset(range(1, 7)))
    lines.append(f"  simulated and second run: {_tested(of)}")
    if chain.native is not None:
        lines.append(f"  first and second run: {_tested(chain.native)}")
    if chain.own is not None:
        ratios = ", ".join(f"p{q.percent:g} {_ratio(q.ratio)}" for q in chain.own.quantiles)
        lines.append(f"  simulated and first run: {_tested(chain.own)}; ratios {ratios}")
    lines.append(f"  {_verdict(of, chain.native)}")
    return lines


def _verdict(simulated: SampleComparison, native: SampleComparison | None) -> str:
    within = f"within {NEAR * 100:g} % of the second run"
    if not mismatched_percentiles(simulated):
        return f"the simulated run is {within}"
    said = f"the simulated run is not {within}: {_named(mismatched_percentiles(simulated))}"
    if native is not None and mismatched_percentiles(native):
        said += f"; nor is the first run: {_named(mismatched_percentiles(native))}"
    return said


def _named(percent: list[float]) -> str:
    return ", ".join(f"p{one:g}" for one in percent)


def _ratio(ratio: float) -> str:
    return "-" if math.isnan(ratio) else f"{ratio:.3f}"


def _interval(low: float, high: float) -> str:
    return "-" if math.isnan(low) else f"{low:.3f} … {high:.3f}"


def _tested(of: SampleComparison) -> str:
    p_value = "p < 0.0001" if of.p_value < 1e-4 else f"p {of.p_value:.2g}"
    return (
        f"D {of.distance:.3f} ({p_value}; {of.count_b} and {of.count_a} latencies), "
        f"mean difference {format_duration(of.moved_ns, 4)}"
    )


def _as_json(fit: Fit, notes: list[str], checked: LatencyCheck | None) -> dict[str, Any]:
    """Return what was measured as JSON-compatible values; times in ns."""
    values: dict[str, Any] = {
        "delays": [
            {
                "topic": link.topic,
                "from": link.sender,
                "to": link.receiver or None,
                "service": link.is_service,
                "delay": _figures(link.delays),
                "wait": _figures(link.waits),
                "negative": link.negative,
                "missing": link.missing,
                "model": _model(model),
            }
            for link, model in fit.links
        ],
        "execution": [
            {
                "node": one.node,
                "entity": one.entity,
                "kind": one.kind,
                "busy": _figures(one.busy),
                "callback": _figures(one.runs),
                "correlation": one.tied,
                "model": _model(model),
            }
            for one, model in fit.executions
        ],
        "executors": [asdict(one) for one in fit.measured.executors],
        "notes": notes,
    }
    if checked is not None:
        values["check"] = [_checked(chain) for chain in checked.chains]
    return values


def _figures(durations: Durations) -> dict[str, int] | None:
    if not len(durations):
        return None
    quantiles = np.percentile(durations, _PERCENT).astype(np.int64).tolist()
    return {
        "count": len(durations),
        **{f"p{p}_ns": value for p, value in zip(_PERCENT, quantiles, strict=True)},
        "max_ns": int(durations.max()),
    }


def _model(model: DurationModel) -> dict[str, Any]:
    return {"distance": model.distance, "said": as_job_has_it(model, time_text)}


def _checked(chain: ChainCheck) -> dict[str, Any]:
    def plain(of: SampleComparison | None) -> dict[str, Any] | None:
        if of is None:
            return None
        values = asdict(of)
        for quantile in values["quantiles"]:
            for key in ("ratio", "low", "high"):
                quantile[key] = None if math.isnan(quantile[key]) else quantile[key]
        return values

    return {
        "chain": chain.name,
        "simulated": plain(chain.simulated),
        "first_run": plain(chain.native),
        "simulated_to_first": plain(chain.own),
        "far": []
        if chain.simulated is None
        else [f"p{one:g}" for one in mismatched_percentiles(chain.simulated)],
    }
