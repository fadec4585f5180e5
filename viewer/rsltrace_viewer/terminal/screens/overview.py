"""A run at a glance; of two runs both, side by side. Enter goes to what is chosen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Static

from rsltrace.model.printable import printable
from rsltrace.model.stamp import format_duration
from rsltrace_viewer.model.cells import fit, wrap
from rsltrace_viewer.model.overview import (
    Overview,
    Part,
    callbacks_of,
    nodes_of,
    read_overview,
    topics_of,
    troubles_of,
)
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.session import Session
from rsltrace_viewer.terminal.background import walk
from rsltrace_viewer.terminal.widgets.list_view import ListView, Pieces

_BAR = 12
_CALLBACKS_MAX = 12
_NUMBERS = 19
_WAITS = 24
Choice = tuple[str, str]
"""What was chosen: ``filter`` with its text, or ``event`` with a number."""
_Make = Callable[[Run, Overview], Sequence[Part]]


class OverviewScreen(Screen[Choice | None]):
    """Gives what to go to, or None."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,q,O", "dismiss(None)", "close")]
    DEFAULT_CSS = """
    OverviewScreen Static { background: $panel; padding: 0 1; height: 1; }
    """

    def __init__(self, session: Session) -> None:
        super().__init__()
        self._session = session
        runs = (session.a,) if session.b is None else (session.a, session.b)
        self._runs = [(run, Overview()) for run in runs]
        self._lines: list[tuple[Pieces, Choice | None]] = []

    def compose(self) -> ComposeResult:
        """Make the parts."""
        yield Static(id="what")
        yield ListView(id="lines")
        yield Static("↑↓ choose   Enter shows the events of it   Esc closes")

    def on_mount(self) -> None:
        """Count in the background, and show what is known."""
        self.query_one(ListView).focus()
        self._show()
        readers = [read_overview(run) for run, _ in self._runs]

        def steps() -> object:
            for place, reader in enumerate(readers):
                for found in reader:
                    self._runs[place] = (self._runs[place][0], found)
                    yield place

        walk(self.app, "overview", iter(steps()), lambda _, done: self._show())  # type: ignore[call-overload]

    def on_resize(self) -> None:
        """Use the width there is."""
        self._show()

    def _show(self) -> None:
        if not self.is_attached:
            return
        session = self._session
        share = min(overview.share for _, overview in self._runs)
        state = "" if share >= 1 else f"  {share:.0%} read"
        title = f"overview  {session.title()}  {session.facts()}{state}"
        self.query_one("#what", Static).update(Content(title))
        self._lines = [*self._troubles(), ((), None)]
        self._lines += self._table("nodes", nodes_of, "node")
        self._lines += [((), None), *self._table("topics", topics_of, "topic")]
        self._lines += [
            ((), None),
            *self._table("callbacks", callbacks_of, "entity", _CALLBACKS_MAX),
        ]
        self.query_one(ListView).show(lambda line: self._lines[line][0], len(self._lines))

    def _troubles(self) -> list[tuple[Pieces, Choice | None]]:
        session = self._session
        lines: list[tuple[Pieces, Choice | None]] = []
        if session.comparison is not None:
            style = "good" if session.comparison.identical else "error"
            width = max(self.app.size.width - 4, 20)
            verdict = printable(session.comparison.verdict())
            lines += [(((line, style),), None) for line in wrap(verdict, width)]
        names = ("a", "b")
        found = [
            troubles_of(run, overview, session.logs.get(names[place]))
            for place, (run, overview) in enumerate(self._runs)
        ]
        lines.append((((fit("what went wrong", 26), "title"), *self._heads()), None))
        for row in zip(*found, strict=False):
            worst = any(one.count for one in row)
            style = ("error" if row[0].bad else "warning") if worst else "muted"
            pieces = [(fit(row[0].what, 26), style)]
            pieces += [(f"{one.count:>10,}", style if one.count else "muted") for one in row]
            pieces.append((f"   {row[0].key} goes from one to the next" if worst else "", "muted"))
            first = row[0].first
            lines.append((pieces, ("event", str(first)) if first is not None else None))
        for place, (run, _) in enumerate(self._runs):
            code = run.trace.result.get("exit_code", "0")
            why = printable(run.trace.result.get("stop_reason", "not finished"))
            text = f"{'run ' + names[place] if len(self._runs) > 1 else 'the run'} ended: {why}"
            style = "plain" if code == "0" else "error"
            if code != "0":
                text += f", exit code {printable(code)}"
            lines.append((((text, style),), None))
        return lines

    def _heads(self) -> list[tuple[str, str]]:
        if len(self._runs) == 1:
            return []
        return [(f"{'run ' + name:>10}", "muted") for name in ("a", "b")]

    def _table(
        self, title: str, make: _Make, field: str, most: int = 10_000
    ) -> list[tuple[Pieces, Choice | None]]:
        made = [make(run, overview) for run, overview in self._runs]
        known = [{(part.node, part.kind, part.name): part for part in parts} for parts in made]
        keys = list(dict.fromkeys(key for one in known for key in one))
        width = max(min(self.app.size.width - 4, 140), 40)
        bars = _BAR if width >= 100 else _BAR // 3
        waits = any(part.wait_ns is not None for parts in made for part in parts)
        names = max(width - bars - 2 - _NUMBERS * len(made) - (_WAITS if waits else 0), 12)
        heads: list[tuple[str, str]] = [(fit(f"{title}  {len(keys)}", names + bars + 2), "title")]
        what = "sent" if field == "topic" else "events"
        for name in ("a", "b")[: len(made)] if len(made) > 1 else ("",):
            heads.append((f"{f'{what} {name}'.strip():>10}{'Hz':>9}", "muted"))
        if waits:
            heads.append(("  on the way: mean, max", "muted"))
        lines: list[tuple[Pieces, Choice | None]] = [(heads, None)]
        for key in keys[:most]:
            parts = [one.get(key) for one in known]
            some = next(part for part in parts if part is not None)
            text = some.name
            if field == "entity":
                text = f"{some.node} {some.kind} {some.name}"
            elif field == "topic":
                text = f"{some.name}  {some.kind}"
            bar = "█" * round(some.share * bars) or "▏"
            pieces = [(fit(printable(text), names) + " ", "plain"), (fit(bar, bars) + " ", "bar")]
            differ = len({part.count if part else 0 for part in parts}) > 1
            for part in parts:
                pieces.append((_numbers(part), "error" if differ else "plain"))
            if some.wait_ns is not None:
                mean, longest = some.wait_ns
                wait = f"  {_short(mean)}, {_short(longest)}"
                pieces.append((wait, "muted"))
            name = some.name if field != "node" else some.node
            lines.append((pieces, ("filter", _filter_of(field, some, name))))
        if len(keys) > most:
            lines.append((((f"… and {len(keys) - most} more", "muted"),), None))
        return lines

    def on_list_view_chosen(self, event: ListView.Chosen) -> None:
        """Go to what was chosen."""
        choice = self._lines[event.line][1]
        if choice is not None:
            self.dismiss(choice)


def _numbers(part: Part | None) -> str:
    if part is None:
        return f"{'-':>10}{'':9}"
    rate = "" if part.rate_hz is None else f"{part.rate_hz:.4g}"
    return f"{part.count:>10,}{rate:>9}"


def _filter_of(field: str, part: Part, name: str) -> str:
    if field == "entity":
        return f'node:"{part.node}" entity:"{name}"'
    return f'{field}:"{name}"'


def _short(duration_ns: int) -> str:
    return format_duration(round(float(f"{duration_ns:.3g}")))
