"""A small pure simulator of a ROS graph that writes traces, and faults that can be planted in it.

Payloads are computed from state and input, so a fault spreads through a run exactly as far as it
would spread in a real one: through messages, services and the state of nodes. The rules of the
loop are rsltrace's: tasks aside, ready events first in first out, then due timers in the order of
deadline and creation. Nothing here imports rsltrace.diff.
"""

from __future__ import annotations

import random
import struct
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

from rsltrace.trace import writer as writer_module
from rsltrace.trace.chain import hash64
from rsltrace.trace.format import (
    ATTACHMENT_JOB,
    METADATA_ENVIRONMENT,
    METADATA_JOB,
    PREFIX_REQUEST,
    PREFIX_RESPONSE,
)
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind
from rsltrace.trace.recorder import Recorder
from rsltrace.trace.writer import TraceWriter

MS = 1_000_000
TYPE = "sim_msgs/msg/Value"
SCHEMA = "uint32 hops\nuint64 data\n"
_VALUE = struct.Struct("<4sIIQ")


def message(hops: int, data: int) -> bytes:
    return _VALUE.pack(b"\0\1\0\0", hops, 0, data)


def mix(*values: int) -> int:
    return hash64(b"".join(value.to_bytes(8, "little") for value in values))


@dataclass(frozen=True)
class Publication:
    """A callback publishes on ``topic`` (or calls the service of that name), if it feels like it:
    when the value it made is a multiple of ``every``."""

    topic: str
    every: int = 1
    call: bool = False


@dataclass(frozen=True)
class NodePlan:
    """A node. ``memory`` says what its state keeps: everything, the last input, or nothing."""

    name: str
    memory: str = "all"
    timers: tuple[tuple[int, tuple[Publication, ...]], ...] = ()
    subscriptions: tuple[tuple[str, tuple[Publication, ...]], ...] = ()
    services: tuple[str, ...] = ()
    draws: bool = False
    draws_at_start: bool = False
    hops_max: int = 4
    starts_ns: int = 0


@dataclass(frozen=True)
class Plan:
    """A job: nodes, what a bag plays (stamp, topic, value), how long it runs, the seed."""

    nodes: tuple[NodePlan, ...]
    bag: tuple[tuple[int, str, int], ...] = ()
    end_ns: int = 1_000 * MS
    seed: int = 0
    version: str = "1"
    job_heading: str = ""


@dataclass(frozen=True)
class Fault:
    """What goes wrong at event ``at`` (as the run without it numbers them).

    kind: ``bit`` (of output ``which``), ``state``, ``swap`` (with the ready event ``which`` places
    behind), ``drop``, ``extra`` (the delivery ``which`` again, before the event), ``late`` (a timer
    by ``delay_ns``), ``raise``.
    """

    kind: str
    at: int
    which: int = 0
    delay_ns: int = 0
    new_deadline: bool = False


@dataclass(frozen=True)
class Storage:
    """How a trace is laid out in its file, which no diff may depend on."""

    events_per_segment: int = 4096
    compression: str = "zstd"
    payloads: bool = True
    close: bool = True


@dataclass
class Logged:
    """One event as it happened, for choosing faults and for checking what a diff says of it."""

    index: int
    stamp_ns: int
    kind: EventKind
    entity: int
    node: str
    name: str
    outputs: int
    ready: list[tuple[int, bytes, tuple[int, int]]]
    due: int


@dataclass
class Node:
    plan: NodePlan
    id: int
    state: int = 0
    publishers: dict[str, int] = field(default_factory=dict)
    clients: dict[str, int] = field(default_factory=dict)
    draws: int = 0


# What waits to be run: kind, entity id, payload, cause.
Ready = tuple[EventKind, int, bytes, tuple[int, int]]


class Simulation:
    """Runs a plan, with faults, into a trace. ``log`` holds what happened."""

    def __init__(
        self, plan: Plan, path: Path, faults: tuple[Fault, ...] = (), storage: Storage = Storage()
    ) -> None:
        self.plan = plan
        self.log: list[Logged] = []
        self.deliveries: list[Ready] = []
        self._faults = {fault.at: fault for fault in faults}
        self._storage = storage
        self.path = path
        self._entities: dict[int, Entity] = {}
        self._nodes: list[Node] = []
        self._owner: dict[int, Node] = {}
        self._subscribers: dict[str, list[int]] = {}
        self._servers: dict[str, int] = {}
        self._actions: dict[int, tuple[Publication, ...]] = {}
        self._clients_of: dict[int, int] = {}
        self._ready: deque[Ready] = deque()
        self._timers: list[list[int]] = []  # deadline, order, entity, period, delay, delay shown
        self._channels: dict[str, int] = {}
        self._now = 0
        self._raised = False

    def run(self) -> Simulation:
        """Write the trace."""
        storage = self._storage
        with (
            mock.patch.object(writer_module, "EVENTS_PER_SEGMENT", storage.events_per_segment),
            TraceWriter(self.path, force=True, compression=storage.compression) as writer,
        ):
            self.recorder = Recorder(writer, keep_payload=lambda topic: storage.payloads)
            self._write_job(writer)
            for node in self.plan.nodes:
                if not node.starts_ns:
                    self._construct(node)
            self._loop()
            if not self._raised:
                self._shut_down()
            if storage.close:
                reason = "a node raised" if self._raised else f"time {self.plan.end_ns}"
                end_ns = self._now if self._raised else self.plan.end_ns
                writer.close(
                    result={
                        "start_time": "0",
                        "end_time": str(end_ns),
                        "stop_reason": reason,
                        "exit_code": "3" if self._raised else "0",
                    }
                )
            else:
                writer.flush()
        return self

    # -- construction ----------------------------------------------------------------------------

    def _write_job(self, writer: TraceWriter) -> None:
        # What a node is made of is in the job, as parameters would be.
        nodes = "".join(f"  - {node}\n" for node in self.plan.nodes)
        text = f"{self.plan.job_heading}seed: {self.plan.seed}\nnodes:\n{nodes}"
        writer.add_metadata(METADATA_JOB, {"name": "job.yaml", "resolved": "{}"})
        writer.add_metadata(METADATA_ENVIRONMENT, {"sim": self.plan.version})
        writer.add_attachment(ATTACHMENT_JOB, "application/yaml", text.encode())

    def _entity(self, kind: EntityKind, name: str, node: int | None, type_: str = "") -> int:
        entity_id = len(self._entities) + 1
        owner = entity_id if node is None else node
        entity = Entity(entity_id, owner, kind, name, type_, self._now, {})
        self._entities[entity_id] = entity
        self.recorder.entity(entity)
        return entity_id

    def _construct(self, plan: NodePlan) -> None:
        node = Node(plan, self._entity(EntityKind.NODE, plan.name, None, "sim"))
        self._nodes.append(node)
        topics = [p for _, ps in (*plan.timers, *plan.subscriptions) for p in ps]
        for publication in topics:
            if publication.call and publication.topic not in node.clients:
                client = self._entity(EntityKind.CLIENT, publication.topic, node.id, "sim/srv/V")
                node.clients[publication.topic] = client
                self._owner[client] = node
            elif not publication.call and publication.topic not in node.publishers:
                publisher = self._entity(EntityKind.PUBLISHER, publication.topic, node.id, TYPE)
                node.publishers[publication.topic] = publisher
        for topic, publications in plan.subscriptions:
            subscription = self._entity(EntityKind.SUBSCRIPTION, topic, node.id, TYPE)
            self._subscribers.setdefault(topic, []).append(subscription)
            self._actions[subscription] = publications
            self._owner[subscription] = node
        for service in plan.services:
            server = self._entity(EntityKind.SERVICE, service, node.id, "sim/srv/V")
            self._servers[service] = server
            self._owner[server] = node
        for period, publications in plan.timers:
            timer = self._entity(EntityKind.TIMER, "tick", node.id)
            self._actions[timer] = publications
            self._owner[timer] = node
            self._timers.append([self._now + period, timer, timer, period, 0, 0])
        if plan.draws_at_start:
            node.state = self._draw(node)
            self.recorder.output(OutputKind.LOG, node.id, node.state)
        self._end_event(EventKind.CONSTRUCT, 0, NO_EVENT, 0, 0)

    def _draw(self, node: Node) -> int:
        node.draws += 1
        return mix(self.plan.seed, hash64(node.plan.name.encode()), node.draws)

    def _stable(self, entity: int) -> int:
        """Return a number for an entity that does not depend on how many others there are."""
        node = self._owner[entity]
        first = node.id
        return mix(hash64(node.plan.name.encode()), entity - first)

    # -- the loop --------------------------------------------------------------------------------

    def _loop(self) -> None:
        bag = deque(self.plan.bag)
        if bag:
            self._player = self._entity(EntityKind.NODE, "/rosbag2_player", None)
            self._bag_publishers = {
                topic: self._entity(EntityKind.PUBLISHER, topic, self._player, TYPE)
                for topic in dict.fromkeys(topic for _, topic, _ in bag)
            }
            self._end_event(EventKind.CONSTRUCT, 0, NO_EVENT, 0, 0)
        late = deque(sorted((n for n in self.plan.nodes if n.starts_ns), key=_starts_ns))
        while not self._raised:
            due = [timer[0] + timer[4] for timer in self._timers] + ([bag[0][0]] if bag else [])
            due += [late[0].starts_ns] if late else []
            if not due or min(due) > self.plan.end_ns:
                return
            self._now = max(min(due), self._now)
            while late and late[0].starts_ns <= self._now:
                self._construct(late.popleft())
            while bag and bag[0][0] <= self._now:
                self._play(*bag.popleft()[1:])
            self._run_step()

    def _run_step(self) -> None:
        while not self._raised:
            fault = self._faults.get(self.recorder.index)
            if fault is not None and fault.kind == "extra":
                del self._faults[fault.at]
                self._ready.appendleft(self.deliveries[fault.which])
            if self._ready:
                if fault is not None and fault.kind == "swap":
                    ready = self._ready
                    ready[0], ready[fault.which] = ready[fault.which], ready[0]
                entry = self._ready.popleft()
                if fault is not None and fault.kind == "drop":
                    del self._faults[fault.at]
                    continue
                self._deliver(entry)
                continue
            due = sorted(t for t in self._timers if t[0] + t[4] <= self._now)
            if not due:
                return
            timer = due[0]
            if fault is not None and fault.kind == "swap":
                timer = due[fault.which]
            if fault is not None and fault.kind == "late":
                del self._faults[fault.at]
                timer[4:] = fault.delay_ns, int(fault.new_deadline)
                continue
            self._fire(timer)

    def _fire(self, timer: list[int]) -> None:
        deadline, _, entity, period, delay, shown = timer
        self._log(EventKind.TIMER, entity, len([t for t in self._timers if t[0] <= self._now]))
        timer[0] = deadline + period
        timer[4:] = 0, 0
        node = self._owner[entity]
        who = self._stable(entity)
        value = mix(node.state if node.plan.memory != "none" else deadline, who)
        if node.plan.draws:
            value = mix(value, self._draw(node))
        self._act(node, entity, value, 0)
        self._end_event(EventKind.TIMER, entity, NO_EVENT, 0, mix(deadline + delay * shown))

    def _play(self, topic: str, value: int) -> None:
        publisher = self._bag_publishers[topic]
        data = message(0, value)
        self._log(EventKind.BAG, publisher, 0)
        self._send(OutputKind.MESSAGE, publisher, topic, data)
        self._end_event(EventKind.BAG, publisher, NO_EVENT, 0, hash64(data))

    def _deliver(self, entry: Ready) -> None:
        kind, entity, data, cause = entry
        self._log(kind, entity, 0, entry)
        node = self._owner[entity]
        _, hops, _, value = _VALUE.unpack(data)
        who = self._stable(entity)
        made = mix(node.state if node.plan.memory != "none" else 0, who, value)
        if kind is EventKind.SERVICE:
            answer = self._bent(message(hops + 1, made))
            position = self._output(OutputKind.RESPONSE, entity, answer)
            client = self._clients_of.pop(cause[0] << 32 | cause[1], 0)
            if client:
                here = (self.recorder.index, position)
                self._ready.append((EventKind.CLIENT, client, answer, here))
        elif kind is EventKind.SUBSCRIPTION:
            self._act(node, entity, made, hops + 1)
        if node.plan.memory == "all":
            node.state = mix(node.state, value, who)
        elif node.plan.memory == "last":
            node.state = value
        self._end_event(kind, entity, *cause, hash64(data))

    def _act(self, node: Node, entity: int, value: int, hops: int) -> None:
        """Do what a callback does: publish and call, depending on a value."""
        if hops > node.plan.hops_max:
            return
        for number, publication in enumerate(self._actions[entity]):
            data = mix(value, number)
            if data % publication.every:
                continue
            if publication.call:
                self._call(node.clients[publication.topic], publication.topic, message(hops, data))
            else:
                sender = node.publishers[publication.topic]
                self._send(OutputKind.MESSAGE, sender, publication.topic, message(hops, data))

    # -- outputs ---------------------------------------------------------------------------------

    def _send(self, kind: OutputKind, sender: int, topic: str, data: bytes) -> None:
        data = self._bent(data)
        position = self._output(kind, sender, data)
        for subscription in self._subscribers.get(topic, ()):
            here = (self.recorder.index, position)
            self._ready.append((EventKind.SUBSCRIPTION, subscription, data, here))

    def _call(self, client: int, service: str, data: bytes) -> None:
        data = self._bent(data)
        position = self._output(OutputKind.REQUEST, client, data)
        server = self._servers.get(service)
        if server is not None:
            here = (self.recorder.index, position)
            self._clients_of[here[0] << 32 | here[1]] = client
            self._ready.append((EventKind.SERVICE, server, data, here))

    def _bent(self, data: bytes) -> bytes:
        """Return the payload as a fault makes it: with one bit changed."""
        fault = self._faults.get(self.recorder.index)
        if fault is None or fault.kind != "bit" or fault.which != self.recorder.outputs:
            return data
        return data[:-1] + bytes([data[-1] ^ 0x40])

    def _output(self, kind: OutputKind, entity: int, data: bytes) -> int:
        name = self._entities[entity].name
        prefix = {OutputKind.REQUEST: PREFIX_REQUEST, OutputKind.RESPONSE: PREFIX_RESPONSE}
        topic = prefix.get(kind, "") + name
        channel = -1
        if self.recorder.keep_payload(topic):
            suffix = {OutputKind.REQUEST: "_Request", OutputKind.RESPONSE: "_Response"}
            type_ = self._entities[entity].type + suffix.get(kind, "")
            channel = self.recorder.writer.add_channel(topic, type_, SCHEMA)
        return self.recorder.message(kind, entity, channel, self._now, data, hash64(data))

    def _log(self, kind: EventKind, entity: int, due: int, entry: Ready | None = None) -> None:
        owner = self._owner.get(entity)
        self.log.append(
            Logged(
                self.recorder.index,
                self._now,
                kind,
                entity,
                owner.plan.name if owner is not None else "/rosbag2_player",
                self._entities[entity].name,
                0,
                [(e, d, c) for _, e, d, c in ([entry] if entry else []) + list(self._ready)],
                due,
            )
        )
        if entry is not None and kind is EventKind.SUBSCRIPTION:
            self.deliveries.append(entry)

    def _end_event(
        self, kind: EventKind, entity: int, cause: int, nth: int, input_hash: int
    ) -> None:
        flags = EventFlag.NONE
        fault = self._faults.get(self.recorder.index)
        if fault is not None and fault.kind == "raise":
            flags, self._raised = EventFlag.RAISED, True
            text = "Traceback (most recent call last):\nValueError: planted\n"
            self.recorder.detail(OutputKind.EXCEPTION, entity, self._now, text, hash64(b"planted"))
        if fault is not None and fault.kind == "state":
            self._owner[entity].state ^= 1
        if self.log and self.log[-1].index == self.recorder.index:
            self.log[-1].outputs = self.recorder.outputs
        self.recorder.end_event(self._now, kind, flags, entity, cause, nth, input_hash)

    def _shut_down(self) -> None:
        self._now = self.plan.end_ns
        for node in self._nodes:
            self._end_event(EventKind.SHUTDOWN, node.id, NO_EVENT, 0, 0)


def _starts_ns(node: NodePlan) -> int:
    return node.starts_ns


def random_plan(rng: random.Random) -> Plan:
    """Return a job with sources, fan-in and fan-out, services and feedback loops."""
    topics = [f"/t{i}" for i in range(rng.randint(2, 6))]
    services = [f"/s{i}" for i in range(rng.randint(0, 2))]
    nodes = []
    count = rng.randint(2, 6)
    for number in range(count):
        timers = tuple(
            (rng.choice((5, 10, 10, 15, 20, 50)) * MS, _publications(rng, topics, services))
            for _ in range(rng.choice((0, 1, 1, 2)) if number else 1)
        )
        subscriptions = tuple(
            (topic, _publications(rng, topics, services) if rng.random() < 0.6 else ())
            for topic in rng.sample(topics, rng.randint(0, min(3, len(topics))))
        )
        own = tuple(s for i, s in enumerate(services) if i % count == number)
        nodes.append(
            NodePlan(
                f"/n{number}",
                rng.choice(("all", "all", "last", "none")),
                timers,
                subscriptions,
                own,
                draws=rng.random() < 0.25,
                draws_at_start=rng.random() < 0.1,
                hops_max=rng.choice((1, 2, 3)),
                starts_ns=rng.choice((0, 0, 0, 20, 35, 60)) * MS if number else 0,
            )
        )
    bag = ()
    if rng.random() < 0.5:
        stamps = sorted(rng.randrange(300) * MS for _ in range(rng.randint(1, 60)))
        bag = tuple((stamp, rng.choice(topics), rng.getrandbits(64)) for stamp in stamps)
    return Plan(tuple(nodes), bag, rng.choice((100, 200, 400)) * MS, rng.randrange(1000))


def _publications(
    rng: random.Random, topics: list[str], services: list[str]
) -> tuple[Publication, ...]:
    chosen = [
        Publication(topic, rng.choice((1, 1, 2, 3)))
        for topic in rng.sample(topics, rng.randint(0, min(2, len(topics))))
    ]
    if services and rng.random() < 0.3:
        chosen.append(Publication(rng.choice(services), rng.choice((1, 2)), call=True))
    return tuple(chosen)
