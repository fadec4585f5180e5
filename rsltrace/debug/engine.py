"""The simulation's side of a debugging session: runs between events, stops, answers, forks.

It is an observer of events. To stop is to read requests after an event, or before a callback,
instead of returning to the loop; the stack stays as it is.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, NamedTuple

from greenlet import getcurrent, greenlet

from rsltrace.checks.conditions.names import RunNames, loaded_fields, names_of
from rsltrace.checks.conditions.text import parse_condition
from rsltrace.debug import inspection
from rsltrace.debug.current_event import NO_CALL, CallbackCall, CurrentEventView, call_of
from rsltrace.debug.debuggers import make_debugger
from rsltrace.debug.event_history import EventLedger, event_values
from rsltrace.debug.goal import RunGoal, WatchedCondition, parse_goal
from rsltrace.errors import DebugError, RsltraceError
from rsltrace.forking import end_process, fork_beside, why_not
from rsltrace.guard.guard import engage
from rsltrace.guard.redirect import copy_of
from rsltrace.line_protocol import Lines, Message
from rsltrace.simulation.middleware.events.observer import EventCall, EventObserver, ObserverOrder
from rsltrace.trace.format import EVENT_REST
from rsltrace.trace.model.event import EventKind

if TYPE_CHECKING:
    from rsltrace.run.session import RunSession

_LOOK_EVERY = 64
_LOOK_S = 0.05
_NEVER = 1 << 62
_cpu_s: Callable[[], float] = copy_of(time.process_time)
_getpid: Callable[[], int] = copy_of(os.getpid)


class ForkedCopy(NamedTuple):
    """A copy of this process: its id, and the socket to it."""

    pid: int
    end: socket.socket


class Engine(EventObserver):
    """The observer that runs, stops and forks one process of a debugged run."""

    order = ObserverOrder.DEBUGGER

    def __init__(
        self,
        session: RunSession,
        ledger: EventLedger,
        lines: Lines,
        *,
        supervisor: int,
        checkpoints: bool,
        idle: frozenset[int],
    ) -> None:
        """``idle`` are middleware threads that do nothing here, and need not be copied."""
        self.session = session
        self.ledger = ledger
        self.lines = lines
        self.event = session.world.domain.event
        self.diverged = False
        self.over = ""
        """Why nothing follows any more, once that is so."""
        self.is_next = False
        self._supervisor = supervisor
        self._forks = checkpoints
        self._idle = idle
        self.view = CurrentEventView(session, ledger)
        self._goal = RunGoal()
        self._mark = _NEVER
        self._checkpoint_s = 0.0
        self._look, self._looked_s = 1, 0.0
        self._next_checkpoint_s = 0.0
        self._hit: Message | None = None
        self._copied_at = -1
        self._calls: dict[greenlet, CallbackCall] = {}
        """What each stack has called last that is not yet over."""
        self._is_unasked = False
        """Whether a callback resumes and it is not yet known if that makes an event."""
        self._apart_calls: Callable[..., None] | None = None
        """What calls callbacks in a copy made for a debugger."""
        session.world.domain.dispatcher.add_observer(self)
        ledger.on_difference = self._differs

    def after_event(self) -> None:
        if self.ledger.events >= self._mark:
            self._stop_or_continue()

    def before_event(self, call: EventCall) -> bool:
        here = getcurrent()
        outer = self._calls.get(here)
        self._calls[here] = self.view.call = call_of(call.callback, call.args)
        self._is_unasked = False
        if self._goal.asks_before:
            event = self.event
            event.handle, event.entity = call.handle, call.entity
            event.node, event.kind = call.node, call.kind
            self._about_to_run()
        if self._apart_calls is not None:
            call.callback, call.args = self._apart_calls, (call.callback, call.args)

        def ended() -> None:
            if outer is None:
                del self._calls[here]
            else:
                self._calls[here] = outer  # which spins, and has run this one

        call.on_end.append(ended)
        return True

    def resumed(self) -> None:
        """Decide, on the stack of a callback that resumes, whether to stop before it."""
        self.view.call = self._calls.get(getcurrent(), NO_CALL)
        self._is_unasked = False
        if not self._goal.asks_before:
            return
        with engage(None):
            is_event = self._is_event()
        if is_event:
            self._about_to_run()
        elif is_event is None:
            self._is_unasked, self._mark = True, 0

    def _is_event(self) -> bool | None:
        """Whether a resuming callback makes an event; None if unknown: one that spins makes an
        event only if something comes of it."""
        event = self.event
        if not event.quiet:
            return True
        try:
            rest, _ = self.ledger.history.row(self.ledger.events)
        except IndexError:
            return None if self.ledger.history.trace is None else False
        known = EVENT_REST.unpack(rest)
        now_ns = self.session.loop.now_ns
        return (known[9], known[6], known[1]) == (EventKind.RESUME, event.entity, now_ns)

    def _differs(self) -> None:
        self.diverged = True
        self._mark = 0

    def _stop_or_continue(self) -> None:
        """Stop, answer or fork after an event, as needed."""
        index, goal = self.ledger.events, self._goal
        with engage(None):
            if self.diverged:
                self.over = "this event differs from the first run"
                self._stop("diverged", text=self.over)
                return
            if goal.after and self._ask(goal.after, index):
                return
            if self._is_unasked:
                self._is_unasked = False
                if self._ask(goal.before, index, before=True):
                    return
            limit = self.ledger.history.limit
            if limit is not None and index >= limit:
                self.over = self._why_over()
                self._stop("end", text=self.over)
            elif goal.is_reached(index):
                self._stop("step")
            else:
                self._leave_due_checkpoints(index)
                self._set_mark(index)

    def _leave_due_checkpoints(self, index: int) -> None:
        """Leave checkpoints, and look for a request to pause."""
        goal = self._goal
        if goal.ladder and index >= goal.ladder[0]:
            while goal.ladder and index >= goal.ladder[0]:
                goal.ladder.pop(0)
            self._leave_checkpoint()
        elif goal.interval_s and _cpu_s() >= self._next_checkpoint_s:
            self._leave_checkpoint()
        if self.lines.has_more():
            self._stop("paused")

    def _set_mark(self, index: int) -> None:
        goal = self._goal
        if goal.after:
            self._mark = 0
            return
        now_s = _cpu_s()  # of callbacks that take long, look after each: a pause must not wait
        self._look = min(2 * self._look, _LOOK_EVERY) if now_s < self._looked_s + _LOOK_S else 1
        self._looked_s = now_s
        mark = index + self._look
        for one in (goal.until, self.ledger.history.limit, *goal.ladder[:1]):
            if one is not None and one < mark:
                mark = one
        self._mark = mark

    def _about_to_run(self) -> None:
        goal, index = self._goal, self.ledger.events
        with engage(None):
            now_ns = self.session.loop.now_ns
            is_late = goal.until_ns is not None and now_ns > goal.until_ns
            if goal.is_next_at == index or (is_late and self.session.has_begun):
                self.is_next = True
                self._stop("step")
            else:
                self.view.is_next = True
                if self._ask(goal.before, index):
                    return
                self.view.is_next = False

    def _ask(self, watched: list[WatchedCondition], index: int, *, before: bool = False) -> bool:
        """Evaluate conditions; return whether one has stopped the run. ``before`` evaluates those
        that apply before an event, after it has ended."""
        is_next = self.view.is_next
        for one in watched:
            ask = one.armed.before if is_next or before else one.armed.after
            try:
                why = ask(self.view)
            except RsltraceError as error:
                why = str(error)
            if not why:
                continue
            hit = {"number": one.number, "text": one.text}
            if not self._goal.searches:
                self.is_next = is_next
                self._stop("breakpoint", breakpoint=hit, text=why)
                return True
            if index < self._goal.below:
                self._hit = {
                    "index": index,
                    "is_next": is_next,
                    "breakpoint": hit,
                    "text": why,
                    "position": self.position(),
                }
        return False

    def _why_over(self) -> str:
        history = self.ledger.history
        if history.ended is not None:
            return history.ended.reason
        trace = history.trace
        return "the end of the run" if trace is None else trace.result.get("stop_reason", "")

    def run(self) -> None:
        """Run the whole session, stopping as requested. Does not return."""
        session = self.session
        with engage(None):
            self._serve()
        try:
            session.begin()
            if not session.ended:
                session.go_on()
            result = session.finish()
            self.over = str(result.error) if result.error is not None else result.stop_reason
        except RsltraceError as error:
            self.over = str(error)
        with engage(None):
            while True:
                self._stop("end", text=self.over)

    def position(self) -> Message:
        found: Message = {
            "index": self.ledger.events,
            "stamp_ns": self.session.loop.now_ns,
            "event": self.ledger.event(),
            "is_next": self.is_next,
            "over": bool(self.over),
        }
        if self.is_next:
            view = self.view
            view.is_next = True
            found["next"] = {
                "kind": EventKind(view.kind).label,
                "node": view.node,
                "entity": view.entity_name,
                "entity_kind": view.entity_kind,
            }
        return found

    def _stop(self, reason: str, **more: Any) -> None:
        """Answer the request to run, then serve requests."""
        answer = {"reason": reason, "position": self.position(), **more}
        if self._hit is not None:
            answer["hit"], self._hit = self._hit, None
        notes = self._goal.notes()
        if notes:
            answer["notes"] = notes
        self._answer(ok=answer)
        self._serve()

    def _serve(self) -> None:
        """Serve requests until one says to run."""
        while True:
            request = self.lines.receive()
            if request is None:
                end_process(0)
                return
            self._id = request.get("id")
            try:
                if request["do"] == "run":
                    if self._begin(request):
                        return
                elif request["do"] in ("pdb", "debugpy"):
                    if self._start_debugger(request):
                        return
                else:
                    self._do(request)
            except KeyError as error:
                self._answer(
                    error=error_answer(DebugError(f"not a request of this protocol: no {error}"))
                )
            except Exception as error:
                self._answer(error=error_answer(error))

    def _begin(self, request: Message) -> bool:
        """Start running towards a goal; return False if it is reached or the run is over."""
        if self.diverged:
            self._answer(ok={"reason": "diverged", "position": self.position(), "text": self.over})
            return False
        if self.over:
            self._answer(ok={"reason": "end", "position": self.position(), "text": self.over})
            return False
        was_next = self.is_next
        self.view.is_next = False
        goal = parse_goal(request, self.view, self.names)
        index = self.ledger.events
        if goal.is_reached(index) or (was_next and goal.is_next_at == index):
            self._answer(ok={"reason": "step", "position": self.position()})
            return False
        self.is_next = False
        self._goal, self._hit = goal, None  # a copy may have been made in the middle of a search
        self._next_checkpoint_s = _cpu_s() + goal.interval_s
        self._set_mark(index)
        return True

    def _answer(self, **what: Any) -> None:
        try:
            self.lines.send({"id": self._id, **what})
        except OSError:
            end_process(0)

    def _do(self, request: Message) -> None:
        do = request["do"]
        if do == "fork":
            other = self._forked()
            if other is not None:
                self._answer_with(other)
        elif do == "position":
            self._answer(ok=self.position())
        elif do == "pause":
            pass  # it stands already
        elif do == "inspect":
            self._answer(ok=inspection.inspect_run(self, request["what"]))
        elif do == "evaluate":
            expression, node = request["expression"], request.get("node")
            self._run_in_copy(lambda: inspection.evaluate(self, expression, node))
        elif do == "event":
            self._answer(ok=self._event(int(request["index"])))
        elif do == "node name":
            self._answer(ok=inspection.full_name(self, request["name"]))
        elif do == "check":
            self._answer(ok=parse_condition(request["text"], self.names()).text)
        elif do == "node":
            self._run_in_copy(lambda: inspection.attributes(self, request["name"]))
        else:
            raise DebugError(f"there is no request {do!r}")

    def _answer_with(self, copy: ForkedCopy) -> None:
        self._hand_over(copy, {"id": self._id, "ok": {"pid": copy.pid}})

    def _leave_checkpoint(self) -> None:
        began_s = _cpu_s()
        try:
            other = self._forked()
        except DebugError as error:
            self._goal.interval_s, self._goal.ladder = 0.0, []
            self.lines.send({"notice": "no checkpoint", "text": str(error)})
            return
        if other is None:
            self._serve()
            return
        position = self.position()
        self._hand_over(other, {"notice": "checkpoint", "pid": other.pid, "position": position})
        now_s = _cpu_s()
        # Checkpoints shall not take more than a fraction of the time, dear ones not either.
        self._checkpoint_s = max(now_s - began_s, self._checkpoint_s * 0.75)
        self._next_checkpoint_s = now_s + max(self._goal.interval_s, 8 * self._checkpoint_s)

    def _forked(self) -> ForkedCopy | None:
        """Fork; return the copy, or None in the copy itself, whose ``lines`` are new."""
        if not self._forks:
            raise DebugError("checkpoints are off")
        pairs = self.session.inner_pairs()
        if self._copied_at != self.ledger.events:  # else nothing has run since the last copy
            own = [self.lines.fileno(), *self.ledger.history.descriptors]
            reason = why_not(own, self._idle, pairs)
            if reason:
                raise DebugError(f"this process cannot be copied: {reason}")
        ours, theirs = socket.socketpair()
        try:
            pid = fork_beside(self._supervisor, pairs)
        except BaseException:
            ours.close()
            theirs.close()
            raise
        self._copied_at = self.ledger.events
        if pid:
            theirs.close()
            return ForkedCopy(pid, ours)
        ours.close()
        self.lines.close()
        self.lines = Lines(theirs)
        self.lines.move_high()
        self.session.changes_process(_getpid(), pairs)
        return None

    def _hand_over(self, copy: ForkedCopy, message: Message) -> None:
        """Give the supervisor a copy's socket."""
        with copy.end:
            self.lines.send(message, copy.end.fileno())

    def _run_in_copy(self, work: Callable[[], Any]) -> None:
        """Run user code in a copy, so that it cannot change this process."""
        try:
            ours = self._forked()
        except DebugError:
            self._copied_at = -1
            self._answer(ok=work())  # then here: better than not at all
            return
        if ours is None:
            try:
                answer = {"ok": work()}
            except BaseException as error:
                answer = {"error": error_answer(error)}
            with suppress(BaseException):
                self.lines.send(answer)
            end_process(0)
        assert ours is not None
        self._answer_with(ours)

    def _start_debugger(self, request: Message) -> bool:
        """Let a copy call the next callbacks under a debugger; return True in the copy."""
        if self.over:
            raise DebugError(f"nothing follows: {self.over}")
        ours = self._forked()
        if ours is not None:
            self._answer_with(ours)
            return False
        try:
            self._apart_calls = make_debugger(self, request)
        except BaseException as error:
            self.end_apart(error=error_answer(error))
        self._goal, self._mark, self.is_next = RunGoal(), _NEVER, False
        self.ledger.on_difference = lambda: None  # who debugs may change things
        return True

    @contextmanager
    def outside(self) -> Iterator[None]:
        """Do work that is not part of the run, on any stack."""
        with engage(None), self.session.world.domain.dispatcher.outside_events():
            yield

    def end_apart(self, **answer: Any) -> None:
        with self.outside(), suppress(BaseException):
            self.lines.send(answer)
        end_process(0)

    def _event(self, index: int) -> Message:
        history = self.ledger.history
        trace = history.trace
        try:
            rest, chain_hash = history.row(index)
        except IndexError:
            raise DebugError(
                f"there is no event {index} (yet): {history.known} are known"
            ) from None
        return event_values(
            rest, chain_hash, self.ledger.entities if trace is None else trace.entities
        )

    def names(self) -> RunNames:
        trace = self.ledger.history.trace
        entities = self.ledger.entities if trace is None else trace.entities
        return names_of(entities.values(), are_all=trace is not None, fields=loaded_fields)


def error_answer(error: BaseException) -> Message:
    kind = type(error).__name__
    text = str(error)
    if not isinstance(error, RsltraceError):
        text = f"{kind}: {text}" if text else kind
    return {"kind": kind if isinstance(error, RsltraceError) else "DebugError", "message": text}
