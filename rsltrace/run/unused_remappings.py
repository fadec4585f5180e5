"""Remappings of a job that remap nothing: no node has asked for the name that they replace.

rcl itself is asked what a rule does to a name, so its forms (`~/x`, `node:x`, `rosservice://x`)
mean here what they mean in a run.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rsltrace.adapters.rclpy.arguments import RosArguments
from rsltrace.errors import did_you_mean
from rsltrace.job import Job, locate
from rsltrace.job.values.problem import Loc
from rsltrace.run.plans.entries import entry_keys
from rsltrace.simulation.middleware.events.census import Asker, Census

_USUAL = frozenset(("/tf", "/tf_static", "tf", "tf_static"))
"""Launch files remap these for every node (to give robots trees of their own), used or not."""

_ELSEWHERE = "/rsltrace/elsewhere"


def has_remappings(job: Job) -> bool:
    """Say whether a job has remappings that might remap nothing."""
    return bool(job.ros_arguments) or any(spec.remappings for spec in job.nodes)


def unused_remappings(job: Job, census: Census) -> Iterator[str]:
    """Yield the remappings of ``nodes`` and ``ros_arguments`` that had nothing to do.

    What several nodes are given alike (``<set_remap>`` of a launch file, an anchor of YAML) has
    something to do if one of them uses it.
    """
    everybody: list[Asker] = []
    given: dict[tuple[str, str], tuple[str, list[Asker]]] = {}
    asked_by: dict[str, list[Asker]] = {}
    for asker in census.asked:
        asked_by.setdefault(asker.entry_key, []).append(asker)
    for index, (spec, key) in enumerate(zip(job.nodes, entry_keys(job.nodes), strict=True)):
        own = [] if spec.component is not None else asked_by.get(key, [])
        everybody += own  # nodes of hooks, of callbacks and the bag player get no arguments
        for old, new in spec.remappings.items() if own else ():
            loc: Loc = ("nodes", index, "remappings", old)
            given.setdefault((old, new), (spec.origin or locate(job, loc), []))[1].extend(own)
    for (old, _), (place, askers) in given.items():
        if not _is_used(old, askers, census):
            yield f"{place}: {_note(old, askers, census)}"
    for index, old in _rules(job.ros_arguments):
        if not _is_used(old, everybody, census):
            yield f"{locate(job, ('ros_arguments', index))}: {_note(old, everybody, census)}"


def _rules(words: tuple[str, ...]) -> Iterator[tuple[int, str]]:
    """Yield (index, name to be replaced) of the remappings among ROS arguments."""
    for index, word in enumerate(words[1:], start=1):
        if words[index - 1] in ("-r", "--remap"):
            yield index, word.partition(":=")[0]


def _is_used(old: str, askers: Iterable[Asker], census: Census) -> bool:
    bare = old.rpartition(":")[2]
    if bare.startswith("__") or bare in _USUAL:
        return True
    rule = RosArguments(["--ros-args", "-r", f"{old}:={_ELSEWHERE}"])
    return any(
        rule.remap_topic(name, asker.name, asker.namespace, None, service=service) == _ELSEWHERE
        for asker in askers
        for name, service in census.asked[asker]
    )


def _forms(name: str, asker: Asker) -> list[str]:
    """Return how a rule may name what is called ``name`` in full."""
    folder = asker.namespace.rstrip("/") + "/"
    return [name, name.removeprefix(folder)] if name.startswith(folder) else [name]


def _note(old: str, askers: list[Asker], census: Census) -> str:
    names = [
        form for asker in askers for name, _ in census.asked[asker] for form in _forms(name, asker)
    ]
    advice = did_you_mean(old, names)
    who = ", ".join(f"{asker.namespace.rstrip('/')}/{asker.name}" for asker in askers[:3])
    who += ", …" if len(askers) > 3 else ""
    return f"nothing of {who or 'any node'} is called {old!r}, so nothing is remapped{advice}"
