"""The delay, loss and order of messages on one link.

``LinkModel`` describes a link, ``LinkChannel`` is its state in a run. Each purpose (delay,
drop, burst, duplicate, the delay of the copy) has a random stream of its own, so
enabling one does not change what others draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.chance.distribution import Constant, Distribution
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.trace.model.operation import NODE_TOPICS

LOST_DROP = -1
LOST_BURST = -2
LOST_OUTAGE = -3

_ATTEMPTS_MAX = 1000
"""A reliable link gives a message up after losing it this many times in a row."""


@dataclass(frozen=True, slots=True)
class BurstLoss:
    """Loss in bursts (Gilbert and Elliott): a Markov chain of a good and a bad state.

    Probabilities per message: of changing state in each direction, and of a loss in each state.
    """

    good_to_bad: float
    bad_to_good: float
    loss_bad: float = 1.0
    loss_good: float = 0.0


@dataclass(frozen=True, slots=True)
class LinkModel:
    """What happens to the messages of a link. No ``delay``: they arrive at once.

    ``retransmit_ns`` is what each loss costs on a reliable link. ``keep_order``: a message never
    overtakes an earlier one of its link.
    """

    delay: Distribution | None = None
    drop: float = 0.0
    burst: BurstLoss | None = None
    duplicate: float = 0.0
    keep_order: bool = True
    retransmit_ns: int = 10_000_000


@dataclass(frozen=True, slots=True)
class LinkOutage:
    """Nothing gets through from ``from_ns`` up to, not including, ``to_ns`` of simulated time."""

    from_ns: int
    to_ns: int


PERFECT_LINK = LinkModel()


class LinkChannel:
    """The messages of one link, in the order in which they are sent.

    ``transmit`` returns the delay in ns, or one of the ``LOST_…`` codes. It sets ``duplicate_ns``,
    the delay of a second copy (or -1), and ``held_until_ns``, the end of the outage that held the
    message back on a reliable link (or -1). ``plain`` is the sampler of a link that only delays;
    who uses it directly has to keep the order.
    """

    def __init__(
        self,
        model: LinkModel,
        *,
        seed: int,
        name: str,
        start_ns: int,
        reliable: bool,
        outages: tuple[LinkOutage, ...] = (),
    ) -> None:
        delay = model.delay or Constant(0)
        self.name = name
        self.duplicate_ns = -1
        self.held_until_ns = -1
        self._model = model
        self._reliable = reliable
        self.outages = _merge_outages(outages)
        self._delay = delay.sampler(RandomStream(seed, f"{name}\0delay"), start_ns)
        self._copy = delay.sampler(RandomStream(seed, f"{name}\0copy"), start_ns)
        self._drop = RandomStream(seed, f"{name}\0drop").uniform
        self._burst = RandomStream(seed, f"{name}\0burst").uniform
        self._duplicate = RandomStream(seed, f"{name}\0duplicate").uniform
        self._bad = False
        self._last_ns = -1
        self.keep_order = model.keep_order
        lossy = model.drop > 0.0 or model.burst is not None or model.duplicate > 0.0
        self.plain = None if lossy or outages else self._delay

    def transmit(self, now_ns: int) -> int:
        """Send one message at ``now_ns``."""
        if self.plain is not None:
            delay_ns = self.plain(now_ns)
        else:
            delay_ns = self._transmit_unreliably(now_ns)
            if delay_ns < 0:
                return delay_ns
        if self.keep_order:
            delay_ns = max(delay_ns, self._last_ns - now_ns)
            self._last_ns = now_ns + delay_ns
            if self.duplicate_ns >= 0:
                # The copy follows its message, in front of the next one.
                self.duplicate_ns = max(delay_ns, self.duplicate_ns)
                self._last_ns = now_ns + self.duplicate_ns
        return delay_ns

    def hold_back(self, until_ns: int) -> None:
        """Let nothing arrive before ``until_ns`` where the order is kept."""
        self._last_ns = max(self._last_ns, until_ns)

    def _transmit_unreliably(self, now_ns: int) -> int:
        """Return the delay over a link with losses, duplicates or outages.

        A lost message's delay is drawn, too, so losses do not change the delays of others.
        """
        self.duplicate_ns = self.held_until_ns = -1
        waited_ns = 0
        for _ in range(_ATTEMPTS_MAX):
            sent_ns = now_ns + waited_ns
            end_ns = self.cut_off_until(sent_ns)
            if end_ns is not None:
                if not self._reliable:
                    self._delay(sent_ns)
                    return LOST_OUTAGE
                self.held_until_ns = end_ns
                waited_ns = end_ns - now_ns
                sent_ns = end_ns
            lost = self._lost()
            if not lost:
                break
            if not self._reliable:
                self._delay(sent_ns)
                return lost
            waited_ns += self._model.retransmit_ns
        else:
            self._delay(sent_ns)
            return lost
        model = self._model
        if model.duplicate > 0.0 and self._duplicate() < model.duplicate:
            self.duplicate_ns = waited_ns + self._copy(sent_ns)
        return waited_ns + self._delay(sent_ns)

    def _lost(self) -> int:
        """Draw whether an attempt is lost; return its code, or 0."""
        model = self._model
        burst = model.burst
        if burst is not None:
            draw = self._burst()
            if self._bad:
                self._bad = draw >= burst.bad_to_good
            else:
                self._bad = draw < burst.good_to_bad
            loss = burst.loss_bad if self._bad else burst.loss_good
            if loss >= 1.0 or (loss > 0.0 and self._burst() < loss):
                return LOST_BURST
        if model.drop > 0.0 and self._drop() < model.drop:
            return LOST_DROP
        return 0

    def cut_off_until(self, now_ns: int) -> int | None:
        for outage in self.outages:
            if outage.from_ns <= now_ns < outage.to_ns:
                return outage.to_ns
        return None


def _merge_outages(outages: Sequence[LinkOutage]) -> tuple[LinkOutage, ...]:
    """Return outages in order; those that overlap or touch are merged."""
    found: list[LinkOutage] = []
    for outage in sorted(outages, key=lambda outage: outage.from_ns):
        if found and outage.from_ns <= found[-1].to_ns:
            found[-1] = LinkOutage(found[-1].from_ns, max(found[-1].to_ns, outage.to_ns))
        else:
            found.append(outage)
    return tuple(found)


QUIET_TOPICS = NODE_TOPICS
"""Topics without the default delay."""


@dataclass(frozen=True, slots=True)
class LinkRule:
    """A model for the links that three globs describe."""

    topic: str
    sender: str
    receiver: str
    model: LinkModel


@dataclass(frozen=True, slots=True)
class NameRule:
    """A model for the topics or services that a glob describes; ``where`` is its line in a file of
    delays."""

    name: str
    model: LinkModel
    where: str = ""


@dataclass(frozen=True, slots=True)
class OutageRule:
    """An outage of the topics, services or nodes that a glob describes; ``kind`` says which."""

    kind: str
    name: str
    outage: LinkOutage


@dataclass(frozen=True, slots=True)
class NetworkPlan:
    """The rules of a job. The first matching rule of ``links`` counts, then an exact name in
    ``topics``, then globs in order, then ``table`` (a file of delays), then the default."""

    links: tuple[LinkRule, ...] = ()
    topics: tuple[NameRule, ...] = ()
    table: tuple[NameRule, ...] = ()
    services: tuple[NameRule, ...] = ()
    default: LinkModel | None = None
    outages: tuple[OutageRule, ...] = ()
    seed: int = 0
    start_ns: int = 0

    def topic_channel(
        self, topic: str, sender: tuple[str, int], receiver: tuple[str, int], *, reliable: bool
    ) -> LinkChannel | None:
        """Return the channel of a link, or None if it is perfect.

        Ends are (node, which of its endpoints of that topic, from 0).
        """
        model = self.topic_model(topic, sender[0], receiver[0])
        outages = self._outages("topic", topic, (sender[0], receiver[0]))
        name = f"topic\0{topic}\0{_end(sender)}\0{_end(receiver)}"
        return self._channel(model, outages, name, reliable=reliable)

    def topic_model(self, topic: str, sender: str, receiver: str) -> LinkModel | None:
        """Return the model of a link between two nodes, or None."""
        model = self._link_model(topic, sender, receiver)
        model = model or _by_name(self.topics, topic) or _by_name(self.table, topic)
        return self.default if model is None and topic not in QUIET_TOPICS else model

    def service_model(self, service: str) -> LinkModel | None:
        """Return the model of a service's requests and responses, or None."""
        model = _by_name(self.services, service)
        return self.default if model is None else model

    def service_channel(
        self, service: str, client: tuple[str, int], server: tuple[str, int], direction: str
    ) -> LinkChannel | None:
        """Return the channel of requests or responses (``direction``) between client and server."""
        model = self.service_model(service)
        if model is not None and model.duplicate > 0.0:
            model = replace(model, duplicate=0.0)  # a request is answered once
        outages = self._outages("service", service, (client[0], server[0]))
        name = f"{direction}\0{service}\0{_end(client)}\0{_end(server)}"
        return self._channel(model, outages, name, reliable=True)

    def _channel(
        self, model: LinkModel | None, outages: tuple[LinkOutage, ...], name: str, *, reliable: bool
    ) -> LinkChannel | None:
        if model is None and not outages:
            return None
        return LinkChannel(
            model or PERFECT_LINK,
            seed=self.seed,
            name=name,
            start_ns=self.start_ns,
            reliable=reliable,
            outages=outages,
        )

    def _link_model(self, topic: str, sender: str, receiver: str) -> LinkModel | None:
        for rule in self.links:
            if (
                fnmatchcase(topic, rule.topic)
                and fnmatchcase(sender, rule.sender)
                and fnmatchcase(receiver, rule.receiver)
            ):
                return rule.model
        return None

    def _outages(self, kind: str, name: str, nodes: tuple[str, str]) -> tuple[LinkOutage, ...]:
        return tuple(
            rule.outage
            for rule in self.outages
            if (rule.kind == kind and fnmatchcase(name, rule.name))
            or (rule.kind == "node" and any(fnmatchcase(node, rule.name) for node in nodes))
        )


def _by_name(rules: Sequence[NameRule], name: str) -> LinkModel | None:
    for rule in rules:
        if rule.name == name:
            return rule.model
    for rule in rules:
        if fnmatchcase(name, rule.name):
            return rule.model
    return None


def _end(end: tuple[str, int]) -> str:
    node, ordinal = end
    return f"{node}#{ordinal}"
