"""What somebody waits for in vain: a topic that nobody publishes, a service or an action that
nobody serves. A name that is misspelt, most often, or a node that is missing."""

from __future__ import annotations

from collections.abc import Iterable

from rsltrace.trace.model.built_in import NODE_TOPICS
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.printable import printable

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
    return f"nobody publishes what is listened to: {_several(silent, 'topics')}"


def without_server(entities: Iterable[Entity]) -> str:
    """Return ``nobody serves /reset, of which /panel is a client``, "" if all is well."""
    nodes: dict[int, str] = {}
    served: set[str] = set()
    called: dict[str, dict[str, None]] = {}
    for entity in entities:
        action = entity.detail.get("action")  # of which a client or server is a part
        name = action if isinstance(action, str) else entity.name
        if entity.kind is EntityKind.NODE:
            nodes[entity.id] = name
        elif entity.kind is EntityKind.SERVICE:
            served.add(name)
        elif entity.kind is EntityKind.CLIENT:
            called.setdefault(name, {})[nodes.get(entity.node, "a program")] = None
    missing = [
        (name, clients)
        for name, clients in called.items()
        if name not in served and _HIDDEN not in name
    ]
    if not missing:
        return ""
    if len(missing) == 1:
        name, clients = missing[0]
        verb = "are clients" if len(clients) > 1 else "is a client"
        return f"nobody serves {printable(name)}, of which {_and(list(clients))} {verb}"
    return f"nobody serves what there are clients of: {_several(missing, 'services')}"


def _several(found: list[tuple[str, dict[str, None]]], what: str) -> str:
    """Return ``/a (for /x), /b (for /y) and 2 more topics``."""
    told = [f"{printable(name)} (for {_and(list(whom))})" for name, whom in found[:_NAMED_MAX]]
    more = len(found) - _NAMED_MAX
    return f"{', '.join(told)}{f' and {more} more {what}' if more > 0 else ''}"


def _and(names: list[str]) -> str:
    shown = [printable(name) for name in names[:2]]
    more = len(names) - len(shown)
    return " and ".join(shown) if not more else f"{', '.join(shown)} and {more} more"
