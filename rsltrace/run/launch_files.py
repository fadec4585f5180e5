"""The launch files of a job as nodes: what a job's search path has can be launched, too."""

from __future__ import annotations

from rsltrace.adapters.launch.expanded import Expanded
from rsltrace.job import Job
from rsltrace.run.plans.executables import compiled_file, why_not
from rsltrace.run.process import search_path


def without_launch_files(job: Job, *, programs: bool = True) -> Expanded:
    """Return a job whose launch files have become nodes; executables are looked for in its
    ``search_path``, too. Python launch files are run to do so, unless ``programs`` is False.

    :raises JobError: if a launch file is wrong, or starts what cannot be simulated.
    """
    if not job.launch:
        return Expanded(job)
    from rsltrace.adapters.launch.expand import expand

    with search_path(job):
        return expand(job, why_not=why_not, is_process=_is_process, programs=programs)


def _is_process(package: str, executable: str) -> bool:
    return compiled_file(f"{package}/{executable}") is not None
