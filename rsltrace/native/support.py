"""What of a job a native run does, what it leaves out, and what it cannot do without."""

from __future__ import annotations

from rsltrace.errors import JobError
from rsltrace.job import Job, locate

_STEERING = (
    "start_ns",
    "construct_time_ns",
    "seed",
    "timer_ties",
    "livelock_limit",
    "guard",
    "delay",
    "policy",
    "min_time_step_ns",
    "executors",
    "execution",
    "clocks",
    "faults",
    "threads",
    "vary",
)
"""Keys of a job that say how a simulation goes; nobody can tell real time and DDS."""


def check(job: Job) -> None:
    """Raise ``JobError`` at the first part of a job that has to be and cannot be native."""
    for index, spec in enumerate(job.nodes):
        if spec.node is None:
            raise JobError(
                f"a native run has all nodes in one process, and {spec.target} is a program of its "
                f"own ({spec.kind}): name its Node class or a function that makes it (node:)",
                where=spec.origin or locate(job, ("nodes", index, spec.kind)),
            )
        if spec.start_after is not None:
            raise JobError(
                "a native run starts all nodes at once: leave start_after out",
                where=spec.origin or locate(job, ("nodes", index, "start_after")),
            )
    if job.bags:
        raise JobError(
            "a native run plays no bags: play them with ros2 bag play beside it, in the domain "
            "that --domain names",
            where=locate(job, ("bags", 0)),
        )
    for name in ("before", "after"):
        if getattr(job.hooks, name) is not None:
            raise JobError("a native run has no hooks", where=locate(job, ("hooks", name)))
    if not job.nodes:
        raise JobError("there are no nodes to run natively", where=locate(job, ("nodes",)))


def ignored(job: Job) -> list[str]:
    """Return the keys of a job that have no effect natively."""
    keys = [key.removesuffix("_ns") for key in _STEERING if key in job.model_fields_set]
    if any(spec.guard is not None for spec in job.nodes) and "guard" not in keys:
        keys.append("guard")
    return keys
