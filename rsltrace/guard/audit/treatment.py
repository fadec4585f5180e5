"""What the guard does about a place in the sources: the job's, or that of the node that runs it.

A node may have a ``guard:`` of its own. Code at the top of a module runs under the job's, since no
node is there yet; what stands in a node's class runs under the node's; any other function under
that of each node whose imports lead to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rsltrace.guard.audit.calls import Place
from rsltrace.guard.audit.files import SourceFile, collect_modules
from rsltrace.guard.audit.model import Treatment
from rsltrace.guard.audit.rules import allowed
from rsltrace.guard.audit.scopes import Scope
from rsltrace.job import Job, policy_of
from rsltrace.trace.model.finding import Policy

_LEAST_SAFE_FIRST = (
    Treatment.NOTHING,
    Treatment.DETECTED,
    Treatment.RECORDED,
    Treatment.REFUSED,
    Treatment.PINNED,
    Treatment.VIRTUAL,
)


@dataclass
class _Group:
    """Nodes that are guarded alike.

    ``targets`` are theirs (``module:Class``, or scripts), ``files`` what these and their imports
    are.
    """

    policy: Policy
    whose: str
    targets: list[str | Path]
    files: frozenset[Path] = frozenset()


class GuardTreatment:
    """Says what is done about a place. ``policy`` is the job's, None if it has no guard at all."""

    def __init__(self, policy: Policy | None, groups: Sequence[_Group] = ()) -> None:
        self._policy = policy
        self._groups = groups

    @classmethod
    def of_job(
        cls, job: Job, targets: Sequence[str | Path], folders: Sequence[Path]
    ) -> GuardTreatment:
        """Return what the guards of a job and its nodes do; ``targets`` are those of the nodes."""
        if not job.guard.enabled:
            return cls(None)
        of_job = policy_of(job.guard)
        if all(spec.guard is None for spec in job.nodes):
            return cls(of_job)
        groups: list[_Group] = []
        for spec, target in zip(job.nodes, targets, strict=True):
            policy, whose = of_job, "the job"
            if spec.guard is not None:
                policy, whose = policy_of(job.guard, spec.guard), f"node {spec.name or spec.target}"
            group = next((one for one in groups if one.policy == policy), None)
            if group is None:
                groups.append(group := _Group(policy, whose, []))
            group.targets.append(target)
        for group in groups:
            names = [module_of(target) for target in group.targets if isinstance(target, str)]
            scripts = [target for target in group.targets if isinstance(target, Path)]
            reached, _ = collect_modules(names, scripts, folders)
            group.files = frozenset(one.path.resolve() for one in reached.files.values())
        return cls(of_job, groups)

    def of(self, source: SourceFile, place: Place) -> tuple[Treatment, str]:
        """Return the treatment of a place, and what that means; of several, the least safe."""
        groups = self._that_get_to(source, place)
        if not groups:
            return _done(source, place, self._policy, "the job")
        all_done = [_done(source, place, group.policy, group.whose) for group in groups]
        least = min(all_done, key=lambda done: _LEAST_SAFE_FIRST.index(done[0]))
        group = groups[all_done.index(least)]
        treatment, does = least
        other = next((done for done in all_done if done[0] is not treatment), None)
        if other is None:
            return least
        runs_in = "" if group.whose in does else f" when {group.whose} runs it"
        return treatment, f"{does}{runs_in} ({other[0].value} elsewhere)"

    def _that_get_to(self, source: SourceFile, place: Place) -> Sequence[_Group]:
        scope: Scope | None = source.module.scope_of(place.node)
        if scope is source.module.top or not self._groups:
            return ()
        while scope is not None and scope.parent is not source.module.top:
            scope = scope.parent
        name = f"{source.module.name}:{getattr(scope and scope.node, 'name', '')}"
        own = [group for group in self._groups if name in group.targets]
        path = source.path.resolve()
        return own or [group for group in self._groups if path in group.files]


def module_of(target: str) -> str:
    """Return the module of ``module:name``."""
    return target.partition(":")[0]


def _done(
    source: SourceFile, place: Place, policy: Policy | None, whose: str
) -> tuple[Treatment, str]:
    rule = place.rule
    globs = policy.allowed.get(rule.source, ()) if policy and rule.source else ()
    if allowed(source.module.name, globs):
        return Treatment.NOTHING, f"{whose} allows it to this module"
    return rule.treated(policy, whose)
