"""Which model each link of a graph has: the rules of a job, by the names of topics and nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

from rsltrace.simulation.chance.channel import NO_MODEL, Channel, Model, Outage

QUIET_TOPICS = frozenset(("/rosout", "/parameter_events"))
"""Topics that the default delay leaves alone: nobody's behaviour is meant when it is set."""


@dataclass(frozen=True, slots=True)
class LinkRule:
    """A model for the links that three globs describe."""

    topic: str
    sender: str
    receiver: str
    model: Model


@dataclass(frozen=True, slots=True)
class NameRule:
    """A model for the topics or services that a glob describes; ``where`` is its line in a file of
    delays."""

    name: str
    model: Model
    where: str = ""


@dataclass(frozen=True, slots=True)
class OutageRule:
    """An outage of the topics, services or nodes that a glob describes; ``kind`` says which."""

    kind: str
    name: str
    outage: Outage


@dataclass(frozen=True, slots=True)
class NetworkPlan:
    """The rules of a job. Of links the first that matches counts, then an exact name, then globs
    in order, then ``table`` (from a file of delays), then the default."""

    links: tuple[LinkRule, ...] = ()
    topics: tuple[NameRule, ...] = ()
    table: tuple[NameRule, ...] = ()
    services: tuple[NameRule, ...] = ()
    default: Model | None = None
    outages: tuple[OutageRule, ...] = ()
    seed: int = 0
    start_ns: int = 0

    def topic_channel(
        self, topic: str, sender: tuple[str, int], receiver: tuple[str, int], *, reliable: bool
    ) -> Channel | None:
        """Return the channel of a link, or None if nothing is ever the matter with it.

        Ends are (node, which of its endpoints of that topic, from 0).
        """
        model = self.topic_model(topic, sender[0], receiver[0])
        outages = self._outages("topic", topic, (sender[0], receiver[0]))
        name = f"topic\0{topic}\0{_end(sender)}\0{_end(receiver)}"
        return self._channel(model, outages, name, reliable=reliable)

    def topic_model(self, topic: str, sender: str, receiver: str) -> Model | None:
        """Return the model of a link from node to node, None if it has none."""
        model = self._link_model(topic, sender, receiver)
        if model is None:
            model = _by_name(self.topics, topic)
        if model is None:
            model = _by_name(self.table, topic)
        if model is None and topic not in QUIET_TOPICS:
            model = self.default
        return model

    def service_model(self, service: str) -> Model | None:
        """Return the model of a service's requests and responses, None if they have none."""
        model = _by_name(self.services, service)
        return self.default if model is None else model

    def service_channel(
        self, service: str, client: tuple[str, int], server: tuple[str, int], direction: str
    ) -> Channel | None:
        """Return the channel of requests or responses (``direction``) of a client to a server."""
        model = self.service_model(service)
        if model is not None and model.duplicate > 0.0:
            model = replace(model, duplicate=0.0)  # a request is answered once
        outages = self._outages("service", service, (client[0], server[0]))
        name = f"{direction}\0{service}\0{_end(client)}\0{_end(server)}"
        return self._channel(model, outages, name, reliable=True)

    def _channel(
        self, model: Model | None, outages: tuple[Outage, ...], name: str, *, reliable: bool
    ) -> Channel | None:
        if model is None and not outages:
            return None
        return Channel(
            model or NO_MODEL,
            seed=self.seed,
            name=name,
            start_ns=self.start_ns,
            reliable=reliable,
            outages=outages,
        )

    def _link_model(self, topic: str, sender: str, receiver: str) -> Model | None:
        for rule in self.links:
            if (
                fnmatchcase(topic, rule.topic)
                and fnmatchcase(sender, rule.sender)
                and fnmatchcase(receiver, rule.receiver)
            ):
                return rule.model
        return None

    def _outages(self, kind: str, name: str, nodes: tuple[str, str]) -> tuple[Outage, ...]:
        return tuple(
            rule.outage
            for rule in self.outages
            if (rule.kind == kind and fnmatchcase(name, rule.name))
            or (rule.kind == "node" and any(fnmatchcase(node, rule.name) for node in nodes))
        )


def _by_name(rules: Sequence[NameRule], name: str) -> Model | None:
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
