"""Which topics Rerun's loader may read: it has no limits of its own for what a type says.

A sequence of empty messages is four bytes that ask for gigabytes, a fixed array asks for as many
values as one likes. rosbags' definition of a type, which our own decoder has checked, tells.
"""

from __future__ import annotations

from typing import Any

from rosbags.interfaces import Nodetype

from rsltrace.errors import TraceError
from rsltrace.trace.decode import Decoders
from rsltrace.trace.reader import Trace

_VALUES_MAX = 1 << 20
"""In the parts of a message whose size is fixed."""


def left_out(trace: Trace) -> dict[str, str]:
    """Return the topics whose messages Rerun must not read, and why not."""
    decoders = Decoders()
    found = {}
    for channel in trace.channels.values():
        try:
            decoder = decoders.of(channel)
            values = _values(decoder.name, decoder.types, {})
        except TraceError as error:
            found[channel.topic] = str(error)
            continue
        except _EmptyItems as error:
            found[channel.topic] = f"{channel.type} has a sequence of {error}, which has no fields"
            continue
        if decoder.wide_texts:
            found[channel.topic] = f"{channel.type} has wide texts (wstring)"
        elif values > _VALUES_MAX:
            found[channel.topic] = f"a {channel.type} has {values} values, more than {_VALUES_MAX}"
    return found


class _EmptyItems(Exception):
    """A sequence whose items have no bytes."""


def _values(name: str, types: dict[str, Any], known: dict[str, int]) -> int:
    """Return how many values a message has at least, the messages in it among them.

    ``types`` do not contain themselves. Raises _EmptyItems.
    """
    if name not in known:
        known[name] = sum(_values_of(field, types, known) for _, field in types[name][1])
    return known[name]


def _values_of(field: Any, types: dict[str, Any], known: dict[str, int]) -> int:
    kind, detail = field
    if kind == Nodetype.BASE:
        return 1
    if kind == Nodetype.NAME:
        return 1 + _values(detail, types, known)
    item, size = detail
    if kind == Nodetype.SEQUENCE:
        if _is_empty(item, types):
            raise _EmptyItems(item[1])
        _values_of(item, types, known)  # within limits, and no sequences of nothing in it
        return 1
    return int(size) * _values_of(item, types, known)


def _is_empty(field: Any, types: dict[str, Any]) -> bool:
    """Whether a field has no bytes: messages of messages of nothing."""
    kind, detail = field
    if kind == Nodetype.ARRAY:
        return _is_empty(detail[0], types)
    return kind == Nodetype.NAME and _has_no_bytes(detail, types, {})


def _has_no_bytes(name: str, types: dict[str, Any], known: dict[str, bool]) -> bool:
    if name not in known:
        known[name] = all(
            (kind == Nodetype.NAME and _has_no_bytes(detail, types, known))
            or (
                kind == Nodetype.ARRAY
                and detail[0][0] == Nodetype.NAME
                and _has_no_bytes(detail[0][1], types, known)
            )
            for _, (kind, detail) in types[name][1]
        )
    return known[name]
