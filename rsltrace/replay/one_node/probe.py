"""What a node subscribes to and publishes: seen by constructing it, in a run that ends at once."""

from __future__ import annotations

from dataclasses import dataclass

from rsltrace.errors import ReplayError, did_you_mean
from rsltrace.job import Job
from rsltrace.run.process import kept_process
from rsltrace.run.session import Session
from rsltrace.simulation.loop.stop import Stop


@dataclass(frozen=True, slots=True)
class Ends:
    """The entry of a job (its place in ``nodes:``) that makes a node, and the node's topics with
    their types."""

    node: str
    entry: int
    subscribed: dict[str, str]
    published: dict[str, str]


class _Probe(Session):
    """Constructs the entries of a job one by one, until one has made the node."""

    def find(self, node: str) -> Ends:
        """Return what there is to know of the node.

        :raises RunError: what went wrong in a constructor.
        """
        world, graph = self.world, self.world.domain.graph
        hooks = int(self.job.hooks.before is not None)
        found, place = None, -1
        with self._failures(), self._engaged():
            world.plan(self._entries, self.start_ns)
            while found is None and not self.ended and place + 1 < len(self._entries):
                place += 1
                world.construct(self._entries[place])
                found = graph.node_named(node)
        if world.error is not None:
            raise world.error
        if found is None:
            names = [one.fully_qualified_name for one in graph.nodes]
            hint = did_you_mean(node, names, f"its nodes are {', '.join(names)}")
            raise ReplayError(f"the job makes no node {node}: {hint}")
        return Ends(
            node,
            place - hooks,
            {one.topic: one.type_name for one in graph.subscriptions_of(found)},
            {one.topic: one.type_name for one in graph.publishers_of(found)},
        )


def ends_of(job: Job, node: str) -> Ends:
    """Construct the nodes of a job until ``node`` is there; return its topics.

    :raises ReplayError: no entry of the job makes it.
    :raises JobError, SetupError, RunError: its code cannot be loaded, or fails.
    """
    probe = _Probe(job, None)
    with kept_process(), probe:
        try:
            return probe.find(node if node.startswith("/") else f"/{node}")
        finally:
            probe.loop.stop(Stop("seen enough"))
            probe.finish()
