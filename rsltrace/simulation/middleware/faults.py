"""Single messages that go wrong, by their number on a topic: lost, late, or twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase


@dataclass(frozen=True, slots=True)
class MessageFault:
    """What becomes of message ``number`` (from 1) of a topic on its way to the nodes that the glob
    ``to`` fits: it is lost if ``is_lost``, ``late_ns`` late, and comes again ``copy_ns`` after that
    (-1: once)."""

    number: int
    to: str = "*"
    is_lost: bool = False
    late_ns: int = 0
    copy_ns: int = -1


class TopicFaults:
    """The faults of one topic. Its publishers say when they send, its links what that means for
    them. ``reached`` is how many messages there have been."""

    def __init__(self, faults: Sequence[MessageFault]) -> None:
        self._by_number: dict[int, list[MessageFault]] = {}
        self.reached = 0
        self._present: list[MessageFault] = []
        self.add(faults)

    def add(self, faults: Sequence[MessageFault]) -> None:
        """Have more of them, of messages that are yet to come."""
        for fault in faults:
            self._by_number.setdefault(fault.number, []).append(fault)

    def begin(self) -> None:
        """Take note that the next message is about to be sent to everybody."""
        self.reached += 1
        self._present = self._by_number.get(self.reached, [])

    def end(self) -> None:
        """Take note that it has been: what is sent to single ones is an older message."""
        self._present = []

    def for_node(self, name: str) -> MessageFault | None:
        """Return what becomes of the present message on its way to a node, None if nothing."""
        fitting = [fault for fault in self._present if fnmatchcase(name, fault.to)]
        if not fitting:
            return None
        copies = [fault.copy_ns for fault in fitting if fault.copy_ns >= 0]
        return MessageFault(
            self.reached,
            name,
            is_lost=any(fault.is_lost for fault in fitting),
            late_ns=sum(fault.late_ns for fault in fitting),
            copy_ns=max(copies, default=-1),
        )


class FaultsOfAll(dict[str, TopicFaults]):
    """Faults of every topic that somebody asks for: there may be some later."""

    def get(self, topic: str, default: object = None) -> TopicFaults:
        """Return those of a topic, which may be none so far."""
        return self.setdefault(topic, TopicFaults(()))
