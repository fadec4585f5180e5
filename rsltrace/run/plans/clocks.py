"""From a job's ``clocks:`` to the clocks of its nodes."""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace.adapters.rclpy.node_clocks import ClockRule
from rsltrace.job import Job, locate
from rsltrace.job.values.problem import Loc
from rsltrace.simulation.chance.clock import ClockModel
from rsltrace.trace.model.stamp import format_duration


def clocks_of(job: Job) -> tuple[ClockRule, ...]:
    """Return what is different about clocks, the first that fits first."""
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
        found.append(ClockRule(spec.node, model, spec.advances, spec.source == "topic"))
    return tuple(found)


def clock_notes(job: Job, start_ns: int) -> Iterator[str]:
    """Yield the clocks that would show times before 0 when they are set."""
    for index, spec in enumerate(job.clocks):
        wrong_ns = spec.offset_ns
        settings: list[tuple[Loc, int]] = [(("clocks", index, "offset"), start_ns + wrong_ns)]
        for number, jump in enumerate(spec.jumps):
            wrong_ns += jump.by_ns
            place: Loc = ("clocks", index, "jumps", number, "by")
            settings.append((place, start_ns + jump.at_ns + wrong_ns))
        for loc, shown_ns in settings:
            if shown_ns < 0:
                yield (
                    f"{locate(job, loc)}: this clock would show times before 0, which ROS does "
                    f"not have: it shows 0 for {format_duration(-shown_ns)}; give the job a later "
                    "'start:'"
                )
                break
