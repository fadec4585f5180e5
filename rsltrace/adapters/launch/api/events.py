"""Events and event handlers: when something starts or ends, other things start."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rsltrace.adapters.launch.api.basics import (
    Action,
    LaunchContext,
    LaunchDescriptionEntity,
    visit_all,
)

_NO_END = "a run ends by the job's stop: conditions"
_CALLED = "it is a function that is called with the event, which there is none of here"


class Event:
    """Something that happens."""


class Shutdown(Event):
    """The end of everything."""

    def __init__(self, *, reason: str = "reason not given", due_to_sigint: bool = False) -> None:
        self.reason, self.due_to_sigint = reason, due_to_sigint


class _UnusedEvent(Event):
    """An event of processes or lifecycle nodes, which does not happen here."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass


class ProcessExited(_UnusedEvent):
    """A process has ended."""


class ProcessStarted(_UnusedEvent):
    """A process has started."""


class ProcessIO(_UnusedEvent):
    """A process has written something."""


class SignalProcess(_UnusedEvent):
    """A process gets a signal."""


class ShutdownProcess(_UnusedEvent):
    """A process is to end."""


class ChangeState(_UnusedEvent):
    """A lifecycle node is to change its state."""


class StateTransition(_UnusedEvent):
    """A lifecycle node has changed its state."""


def matches_action(target_action: Any) -> Any:
    """Return what tells the events of an action, which nobody asks here."""
    return lambda action: action is target_action


class EventHandler:
    """Does something when an event happens: which ones, only launch knows."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def register(self, context: LaunchContext, where: str) -> None:
        """Note that it cannot be simulated."""
        context.refuse(where, type(self).__name__, "nothing here knows when that happens")


class OnShutdown(EventHandler):
    """What is done at the end: nothing of it is part of a run."""

    def register(self, context: LaunchContext, where: str) -> None:
        context.launched.ignored.append(
            f"{where}: OnShutdown: a run is over when it ends; nothing starts then"
        )


class OnProcessIO(EventHandler):
    """What is done when a process has written something."""


class OnStateTransition(EventHandler):
    """What is done when a lifecycle node has changed its state."""


class _OnProcess(EventHandler):
    """Starts actions when a process starts or ends."""

    moment = "ended"

    def __init__(self, *, target_action: Any = None, actions: Any = None) -> None:
        self._target, self._actions = target_action, actions

    def register(self, context: LaunchContext, where: str) -> None:
        """Have the actions done once everything else of the launch file is."""
        if not isinstance(self._target, Action):
            context.refuse(where, type(self).__name__, "it is not for one process")
        elif self._actions is not None:
            later(context, where, self.moment, self._target, self._actions)


class OnProcessExit(_OnProcess):
    """Starts actions when a process has ended."""

    def __init__(self, *, target_action: Any = None, on_exit: Any = None, **_: Any) -> None:
        super().__init__(target_action=target_action, actions=on_exit)


class OnProcessStart(_OnProcess):
    """Starts actions when a process has started."""

    moment = "started"

    def __init__(self, *, target_action: Any = None, on_start: Any = None, **_: Any) -> None:
        super().__init__(target_action=target_action, actions=on_start)


class OnExecutionComplete(_OnProcess):
    """Starts actions when another one is done, which for a node means that it has ended."""

    def __init__(self, *, target_action: Any = None, on_completion: Any = None, **_: Any) -> None:
        super().__init__(target_action=target_action, actions=on_completion)


def later(context: LaunchContext, where: str, moment: str, target: Action, actions: Any) -> None:
    """Have actions done after the launch file; their nodes start when ``target`` starts or ends."""
    if callable(actions) and not isinstance(actions, LaunchDescriptionEntity):
        context.refuse(where, f"what follows when {_title(target)} has {moment}", _CALLED)
        return
    listed = list(actions) if isinstance(actions, Iterable) else [actions]
    if not all(isinstance(action, LaunchDescriptionEntity) for action in listed):
        what = f"what follows when {_title(target)} has {moment}"
        context.launched.ignored.append(f"{where}: {what}: it is no action")
        return
    context.kept.append(target)

    def do() -> None:
        outer = context.after, context.delay_ns
        context.after, context.delay_ns = (moment, id(target)), 0
        try:
            visit_all(context, listed)
        finally:
            context.after, context.delay_ns = outer

    context.later.append(do)


def _title(target: Action) -> str:
    return f"the {type(target).__name__} of {target.where}"


class EmitEvent(Action):
    """Lets an event happen."""

    def __init__(self, *, event: Any, **options: Any) -> None:
        super().__init__(**options)
        self.event = event

    def execute(self, context: LaunchContext) -> None:
        """Note that it cannot be simulated, but for the end of everything where a node ends."""
        if not isinstance(self.event, Shutdown):
            what = f"EmitEvent({type(self.event).__name__})"
            context.refuse(self.where, what, "there are no processes and no launch service here")
            return
        if context.after is None:
            context.refuse(self.where, "shutdown", _NO_END)
        elif context.after[0] == "ended" and not context.delay_ns:
            context.launched.required.add(context.after[1])
        else:
            context.launched.ignored.append(f"{self.where}: shutdown: {_NO_END}")


class ShutdownAction(EmitEvent):
    """Ends everything."""

    def __init__(self, *, reason: Any = "reason not given", **options: Any) -> None:
        super().__init__(event=Shutdown(), **options)


class RegisterEventHandler(Action):
    """Has an event handler ask for its event."""

    def __init__(self, event_handler: EventHandler, **options: Any) -> None:
        super().__init__(**options)
        self._handler = event_handler

    def execute(self, context: LaunchContext) -> None:
        if not isinstance(self._handler, EventHandler):
            raise TypeError(f"an event handler is needed, not {type(self._handler).__name__}")
        self._handler.register(context, self.where)


class UnregisterEventHandler(Action):
    """Takes an event handler away."""

    def __init__(self, event_handler: EventHandler, **options: Any) -> None:
        super().__init__(**options)

    def execute(self, context: LaunchContext) -> None:
        context.refuse(self.where, "UnregisterEventHandler", "event handlers stay as they are here")
