"""``rsltrace record``: run a job and write its trace."""

from __future__ import annotations

import faulthandler
import json
import os
import shlex
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.job_source import JobArguments, RosArgsCommand, job_options
from rsltrace.cli.options import json_option, no_pin_option, seed_option, until_option
from rsltrace.cli.output.exit_status import (
    reopen_standard_streams,
    status_without_output,
    tell_error,
)
from rsltrace.cli.output.search_progress import interruptible, progress
from rsltrace.errors import EXIT_USAGE, RsltraceError
from rsltrace.guard.pin import has_fixed_addresses, unpin
from rsltrace.terminal import say, tell
from rsltrace.trace.model.finding import READ_BY, NondeterminismSource
from rsltrace.trace.model.texts import format_duration, format_seconds, printable
from rsltrace.trace.words.logs import missing_servers, silent_topics, unheard_topics

if TYPE_CHECKING:
    from rsltrace.cli.output.checks import CheckReport
    from rsltrace.job import Job
    from rsltrace.native.native_run import NativeOptions, NativeResult
    from rsltrace.run import RunResult
    from rsltrace.simulation.loop.stop import Stop


@click.command(cls=RosArgsCommand)
@job_options
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Write the trace to this file (default: the name of the job file or its folder, with "
    ".mcap).",
)
@click.option(
    "--export-bag",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Also write the messages to a rosbag2 bag.",
)
@click.option(
    "--force",
    is_flag=True,
    help="Replace an existing trace and bag once the new ones are complete. A trace that this run "
    "reads is never replaced.",
)
@seed_option
@until_option
@click.option(
    "--replay",
    type=click.Path(path_type=Path),
    metavar="TRACE",
    help="Give the nodes the external inputs that TRACE recorded (guard: mode record).",
)
@json_option
@click.option("--print-job", is_flag=True, help="Print the job as YAML and do not run it.")
@no_pin_option
@click.option(
    "--native",
    is_flag=True,
    help="Run the nodes on rclpy's own executors over DDS in real time, and only observe them.",
)
@click.option(
    "--executor",
    type=click.Choice(("single", "multi")),
    help="With --native: use single-threaded (default) or multi-threaded executors.",
)
@click.option(
    "--processes",
    is_flag=True,
    help="With --native: run each node in a process of its own (default: only if one is an "
    "executable).",
)
@click.option(
    "--domain",
    type=click.IntRange(0, 232),
    metavar="ID",
    help="With --native: join this DDS domain (default: an unused one).",
)
@click.option(
    "--policy",
    type=click.Choice(("rate_monotonic", "priority")),
    help="With --native: run the most urgent callback first, by rate or by the priorities of the "
    "job's policy. Threads get real-time priorities where permitted.",
)
@click.option(
    "--last",
    metavar="T",
    help="With --native: keep only the last T seconds, in memory, and write them to a file at the "
    "end, after a crash, and at SIGUSR1 (record: last: in a job).",
)
@click.option(
    "-q", "--quiet", is_flag=True, help="Show no progress and no log records of the nodes."
)
@click.option("--sample-states", is_flag=True, hidden=True)  # as the runs of ``verify`` do
def record(
    given: JobArguments,
    output: Path | None,
    export_bag: Path | None,
    force: bool,
    seed: int | None,
    until: str | None,
    replay: Path | None,
    as_json: bool,
    print_job: bool,
    no_pin: bool,
    native: bool,
    executor: str | None,
    processes: bool,
    domain: int | None,
    policy: str | None,
    last: str | None,
    quiet: bool,
    sample_states: bool,
) -> None:
    """Run JOB (a job.yaml) or the nodes of a launch file deterministically and record a trace.

    \b
      rsltrace record job.yaml -o run.mcap --ros-args -p ekf:rate:=20
      rsltrace record --launch robot.launch.xml world:=lab --until 60

    With --native, the nodes run as they do without rsltrace, in real time, and are only observed.
    The trace has the same format but no digest (see docs/native.md).

    Log records of the nodes go to stderr. The last line on stdout is
    "digest <16 hex>  events <n>  sim <seconds>". Runs with the same digest are identical.

    Exit status: that of the job's stop condition (default 0); 1 if a check of the job fails; 3 if a
    node raised an exception; 130, 143 or 129 if interrupted (Ctrl-C, SIGTERM, SIGHUP).
    """
    from rsltrace.run.process import skip_final_collection

    if click.get_current_context().obj is not None:  # a process that is there for this alone
        skip_final_collection()
    _check_options(native, executor, domain, policy, replay, seed, last, processes=processes)
    loaded, named = given.overridden(seed, until, last).job()
    if no_pin:
        guard = loaded.guard.with_values(pin=False)
        loaded = loaded.with_values(guard=guard)
    if native or not loaded.guard.pins:
        unpin()
    if print_job:
        _print_job(loaded)
        return
    if given.program and not (quiet or as_json):
        tell(f"the job (--print-job before '--' prints it alone):\n{loaded.to_yaml()}", end="")
        if not (loaded.stop.given_fields or loaded.bags or any(n.main for n in loaded.nodes)):
            tell("it lasts as long as its programs: --until 10 ends it after 10 s, Ctrl-C at once")
    path = output or default_output(named)
    _check_first(loaded, export_bag, force=force)
    if native:
        from rsltrace.native.native_run import NativeOptions

        options = NativeOptions(executor or "single", processes, domain, policy)
        _record_native(loaded, path, export_bag, options, force=force, quiet=quiet, as_json=as_json)
        return
    shown_notes: list[str] = []
    result = _recorded(
        loaded,
        path,
        shown_notes,
        force=force,
        echo=not quiet,
        shows=not (quiet or as_json),
        replay=replay,
        samples_states=sample_states,
    )
    status = result.exit_code
    reopen_standard_streams()
    try:
        checked, checks_status = _checked(loaded, result.path)
        status = status or checks_status
        silent = _silent_topics(result, plays_bags=bool(given.bags))
        _report(result, silent, shown_notes, checked, as_json=as_json)
        if export_bag is not None:
            _export(result.path or path, export_bag, force=force)
    except OSError as error:
        status = status_without_output(error, status)
    sys.exit(status)


def _check_options(
    native: bool,
    executor: str | None,
    domain: int | None,
    policy: str | None,
    replay: Path | None,
    seed: int | None,
    last: str | None,
    *,
    processes: bool,
) -> None:
    """Raise a usage error for options that make no sense together."""
    if native and (replay is not None or seed is not None):
        raise click.UsageError("--replay and --seed have no effect on a native run: leave them out")
    if not native and (executor is not None or domain is not None or processes):
        raise click.UsageError("--executor, --processes and --domain need --native")
    if not native and last is not None:
        raise click.UsageError("--last needs --native")
    if not native and policy is not None:
        raise click.UsageError(
            "--policy needs --native; for a simulation use --set policy=rate_monotonic"
        )
    if policy is not None and executor == "multi":
        raise click.UsageError("--policy needs single-threaded executors: leave --executor out")


def _check_first(job: Job, bag: Path | None, *, force: bool) -> None:
    """Report before the run what would fail after it: an existing bag, a wrong check."""
    if bag is not None:
        from rsltrace.trace.recordings.export import check_bag_folder

        check_bag_folder(bag, force=force)
    if job.checks or job.metrics:
        from rsltrace.checks.evaluate import check_texts
        from rsltrace.checks.metrics import check_metrics

        check_texts(job)
        check_metrics(job)


def _recorded(
    job: Job,
    path: Path,
    shown_notes: list[str],
    *,
    force: bool,
    echo: bool,
    shows: bool,
    replay: Path | None,
    samples_states: bool,
) -> RunResult:
    """Run a job; notes are shown, and added to ``shown_notes``. ``shows``: progress, too."""
    from rsltrace.run import RunCallbacks, run

    def note(text: str) -> None:
        shown_notes.append(text)
        _note(text)

    if sys.__stderr__ is not None and not faulthandler.is_enabled():
        with suppress(OSError, ValueError):  # a stderr that is no file
            faulthandler.enable(sys.__stderr__)
    with interruptible() as on_interrupt, progress(quiet=not shows) as on_progress:

        def begins(stop: Callable[[Stop], None]) -> None:
            _say_if_it_has_no_end(job)
            on_interrupt(stop)

        return run(
            job,
            path,
            force=force,
            echo=echo,
            observer=RunCallbacks(on_progress, begins, note, samples_states=samples_states),
            replay=replay,
        )


def _record_native(
    job: Job,
    path: Path,
    bag: Path | None,
    options: NativeOptions,
    *,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Run a job natively, and end the process."""
    result = _run_native(
        job, path, options, force=force, echo=not quiet, shows=not (quiet or as_json)
    )
    status = result.exit_code
    reopen_standard_streams()
    try:
        checked, checks_status = _checked(job, result.path)
        status = status or checks_status or (1 if result.failed_checks else 0)
        for name, count in result.failed_checks.items():
            times = f"{count} time{'s' if count > 1 else ''}"
            tell(f"check violated {times} while the run went on: {name}")
        _report_native(result, checked, as_json=as_json)
        if bag is not None:
            _export(result.path, bag, force=force)
    except OSError as error:
        status = status_without_output(error, status)
    _leave(result, status)


def _export(trace: Path, bag: Path, *, force: bool) -> None:
    from rsltrace.trace.recordings.export import export_bag

    count = export_bag(trace, bag, force=force)
    tell(f"wrote {bag}: {count} messages")


def _say_if_it_has_no_end(job: Job) -> None:
    if job.stop.given_fields or job.bags:
        return
    if job.launch:
        _note("a launch file has no end: stop the run with --until T or Ctrl-C")
    elif any(spec.node is not None for spec in job.nodes):  # mains end by themselves
        _note("the job has no end: stop the run with 'stop:' in the job, --until T or Ctrl-C")


def _print_job(job: Job) -> None:
    from rsltrace.run.inputs import expand_launch_files

    expanded = expand_launch_files(job)
    for note in expanded.notes:
        _note(note)
    say(expanded.job.to_yaml(), end="")


def default_output(job: Path) -> Path:
    """Return the trace's name for a job file, here: ``demo/job.yaml`` or ``demo.launch.xml`` →
    ``demo.mcap``."""
    stem = job.name.split(".launch.")[0] if ".launch." in job.name else job.stem
    stem = job.resolve().parent.name if stem == "job" else stem
    return Path(f"{stem or 'run'}.mcap")


def _note(text: str) -> None:
    tell(f"rsltrace: note: {text}")


def _silent_topics(result: RunResult, *, plays_bags: bool) -> list[str]:
    """Return notes on topics without a publisher and services without a server."""
    if result.path is None or result.error is not None or not result.path.is_file():
        return []
    from rsltrace.trace.reader import Trace

    try:
        with Trace.open(result.path) as trace:
            entities = list(trace.entities.values())
            found = [silent_topics(entities), missing_servers(entities)]
            if plays_bags:  # a job says itself which topics of a bag it plays
                from rsltrace.run.plans.bags import PLAYER

                found.append(unheard_topics(entities, f"/{PLAYER}"))
    except RsltraceError:
        return []  # the trace is gone
    return [f"{text}; rsltrace check shows the graph" for text in found if text]


def _checked(job: Job, path: Path | None) -> tuple[CheckReport | None, int]:
    """Evaluate the job's checks on the trace; return the results and an exit status."""
    if not (job.checks or job.metrics) or path is None:
        return None, 0
    from rsltrace.cli.output.checks import CheckReport

    try:
        checked = CheckReport(job, path)
    except RsltraceError as error:  # the trace itself is complete
        tell(f"rsltrace: error: {error}")
        return None, EXIT_USAGE
    return checked, 1 if checked.violated else 0


def _report(
    result: RunResult,
    silent: list[str],
    shown_notes: list[str],
    checked: CheckReport | None,
    *,
    as_json: bool,
) -> None:
    error = result.error
    for note in (*result.notes, *silent):
        if note not in shown_notes:  # when the run began
            tell(f"note: {note}")
    if error is not None:
        tell_error(error)
    _warn(result)
    for line in [] if checked is None else checked.lines():
        tell(line)
    if as_json:
        say(
            json.dumps(
                {
                    "findings": sum(met.count for met in result.guarded if met.is_finding),
                    "path": str(result.path),
                    "digest": result.digest,
                    "events": result.events,
                    "start_ns": result.start_ns,
                    "end_ns": result.end_ns,
                    "stop_reason": result.stop_reason,
                    "exit_code": result.exit_code,
                    "error": None if error is None else str(error),
                    **({} if checked is None else checked.values()),
                    "notes": [*result.notes, *silent, *([result.kept] if result.kept else [])],
                }
            )
        )
        return
    kept = result.kept and f" ({result.kept})"
    has_next = checked is not None and checked.violated
    then = "" if has_next else f"; next: rsltrace view {shlex.quote(str(result.path))}"
    tell(f"wrote {result.path}{kept}: {result.stop_reason}{then}")
    say(f"digest {result.digest}  events {result.events}  sim {result.sim_seconds}")


def _warn(result: RunResult) -> None:
    """Print the calls that could make another run differ."""
    found = [met for met in result.guarded if met.is_finding]
    if not found:
        return
    from rsltrace.trace.words.code import places_text

    calls: Counter[tuple[str, str]] = Counter()
    places: dict[tuple[str, str], dict[str, None]] = {}
    lines = _finding_places(result.path)
    copied = {met.node for met in found if met.call == _ENVIRONMENT}
    for met in found:
        what, _, library = met.call.partition(READ_BY)
        if library:  # usually the library's configuration
            what = f"environment variables{READ_BY}{library}"
        elif met.node in copied and what.startswith(f"{_ENVIRONMENT}["):
            continue  # reads of the whole environment are reported once
        key = met.source.value, f"{what} in {met.node or 'the run'}"
        calls[key] += met.count
        places.setdefault(key, {}).update(dict.fromkeys(lines.get((met.node, met.call), ())))
    tell("guard: these calls can make runs differ (see docs/guard.md):")
    for (source, call), count in sorted(calls.items())[:_SHOWN_MAX]:
        at = printable(places_text(list(places[source, call]), ", "))
        times = f", {count} times" if count > 1 else ""
        tell(f"  {source}: {printable(call)}{at and f' at {at}'}{times}")
    if (
        any(met.source is NondeterminismSource.ADDRESS for met in found)
        and not has_fixed_addresses()
    ):
        tell("  memory addresses differ in every process on this machine")
    if len(calls) > _SHOWN_MAX:
        tell(f"  and {len(calls) - _SHOWN_MAX} more: rsltrace info {result.path}")


def _finding_places(path: Path | None) -> dict[tuple[str, str], list[str]]:
    if path is None or not path.is_file():
        return {}
    from rsltrace.trace.reader import Trace

    try:
        with Trace.open(path) as trace:
            return trace.finding_places
    except RsltraceError:
        return {}  # the trace is gone


_SHOWN_MAX = 8
_ENVIRONMENT = "os.environ"


# rsltrace record --native: run, report and exit.


def _run_native(
    job: Job,
    path: Path,
    options: NativeOptions,
    *,
    force: bool,
    echo: bool,
    shows: bool,
) -> NativeResult:
    """Run a job natively; ``shows``: with progress."""
    from rsltrace.adapters.rclpy.boundary.installation import native_extension

    native_extension()  # before the session's modules, which bind it
    from rsltrace.native.session import run_natively
    from rsltrace.run import RunCallbacks

    shown = progress(quiet=not shows, what="observing", time="of real time")
    with interruptible() as on_interrupt, shown as on_progress:

        def begins(stop: Callable[[Stop], None]) -> None:
            _say_if_it_has_no_end(job)
            on_interrupt(stop)

        observer = RunCallbacks(progress=on_progress, interrupt=begins, note=_note)
        return run_natively(job, path, options, force=force, echo=echo, observer=observer)


def _report_native(result: NativeResult, checked: CheckReport | None, *, as_json: bool) -> None:
    error = result.error
    for note in result.notes:
        tell(f"note: {note}")
    if error is not None:
        tell_error(error)
    for line in [] if checked is None else checked.lines():
        tell(line)
    if as_json:
        say(json.dumps(_native_values(result, checked)))
        return
    kept = result.kept and f" ({result.kept})"
    tell(f"wrote {result.path}{kept}: {result.stop_reason}")
    cost = f"observer {format_duration(result.observer_ns)} per callback"
    say(f"native  events {result.events}  real {format_seconds(result.duration_ns)}  {cost}")


def _native_values(result: NativeResult, checked: CheckReport | None) -> dict[str, Any]:
    return {
        "native": True,
        "path": str(result.path),
        "digest": None,
        "events": result.events,
        "duration_ns": result.duration_ns,
        "observer_ns": result.observer_ns,
        "pen_ns": result.pen_ns,
        "callback_ns": result.callback_ns,
        "stop_reason": result.stop_reason,
        "exit_code": result.exit_code,
        "error": None if result.error is None else str(result.error),
        "stuck": list(result.stuck),
        **({} if checked is None else checked.values()),
        "notes": [*result.notes, *([result.kept] if result.kept else [])],
    }


def _leave(result: NativeResult, status: int) -> None:
    """End the process, even if the thread of a stuck callback would keep it alive."""
    if result.stuck:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):
                stream.flush()
        os._exit(status)
    sys.exit(status)
