"""From a job's ``policy:``, ``executors:`` and ``execution:`` to the plan that a world follows."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rsltrace.adapters.rclpy.hints import cannot_import, import_raised
from rsltrace.errors import JobError, RsltraceError, did_you_mean
from rsltrace.job import Job, locate
from rsltrace.run.plans.network import make_distribution
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.simulation.loop.policy import (
    Departure,
    Departures,
    ExecutionPolicy,
    Fifo,
    FifoUntil,
    Pct,
    Permutation,
    Priority,
    PriorityRule,
    RateMonotonic,
)
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.loop.wait_set import RclcppWaitSetPolicy, RclpyWaitSetPolicy
from rsltrace.simulation.middleware.events.failure import exception_text

if TYPE_CHECKING:
    from rsltrace.adapters.rclpy.entry import JobEntry
    from rsltrace.adapters.rclpy.world import World
    from rsltrace.job.parts.scheduling import PolicySpec
    from rsltrace.simulation.middleware.scheduling import SchedulingPlan

# What a job names as ``module:attribute``.


def load_target(target: str, *, where: str) -> Any:
    """Import ``module:attribute``.

    :raises JobError: if there is no such module or attribute, or it cannot be called.
    """
    module_name, _, attribute = target.partition(":")
    try:
        value: Any = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is not None and (module_name + ".").startswith(error.name + "."):
            raise JobError(
                f"there is no module {module_name!r} (looked in search_path and in Python's own "
                "path); check the name, or add its folder to search_path",
                where=where,
            ) from error
        raise JobError(cannot_import(module_name, error), where=where) from error
    except RsltraceError:
        raise
    except (Exception, SystemExit) as error:
        raise JobError(
            import_raised(module_name, error, exception_text(error)), where=where
        ) from error
    for part in attribute.split("."):
        try:
            value = getattr(value, part)
        except AttributeError as error:
            hint = did_you_mean(part, (n for n in dir(value) if not n.startswith("_")))
            raise JobError(
                f"module {module_name!r} has no {attribute!r}{hint}", where=where
            ) from error
    if not callable(value):
        raise JobError(f"{target} is a {type(value).__qualname__}, not callable", where=where)
    return value


def is_ordered(job: Job) -> bool:
    """Whether a job needs more than the plain loop."""
    policy = job.policy
    fifo = policy is None or (policy.order == "fifo" and policy.recorded is None)
    rules = not fifo or job.executors is not None or job.execution is not None
    return rules or switches_at_lines(job)


def switches_at_lines(job: Job) -> bool:
    """Whether a thread may go on in the middle of another's callback."""
    if job.threads is None:
        return False
    from rsltrace.job.parts.scheduling import EVERY_LINE

    return job.threads.switch == EVERY_LINE


def scheduling_plan(job: Job, start_ns: int, policy: ExecutionPolicy | None) -> SchedulingPlan:
    """Return the plan of a job. ``policy`` is what it follows instead of its own.

    :raises JobError: if the policy's class cannot be made.
    """
    from rsltrace.simulation.middleware.scheduling import (
        ExecutionRule,
        ExecutorRule,
        SchedulingPlan,
    )

    rules = []
    if job.execution is not None:
        for spec in job.execution.entities:
            rules.append(ExecutionRule(spec.node, spec.entity, make_distribution(job, spec)))
        for name, by_node in job.execution.nodes.items():
            rules.append(ExecutionRule(name, None, make_distribution(job, by_node)))
        if job.execution.default is not None:
            rules.append(ExecutionRule("*", None, make_distribution(job, job.execution.default)))
    return SchedulingPlan(
        policy=policy or policy_of_job(job, start_ns),
        executors=tuple(ExecutorRule(spec.nodes, spec.workers) for spec in job.executors or ()),
        occupies=job.executors is not None or job.execution is not None,
        execution=tuple(rules),
        seed=job.seed,
        start_ns=start_ns,
    )


def policy_of_job(job: Job, start_ns: int) -> ExecutionPolicy:
    """Return the policy of a job, at its beginning.

    :raises JobError: if the policy's class cannot be made.
    """
    spec = job.policy
    if spec is None:
        return Fifo()
    policy = _policy(job, spec)
    if spec.after_ns is None or isinstance(policy, Fifo | Departures):
        return policy
    return FifoUntil(start_ns + spec.after_ns, policy)


def continued_policy(policy: ExecutionPolicy, before: ExecutionPolicy) -> ExecutionPolicy:
    """Return a policy that goes on in the middle of a run, in the place of another one."""
    if isinstance(policy, Departures) and isinstance(before, Departures):
        policy.choices = before.choices
    return policy


def _policy(job: Job, spec: PolicySpec) -> ExecutionPolicy:
    seed = job.seed if spec.seed is None else spec.seed
    if spec.order is not None:
        policy = policy_named(spec.order, seed)
        assert policy is not None, "the job has been checked"
        return policy
    if spec.priority is not None:
        rules = [PriorityRule(r.priority, r.node, r.entity, r.group_of) for r in spec.priority]
        return Priority(rules)
    if spec.departures is not None:
        return Departures(Departure(one.choice, one.run, one.of) for one in spec.departures)
    if spec.pct is not None:
        return Pct(RandomStream(seed, "pct"), spec.pct.depth, spec.pct.choices)
    if spec.function is not None:
        return user_policy(spec.function, locate(job, ("policy", "function")))
    return Fifo()


def unmet_departures(job: Job, policy: ExecutionPolicy) -> Iterator[str]:
    """Yield the departures that a run has not come to, which had so few choices."""
    if job.policy is None or not isinstance(policy, Departures):
        return
    unmet = frozenset(policy.unmet())
    for index, one in enumerate(job.policy.departures or ()):
        if one.choice in unmet:
            yield (
                f"{locate(job, ('policy', 'departures', index, 'choice'))}: there was no choice "
                f"{one.choice}: the run had {policy.choices}"
            )


def policy_named(order: str, seed: int) -> ExecutionPolicy | None:
    """Return the policy that a job calls by a word alone, None if there is none of that name."""
    if order == "permutation":
        return Permutation(RandomStream(seed, "permutation"))
    makers: dict[str, Callable[[], ExecutionPolicy]] = {
        "fifo": Fifo,
        "rate_monotonic": RateMonotonic,
        "wait_set": RclcppWaitSetPolicy,
        "rclpy": RclpyWaitSetPolicy,
    }
    return makers[order]() if order in makers else None


def user_policy(function: Any, where: str) -> ExecutionPolicy:
    """Make a policy of the user's own.

    :raises JobError: beginning with ``where``, if there is no such class, or it is no policy.
    """
    if isinstance(function, str):
        function = load_target(function, where=where)
    try:
        policy: Any = function()
    except Exception as error:
        raise JobError(
            f"the policy cannot be made: {type(error).__qualname__}: {error}", where=where
        ) from error
    if not callable(getattr(policy, "choose", None)):
        raise JobError(
            f"a {type(policy).__qualname__} has no method choose(ready, moment): see "
            "docs/policies.md",
            where=where,
        )
    return policy  # type: ignore[no-any-return]


def stop_with(world: World, entries: Sequence[JobEntry]) -> None:
    """Let the run end when an entry has ended that is required."""
    required = {entry.key for entry in entries if entry.required}
    loop = world.domain.loop

    def program_changed(what: str, key: str) -> None:
        if what == "ended" and key in required and loop.stopped is None:
            loop.stop(Stop(f"{key} has ended, which the run requires"))

    if required:
        world.runtime.programs.listeners.append(program_changed)
