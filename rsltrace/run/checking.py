"""Check a job without running it: nodes are constructed, the loop never runs."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rsltrace.errors import JobError
from rsltrace.job import Job
from rsltrace.run.plans.bags import PLAYER
from rsltrace.run.plans.entries import impossible_starts
from rsltrace.run.plans.executables import executable_source
from rsltrace.run.process import RunCallbacks, preserved_process
from rsltrace.run.session import RunSession
from rsltrace.simulation.loop.stop import Stop

if TYPE_CHECKING:
    from rsltrace.simulation.middleware.overview import GraphOverview


_OF_MANY = frozenset(("tf", "tf_static", "diagnostics", "rosout", "parameter_events"))
"""Topics that many publish at once, whatever their namespace."""


@dataclass(frozen=True, slots=True)
class CheckedJob:
    """A job that could run: its start time (ns), graph and notes."""

    job: Job
    start_ns: int
    overview: GraphOverview
    notes: tuple[str, ...]
    unused: tuple[str, ...]
    """What in the job had nothing to do: it names what is not there."""
    interfaces: Mapping[str, str]
    """By the names of all topics and services, their interfaces."""

    @property
    def problems(self) -> tuple[str, ...]:
        return (*self.overview.problems, *self.unused)


def check_job(job: Job, *, everything: bool = False) -> CheckedJob:
    """Construct a job's nodes and return their graph (``everything``: with each node's default
    topics).

    :raises JobError, SetupError, BagError: the job cannot run.
    :raises RunError: a constructor raised.
    """
    from rsltrace.simulation.middleware.overview import graph_overview

    notes: list[str] = []
    observer = RunCallbacks(note=notes.append)
    with preserved_process(), RunSession(job, None, observer=observer) as session:
        session.whole_graph = True
        session.begin()
        if session.error is not None:
            error = session.error
            session.stop = session.stop or Stop("checked")
            session.finish()
            raise error
        world = session.world
        found = graph_overview(
            world.domain.graph,
            world.blocked(),
            everything=everything,
            follows=world.clocks.follows if world.clocks is not None else lambda node: False,
        )
        found = replace(found, problems=(*found.problems, *_played_and_published(found)))
        graph = world.domain.graph
        never = impossible_starts(session.job, graph, session.start_ns, session.end_ns)
        unused = (*session.unused(), *never)
        interfaces = {
            name: types[0]
            for name, types in (*graph.topic_names_and_types(), *graph.service_names_and_types())
        }
        session.stop = Stop("checked")
        session.finish()
        notes += _divisions_by_nothing(session.job)
        return CheckedJob(session.job, session.start_ns, found, tuple(notes), unused, interfaces)


def _divisions_by_nothing(job: Job) -> Iterator[str]:
    """Yield where nodes divide by the difference of two ROS times of one callback."""
    from rsltrace.guard.audit.audit import audit_job

    if any(clock.advances and clock.node == "*" for clock in job.clocks):
        return
    try:
        from rsltrace.adapters.workspace.installs import module_folders

        found = audit_job(
            job, lambda target, where: executable_source(target, where=where), module_folders
        ).found
    except JobError:  # made in Python: there is no source to look at
        return
    for one in found:
        if one.call.startswith("division by "):
            path = os.path.relpath(one.path, job.base_dir)
            yield f"{path}:{one.line}:{one.column}: {one.call}, which {one.does}"


def _played_and_published(found: GraphOverview) -> Iterator[str]:
    """Yield the topics that both a bag and a node publish."""
    for link in found.of_kind("topic"):
        nodes = list(dict.fromkeys(end.node for end in link.senders))
        others = [node for node in nodes if node != f"/{PLAYER}"]
        if len(others) < len(nodes) and others and link.name.rpartition("/")[2] not in _OF_MANY:
            yield (
                f"topic {link.name}: both a bag and {', '.join(others)} publish it; if that is "
                f"not intended: bags: [{{path: ..., exclude: [{link.name}]}}]"
            )
