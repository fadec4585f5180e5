"""Message and service types by name, faults of single messages, and the source of callbacks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import PurePath
from types import CodeType, CoroutineType, FunctionType, MethodType

from rsltrace.fast_dataclass import dataclass


@dataclass(frozen=True, slots=True)
class MessageFault:
    """The fault of message ``number`` (from 1) of a topic for the nodes that glob ``to`` matches:
    it is lost, ``late_ns`` late, or repeated after ``copy_ns`` (-1: not)."""

    number: int
    to: str = "*"
    is_lost: bool = False
    late_ns: int = 0
    copy_ns: int = -1


class TopicFaults:
    """The faults of one topic. ``reached`` is the number of messages so far."""

    def __init__(self, faults: Sequence[MessageFault]) -> None:
        self._by_number: dict[int, list[MessageFault]] = {}
        self.reached = 0
        self._present: list[MessageFault] = []
        self.add(faults)

    def add(self, faults: Sequence[MessageFault]) -> None:
        for fault in faults:
            self._by_number.setdefault(fault.number, []).append(fault)

    def begin(self) -> None:
        """Note that the next message is about to be sent to all receivers."""
        self.reached += 1
        self._present = self._by_number.get(self.reached, [])

    def end(self) -> None:
        """Note that it was sent: a message to a single receiver is an older one."""
        self._present = []

    def for_node(self, name: str) -> MessageFault | None:
        """Return the fault of the current message on its way to a node, or None."""
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


class AllTopicFaults(dict[str, TopicFaults]):
    """Faults for every topic: more may be added while the run goes on."""

    def get(self, topic: str, default: object = None) -> TopicFaults:
        return self.setdefault(topic, TopicFaults(()))


_WRAPPED_MAX = 50


def callback_source(callback: object) -> str:
    """Return ``package/module.py:24`` of the function that a callback runs in the end, or "" if it
    is unknown or our own.

    The line is that of ``def``, or of its first decorator. The file is named as it is imported, so
    that traces do not differ by the folder in which they were made.
    """
    found = callback_code(callback)
    if found is None:
        return ""
    code, names = found
    if code.co_filename[:1] == "<" or str(names.get("__name__")).startswith("rsltrace."):
        return ""
    return f"{imported_file(code, names)}:{code.co_firstlineno}"


def callback_code(callback: object) -> tuple[CodeType, Mapping[str, object]] | None:
    """Return the code that a callback runs in the end, with its module's names; None if unknown.

    Goes through methods, partials, decorators and callable objects (which may answer anything).
    """
    for _ in range(_WRAPPED_MAX):
        if isinstance(callback, partial):
            callback = callback.func
        elif isinstance(callback, MethodType):
            callback = callback.__func__
        elif isinstance(callback, FunctionType):
            wrapped = callback.__dict__.get("__wrapped__")
            if wrapped is None:
                return callback.__code__, callback.__globals__
            callback = wrapped
        elif isinstance(callback, CoroutineType):
            frame = callback.cr_frame
            return (callback.cr_code, frame.f_globals) if frame is not None else None
        elif isinstance(callback, type):
            callback = callback.__init__  # type: ignore[misc]
        elif (wrapped := _attributes(callback).get("__wrapped__")) is not None:
            callback = wrapped
        else:
            callbacks = (vars(one).get("__call__") for one in type(callback).__mro__)
            callback = next((one for one in callbacks if one is not None), None)
            if not isinstance(callback, FunctionType):
                return None
    return None


def _attributes(value: object) -> dict[str, object]:
    try:
        return object.__getattribute__(value, "__dict__")  # type: ignore[no-any-return]
    except AttributeError:
        return {}


def imported_file(code: CodeType, names: Mapping[str, object]) -> str:
    """Return a code's file as it is imported, ``package/module.py``: the same on any machine."""
    path = PurePath(code.co_filename)
    module = names.get("__name__")
    if isinstance(module, str):
        package = PurePath(*module.split("."))
        for tail in (package.with_suffix(".py"), package / "__init__.py"):
            if path.parts[-len(tail.parts) :] == tail.parts:
                return tail.as_posix()
    return path.name


def _unknown() -> tuple[str, str]:
    return "", ""


@dataclass(frozen=True, slots=True)
class MessageType:
    """The type of a topic, a request or a response: ``std_msgs/msg/UInt64``.

    ``describe`` gives its definition and its type hash (either may be empty), for those who read
    the trace; it is asked when the first message is kept.
    """

    name: str
    describe: Callable[[], tuple[str, str]] = _unknown


@dataclass(frozen=True, slots=True)
class ServiceType:
    """The type of a service, with those of its two messages."""

    name: str
    request: MessageType
    response: MessageType
