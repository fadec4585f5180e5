"""``rsltrace verify``: test whether a job is deterministic."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from rsltrace.search.perturb import CORE_TYPE, KERNEL, KINDS, Perturbation, PerturbedRun
from rsltrace.terminal import say, tell

if TYPE_CHECKING:
    from rsltrace.search.history.run_record import RunRecord
    from rsltrace.search.verify import HiddenDifference, VerifyResult


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
    from rsltrace.search.explore.table import PAGE

    again = [_again(given, perturbations, one.perturbation) for one in _two(result)]
    if as_json:
        say(_as_json(result, place, again, kept=keep is not None))
    else:
        (tell if result.trouble else say)(_as_text(result, place, again, kept=keep is not None))
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
        write_text(keep / PAGE, _as_page(result, keep, again))
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


# The report.


_LINES_MAX = 40
_UNKNOWN_SOURCE = (
    "The guard has no finding that explains it: a source of nondeterminism that it does not know.\n"
    "Please report it, with the callback named above."
)
_WAY_OUT = (
    "  OpenBLAS rounds differently on each core type. Compare such values with a tolerance, or set "
    f"a\n  core type that all your machines support: {CORE_TYPE}=Haswell rsltrace …"
)


def _as_text(result: VerifyResult, folder: Path, again: Sequence[str], *, kept: bool) -> str:
    """Return the report; ``again`` are the commands that repeat the runs in question."""
    if result.trouble is not None:
        return _trouble(result, result.trouble, again[-1])
    perturbed = f"perturbed: {', '.join(result.kinds) or 'nothing'}"
    first, other = result.first, result.other
    if other is None:
        lines = [_answer(result), perturbed]
        if result.hidden is not None:
            lines += ["", *_hidden(result, result.hidden, again[-1], folder)]
        return "\n".join([*lines, f"the traces are in {folder}"] if kept else lines)
    lines = [_answer(result), perturbed, ""]
    for recorded, command in zip((first, other), again, strict=True):
        ended = f", exit status {recorded.exit_code}" if recorded.exit_code else ""
        around = recorded.perturbation
        lines.append(f"run {around.number}: digest {recorded.digest}{ended}: {around}")
        lines.append(f"  {command}")
    lines += ["", _provoked(result, again[-1])]
    if other.failure:
        lines += [f"run {other.perturbation.number} failed: {other.failure}"]
    report = _compared(result, first, other, folder)
    if not kept:  # what to do next with traces that are gone
        report = [line for line in report if not line.startswith("next: ")]
    lines += ["", *report]
    lines += ["", f"the traces are in {folder}"] if kept else []
    return "\n".join(lines)


def _as_page(result: VerifyResult, folder: Path, again: Sequence[str]) -> str:
    """Return the report as a page; the traces are in ``folder``. Raises TraceError."""
    from rsltrace_viewer.pages.search_page import search_page

    differ = [result.first] if result.other is None else [result.first, result.other]
    rows = [("perturbed", ", ".join(result.kinds) or "nothing")]
    rows += [
        (f"run {one.perturbation.number}", f"{one.digest}: {one.perturbation}") for one in differ
    ]
    commands = list(again)
    if result.other is not None or result.hidden is not None:
        cause, *command = _provoked(result, again[-1]).splitlines()[:2]
        name, _, text = cause.partition(": ")
        rows.append((name, text))
        commands += map(str.strip, command)
    traces = [_place(one, folder) for one in differ][: 2 * (len(differ) > 1)]
    return search_page(_answer(result), rows, commands, traces)


def _as_json(result: VerifyResult, folder: Path, again: Sequence[str], *, kept: bool) -> str:
    second = result.trouble or result.other
    difference = None
    if result.trouble is None and result.other is not None:
        from rsltrace.diff import diff_files
        from rsltrace.diff.report import render

        places = (_place(result.first, folder), _place(result.other, folder))
        difference = json.loads(render(diff_files(*map(str, places)), "json"))
    return json.dumps(
        {
            "agrees": result.agrees,
            "runs": result.runs,
            "perturbations": list(result.kinds),
            "digests": list(result.digests),
            "trouble": None if result.trouble is None else result.trouble.failure,
            "other": None if second is None else _run(second),
            "reproduce": list(again),
            "by_itself": result.by_itself,
            "provoked_by": list(result.provoked_by) if result.narrowed else None,
            "hidden": _hidden_values(result.hidden),
            "kept": str(folder) if kept else None,
            "diff": difference,
        }
    )


def _hidden(result: VerifyResult, found: HiddenDifference, command: str, folder: Path) -> list[str]:
    """Return what to say of runs of equal events in which a node did not keep the same."""
    lines = [
        f"The events agree, but the state of {found.node} differs: its attribute "
        f"{found.attribute}, after event {found.event} of run {found.run.perturbation.number}.",
        _provoked(result, command),
    ]
    if found.traces is None:
        return lines
    report = _compared(result, *found.traces, folder)
    return [*lines, "", *(line for line in report if not line.startswith("next: "))]


def _compared(
    result: VerifyResult, first: PerturbedRun, other: PerturbedRun, folder: Path
) -> list[str]:
    """Return the lines of a comparison, and whether the guard knows what made the runs differ."""
    from rsltrace.diff import diff_files
    from rsltrace.diff.report import render
    from rsltrace.trace.reader import Trace

    diff = diff_files(str(_place(first, folder)), str(_place(other, folder)))
    lines = render(diff).rstrip().splitlines()
    has_cause = any(one.likely is not None or one.calls for one in diff.divergences)
    is_pinned = all(setting.name == "numerics" for setting in diff.settings)
    if has_cause or not is_pinned or KERNEL in result.provoked_by or not result.narrowed:
        return lines
    for recorded in (first, other):
        with Trace.open(_place(recorded, folder)) as trace:
            if trace.findings or _lets_pass(json.loads(trace.job.get("resolved", "{}"))):
                return lines
    return [*lines, "", _UNKNOWN_SOURCE]


def _lets_pass(job: dict[str, Any]) -> bool:
    """Return whether a job has the guard let something pass without a finding."""
    guards = [job.get("guard") or {}, *(node.get("guard") or {} for node in job.get("nodes", ()))]
    return any(
        guard.get("enabled") is False
        or guard.get("pin") is False
        or any(isinstance(one, dict) and _is_allowed(one) for one in guard.values())
        for guard in guards
    )


def _is_allowed(source: dict[str, Any]) -> bool:
    return source.get("mode") == "allow" or bool(source.get("allow"))


def _run(recorded: PerturbedRun) -> dict[str, object]:
    return {
        "number": recorded.perturbation.number,
        "surroundings": dict(recorded.perturbation.values),
        "digest": recorded.digest,
        "exit_code": recorded.exit_code,
        "errors": recorded.errors,
    }


def _hidden_values(found: HiddenDifference | None) -> dict[str, object] | None:
    if found is None:
        return None
    return {
        "node": found.node,
        "attribute": found.attribute,
        "event": found.event,
        "run": found.run.perturbation.number,
    }


def _place(recorded: PerturbedRun, folder: Path) -> Path:
    return folder / recorded.path.name


def _answer(result: VerifyResult) -> str:
    many = "s" * (len(result.kinds) != 1)
    tried = f"{result.runs} runs, {len(result.kinds)} perturbation{many}"
    if result.other is not None:
        return f"not deterministic: {tried}, {len(result.digests)} digests"
    first = result.first
    ended = f" (each ended with exit status {first.exit_code})" if first.exit_code else ""
    return f"{tried}, one digest {first.digest}{ended}"


def _provoked(result: VerifyResult, command: str) -> str:
    if result.by_itself:
        return "cause: not a perturbation, since a second unperturbed run differs, too"
    if not result.narrowed:
        return "cause: unknown; the runs are too long to try each perturbation alone, use --only"
    if not result.provoked_by:
        return "cause: several perturbations together, or chance: none alone makes a run differ"
    each = " (each alone)" if len(result.provoked_by) > 1 else " alone"
    lines = [
        f"caused by: {', '.join(result.provoked_by)}{each}",
        f"  {command} --only '{result.provoked_by[0]}'",
    ]
    return "\n".join(lines + [_WAY_OUT] * (KERNEL in result.provoked_by))


def _trouble(result: VerifyResult, run: PerturbedRun, command: str) -> str:
    number = run.perturbation.number
    what = "the first run" if number == 0 else f"run {number} of {result.runs}"
    lines = [f"rsltrace: error: {what} cannot be compared: {run.failure}"]
    said = run.errors.strip().splitlines()[-_LINES_MAX:]
    lines += [f"  | {line}" for line in said]
    lines.append(f"with {run.perturbation}; to repeat it:\n  {command}")
    return "\n".join(lines)
