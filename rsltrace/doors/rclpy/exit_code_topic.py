"""Ending a run by a message: the job's ``stop: topic:``, RSLCPP's ``/rslcpp/error_code``."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from rsltrace.doors.rclpy.wire.codec import codec_for
from rsltrace.errors import JobError, nearest
from rsltrace.loop.stop import Stop

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core


class _TopicStop(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def exit_code(self) -> str | None: ...


def watch_exit_code(core: Core, spec: _TopicStop, *, where: str) -> Callable[[Any, bytes], None]:
    """Return a watcher that ends the run after the time step of the first message.

    With ``spec.exit_code`` (a dotted field path; ``where`` it stands in the job) the message's
    field is the exit status.
    """

    def watch(msg_type: Any, data: bytes) -> None:
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
        core.loop.stop_after_step(Stop(f"message on {spec.name}", code))

    return watch
