"""From a job's ``clocks:`` to the clocks of its nodes."""

from __future__ import annotations

from rsltrace.chance.clock import ClockModel
from rsltrace.job import Job


def clocks_of(job: Job) -> tuple[tuple[str, ClockModel], ...]:
    """Return (glob of the node, what is wrong with its clock), the first that fits first."""
    found = []
    for spec in job.clocks:
        random = spec.random_jumps
        model = ClockModel(
            offset_ns=spec.offset_ns,
            drift=spec.drift(),
            jumps=tuple((jump.at_ns, jump.by_ns) for jump in spec.jumps),
            random_every_ns=0 if random is None else random.every_ns,
            random_most_ns=0 if random is None else random.most_ns,
        )
        found.append((spec.node, model))
    return tuple(found)
