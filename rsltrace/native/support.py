"""What of a job a native run does, what it leaves out, and what it cannot do without."""

from __future__ import annotations

from rsltrace.errors import JobError
from rsltrace.job import Job, locate
from rsltrace.simulation.loop.policy import PriorityRule

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
        if spec.component is not None:
            raise JobError(
                f"a native run loads no components: start {spec.target} beside it, in the domain "
                "that --domain names, or name a program of its own",
                where=spec.origin or locate(job, ("nodes", index, "component")),
            )
        if spec.stdin is not None:
            raise JobError(
                "a native run types nothing: leave stdin out, or give arguments",
                where=spec.origin or locate(job, ("nodes", index, "stdin")),
            )
    for name in ("before", "after"):
        if getattr(job.hooks, name) is not None:
            raise JobError("a native run has no hooks", where=locate(job, ("hooks", name)))
    if not job.nodes and not job.bags:
        raise JobError("there are no nodes to run natively", where=locate(job, ("nodes",)))


def needs_processes(job: Job) -> bool:
    """Return whether a job has more than nodes to construct: what is a program is a process."""
    return bool(job.bags) or any(
        spec.node is None or spec.start_after is not None for spec in job.nodes
    )


def priority_rules(job: Job, policy: str | None) -> tuple[PriorityRule, ...] | None:
    """Return the rules that a native run's priorities go by, None if they go by rate.

    :raises JobError: the job has none, and ``policy`` is ``priority``.
    """
    if policy != "priority":
        return None
    rules = None if job.policy is None else job.policy.priority
    if rules is None:
        raise JobError(
            "--policy priority takes the rules of the job, which has none: write for example "
            "policy: {priority: [{node: /controller, priority: 10}]}",
            where=locate(job, ("policy",)),
        )
    return tuple(PriorityRule(r.priority, r.node, r.entity, r.group_of) for r in rules)


def ignored(job: Job, policy: str | None = None) -> list[str]:
    """Return the keys of a job that have no effect natively, where priorities go by ``policy``."""
    keys = [key.removesuffix("_ns") for key in _STEERING if key in job.model_fields_set]
    if "policy" in keys and job.policy is not None and policy is not None:
        given = job.policy.order or ("priority" if job.policy.priority is not None else "")
        keys = [key for key in keys if key != "policy" or policy != given]
    if any(spec.guard is not None for spec in job.nodes) and "guard" not in keys:
        keys.append("guard")
    return keys
