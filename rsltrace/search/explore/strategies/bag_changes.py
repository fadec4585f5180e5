"""What a bag could have played instead: other values, another order, a message once more."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rsltrace.errors import TraceError
from rsltrace.run.plans.bags import PLAYER
from rsltrace.simulation.chance.stream import Stream
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.reader import Trace

if TYPE_CHECKING:
    from rsltrace.trace.leaves import Leaf

_KINDS = ("change", "change", "change", "change", "swap", "repeat")
_SCALES = (-1, 0.1, 0.5, 1.1, 2, 10, 1000)
_TEXTS = ("", "x", "0", "-1", "nan", "é" * 64, "x" * 1000)
_BEYOND_INTEGERS = 1e20


@dataclass(frozen=True, slots=True)
class Played:
    """A topic that a bag plays: which of its messages may be disturbed, its fields, and how long
    the arrays of its first message are, by their names."""

    messages: range
    leaves: Sequence[Leaf]
    lengths: dict[str, int]

    def fault(self, topic: str, draw: Stream) -> dict[str, Any]:
        """Draw a fault of one of the messages."""
        kind = _KINDS[draw.below(len(_KINDS))]
        number = self.messages[draw.below(len(self.messages))]
        if kind == "change" and not self.leaves:
            kind = "swap"
        if kind == "repeat" and number == 1:
            kind = "swap"
        found = {kind: topic, "message": number}
        return {**found, **self._change(draw)} if kind == "change" else found

    def _change(self, draw: Stream) -> dict[str, Any]:
        leaf = self.leaves[draw.below(len(self.leaves))]
        name = ""
        *arrays, last = leaf.name.split("[]")
        bare = ""
        for array in arrays:
            bare += array
            name += f"{array}[{self._place(bare, draw)}]"
            bare += "[]"
        name += last
        if leaf.length_max is None:
            return {"field": name, **_another(leaf.type, draw)}
        count = self.lengths.get(leaf.name, 0)
        lengths = [0, 1, max(count - 1, 0), count + 1, 2 * count]
        return {"field": name, "length": min(lengths[draw.below(5)], leaf.length_max)}

    def _place(self, array: str, draw: Stream) -> str:
        """Draw which items of an array change."""
        count = max(self.lengths.get(array, 1), 1)
        return ("*", "0", "-1", str(draw.below(count)))[draw.below(4)]


def played_in(trace: Trace, messages: dict[str, range]) -> dict[str, Played]:
    """Return what bags have played in a run, of those topics of which some messages may be
    disturbed."""
    found = {}
    for name in sorted({one.name for one in trace.entities.values() if is_played(trace, one)}):
        if name in messages:
            leaves: list[Leaf] = []
            lengths: dict[str, int] = {}
            with suppress(TraceError):  # it keeps none of them: they can change places
                leaves = trace.leaves(name)
                first = next(trace.messages(name), None)
                if first is not None:
                    lengths.update(_lengths(trace.decode(name, first[-1]), leaves))
            there = [leaf for leaf in leaves if _is_there(leaf, lengths)]
            found[name] = Played(messages[name], there, lengths)
    return found


def is_played(trace: Trace, entity: Entity) -> bool:
    """Whether an entity of a run publishes what a bag plays."""
    is_publisher = entity.kind is EntityKind.PUBLISHER
    return is_publisher and trace.node_of(entity).name == f"/{PLAYER}"


def _lengths(message: Any, leaves: Sequence[Leaf]) -> Iterator[tuple[str, int]]:
    """Yield how long the arrays of a message are; of those within others, the first one."""
    for leaf in leaves:
        value, name = message, ""
        if leaf.length_max is None:
            continue
        for part in leaf.name.split("."):
            field = part.removesuffix("[]")
            value = getattr(value, field, ())
            name = f"{name}.{field}" if name else field
            if field != part:
                if not len(value):
                    break
                value, name = value[0], f"{name}[]"
        else:
            yield name, len(value)


def _is_there(leaf: Leaf, lengths: dict[str, int]) -> bool:
    """Whether none of the arrays that a field is in is empty."""
    arrays = leaf.name.split("[]")[:-1]
    return all(lengths.get("[]".join(arrays[: n + 1]), 1) for n in range(len(arrays)))


def _another(kind: str, draw: Stream) -> dict[str, Any]:
    """Draw another value for a field of a type."""
    if kind == "string":
        return {"value": _TEXTS[draw.below(len(_TEXTS))]}
    if kind == "bool":
        return {"value": bool(draw.below(2))}
    is_float = kind.startswith("float")
    what = draw.below(3)
    if what == 0:
        return {"scale": _SCALES[draw.below(len(_SCALES))]}
    sign = 1 if draw.below(2) else -1
    if what == 1:
        return {"offset": sign * 10 ** draw.below(5) / (100 if is_float else 1)}
    if is_float:
        values = ("nan", "inf", "-inf", 0, 3e38 * sign)
        return {"value": values[draw.below(len(values))]}
    # Beyond all limits is the limit of the field's type.
    return {"offset": _BEYOND_INTEGERS * sign} if draw.below(2) else {"value": 0}
