"""Entries that start after others: which entry is meant, and orders that cannot be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rsltrace.errors import did_you_mean
from rsltrace.job.fields import JobFields
from rsltrace.job.parts.node import NodeSpec
from rsltrace.job.values.problem import JobProblem


def entry_meant(nodes: Sequence[NodeSpec], reference: str | int) -> int:
    """Return the place in ``nodes:`` of the entry with a name, a target or a number.

    :raises Problem: if there is none, or more than one.
    """
    if isinstance(reference, int):
        if reference < len(nodes):
            return reference
        raise JobProblem(f"there are {len(nodes)} entries, counted from 0: there is no {reference}")
    found = [index for index, spec in enumerate(nodes) if reference in _names(spec)]
    if len(found) == 1:
        return found[0]
    if found:
        places = ", ".join(map(str, found))
        raise JobProblem(
            f"several entries are called {reference!r}: give one of them a name, or write its "
            f"number in the list ({places})"
        )
    names = [name for spec in nodes for name in _names(spec)]
    hint = did_you_mean(reference, names, f"there are {', '.join(names)}")
    raise JobProblem(f"no entry of nodes is called {reference!r}: {hint}")


def _names(spec: NodeSpec) -> list[str]:
    """Return what an entry is called: its target, its name, its name in full."""
    if spec.name is None:
        return [spec.target]
    return [spec.target, spec.name, f"{(spec.namespace or '').rstrip('/')}/{spec.name}"]


def start_problems(job: JobFields) -> Iterator[JobProblem]:
    """Yield the starts that wait for what is not there, or never comes."""
    waits_for: dict[int, dict[str, int]] = {}
    for index, spec in enumerate(job.nodes):
        for key in ("started", "ended"):
            reference = None if spec.start_after is None else getattr(spec.start_after, key)
            if reference is None:
                continue
            place = ("nodes", index, "start_after", key)
            try:
                other = entry_meant(job.nodes, reference)
            except JobProblem as problem:
                if not job.launch:  # else it may be an entry of a launch file
                    yield JobProblem(problem.message, place)
                continue
            waits_for.setdefault(index, {})[key] = other
            if key == "ended" and job.nodes[other].node is not None:
                yield JobProblem(
                    f"{job.nodes[other].target} (nodes[{other}]) never ends: a 'node' lasts as "
                    "long as the run, only a main, executable, script or module ends",
                    place,
                )
    yield from _circles(waits_for)


def _circles(waits_for: dict[int, dict[str, int]]) -> Iterator[JobProblem]:
    reported: set[int] = set()
    for first, after in waits_for.items():
        for key in after:
            path, at = [first], after[key]
            while at not in path and at in waits_for:
                path.append(at)
                at = next(iter(waits_for[at].values()))
            if at == first and not reported & set(path):
                reported.update(path)
                way = " → ".join(f"nodes[{index}]" for index in [*path, first])
                yield JobProblem(
                    f"it waits for itself, and never starts: {way}",
                    ("nodes", first, "start_after", key),
                )
