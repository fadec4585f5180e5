"""Other messages than those that were sent: on their way, or as one receiver gets them."""

from __future__ import annotations

from typing import Any

from rsltrace.errors import EditError, did_you_mean
from rsltrace.replay.edits import Edit, SetMessage, change, path_text
from rsltrace.simulation.middleware.events.observer import EventCall
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.event import EventKind


def changed_data(endpoint: Any, edit: Edit, data: bytes) -> bytes:
    """Return the message (canonical CDR) of a publisher or subscription, edited.

    :raises EditError: it has no such field, or that cannot have such a value.
    """
    from rsltrace.adapters.rclpy.wire.codec import codec_for
    from rsltrace.adapters.rclpy.wire.interfaces import class_of

    return _recoded(codec_for(class_of(endpoint)), edit, data)


def receive_edited(edit: Edit, call: EventCall) -> None:
    """Let an event that is about to run receive another message.

    :raises EditError: it receives none, or that cannot be edited so.
    """
    from rsltrace.adapters.rclpy.wire.codec import codec_for

    handle, kind, args = call.handle, call.kind, call.args
    is_coroutine = hasattr(handle, "task")
    if is_coroutine:
        part = arrived_for_action(handle, kind)
        if part is not None:
            call.input_hash = _change_arrival(part, edit)
            return
        args = tuple(one for one in _begun_with(handle, kind) if _is_message(one))[:1]
    if kind == EventKind.BAG or (args and isinstance(args[0], bytes)):
        data = changed_data(handle, edit, args[0])
        call.input_hash = hash64(data)
        rest = (call.input_hash,) if kind == EventKind.BAG else args[1:]
        call.args = (data, *rest)
        return
    if not args or not _is_message(args[0]):
        raise EditError(f"{handle.describe()} ({EventKind(kind).label}) receives no message")
    _change_message(args[0], edit)
    message: Any = type(args[0])
    call.input_hash = hash64(codec_for(message).serialize(args[0]))


def arrived_for_action(handle: Any, kind: int) -> Any:
    """Return the part of an action of which a coroutine is going to take what has arrived: a goal,
    a response, feedback. None if it is going to do something else."""
    from rsltrace.adapters.rclpy.actions.parts import Part

    parts = (one for one in _begun_with(handle, kind) if isinstance(one, Part) and one.queue)
    return next(parts, None) if kind == EventKind.ACTION else None


def _begun_with(run: Any, kind: int) -> list[Any]:
    """Return what a coroutine is going to be called with; nothing if it is under way already."""
    frame = getattr(run.task._handler, "cr_frame", None)
    is_under_way = kind in (EventKind.RESUME, EventKind.TASK)
    return [] if frame is None or is_under_way else list(frame.f_locals.values())


def _change_arrival(part: Any, edit: Edit) -> int:
    """Change what has arrived first; return its hash."""
    from rsltrace.adapters.rclpy.actions.parts import GoalClient, GoalService
    from rsltrace.adapters.rclpy.wire.codec import codec_for

    if isinstance(part, GoalService):
        codec = codec_for(part.srv_type.Request)
    elif isinstance(part, GoalClient):
        codec = codec_for(part.srv_type.Response)
    else:
        codec = codec_for(part.msg_type)
    at = part.origin.start - 1  # where the data is, in front of where it comes from
    first = list(part.queue[0])
    first[at] = _recoded(codec, edit, first[at])
    digest = first[at + 3] = hash64(first[at])
    part.queue[0] = tuple(first)
    return digest


def _recoded(codec: Any, edit: Edit, data: bytes) -> bytes:
    message = codec.deserialize(data)
    _change_message(message, edit)
    changed: bytes = codec.serialize(message)
    return changed


def _is_message(value: object) -> bool:
    return hasattr(value, "get_fields_and_field_types")


def _change_message(message: Any, edit: Edit) -> None:
    """Change a field, with the checks that rclpy's own messages have.

    :raises EditError: there is no such field, or it cannot have the value.
    """
    action = edit.action
    assert isinstance(action, SetMessage)
    try:
        change(message, action.path, action.operator, action.value)
    except AttributeError:
        fields = message.get_fields_and_field_types()
        near = did_you_mean(str(action.path[0][1]), fields)
        listed = ", ".join(fields)
        name = f"{path_text(action.path).removeprefix('.')}"
        raise EditError(f"{type(message).__name__} has no {name} (it has {listed}){near}") from None
    except AssertionError as error:
        raise EditError(f"{path_text(action.path).removeprefix('.')}: {error}") from None
