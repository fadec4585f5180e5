"""``rsltrace explore``: search the callback orders of a job for runs that fail."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.job_source import JobArguments, RosArgsCommand, job_options
from rsltrace.cli.options import history_option, job_folder_option, trust_option
from rsltrace.cli.output.exit_status import interrupted_status
from rsltrace.cli.record import default_output
from rsltrace.cli.verify import handling_signals
from rsltrace.errors import ExploreError
from rsltrace.terminal import say, tell
from rsltrace.trace.model.regular_file import replacement_of
from rsltrace.trace.model.texts import NS_PER_S, printable

if TYPE_CHECKING:
    from rsltrace.job import Job
    from rsltrace.job.parts.scheduling import PolicySpec
    from rsltrace.search.explore.search import Explorer, SearchBudget, TrialPool
    from rsltrace.search.explore.small.causes import ReducedFailure
    from rsltrace.search.explore.trial import JobSource, TrialResult
    from rsltrace.search.history.run_record import RunRecord


STRATEGIES = ("mixed", "pct", "random", "feedback", "systematic", "faults", "vary")
_FORMAT = 1


def _budget(context: click.Context, option: click.Parameter, text: str) -> SearchBudget:
    """Read ``1000`` (trials) or ``10min`` (of real time)."""
    from rsltrace.job.values.times import parse_time
    from rsltrace.search.explore.search import SearchBudget

    if re.fullmatch(r"\d+", text.strip()):
        if int(text) == 0:
            raise click.BadParameter("the budget must be greater than 0")
        return SearchBudget(trials=int(text))
    try:
        seconds = parse_time(text) / NS_PER_S
    except ValueError:
        raise click.BadParameter(
            f"expected a number of runs (1000) or a time (10min, 90s, 2h), got {text!r}"
        ) from None
    if seconds == 0:
        raise click.BadParameter("the budget must be greater than 0")
    return SearchBudget(seconds=seconds)


def _fork_after(
    context: click.Context, option: click.Parameter, text: str | None
) -> tuple[str, int] | None:
    """Read a simulated time since the start of a run."""
    from rsltrace.job.values.times import format_time, parse_stamp

    if text is None:
        return None
    try:
        after_ns = parse_stamp(text)
        return format_time(after_ns), after_ns
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


def budget_option(default: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the option of how long to search."""
    return click.option(
        "--budget",
        default=default,
        show_default=True,
        metavar="N|TIME",
        callback=_budget,
        help="Try N runs, or search for this long (10min).",
    )


jobs_option = click.option(
    "--jobs",
    type=click.IntRange(min=1),
    metavar="W",
    help="Run W runs in parallel (default: one per CPU).",
)
output_option = click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    help="Write results and traces to this folder (default: the job's name with .explore).",
)


@click.command(cls=RosArgsCommand)
@job_options
@click.option(
    "--strategy",
    type=click.Choice(STRATEGIES),
    default="mixed",
    show_default=True,
    help="How the search chooses runs: see docs/exploring.md.",
)
@budget_option("1000")
@click.option("--stop-at-first", is_flag=True, help="Stop at the first run that fails.")
@click.option("--resume", is_flag=True, help="Continue the search in the output folder.")
@click.option("--force", is_flag=True, help="Replace the search in the output folder.")
@jobs_option
@output_option
@click.option(
    "--depth",
    type=click.IntRange(1, 100),
    help="For pct: depth of the bugs to find (default: 1 to 3). For systematic: maximum number of "
    "deviations from the default order (default: unlimited).",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Make other random choices with this seed.",
)
@click.option(
    "--until",
    metavar="T",
    help="Stop each run at time T: seconds, or with a unit (90s, 5ms). @T is a simulated time.",
)
@click.option(
    "--fork-after",
    metavar="T",
    callback=_fork_after,
    help="Change the order only after simulated time T (30s): run the job up to T once, and fork "
    "that run for each trial. Of a native TRACE: follow its order up to T (default: 0s).",
)
@click.option(
    "--timeout",
    type=click.FloatRange(min=0, min_open=True),
    metavar="S",
    help="Kill a run after S seconds of real time (default: 30 times the duration of the first "
    "run, at least 60).",
)
@click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Run on the workers of a Dask cluster: give the address of its scheduler "
    "(tcp://host:8786), or dask to use Dask's configuration.",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(("text", "json", "junit", "github")),
    default="text",
    show_default=True,
    help="Format of the final report.",
)
@click.option(
    "--minimize",
    is_flag=True,
    help="Reduce the first failing run of each cause to the fewest faults and deviations, and "
    "write a folder that reproduces it. Can be done later with --resume.",
)
@job_folder_option
@trust_option
@history_option
@click.option("-q", "--quiet", is_flag=True, help="Show only the result, no progress.")
def explore(
    given: JobArguments,
    strategy: str,
    budget: SearchBudget,
    stop_at_first: bool,
    resume: bool,
    force: bool,
    jobs: int | None,
    output: Path | None,
    depth: int | None,
    seed: int,
    until: str | None,
    fork_after: tuple[str, int] | None,
    timeout: float | None,
    cluster: str | None,
    form: str,
    minimize: bool,
    job_folder: Path | None,
    trust: bool,
    history: str | None,
    quiet: bool,
) -> int:
    """Run JOB in many callback orders and find the runs that fail.

    A run fails if a check of the job (checks:) fails or a node raises an exception. It also fails
    if it deadlocks, livelocks, crashes or reaches its timeout (stop: {timeout: …}). Each failing
    run is printed as an "rsltrace record" command that reproduces it.

    If JOB is the trace of a native run, follow its order up to --fork-after, then try others. The
    job of that is written to TRACE.explore.yaml, beside the job that was recorded.

    Exit status: 0 if no run failed, 1 if one did, 2 for an error. Results so far are kept, and
    --resume continues the search.
    """
    from rsltrace.checks.evaluate import check_texts
    from rsltrace.checks.metrics import check_metrics
    from rsltrace.diff.file_kind import is_trace
    from rsltrace.search.explore.search import Explorer
    from rsltrace.search.explore.strategies.named import check_vary, strategy_named
    from rsltrace.search.explore.table import ResultsFolder
    from rsltrace.search.explore.trial import JobSource

    if resume and force:
        raise click.UsageError(
            "give --resume to continue a search or --force to replace it, not both"
        )
    named, changes, text = given.overridden(None, until).named()
    default = default_output(named).with_suffix(".explore")
    if text is None and is_trace(named):
        named = _job_of_native(named, job_folder, trust=trust, force=force, quiet=quiet)
        fork_after = fork_after or ("0s", 0)
    labelled = tuple(("--set", one) if isinstance(one, str) else one for one in changes)
    source = JobSource(given.source_name(named), labelled, text, str(named.parent))
    with replace(given, until=until).recorded(history, "explore") as record:
        job = source.job()
        if job.policy is not None and job.policy.recorded is not None:
            source, fork_after = _leaving_recorded(source, job.policy, fork_after)
            job = source.job()
        check_texts(job)
        check_metrics(job)
        if strategy == "vary":
            check_vary(source, job)
        folder = output or default
        about = _about(source, job, strategy, seed, depth)
        if fork_after is not None:
            about["fork after"] = fork_after[1]
        with handling_signals(), ResultsFolder(folder, about, resume=resume, force=force) as table:
            chosen = strategy_named(strategy, job, seed=seed, depth=depth, fork_after=fork_after)
            search = Explorer(
                job,
                chosen,
                table,
                budget=budget,
                stop_at_first=stop_at_first,
                timeout_s=timeout,
                fork_ns=-1 if fork_after is None else fork_after[1],
            )
            end = _SearchReport(search, source, folder, strategy, form, quiet=quiet)
            interrupted = 0
            with search, _pool(source, job, jobs, cluster) as pool:
                try:
                    with _telling(search, budget, quiet=quiet) as on_result:
                        search.run(pool, on_result)
                except KeyboardInterrupt as interrupt:
                    interrupted = interrupted_status(interrupt)
                except ExploreError:
                    if search.tally.runs:
                        end.report(job)
                    raise
        if minimize and not interrupted:
            end.make_small(job, timeout)
        _set_result(record, search)
        end.report(job)
        if interrupted:
            if record.verdict != "failed":
                record.runs = 0  # one that is cut off says nothing else: no line
            tell(f"interrupted: continue with --resume; the results are in {folder}")
            return interrupted
        return 1 if search.tally.failures else 0


def _job_of_native(
    path: Path, job_folder: Path | None, *, trust: bool, force: bool, quiet: bool
) -> Path:
    """Write the job that follows a native run beside the job of that run; return its path.

    :raises TraceError, ReplayError: the trace or what it needs is missing, or is not trusted.
    :raises ExploreError: it is of a simulated run, or the job cannot be written.
    """
    from rsltrace.cli.replay import agree, code_lines
    from rsltrace.replay.preparation import prepare_replay
    from rsltrace.trace.native import is_native

    with prepare_replay(path, job_folder) as plan:
        if not is_native(plan.trace):
            raise ExploreError(
                f"{path} is of a simulated run: explore its job, with --fork-after for other "
                "orders from a time on"
            )
        for line in () if quiet else (*code_lines(plan, "exploring"), *plan.notes):
            tell(line)
        agree(plan, trust=trust)
        written = plan.folder / f"{path.stem}.explore.yaml"
        text = f"# {path.name}, to be run again: see docs/native.md\n{plan.job.to_yaml()}"
        try:
            if written.exists() and written.read_text(encoding="utf-8") != text and not force:
                raise ExploreError(f"{written} is of another run: replace it with --force")
            with replacement_of(written) as work:
                work.write_text(text, encoding="utf-8")
            tell(f"wrote {written}")
        except (OSError, UnicodeError) as error:
            raise ExploreError(f"{written} cannot be written: {error}") from None
    return written


def _leaving_recorded(
    source: JobSource, policy: PolicySpec, fork_after: tuple[str, int] | None
) -> tuple[JobSource, tuple[str, int] | None]:
    """Return a job that follows a recording so that trials leave it at a time, and the time."""
    from rsltrace.job.values.times import format_time

    if fork_after is not None:
        after = "--fork-after", f"policy.after={fork_after[0]}"
        source = replace(source, overrides=(*source.overrides, after))
    elif policy.after_ns is not None:
        fork_after = format_time(policy.after_ns), policy.after_ns
    return replace(source, begins_recorded=fork_after is not None), fork_after


def _set_result(record: RunRecord, search: Explorer) -> None:
    """Set what this search found, without the runs of one that it resumed."""
    tally = search.tally
    record.runs = search.runs_here
    record.failed = search.failed_here
    record.digest = tally.plain.digest if search.has_run_plain and tally.plain else ""
    if tally.failures:
        ((cause, _),) = tally.failures.most_common(1)
        record.fails(cause)


def _pool(
    source: JobSource, job: Job, jobs: int | None, cluster: str | None
) -> AbstractContextManager[TrialPool]:
    """Return the workers of the search: processes on this machine, or a cluster."""
    from rsltrace.search.explore.workers import Workers, default_jobs

    if cluster is None:
        return Workers(source, jobs or default_jobs(), pins=job.guard.pins)
    if jobs is not None:
        raise click.UsageError("--jobs has no effect with --cluster")
    try:
        from rsltrace.search.explore.cluster import Cluster
    except ImportError:
        raise ExploreError(
            "a cluster needs dask.distributed: pip install 'rsltrace[explore]'"
        ) from None
    return Cluster(source, cluster, pins=job.guard.pins)


def _about(
    source: JobSource, job: Job, strategy: str, seed: int, depth: int | None
) -> dict[str, Any]:
    """Return the settings of a search. It can be resumed only with the same settings."""
    from rsltrace.trace.chain import hash64

    return {
        "format": _FORMAT,
        "job": source.path,
        "overrides": [list(one) for one in source.overrides],
        "what the job says": f"{hash64(job.to_yaml().encode()):016x}",
        "strategy": strategy,
        "seed": seed,
        "depth": depth,
    }


@contextmanager
def _telling(
    search: Explorer, budget: SearchBudget, *, quiet: bool
) -> Iterator[Callable[[TrialResult], None]]:
    """Show the progress of a search on stderr, and new causes of failures."""
    from rsltrace.cli.output.search_progress import search_line

    if quiet:
        yield lambda result: None
        return
    reported: set[str] = set()
    with search_line(search, budget) as update:

        def on_result(result: TrialResult) -> None:
            update()
            trial, failure = result.trial, result.failure
            if failure is not None and failure.key not in reported:
                reported.add(failure.key)
                tell(f"trial {trial.number} ({trial.why}): {failure.kind}: {failure.text}")

        yield on_result


class _SearchReport:
    """The report of a search: what is printed, and the page in its folder."""

    def __init__(
        self,
        search: Explorer,
        source: JobSource,
        folder: Path,
        strategy: str,
        form: str,
        *,
        quiet: bool,
    ) -> None:
        self._search = search
        self._source = source
        self._folder = folder
        self._strategy = strategy
        self._form = form
        self._quiet = quiet
        self._small: dict[str, ReducedFailure] = {}

    def make_small(self, job: Job, timeout_s: float | None) -> None:
        """Minimize one run of each cause."""
        from rsltrace.search.explore.small.causes import reduce_failures

        def on_begin(cause: str) -> None:
            if not self._quiet:
                tell(f"minimizing: {cause}")

        self._small = reduce_failures(
            self._source,
            self._search.tally.first,
            self._folder,
            pins=job.guard.pins,
            timeout_s=timeout_s,
            on_begin=on_begin,
        )

    def _say_small(self) -> None:
        for cause, one in self._small.items():
            if one.trouble:
                say(printable(f"not minimized: {cause}: {one.trouble}"))
                continue
            say(printable(f"minimized: {cause}: {one.folder / 'README.md'}"))
            if one.decides:
                say(printable(f"  {one.decides}"))

    def report(self, job: Job) -> None:
        """Write the page and the table, and print the result."""
        from rsltrace_viewer.pages.search_page import exploration_page

        from rsltrace.cli.output.search_text import flaky_lines, search_lines
        from rsltrace.search.explore.report import (
            Exploration,
            ReducedRun,
            github_text,
            json_text,
            junit_text,
            write_parquet,
        )
        from rsltrace.search.explore.table import PAGE, PARQUET, result_rows

        source, search = self._source, self._search
        explored = Exploration(
            source,
            list(result_rows(self._folder)),
            strategy=self._strategy,
            coverage=search.strategy.coverage(),
            wall_s=time.monotonic() - search.began_s,
            reduced={
                cause: ReducedRun(str(one.folder), one.decides)
                for cause, one in self._small.items()
                if not one.trouble
            },
            checks=len(job.checks),
            units={name: spec.unit for name, spec in job.metrics.items() if spec.unit},
        )
        try:
            with replacement_of(self._folder / PAGE) as work:
                work.write_text(exploration_page(explored), encoding="utf-8")
            with suppress(ExploreError):  # pyarrow is not installed
                write_parquet(explored, self._folder / PARQUET)
        except OSError as error:
            raise ExploreError(
                f"the report in {self._folder} cannot be written: {error.strerror}; the results "
                "are kept there; continue with --resume"
            ) from None
        if self._form == "text":
            for line in search_lines(
                search, source, self._folder, caution=explored.caution, quiet=self._quiet
            ):
                say(line)
            self._say_small()
        elif self._form == "flaky":
            for line in flaky_lines(search, self._folder, self._small):
                say(printable(line))
        else:
            texts = {"json": json_text, "junit": junit_text, "github": github_text}
            say(texts[self._form](explored))


_DELAY = 'delay.default={"lognormal": {"median": "1ms", "sigma": 1.5}}'
"""Mostly a millisecond, one in a hundred over 30 ms: messages of other topics overtake each other
as on a loaded machine."""


@click.command(cls=RosArgsCommand)
@job_options
@budget_option("100")
@click.option("--stop-at-first", is_flag=True, help="Stop at the first run that fails.")
@jobs_option
@output_option
@click.option("--resume", is_flag=True, help="Continue the search in the output folder.")
@click.option("--force", is_flag=True, help="Replace the search in the output folder.")
@click.option("-q", "--quiet", is_flag=True, help="Show only the result, no progress.")
def flaky(given: JobArguments, **options: Any) -> int:
    """Run a test in many callback orders and with many delays, and keep the smallest run that
    fails and the nearest that passes.

    \b
      rsltrace flaky -- pytest test/test_nodes.py::test_reset
      rsltrace flaky -- ros2 launch my_robot nodes.launch.py -- pytest test/test_nodes.py
      rsltrace flaky -- build/my_robot/test_filter

    The test runs unmodified, in simulated time. It fails by an exception, an exit status, a
    deadlock or a crash. Messages are delayed by about a millisecond, some by much more; --set
    delay.default=T changes that.

    Exit status: 0 if it never failed, 1 if it did, 2 for an error.
    """
    if not given.program:
        raise click.UsageError("name the test after '--': rsltrace flaky -- pytest FILE")
    assert explore.callback is not None
    status: int = explore.callback(
        replace(given, overrides=(_DELAY, *given.overrides)),
        strategy="mixed",
        depth=None,
        seed=0,
        until=None,
        fork_after=None,
        timeout=None,
        cluster=None,
        form="flaky",
        minimize=True,
        job_folder=None,
        trust=False,
        history=None,
        **options,
    )
    return status
