"""Follow the order of a recording (``policy: {recorded: …}``), and record what that needs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace.errors import JobError, TraceError
from rsltrace.job import Job, locate
from rsltrace.run.plans.scheduling import policy_named, user_policy
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.simulation.loop.loop import EventLoop
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
    NativeCallback,
    NativeOrder,
    RecordedEvent,
    RecordedOrder,
    entity_text,
)
from rsltrace.simulation.loop.wait_set import RclpyWaitSetPolicy
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.texts import Stamp
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.writer import TraceWriter

if TYPE_CHECKING:
    from rsltrace.simulation.middleware.domain import Domain
    from rsltrace.simulation.middleware.events.recorded_order_observer import (
        NativeOrderObserver,
        RecordedOrderObserver,
    )

ATTACHMENT_CHOICES = "rsltrace/choices"
"""What the policy of the run has chosen; see ``rsltrace.simulation.loop.policy``."""
ATTACHMENT_POLLS = "rsltrace/polls"
"""From when on executors had polling points, see ``OrderedLoop.polls``."""


def follow_recording(
    job: Job, domain: Domain, stack: ExitStack
) -> RecordedOrderObserver | NativeOrderObserver | None:
    """Let a run follow the order of a recording, if the job says so; the recording stays open as
    long as ``stack``. The order of a native run is followed where possible.

    :raises JobError: the recording cannot be read, or has no events.
    """
    from rsltrace.simulation.middleware.events.recorded_order_observer import (
        NativeOrderObserver,
        RecordedOrderObserver,
    )

    if job.policy is None or job.policy.recorded is None:
        return None
    trace = _opened(job, job.policy.recorded, stack)
    census = domain.entities.census
    assert census is not None, "a job with a policy has rules"
    file = Path(job.policy.recorded).name
    if is_native(trace):
        events = enumerate(_events(trace))
        observed = [NativeCallback(index, one) for index, one in events if one.kind in CALLBACKS]
        return NativeOrderObserver(
            domain.dispatcher, NativeOrder(file, observed, census.describe_all())
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
