"""Stop in the middle of a run, from where runs of other jobs continue.

Their jobs differ only in what comes later (``RunSession.becomes``): each run is as if made from the
beginning. ``rsltrace.search.explore.prefix`` makes the copies.
"""

from __future__ import annotations

from collections.abc import Iterator

from greenlet import getcurrent

from rsltrace.job import Job
from rsltrace.job.parts.fault import FaultSpec
from rsltrace.run.driver import next_step_ns
from rsltrace.run.session import RunSession
from rsltrace.run.stop_rules import given_rules
from rsltrace.simulation.loop.policy import Departures
from rsltrace.trace.model.texts import format_seconds


def run_up_to(session: RunSession, time_ns: int) -> bool:
    """Run up to and including a simulated time; return whether anything follows."""
    loop, runners = session.loop, session.world.runtime.runners

    def gate(next_ns: int | None) -> bool:
        coming_ns = next_step_ns(loop, next_ns)
        if coming_ns is not None and coming_ns <= time_ns:
            return False
        loop.gate = None
        runners.waiting.append(getcurrent())
        assert runners.main is not None
        runners.main.switch()
        return False

    loop.gate = gate
    session.begin()
    if not session.ended:
        session.go_on()
    return not session.ended


def why_no_branches(job: Job) -> str:
    """Return why no other run can go on from one of a job, "" if others can."""
    for _, _, rule in given_rules(job):
        if rule.prevents_forks:
            return rule.prevents_forks
    if any(fault.of_node for fault in job.faults):
        return "the job itself has faults of nodes"
    return ""


def why_no_branch(session: RunSession, job: Job) -> str:
    """Return why a job's run cannot branch off where a session stands, or ""."""
    first = next(_obstacles(session, job), "")
    at = format_seconds(session.loop.now_ns - session.start_ns)
    return first and f"{first} up to {at} s"


def _obstacles(session: RunSession, job: Job) -> Iterator[str]:
    """Yield what already differs."""
    old, loop = session.job, session.loop
    before = getattr(loop, "policy", None)
    policy = job.policy
    if policy != old.policy and policy is not None:
        if policy.departures is not None:
            done = before.choices if isinstance(before, Departures) else 0
            if any(one.choice < done for one in policy.departures):
                yield "its order departs from the plain one"
        elif policy.after_ns is None or session.start_ns + policy.after_ns < loop.now_ns:
            yield "its policy chooses"
        elif policy.order == "rate_monotonic":
            yield "its policy follows chains"
    own = len(old.faults)
    if job.faults[:own] != old.faults:
        yield "it is without faults of the job"
    if not all(_is_to_come(fault, session) for fault in job.faults[own:]):
        yield "it has a fault"


def _is_to_come(fault: FaultSpec, session: RunSession) -> bool:
    if fault.of_node:  # of those that come at a time, the order among what is due then is another
        return fault.event is not None and fault.event >= session.loop.events
    assert fault.message is not None
    if fault.of_bag:
        bags = session.bag_faults
        return bags is None or fault.message > bags.reached[fault.name]
    reached = session.world.domain.transport.faults.get(fault.name)
    return reached is None or fault.message > reached.reached
