"""The files that a job consists of and reads. ``--force`` must not overwrite them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rsltrace.adapters.launch import JobExpansion
from rsltrace.errors import OutputError
from rsltrace.job import Job
from rsltrace.run.plans.executables import compiled_file, why_not_runnable
from rsltrace.run.process import search_path


def expand_launch_files(job: Job, *, programs: bool = True, native: bool = False) -> JobExpansion:
    """Return a job whose launch files are replaced by nodes, and for a ``native`` run other
    programs; executables are also looked for in its ``search_path``. Unless ``programs`` is False,
    this runs Python launch files.

    :raises JobError: a launch file is wrong, or starts what cannot be simulated.
    """
    if not job.launch:
        return JobExpansion(job)
    from rsltrace.adapters.launch.expand import expand

    def is_process(package: str, executable: str) -> bool:
        return compiled_file(f"{package}/{executable}") is not None

    with search_path(job):
        return expand(
            job,
            why_not=why_not_runnable,
            is_process=is_process,
            programs=programs,
            native=native,
        )


def check_output(job: Job, output: Path, replay: Path | None) -> None:
    """Raise ``OutputError`` if the trace would overwrite a file that the run reads."""
    if not output.exists():
        return
    for what, path in _inputs(job, replay):
        inside = path.is_dir() and path.resolve() in output.resolve().parents
        if inside or (path.exists() and output.samefile(path)):
            raise OutputError(
                f"cannot write the trace {output}: the run reads it ({what}); choose another place "
                "with -o"
            )


def _inputs(job: Job, replay: Path | None) -> Iterator[tuple[str, Path]]:
    """Yield (description, path) of each file that the run reads."""
    yield "it is the job", job.resolve(Path(job.source_name).name)
    if job.composed is not None:
        for other in job.composed.others:
            yield "base or include of the job", job.resolve(other)
    for bag in job.bags:
        yield "a bag of the job", job.resolve(bag.path)
    for place, file in job.model_files():
        yield ".".join(map(str, place)), job.resolve(file)
    for node in job.nodes:
        for file in node.parameter_files:
            yield "a parameter file of the job", job.resolve(file)
    if replay is not None:
        yield "the trace whose recorded answers are given again", replay
