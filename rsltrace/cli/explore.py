"""``rsltrace explore``: search the orders of a job for the run that fails."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.job_source import (
    RosArgsCommand,
    all_overrides,
    job_options,
    job_words,
)
from rsltrace.cli.record import default_output
from rsltrace.cli.verify import terminated
from rsltrace.errors import ExploreError
from rsltrace.terminal import say, tell
from rsltrace.trace.model.texts import printable

if TYPE_CHECKING:
    from rsltrace.job import Job
    from rsltrace.search.explore.search import Budget, Pool, Search
    from rsltrace.search.explore.small.causes import SmallRun
    from rsltrace.search.explore.trial import JobSource, TrialResult

STRATEGIES = ("mixed", "pct", "random", "feedback", "systematic", "faults", "vary")
_FORMAT = 1
_INTERRUPTED = 130


def _budget(context: click.Context, option: click.Parameter, text: str) -> Budget:
    """Read ``1000`` (trials) or ``10min`` (of real time)."""
    from rsltrace.job.values.times import parse_time
    from rsltrace.search.explore.search import Budget
    from rsltrace.trace.model.texts import NS_PER_S

    if re.fullmatch(r"\d+", text.strip()):
        if int(text) == 0:
            raise click.BadParameter("nothing can be tried with a budget of 0")
        return Budget(trials=int(text))
    try:
        seconds = parse_time(text) / NS_PER_S
    except ValueError:
        raise click.BadParameter(
            f"expected a number of runs (1000) or a time (10min, 90s, 2h), got {text!r}"
        ) from None
    if seconds == 0:
        raise click.BadParameter("nothing can be tried with a budget of 0")
    return Budget(seconds=seconds)


def _fork_after(
    context: click.Context, option: click.Parameter, text: str | None
) -> tuple[str, int] | None:
    """Read a simulated time since the start of a run."""
    from rsltrace.job.values.times import parse_time

    if text is None:
        return None
    try:
        return text, parse_time(text)
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


@click.command(cls=RosArgsCommand)
@job_options
@click.option(
    "--strategy",
    type=click.Choice(STRATEGIES),
    default="mixed",
    show_default=True,
    help="What is tried: see docs/exploring.md.",
)
@click.option(
    "--budget",
    default="1000",
    show_default=True,
    metavar="N|TIME",
    callback=_budget,
    help="How many runs, or how long (10min).",
)
@click.option("--stop-at-first", is_flag=True, help="End the search with the first run that fails.")
@click.option("--resume", is_flag=True, help="Go on with the search in the output folder.")
@click.option("--force", is_flag=True, help="Replace the search in the output folder.")
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    metavar="W",
    help="How many runs at a time (default: one for each processor).",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for results and traces (default: the job's name with .explore, here).",
)
@click.option(
    "--depth",
    type=click.IntRange(1, 100),
    help="Depth of bugs that pct looks for (default: 1 to 3); departures from the plain order "
    "that systematic makes at most (default: any number).",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Search with other random choices.",
)
@click.option(
    "--until",
    metavar="T",
    help="Stop at time T of each run (seconds, or 90s, 5ms, …; @T: at simulated time T).",
)
@click.option(
    "--fork-after",
    metavar="T",
    callback=_fork_after,
    help="Differ from the job as it is only after simulated time T (30s), and go on from there in "
    "copies of its run.",
)
@click.option(
    "--timeout",
    type=click.FloatRange(min=0, min_open=True),
    metavar="S",
    help="Kill a run after so many seconds (default: 30 times what the first took, at least 60).",
)
@click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Run on the workers of a Dask cluster: its scheduler (tcp://host:8786), or dask for what "
    "Dask's configuration says.",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(("text", "json", "junit", "github")),
    default="text",
    show_default=True,
    help="What to print in the end.",
)
@click.option(
    "--small",
    is_flag=True,
    help="Make the first run of each cause small, and write it as a folder that repeats it (with "
    "--resume also later).",
)
@click.option("-q", "--quiet", is_flag=True, help="Only the result, nothing while it searches.")
def explore(
    words: tuple[str, ...],
    launch: Path | None,
    skip: bool,
    overrides: tuple[str, ...],
    strategy: str,
    budget: Budget,
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
    small: bool,
    quiet: bool,
) -> int:
    """Run JOB in many orders of its callbacks, and find those in which something fails.

    What fails is what the job's checks say (checks:), an exception, a deadlock, a livelock, a run
    that does not end before its timeout (stop: {timeout: …}) or that crashes. Every run can be
    repeated: it is the job with what sets it apart, and "rsltrace record" of that does the same.

    The exit status is 0 if nothing failed, 1 if something did, 2 for trouble: results that are
    there by then are kept, and --resume goes on.
    """
    from rsltrace.checks.evaluate import check_texts
    from rsltrace.checks.metrics import check_metrics
    from rsltrace.search.explore.search import Search
    from rsltrace.search.explore.strategies.named import strategy_named
    from rsltrace.search.explore.table import Table
    from rsltrace.search.explore.trial import JobSource
    from rsltrace.search.explore.vary import check_vary

    if resume and force:
        raise click.UsageError("--resume goes on with a search, --force replaces it: give one")
    named, changes, text = job_words(words, launch, skip, all_overrides(overrides, None, until))
    labelled = tuple(("--set", one) if isinstance(one, str) else one for one in changes)
    source = JobSource(str(named), labelled, text, str(named.parent))
    job = source.job()
    check_texts(job)
    check_metrics(job)
    if strategy == "vary":
        check_vary(source, job)
    folder = output or default_output(named).with_suffix(".explore")
    about = _about(source, job, strategy, seed, depth)
    if fork_after is not None:
        about["fork after"] = fork_after[1]
    with terminated(), Table(folder, about, resume=resume, force=force) as table:
        chosen = strategy_named(strategy, job, seed=seed, depth=depth, fork_after=fork_after)
        search = Search(
            job,
            chosen,
            table,
            budget=budget,
            stop_at_first=stop_at_first,
            timeout_s=timeout,
            fork_ns=-1 if fork_after is None else fork_after[1],
        )
        end = _End(search, source, folder, strategy, form)
        interrupted = False
        with search, _pool(source, job, jobs, cluster) as pool:
            try:
                with _telling(search, budget, quiet=quiet) as on_result:
                    search.run(pool, on_result)
            except KeyboardInterrupt:
                interrupted = True
            except ExploreError:
                if search.tally.runs:
                    end.report(job)
                raise
    if small and not interrupted:
        end.make_small(job, timeout, quiet=quiet)
    end.report(job)
    if interrupted:
        tell(f"interrupted: --resume goes on; the results are in {folder}")
        return _INTERRUPTED
    return 1 if search.tally.failures else 0


def _pool(
    source: JobSource, job: Job, jobs: int | None, cluster: str | None
) -> AbstractContextManager[Pool]:
    """Return where the trials are run: here, or on a cluster."""
    from rsltrace.search.explore.workers import Workers, default_jobs

    if cluster is None:
        return Workers(source, jobs or default_jobs(), pins=job.guard.pins)
    if jobs is not None:
        raise click.UsageError("--jobs is for this machine: a cluster has as many as it has")
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
    """Return what a search is about: it can be resumed if that is the same."""
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
    search: Search, budget: Budget, *, quiet: bool
) -> Iterator[Callable[[TrialResult], None]]:
    """Tell on stderr how a search goes: a line on a terminal, causes of failures anywhere."""
    from rsltrace.cli.output.search_progress import search_line

    if quiet:
        yield lambda result: None
        return
    told: set[str] = set()
    with search_line(search, budget) as update:

        def on_result(result: TrialResult) -> None:
            update()
            trial, failure = result.trial, result.failure
            if failure is not None and failure.key not in told:
                told.add(failure.key)
                tell(f"trial {trial.number} ({trial.why}): {failure.kind}: {failure.text}")

        yield on_result


class _End:
    """The end of a search: what is printed, and the page in its folder."""

    def __init__(
        self, search: Search, source: JobSource, folder: Path, strategy: str, form: str
    ) -> None:
        self._search = search
        self._source = source
        self._folder = folder
        self._strategy = strategy
        self._form = form
        self._small: dict[str, SmallRun] = {}

    def make_small(self, job: Job, timeout_s: float | None, *, quiet: bool) -> None:
        """Make one run of each cause small."""
        from rsltrace.search.explore.small.causes import make_small

        def on_begin(cause: str) -> None:
            if not quiet:
                tell(f"making it small: {cause}")

        self._small = make_small(
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
                say(printable(f"not made small: {cause}: {one.trouble}"))
                continue
            say(printable(f"made small: {cause}: {one.folder / 'README.md'}"))
            if one.decides:
                say(printable(f"  {one.decides}"))

    def report(self, job: Job) -> None:
        """Write the page and the table, and print what came of the search."""
        from rsltrace.cli.output.search_text import search_lines
        from rsltrace.search.explore.report.exploration import Exploration, Reduced
        from rsltrace.search.explore.report.formats import (
            github_text,
            json_text,
            junit_text,
            write_parquet,
        )
        from rsltrace.search.explore.report.page import write_page
        from rsltrace.search.explore.table import PAGE, PARQUET, rows

        source, search = self._source, self._search
        explored = Exploration(
            source.path,
            list(rows(self._folder)),
            strategy=self._strategy,
            arguments=[word for _, text in source.overrides for word in ("--set", text)],
            coverage=search.strategy.coverage(),
            wall_s=time.monotonic() - search.began_s,
            reduced={
                cause: Reduced(str(one.folder), one.decides)
                for cause, one in self._small.items()
                if not one.trouble
            },
            checks=len(job.checks),
            units={name: spec.unit for name, spec in job.metrics.items() if spec.unit},
        )
        try:
            write_page(explored, self._folder / PAGE)
            with suppress(ExploreError):  # without pyarrow there are the rows alone
                write_parquet(explored, self._folder / PARQUET)
        except OSError as error:
            raise ExploreError(
                f"the report in {self._folder} cannot be written: {error.strerror}; the results "
                "are kept there, and --resume goes on"
            ) from None
        if self._form == "text":
            for line in search_lines(search, source, self._folder, caution=explored.caution):
                say(line)
            self._say_small()
        else:
            texts = {"json": json_text, "junit": junit_text, "github": github_text}
            say(texts[self._form](explored))
