"""A message in a few words, for a row: ``x=0.31 ω=-0.05``. What is zero or long is left out."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rsltrace.errors import TraceError
from rsltrace.trace.model.event import NO_SEQUENCE, Output, OutputKind
from rsltrace.trace.model.texts import PLACEHOLDERS, printable, shortened
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.events import EventText, outputs_text

_NOT_SHOWN = PLACEHOLDERS | {"header", "stamp"}
_VALUES_MAX = 5
_LEAVES_MAX = 60
_TEXT_MAX = 30
_TURNS = {"x": "ωx", "y": "ωy", "z": "ω"}


def message_values(message: object) -> str:
    """Return the values of a decoded message that tell most."""
    leaves = list(_leaves(message, ""))[:_LEAVES_MAX]
    told = [leaf for leaf in leaves if leaf[1] not in ("0", "false", '""', "[]")] or leaves[:2]
    # Names of frames and the like rarely change: they come last.
    told = sorted(told, key=lambda leaf: leaf[1].startswith('"'))[:_VALUES_MAX]
    short = Counter(path.rpartition(".")[2] for path, _ in told)
    parts = []
    for path, value in told:
        name = path.rpartition(".")[2]
        if short[name] > 1:
            name = ".".join(path.split(".")[-2:])
        parts.append(f"{name}={value}" if len(leaves) > 1 else value)
    return printable(" ".join(parts))


def differing_values(a: object, b: object) -> tuple[str, str]:
    """Return the first values in which two decoded messages differ, in full."""
    leaves = [dict(list(_leaves(one, "", in_full=True))[:_LEAVES_MAX]) for one in (a, b)]
    paths = [path for path in leaves[0] if leaves[0][path] != leaves[1].get(path)]
    texts = [
        printable(" ".join(f"{path.rpartition('.')[2]}={one.get(path, '-')}" for path in paths))
        for one in leaves
    ]
    return texts[0], texts[1]


def field_name(path: str, *, whole: bool = False) -> str:
    """Return how a row calls a field: ``x``, of an angular velocity ``ω``; ``whole``: with the
    field it is in. A message that has nothing but ``data`` needs no name."""
    names = path.split(".")
    name = names[-1].rstrip("_")
    if "angular" in names[:-1]:
        name = _TURNS.get(name, name)
    if path == "data":
        return ""
    return ".".join([*names[-2:-1], name]) if whole else name


def _leaves(value: Any, path: str, in_full: bool = False) -> Iterator[tuple[str, str]]:
    if isinstance(value, (bool, np.bool_)):
        yield path, "true" if value else "false"
    elif isinstance(value, (int, np.integer)):
        yield path, str(value)
    elif isinstance(value, (float, np.floating)):
        yield path, repr(float(value)) if in_full else number(float(value))
    elif isinstance(value, str):
        yield path, f'"{shortened(value, _TEXT_MAX)}"'
    elif isinstance(value, (list, np.ndarray)):
        if in_full:
            for place, item in enumerate(value[:_LEAVES_MAX]):
                yield from _leaves(item, f"{path}[{place}]", in_full)
        elif "covariance" not in path:
            yield path, _items(value)
    elif dataclasses.is_dataclass(value):
        yield from _fields(value, path, in_full)


def _fields(message: Any, path: str, in_full: bool) -> Iterator[tuple[str, str]]:
    left_out = PLACEHOLDERS if in_full else _NOT_SHOWN
    names = [f.name for f in dataclasses.fields(message) if f.name not in left_out]
    if names == ["x", "y", "z", "w"] and not in_full:  # a quaternion: its turn is what tells
        yield f"{path}.θ".lstrip("."), number(_yaw(*(float(getattr(message, n)) for n in names)))
        return
    turns = "angular" in path and names == ["x", "y", "z"]
    for name in names:
        inner = _TURNS[name] if turns else name.rstrip("_")
        yield from _leaves(getattr(message, name), f"{path}.{inner}".lstrip("."), in_full)


def _items(values: Any) -> str:
    if not len(values):
        return "[]"
    if len(values) <= 3 and not dataclasses.is_dataclass(values[0]):
        return "[" + " ".join(value for item in values for _, value in _leaves(item, "")) + "]"
    return f"[{len(values)}]"


def _yaw(x: float, y: float, z: float, w: float) -> float:
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def number(value: float, digits: int = 4) -> str:
    """Return a number in so many digits: ``0.31``, ``1.234e+06``."""
    text = f"{value:.{digits}g}"
    return "0" if text == "-0" else text


# What events sent and got, with values, for rows. Read apart from the rows: messages have to be
# decoded for it, and the first of each type takes as long as a screen may.

_MESSAGES = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)
_BYTES_MAX = 1 << 16
_OUTPUTS_MAX = 12
_KEPT = 4096


class RowValues:
    """The texts of one run's events that have been read so far."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._texts: OrderedDict[int, str] = OrderedDict()
        self._events: dict[int, EventText] = {}

    def known(self, event: EventText) -> EventText:
        """Return an event with the values of what it did, if these have been read."""
        text = self._texts.get(event.index)
        if not text:
            return event
        found = self._events.get(event.index)
        if found is None:
            found = self._events[event.index] = replace(event, outputs=text)
        return found

    def read(self, indexes: Sequence[int]) -> Iterator[int]:
        """Read events, one at a time; yields how many are done."""
        for count, index in enumerate(indexes, start=1):
            if index not in self._texts:
                self._texts[index] = self._text(index)
                while len(self._texts) > _KEPT:
                    self._events.pop(self._texts.popitem(last=False)[0], None)
            yield count

    def _text(self, index: int) -> str:
        run = self._run
        try:
            event = run.event(index)
            outputs = run.outputs(index)
            if any(output.kind is not OutputKind.DRAW for output in outputs):
                budget = iter(range(_OUTPUTS_MAX))
                return outputs_text(
                    run, outputs, more=lambda o: "" if next(budget, None) is None else self._of(o)
                )
            source = run.input_of(event)
            if source is None or source.kind not in _MESSAGES:
                return ""
            values = self._of(source)
            drawn = outputs_text(run, outputs)
            return ", ".join(filter(None, (values and f"got {values}", drawn)))
        except TraceError:
            return ""  # the row says what is wrong, without values

    def _of(self, output: Output) -> str:
        if output.kind not in _MESSAGES or output.sequence == NO_SEQUENCE:
            return ""
        trace = self._run.trace
        try:
            found = trace.payload(output)
            channel = trace.channel_of(output)
            if found is None or channel is None:
                return ""
            if len(found[2]) > _BYTES_MAX:
                return f"({len(found[2]) / 1e6:.1f} MB)"
            return message_values(trace.decode(channel, found[2]))
        except TraceError:
            return ""
