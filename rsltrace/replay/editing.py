"""Make edits in a run: between two events, or to the next event.

The place of an edit depends only on the number of events and the time, so the same edits of the
same run give the same branch.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Sequence
from functools import partial
from itertools import takewhile
from math import inf
from typing import TYPE_CHECKING, Any

from rsltrace.errors import EditError, did_you_mean
from rsltrace.replay.edits import (
    DeferEdit,
    DelayEdit,
    DropEdit,
    Edit,
    SetAttributeEdit,
    SetMessageEdit,
    SetParameterEdit,
    path_text,
    set_path,
)
from rsltrace.simulation.loop.loop import Dispatchable, EventLoop
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.event import OutsideEvent
from rsltrace.simulation.middleware.events.observer import EventCall, EventObserver, ObserverOrder
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.texts import format_seconds

if TYPE_CHECKING:
    from rsltrace.run.session import RunSession


def changed_data(endpoint: Any, edit: Edit, data: bytes) -> bytes:
    """Return an edited message (canonical CDR) of a publisher or subscription.

    :raises EditError: there is no such field, or the value does not fit.
    """
    from rsltrace.adapters.rclpy.messages.codec import codec_for
    from rsltrace.adapters.rclpy.messages.interfaces import class_of

    return _recoded(codec_for(class_of(endpoint)), edit, data)


def receive_edited(edit: Edit, call: EventCall) -> None:
    """Change the message that an event is about to receive.

    :raises EditError: it receives none, or the edit does not fit.
    """
    from rsltrace.adapters.rclpy.messages.codec import codec_for
    from rsltrace.adapters.rclpy.messages.interfaces import get_message_class

    handle, kind, args = call.handle, call.kind, call.args
    is_coroutine = hasattr(handle, "task")
    if is_coroutine:
        part = arrived_for_action(handle, kind)
        if part is not None:
            call.input_hash = _change_arrival(part, edit)
            return
        args = tuple(one for one in _begun_with(handle, kind) if _is_message(one))[:1]
    if hasattr(handle, "arriving_type"):  # of a process
        codec = codec_for(get_message_class(handle.arriving_type()))
        call.args, data = handle.changed(args, partial(_recoded, codec, edit))
        call.input_hash = hash64(data)
        return
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
    """Return the part of an action (goal, response, feedback) whose arrival a coroutine is about to
    take, or None."""
    from rsltrace.adapters.rclpy.handles.actions import ActionEndpoint

    parts = (
        one for one in _begun_with(handle, kind) if isinstance(one, ActionEndpoint) and one.queue
    )
    return next(parts, None) if kind == EventKind.ACTION else None


def _begun_with(run: Any, kind: int) -> list[Any]:
    """Return the arguments of a coroutine that has not begun yet, else nothing."""
    frame = getattr(run.task._handler, "cr_frame", None)
    is_under_way = kind in (EventKind.RESUME, EventKind.TASK)
    return [] if frame is None or is_under_way else list(frame.f_locals.values())


def _change_arrival(part: Any, edit: Edit) -> int:
    """Change the first arrival in a queue; return its hash."""
    from rsltrace.adapters.rclpy.handles.actions import ActionService, ActionServiceClient
    from rsltrace.adapters.rclpy.messages.codec import codec_for

    if isinstance(part, ActionService):
        codec = codec_for(part.srv_type.Request)
    elif isinstance(part, ActionServiceClient):
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
    """Change a field, with the checks that rclpy's own messages have."""
    action = edit.action
    assert isinstance(action, SetMessageEdit)
    try:
        set_path(message, action.path, action.operator, action.value)
    except AttributeError:
        fields = message.get_fields_and_field_types()
        near = did_you_mean(str(action.path[0][1]), fields)
        listed = ", ".join(fields)
        name = f"{path_text(action.path).removeprefix('.')}"
        raise EditError(f"{type(message).__name__} has no {name} (it has {listed}){near}") from None
    except AssertionError as error:
        raise EditError(f"{path_text(action.path).removeprefix('.')}: {error}") from None


_CAN_COME_LATER = (EventKind.SUBSCRIPTION, EventKind.TIMER, EventKind.SERVICE)
_CAN_BE_DROPPED = (*_CAN_COME_LATER, EventKind.CLIENT, EventKind.ACTION, EventKind.BAG)
FAILED = Stop("an edit could not be made", 2)


class EditObserver(EventObserver):
    """Makes the edits of one run. ``error`` says which edit failed, and why.

    ``on_new`` is called before the first edit with number ``known`` or higher is made.
    """

    order = ObserverOrder.EDITS

    def __init__(
        self,
        edits: Sequence[Edit],
        *,
        known: int = 0,
        on_new: Callable[[], None] = lambda: None,
    ) -> None:
        self.all = tuple(edits)
        self._pending = list(edits)
        self._new = list(edits)[known:]
        self._armed: dict[str, list[Edit]] = {}
        self._on_new: Callable[[], None] | None = on_new
        self.error: EditError | None = None
        self._setting: OutsideEvent | None = None
        """The current event, if it is an edit itself."""
        self._session: RunSession

    @property
    def branches(self) -> bool:
        return bool(self._new)

    @property
    def unmade(self) -> list[Edit]:
        return [*self._pending, *(edit for edits in self._armed.values() for edit in edits)]

    def failure(self) -> EditError | None:
        """Return what is wrong after the run: an error, or a new edit that was never made."""
        late = [edit for edit in self.unmade if edit in self._new]
        if self.error is not None or not late:
            return self.error
        return EditError(
            f"{late[0].text!r} was not made: the run was over before, after {self._loop.events} "
            f"events, at {format_seconds(self._loop.now_ns - self._session.start_ns)} s"
        )

    def attach(self, session: RunSession) -> None:
        self._session = session
        self._loop = session.loop
        self._dispatcher = session.world.domain.dispatcher
        self._deferred = DeferredEvents(session.loop)
        self._dispatcher.add_observer(self)

    def before_event(self, call: EventCall) -> bool:
        """Make the edits due before an event, and those of the event itself."""
        if not self._pending or call.handle is self._setting:
            return True
        due = [edit for edit in self._pending if self._is_due(edit)]
        for edit in due:
            if not edit.of_event:
                self._try(edit, self._between)
        happens = True
        for edit in due:
            if edit.of_event and happens and self.error is None:
                happens = bool(self._try(edit, self._event, call))
        if self.error is not None and hasattr(call.handle, "task"):
            call.handle.task._handler.close()  # a coroutine that will not begin
        return happens and self.error is None

    def after_event(self) -> None:
        """Make the edits due before the next event, and release deferred events."""
        for edit in [edit for edit in self._pending if self._is_due(edit)]:
            if edit.of_event:
                self._check_is_to_come(edit)
            elif not isinstance(edit.action, SetParameterEdit):  # it is an event: see before_event
                self._try(edit, self._between)
        self._deferred.release()

    def _check_is_to_come(self, edit: Edit) -> None:
        """End the run if the event of an edit is over. After an edit that was itself an event of
        that number, the next one is meant."""
        if edit.index is None or edit.index >= self._loop.events:
            return
        if self._dispatcher.event.handle is not self._setting:
            self._fail(edit, "the event is not a callback: a main or a thread made it")

    def _is_due(self, edit: Edit) -> bool:
        if edit.index is not None:
            return self._loop.events >= edit.index
        assert edit.time is not None
        return self._loop.now_ns >= edit.time.stamp_ns(self._session.start_ns)

    def _try(self, edit: Edit, make: Callable[..., Any], *args: Any) -> Any:
        """Make an edit, or end the run with the reason why not."""
        if self._on_new is not None and edit in self._new:
            on_new, self._on_new = self._on_new, None
            on_new()
        try:
            return make(edit, *args)
        except EditError as error:
            self._fail(edit, str(error))
        except Exception as error:
            self._fail(edit, f"{type(error).__name__}: {error}")
        return None

    def _fail(self, edit: Edit, why: str) -> None:
        self._pending.clear()
        self._armed.clear()
        if self.error is None:
            self.error = EditError(f"{edit.text!r} at event {self._loop.events}: {why}")
        self._loop.stop(FAILED)

    def _between(self, edit: Edit) -> None:
        action = edit.action
        if edit.topic is not None:
            self._arm(edit, edit.topic)
            return
        self._pending.remove(edit)
        assert isinstance(action, (SetAttributeEdit, SetParameterEdit))
        node = self._node(action.node)
        if isinstance(action, SetAttributeEdit):
            first = action.path[0][1]
            if not hasattr(node, first):
                near = did_you_mean(first, vars(node))
                raise EditError(f"{action.node} has no attribute {first!r}{near}")
            set_path(node, action.path, action.operator, action.value)
        else:
            self._setting = handle = OutsideEvent(lambda: f"the edit {edit.text!r}")
            self._dispatcher.run_outside(
                handle, EventKind.OUTSIDE, 0, None, partial(self._set_parameter, edit, node, action)
            )
            self._setting = None

    def _set_parameter(self, edit: Edit, node: Any, action: SetParameterEdit) -> None:
        """Set a parameter; an error is the edit's, not an exception of the node."""
        try:
            _set_parameter(node, action)
        except EditError as error:
            self._fail(edit, str(error))

    def _node(self, name: str) -> Any:
        for handle in self._session.world.domain.graph.nodes_named(name):
            wrapper = getattr(handle, "wrapper", None)
            if wrapper is not None:
                return wrapper
        raise EditError(f"at that time there is no node {name}")

    def _arm(self, edit: Edit, topic: str) -> None:
        """Wait for the next message on a topic, from any publisher."""
        domain = self._session.world.domain
        if not domain.graph.publishers(topic):
            return  # no publisher yet
        self._pending.remove(edit)
        self._armed.setdefault(topic, []).append(edit)

        def edited(publisher: Any, data: bytes) -> bytes | None:
            domain.filter(topic, None)
            result: bytes | None = data
            for armed in self._armed.pop(topic, ()):
                if result is None or isinstance(armed.action, DropEdit):
                    return None
                result = self._try(armed, partial(changed_data, publisher), result)
            return result

        domain.filter(topic, edited)

    def _event(self, edit: Edit, call: EventCall) -> bool:
        """Make an edit of an event; return whether the event runs now."""
        self._pending.remove(edit)
        handle, kind, action = call.handle, call.kind, edit.action
        if isinstance(action, SetMessageEdit):
            receive_edited(edit, call)
            return True
        name = f"{handle.describe()} ({EventKind(kind).label})"
        waits = hasattr(handle, "task")  # a coroutine
        if isinstance(action, DropEdit):
            if kind not in _CAN_BE_DROPPED:
                raise EditError(f"{name} cannot be dropped")
            if waits:
                if (part := arrived_for_action(handle, kind)) is not None:
                    part.queue.popleft()
                handle.task._handler.close()
                handle.task.cancel()
                handle.dispatch()  # which ends it
            return False
        if kind not in _CAN_COME_LATER or waits or isinstance(handle, OutsideEvent):
            raise EditError(f"{name} cannot run later; a subscription, timer or service can")
        if getattr(call.node, "mailbox", None) is not None:
            raise EditError(f"{name} cannot run later: an executor of its program runs it")
        later = _LaterEvent(self._dispatcher, call)
        if isinstance(action, DelayEdit):
            self._loop.schedule_release(self._loop.now_ns + action.delay_ns, lambda _: later)
        else:
            assert isinstance(action, DeferEdit)
            self._deferred.add(later, action.count)
        return False


def _set_parameter(node: Any, action: SetParameterEdit) -> None:
    from rclpy.parameter import Parameter

    value = action.value
    known = node._parameters.get(action.name)
    if known is None and not node._allow_undeclared_parameters:
        near = did_you_mean(action.name, node._parameters)
        raise EditError(f"{action.node} has no parameter {action.name!r}{near}")
    if known is not None and known.type_ is Parameter.Type.DOUBLE and type(value) is int:
        value = float(value)
    for result in node.set_parameters([Parameter(action.name, value=value)]):
        if not result.successful:
            raise EditError(f"{action.node} refuses {action.name} = {value!r}: {result.reason}")


class DeferredEvents:
    """Events deferred until so many others, or all that are due at the current time, have run.

    They wait in order of the event before which they run; the first also runs when nothing else can
    run at the current time, so no event is lost.
    """

    def __init__(self, loop: EventLoop) -> None:
        self._loop = loop
        self._waiting: list[tuple[float, int, Dispatchable]] = []
        self._count = 0

    def add(self, item: Dispatchable, others: int | None) -> None:
        """Let ``others`` events (None: all) run before ``item``."""
        if not self._waiting:
            self._loop.idle.append(self._release_first)
        self._count += 1  # no two are the same, so items are not compared
        before = inf if others is None else self._loop.events + others
        insort(self._waiting, (before, self._count, item))

    def release(self) -> None:
        """Run those that have waited long enough next."""
        due = 0
        while due < len(self._waiting) and self._waiting[due][0] <= self._loop.events:
            due += 1
        self._run_next(due)

    def _run_next(self, count: int) -> None:
        tasks = self._loop.tasks
        before = sum(1 for _ in takewhile(lambda one: isinstance(one, _LaterEvent), tasks))
        for _, _, item in reversed(self._waiting[:count]):
            tasks.insert(before, item)
        del self._waiting[:count]
        if count and not self._waiting:
            self._loop.idle.remove(self._release_first)

    def _release_first(self) -> bool:
        """Run the first deferred event when nothing else is ready."""
        loop = self._loop
        if loop.idle[-1] != self._release_first:  # others have a look first
            loop.idle.remove(self._release_first)
            loop.idle.append(self._release_first)
            return True
        if loop.ready or loop.tasks or (loop.scheduled and loop.scheduled[0][0] <= loop.now_ns):
            return False
        self._run_next(1)
        return True


class _LaterEvent:
    def __init__(self, dispatcher: Dispatcher, call: EventCall) -> None:
        self._dispatcher = dispatcher
        self._event = call.values()
        self._handle = call.handle

    def dispatch(self) -> None:
        """Run the event, unless its entity is gone; a busy callback group is waited for."""
        handle = self._handle
        if getattr(handle, "destroyed", False):
            return
        wrapper = getattr(handle, "wrapper", None)
        if wrapper is not None and handle.runtime.groups.must_wait(self, wrapper):
            return
        self._dispatcher.execute(*self._event)

    def describe(self) -> str:
        return str(self._handle.describe())

    def runnable(self) -> Any:
        return self._handle.runnable()
