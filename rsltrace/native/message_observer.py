"""What passes between rclpy and its extension: every message taken or sent, every log record.

The methods of the extension's own classes are wrapped, where a simulation puts classes of its own:
all of rclpy's Python and all user code run as they are. Each wrapper gives what its method gave.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from itertools import count
from typing import Any

from rsltrace.adapters.rclpy.handles.lifecycle import transition_event
from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.native.observed_entities import ObservedEntities, ObservedEntity
from rsltrace.native.span_recorder import (
    CallbackSpan,
    EmittedLog,
    ReceivedInput,
    SentMessage,
    SpanRecorder,
    now_ns,
)
from rsltrace.native.support import patched
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.event import OutputKind

_MESSAGE = int(OutputKind.MESSAGE)
_REQUEST = int(OutputKind.REQUEST)
_RESPONSE = int(OutputKind.RESPONSE)

_ACTION_SENDS = {
    "ActionServer": {
        "send_goal_response": ("send_goal", _RESPONSE),
        "send_cancel_response": ("cancel_goal", _RESPONSE),
        "send_result_response": ("get_result", _RESPONSE),
        "publish_feedback": ("feedback", _MESSAGE),
        "publish_status": ("status", _MESSAGE),
    },
    "ActionClient": {
        "send_goal_request": ("send_goal", _REQUEST),
        "send_cancel_request": ("cancel_goal", _REQUEST),
        "send_result_request": ("get_result", _REQUEST),
    },
}
_ACTION_TAKES = {
    "ActionServer": {
        "take_goal_request": "send_goal",
        "take_cancel_request": "cancel_goal",
        "take_result_request": "get_result",
    },
    "ActionClient": {
        "take_goal_response": "send_goal",
        "take_cancel_response": "cancel_goal",
        "take_result_response": "get_result",
        "take_feedback": "feedback",
        "take_status": "status",
    },
}


MessageTaker = Callable[[Any, Any, bool], tuple[Any, bytes]]
"""Takes a message from a subscription's handle, as its ``take_message`` does; returns what that
does, and the gid of the publisher."""


def channel_of(kind: int, name: str) -> str:
    """Return the name by which what was sent is found again by who takes it."""
    return f"{kind} {name}"


class MessageObserver:
    """Tells a recorder of what is sent, and keeps what is taken for the callback that follows."""

    def __init__(
        self, recorder: SpanRecorder, entities: ObservedEntities, taker: MessageTaker | None = None
    ) -> None:
        """``taker`` takes messages in place of rclpy, and says whose they are."""
        self._recorder = recorder
        self._entities = entities
        self._taker = taker
        self._local = threading.local()
        self.on_message: dict[str, Callable[[bytes, Any], object]] = {}
        """Called with the messages on a topic, and of their class."""
        self.unreadable = 0
        """Messages that could not be written as bytes."""

    def take(self) -> ReceivedInput | None:
        """Return what was taken in this thread since this was asked last."""
        taken: ReceivedInput | None = getattr(self._local, "taken", None)
        self._local.taken = None
        return taken

    @contextmanager
    def watched(self, extension: Any) -> Iterator[None]:
        """Observe all that passes meanwhile."""
        wraps_of: list[tuple[Any, str, Callable[..., Any]]] = [
            (extension.Publisher, "publish", self._publish),
            (extension.Publisher, "publish_raw", self._publish),
            (extension.Subscription, "take_message", self._take_message),
            (extension.Client, "send_request", self._sends(_REQUEST)),
            (extension.Client, "take_response", self._take_exchange(_RESPONSE)),
            (extension.Service, "service_take_request", self._take_exchange(_REQUEST)),
            (extension.Service, "service_send_response", self._sends(_RESPONSE)),
            (extension.Timer, "call_timer", self._call_timer),
            (extension.LifecycleStateMachine, "trigger_transition_by_id", self._trigger),
            (extension.LifecycleStateMachine, "trigger_transition_by_label", self._trigger),
            (extension, "rclpy_logging_rcutils_log", self._log),
        ]
        for name, sends in _ACTION_SENDS.items():
            for method, (part, kind) in sends.items():
                wrap = self._sends(kind, part)
                wraps_of.append((getattr(extension, name), method, wrap))
        for name, takes in _ACTION_TAKES.items():
            for method, part in takes.items():
                wraps_of.append((getattr(extension, name), method, self._action_takes(part)))
        with ExitStack() as stack:
            for owner, method, wrap in wraps_of:
                stack.enter_context(patched(owner, method, wrap))
            yield

    # -- topics ----------------------------------------------------------------------------------

    def _publish(self, original: Callable[..., None]) -> Callable[..., None]:
        @wraps(original)
        def publish(handle: Any, message: Any) -> None:
            begun_ns = now_ns()
            entity = self._entities.find(handle)
            if entity is None:
                original(handle, message)
                return
            with self._sending() as span, entity.sending:
                sequence = next(entity.sequence)
                before_ns = time.time_ns()
                begun_ns -= now_ns()
                try:
                    original(handle, message)
                except BaseException:
                    entity.sequence = count(sequence)  # the middleware has not counted it
                    raise
                begun_ns += now_ns()
                self._sent(span, _MESSAGE, entity, message, sequence, before_ns, begun_ns)

        return publish

    def _trigger(self, original: Callable[..., None]) -> Callable[..., None]:
        """Wrap what changes the state of a lifecycle node: rcl publishes from where to where."""

        @wraps(original)
        def trigger(machine: Any, transition: Any, publish_update: bool) -> None:
            entity = self._entities.find(machine)
            if entity is None or not publish_update:
                original(machine, transition, publish_update)
                return
            start = machine.current_state
            with self._sending() as span:
                before_ns = time.time_ns()
                original(machine, transition, publish_update)
                message = transition_event(start, machine.current_state)
                number = next(entity.sequence)
                self._sent(span, _MESSAGE, entity, message, number, before_ns, now_ns())

        return trigger

    @contextmanager
    def _sending(self) -> Iterator[CallbackSpan]:
        """Have an event under way that sends something within the block, and says so there.

        Nothing interrupts it between the message that leaves and the note of it: whoever gets it
        finds its cause.
        """
        with self._recorder.interrupts:
            span = self._recorder.sending()
            try:
                yield span
            except BaseException:
                self._recorder.sent(span, None)
                raise

    def _sent(
        self,
        span: CallbackSpan,
        kind: int,
        entity: ObservedEntity,
        message: Any,
        sequence: int,
        before_ns: int,
        begun_ns: int,
    ) -> None:
        """Note that a message was sent. ``begun_ns`` is when the observer began, were it not for
        the time that sending took."""
        after_ns = time.time_ns()
        data = self._bytes_of(entity.sends_type, message)
        digest = hash64(data) if data else 0
        sent = SentMessage(kind, entity, digest, data, sequence, after_ns, before_ns)
        self._recorder.sent(span, sent, begun_ns)
        if kind == _MESSAGE and (callback := self.on_message.get(entity.name)) is not None:
            callback(data, entity.sends_type)

    def _take_message(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def take_message(handle: Any, message_type: Any, raw: bool) -> Any:
            gid = b""
            if self._taker is None:
                found = original(handle, message_type, raw)
            else:
                with self._recorder.interrupts:  # rclpy would make it a TypeError
                    found, gid = self._taker(handle, message_type, raw)
            begun_ns = now_ns()
            entity = self._entities.find(handle)
            if found is not None and entity is not None:
                message, info = found
                self._took(
                    entity,
                    message,
                    channel_of(_MESSAGE, entity.name),
                    info.get("publication_sequence_number") or 0,
                    info.get("source_timestamp") or 0,
                    info.get("received_timestamp") or 0,
                    begun_ns,
                    gid,
                )
            return found

        return take_message

    def _took(
        self,
        entity: ObservedEntity,
        message: Any,
        channel: str,
        sequence: int,
        source_ns: int,
        ready_ns: int,
        begun_ns: int,
        gid: bytes = b"",
    ) -> None:
        data = self._bytes_of(entity.takes_type, message)
        digest = hash64(data) if data else 0
        earlier: ReceivedInput | None = getattr(self._local, "taken", None)
        if earlier is not None:  # an action may take several at once
            earlier.input_hash = hash64(digest.to_bytes(8, "little"), earlier.input_hash)
            return
        taken = ReceivedInput(
            entity, digest, digest, channel, sequence, source_ns, ready_ns, gid=gid
        )
        taken.observer_ns = now_ns() - begun_ns
        self._local.taken = taken

    def _bytes_of(self, type: Any, message: Any) -> bytes:
        """Return a message as canonical CDR; nothing of one that cannot be written so."""
        if message is None:  # the status of goals: rcl makes it
            return b""
        codec = codec_for(type)
        try:
            if isinstance(message, (bytes, bytearray, memoryview)):
                return codec.canonical(bytes(message))
            return codec.serialize(message)
        except Exception:  # whatever it is, it is no concern of the node's
            self.unreadable += 1
            return b""

    # -- services --------------------------------------------------------------------------------

    def _take_exchange(self, kind: int) -> Callable[..., Any]:
        """Wrap what takes a request or a response: it gives message and header in some order."""

        def wrapping(original: Callable[..., Any]) -> Callable[..., Any]:
            @wraps(original)
            def take(handle: Any, type: Any) -> Any:
                found = original(handle, type)
                begun_ns = now_ns()
                message, header = found if kind == _REQUEST else reversed(found)
                entity = self._entities.find(handle)
                if header is not None and entity is not None:
                    self._took(
                        entity,
                        message,
                        channel_of(kind, entity.name),
                        header.request_id.sequence_number,
                        header.source_timestamp,
                        header.received_timestamp,
                        begun_ns,
                    )
                return found

            return take

        return wrapping

    # -- actions ---------------------------------------------------------------------------------

    def _sends(self, kind: int, part: str = "") -> Callable[..., Any]:
        """Wrap what sends a request or a response, or, as a ``part`` of an action, anything."""

        def wrapping(original: Callable[..., Any]) -> Callable[..., Any]:
            @wraps(original)
            def send(handle: Any, *words: Any) -> Any:
                if part:
                    entity = self._entities.parts.get(handle, {}).get(part)
                else:
                    entity = self._entities.find(handle)
                if entity is None:
                    return original(handle, *words)
                with self._sending() as span:
                    before_ns = time.time_ns()
                    given = original(handle, *words)
                    # A request gives its number; a response is given the one it answers.
                    if kind == _MESSAGE:  # who takes it learns no number
                        sequence = 0
                    else:
                        answered = words[0 if part else -1]
                        sequence = given if kind == _REQUEST else answered.sequence_number
                    # The status of an action is made by rcl; only a service has the number last.
                    message = words[-1 if part else 0] if words else None
                    self._sent(span, kind, entity, message, sequence, before_ns, now_ns())
                return given

            return send

        return wrapping

    def _action_takes(self, part: str) -> Callable[..., Any]:
        def wrapping(original: Callable[..., Any]) -> Callable[..., Any]:
            @wraps(original)
            def take(handle: Any, type: Any) -> Any:
                found = original(handle, type)
                begun_ns = now_ns()
                parts = self._entities.parts.get(handle)
                header, message = found if isinstance(found, tuple) else (None, found)
                if message is not None and parts is not None:
                    entity = parts[part]
                    kind = _MESSAGE if header is None else _REQUEST
                    if isinstance(header, int):
                        kind = _RESPONSE
                    number = getattr(header, "sequence_number", header) or 0
                    channel = channel_of(kind, entity.name)
                    self._took(entity, message, channel, number, 0, 0, begun_ns)
                return found

            return take

        return wrapping

    # -- timers and logs -------------------------------------------------------------------------

    def _call_timer(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def call_timer(handle: Any) -> Any:
            begun_ns = now_ns()
            entity = self._entities.find(handle)
            if entity is not None:
                due_ns = time.time_ns() + min(handle.time_until_next_call() or 0, 0)
                taken = ReceivedInput(entity, ready_ns=due_ns)
                taken.observer_ns = now_ns() - begun_ns
                self._local.taken = taken
            return original(handle)

        return call_timer

    def _log(self, original: Callable[..., None]) -> Callable[..., None]:
        @wraps(original)
        def log(
            severity: int, name: str, message: Any, function: str, file: str, line: int
        ) -> None:
            original(severity, name, message, function, file, line)
            begun_ns = now_ns()
            entity = self._logger(name)
            if entity is not None:
                text = str(message).encode(errors="backslashreplace").decode()
                self._recorder.add(
                    EmittedLog(entity, int(severity), name, text, function, file, line), begun_ns
                )

        return log

    def _logger(self, name: str) -> ObservedEntity | None:
        """Return the /rosout of the node whose logger, or child of a logger, has this name."""
        rosout = self._entities.rosout
        while name and name not in rosout:
            name = name.rpartition(".")[0]
        return rosout.get(name)
