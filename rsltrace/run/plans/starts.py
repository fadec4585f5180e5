"""``start_after:`` of a job's entries that never comes true, or did not."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rsltrace.adapters.rclpy.components import load_service
from rsltrace.errors import did_you_mean
from rsltrace.job import Job, NodeSpec, locate
from rsltrace.job.values.problem import Loc
from rsltrace.run.plans.entries import entry_keys
from rsltrace.simulation.middleware.graph import Graph
from rsltrace.trace.model.texts import format_duration


def impossible_starts(job: Job, graph: Graph, start_ns: int, end_ns: int | None) -> Iterator[str]:
    """Yield the entries that will never start, as far as the graph of all entries tells.

    ``end_ns`` is when the run ends, if time ends it.
    """
    topics = [name for name, _ in graph.topic_names_and_types() if graph.publishers(name)]
    services = [name for name, _ in graph.service_names_and_types() if graph.services(name)]
    nodes = [node.fully_qualified_name for node in graph.nodes]
    for index, spec in enumerate(job.nodes):
        if spec.container is not None and load_service(spec.container) not in services:
            near = did_you_mean(spec.container, nodes)
            yield (
                f"{_where(job, index, 'container')}: {spec.target} is never loaded: there is no "
                f"container {spec.container}{near}"
            )
        after = spec.start_after
        if after is None:
            continue
        for key, names, nobody in (
            ("topic", topics, "nobody publishes {}"),
            ("service", services, "nobody serves {}"),
            ("node", nodes, "no entry makes a node {}"),
        ):
            name = getattr(after, key)
            if name is not None and name not in names:
                why = nobody.format(name) + did_you_mean(name, names)
                yield f"{_where(job, index, key)}: {spec.target} never starts: {why}"
        if end_ns is not None and start_ns + after.delay_ns > end_ns:
            yield (
                f"{_where(job, index, 'delay')}: {spec.target} never starts: that is "
                f"{format_duration(after.delay_ns)} after the start, and the run ends "
                f"{format_duration(end_ns - start_ns)} after it"
            )


def missed_starts(job: Job, missed: Iterable[tuple[str, list[str]]]) -> Iterator[str]:
    """Yield the entries (keys) that have not started in a run, and what they waited for."""
    keys = entry_keys(job.nodes)
    for key, unmet in missed:
        index = keys.index(key)
        spec = job.nodes[index]
        after = spec.start_after
        waited = [
            f"{name} {getattr(after, name, None) or _of_container(spec, name)}" for name in unmet
        ]
        if not waited:
            waited = [f"{format_duration(0 if after is None else after.delay_ns)} to pass"]
        place = _where(job, index, unmet[0] if unmet else "delay")
        yield f"{place}: {spec.target} has not started: it waited for {' and '.join(waited)}"


def _of_container(spec: NodeSpec, name: str) -> str:
    """Return what a component waits for without saying so."""
    assert spec.container is not None
    return load_service(spec.container) if name == "service" else "the component before it"


def _where(job: Job, index: int, key: str) -> str:
    spec = job.nodes[index]
    place: Loc = ("nodes", index, "start_after", key)
    if spec.container is not None and spec.start_after is None:
        place = ("nodes", index, "container")
    return spec.origin or locate(job, place)


__all__ = ["impossible_starts", "missed_starts"]
