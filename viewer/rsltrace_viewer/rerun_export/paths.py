"""Where things are in Rerun's tree of entities, and what they are called there.

    [run_a/] events                        the table of all events
           nodes/NODE                      its callbacks, as a lane of states
           nodes/NODE/log                  its log records, and the tracebacks of exceptions
           nodes/NODE/rate                 its callbacks per simulated second
           nodes/NODE/KIND/NAME            the events of one entity, and its rate
           topics/TOPIC                    its messages as data, and what Rerun draws of them
           services/SERVICE/request        the same for the messages of services
    frames/FRAME                           of two runs: what joins their frames
    divergence                             of two runs: what the diff says, and marks

The prefix, ``run_a`` or ``run_b``, is there when two runs are shown.
"""

from __future__ import annotations

import rerun as rr

from rsltrace.trace.format import PREFIX_REQUEST, PREFIX_RESPONSE
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.printable import printable
from rsltrace.trace.reader import Trace

NO_NODE = "(run)"
"""Where the events are that belong to no node, such as the construction of nodes."""


def join(*parts: str) -> str:
    """Return the entity path of some parts; each may hold slashes, which make more parts."""
    names = [name for part in parts for name in part.split("/") if name]
    return "/" + "/".join(rr.escape_entity_path_part(name) for name in names)


class Paths:
    """The paths of one run. ``label`` is empty for a single run, or ``a`` or ``b``.

    ``root`` is above all of them; it comes behind ``divergence`` in the alphabet, in which the
    viewer lists.
    """

    def __init__(self, label: str, trace: Trace) -> None:
        self.label = label
        self.root = f"run_{label}" if label else ""
        self._trace = trace
        self._ordinals: dict[int, int] = {}
        seen: dict[tuple[int, EntityKind, str], int] = {}
        for entity in trace.entities.values():
            key = (entity.node, entity.kind, entity.name)
            self._ordinals[entity.id] = seen[key] = seen.get(key, 0) + 1

    @property
    def events(self) -> str:
        """The table of events."""
        return join(self.root, "events")

    @property
    def nodes(self) -> str:
        """Above all nodes."""
        return join(self.root, "nodes")

    @property
    def topics(self) -> str:
        """Above all topics."""
        return join(self.root, "topics")

    def node_name(self, entity: Entity) -> str:
        """Return the name of the node that owns an entity, or ``(run)``."""
        owner = self._trace.entities.get(entity.node)
        return printable(owner.name) if owner is not None and owner.name else NO_NODE

    def node(self, name: str) -> str:
        """Return the path of a node."""
        return join(self.root, "nodes", name)

    def callback(self, entity: Entity) -> str:
        """Return the path of an entity that runs callbacks or sends something."""
        if entity.kind in (EntityKind.NODE, EntityKind.SYSTEM):
            return join(self.root, "nodes", self.node_name(entity), entity.kind.label)
        return join(
            self.root, "nodes", self.node_name(entity), entity.kind.label, self.name(entity)
        )

    def name(self, entity: Entity) -> str:
        """Return an entity's name, with a number if its node has several of that name."""
        name = printable(entity.name) or f"{entity.kind.label} {entity.id}"
        ordinal = self._ordinals.get(entity.id, 1)
        return f"{name} #{ordinal}" if ordinal > 1 else name

    def topic(self, topic: str) -> str:
        """Return the path of a topic, or of the request or response side of a service."""
        for prefix, side in ((PREFIX_REQUEST, "request"), (PREFIX_RESPONSE, "response")):
            if topic.startswith(f"{prefix}/"):
                return join(self.root, "services", printable(topic[len(prefix) :]), side)
        return join(self.root, "topics", printable(topic))
