"""Ending a run by a message: the job's ``stop: topic:``, RSLCPP's ``/rslcpp/error_code``."""

from __future__ import annotations

from typing import Any, Protocol

from rsltrace.adapters.rclpy.wire.codec import codec_for
from rsltrace.adapters.rclpy.wire.interfaces import class_of
from rsltrace.errors import JobError, nearest
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.simulation.middleware.transport import Watcher


class _TopicStop(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def exit_code(self) -> str | None: ...


def watch_exit_code(loop: EventLoop, spec: _TopicStop, *, where: str) -> Watcher:
    """Return a watcher that ends the run after the time step of the first message.

    With ``spec.exit_code`` (a dotted field path; ``where`` it stands in the job) the message's
    field is the exit status.
    """

    def watch(publisher: Publisher, data: bytes) -> None:
        msg_type: Any = class_of(publisher)
        code = 0
        if spec.exit_code is not None:
            value: Any = codec_for(msg_type).deserialize(data)
            for name in spec.exit_code.split("."):
                fields: dict[str, str] = getattr(value, "get_fields_and_field_types", dict)()
                if name not in fields:
                    near = nearest(name, fields)
                    hint = f"did you mean {near!r}?" if near else f"there are {', '.join(fields)}"
                    hint = hint if fields else "what comes before it is no message"
                    raise JobError(
                        f"stop.topic.exit_code: {spec.name} is a {msg_type.__qualname__} without "
                        f"the field {spec.exit_code!r}: {hint}",
                        where=where,
                    )
                value = getattr(value, name)
            if not isinstance(value, int):
                raise JobError(
                    f"stop.topic.exit_code: {spec.exit_code!r} of {spec.name} is "
                    f"{value!r}, not an integer",
                    where=where,
                )
            code = int(value)
        loop.stop_after_step(Stop(f"message on {spec.name}", code))

    return watch
