"""``rsltrace verify``: test whether a job is deterministic."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rsltrace.cli.job_source import JobArguments, RosArgsCommand, job_options
from rsltrace.cli.options import (
    history_option,
    json_option,
    seed_option,
    timeout_option,
    until_option,
)
from rsltrace.errors import EXIT_USAGE, RsltraceError
from rsltrace.search.perturb import KINDS, Perturbation, PerturbedRun
from rsltrace.terminal import say, tell

if TYPE_CHECKING:
    from rsltrace.search.history.run_record import RunRecord
    from rsltrace.search.verify import VerifyResult


@click.command(cls=RosArgsCommand)
@job_options
@click.option(
    "--runs",
    type=click.IntRange(min=2),
    default=10,
    show_default=True,
    metavar="N",
    help="Run the job N times. The first run is not perturbed.",
)
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    metavar="W",
    help="Run W runs in parallel.",
)
@seed_option
@until_option
@click.option("--no-pin", is_flag=True, help="Do not pin the process, to show what pinning hides.")
@click.option(
    "--perturbations",
    type=click.IntRange(min=0),
    default=0,
    metavar="SEED",
    help="Choose other perturbations with this seed.",
)
@timeout_option
@click.option(
    "--keep",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Keep the traces of all runs in this folder, with a page (report.html).",
)
@click.option(
    "--run", "number", type=click.IntRange(min=0), help="Repeat only the run of this number."
)
@click.option(
    "--only", type=click.Choice(KINDS), help="With --run: apply only this one of its perturbations."
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    help="With --run: write the trace to this file (default: run-N.mcap).",
)
@history_option
@json_option
def verify(
    given: JobArguments,
    runs: int,
    jobs: int,
    seed: int | None,
    until: str | None,
    no_pin: bool,
    perturbations: int,
    timeout: float | None,
    keep: Path | None,
    number: int | None,
    only: str | None,
    output: Path | None,
    history: str | None,
    as_json: bool,
) -> int:
    """Run JOB several times under perturbed environments and compare the digests.

    Each run after the first has a different hash seed, working directory, locale, time zone, heap,
    address space, CPU load, thread counts and BLAS core type, as far as this machine permits. When
    a run differs, the two runs are compared as "rsltrace diff" does, commands to repeat both are
    printed, and each perturbation is tried alone.

    Exit status: 0 if all runs are the same, 1 if not, 2 for an error: the job is wrong, or a run
    fails, crashes or times out.
    """
    if (only or output) and number is None:
        raise click.UsageError("--only and --output need --run N")
    given = replace(given, seed=seed, until=until, no_pin=no_pin)
    history = history if number is None else None
    with (
        given.recorded(history, "verify") as record,
        tempfile.TemporaryDirectory(prefix="rsltrace-verify-") as name,
        handling_signals(),
    ):
        given.job()  # report a broken job once, before the runs
        folder = Path(name)
        if number is not None:
            return _one_run(given, folder, number, perturbations, only, output)
        return _verify(
            given, folder, record, runs, jobs, perturbations, timeout, keep, as_json=as_json
        )


def _verify(
    given: JobArguments,
    folder: Path,
    record: RunRecord,
    runs: int,
    jobs: int,
    perturbations: int,
    timeout_s: float | None,
    keep: Path | None,
    *,
    as_json: bool,
) -> int:
    from rsltrace.search.verify import DeterminismTest

    def on_run(recorded: PerturbedRun) -> None:
        if sys.stderr.isatty():
            around = recorded.perturbation
            tell(f"run {around.number}: digest {recorded.digest or '-'}")

    series = DeterminismTest(
        given.arguments(os.path.abspath),
        folder,
        workers=jobs,
        seed=perturbations,
        timeout_s=timeout_s,
        keep=keep is not None,
    )
    result = series.verify(runs, on_run)
    place = folder
    if keep is not None:
        place = keep
        keep.mkdir(parents=True, exist_ok=True)
        for trace in sorted(folder.glob("*.mcap")):
            shutil.move(trace, keep / trace.name)
    from rsltrace.cli.output.text_file import write_text
    from rsltrace.cli.output.verify_text import as_page, as_text, as_values
    from rsltrace.search.explore.table import PAGE

    again = [_again(given, perturbations, one.perturbation) for one in _two(result)]
    if as_json:
        say(as_values(result, place, again, kept=keep is not None))
    else:
        (tell if result.trouble else say)(as_text(result, place, again, kept=keep is not None))
    if keep is not None:
        (keep / PAGE).unlink(missing_ok=True)  # of an earlier time
    record.digest, record.runs = result.first.digest, result.runs
    if result.trouble is not None:
        record.verdict, record.reason = "error", result.trouble.failure
        return EXIT_USAGE
    if result.other is not None:
        from rsltrace.diff import diff_files

        record.fails(diff_files(*(place / one.path.name for one in _two(result))).sentence)
    if keep is not None:
        write_text(keep / PAGE, as_page(result, keep, again))
    return 0 if result.agrees else 1


def _two(result: VerifyResult) -> list[PerturbedRun]:
    second = result.trouble or result.other
    if result.hidden is not None:
        second = result.hidden.run
    return [result.first] if second is None or second is result.first else [result.first, second]


def _again(given: JobArguments, perturbations: int, around: Perturbation) -> str:
    """Return the command that repeats one run."""
    words = ["rsltrace", "verify", *given.arguments()]
    if perturbations:
        words += ["--perturbations", str(perturbations)]
    return shlex.join([*words, "--run", str(around.number)])


def _one_run(
    given: JobArguments,
    folder: Path,
    number: int,
    perturbations: int,
    only: str | None,
    output: Path | None,
) -> int:
    from rsltrace.search.perturb import perturbation, record_perturbed

    around = perturbation(number, perturbations)
    if only is not None:
        if only not in around.values:
            raise click.UsageError(f"run {number} does not perturb the {only}")
        around = around.only(only)
    path = (output or Path(f"run-{number}.mcap")).absolute()
    tell(f"run {number}: {around}")
    done = record_perturbed(around, given.arguments(os.path.abspath), folder, path=path)
    tell(done.errors, end="")
    if not done.digest:
        raise RsltraceError(f"run {number}: {done.failure}")
    say(f"digest {done.digest}  events {done.events}")
    return done.exit_code


@contextmanager
def handling_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the command as Ctrl-C does: with its child processes."""

    def end(number: int, frame: object) -> None:
        raise KeyboardInterrupt(128 + number)

    caught = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, end) for number in caught]
    try:
        yield
    finally:
        for number, handler in zip(caught, before, strict=True):
            signal.signal(number, handler)
