"""The faults of a job: of messages, of nodes, and of what bags play.

Faults of bags apply before a message is published, so the trace has the faulty message.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.adapters.rclpy.messages.interface_classes import class_of
from rsltrace.adapters.rclpy.messages.message_spec import (
    ArrayType,
    FieldType,
    ItemType,
    MessageSpec,
    PrimitiveType,
    SequenceType,
    StringType,
    message_spec,
)
from rsltrace.errors import BagError, did_you_mean
from rsltrace.job import Job, locate
from rsltrace.simulation.middleware.interface import MessageFault, TopicFaults

if TYPE_CHECKING:
    from rsltrace.adapters.player import BagPublisher
    from rsltrace.adapters.player import Message as BagMessage
    from rsltrace.adapters.rclpy.faults import NodeFaults
    from rsltrace.adapters.rclpy.world import World
    from rsltrace.job.parts.fault import FaultSpec, Step


_FLOAT_MAX = {"f": 3.4028234663852886e38, "d": 1.7976931348623157e308}


class FieldChangeError(ValueError):
    """A field that does not exist or cannot have the value."""


def field_changer(message_class: type, spec: FaultSpec) -> Callable[[bytes], bytes]:
    """Return the function that changes a message (canonical CDR) as a fault says. It raises
    UnfitError for a message whose array lacks the item.

    :raises UnfitError: the class has no such field, or the value does not fit.
    """
    from rsltrace.job.parts.fault import field_steps

    assert spec.field is not None
    steps = field_steps(spec.field)
    new = _change_of(spec, _type_at(message_spec(message_class), steps))
    codec = codec_for(message_class)

    def change(data: bytes) -> bytes:
        message = codec.deserialize(data)
        _change(message, steps, new)
        return codec.serialize(message)

    return change


def _type_at(spec: MessageSpec, steps: tuple[Step, ...]) -> FieldType:
    kind: FieldType = spec
    before = ""
    for name, place in steps:
        if isinstance(kind, (ArrayType, SequenceType)):
            raise FieldChangeError(f"{before} is an array: write {before}[0] or {before}[*]")
        if not isinstance(kind, MessageSpec):
            raise FieldChangeError(f"{before} has no fields")
        fields = {field.name: field.type for field in kind.fields}
        if name not in fields:
            near = did_you_mean(name, fields)
            listed = ", ".join(fields)
            raise FieldChangeError(f"{kind.type_name} has no field {name} (it has {listed}){near}")
        kind, before = fields[name], name
        if place is not None:
            if not isinstance(kind, (ArrayType, SequenceType)):
                raise FieldChangeError(f"{name} is no array, so there is no {name}[{place}]")
            kind = kind.item
    return kind


def _change_of(spec: FaultSpec, kind: FieldType) -> Callable[[Any], Any]:
    """Return the function from a field's old value to its new one."""
    name = str(spec.field)
    if isinstance(kind, (ArrayType, SequenceType)):
        return _change_of_array(spec, kind, name)
    if spec.length is not None or isinstance(spec.value, list):
        raise FieldChangeError(f"{name} is no array")
    if isinstance(kind, MessageSpec):
        raise FieldChangeError(f"{name} is a {kind.type_name}: name a field of it")
    if _is_character(kind):
        raise FieldChangeError(f"{name} is a character, which cannot be changed")
    if spec.value is not None:
        value = _fitting(kind, spec.value, name)
        return lambda old: value
    if isinstance(kind, StringType) or kind.code == "?":
        raise FieldChangeError(f"{name} is no number: give value")
    scale = 1.0 if spec.scale is None else spec.scale
    offset = spec.offset or 0.0
    return lambda old: _moved(kind, old, scale, offset)


def _change_of_array(
    spec: FaultSpec, kind: ArrayType | SequenceType, name: str
) -> Callable[[Any], Any]:
    most = kind.length if isinstance(kind, ArrayType) else kind.bound
    least = kind.length if isinstance(kind, ArrayType) else 0
    count = len(spec.value) if isinstance(spec.value, list) else spec.length
    if count is None:
        raise FieldChangeError(f"{name} is an array: write {name}[*] for all of its items")
    if count < least or (most is not None and count > most):
        bound = "exactly" if least else "at most"
        raise FieldChangeError(f"{name} has {bound} {most} items, not {count}")
    item = kind.item
    if spec.length is not None:
        return lambda old: _with_length(list(old), count, item)
    if isinstance(item, MessageSpec) or _is_character(item):
        raise FieldChangeError(f"{name} cannot be changed as a whole, but its length can")
    values = [_fitting(item, value, name) for value in spec.value]
    return lambda old: values


def _with_length(items: list[Any], count: int, item: ItemType) -> list[Any]:
    if not items and count:
        items = [_blank(item)]
    return items[:count] + items[-1:] * (count - len(items))


def _blank(item: ItemType) -> Any:
    if isinstance(item, MessageSpec):
        return item.cls()
    if isinstance(item, StringType):
        return ""
    blanks = {"?": False, "c": b"\0" if item.name == "octet" else "\0"}
    return blanks.get(item.code, 0.0 if item.code in "fd" else 0)


def _is_character(item: ItemType) -> bool:
    return isinstance(item, PrimitiveType) and item.name == "char"


def _limits(item: PrimitiveType) -> tuple[float, float]:
    """Return the least and the greatest finite number of a type."""
    if item.code in "fd":
        return -_FLOAT_MAX[item.code], _FLOAT_MAX[item.code]
    bits = 8 * item.size
    is_signed = item.code in "bhiq"
    return (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if is_signed else (0, 2**bits - 1)


def _fitting(item: PrimitiveType | StringType, value: Any, name: str) -> Any:
    """Return a value converted to the field's type."""
    if isinstance(item, StringType):
        if not isinstance(value, str):
            raise FieldChangeError(f"{name} is text, not {value!r}")
        return value
    if item.code == "?":
        if not isinstance(value, bool):
            raise FieldChangeError(f"{name} is true or false, not {value!r}")
        return value
    from rsltrace.job.parts.fault import number_of

    number = number_of(value)
    if number is None:
        raise FieldChangeError(f"{name} is a number, not {value!r}")
    least, most = _limits(item)
    if item.code in "fd":
        if math.isfinite(number) and not least <= number <= most:
            raise FieldChangeError(f"{name} is from {least:g} to {most:g}, not {number}")
        return float(number)
    if not (math.isfinite(number) and number == int(number) and least <= number <= most):
        raise FieldChangeError(f"{name} is a whole number from {least} to {most}, not {value}")
    return bytes([int(number)]) if item.code == "c" else int(number)


def _moved(item: PrimitiveType, old: Any, scale: float, offset: float) -> Any:
    """Return a scaled and shifted number. Beyond the limits, floats become infinite and integers
    are clamped."""
    least, most = _limits(item)
    if item.code in "fd":
        moved = old * scale + offset
        return math.copysign(math.inf, moved) if abs(moved) > most else moved
    number = old[0] if item.code == "c" else old
    exact = int(scale) * number if scale == int(scale) else round(scale * number)
    exact += int(offset) if offset == int(offset) else round(offset)
    exact = int(min(max(exact, least), most))
    return bytes([exact]) if item.code == "c" else exact


def _change(owner: Any, steps: tuple[Step, ...], new: Callable[[Any], Any]) -> None:
    (name, place), *rest = steps
    held = getattr(owner, name)
    if place is None:
        if rest:
            _change(held, tuple(rest), new)
        else:
            setattr(owner, name, new(held))
        return
    chosen = range(len(held)) if place == "*" else [int(str(place))]
    if not len(held) or not -len(held) <= chosen[0] < len(held):
        raise FieldChangeError(f"there is no {name}[{place}]: it has {len(held)} items")
    items = list(held)
    for index in chosen:
        if rest:
            _change(items[index], tuple(rest), new)
        else:
            items[index] = new(items[index])
    if not rest:
        setattr(owner, name, items)


def check_changes(job: Job, topic: str, message_class: type) -> None:
    """Raise BagError if a fault's change does not fit a topic's message class."""
    for index, spec in enumerate(job.faults):
        if spec.change == topic:
            try:
                field_changer(message_class, spec)
            except FieldChangeError as error:
                raise BagError(f"{locate(job, ('faults', index))}: {error}") from None


class BagFaults:
    """The faults of what bags play in one run. ``is_open``: more may be added later."""

    def __init__(self, job: Job, *, is_open: bool = False) -> None:
        self._by_number: dict[tuple[str, int], list[_BagFault]] = {}
        self._all: list[_BagFault] = []
        self._last: dict[BagPublisher, bytes] = {}
        self._is_open = is_open
        self.reached: Counter[str] = Counter()
        """How many messages of each topic have been taken from the bags."""
        self.add(job, 0)

    def add(self, job: Job, first: int) -> None:
        for index, spec in enumerate(job.faults[first:], start=first):
            if spec.of_bag:
                assert spec.message is not None
                fault = _BagFault(spec, locate(job, ("faults", index)))
                self._all.append(fault)
                self._by_number.setdefault((spec.name, spec.message), []).append(fault)

    def missed(self) -> Iterator[tuple[str, str]]:
        """Yield (place in the job, reason) of each fault that did not happen."""
        for fault in self._all:
            reached, spec = self.reached[fault.spec.name], fault.spec
            if fault.missed:
                yield fault.where, fault.missed
            elif reached < (spec.message or 0):
                times = "message" if reached == 1 else "messages"
                yield fault.where, f"bags played {reached} {times} on {spec.name}"

    def played(self, messages: Iterator[BagMessage]) -> Iterator[BagMessage]:
        """Yield messages with the faults applied."""
        return self._played(messages) if self._all or self._is_open else messages

    def _played(self, messages: Iterator[BagMessage]) -> Iterator[BagMessage]:
        ahead: deque[BagMessage] = deque()
        while True:
            message = ahead.popleft() if ahead else next(messages, None)
            if message is None:
                return
            stamp_ns, publisher, data = message
            self.reached[publisher.topic] += 1
            number = self.reached[publisher.topic]
            for fault in self._by_number.get((publisher.topic, number), ()):
                if fault.spec.swap is not None:
                    data = self._swapped(fault, message, ahead, messages)
                elif fault.spec.repeat is not None:
                    data = self._last.get(publisher, data)
                else:
                    data = fault.changed(publisher, data)
            self._last[publisher] = data
            yield stamp_ns, publisher, data

    def _swapped(
        self,
        fault: _BagFault,
        message: BagMessage,
        ahead: deque[BagMessage],
        rest: Iterator[BagMessage],
    ) -> bytes:
        """Swap a message's content with that of its publisher's next one; return the latter."""
        _, publisher, data = message
        place = 0
        while True:
            if place == len(ahead):
                following = next(rest, None)
                if following is None:
                    fault.missed = f"no message on {publisher.topic} follows that one"
                    return data
                ahead.append(following)
            stamp_ns, other, content = ahead[place]
            if other is publisher:
                ahead[place] = stamp_ns, publisher, data
                return content
            place += 1


class _BagFault:
    """One fault; ``missed`` says why it did not come to pass."""

    def __init__(self, spec: FaultSpec, where: str) -> None:
        self.spec = spec
        self.where = where
        self.missed = ""

    def changed(self, publisher: BagPublisher, data: bytes) -> bytes:
        """Return the changed message, or the same one if it lacks the item."""
        try:
            return field_changer(class_of(publisher), self.spec)(publisher.canonical(data))
        except FieldChangeError as error:
            self.missed = str(error)
            return data
        except ValueError:  # it is no message of that type: the player says so
            return data


def arm_topic_faults(faults: Sequence[FaultSpec], world: World) -> None:
    """Add faults of single messages: before the first node is made, or later where
    ``AllTopicFaults`` were there from the start."""
    by_topic: dict[str, list[MessageFault]] = {}
    for spec in faults:
        if spec.of_message:
            by_topic.setdefault(spec.name, []).append(_message_fault(spec))
    for topic, found in by_topic.items():
        world.domain.transport.faults.setdefault(topic, TopicFaults(())).add(found)


def arm_node_faults(job: Job, world: World, start_ns: int) -> NodeFaults | None:
    """Let nodes crash, hang or restart; None if the job has no such faults. Must be called before
    the first node is made."""
    if not any(spec.of_node for spec in job.faults):
        return None
    from rsltrace.adapters.rclpy.faults import NodeFault, NodeFaults

    faults = [
        NodeFault(
            spec.kind,
            spec.name,
            locate(job, ("faults", index)),
            spec.at_ns,
            spec.event,
            spec.topic or "",
            spec.message or 0,
            spec.for_ns,
        )
        for index, spec in enumerate(job.faults)
        if spec.of_node
    ]
    return NodeFaults(world, faults, start_ns)


def missed_faults(
    job: Job, world: World, nodes: NodeFaults | None, bags: BagFaults | None
) -> Iterator[str]:
    """Yield the faults that did not happen in a finished run."""
    for index, spec in enumerate(job.faults):
        if spec.of_bag and bags is None:
            where = locate(job, ("faults", index))
            yield f"{where}: this fault did not happen: no bag plays {spec.name}"
        if spec.of_message:
            faults = world.domain.transport.faults[spec.name]
            assert spec.message is not None
            if faults.reached < spec.message:
                times = "message" if faults.reached == 1 else "messages"
                yield (
                    f"{locate(job, ('faults', index))}: this fault did not happen: there were "
                    f"{faults.reached} {times} on {spec.name}"
                )
    for found in (nodes, bags):
        for where, why in found.missed() if found is not None else ():
            yield f"{where}: this fault did not happen: {why}"


def _message_fault(spec: FaultSpec) -> MessageFault:
    assert spec.message is not None
    return MessageFault(
        spec.message,
        spec.to or "*",
        is_lost=spec.drop is not None,
        late_ns=(spec.by_ns or 0) if spec.delay is not None else 0,
        copy_ns=(spec.by_ns or 0) if spec.duplicate is not None else -1,
    )
