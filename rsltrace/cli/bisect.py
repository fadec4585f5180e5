"""``rsltrace bisect``: find the commit that changed a job's behaviour."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.job_source import JobArguments, RosArgsCommand, job_options
from rsltrace.cli.options import (
    json_option,
    no_pin_option,
    seed_option,
    timeout_option,
    until_option,
)
from rsltrace.cli.verify import handling_signals
from rsltrace.errors import BisectError, JobError, OutputError
from rsltrace.terminal import say, tell

if TYPE_CHECKING:
    from rsltrace.child_processes import Processes
    from rsltrace.job import Job
    from rsltrace.search.bisect.repository import GitRepository
    from rsltrace.search.bisect.search import BisectResult, RevisionCheck, RevisionRunner

_BEFORE, _AFTER = "before.mcap", "after.mcap"


@click.command(cls=RosArgsCommand)
@job_options
@click.option("--good", metavar="REV", required=True, help="A revision before the change.")
@click.option("--bad", metavar="REV", required=True, help="A revision that has the change.")
@click.option(
    "--check",
    "expression",
    metavar="EXPR",
    help="Test this instead of the digest: 'count(\"/odom\") > 0', or MODULE:FUNCTION that takes "
    "a Trace.",
)
@click.option(
    "--run",
    "shell",
    metavar="COMMAND",
    help="Test with a shell command: exit status 0 is good, 125 skip, others bad. RSLTRACE_TRACE "
    "is the path of the trace.",
)
@click.option("--first-parent", is_flag=True, help="Follow only the first parent of merges.")
@click.option(
    "--share",
    "shared",
    multiple=True,
    type=click.Path(path_type=Path, exists=True),
    metavar="PATH",
    help="Make this untracked file or folder available to every revision. Repeatable.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help=f"Keep the traces before and after the change in DIR ({_BEFORE}, {_AFTER}), with a page "
    "(report.html).",
)
@click.option("--force", is_flag=True, help="Replace existing traces in DIR.")
@seed_option
@until_option
@no_pin_option
@timeout_option
@json_option
@click.option("-q", "--quiet", is_flag=True, help="Show no progress.")
def bisect(
    given: JobArguments,
    good: str,
    bad: str,
    expression: str | None,
    shell: str | None,
    first_parent: bool,
    shared: tuple[Path, ...],
    output: Path | None,
    force: bool,
    seed: int | None,
    until: str | None,
    no_pin: bool,
    timeout: float | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Run JOB at revisions of its git repository and find the first commit that changed its
    behaviour.

    A change is a different digest, or a different result of --check or --run. Each revision runs
    with its own job and nodes in a separate git worktree; your checkout is not touched. The good
    and the bad revision run first, twice each. Revisions that fail to run, or raise an exception
    that neither of these two raises, are skipped, as by "git bisect skip".

    Exit status: 0 if one commit was found; 1 if skipped revisions leave several candidates; 2 for
    an error: the ends do not differ, the job is nondeterministic, or there is no repository.
    """
    from rsltrace.child_processes import Processes
    from rsltrace.cli.output.search_text import line_of
    from rsltrace.search.bisect.repository import GitRepository, Worktree
    from rsltrace.search.bisect.search import BisectSearch, RevisionRunner

    if expression is not None and shell is not None:
        raise click.UsageError("give --check or --run, not both")
    given = replace(given, seed=seed, until=until, no_pin=no_pin)
    files = _named(given)
    if output is not None and not force:
        _check_free(output)
    repository = GitRepository.of(files[0])
    ends = repository.commit(good), repository.commit(bad)
    _check_ends(repository, *ends)
    processes = Processes()
    check = _check(expression, shell, processes)
    job = _job_here(given)
    links = [*_untracked(repository, job, files), *(path.resolve() for path in shared)]
    say_progress: Callable[[str], object] = (lambda text: None) if quiet else tell
    notes = [] if job is None else list(_same_everywhere(repository, job))
    for note in notes:
        tell(f"note: {note}")
    with handling_signals(), Worktree(repository, links) as tree:
        runner = RevisionRunner(
            repository, tree, tuple(given.arguments(tree.path)), processes, timeout
        )
        search = BisectSearch(
            runner,
            *ends,
            check,
            first_parent=first_parent,
            on_try=lambda tried: say_progress(line_of(tried)),
            on_note=say_progress,
        )
        with processes:
            found = search.find()
        return _report(found, runner, output, as_json=as_json)


def _check(expression: str | None, shell: str | None, processes: Processes) -> RevisionCheck | None:
    from rsltrace.search.bisect.search import command_check, expression_check

    if expression is not None:
        return expression_check(expression)
    return None if shell is None else command_check(shell, processes)


def _named(given: JobArguments) -> list[Path]:
    """Return the files that the command line names, the job's (or launch file's) first."""
    given.check_named()
    files = [*map(Path, given.files), *([] if given.launch is None else [given.launch])]
    files = files or [Path("run")]  # programs have no file, but a folder
    ros = given.ros
    files += [Path(ros[at + 1]) for at, word in enumerate(ros[:-1]) if word == "--params-file"]
    return [file.parent.resolve() / file.name for file in files]


def _check_free(folder: Path) -> None:
    for name in (_BEFORE, _AFTER):
        if (folder / name).exists():
            raise OutputError(f"{folder / name} exists; use --force to replace it")


def _check_ends(repository: GitRepository, good: Any, bad: Any) -> None:
    """Check the two ends of the search.

    :raises BisectError: they are the same commit, or in the wrong order.
    """
    if good == bad:
        raise BisectError(f"the good and the bad revision are the same commit, {good}")
    if repository.is_ancestor(bad, good):
        raise BisectError(f"--bad {bad} is an ancestor of --good {good}: exchange them")


def _job_here(given: JobArguments) -> Job | None:
    """Return the job in the checkout, or None if it is broken: revisions have their own."""
    try:
        return given.job()[0]
    except JobError:
        return None


def _untracked(repository: GitRepository, job: Job | None, files: list[Path]) -> Iterator[Path]:
    """Yield untracked files of the checkout that the job names, to share with all revisions."""
    candidates = list(files)
    if job is not None:
        texts = _texts(job.resolved())
        candidates += [job.resolve(text) for text in texts if text and len(text) < 4096]
    for path in dict.fromkeys(Path(os.path.normpath(path)) for path in candidates):
        inside = path.is_relative_to(repository.top) and path != repository.top
        if inside and os.path.lexists(path) and not repository.has_tracked(path):
            yield path


def _same_everywhere(repository: GitRepository, job: Job) -> Iterator[str]:
    """Yield notes on code that is the same at every revision because of where it is loaded from."""
    from rsltrace.replay.code import job_code_files, module_file
    from rsltrace.search.bisect.search import python_folders

    relative = [path for path in job.search_path if not os.path.isabs(path)]
    folders = [*map(str, python_folders(repository)), *(str(job.resolve(p)) for p in relative)]
    found = [(one.name, one.file) for one in job_code_files(job, {}) if one.file is not None]
    for name, file in found:
        is_ours = file.resolve().is_relative_to(repository.top)
        is_module = all(part.isidentifier() for part in name.split("."))
        if is_ours and is_module and module_file(name, folders, installed=False) is None:
            yield (
                f"{name} is loaded from {file} at every revision: add its folder, relative to the "
                "job, to search_path"
            )
    if found and not any(file.resolve().is_relative_to(repository.top) for _, file in found):
        name, file = found[0]
        yield (
            f"none of the job's code lies in {repository.top}: {name} is loaded from {file} at "
            "every revision"
        )


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for one in value.values():
            yield from _texts(one)
    elif isinstance(value, list):
        for one in value:
            yield from _texts(one)


def _report(
    found: BisectResult, runner: RevisionRunner, output: Path | None, *, as_json: bool
) -> int:
    """Print the result, keep the traces if wanted, and return the exit status."""
    from rsltrace.cli.output.search_text import as_page, as_text, as_values
    from rsltrace.cli.output.text_file import write_text
    from rsltrace.search.explore.table import PAGE

    kept = None
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(found.before.run.path, output / _BEFORE)
        shutil.copyfile(found.after.run.path, output / _AFTER)
        kept = (output / _BEFORE, output / _AFTER)
    if as_json:
        say(json.dumps(as_values(found, runner.repository, kept)))
    else:
        say(as_text(found, runner.repository, kept))
    if output is not None and kept is not None:
        write_text(output / PAGE, as_page(found, runner.repository, kept))
    return 0 if found.first is not None else 1
