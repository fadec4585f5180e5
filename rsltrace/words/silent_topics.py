"""Topics that somebody listens to and nobody publishes: a name that is misspelt, most often."""

from __future__ import annotations

from collections.abc import Iterable

from rsltrace.model.built_in import NODE_TOPICS
from rsltrace.model.entity import Entity, EntityKind
from rsltrace.model.printable import printable

_STANDARD = frozenset((*NODE_TOPICS, "/clock", "/tf", "/tf_static", "/diagnostics", "/joy"))
"""What nodes listen to in case that somebody publishes it."""

_HIDDEN = "/_"
_NAMED_MAX = 3


def silent_topics(entities: Iterable[Entity]) -> str:
    """Return ``nobody publishes /scan, which /follower listens to``, "" if all is well."""
    nodes: dict[int, str] = {}
    published: set[str] = set()
    heard: dict[str, dict[str, None]] = {}
    for entity in entities:
        if entity.kind is EntityKind.NODE:
            nodes[entity.id] = entity.name
        elif entity.kind is EntityKind.PUBLISHER:
            published.add(entity.name)
        elif entity.kind is EntityKind.SUBSCRIPTION:
            heard.setdefault(entity.name, {})[nodes.get(entity.node, "a program")] = None
    silent = [
        (topic, listeners)
        for topic, listeners in heard.items()
        if topic not in published and topic not in _STANDARD and _HIDDEN not in topic
    ]
    if not silent:
        return ""
    if len(silent) == 1:
        topic, listeners = silent[0]
        verb = "listen" if len(listeners) > 1 else "listens"
        return f"nobody publishes {printable(topic)}, which {_and(list(listeners))} {verb} to"
    told = [
        f"{printable(topic)} (for {_and(list(listeners))})"
        for topic, listeners in silent[:_NAMED_MAX]
    ]
    more = len(silent) - _NAMED_MAX
    topics = f"{', '.join(told)}{f' and {more} more topics' if more > 0 else ''}"
    return f"nobody publishes what is listened to: {topics}"


def _and(names: list[str]) -> str:
    shown = [printable(name) for name in names[:2]]
    more = len(names) - len(shown)
    return " and ".join(shown) if not more else f"{', '.join(shown)} and {more} more"
