"""Calls that block become simulated waiting: time passes, other callbacks run, then they return.

There is one thread, so whoever blocks gives its call stack up for a while: greenlets do that. The
loop runs on the stack of whoever runs it; when a callback blocks deep inside it, another stack
takes the loop over, and when the wait is over the loop's present runner switches back to the
callback, which finishes and goes on as the loop's runner. Callbacks that do not block (nearly all)
never meet any of this.

In the trace a wait ends the event (flag ``SUSPENDED``); what follows is a ``RESUME`` event.
"""

from __future__ import annotations

import os
import threading
import traceback
from _thread import get_ident
from asyncio import _get_running_loop, _set_running_loop
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NoReturn

from greenlet import getcurrent, greenlet

from rsltrace.doors.rclpy.boundary import callback_groups as groups
from rsltrace.doors.rclpy.stacks.wait_reasons import called_service
from rsltrace.errors import UnsupportedError
from rsltrace.guard.redirect import copy_of
from rsltrace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core

POLL_NS = 1_000_000
"""What a second look at one instant costs: a loop of ``spin_once(timeout_sec=0)`` takes time."""

_RESUME = int(EventKind.RESUME)
_SUSPENDED = int(EventFlag.SUSPENDED)
getpid = copy_of(os.getpid)  # type: ignore[arg-type]  # not the one that the guard watches
_PATIENCE = 100
"""How often a stack may go on to wait after the end of the run before it is left where it is."""
_PYTHON = os.path.dirname(threading.__file__) + os.sep

# Stacks that go on whatever is raised in them (`while True: try: ... except: pass`). They must not
# be collected: that would raise in them once more.
_abandoned: list[greenlet] = []

Patience = bool | Callable[[], bool]
"""Whether it is in order to wait for ever, or what says so when somebody asks."""


class RunEnded(BaseException):
    """Raised in a blocked call when the run ends, so that ``finally`` blocks run."""


class Wait:
    """One blocked call. ``wake`` makes it ready; it is dispatched like any other event."""

    def __init__(
        self, core: Core, what: object, group: object, *, quiet: bool, patient: Patience
    ) -> None:
        self.core = core
        self.what = what
        self._patient = patient
        self.error: BaseException | None = None
        """What to raise in the blocked call when it goes on."""
        self.program = core.program
        self.deadline_ns: int | None = None
        self.quiet = quiet
        self._group = group
        self.stack = getcurrent()
        self.timed_out = False
        self._woken = False
        self._event = (core.current_handle, core.current_entity, core.current_node)
        self._constructing = core.constructing
        self._end_group = core.on_end
        self._cause = (NO_EVENT, 0)
        self._input_hash = 0
        self._busy_ns = core.busy_ns

    @property
    def entity_id(self) -> int:
        """The entity whose callback waits."""
        return self._event[1]

    @property
    def group(self) -> object:
        """The callback group that the wait keeps busy, or None."""
        return self._group

    @property
    def waiting(self) -> bool:
        """Whether nothing has let the call return yet."""
        return not self._woken

    def stop_waiting(self) -> None:
        """Take no more notice of what the call waited for."""
        self._woken = True

    def is_patient(self) -> bool:
        """Return whether it is in order to wait for ever: for more work, say."""
        patient, self._patient = self._patient, False  # False, should somebody ask in a circle
        try:
            return patient if isinstance(patient, bool) else patient()
        finally:
            self._patient = patient

    def wake(self) -> None:
        """Let the call return: because of the event under way."""
        if not self._woken:
            self._woken = True
            core = self.core
            self._cause = (core.loop.events, core.note(OutputKind.TASK, self._event[1], 2))
            self._input_hash = core.input_hash
            core.loop.tasks.append(self)

    def release(self) -> None:
        """Let the call return, because of nothing that has an event."""
        if not self._woken:
            self._woken = True
            self.core.loop.tasks.append(self)

    def time_out(self) -> None:
        """Let the call return: because its time is up."""
        if not self._woken:
            self._woken = self.timed_out = True
            self.core.loop.ready.append(self)

    def dispatch(self) -> None:
        """Give the loop's runner up to the blocked call (called on the runner's stack)."""
        runners = self.core.runners
        runner = getcurrent()
        runners.append(runner)
        self.stack.switch()

    def resumed(self) -> None:
        """Begin the RESUME event (called on the blocked call's own stack)."""
        core = self.core
        core.current_handle, core.current_entity, core.current_node = self._event
        if core.on_node is not None:
            core.on_node(core.current_node)
        core.kind = _RESUME
        core.cause_event, core.cause_output = self._cause
        core.input_hash = self._input_hash
        core.constructing = self._constructing
        core.on_end = self._end_group
        core.quiet = self.quiet
        core.busy_ns = self._busy_ns
        if self.program is not core.program:
            self.program.enter()

    def describe(self) -> str:
        """Name the callback that waits."""
        return self._event[0].describe() if self._event[0] is not None else "the run"

    def waits_for(self) -> str:
        """Say who waits for what, with the lines of user code that led there."""
        frames = traceback.extract_stack(self.stack.gr_frame) if self.stack.gr_frame else []
        own = [frame for frame in frames if _is_telling(frame.filename)]
        where = "".join(f"\n    at {f.filename}:{f.lineno} in {f.name}" for f in own[-4:])
        hint = ""
        if self._group is not None and self.core.waiting_for_group(self._group):
            hint = (
                ", which may be among the events that wait for its callback group: a blocked "
                "callback keeps a mutually exclusive group busy, so give the client, timer or "
                "subscription it waits for a callback group of its own"
            )
        what = called_service(self.core, self.stack.gr_frame) or self.what
        return f"{self.describe()} waits for {what}{hint}{where}"


def _is_telling(file: str) -> bool:
    """Say whether a source file tells the user anything: it is not ours, Python's or rclpy's."""
    if "/rsltrace/" in file or "/rclpy/" in file:
        return False
    return not file.startswith(_PYTHON) or "/site-packages/" in file


def wait(
    core: Core,
    what: object,
    *,
    until: Callable[[Wait], None] | None = None,
    for_ns: int | None = None,
    quiet: bool = False,
    patient: Patience = False,
) -> bool:
    """Block the present callback in simulated time; return whether it was woken (not timed out).

    ``until`` is given the Wait and arranges for its ``wake`` to be called; ``for_ns`` limits the
    wait. ``what`` completes "… waits for". After a ``quiet`` wait there is only a RESUME event if
    something comes of it. A ``patient`` one may last for ever.

    :raises RunEnded: when the run ends before the wait does.
    :raises UnsupportedError: in a real thread, another process, or outside of all callbacks.
    """
    _check_may_wait(core, what)
    group = _hold_group(core)
    blocked = Wait(core, what, group, quiet=quiet, patient=patient)
    if until is not None:
        until(blocked)
    if for_ns is not None:
        blocked.deadline_ns = core.loop.now_ns + core.grace_ns + max(for_ns, 0)
        core.loop.schedule(blocked.deadline_ns, blocked.time_out)
    _end_stretch(core)
    core.blocked[blocked] = None
    core.on_end = None
    if core.program is not core.host:
        core.host.enter()
    running = _get_running_loop()
    if running is not None:  # asyncio keeps one per thread, here each stack has its own
        _set_running_loop(None)
    core.next_runner().switch()
    if running is not None:
        _set_running_loop(running)
    core.blocked.pop(blocked, None)
    blocked.stop_waiting()
    blocked.resumed()
    if core.ending:
        raise RunEnded
    if blocked.error is not None:
        error, blocked.error = blocked.error, None
        raise error
    return not blocked.timed_out


def _check_may_wait(core: Core, what: object) -> None:
    """Refuse where there is no stack that can be set aside, and when the run is over."""
    if get_ident() != core.thread or getpid() != core.process:
        place = "thread" if getpid() == core.process else "process"
        raise UnsupportedError(
            f"a {place} that a node has started waits for {what}, which takes simulated time: only "
            "callbacks, constructors and tasks can wait; use call_async with add_done_callback "
            f"there, or let a callback wait and hand the result to the {place}"
        )
    if core.ending or core.program.ended:
        _refuse(core)
    if core.current_handle is None:
        raise UnsupportedError(
            f"whoever is outside of all callbacks cannot wait for {what}: a stop function only "
            "looks; in a Simulation, do it within sim.call(…), or run the simulation until then"
        )


def _end_stretch(core: Core) -> None:
    """Record the event under way as one that will go on, unless it is quiet and said nothing."""
    if core.quiet and not core.said_anything():
        core.quiet = False
        core.flags = 0
        return
    core.flags |= _SUSPENDED
    core.end_event()


@contextmanager
def set_aside(core: Core) -> Iterator[None]:
    """Let other events run on this stack, between two parts of the event under way."""
    handle, entity, node = core.current_handle, core.current_entity, core.current_node
    constructing, on_end = core.constructing, core.on_end
    _end_stretch(core)
    core.on_end = None
    try:
        yield
    finally:
        core.current_handle, core.current_entity, core.current_node = handle, entity, node
        if core.on_node is not None:
            core.on_node(node)
        core.kind, core.input_hash = _RESUME, 0
        core.cause_event, core.cause_output = core.loop.events - 1, 0
        core.constructing, core.on_end = constructing, on_end
        core.quiet = True


def _refuse(core: Core) -> NoReturn:
    """Do not wait any more, the run is over."""
    lose_patience(core)
    raise RunEnded


def abandon(stack: greenlet) -> None:
    """Leave a stack where it is, for ever: nothing is raised in it, nothing in it is collected."""
    _abandoned.append(stack)


def lose_patience(core: Core) -> None:
    """Count that somebody goes on although the run is over; in the end, leave it where it is."""
    core.refused += 1
    if core.refused > _PATIENCE and getcurrent() is not core.main:
        core.refused = 0
        core.end_event()
        abandon(getcurrent())
        core.host.enter()
        assert core.main is not None
        core.main.switch()


def _hold_group(core: Core) -> object:
    """Keep the callback's group busy while it is blocked, as an executor would; return it."""
    handle = core.current_handle
    wrapper: Any = getattr(handle, "wrapper", None)
    group = getattr(wrapper, "callback_group", None)
    if core.on_end is None and group is not None and not groups.is_busy(group, wrapper):
        groups.begin(group, wrapper)
        core.on_end = lambda: groups.end(core, group, wrapper)
    return group


def end_blocked(core: Core) -> None:
    """Unwind every blocked call at the end of a run, so that ``finally`` blocks run."""
    core.ending = True
    core.loop.halt()
    here = getcurrent()
    for blocked in list(core.blocked):
        core.runners.append(here)
        blocked.stack.switch()
    for runner in core.runners:
        if runner is not here and not runner.dead:
            runner.throw(RunEnded)
    core.runners.clear()
