"""Arm the faults of a job: of messages, by topic, and of nodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rsltrace.job import Job, locate
from rsltrace.job.parts.fault import FaultSpec
from rsltrace.simulation.middleware.interface import MessageFault, TopicFaults

if TYPE_CHECKING:
    from rsltrace.adapters.rclpy.faults import NodeFaults
    from rsltrace.adapters.rclpy.world import World
    from rsltrace.run.plans.bag_faults import BagFaults


def arm_topic_faults(faults: Sequence[FaultSpec], world: World) -> None:
    """Add faults of single messages: before the first node is made, or later where
    ``AllTopicFaults`` were there from the start."""
    by_topic: dict[str, list[MessageFault]] = {}
    for spec in faults:
        if spec.of_message:
            by_topic.setdefault(spec.name, []).append(_message_fault(spec))
    for topic, found in by_topic.items():
        world.domain.transport.faults.setdefault(topic, TopicFaults(())).add(found)


def arm_node_faults(job: Job, world: World, start_ns: int) -> NodeFaults | None:
    """Let nodes crash, hang or restart; None if the job has no such faults. Must be called before
    the first node is made."""
    if not any(spec.of_node for spec in job.faults):
        return None
    from rsltrace.adapters.rclpy.faults import NodeFault, NodeFaults

    faults = [
        NodeFault(
            spec.kind,
            spec.name,
            locate(job, ("faults", index)),
            spec.at_ns,
            spec.event,
            spec.topic or "",
            spec.message or 0,
            spec.for_ns,
        )
        for index, spec in enumerate(job.faults)
        if spec.of_node
    ]
    return NodeFaults(world, faults, start_ns)


def missed_faults(
    job: Job, world: World, nodes: NodeFaults | None, bags: BagFaults | None
) -> Iterator[str]:
    """Yield the faults that did not happen in a finished run."""
    for index, spec in enumerate(job.faults):
        if spec.of_bag and bags is None:
            where = locate(job, ("faults", index))
            yield f"{where}: this fault did not happen: no bag plays {spec.name}"
        if spec.of_message:
            faults = world.domain.transport.faults[spec.name]
            assert spec.message is not None
            if faults.reached < spec.message:
                times = "message" if faults.reached == 1 else "messages"
                yield (
                    f"{locate(job, ('faults', index))}: this fault did not happen: there were "
                    f"{faults.reached} {times} on {spec.name}"
                )
    for found in (nodes, bags):
        for where, why in found.missed() if found is not None else ():
            yield f"{where}: this fault did not happen: {why}"


def _message_fault(spec: FaultSpec) -> MessageFault:
    assert spec.message is not None
    return MessageFault(
        spec.message,
        spec.to or "*",
        is_lost=spec.drop is not None,
        late_ns=(spec.by_ns or 0) if spec.delay is not None else 0,
        copy_ns=(spec.by_ns or 0) if spec.duplicate is not None else -1,
    )
