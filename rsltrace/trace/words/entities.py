"""Names of entities, by their ids in one trace and independent of ids; words for kinds and flags;
a colour for each node."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from zlib import crc32

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind
from rsltrace.trace.model.texts import printable

LOG_LEVELS = {"debug": 10, "info": 20, "warn": 30, "warning": 30, "error": 40, "fatal": 50}


def is_named(pattern: str, name: str) -> bool:
    """Whether a name matches: a glob as a whole, ``/x`` exactly, ``x`` as a part."""
    if any(c in pattern for c in "*?["):
        return fnmatchcase(name, pattern)
    if pattern.startswith("/"):
        return name == pattern
    return pattern.casefold() in name.casefold()


def short_name(node: str) -> str:
    """Return the last part of a node's name: ``ekf`` of ``/robot/ekf``."""
    return node.rsplit("/", 1)[-1]


def nodes_called(name: str, nodes: Iterable[str]) -> list[str]:
    """Return the nodes that somebody means who calls one ``name``: its full or its short name."""
    nodes = list(nodes)
    if name in nodes:
        return [name]
    return [one for one in nodes if short_name(one) == name or one == f"/{name}"]


RUN_NAME = "(run)"
"""The displayed node of what belongs to the run itself."""


@dataclass(frozen=True, slots=True)
class EntityKey:
    """An entity independent of its id.

    ``ordinal`` distinguishes otherwise equal entities: 0, 1, … in creation order.
    """

    node: str
    kind: str
    name: str
    type: str
    ordinal: int = 0

    def __str__(self) -> str:
        number = f" #{self.ordinal + 1}" if self.ordinal else ""
        return f"{self.node or RUN_NAME}: {self.kind} {self.name}{number}"


class EntityNames:
    """The names of one trace's entities by id, printable."""

    def __init__(self, entities: Mapping[int, Entity]) -> None:
        self._names: dict[int, tuple[str, str]] = {0: ("", "")}
        for entity in entities.values():
            owner = entities.get(entity.node)
            node = printable(owner.name) if owner is not None else ""
            name = printable(entity.name) or (entity.kind.label if entity.id else "")
            self._names[entity.id] = node, name

    def node(self, entity_id: int) -> str:
        """Return the name of an entity's node; empty for the run."""
        return self._names.get(entity_id, ("", ""))[0]

    def name(self, entity_id: int) -> str:
        """Return an entity's name, or its kind if it has none; ``#7`` if the trace does not
        describe it, empty for the run."""
        return self._names.get(entity_id, ("", f"#{entity_id}"))[1]

    @property
    def longest_node(self) -> int:
        return max(len(node) for node, _ in self._names.values())

    @property
    def longest_name(self) -> int:
        return max(len(name) for _, name in self._names.values())


NODE_COLOURS = (
    ("#76e2e3", "#086869"),
    ("#b4cffe", "#2855ad"),
    ("#ebb9f7", "#7e388e"),
    ("#cfc5fe", "#6044a6"),
    ("#719def", "#032e84"),
    ("#2eabe1", "#063d54"),
    ("#c282d0", "#570c66"),
    ("#a28ee8", "#3f1c7c"),
)
"""For a dark and for a light background. Red, amber and green are left out: they mean that runs
differ."""


def node_colours(names: Iterable[str]) -> dict[str, int]:
    """Return the colour of each node, its place in ``NODE_COLOURS``.

    It follows from the name; of two nodes with the same one, the later name takes the next that is
    free.
    """
    count, found, used = len(NODE_COLOURS), dict[str, int](), set[int]()
    for name in sorted(set(names)):
        wanted = crc32(name.encode(errors="replace")) % count
        order = [*range(wanted, count), *range(wanted)]
        found[name] = next((one for one in order if one not in used), wanted)
        used.add(found[name])
    return found


SHORT_KINDS = {
    EventKind.CONSTRUCT: "init",
    EventKind.TIMER: "timer",
    EventKind.SUBSCRIPTION: "sub",
    EventKind.SERVICE: "srv",
    EventKind.CLIENT: "client",
    EventKind.GUARD_CONDITION: "guard",
    EventKind.TASK: "task",
    EventKind.RESUME: "resume",
    EventKind.QOS_EVENT: "qos",
    EventKind.BAG: "bag",
    EventKind.SHUTDOWN: "end",
    EventKind.ACTION: "action",
    EventKind.CLOCK_JUMP: "jump",
    EventKind.OUTSIDE: "driver",
    EventKind.FAULT: "fault",
}
"""Kinds of events in at most six letters, for narrow columns."""

_FLAGS = tuple((flag, str(flag.name).lower()) for flag in EventFlag if flag)


def kind_label(kinds: type[EventKind] | type[OutputKind], number: int) -> str:
    """Return the name of a kind; ``kind 99`` for one of a newer rsltrace."""
    try:
        return kinds(number).label
    except ValueError:
        return f"kind {number}"


def flag_names(flags: int) -> list[str]:
    """Return the names of flags: ``raised``, ``suspended``."""
    return [name for flag, name in _FLAGS if flags & flag]
