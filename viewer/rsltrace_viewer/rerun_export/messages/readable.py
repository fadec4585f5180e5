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
        if values > _VALUES_MAX:
            found[channel.topic] = f"a {channel.type} has {values} values, more than {_VALUES_MAX}"
    return found


class _EmptyItems(Exception):
    """A sequence whose items have no bytes."""


def _values(name: str, types: dict[str, Any], known: dict[str, int]) -> int:
    """Return how many values a message has at least. ``types`` do not contain themselves."""
    if name not in known:
        known[name] = sum(_values_of(field, types, known) for _, field in types[name][1])
    return known[name]


def _values_of(field: Any, types: dict[str, Any], known: dict[str, int]) -> int:
    kind, detail = field
    if kind == Nodetype.BASE:
        return 1
    if kind == Nodetype.NAME:
        return _values(detail, types, known)
    item, size = detail
    each = _values_of(item, types, known)
    if kind == Nodetype.SEQUENCE:
        if not each:
            raise _EmptyItems(item[1])
        return 1
    return int(size) * each
