"""Single messages that bags play otherwise than they were recorded: changed, swapped, stale.

It happens before a message is published, so all that follows, the trace included, has that one.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from typing import TYPE_CHECKING

from rsltrace.adapters.rclpy.wire.interface_classes import class_of
from rsltrace.errors import BagError
from rsltrace.job import Job, locate
from rsltrace.job.parts.fault import FaultSpec
from rsltrace.run.plans.changed_fields import UnfitError, changer

if TYPE_CHECKING:
    from rsltrace.adapters.player import BagPublisher, Message


def check_changes(job: Job, topic: str, message_class: type) -> None:
    """Raise BagError if what a fault says cannot become of messages of a class on a topic."""
    for index, spec in enumerate(job.faults):
        if spec.change == topic:
            try:
                changer(message_class, spec)
            except UnfitError as error:
                raise BagError(f"{locate(job, ('faults', index))}: {error}") from None


class BagFaults:
    """The faults of one run that are about what bags play. ``is_open``: there may be some later."""

    def __init__(self, job: Job, *, is_open: bool = False) -> None:
        self._by_number: dict[tuple[str, int], list[_BagFault]] = {}
        self._all: list[_BagFault] = []
        self._last: dict[BagPublisher, bytes] = {}
        self._is_open = is_open
        self.reached: Counter[str] = Counter()
        """How many messages of each topic have been taken from the bags."""
        self.add(job, 0)

    def add(self, job: Job, first: int) -> None:
        """Have those of a job from its ``first`` fault on."""
        for index, spec in enumerate(job.faults[first:], start=first):
            if spec.of_bag:
                assert spec.message is not None
                fault = _BagFault(spec, locate(job, ("faults", index)))
                self._all.append(fault)
                self._by_number.setdefault((spec.name, spec.message), []).append(fault)

    def missed(self) -> Iterator[tuple[str, str]]:
        """Yield the place in the job of each fault that has not come to pass, and why."""
        for fault in self._all:
            reached, spec = self.reached[fault.spec.name], fault.spec
            if fault.missed:
                yield fault.where, fault.missed
            elif reached < (spec.message or 0):
                times = "message" if reached == 1 else "messages"
                yield fault.where, f"bags played {reached} {times} on {spec.name}"

    def played(self, messages: Iterator[Message]) -> Iterator[Message]:
        """Yield messages as they are to be published."""
        return self._played(messages) if self._all or self._is_open else messages

    def _played(self, messages: Iterator[Message]) -> Iterator[Message]:
        ahead: deque[Message] = deque()
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
        self, fault: _BagFault, message: Message, ahead: deque[Message], rest: Iterator[Message]
    ) -> bytes:
        """Put the content of a message where its publisher's next one is, return that one's."""
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
        """Return a message with another value, or as it is if it has no such item."""
        try:
            return changer(class_of(publisher), self.spec)(publisher.canonical(data))
        except UnfitError as error:
            self.missed = str(error)
            return data
        except ValueError:  # it is no message of that type: the player says so
            return data
