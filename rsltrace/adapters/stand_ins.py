"""The adapter for those who were in a recording and are not here: they do again what they sent.

A stand-in has the name and the endpoints of a recorded participant, so nodes find the graph that
they found then, and what it sends takes the same links with the same draws. It runs no code; what
is sent to it, it drops.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.entity import DomainEntity, Receiver
from rsltrace.simulation.middleware.interface import MessageType, ServiceType
from rsltrace.simulation.middleware.participant import Participant
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.simulation.middleware.qos.policies import (
    DEFAULT_QOS,
    Durability,
    History,
    Liveliness,
    Qos,
    Reliability,
)
from rsltrace.simulation.middleware.services import Client, RequestId, Service
from rsltrace.simulation.middleware.subscription import Subscription
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventKind, OutputKind

_BAG = int(EventKind.BAG)
_MESSAGES = (OutputKind.MESSAGE, OutputKind.LOG)

Payload = Callable[[], bytes]


@dataclass(frozen=True, slots=True)
class Sent:
    """Something that a stand-in sends once more: canonical CDR, and the hash of its content.

    ``answers`` is, of a response, the client that asked (by name of the service and id in the run)
    and which of its requests it was.
    """

    kind: OutputKind
    entity: int
    data: Payload
    hash: int
    answers: tuple[int, int] | None = None


class _AbsentPublisher(Publisher):
    """Sends only to those who are here."""

    def connect(self, subscription: Subscription) -> None:
        if not isinstance(subscription, _AbsentSubscription):
            super().connect(subscription)

    def send_history(self, subscription: Subscription) -> None:
        if not isinstance(subscription, _AbsentSubscription):
            super().send_history(subscription)

    def is_heard(self) -> bool:
        """Return whether what it sends matters to anybody now, or may later."""
        return bool(self.subscriptions) or self._history is not None

    def unheard(self) -> None:
        """Count a message that nobody here would get."""
        self._count += 1

    def dispatch(self) -> None:
        raise AssertionError("never in a queue")


class _Absent(Receiver):
    begins_active = False

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.queue = deque(maxlen=0)


class _AbsentSubscription(_Absent, Subscription):
    """Takes nothing: a subscription of a node that does not run."""


class _AbsentService(_Absent, Service):
    """Takes nothing."""


class _AbsentClient(_Absent, Client):
    """Takes nothing."""


class StandIns:
    """The stand-ins of one run, by the ids that those they stand for had in the recording.

    ``definitions`` gives the definition and type hash of an interface, where they are known.
    """

    def __init__(self, domain: Domain, definitions: Callable[[str], tuple[str, str]]) -> None:
        self._domain = domain
        self._definitions = definitions
        self._made: dict[int, Any] = {}
        self.fed = 0
        """How many messages, requests and responses have been sent."""

    def perform(
        self,
        created: Sequence[Entity],
        sent: Sequence[Sent],
        busy_ns: int,
        clients: Callable[[int], Client | None],
    ) -> None:
        """Do what a recorded event did, as one event: make endpoints, send.

        ``busy_ns`` is how much later than the event its messages left, ``clients`` finds who asked
        a service, by its id in the recording.
        """
        for entity in created:
            self._create(entity)
        wanted = [one for one in sent if self._is_wanted(one)]
        if not created and not wanted:
            return
        contents = [one.data() for one in wanted]

        def body() -> None:
            event = self._domain.dispatcher.event
            before, event.busy_ns = event.busy_ns, busy_ns
            for one, data in zip(wanted, contents, strict=True):
                self._send(one, data, clients)
            event.busy_ns = before

        first = self._made.get(wanted[0].entity) if wanted else None
        handle = first or _Newcomers()
        self._domain.dispatcher.execute(
            handle,
            0 if first is None else first.entity_id,
            None,
            _BAG,
            body,
            (),
            NO_EVENT,
            0,
            wanted[0].hash if wanted else 0,
        )

    def _is_wanted(self, one: Sent) -> bool:
        end = self._made.get(one.entity)
        if isinstance(end, _AbsentPublisher):
            if end.is_heard():
                return True
            end.unheard()
            return False
        if isinstance(end, Client):
            return any(not isinstance(server, _AbsentService) for server in end.servers())
        return one.answers is not None and end is not None

    def _send(self, one: Sent, data: bytes, clients: Callable[[int], Client | None]) -> None:
        end = self._made[one.entity]
        if isinstance(end, Publisher):
            end.send(data, one.hash)
        elif isinstance(end, Client):
            end.request(data)
        else:
            assert one.answers is not None
            asked = clients(one.answers[0])
            if asked is None or not asked.has_asked(one.answers[1]):
                return  # other code than was recorded, which has not asked
            end.respond(data, RequestId(asked, one.answers[1]))
        self.fed += 1

    # -- who stands in ---------------------------------------------------------------------------

    def _create(self, entity: Entity) -> None:
        domain, kind = self._domain, entity.kind
        if kind is EntityKind.NODE:
            namespace, _, name = entity.name.rpartition("/")
            self._made[entity.id] = domain.join(name, namespace or "/")
            return
        owner = self._made.get(entity.node)
        if not isinstance(owner, Participant):
            return
        made: DomainEntity
        if kind is EntityKind.PUBLISHER:
            made = _AbsentPublisher(
                domain.transport, owner, entity.name, self._message(entity.type), _qos(entity)
            )
            domain.graph.add_publisher(made)
        elif kind is EntityKind.SUBSCRIPTION:
            made = _AbsentSubscription(
                domain.dispatcher, owner, entity.name, self._message(entity.type), _qos(entity)
            )
            domain.graph.add_subscription(made)
        elif kind is EntityKind.SERVICE:
            made = _AbsentService(
                domain.transport, owner, entity.name, self._service(entity.type), DEFAULT_QOS
            )
            domain.graph.add_service(made)
        elif kind is EntityKind.CLIENT:
            made = _AbsentClient(
                domain.transport, owner, entity.name, self._service(entity.type), DEFAULT_QOS
            )
            domain.graph.add_client(made)
        else:
            return
        self._made[entity.id] = made

    def _message(self, name: str) -> MessageType:
        return MessageType(name, lambda: self._definitions(name))

    def _service(self, name: str) -> ServiceType:
        return ServiceType(
            name, self._message(f"{name}_Request"), self._message(f"{name}_Response")
        )


class _Newcomers:
    """Stands for a handle in an event that only makes stand-ins."""

    node = None

    def dispatch(self) -> None:
        raise AssertionError("never in a queue")

    def describe(self) -> str:
        return "those who are not here"


def _qos(entity: Entity) -> Qos:
    """Return the QoS that a trace tells of an endpoint."""
    qos = entity.detail.get("qos")
    values: Mapping[str, Any] = qos if isinstance(qos, Mapping) else {}

    def word(kind: Any, key: str, default: Any) -> Any:
        return kind.__members__.get(str(values.get(key, "")).upper(), default)

    return Qos(
        history=word(History, "history", History.KEEP_LAST),
        depth=_whole(values.get("depth"), 10),
        reliability=word(Reliability, "reliability", Reliability.RELIABLE),
        durability=word(Durability, "durability", Durability.VOLATILE),
        deadline_ns=_whole(values.get("deadline_ns"), 0),
        lifespan_ns=_whole(values.get("lifespan_ns"), 0),
        liveliness=word(Liveliness, "liveliness", Liveliness.AUTOMATIC),
        lease_ns=_whole(values.get("lease_ns"), 0),
    )


def _whole(value: object, default: int) -> int:
    return value if isinstance(value, int) and value >= 0 else default
