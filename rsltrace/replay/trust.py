"""Whether to run what a trace names. A trace may come from anybody, and its job may name any code.

``record`` runs what a job file says that somebody chose to run. A replay runs what a *trace* says,
and a trace looks like data. So it runs without being asked only where it does no more than
``record`` of the job file in the present folder would do: the same nodes (or some of them) with the
same parameters, arguments, launch files, hooks and bags. What only says when, in which order and
for how long they run may differ.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch import ros_launch
from rsltrace.errors import JobError
from rsltrace.job import Job, job_from_text, load_job
from rsltrace.replay.edits import edits_of
from rsltrace.replay.job_folder import job_name, without_bags
from rsltrace.run.launch_files import without_launch_files
from rsltrace.trace.model.finding import Mode
from rsltrace.trace.reader import Trace

_LAUNCH = (".launch.xml", ".launch.yaml", ".launch.yml")
_MAY_DIFFER = frozenset(
    (
        "start_ns",
        "construct_time_ns",
        "stop",
        "seed",
        "timer_ties",
        "livelock_limit",
        "policy",
        "min_time_step_ns",
        "executors",
        "execution",
        "record",
    )
)
"""Keys of a job that say when, in which order and for how long its nodes run, and what is kept."""


def why_not_trusted(trace: Trace, job: Job, folder: Path, *, named: bool, bags: bool = True) -> str:
    """Return why a trace runs only if somebody says so, empty if it may.

    ``named``: the job's folder has been named by whoever runs it. Nothing is run to find out.
    ``bags``: those of the job will play.
    """
    name = job_name(trace)
    if not named and folder.resolve() != Path.cwd():
        return f"its job lies in {folder}, which is not the present folder"
    if not name:
        return "its job was made in Python, so there is no job file here that says the same"
    try:
        own = _own_job(folder / name, bags=bags)
    except (JobError, OSError, RecursionError):
        own = None
    if own is None:
        return f"there is no {name} in {folder} to compare its job with without running code"
    differing = _differing(own, job)
    if differing:
        return f"its job differs from {folder / name} in {', '.join(differing)}"
    if edits_of(trace):
        return "it holds edits, which the nodes would run with"
    if any(found.mode is Mode.RECORD for one in trace.findings.values() for found in one):
        return "it holds answers from outside (of files, sockets, …) that the nodes would be given"
    return ""


def _own_job(file: Path, *, bags: bool) -> Job | None:
    """Return the job of a job file or launch file, None if that takes running a program."""
    if file.name.endswith(_LAUNCH):
        spec = json.dumps({"file": file.name, "arguments": {}})
        job = job_from_text("{}", str(file), file.parent, overrides=[f"launch.+={spec}"])
    elif file.suffix in (".yaml", ".yml", ".json"):
        job = load_job(file) if bags else without_bags(lambda to: load_job(file, overrides=to))
    else:
        return None
    for launch in job.launch:
        # ROS's own launch runs what a launch file tells it to.
        if not launch.file.endswith(_LAUNCH) or ros_launch.can_read(job.resolve(launch.file)):
            return None
    return without_launch_files(job, programs=False).job


def _differing(own: Job, job: Job) -> list[str]:
    a, b = _values(own), _values(job)
    fewer = all(node in a["nodes"] for node in b["nodes"])  # of the nodes that are named here
    return [key for key in a if a[key] != b[key] and not (key == "nodes" and fewer)]


def _values(job: Job) -> dict[str, Any]:
    resolved = json.loads(json.dumps(job.resolved()))
    values = {key: value for key, value in resolved.items() if key not in _MAY_DIFFER}
    values["guard"] = {key: value for key, value in values["guard"].items() if key != "pin"}
    policy = resolved["policy"] or {}
    values["stop.function"] = resolved["stop"]["function"]
    values["policy"] = policy.get("function"), policy.get("recorded")
    values["files"] = sorted(job.model_files())
    return values
