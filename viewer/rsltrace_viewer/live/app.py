"""The viewer of a run that goes on: selecting an event executes it again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, ClassVar, TypeVar

from textual.app import ComposeResult
from textual.binding import Binding
from textual.content import Content
from textual.widgets import Static
from textual.worker import get_current_worker

from rsltrace.debug.checkpoints import Breakpoint
from rsltrace.debug.client import DebugSession
from rsltrace.errors import DebugError, RsltraceError
from rsltrace.trace.model.texts import printable
from rsltrace_viewer.live.execution import (
    WATCHES_MAX,
    Executed,
    Execution,
    LiveSession,
    LiveStop,
    Superseded,
)
from rsltrace_viewer.terminal.app import ViewerApp
from rsltrace_viewer.terminal.keys import LIVE_KEYS
from rsltrace_viewer.terminal.screens.text import PickScreen
from rsltrace_viewer.terminal.widgets.prompt import Prompt, Question

# What a live screen has besides: the breakpoints.

_SHOWN_MAX = 4


class BreakpointsPanel(Static):
    """The breakpoints, and which of them has stopped the run."""

    DEFAULT_CSS = """
    BreakpointsPanel { height: auto; background: $surface; border-top: solid $panel; padding: 0 1;
                  border-title-color: $text-muted; }
    """

    def show(self, found: Sequence[Breakpoint], hit: int | None) -> None:
        """Show breakpoints; ``hit`` is the number of the one at which the run stands."""
        self.border_title = "breakpoints"
        if not found:
            self.update(Content.styled("none: B sets one, as in /odom: twist.x > 3", "$text-muted"))
            return
        first = max(len(found) - _SHOWN_MAX, 0)
        lines = []
        for one in found[first:]:
            sign = "▶" if one.number == hit else "●"
            style = "bold $text-error" if one.number == hit else ""
            lines.append(Content.styled(printable(f"{sign} {one.number}  {one.text}"), style))
        if first:
            lines[0] = Content.styled(f"… {first + 1} more", "$text-muted")
        self.update(Content("\n").join(lines))


T = TypeVar("T")

_QUESTIONS = {
    "breakpoint": ("stop at", "812 · t=2.5s · node /ekf · topic /odom · /odom: twist.x > 3 · …"),
    "changed": ("last change of", "an attribute of this node: state, P[0][0]; goes there"),
    "first": ("first event with", "a condition, as of a breakpoint; up to here"),
    "watch": ("watch", "an expression in this node: state * 2, node('ekf').P; empty: none"),
}


class LiveApp(ViewerApp):
    """One run, executed again as one looks at it."""

    live = True
    session: LiveSession
    CSS = (
        f"""{ViewerApp.CSS}"""
        """
    .low #breakpoints { display: none; }
    .only-timeline #breakpoints, .only-inspector #breakpoints, .only-lanes #breakpoints,
    .only-source #breakpoints { display: none; }
    """
    )
    BINDINGS: ClassVar = [
        Binding(key.keys, key.action, key.help, show=False, priority=key.first) for key in LIVE_KEYS
    ]

    def __init__(self, session: LiveSession, execution: Execution, **options: Any) -> None:
        """Show ``session``; ``options`` are those of ``ViewerApp``."""
        super().__init__(session, **options)
        self._execution = execution
        self._hit: int | None = None
        self._breakpoints: Sequence[Breakpoint] = ()

    def compose(self) -> ComposeResult:
        for part in super().compose():
            if isinstance(part, Prompt):
                yield BreakpointsPanel(id="breakpoints")
            yield part

    def on_mount(self) -> None:
        self.screen_stack[0].add_class("with-source")
        super().on_mount()

    def _show_source(self) -> None:
        """What was executed says where it is."""

    def _mode(self) -> str:
        return "live"

    # Executing.

    def first_shown(self) -> None:
        super().first_shown()
        self._show_breakpoints()

    def _show_inspector(self, *, top: bool = True) -> None:
        """Show the selected event, executing it first if it has not been."""
        super()._show_inspector(top=top)
        selected = self.session.current()
        if selected is not None and self.session.here is None:
            index = selected[1]
            self._drive(
                lambda wanted: self._execution.at(index, wanted), self._executed, executes=True
            )

    def _executed(self, executed: Executed) -> None:
        session = self.session
        session.executed = executed
        if session.here is None:
            return  # one has gone on
        if executed.wrong:
            self._say("diverged")
        self.inspector.show(session.lines(), top=False)
        self.source.show(executed.source)

    def _drive(
        self,
        ask: Callable[[Callable[[], bool]], T],
        arrive: Callable[[T], object],
        *,
        executes: bool = False,
    ) -> None:
        """Ask the session in a thread; what is under way for something else ends."""
        self._supersede()

        def work() -> None:
            worker = get_current_worker()
            try:
                found = ask(lambda: not worker.is_cancelled)
            except Superseded:
                return
            except RsltraceError as error:
                if not worker.is_cancelled:
                    self.call_from_thread(self._failed, str(error), executes)
                return
            if not worker.is_cancelled:
                self.call_from_thread(arrive, found)

        self.run_worker(work, group="live", thread=True, exclusive=True, exit_on_error=False)

    def _failed(self, message: str, executes: bool) -> None:
        self._say("")
        self.notify(message.partition("\n")[0], severity="error")
        if not executes and self.session.here is None:
            self._show_inspector(top=False)

    def _supersede(self) -> None:
        if self.has_worker("live"):
            self.workers.cancel_group(self, "live")
            with suppress(DebugError):
                self._execution.session.pause()

    def go(self, place: int, *, remember: bool = True, centre: bool = False) -> None:
        """Select a place; no breakpoint has stopped there."""
        if self._hit is not None:
            self._hit = None
            self._show_breakpoints()
        super().go(place, remember=remember, centre=centre)

    # Running.

    def action_run(self, step: int) -> None:
        """Run on to the next breakpoint (1), or back to the last (-1)."""
        here = self.session.current()
        if here is None:
            return
        execution, index = self._execution, here[1]
        run = execution.run_on if step > 0 else execution.run_back
        self._say("running … Esc stops" if step > 0 else "running back … Esc stops")
        self._drive(lambda wanted: run(index, wanted), self._stopped)

    def _stopped(self, stop: LiveStop) -> None:
        self.go(self.session.view.place_of(stop.event), centre=True)
        self._hit = stop.breakpoint.number if stop.breakpoint is not None else None
        self._show_breakpoints()
        self._say(stop.why)

    def action_escape(self) -> None:
        """Stop what runs; otherwise end the nearest thing that can be ended."""
        if (
            self.has_worker("live")
            and not self.prompt.asking
            and self._status.startswith("running")
        ):
            with suppress(DebugError):
                self._execution.session.pause()
            return
        super().action_escape()

    # Breakpoints and questions.

    def action_ask(self, kind: str) -> None:
        if kind not in _QUESTIONS:
            super().action_ask(kind)
            return
        label, hint = _QUESTIONS[kind]
        self.prompt.ask(Question(kind, label, hint, "", str))

    def on_prompt_answered(self, event: Prompt.Answered) -> None:
        if event.kind not in _QUESTIONS:
            super().on_prompt_answered(event)
            return
        event.prevent_default()
        self.timeline.focus()
        text = (event.text or "").strip()
        execution = self._execution
        if event.kind == "watch" and event.text is not None:
            self._watch(text)
        elif not text:
            return
        elif event.kind == "breakpoint":
            self._change_breakpoints(lambda session: session.break_at(text))
        elif event.kind == "first":
            self._drive(lambda wanted: execution.true_first(text), self._found)
        elif self.session.here is not None:
            node = self.session.here.node
            self._drive(lambda wanted: execution.changed_last(node, text), self._found)

    def _found(self, event: int) -> None:
        self.go(self.session.view.place_of(event), centre=True)

    def _watch(self, text: str) -> None:
        watches = self._execution.watches
        if text:
            watches[:] = [*(one for one in watches if one != text), text][-WATCHES_MAX:]
        else:
            watches.clear()
        self.session.executed = None
        self._show_inspector(top=True)

    def _change_breakpoints(self, change: Callable[[DebugSession], object]) -> None:
        session = self._execution.session

        def ask(wanted: Callable[[], bool]) -> Sequence[Breakpoint]:
            change(session)
            return session.breakpoints

        def arrive(found: Sequence[Breakpoint]) -> None:
            self._breakpoints = found
            self._show_breakpoints()
            if self.session.here is None:
                self._show_inspector(top=False)

        self._drive(ask, arrive)

    def _show_breakpoints(self) -> None:
        self.screen_stack[0].query_one(BreakpointsPanel).show(self._breakpoints, self._hit)

    def action_clear(self) -> None:
        """Remove a breakpoint, or let choose between several."""
        found = self._breakpoints
        if not found:
            self._say("there is no breakpoint")
            return

        def chosen(place: int | None) -> None:
            if place is not None:
                number = found[place].number
                self._change_breakpoints(lambda session: session.clear(number))

        if len(found) == 1:
            chosen(0)
        else:
            names = [f"{one.number}  {one.text}" for one in found]
            self.push_screen(PickScreen("remove a breakpoint", names), chosen)
