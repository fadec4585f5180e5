"""What is asked: a callback of a node, perhaps at a time; and what it should have received."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from itertools import pairwise
from statistics import median
from typing import Any, ClassVar

from rsltrace.diff.why.history import Message, Occupation, RunHistory
from rsltrace.simulation.middleware.qos.policies import Qos, incompatible_policies
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventFlag, OutputKind
from rsltrace.trace.model.texts import format_duration, printable
from rsltrace.trace.words.code import entity_places
from rsltrace.trace.words.phrases import exception_of, seconds_text

SENDERS = {
    EntityKind.SUBSCRIPTION: EntityKind.PUBLISHER,
    EntityKind.SERVICE: EntityKind.CLIENT,
    EntityKind.CLIENT: EntityKind.SERVICE,
}
WITH_CALLBACK = (*SENDERS, EntityKind.TIMER)
_FRAME = re.compile(r'File "([^"\n]*)", line (\d+)')
_PERIODS = 1.5
"""A sender is silent after so many of its usual periods."""


@dataclass(frozen=True)
class Question:
    """Why ``entity`` did not run, at ``at_ns`` or in the whole run (None).

    ``message`` is the one that is looked at, if any; ``depth``: how many questions led to this one.
    """

    history: RunHistory
    entity: Entity
    at_ns: int | None = None
    message: Message | None = None
    depth: int = 0

    @property
    def node(self) -> Entity:
        return self.history.trace.entity(self.entity.node)

    @property
    def end_ns(self) -> int:
        return self.history.trace.end_ns

    @property
    def time_ns(self) -> int:
        """The time that is asked about: the end of the run if none was given."""
        return self.end_ns if self.at_ns is None else self.at_ns

    @property
    def until_ns(self) -> int:
        """The time until which the callback should have run."""
        return self.time_ns if self.message is None else self.message.arrival_ns

    def named(self, entity_id: int) -> str:
        """Return an entity as part of a sentence: ``subscription /a of /slow``."""
        entity = self.history.trace.entity(entity_id)
        owner = self.history.trace.node_of(entity)
        of = f" of {printable(owner.name)}" if owner.id and owner is not entity else ""
        return f"{entity.kind.label} {printable(entity.name)}{of}"

    @property
    def name(self) -> str:
        return self.named(self.entity.id)

    @property
    def sender(self) -> str:
        assert self.message is not None
        return self.named(self.message.sender)

    def place_of(self, entity_id: int) -> str:
        """Return the line of an entity's callback, else one from which it sent, else its node's."""
        entity = self.history.trace.entity(entity_id)
        places = entity_places(self.history.trace, entity)
        return places[0] if places else self.history.trace.node_of(entity).source

    @property
    def place(self) -> str:
        return self.place_of(self.entity.id)

    @cached_property
    def senders(self) -> list[Entity]:
        """Who sends what the callback receives."""
        kind, everything = SENDERS.get(self.entity.kind), self.history.trace.entities.values()
        return [one for one in everything if one.kind is kind and one.name == self.entity.name]

    @cached_property
    def messages(self) -> list[Message]:
        return self.history.messages(self.senders, self.entity.id)

    def mismatch(self, sender: Entity) -> tuple[str, str, str] | None:
        """Return the first policy that keeps a publisher from this subscription, what is offered
        and what is requested; None if they match."""
        offered, requested = qos_of(sender), qos_of(self.entity)
        policies = incompatible_policies(offered, requested)
        if not policies:
            return None
        policy = policies[0].name.lower()
        if policy == "liveliness" and offered.liveliness is requested.liveliness:
            policy = "lease"
        shown = [one.summary() for one in (offered, requested)]
        values = [one.get(policy, one.get(f"{policy}_ns", "unlimited")) for one in shown]
        texts = [format_duration(one) if isinstance(one, int) else str(one) for one in values]
        return policy, texts[0], texts[1]

    def is_silent(self, sent: list[Message], until_ns: int) -> bool:
        """Whether more time than usual has passed since the last of some messages."""
        gaps = [later.sent_ns - one.sent_ns for one, later in pairwise(sent)]
        gaps = [gap for gap in gaps if gap > 0]
        return bool(gaps) and until_ns - sent[-1].sent_ns > _PERIODS * median(gaps)

    def occupations(self, from_ns: int, to_ns: int) -> list[Occupation]:
        """Return what kept the callback from running in a stretch of time, the longest first."""
        return self.history.occupations_of(self.entity, from_ns, to_ns, self._shares_executor)

    def _shares_executor(self, other: Entity) -> bool:
        names = [self.node.name, self.history.trace.node_of(other).name]
        rules: list[list[str]] = [one.get("nodes") or [] for one in self.rules("executors")]
        return any(all(any(fnmatchcase(n, g) for g in rule) for n in names) for rule in rules)

    def rules(self, *keys: str) -> list[dict[str, Any]]:
        """Return a list of rules of the resolved job, empty if it has none."""
        try:
            value = json.loads(self.history.trace.job.get("resolved") or "{}")
            for key in keys:
                value = value.get(key)
        except (ValueError, AttributeError, RecursionError):
            return []
        return [one for one in value if isinstance(one, dict)] if isinstance(value, list) else []

    def raised(self, event: int) -> tuple[str, str] | None:
        """Return the exception that an event raised, and its place in user code;
        None if it raised none."""
        trace = self.history.trace
        if not int(self.history.events["flags"][event]) & EventFlag.RAISED:
            return None
        outputs = [o for o in trace.outputs_of(event) if o.kind is OutputKind.EXCEPTION]
        text = (trace.detail(outputs[0]) or "").strip() if outputs else ""
        files = {one.source.rpartition(":")[0] for one in trace.entities.values() if one.source}
        places = [
            f"{file}:{line}"
            for path, line in _FRAME.findall(text)
            for file in sorted(files, key=len)
            if f"/{path}".endswith(f"/{file}")
        ]
        return printable(exception_of(text)), places[-1] if places else ""


def qos_of(entity: Entity) -> Qos:
    shown = entity.detail.get("qos")
    return Qos.from_summary(shown if isinstance(shown, dict) else {})


def filter_of(entity: Entity) -> tuple[str, str, int] | None:
    """Return the callback of the message filter behind a subscription, its line, and how far apart
    stamps may be (ns); None if there is none."""
    of = entity.detail.get("filter")
    if not isinstance(of, dict) or not isinstance(of.get("slop_ns"), int):
        return None
    return str(of.get("callback")), str(of.get("source")), of["slop_ns"]


# What all reasons have.


@dataclass(frozen=True, kw_only=True)
class Reason:
    """Why a callback did not run. Times are simulated nanoseconds; entities are named as in
    sentences.

    ``place`` is the line of code (``module.py:24``) of what is to blame, ``event`` the one to look
    at; "" and None if unknown.
    """

    is_reason: ClassVar[bool] = True
    """Whether something kept the callback from running; else another reason is looked for."""
    question: Question
    place: str = ""
    event: int | None = None

    @property
    def kind(self) -> str:
        """What programs call it: ``pushed_out``."""
        return re.sub("(?<=[a-z])(?=[A-Z])", "_", type(self).__name__).lower()

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        """Return the reason, None if it does not hold."""
        raise NotImplementedError

    def seconds(self, stamp_ns: int) -> str:
        """Return a time in seconds since the start of the run: ``1.5``."""
        return seconds_text(self.question.history.trace.stamp(stamp_ns))

    def when(self, stamp_ns: int) -> str:
        """Return a time as part of a sentence: ``at 1.5 s``."""
        return f"at {self.seconds(stamp_ns)} s"

    def words(self) -> str:
        """Return a sentence without its full stop."""
        raise NotImplementedError

    def clause(self) -> str:
        """Return the reason as what follows "because" in the sentence of another one."""
        return self.words()

    def because(self) -> Reason | None:
        """Return the reason behind this one, if there is one."""
        return None

    def evidence(self) -> Iterator[str]:
        """Yield lines that show what the trace says, beside the counts and the event."""
        yield from ()
