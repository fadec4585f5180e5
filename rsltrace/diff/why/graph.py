"""Reasons that keep everything away: nodes that are not there, names and QoS that do not match."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from rsltrace.diff.why.question import SENDERS, Question, Reason, qos_of
from rsltrace.errors import nearest
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import OutputKind, RandomDecision, decision_kind, decision_text
from rsltrace.trace.model.operation import is_built_in
from rsltrace.trace.model.texts import printable, shortened

_TEXT_MAX = 200
_CRASHES = (RandomDecision.CRASH, RandomDecision.RESTART)
_VERBS = {
    EntityKind.SUBSCRIPTION: "publishes",
    EntityKind.SERVICE: "calls",
    EntityKind.CLIENT: "serves",
}


@dataclass(frozen=True)
class NotConstructed(Reason):
    """A constructor raised: that of the node itself, or of an ``other`` one before it."""

    node: str
    raised: str
    other: str = ""

    def words(self) -> str:
        whose = f"before it, the constructor of {self.other}" if self.other else "its constructor"
        raised = shortened(self.raised, _TEXT_MAX)
        return f"{self.node} was not constructed: {whose} raised {raised}"


@dataclass(frozen=True)
class NotReceived(Reason):
    """The node receives nothing of the name that was asked for, but ``names``."""

    asked: str
    names: tuple[str, ...]

    def words(self) -> str:
        node = printable(self.question.entity.name)
        but = f"; it receives {', '.join(self.names[:3])}" if self.names else ""
        return f"{node} does not receive {self.asked}{but}"


@dataclass(frozen=True)
class NodeEnded(Reason):
    """The node raised (``by`` is the callback), or a fault of the job crashed it."""

    node: str
    at_ns: int
    by: str
    raised: str

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        if question.message is not None and question.message.taken is not None:
            return None
        ended = cls.of_node(question, question.node)
        return ended if ended is not None and ended.at_ns <= question.until_ns else None

    @classmethod
    def of_node(cls, question: Question, node: Entity) -> NodeEnded | None:
        history, name = question.history, printable(node.name)
        if not node.id:
            return None  # the run itself: a bag, or code outside
        for _, event, number in history.outputs_of([node.id], OutputKind.DRAW):
            if decision_kind(number) in _CRASHES:
                what = (name, history.stamp(event), "a fault of the job:", decision_text(number))
                return cls(*what, question=question, place=node.source, event=event)
        own = [one.id for one in history.trace.entities.values() if one.node == node.id]
        runs = history.runs_of(*own, *filter(None, [history.main_of(node.id)]))
        if not runs or (raised := question.raised(runs[-1])) is None:
            return None
        event = runs[-1]
        kinds = [one.kind for one in history.trace.outputs_of(event)]
        if OutputKind.LOG in kinds[kinds.index(OutputKind.EXCEPTION) :]:
            return None  # on_exception: log
        by = question.named(int(history.events["entity"][event]))
        what = (name, history.stamp(event), by, f"raised {raised[0]}")
        return cls(*what, question=question, place=raised[1], event=event)

    def words(self) -> str:
        what = f"{self.by} {shortened(self.raised, _TEXT_MAX)}"
        return f"{self.node} ended {self.when(self.at_ns)}: {what}"


@dataclass(frozen=True)
class NoSender(Reason):
    """Nobody publishes, calls or serves; ``near`` is a similar name that the node ``by`` does."""

    near: str
    by: str

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        entity = question.entity
        if question.senders or entity.kind not in SENDERS:
            return None
        others = {
            one.name: printable(question.history.trace.node_of(one).name)
            for one in question.history.trace.entities.values()
            if one.kind is SENDERS[entity.kind] and one.type == entity.type and not is_built_in(one)
        }
        last = entity.name.rpartition("/")[2]
        same = [name for name in others if name.rpartition("/")[2] == last]
        near = same[0] if same else nearest(entity.name, others) or ""
        return cls(printable(near), others.get(near, ""), question=question, place=question.place)

    def words(self) -> str:
        verb = _VERBS[self.question.entity.kind]
        text = f"nobody {verb} what {self.question.name} waits for"
        if not self.near:
            return text
        meant = "a typo, or a missing remapping or namespace?"
        return f"{text}; {self.by or 'a bag'} {verb} {self.near}: {meant}"

    def evidence(self) -> Iterator[str]:
        for one in self.question.history.trace.entities.values():
            if one.name == self.near and one.kind is SENDERS[self.question.entity.kind]:
                place = printable(self.question.place_of(one.id))
                yield f"{self.question.named(one.id)} at {place}"


@dataclass(frozen=True)
class IncompatibleQos(Reason):
    sender: str
    policy: str
    offered: str
    requested: str

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        message, entities = question.message, question.history.trace.entities
        senders = question.senders if message is None else [entities[message.sender]]
        found = [(one, mismatch) for one in senders if (mismatch := question.mismatch(one))]
        if not found or len(found) < len(senders):
            return None
        sender, what = found[0]
        return cls(question.named(sender.id), *what, question=question, place=question.place)

    def words(self) -> str:
        return (
            f"{self.question.name} and {self.sender} do not connect: {self.policy} is "
            f"{self.offered} at the publisher, and the subscription asks for {self.requested}"
        )

    def evidence(self) -> Iterator[str]:
        for one in (*self.question.senders, self.question.entity):
            place = printable(self.question.place_of(one.id))
            yield f"{self.question.named(one.id)} at {place}: {qos_of(one).describe()}"


@dataclass(frozen=True)
class CreatedLate(Reason):
    """The message was sent before the subscription was there, and an end is ``volatile``."""

    sender: str
    sent_ns: int
    created_ns: int
    volatile: str

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        message, history = question.message, question.history
        made = history.made_by(question.entity.id)
        if message is None or message.taken is not None or message.event > made:
            return None
        ends = {"publisher": history.trace.entity(message.sender), "subscription": question.entity}
        volatile = [
            name
            for name, one in ends.items()
            if isinstance(qos := one.detail.get("qos"), dict)
            and qos.get("durability") == "volatile"
        ]
        times = (message.sent_ns, history.stamp(made), " and the ".join(volatile))
        return cls(question.sender, *times, question=question, place=question.place, event=made)

    def words(self) -> str:
        verb = "is" if " and " not in self.volatile else "are"
        kept = f", and the {self.volatile} {verb} volatile" if self.volatile else ""
        return (
            f"{self.question.name} was created {self.when(self.created_ns)}, after {self.sender} "
            f"had sent {self.when(self.sent_ns)}{kept}"
        )
