"""What became of each message, and what occupied a node: from the events of a whole trace."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.trace.contents import CONTINUES
from rsltrace.trace.departures import Departures
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import (
    NO_EVENT,
    EventFlag,
    EventKind,
    OutputKind,
    RandomDecision,
    decision_duration,
    decision_kind,
)
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.timings import event_columns

LOSSES = (RandomDecision.DROP, RandomDecision.BURST, RandomDecision.OUTAGE)
_SENT = {
    EntityKind.PUBLISHER: OutputKind.MESSAGE,
    EntityKind.CLIENT: OutputKind.REQUEST,
    EntityKind.SERVICE: OutputKind.RESPONSE,
}
_FOR_EVER = 1 << 62


@dataclass(frozen=True, slots=True)
class Message:
    """A message (request, response), and how it reached a receiver.

    ``output`` is its position in its event. It ``left_ns`` when the callback was over, and arrived
    at ``arrival_ns``; ``loss``: how a link lost it; ``taken``: the event that received it.
    """

    event: int
    output: int
    sender: int
    sent_ns: int
    left_ns: int
    arrival_ns: int
    loss: RandomDecision | None = None
    taken: int | None = None


@dataclass(frozen=True, slots=True)
class Occupation:
    """A stretch in which the callback of an event kept others from running."""

    event: int
    entity: int
    from_ns: int
    to_ns: int
    verb: str


class RunHistory:
    """The events and outputs of a run as columns; ``ended``: the index where its shutdown began.

    :raises TraceError: it is a native run, whose trace does not say what became of each message.
    """

    def __init__(self, trace: Trace) -> None:
        if is_native(trace):
            raise TraceError(f"{trace.name} is a native run, which `rsltrace why` cannot explain")
        self.trace = trace
        self.events = event_columns(trace)
        names = ["event", "entity", "kind", "hash"]
        parts = [np.array(outputs[names]) for outputs in trace.outputs()]
        self.outputs = np.concatenate(parts) if parts else np.zeros(0, [(n, "u8") for n in names])
        self.firsts = np.cumsum(self.events["outputs"], dtype=np.int64) - self.events["outputs"]
        self._stamps = self.events["stamp"].astype(np.int64)
        self._is_draw = self.outputs["kind"] == OutputKind.DRAW
        self._messages: dict[tuple[int, ...], list[Message]] = {}
        ended = trace.result.get("ended_after", "")
        self.ended = int(ended) if ended.isdecimal() else len(self.events)

    def stamp(self, event: int) -> int:
        return int(self._stamps[event])

    def runs_of(self, *entities: int) -> list[int]:
        """Return the events of some entities before the end of the run."""
        mine = np.isin(self.events["entity"][: self.ended], entities)
        found: list[int] = np.flatnonzero(mine).tolist()
        return found

    def calls_of(self, entity: int, until_ns: int = _FOR_EVER) -> list[int]:
        """Return the events with which an entity's callback began, until a time."""
        mine = self.events[: self.ended]
        began = (mine["entity"] == entity) & ~np.isin(mine["kind"], CONTINUES)
        found: list[int] = np.flatnonzero(began & (mine["stamp"] <= until_ns)).tolist()
        return found

    def outputs_of(self, entities: list[int], kind: OutputKind) -> list[tuple[int, int, int]]:
        """Return (row, event, hash) of the outputs of some entities, of one kind."""
        mine = (self.outputs["kind"] == kind) & np.isin(self.outputs["entity"], entities)
        rows = np.flatnonzero(mine & (self.outputs["event"] < self.ended))
        found = self.outputs[rows]
        columns = (rows, found["event"], found["hash"])
        return list(zip(*(column.tolist() for column in columns), strict=True))

    def made_by(self, entity: int) -> int:
        found = self.outputs_of([entity], OutputKind.ENTITY)
        return found[0][1] if found else 0

    def messages(self, senders: list[Entity], receiver: int) -> list[Message]:
        """Return what some entities sent, and how it reached a receiver, in order of sending."""
        key = (receiver, *(one.id for one in senders))
        if key not in self._messages:
            self._messages[key] = self._find_messages(senders, receiver) if senders else []
        return self._messages[key]

    def _find_messages(self, senders: list[Entity], receiver: int) -> list[Message]:
        calls = self.calls_of(receiver)
        causes = (self.events[name][calls].tolist() for name in ("cause_event", "cause_output"))
        taken = dict(zip(reversed(list(zip(*causes, strict=True))), reversed(calls), strict=True))
        sent = self.outputs_of([one.id for one in senders], _SENT[senders[0].kind])
        return [self._sent(row, event, receiver, taken) for row, event, _ in sent]

    def _sent(
        self, row: int, event: int, receiver: int, taken: dict[tuple[int, int], int]
    ) -> Message:
        sender, sent_ns = int(self.outputs["entity"][row]), self.stamp(event)
        left_ns = sent_ns + self._late_ns.get(event, 0)
        first = int(self.firsts[event])
        output = row - first
        by = taken.get((event, output))
        message = Message(event, output, sender, sent_ns, left_ns, left_ns, taken=by)
        for draw in range(row + 1, first + int(self.events["outputs"][event])):
            if not self._is_draw[draw]:
                break
            number = int(self.outputs["hash"][draw])
            if self.outputs["entity"][draw] != receiver:
                continue
            if (kind := decision_kind(number)) in LOSSES:
                return replace(message, loss=kind)
            delay_ns = decision_duration(number, RandomDecision.DELAY)
            if delay_ns is not None:
                return replace(message, arrival_ns=left_ns + delay_ns)
        return message

    def _draws(self, kind: RandomDecision) -> Iterator[tuple[int, int, int]]:
        """Yield (event, entity, duration) of the draws of one kind."""
        rows = self.outputs[self._is_draw]
        columns: list[npt.NDArray[np.uint64]] = [rows[n] for n in ("event", "entity", "hash")]
        for event, entity, number in zip(*(one.tolist() for one in columns), strict=True):
            duration_ns = decision_duration(number, kind)
            if duration_ns is not None and event < self.ended:
                yield event, entity, duration_ns

    @cached_property
    def _late_ns(self) -> dict[int, int]:
        return Departures().read(0, self.events, self.outputs)

    @cached_property
    def _executions(self) -> dict[int, int]:
        """How long the callbacks of events took, by the job."""
        entities = self.events["entity"]
        drawn = self._draws(RandomDecision.EXECUTION)
        return {event: ns for event, entity, ns in drawn if entities[event] == entity}

    @cached_property
    def occupations(self) -> list[Occupation]:
        """All callbacks that took time: by execution times, because they waited, or by a fault."""
        entities = self.events["entity"]
        found = list(self._suspensions())
        for event, took_ns in self._executions.items():
            start = self.stamp(event)
            found.append(Occupation(event, int(entities[event]), start, start + took_ns, "ran"))
        for event, entity, hang_ns in self._draws(RandomDecision.HANG):
            start = self.stamp(event)
            found.append(Occupation(event, entity, start, start + (hang_ns or _FOR_EVER), "hung"))
        return found

    def _suspensions(self) -> Iterator[Occupation]:
        waiting: dict[int, list[int]] = {}
        flags, kinds = self.events["flags"][: self.ended], self.events["kind"][: self.ended]
        involved = (flags & EventFlag.SUSPENDED != 0) | (kinds == EventKind.RESUME)
        for event in np.flatnonzero(involved).tolist():
            entity = int(self.events["entity"][event])
            if kinds[event] == EventKind.RESUME and waiting.get(entity):
                begun = waiting[entity].pop(0)
                slept = self.events["cause_event"][event] == NO_EVENT
                verb = "slept or waited" if slept else "waited"
                yield Occupation(begun, entity, self.stamp(begun), self.stamp(event), verb)
            if flags[event] & EventFlag.SUSPENDED:
                waiting.setdefault(entity, []).append(event)
        for entity, events in waiting.items():
            if self.trace.entity(entity).kind is not EntityKind.MAIN:  # which spins
                for begun in events:
                    yield Occupation(begun, entity, self.stamp(begun), _FOR_EVER, "slept or waited")

    def main_of(self, node: int) -> int:
        """Return the main that made a node, 0 if none has."""
        event = self.made_by(node)
        mains = [one.id for one in self.trace.entities.values() if one.kind is EntityKind.MAIN]
        made = (one for one in mains if event in (self.made_by(one), *self.runs_of(one)))
        return next(made, 0)

    def _spins(self, wait: Occupation, node: int) -> bool:
        """Return whether callbacks of a node began while a main waited: it spun the node."""
        own = [
            one.id
            for one in self.trace.entities.values()
            if one.node == node and one.kind is not EntityKind.THREAD
        ]
        during = self.events[wait.event + 1 : self.ended]
        during = during[during["stamp"] < wait.to_ns]
        began = (during["kind"] != EventKind.RESUME) & (during["kind"] != EventKind.CONSTRUCT)
        return bool(np.isin(during["entity"][began], own).any())

    def occupations_of(
        self, entity: Entity, from_ns: int, to_ns: int, shares: Callable[[Entity], bool]
    ) -> list[Occupation]:
        """Return what kept a callback from running in a stretch of time, the longest first: of its
        node (if suspended, of its group), or of a node that ``shares`` its executor."""
        main = self.main_of(entity.node)
        found: list[tuple[int, Occupation]] = []
        for one in self.occupations:
            shared_ns = min(one.to_ns, to_ns) - max(one.from_ns, from_ns)
            if shared_ns > 0:
                other = self.trace.entity(one.entity)
                if other.kind is EntityKind.MAIN:
                    blocks = other.id == main and not self._spins(one, entity.node)
                elif other.node != entity.node:
                    blocks = one.verb == "ran" and shares(other)
                else:
                    groups = {str(each.detail.get("group", "")) for each in (other, entity)}
                    same = len(groups) == 1 and "reentrant" not in next(iter(groups))
                    blocks = one.verb in ("ran", "hung") or same
                if blocks and other.kind is not EntityKind.THREAD:
                    found.append((shared_ns, one))
        return [one for _, one in sorted(found, key=lambda pair: -pair[0])]
