"""What there is in a run, so that a mistyped name is an error at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from rsltrace.errors import near_or_all
from rsltrace.trace.model.entity import WITH_TOPIC, Entity, EntityKind
from rsltrace.trace.words.entities import is_named

Fields = Callable[[str], Mapping[str, str] | None]
"""By the name of an interface (``nav_msgs/msg/Odometry``), its fields and their types."""


def _no_fields(interface: str) -> None:
    return None


@dataclass(frozen=True, slots=True)
class RunNames:
    """The names of a run's nodes, topics (and services) and entities.

    Unless they ``are_all`` (the run may make more), a name that is none of them is no mistake.
    ``interfaces`` is by topic; ``fields`` knows those of an interface, or None.
    """

    nodes: tuple[str, ...] = ()
    topics: tuple[str, ...] = ()
    entities: tuple[str, ...] = ()
    are_all: bool = False
    interfaces: Mapping[str, str] = field(default_factory=dict)
    fields: Fields = _no_fields

    def unknown(self, pattern: str, names: Iterable[str], what: str) -> str:
        """Return what is wrong with a pattern that has to fit one of ``names``, empty if nothing
        is."""
        names = tuple(names)
        if not self.are_all or any(is_named(pattern, name) for name in names):
            return ""
        return f"no {what} is called {pattern!r}{near_or_all(pattern, names)}"


def names_of(
    entities: Iterable[Entity], *, are_all: bool = True, fields: Fields = _no_fields
) -> RunNames:
    """Return the names of entities, as those of a trace."""
    entities = tuple(entities)
    with_topic = [one for one in entities if one.kind in WITH_TOPIC]
    return RunNames(
        nodes=_each(one.name for one in entities if one.kind is EntityKind.NODE),
        topics=_each(one.name for one in with_topic),
        entities=_each(one.name for one in entities),
        are_all=are_all,
        interfaces={
            one.name: one.type
            for one in with_topic
            if one.kind in (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION)
        },
        fields=fields,
    )


def _each(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for name in names if name))


def short_name(node: str) -> str:
    """Return the last part of a node's name: ``ekf`` of ``/robot/ekf``."""
    return node.rsplit("/", 1)[-1]


def nodes_called(name: str, nodes: Iterable[str]) -> list[str]:
    """Return the nodes that somebody means who calls one ``name``: its full or its short name."""
    nodes = list(nodes)
    if name in nodes:
        return [name]
    return [one for one in nodes if short_name(one) == name or one == f"/{name}"]
