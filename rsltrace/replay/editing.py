"""Making edits in a run: at the boundary between two events, or in the way of the next one.

Where an edit takes place depends on nothing but how many events there have been and what time it
is, so the same edits of the same run give the same branch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from rsltrace.errors import EditError, did_you_mean
from rsltrace.loop.stop import Stop
from rsltrace.middleware.events.event import OutsideEvent
from rsltrace.model.event import NO_EVENT, EventKind
from rsltrace.model.stamp import format_seconds
from rsltrace.replay.edited_messages import arrived_for_action, changed_data, received
from rsltrace.replay.edits import (
    Defer,
    Delay,
    Drop,
    Edit,
    SetAttribute,
    SetMessage,
    SetParameter,
    change,
)

if TYPE_CHECKING:
    from rsltrace.run.session import Session

_CAN_COME_LATER = (EventKind.SUBSCRIPTION, EventKind.TIMER, EventKind.SERVICE)
_CAN_BE_DROPPED = (*_CAN_COME_LATER, EventKind.CLIENT, EventKind.ACTION, EventKind.BAG)
FAILED = Stop("an edit could not be made", 2)


class Editing:
    """The edits of one run. ``error`` says which of them could not be made, and why.

    ``on_new`` is called before the first edit, from number ``known`` on, that is made.
    """

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
        self._session: Session

    @property
    def branches(self) -> bool:
        """Whether there are new edits."""
        return bool(self._new)

    @property
    def unmade(self) -> list[Edit]:
        """The edits that have not been made so far."""
        return [*self._pending, *(edit for edits in self._armed.values() for edit in edits)]

    def failure(self) -> EditError | None:
        """Return what is wrong with a run that is over: a new edit that has not been made."""
        late = [edit for edit in self.unmade if edit in self._new]
        if self.error is not None or not late:
            return self.error
        return EditError(
            f"{late[0].text!r} was not made: the run was over before, after {self._loop.events} "
            f"events, at {format_seconds(self._loop.now_ns)} s"
        )

    def attach(self, session: Session) -> None:
        """Make the edits in an open session from now on."""
        self._session = session
        self._loop = session.loop
        self._dispatcher = dispatcher = session.world.domain.dispatcher
        self._execute, self._end_event = dispatcher.execute, dispatcher.end_event
        dispatcher.execute = self._edited  # type: ignore[method-assign, assignment]
        dispatcher.end_event = self._ended  # type: ignore[method-assign]

    def _edited(self, *event: Any) -> None:
        """Stand in for ``Dispatcher.execute``: an event is about to run."""
        if not self._pending:
            self._execute(*event)
            return
        due = [edit for edit in self._pending if self._is_due(edit)]
        for edit in due:
            if not edit.of_event:
                self._try(edit, self._between)
        changed: tuple[Any, ...] | None = event
        if event[3] == EventKind.BAG:  # a topic's next message may be the one of this very event
            changed = (*event[:4], event[0].send, *event[5:])
        for edit in due:
            if edit.of_event and changed is not None and self.error is None:
                changed = self._try(edit, self._event, changed)
        if changed is not None and self.error is None:
            self._execute(*changed)
        elif hasattr(event[0], "task"):  # a coroutine that nobody is going to begin
            getattr(event[0].task._handler, "close", int)()

    def _ended(self) -> None:
        """Stand in for ``Dispatcher.end_event``: what is due before the next event is made."""
        self._end_event()
        for edit in [edit for edit in self._pending if self._is_due(edit)]:
            if not edit.of_event:
                if not isinstance(edit.action, SetParameter):  # an event of its own: see _edited
                    self._try(edit, self._between)
            elif edit.index is not None and edit.index < self._loop.events:
                self._fail(edit, "this is no callback, but what a main or thread did")

    def _is_due(self, edit: Edit) -> bool:
        if edit.index is not None:
            return self._loop.events >= edit.index
        assert edit.time_ns is not None
        return self._loop.now_ns >= edit.time_ns

    def _try(self, edit: Edit, make: Callable[..., Any], *args: Any) -> Any:
        """Make an edit, or end the run and say why not."""
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

    # -- between two events ----------------------------------------------------------------------

    def _between(self, edit: Edit) -> None:
        action = edit.action
        if edit.topic is not None:
            self._arm(edit, edit.topic)
            return
        self._pending.remove(edit)
        assert isinstance(action, (SetAttribute, SetParameter))
        node = self._node(action.node)
        if isinstance(action, SetAttribute):
            first = action.path[0][1]
            if not hasattr(node, first):
                near = did_you_mean(first, vars(node))
                raise EditError(f"{action.node} has no attribute {first!r}{near}")
            change(node, action.path, action.operator, action.value)
        else:
            handle = OutsideEvent(lambda: f"the edit {edit.text!r}")
            event = (handle, 0, None, EventKind.OUTSIDE, self._set_parameter)
            self._execute(*event, (edit, node, action), NO_EVENT, 0, 0)

    def _set_parameter(self, edit: Edit, node: Any, action: SetParameter) -> None:
        """Set a parameter; what is wrong with it is no exception of a node's."""
        try:
            _set_parameter(node, action)
        except EditError as error:
            self._fail(edit, str(error))

    def _node(self, name: str) -> Any:
        for handle in self._session.world.domain.graph.nodes_named(name):
            wrapper = getattr(handle, "wrapper", None)
            if wrapper is not None:
                return wrapper
        raise EditError(f"there is no node {name} by then")

    def _arm(self, edit: Edit, topic: str) -> None:
        """Wait for the next message on a topic, whoever publishes it."""
        publishers = list(self._session.world.domain.graph.publishers(topic))
        if not publishers:
            return  # nobody yet
        self._pending.remove(edit)
        self._armed.setdefault(topic, []).append(edit)

        def send(publisher: Any, data: bytes, content_hash: int | None = None) -> None:
            for one in publishers:
                one.__dict__.pop("send", None)
            for armed in self._armed.pop(topic, ()):
                if isinstance(armed.action, Drop) or data is None:
                    return
                data = self._try(armed, partial(changed_data, publisher), data)
                content_hash = None
            if data is not None:
                publisher.send(data, content_hash)

        for publisher in publishers:
            publisher.send = partial(send, publisher)  # type: ignore[method-assign]

    # -- the event that is about to run ----------------------------------------------------------

    def _event(self, edit: Edit, event: tuple[Any, ...]) -> tuple[Any, ...] | None:
        """Return what is to run instead of an event; None if nothing is, or not now."""
        self._pending.remove(edit)
        handle, _, node, kind = event[:4]
        action = edit.action
        if isinstance(action, SetMessage):
            return received(edit, event)
        name = f"{handle.describe()} ({EventKind(kind).label})"
        waits = hasattr(handle, "task")  # a coroutine
        if isinstance(action, Drop):
            if kind not in _CAN_BE_DROPPED:
                raise EditError(f"{name} cannot be dropped")
            if waits:
                if (part := arrived_for_action(handle, kind)) is not None:
                    part.queue.popleft()
                handle.task._handler.close()
                handle.task.cancel()
                handle.dispatch()  # which ends it
            return None
        if kind not in _CAN_COME_LATER or waits or isinstance(handle, OutsideEvent):
            raise EditError(f"{name} cannot run later; a subscription, timer or service can")
        if getattr(node, "mailbox", None) is not None:
            raise EditError(f"{name} cannot run later: an executor of its program runs it")
        later = _Later(self._dispatcher, event)
        if isinstance(action, Delay):
            self._loop.schedule_release(self._loop.now_ns + action.delay_ns, lambda _: later)
        else:
            assert isinstance(action, Defer)
            self._loop.schedule_release(self._loop.now_ns, lambda _: later.once())
            if action.count is not None:
                self._after(action.count, later)
        return None

    def _after(self, count: int, later: _Later) -> None:
        """Make an event ready as soon as so many others have run."""
        goal = self._loop.events + count
        end_event = self._dispatcher.end_event

        def ended() -> None:
            end_event()
            if self._loop.events >= goal:
                self._dispatcher.end_event = end_event  # type: ignore[method-assign]
                if later.once() is not None:
                    self._loop.ready.appendleft(later)

        self._dispatcher.end_event = ended  # type: ignore[method-assign]


def _set_parameter(node: Any, action: SetParameter) -> None:
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


class _Later:
    """An event that runs later than it would have."""

    def __init__(self, dispatcher: Any, event: tuple[Any, ...]) -> None:
        self._dispatcher = dispatcher
        self._event = event
        self._handle = event[0]
        self._is_on = True

    def once(self) -> _Later | None:
        """Return itself the first time."""
        if not self._is_on:
            return None
        self._is_on = False
        return self

    def dispatch(self) -> None:
        """Run the event, unless whose it is has gone; a busy callback group is waited for."""
        handle = self._handle
        if getattr(handle, "destroyed", False):
            return
        wrapper = getattr(handle, "wrapper", None)
        if wrapper is not None and handle.stacks.groups.must_wait(self, wrapper):
            return
        self._dispatcher.execute(*self._event)

    def describe(self) -> str:
        """Name it for an error message."""
        return str(self._handle.describe())

    def runnable(self) -> Any:
        """Describe it to a policy."""
        return self._handle.runnable()
