"""Follow the order of a recording (``policy: {recorded: …}``), and record what that needs."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rsltrace.errors import JobError, TraceError
from rsltrace.job import Job, locate
from rsltrace.run.plans.scheduling import policy_named, user_policy
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.simulation.loop.loop import NOTHING_LEFT, EventLoop
from rsltrace.simulation.loop.ordered import OrderedLoop
from rsltrace.simulation.loop.policy import (
    Candidate,
    ChoicePoint,
    Departure,
    Departures,
    ExecutionPolicy,
    Fifo,
    FifoUntil,
    Pct,
    PolicyChoices,
    Priority,
    PriorityRule,
    decode_choices,
)
from rsltrace.simulation.loop.recorded_order import (
    CALLBACKS,
    THE_RUN,
    Message,
    NativeOrder,
    NativeOrderLoop,
    NativeStep,
    RecordedEvent,
    RecordedOrder,
    entity_text,
    event_text,
)
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.loop.wait_set import RclpyWaitSetPolicy
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.texts import Stamp, format_seconds
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.writer import TraceWriter

if TYPE_CHECKING:
    from rsltrace.simulation.middleware.domain import Domain
    from rsltrace.simulation.middleware.services import Client

ATTACHMENT_CHOICES = "rsltrace/choices"
"""What the policy of the run has chosen; see ``rsltrace.simulation.loop.policy``."""
ATTACHMENT_POLLS = "rsltrace/polls"
"""From when on executors had polling points, see ``OrderedLoop.polls``."""


def follow_recording(
    job: Job, domain: Domain, stack: ExitStack
) -> RecordedOrderObserver | NativeOrderObserver | None:
    """Let a run follow the order of a recording, if the job says so; the recording stays open as
    long as ``stack``.

    :raises JobError: the recording cannot be read, or has no events.
    """
    if job.policy is None or job.policy.recorded is None:
        return None
    trace = _opened(job, job.policy.recorded, stack)
    census = domain.entities.census
    assert census is not None, "a job with a policy has rules"
    file = Path(job.policy.recorded).name
    after_ns = job.policy.after_ns
    if is_native(trace):
        if after_ns is not None and after_ns >= last_ns(trace) - trace.start_ns:
            raise JobError(
                f"{file} ends at {format_seconds(last_ns(trace) - trace.start_ns)} s: give an "
                "earlier time",
                where=locate(job, ("policy", "after")),
            )
        return NativeOrderObserver(domain, trace, file, after_ns)
    if after_ns is not None:
        raise JobError(
            f"{file} is of a simulated run: only the order of a native run can be left at a time",
            where=locate(job, ("policy", "after")),
        )
    order = RecordedOrder(file, _EventCursor(trace).event, _chosen(trace), census.describe_all())
    from_ns = _polls_from_ns(trace)
    if from_ns is not None:
        order.poll_as(
            RclpyWaitSetPolicy() if from_ns < 0 else FifoUntil(from_ns, RclpyWaitSetPolicy())
        )
    return RecordedOrderObserver(domain.dispatcher, order, is_whole=trace.complete)


def _opened(job: Job, path: str, stack: ExitStack) -> Trace:
    where = locate(job, ("policy", "recorded"))
    try:
        trace = stack.enter_context(Trace.open(job.resolve(path)))
        trace.check()
    except TraceError as error:
        raise JobError(str(error), where=where) from None
    if trace.event_count == 0:
        raise JobError(
            f"{path} has no events to follow: it was cut off before the first was "
            "written (record.segment_events says how often that is)",
            where=where,
        )
    return trace


def remember_choices(loop: EventLoop) -> None:
    """Let a loop remember its policy's choices; FIFO needs none."""
    if isinstance(loop, OrderedLoop) and not isinstance(loop.policy, Fifo):
        loop.choices = PolicyChoices()


def write_choices(writer: TraceWriter, loop: EventLoop) -> None:
    """Write a policy's choices into the trace."""
    if isinstance(loop, OrderedLoop) and loop.choices:
        data = loop.choices.encoded()
        writer.add_attachment(ATTACHMENT_CHOICES, "application/octet-stream", data)
    policy = loop.policy if isinstance(loop, OrderedLoop) else None
    from_ns = getattr(policy, "polls_from_ns", None)
    if from_ns is not None:
        writer.add_attachment(ATTACHMENT_POLLS, "text/plain", str(from_ns).encode())


def _polls_from_ns(trace: Trace) -> int | None:
    """Return from when on the recorded executors polled, or None."""
    data = trace.attachment(ATTACHMENT_POLLS)
    if data is not None:
        return int(data)
    policy = (json.loads(trace.job.get("resolved") or "null") or {}).get("policy") or {}
    made = None if policy.get("after_ns") else policy_named(str(policy.get("order")), 0)
    return getattr(made, "polls_from_ns", None)  # it was cut off


def _chosen(trace: Trace) -> Callable[[Sequence[Candidate], ChoicePoint], int | None] | None:
    """Return the function that repeats the choices of the recording's policy, or None.

    An incomplete recording has no choices; its policy, made again, makes the same ones.
    """
    data = trace.attachment(ATTACHMENT_CHOICES)
    if data is not None:
        choices = decode_choices(data)
        return lambda ready, moment: next(choices, None) if len(ready) > 1 else 0
    resolved = json.loads(trace.job.get("resolved") or "null")
    if not isinstance(resolved, dict):
        return None
    policy = _same_policy(resolved.get("policy") or {"order": "fifo"}, int(resolved["seed"]))
    return None if policy is None else policy.choose


def _same_policy(spec: dict[str, Any], seed: int) -> ExecutionPolicy | None:
    """Return the policy of a resolved job, None if it cannot be made."""
    if spec.get("after_ns") is not None:
        return None  # where a run that was cut off began is not known
    seed = seed if spec.get("seed") is None else int(spec["seed"])
    if spec.get("priority") is not None:
        return Priority([PriorityRule(**rule) for rule in spec["priority"]])
    if spec.get("departures") is not None:
        return Departures([Departure(**one) for one in spec["departures"]])
    if spec.get("pct") is not None:
        return Pct(RandomStream(seed, "pct"), **spec["pct"])
    if spec.get("function") is not None:
        with suppress(JobError):
            return user_policy(spec["function"], "")
    return policy_named(str(spec.get("order")), seed)


class _EventCursor:
    """Reads the events of a recording once, in order."""

    def __init__(self, trace: Trace) -> None:
        self._following = _events(trace)
        self._next = 0
        self._present: RecordedEvent | None = None

    def event(self, index: int) -> RecordedEvent | None:
        """Return the event of an index, which must not decrease from call to call."""
        while self._next <= index:
            self._present = next(self._following, None)
            self._next += 1
        return self._present


def _events(trace: Trace) -> Iterator[RecordedEvent]:
    names, start_ns = {}, trace.start_ns
    for entity in trace.entities.values():
        node = trace.node_of(entity).name if entity.node else ""
        names[entity.id] = entity_text(entity, node)
    left = trace.event_count if trace.ended_after is None else trace.ended_after
    for rows in trace.events():
        for stamp, kind, entity_id in zip(
            rows["stamp"].tolist(), rows["kind"].tolist(), rows["entity"].tolist(), strict=True
        ):
            if left == 0 or kind == EventKind.SHUTDOWN:
                return
            left -= 1
            yield RecordedEvent(
                Stamp(stamp, start_ns), kind, entity_id, names.get(entity_id, THE_RUN)
            )


# Following a native run. Entities of both runs correspond by name, those of one name in the order
# of their creation; messages by their sender and number.

_SENT = frozenset(map(int, (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)))
_ENDPOINTS = (
    EntityKind.NODE,
    EntityKind.PUBLISHER,
    EntityKind.SUBSCRIPTION,
    EntityKind.SERVICE,
    EntityKind.CLIENT,
)


_ADDRESS = re.compile("[0-9a-f]{8,16}")


class EntityNames(dict[int, str]):
    """Unique names of entities, by their ids: those that a ``native`` run has for them, in which an
    address in the name of a node is another one (``tf2_ros::TransformListener``)."""

    def __init__(self, native: EntityNames | None = None) -> None:
        super().__init__()
        self.nodes: dict[int, str] = {}
        self._native = native
        self._counts: dict[str, int] = {}

    def add(self, entity: Entity) -> None:
        """Name an entity, in the order of their creation."""
        if entity.kind is EntityKind.NODE:
            entity = replace(entity, name=self._node(entity.name))
            self.nodes[entity.id] = entity.name
        name = entity_text(entity, self.nodes.get(entity.node, ""))
        count = self._counts[name] = self._counts.get(name, 0) + 1
        self[entity.id] = name if count == 1 else f"{name} ({count})"

    def _node(self, name: str) -> str:
        theirs = () if self._native is None else self._native.nodes.values()
        if name in theirs:
            return name
        shape, taken = _ADDRESS.sub("*", name), set(self.nodes.values())
        alike = (one for one in theirs if _ADDRESS.sub("*", one) == shape and one not in taken)
        return next(alike, name)


class NativeOrderObserver(EventObserver):
    """Lets a run follow a native one; nodes that are not in the run are played from the trace."""

    order = ObserverOrder.RECORDED_ORDER
    policy = None
    """What chooses in place of the job's policy."""

    def __init__(self, domain: Domain, trace: Trace, file: str, after_ns: int | None) -> None:
        """``after_ns``: how long after the start the run goes on by itself (None: never)."""
        self._domain, self._trace = domain, trace
        self._native = EntityNames()
        for entity in trace.entities.values():
            self._native.add(entity)
        self._names = EntityNames(self._native)
        self._sent: dict[int, int] = {}
        self._event, self._place = -1, 0
        self._playing: int | None = None
        self._not_kept: dict[str, int] = {}
        self._loop = loop = domain.loop
        assert isinstance(loop, NativeOrderLoop), "a job that follows a recording has one"
        end_ns = self._here(last_ns(trace)) if after_ns is None else loop.origin_ns + after_ns
        until = None if after_ns is None else format_seconds(after_ns)
        self._followed = loop.order = NativeOrder(file, end_ns + 1, self._names, until)
        domain.dispatcher.add_observer(self)

    def _here(self, native_ns: int) -> int:
        return native_ns - self._trace.start_ns + self._loop.origin_ns

    def entity_created(self, entity: Entity) -> None:
        self._names.add(entity)

    def output(self, kind: int, entity: int, content_hash: int) -> None:
        if self._event != self._loop.events:
            self._event, self._place = self._loop.events, 0
        if kind in _SENT:
            count = self._sent.get(entity, 0) + 1 if self._playing is None else self._playing
            self._followed.sent[self._event, self._place] = entity, count
            self._sent[entity] = count
        self._place += 1

    def begin(self, *, plays: bool) -> None:
        """Begin with the nodes that there are now; ``plays``: no others will come, and those that
        the native run has besides are played."""
        from rsltrace.adapters.stand_ins import StandIns

        self._stand_ins = StandIns(self._domain, self._definition)
        entities = self._trace.entities
        here = {self._names.nodes.get(node.entity_id) for node in self._domain.graph.nodes}
        absent = {
            one.id
            for one in entities.values()
            if plays and one.kind is EntityKind.NODE and one.name not in here
        }
        played = {one.id: one for one in entities.values() if {one.node, one.id} & absent}
        ends = [one for one in played.values() if one.kind in _ENDPOINTS]
        self._stand_ins.perform(ends, (), 0, self._client)
        known = dict.fromkeys(self._native.values(), 0)
        for outputs in self._trace.outputs():
            for entity in outputs["entity"][np.isin(outputs["kind"], list(_SENT))].tolist():
                known[self._native[entity]] += 1
        for step in self._followed.begin(self._steps(played), known):
            if step.perform is not None:
                self._loop.schedule(step.stamp_ns, step.perform)

    def _steps(self, played: Container[int]) -> Iterator[NativeStep]:
        """Yield the callbacks of nodes that run here, and what others sent."""
        trace, names = self._trace, self._native
        sent: dict[tuple[int, int], Message] = {}
        counts: dict[int, int] = {}
        for rows, outputs in zip(trace.events(), trace.outputs(), strict=True):
            to_play: dict[int, list[tuple[int, Message]]] = {}
            begun, place = -1, 0
            for event, entity, kind in _columns(outputs, "event", "entity", "kind"):
                begun, place = event, place + 1 if event == begun else 0
                if kind not in _SENT:
                    continue
                counts[entity] = counts.get(entity, 0) + 1
                sent[event, place] = message = names[entity], counts[entity]
                if entity in played:
                    to_play.setdefault(event, []).append((place, message))
            for index, stamp_ns, kind, entity, *cause, digest in _columns(rows, *_OF_EVENT):
                at_ns, got = self._here(stamp_ns), sent.get((cause[0], cause[1]))
                if index in to_play:
                    perform = partial(self._play, index, to_play[index], got)
                    yield NativeStep(index, at_ns, kind, "", perform=perform)
                if kind in CALLBACKS and entity not in played:
                    yield NativeStep(index, at_ns, kind, names[entity], got, digest)

    def _play(
        self, event: int, places: Sequence[tuple[int, Message]], request: Message | None
    ) -> None:
        """Send what a node that does not run here sent in an event, which ``request`` caused."""
        from rsltrace.adapters.stand_ins import Sent

        outputs = self._trace.outputs_of(event)
        for place, message in places:
            one = outputs[place]
            payload = self._trace.payload(one)
            if payload is None:
                self._not_kept[message[0]] = self._not_kept.get(message[0], 0) + 1
                continue
            data, answers = payload[2], None
            if one.kind is OutputKind.RESPONSE and request is not None:
                ids = (entity for entity, name in self._names.items() if name == request[0])
                answers = next(ids, 0), request[1]
            self._playing = message[1]
            sent = Sent(one.kind, one.entity, lambda data=data: data, one.hash, answers)  # type: ignore[misc]
            self._stand_ins.perform((), (sent,), 0, self._client)
            self._playing = None

    def _client(self, entity: int) -> Client | None:
        clients = self._domain.graph.all_clients()
        return next((one for one in clients if one.entity_id == entity), None)

    def _definition(self, type_name: str) -> tuple[str, str]:
        return definition_of(self._trace, type_name)

    def notes(self) -> Iterator[str]:
        yield from self._followed.notes()
        if self._not_kept:
            count, names = sum(self._not_kept.values()), ", ".join(self._not_kept)
            file = self._followed.file
            yield f"{file} does not hold {count} messages, which were not sent: {names}"


_OF_EVENT = ("index", "stamp", "kind", "entity", "cause_event", "cause_output", "input_hash")


def _columns(rows: npt.NDArray[np.void], *names: str) -> Iterator[tuple[int, ...]]:
    return zip(*(rows[name].tolist() for name in names), strict=True)


def last_ns(trace: Trace) -> int:
    """Return when the last callback of a native run began, or its end if that is later: processes
    do not end at once."""
    stamps = [rows["stamp"][np.isin(rows["kind"], list(CALLBACKS))] for rows in trace.events()]
    return max([trace.end_ns, *(int(one.max()) for one in stamps if len(one))])


def definition_of(trace: Trace, type_name: str) -> tuple[str, str]:
    """Return the definition and the type hash of an interface, empty where a trace has none."""
    for channel in trace.channels.values():
        if channel.type == type_name:
            return channel.schema_text, str(channel.metadata.get("topic_type_hash", ""))
    return "", ""


# A policy only sees its candidates. Whether an event is the recorded one shows when it is over,
# whoever ran it: the loop, or one of the user's own executors.


class RecordedOrderObserver(EventObserver):
    """Compares the events of a run with a recording; the first difference ends the run.

    ``is_whole``: the recording is complete.
    """

    order = ObserverOrder.RECORDED_ORDER

    def __init__(self, dispatcher: Dispatcher, order: RecordedOrder, *, is_whole: bool) -> None:
        self._dispatcher = dispatcher
        self.policy = order
        self._is_whole = is_whole
        self._last: tuple[int, RecordedEvent] | None = None
        self._is_beyond = False
        self._other_time: tuple[int, RecordedEvent, int] | None = None
        dispatcher.add_observer(self)

    def after_event(self) -> None:
        loop, order = self._dispatcher.loop, self.policy
        event, outcome = self._dispatcher.event, self._dispatcher.outcome
        index, kind, entity, handle = loop.events - 1, event.kind, event.entity, event.handle
        if outcome.ended_after is not None or outcome.error is not None:
            return
        expected = order.event(index)
        if expected is None:
            self._is_beyond = True
            return
        self._last = index, expected
        name = order.name_of(entity)
        if kind != expected.kind or name not in (None, expected.name):
            if handle is not None and (name is None or not entity):
                name = handle.describe()
            here = f"here it was {event_text(kind, name or 'something else', loop.stamp)}"
            error = order.cannot_follow(index, expected, here)
            outcome.error = error
            loop.stop(Stop("the recorded order cannot be followed", error.exit_code))
        elif loop.now_ns != expected.stamp_ns and self._other_time is None:
            self._other_time = index, expected, loop.stamp

    def notes(self) -> Iterator[str]:
        """Yield how the run differs from the recorded one."""
        loop, file = self._dispatcher.loop, self.policy.file
        if self._other_time is not None:
            index, expected, now_ns = self._other_time
            yield (
                f"the run follows the order of {file}, but not its times: event {index} is "
                f"{expected} there, and at {format_seconds(now_ns)} s here"
            )
        if self._is_beyond and self._last is not None:
            index, event = self._last
            end = "ends with" if self._is_whole else "was cut off after"
            yield (
                f"{file} {end} its event {index} ({event}); from there on this run was first "
                "come, first served"
            )
        ended_after = self._dispatcher.outcome.ended_after
        count = loop.events if ended_after is None else ended_after
        following = None if self._is_beyond else self.policy.event(count)
        stopped = loop.stopped
        if following is not None and (
            following.stamp_ns < loop.now_ns
            or (stopped is not None and stopped.reason == NOTHING_LEFT)
        ):
            yield (f"the run ended before {file} did: its event {count}, {following}, has not come")
