"""Notes on rules of a job that had no effect: they name a topic, service or node that never
existed; and on messages that full queues dropped.

ROS ignores such rules, and so does a run. Names that nodes create after the end of a run are not
seen, so these are notes, not errors.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase

from rsltrace.adapters.rclpy.arguments import RosArguments
from rsltrace.adapters.rclpy.handles.node import Parameters
from rsltrace.errors import did_you_mean
from rsltrace.job import Job, locate
from rsltrace.job.values.problem import Loc
from rsltrace.run.plans.entries import entry_keys
from rsltrace.run.stop_rules import given_rules
from rsltrace.simulation.chance.channel import QUIET_TOPICS, NetworkPlan
from rsltrace.simulation.middleware.entity import Receiver
from rsltrace.simulation.middleware.events.event import NameRegistry, NameRequester
from rsltrace.simulation.middleware.qos.policies import Durability
from rsltrace.simulation.middleware.subscription import Subscription
from rsltrace.trace.model.finding import QueueDrops
from rsltrace.trace.model.operation import NODE_SERVICES
from rsltrace.trace.model.texts import format_duration

_TOLD = 5

Counts = Mapping[tuple[Receiver, int], int]
"""How many, by receiver, and by how many messages a publisher holds in an outage if its queue was
the full one (else 0)."""


def queue_drops(counts: Counts) -> list[QueueDrops]:
    """Return the drops of full queues, ordered by entity."""
    found = [
        QueueDrops(receiver.entity_id, held or receiver.keep or 0, count, in_outage=held > 0)
        for (receiver, held), count in counts.items()
    ]
    return sorted(found, key=lambda one: (one.entity, one.in_outage))


def drop_notes(counts: Counts) -> list[str]:
    """Return one note that names the queues that dropped most.

    Who asks for the latest value alone, as an action client does of its goals' status, gets it.
    """
    lost = (item for item in counts.items() if item[0][1] or not _wants_the_latest(item[0][0]))
    most = sorted(lost, key=lambda item: (-item[1], item[0][0].entity_id))
    if not most:
        return []
    parts = [
        f"{receiver.describe()} {count} (depth {held or receiver.keep}"
        f"{', of a publisher in an outage' if held else ''})"
        for (receiver, held), count in most[:_TOLD]
    ]
    if len(most) > _TOLD:
        parts.append(f"{len(most) - _TOLD} more (rsltrace info lists them)")
    return [f"full queues dropped their oldest messages: {'; '.join(parts)}"]


def _wants_the_latest(receiver: Receiver) -> bool:
    latched = (
        isinstance(receiver, Subscription) and receiver.qos.durability is Durability.TRANSIENT_LOCAL
    )
    return latched and receiver.keep == 1


# rcl itself applies the rules, so their forms (`~/x`, `node:x`, `rosservice://x`) mean what they do
# in a run.

_USUAL = frozenset(("/tf", "/tf_static", "tf", "tf_static"))
"""Launch files remap these for every node (to give robots trees of their own), used or not."""

_ELSEWHERE = "/rsltrace/elsewhere"


def has_remappings(job: Job) -> bool:
    return bool(job.ros_arguments) or any(spec.remappings for spec in job.nodes)


def unused_remappings(job: Job, census: NameRegistry) -> Iterator[str]:
    """Yield the remappings of ``nodes`` and ``ros_arguments`` without effect.

    A remapping given to several nodes (``<set_remap>``, a YAML anchor) is used if one node uses it.
    """
    everybody: list[NameRequester] = []
    given: dict[tuple[str, str], tuple[str, list[NameRequester]]] = {}
    asked_by: dict[str, list[NameRequester]] = {}
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
            yield f"{place}: {_remapping_note(old, askers, census)}"
    for index, old in _rules(job.ros_arguments):
        if not _is_used(old, everybody, census):
            place = locate(job, ("ros_arguments", index))
            yield f"{place}: {_remapping_note(old, everybody, census)}"


def _rules(words: tuple[str, ...]) -> Iterator[tuple[int, str]]:
    """Yield (index, replaced name) of the remappings among ROS arguments."""
    for index, word in enumerate(words[1:], start=1):
        if words[index - 1] in ("-r", "--remap"):
            yield index, word.partition(":=")[0]


def _is_used(old: str, askers: Iterable[NameRequester], census: NameRegistry) -> bool:
    bare = old.rpartition(":")[2]
    if bare.startswith("__") or bare in _USUAL:
        return True
    rule = RosArguments(["--ros-args", "-r", f"{old}:={_ELSEWHERE}"])
    return any(
        rule.remap_topic(name, asker.name, asker.namespace, None, service=service) == _ELSEWHERE
        for asker in askers
        for name, service in census.asked[asker]
    )


def _forms(name: str, asker: NameRequester) -> list[str]:
    """Return the names by which a rule may refer to the full name ``name``."""
    folder = asker.namespace.rstrip("/") + "/"
    return [name, name.removeprefix(folder)] if name.startswith(folder) else [name]


def _remapping_note(old: str, askers: list[NameRequester], census: NameRegistry) -> str:
    names = [
        form for asker in askers for name, _ in census.asked[asker] for form in _forms(name, asker)
    ]
    advice = did_you_mean(old, names)
    who = ", ".join(f"{asker.namespace.rstrip('/')}/{asker.name}" for asker in askers[:3])
    who += ", …" if len(askers) > 3 else ""
    return f"nothing of {who or 'any node'} is called {old!r}, so nothing is remapped{advice}"


def has_rules(job: Job) -> bool:
    """Return whether a job has rules that might fit nothing."""
    parts = (job.delay, job.execution, job.executors, job.policy, *_stop_topics(job))
    return bool(
        any(part is not None for part in parts)
        or job.clocks
        or job.faults
        or has_remappings(job)
        or any(_record_globs(job))
    )


def unused_rules(
    job: Job, census: NameRegistry, plan: NetworkPlan | None, lasted_ns: int | None = None
) -> Iterator[str]:
    """Yield the names in a job's rules that did not exist; ``lasted_ns`` is the run's duration."""
    topics = [*census.topics, *QUIET_TOPICS]
    nodes = list(census.nodes)
    for place, glob, names, what in _single(job, topics, list(census.services), nodes):
        if not _fits(glob, names):
            other, others = (
                ("topics", topics) if what == "service" else ("services", census.services)
            )
            if what != "node" and _fits(glob, others):
                yield f"{locate(job, place)}: {glob!r} fits {other} only: name it as such"
            else:
                yield _note(job, place, what, glob, names)
    for rule in plan.table if plan is not None else ():
        if rule.name not in topics:
            yield f"{rule.where}: no topic is called {rule.name!r}{_suggestion(rule.name, topics)}"
    for place, glob in _record_globs(job):
        names = [*topics, *census.services]
        if not _fits(glob, names):
            yield _note(job, place, "topic or service", glob, names)
    yield from unused_remappings(job, census)
    yield from _links(job, census)
    yield from _entities(job, census)
    yield from _hidden(job, nodes)
    if job.delay is not None and lasted_ns is not None:
        for index, outage in enumerate(job.delay.outages):
            if outage.from_ns > lasted_ns:
                yield (
                    f"{locate(job, ('delay', 'outages', index, 'from'))}: this outage begins "
                    f"{format_duration(outage.from_ns)} after the start, the run lasted "
                    f"{format_duration(lasted_ns)}"
                )


def unused_parameters(job: Job, nodes: dict[str, Parameters], *, lasted: bool) -> Iterator[str]:
    """Yield the parameters of an entry that none of its nodes has declared.

    A parameter that a launch file gives to several nodes (``<set_parameter>``) need only be
    declared by one. Until the run has ``lasted``, unconfigured nodes are skipped: they may still
    declare it.
    """
    entries = []
    used_alike: set[tuple[str, str]] = set()
    made_by: dict[str, dict[str, Parameters]] = {}
    for node, found in nodes.items():
        made_by.setdefault(found.entry_key, {})[node] = found
    for index, (spec, key) in enumerate(zip(job.nodes, entry_keys(job.nodes), strict=True)):
        made = made_by.get(key, {})
        entries.append((index, spec, made))
        if spec.origin:
            declared_ones = {name for found in made.values() for name in found.declared}
            used_alike.update(
                (name, repr(v)) for name, v in spec.parameters.items() if name in declared_ones
            )
    for index, spec, made in entries:
        for name, value in spec.parameters.items():
            given = {node: found for node, found in made.items() if name in found.unused}
            if not given or any(name in found.declared for found in made.values()):
                continue
            if not lasted and any(found.unconfigured for found in given.values()):
                continue
            if spec.origin and (name, repr(value)) in used_alike:
                continue
            declared = [other for found in given.values() for other in found.declared]
            where = spec.origin or locate(job, ("nodes", index, "parameters", name))
            near = did_you_mean(name, declared)
            who = ", ".join(given)
            yield (
                f"{where}: {who} has not declared the parameter {name!r}, so it has no effect{near}"
            )


def unused_ros_parameters(
    job: Job, census: NameRegistry, nodes: dict[str, Parameters], *, lasted: bool
) -> Iterator[str]:
    """Yield the parameters among ``ros_arguments`` that no receiving node has declared.

    Unconfigured nodes are skipped as in ``unused_parameters``.
    """
    words = job.ros_arguments
    for index, word in enumerate(words[1:], start=1):
        if words[index - 1] not in ("-p", "--param"):
            continue
        arguments = RosArguments(["--ros-args", "-p", word])
        given = {name: list(arguments.parameters(name)) for name in census.nodes}
        name = next((found[0] for found in given.values() if found), None)
        place = locate(job, ("ros_arguments", index))
        if name is None:
            who = word.partition(":=")[0].rpartition(":")[0]
            yield f"{place}: no node is called {who!r}{_suggestion(who, list(census.nodes))}"
            continue
        who_gets = [node for node, found in given.items() if found]
        if any(node not in nodes or name in nodes[node].declared for node in who_gets):
            continue
        if not lasted and any(nodes[node].unconfigured for node in who_gets):
            continue
        near = did_you_mean(name, [other for node in who_gets for other in nodes[node].declared])
        who = ", ".join(who_gets[:3]) + (", …" if len(who_gets) > 3 else "")
        yield f"{place}: {who} has not declared the parameter {name!r}, so it has no effect{near}"


def _single(
    job: Job, topics: list[str], services: list[str], nodes: list[str]
) -> Iterator[tuple[Loc, str, list[str], str]]:
    """Yield (place, glob, candidates, kind) of the rules with one name."""
    if job.delay is not None:
        for glob in job.delay.topics:
            yield ("delay", "topics", glob), glob, topics, "topic"
        for glob in job.delay.services:
            yield ("delay", "services", glob), glob, services, "service"
        for index, outage in enumerate(job.delay.outages):
            kind, glob = outage.what
            names = {"topic": topics, "service": services, "node": nodes}[kind]
            yield ("delay", "outages", index, kind), glob, names, kind
    if job.execution is not None:
        for glob in job.execution.nodes:
            yield ("execution", "nodes", glob), glob, nodes, "node"
    for index, executor in enumerate(job.executors or ()):
        for number, glob in enumerate(executor.nodes):
            yield ("executors", index, "nodes", number), glob, nodes, "node"
    for index, fault in enumerate(job.faults):
        what = (nodes, "node") if fault.of_node else (topics, "topic")
        yield ("faults", index, fault.kind), fault.name, *what
        if fault.topic is not None:
            yield ("faults", index, "topic"), fault.topic, topics, "topic"
        if fault.to is not None:
            yield ("faults", index, "to"), fault.to, nodes, "node"
    for index, clock in enumerate(job.clocks):
        yield ("clocks", index, "node"), clock.node, nodes, "node"
    for key, topic in _stop_topics(job):
        yield ("stop", key, "name"), topic, topics, "topic"


def _stop_topics(job: Job) -> list[tuple[str, str]]:
    given = ((key, rule.topic(value)) for key, value, rule in given_rules(job))
    return [(key, topic) for key, topic in given if topic is not None]


def _record_globs(job: Job) -> Iterator[tuple[Loc, str]]:
    """Yield (place, glob) of what the trace keeps, except globs that begin with ``*`` or stand in a
    shared file: they are meant for other jobs, too."""
    for key, globs in (("topics", job.record.topics), ("exclude", job.record.exclude)):
        for index, glob in enumerate(globs):
            loc: Loc = ("record", key, index)
            is_own = locate(job, loc).startswith((f"{job.source_name}:", "--"))
            if is_own and not glob.startswith("*"):
                yield loc, glob


def _links(job: Job, census: NameRegistry) -> Iterator[str]:
    for index, link in enumerate(job.delay.links if job.delay is not None else ()):
        place: Loc = ("delay", "links", index)
        if not _fits(link.topic, census.topics):
            yield _note(job, (*place, "topic"), "topic", link.topic, list(census.topics))
            continue
        for key, glob, ends, what in (
            ("from", link.sender, census.publishers, "publishes"),
            ("to", link.receiver, census.subscriptions, "subscribes"),
        ):
            there = [node for node, topic in ends if fnmatchcase(topic, link.topic)]
            if not _fits(glob, there):
                near = did_you_mean(glob, there) or _available(there)
                yield (
                    f"{locate(job, (*place, key))}: no node that fits {glob!r} {what} "
                    f"{link.topic!r}{near}"
                )


def _entities(job: Job, census: NameRegistry) -> Iterator[str]:
    """Yield the unmatched rules for entities, in ``execution`` and ``policy``."""
    rules: list[tuple[Loc, str, str, str | None]] = []
    if job.execution is not None:
        for index, spec in enumerate(job.execution.entities):
            rules.append((("execution", "entities", index), spec.node, "entity", spec.entity))
    priority = job.policy.priority if job.policy is not None else None
    for index, rule in enumerate(priority or ()):
        key = "group_of" if rule.group_of is not None else "entity"
        rules.append((("policy", "priority", index), rule.node, key, rule.group_of or rule.entity))
    for place, node, key, entity in rules:
        if not _fits(node, census.nodes):
            yield _note(job, (*place, "node"), "node", node, list(census.nodes))
        elif entity is not None:
            names = [name for owner, name in census.entities if fnmatchcase(owner, node)]
            if not _fits(entity, names):
                near = did_you_mean(entity, names) or _available(names)
                yield (
                    f"{locate(job, (*place, key))}: no topic, service or timer's callback of "
                    f"{node!r} fits {entity!r}{near}"
                )


def _hidden(job: Job, nodes: list[str]) -> Iterator[str]:
    """Yield the clocks and executors whose nodes all match an earlier entry."""
    clocks = [(("clocks", i), (spec.node,)) for i, spec in enumerate(job.clocks)]
    executors = [(("executors", i), spec.nodes) for i, spec in enumerate(job.executors or ())]
    for entries in (clocks, executors):
        taken: set[str] = set()
        for place, globs in entries:
            fitting = {node for node in nodes if any(fnmatchcase(node, glob) for glob in globs)}
            if fitting and fitting <= taken:
                yield f"{locate(job, place)}: every node that it fits has an earlier entry"
            taken |= fitting


def _fits(glob: str, names: Iterable[str]) -> bool:
    return any(fnmatchcase(name, glob) for name in names)


def _note(job: Job, place: Loc, what: str, glob: str, names: list[str]) -> str:
    return f"{locate(job, place)}: no {what} fits {glob!r}{_suggestion(glob, names)}"


def _suggestion(name: str, names: list[str]) -> str:
    return did_you_mean(name, names) or _available(names)


def _available(names: Iterable[str]) -> str:
    usual = (*QUIET_TOPICS, *NODE_SERVICES)
    found = sorted({name for name in names if name and not name.endswith(usual)})
    shown = ", ".join(found[:5]) + (", …" if len(found) > 5 else "")
    return f" (there are {shown})" if found else ""
