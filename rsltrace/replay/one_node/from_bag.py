"""Run one node with the inputs from a recording of the real robot.

The run is that of a job with one entry and the bag, so its trace is an ordinary one. Its outputs
are compared with what the robot recorded on the same topics. A robot takes time where a simulation
takes none, so messages are matched by their header stamps, or else by their order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rsltrace.diff.options import DiffOptions
from rsltrace.errors import ReplayError, near_or_all
from rsltrace.job import BagSpec, Job, StopSpec
from rsltrace.replay.one_node.output_comparison import (
    Key,
    NodeOutput,
    NodeOutputs,
    output_changes,
    outputs_of_node,
)
from rsltrace.replay.one_node.result import NodeReplayResult
from rsltrace.replay.preparation import NOT_KEPT, ReplayOutput
from rsltrace.replay.verification import interruption
from rsltrace.run import run
from rsltrace.run.plans.bags import begins_with_header, check_type, never_plays
from rsltrace.run.process import preserved_process
from rsltrace.run.session import RunSession
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.event import NO_EVENT, NO_SEQUENCE, EventKind, Output, OutputKind
from rsltrace.trace.model.operation import NODE_TOPICS
from rsltrace.trace.reader import Trace
from rsltrace.trace.recordings import open_bag
from rsltrace.trace.recordings.playback import header_stamp_ns


@dataclass(frozen=True, slots=True)
class NodeTopics:
    """The topics of a node with their types, and its entry in ``nodes:``."""

    node: str
    entry: int
    subscribed: dict[str, str]
    published: dict[str, str]


class _NodeProbe(RunSession):
    """Constructs the entries of a job one by one until one has made the node."""

    def find(self, node: str) -> NodeTopics:
        """Return the node's topics.

        :raises RunError: a constructor failed.
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
            hint = near_or_all(node, (one.fully_qualified_name for one in graph.nodes))
            raise ReplayError(f"the job makes no node {node}{hint}")
        return NodeTopics(
            node,
            place - hooks,
            {one.topic: one.type_name for one in graph.subscriptions_of(found)},
            {one.topic: one.type_name for one in graph.publishers_of(found)},
        )


def node_topics(job: Job, node: str) -> NodeTopics:
    """Construct the nodes of a job until ``node`` exists; return its topics.

    :raises ReplayError: no entry of the job makes it.
    :raises JobError, SetupError, RunError: its code cannot be loaded, or fails.
    """
    probe = _NodeProbe(job, None)
    with preserved_process(), probe:
        try:
            return probe.find(node if node.startswith("/") else f"/{node}")
        finally:
            probe.loop.stop(Stop("seen enough"))
            probe.finish()


_NOT_OF_ROBOTS: dict[str, object] = {
    **dict.fromkeys(("delay", "policy", "executors", "execution")),
    **dict.fromkeys(("start_ns", "construct_time_ns", "progress")),
    "bags": (),
    "stop": StopSpec(),
}
"""Settings of a simulated robot; a recording of a real one already has their effects."""


class BagOutputs(NodeOutputs):
    """The messages of a bag on a node's topics, decoded with the types of a trace."""

    def __init__(self, trace: Trace) -> None:
        super().__init__(trace, [])
        self.puts: list[NodeOutput] = []
        self.data: list[bytes] = []

    def decoded(self, put: NodeOutput) -> object | None:
        channel = put.key[1]
        if not any(one.topic == channel for one in self.trace.channels.values()):
            return None
        return self.trace.decode(channel, self.data[put.place])


def replay_from_bag(
    job: Job,
    node: str,
    bags: Sequence[Path],
    *,
    options: DiffOptions | None = None,
    to: ReplayOutput = NOT_KEPT,
) -> NodeReplayResult:
    """Run one node of a job with inputs from bags; compare its outputs.

    :raises ReplayError: the job makes no such node, or the bags have no input for it.
    :raises JobError, SetupError, BagError, OutputError: the run cannot start or be written.
    :raises RunError: the node failed.
    """
    alone = job.with_values(**_NOT_OF_ROBOTS)
    ends = node_topics(alone, node)
    specs = tuple(_specs(bags, ends))
    nodes = (job.nodes[ends.entry],)
    job = alone.with_values(nodes=nodes, bags=specs)
    with to.place() as path:
        done = run(job, path, force=to.force, echo=to.echo, observer=to.observer)
        if done.error is not None:
            raise done.error
        place = done.path or path
        with Trace.open(place) as trace:
            here, there = _sides(trace, ends, bags)
            if interruption(done):
                there.puts = [put for put in there.puts if put.stamp_ns < done.end_ns]
            found = tuple(output_changes(there, here, options or DiffOptions()))
            inputs = sum(int((r["kind"] == EventKind.BAG).sum()) for r in trace.events())
    return NodeReplayResult(
        trace=", ".join(map(str, bags)),
        node=ends.node,
        inputs=inputs,
        compared=len(there.puts),
        changes=found,
        start_ns=done.start_ns,
        end_ns=done.end_ns,
        ended=done.stop_reason,
        path=to.kept(place),
        interrupted=interruption(done),
        notes=tuple(dict.fromkeys([*done.notes, *_notes(ends, there)])),
    )


def _specs(bags: Sequence[Path], ends: NodeTopics) -> Iterator[BagSpec]:
    """Yield the bags with the topics that the node subscribes to."""
    names: list[str] = []
    met = False
    for path in bags:
        with open_bag(path, recover=True, skip=never_plays) as bag:
            topics = {topic.name: topic.type_name for topic in bag.topics}
        names += topics
        wanted = [name for name in topics if name in ends.subscribed]
        for name in wanted:
            if topics[name] != ends.subscribed[name]:
                raise ReplayError(
                    f"{path}: {name} is {topics[name]}, and {ends.node} wants it as "
                    f"{ends.subscribed[name]}"
                )
        if wanted:
            met = True
            yield BagSpec(path=str(path.absolute()), topics=wanted)
    if not met:
        raise ReplayError(
            f"{', '.join(map(str, bags))}: nothing of what {ends.node} subscribes to "
            f"({', '.join(ends.subscribed) or 'nothing'}) is in there, only "
            f"{', '.join(dict.fromkeys(names))}; remappings in the job give topics other names"
        )


def _compared(ends: NodeTopics) -> list[str]:
    """Return the topics that probably only the node itself publishes."""
    return [t for t in ends.published if t not in (*NODE_TOPICS, *ends.subscribed)]


def _sides(trace: Trace, ends: NodeTopics, bags: Sequence[Path]) -> tuple[NodeOutputs, BagOutputs]:
    """Return the node's outputs, and the recorded ones on these topics."""
    recorded = BagOutputs(trace)
    headers: dict[str, bool] = {}
    for path in bags:
        with open_bag(path, recover=True, skip=never_plays) as bag:
            found = {topic.name for topic in bag.topics}
        wanted = [topic for topic in _compared(ends) if topic in found]
        if wanted:
            _read(path, wanted, recorded, headers)
    counts: dict[Key, int] = {}
    puts = []
    for put in outputs_of_node(trace, ends.node):
        if put.key[0] is OutputKind.MESSAGE and put.key[1] in headers:
            payload = trace.payload(put.output)
            data = b"" if payload is None else payload[2]
            at = _at(put.key, data, headers, counts)
            puts.append(NodeOutput(put.stamp_ns, put.key, put.place, put.output, at))
    return NodeOutputs(trace, puts), recorded


def _read(path: Path, topics: list[str], side: BagOutputs, headers: dict[str, bool]) -> None:
    from rsltrace.adapters.rclpy.messages.codec import codec_for

    counts: dict[Key, int] = {}
    with open_bag(path, topics=topics, recover=True, skip=never_plays) as bag:
        classes = [check_type(str(path), topic) for topic in bag.topics]
        for topic, cls in zip(bag.topics, classes, strict=True):
            headers[topic.name] = begins_with_header(cls)
        canonical = [codec_for(cls).canonical for cls in classes]
        for stamp_ns, index, raw in bag.messages():
            data = canonical[index](raw)
            key: Key = (OutputKind.MESSAGE, bag.topics[index].name)
            output = Output(NO_EVENT, 0, OutputKind.MESSAGE, hash64(data), NO_SEQUENCE)
            at = _at(key, data, headers, counts)
            side.puts.append(NodeOutput(stamp_ns, key, len(side.data), output, at))
            side.data.append(data)


def _at(key: Key, data: bytes, headers: dict[str, bool], counts: dict[Key, int]) -> int:
    """Return the stamp of a message's header, or else its number."""
    if headers[key[1]]:
        return header_stamp_ns(data)
    counts[key] = counts.get(key, -1) + 1
    return counts[key]


def _notes(ends: NodeTopics, there: NodeOutputs) -> Iterator[str]:
    both = [t for t in ends.published if t in ends.subscribed and t not in NODE_TOPICS]
    if both:
        yield (
            f"{ends.node} publishes and hears {', '.join(both)}: what was recorded there plays, "
            "its own messages among it, and nothing there is compared"
        )
    if not there.puts:
        topics = ", ".join(_compared(ends)) or "nothing"
        yield (
            f"the recording has nothing on what {ends.node} publishes ({topics}), so nothing was "
            "compared; -o keeps this run, and --node compares with it from then on"
        )
