"""Log records, parsed from their bytes.

They are shown often, and loading the schema decoder takes longer than the rest of a first screen.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import Output
from rsltrace.trace.model.operation import NODE_TOPICS
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace

# Topics without publisher, services and actions without server: mostly a misspelt name or a missing
# node.

_STANDARD = frozenset((*NODE_TOPICS, "/clock", "/tf", "/tf_static", "/diagnostics", "/joy"))
"""Topics that nodes subscribe to in case that somebody publishes them."""

_HIDDEN = "/_"
_NAMED_MAX = 3


def silent_topics(entities: Iterable[Entity]) -> str:
    """Return ``nobody publishes /scan, which /follower listens to``, "" if all are published."""
    wanted = _wanted(entities, EntityKind.SUBSCRIPTION, EntityKind.PUBLISHER)
    silent = [(topic, nodes) for topic, nodes in wanted if topic not in _STANDARD]
    if not silent:
        return ""
    if len(silent) == 1:
        topic, listeners = silent[0]
        verb = "listen" if len(listeners) > 1 else "listens"
        return f"nobody publishes {printable(topic)}, which {_and(list(listeners))} {verb} to"
    return f"topics without a publisher: {_names_text(silent, 'topics')}"


def unheard_topics(entities: Sequence[Entity], player: str) -> str:
    """Return ``nobody subscribes to /scan, which a bag plays``, "" if all that the node ``player``
    publishes is heard."""
    players = {one.id for one in entities if one.name == player}
    heard = {one.name for one in entities if one.kind is EntityKind.SUBSCRIPTION}
    played = (e.name for e in entities if e.kind is EntityKind.PUBLISHER and e.node in players)
    unheard = sorted(set(played) - heard - set(NODE_TOPICS))
    return f"nobody subscribes to {_and(unheard)}, which a bag plays" if unheard else ""


def missing_servers(entities: Iterable[Entity]) -> str:
    """Return ``nobody serves /reset, of which /panel is a client``, "" if there is none."""
    missing = _wanted(entities, EntityKind.CLIENT, EntityKind.SERVICE)
    if not missing:
        return ""
    if len(missing) == 1:
        name, clients = missing[0]
        verb = "are clients" if len(clients) > 1 else "is a client"
        return f"nobody serves {printable(name)}, of which {_and(list(clients))} {verb}"
    return f"services without a server: {_names_text(missing, 'services')}"


def _wanted(
    entities: Iterable[Entity], wants: EntityKind, gives: EntityKind
) -> list[tuple[str, dict[str, None]]]:
    """Return the names that some entities want and none gives, with the nodes that want them."""
    nodes: dict[int, str] = {}
    given: set[str] = set()
    wanted: dict[str, dict[str, None]] = {}
    for entity in entities:
        name = entity.name
        if wants is EntityKind.CLIENT:  # those of an action are named by it
            name = name.partition("/_action/")[0]
        if entity.kind is EntityKind.NODE:
            nodes[entity.id] = name
        elif entity.kind is gives:
            given.add(name)
        elif entity.kind is wants:
            wanted.setdefault(name, {})[nodes.get(entity.node, "a program")] = None
    return [one for one in wanted.items() if one[0] not in given and _HIDDEN not in one[0]]


def _names_text(found: list[tuple[str, dict[str, None]]], what: str) -> str:
    """Return ``/a (for /x), /b (for /y) and 2 more topics``."""
    texts = [f"{printable(name)} (for {_and(list(whom))})" for name, whom in found[:_NAMED_MAX]]
    more = len(found) - _NAMED_MAX
    return f"{', '.join(texts)}{f' and {more} more {what}' if more > 0 else ''}"


def _and(names: list[str]) -> str:
    shown = [printable(name) for name in names[:2]]
    more = len(names) - len(shown)
    return " and ".join(shown) if not more else f"{', '.join(shown)} and {more} more"


LEVEL_WARN = 30
_TYPE = "rcl_interfaces/msg/Log"
_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}
_HEAD = struct.Struct("<4xiIB")
_LENGTH = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class LogRecord:
    """A log record: level as a number (30: warning), logger name, text, ``module.py:31``."""

    level: int
    name: str
    text: str
    place: str = ""

    @property
    def level_name(self) -> str:
        """``WARN``, or the number of an unusual level."""
        return _LEVELS.get(self.level, str(self.level))


def log_record(trace: Trace, output: Output) -> LogRecord | None:
    """Return the log record of an output; None if it was not recorded or is unreadable."""
    try:
        found = trace.payload(output)
        channel = trace.channel_of(output)
        if found is None or channel is None or channel.type != _TYPE:
            return None
        return parse_log(found[2])
    except (TraceError, ValueError):
        return None


def parse_log(data: bytes) -> LogRecord:
    """Parse an ``rcl_interfaces/msg/Log`` in CDR. Raises ValueError for anything else."""
    try:
        _, _, level = _HEAD.unpack_from(data)
        name, position = _string(data, _HEAD.size)
        text, position = _string(data, position)
        file, position = _string(data, position)
        _, position = _string(data, position)
        (line,) = _LENGTH.unpack_from(data, position + (-position % 4))
    except (struct.error, IndexError) as error:
        raise ValueError(f"not a log record: {error}") from error
    return LogRecord(level, name, text, f"{file}:{line}" if file else "")


def _string(data: bytes, position: int) -> tuple[str, int]:
    position += -(position - 4) % 4
    (length,) = _LENGTH.unpack_from(data, position)
    end = position + _LENGTH.size + length
    if end > len(data):
        raise IndexError("a string is cut off")
    return data[position + _LENGTH.size : end].rstrip(b"\0").decode("utf-8", "replace"), end
