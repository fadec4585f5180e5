"""A run at a glance; of two runs both, side by side. Enter goes to what is chosen."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.screen import Screen
from textual.widgets import Static

from rsltrace.errors import TraceError
from rsltrace.trace.model.texts import format_duration, printable
from rsltrace.trace.native import is_native
from rsltrace_viewer.model.chains import Chain
from rsltrace_viewer.model.overview import (
    Checks,
    Overview,
    OverviewSection,
    Times,
    Trouble,
    callbacks_of,
    nodes_of,
    topics_of,
    troubles_of,
    unheard_of,
)
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.columns import ShortNames
from rsltrace_viewer.model.view import cells, fit, wrap
from rsltrace_viewer.session import Session
from rsltrace_viewer.terminal.keys import KEYS
from rsltrace_viewer.terminal.widgets.bars import HeaderBar
from rsltrace_viewer.terminal.widgets.list_view import ListView, Pieces, node_piece

_BAR = 12
_NUMBERS = 19
_TIMES = 24
_WHAT = 26
_WIDTH_MAX = 140
_NAMES_LEAST = 26
_LINES_LEAST = 5
_OTHER_LINES = 16
_CHAIN, _CHAINS_MOST = 32, 12
_UNTIMED = "Callbacks take no simulated time in this job (execution: gives them some)."
_FIRST = "↓↑ Enter shows the events of a line   Esc all events   ? keys   q quits"
_LATER = "↓↑ Enter shows the events of a line   Esc closes"
_OWN_KEYS = ("help", "theme", "overview", "escape", "quit", "enter", "yank")
Choice = tuple[str, str]
"""What was chosen: ``filter`` with its text, ``event`` with its run and number (``b 12``), ``key``
with the action that a key has among the events, ``more`` with the table to be shown whole,
``reason`` with the node and the name of the callback that is asked about."""
_Line = tuple[Pieces, Choice | None]
_Row = Sequence[OverviewSection | None]
"""The same node, topic or callback in each run."""
_Column = tuple[str, Callable[[_Row], str]]
"""The head of a column, and its texts."""


class OverviewScreen(Screen[Choice | None]):
    """Gives what to go to, or None. What it shows is counted by ``Session.survey``."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,O", "dismiss(None)", "close"),
        Binding("q", "leave", "close"),
        Binding("y", "yank", "copy"),
    ]
    DEFAULT_CSS = """
    OverviewScreen #keys { background: $panel; padding: 0 1; height: 1; }
    """

    def __init__(self, session: Session, *, first: bool) -> None:
        """Show a session; ``first``: before anything else of it was shown."""
        super().__init__()
        self._session = session
        self._first = first
        self._whole: set[str] = set()
        self._lines: list[_Line] = []
        self._asked: dict[Choice | None, str] = {}
        """By the choice of its line, the node and the name of a callback."""

    def compose(self) -> ComposeResult:
        yield HeaderBar(id="what")
        yield ListView(id="lines")
        yield Static(_FIRST if self._first else _LATER, id="keys")

    def on_mount(self) -> None:
        self.query_one(ListView).focus()
        self.update_lines()

    def on_resize(self) -> None:
        self.update_lines()

    def on_key(self, event: events.Key) -> None:
        """A key of the events: go there, and do what it does."""
        pressed = [key for key in KEYS if event.key in key.keys.split(",")]
        callback = self._asked.get(self._lines[self.query_one(ListView).cursor][1])
        if callback is not None and pressed and pressed[0].action == "reason":
            event.stop()
            self.dismiss(("reason", callback))
        elif pressed and not pressed[0].action.startswith(_OWN_KEYS):
            event.stop()
            self.dismiss(("key", f"app.{pressed[0].action}"))

    async def action_leave(self) -> None:
        """Leave the viewer, if there was nothing before this screen."""
        if self._first:
            await self.app.action_quit()
        else:
            self.dismiss(None)

    def action_yank(self) -> None:
        text = "".join(piece for piece, _ in self._lines[self.query_one(ListView).cursor][0])
        self.app.copy_to_clipboard(text.strip())
        self.app.notify(f"copied: {text.strip()}")

    def update_lines(self) -> None:
        if not self.query(ListView):  # it is about to be there, or was closed
            return
        session = self._session
        runs = [
            (run, session.overviews.get(name, Overview())) for name, run in session.runs.items()
        ]
        share = min(overview.share for _, overview in runs)
        self.query_one(HeaderBar).show(
            session.title(),
            session.facts() if share >= 1 else f"{share:.0%} read  {session.facts()}",
            "overview" if session.b is None else "overview of a and b",
            "",
            bad=False,
            lines=0,
            width=self.app.size.width,
        )
        nothing: Iterator[_Line] = iter([((), None)])
        parts = (
            self._verdict(),
            self._troubles(runs),
            nothing,
            self._tables(runs),
            self._chains(),
        )
        self._lines = [line for part in parts for line in self._readable(part)]
        self.query_one(ListView).show(lambda line: self._lines[line][0], len(self._lines))

    def _readable(self, lines: Iterator[_Line]) -> Iterator[_Line]:
        """Yield lines, up to what a damaged trace does not have: then say so."""
        try:
            yield from lines
        except TraceError as error:
            for line in wrap(printable(str(error)), max(self.app.size.width - 4, 20)):
                yield ((line, "error"),), None

    def _verdict(self) -> Iterator[_Line]:
        comparison = self._session.comparison
        if comparison is not None:
            style = "good" if comparison.identical else "error"
            verdict = printable(comparison.verdict())
            for line in wrap(verdict, max(self.app.size.width - 4, 20)):
                yield ((line, style),), None

    def _troubles(self, runs: Sequence[tuple[Run, Overview]]) -> Iterator[_Line]:
        logs = self._session.logs
        found = [
            {one.what: one for one in troubles_of(run, overview, logs.get(name))}
            for name, (run, overview) in zip("ab", runs, strict=False)
        ]
        heads = [(f"{f'run {name}':>10}", "muted") for name in "ab"] if len(runs) > 1 else []
        whole = all(overview.share >= 1 for _, overview in runs) and len(logs) == len(runs)
        checks = self._session.checks
        wrong = any(one.count for known in found for one in known.values())
        wrong = wrong or any(one.violated or one.error for one in checks.values())
        if not wrong and not whole:
            yield ((("nothing went wrong so far", "title"),), None)
        elif not wrong:
            yield ((("nothing went wrong", "title"),), None)
            usual = "no exceptions, no errors or warnings logged, no findings of the guard"
            yield (((usual, "good"),), None)
        else:
            yield ((fit("what went wrong", _WHAT), "title"), *heads), None
            for what in dict.fromkeys(what for known in found for what in known):
                yield _trouble(what, [known.get(what) for known in found])
        for name, one in checks.items():
            for text, style, event in _of_checks(one, f" of run {name}" if len(runs) > 1 else ""):
                choice = None if event is None else ("event", f"{name} {event}")
                for line in wrap(text, max(self.app.size.width - 4, 20)):
                    yield ((line, style),), choice
        for name, (run, _) in zip("ab", runs, strict=False):
            yield (_ending(run, f"run {name}" if len(runs) > 1 else "the run"), None)
        unheard = list(dict.fromkeys(filter(None, (unheard_of(run) for run, _ in runs))))
        for text in unheard:
            for line in wrap(printable(text), max(self.app.size.width - 4, 20)):
                yield ((line, "warning"),), None

    def _tables(self, runs: Sequence[tuple[Run, Overview]]) -> Iterator[_Line]:
        timed = any(overview.took for _, overview in runs)
        tables = []
        for title, make, field in (
            ("nodes", nodes_of, "node"),
            ("topics", topics_of, "topic"),
            ("where the time goes: callbacks" if timed else "callbacks", callbacks_of, "entity"),
        ):
            made = [make(run, overview) for run, overview in runs]
            known = [{(part.node, part.kind, part.name): part for part in parts} for parts in made]
            keys = dict.fromkeys(key for one in known for key in one)
            tables.append((title, field, [[one.get(key) for one in known] for key in keys]))
        names = max((cells(_name(row, f)) for _, f, rows in tables for row in rows), default=0)
        # Columns stand below each other: the table with the most of them has the least for names.
        columns = [self._columns(rows) for _, _, rows in tables]
        names = min(max(names, _NAMES_LEAST), *(room for room, _ in columns))
        for (title, field, rows), (_, times) in zip(tables, columns, strict=True):
            yield from self._table(title, field, rows, names, times)
            yield (), None
        simulated = not is_native(self._session.a.trace)
        if simulated and not timed and all(overview.share >= 1 for _, overview in runs):
            yield ((_UNTIMED, "muted"),), None

    def _chains(self) -> Iterator[_Line]:
        """Yield the chains with their latencies; a line leads to the slowest one of the first run
        that has one."""
        known = [
            {(one.hops, one.via): one for one in self._session.chains.get(name, ())}
            for name in self._session.runs
        ]
        keys = list(dict.fromkeys(key for one in known for key in one))
        if not keys:
            return
        names = max(self._width - _CHAIN * len(known), _NAMES_LEAST)
        yield (), None
        heads = [(fit(f"chains  {len(keys)}", names), "title")]
        for name in "ab"[: len(known)]:
            what = "latency: p50, max, age" + (f" {name}" if len(known) > 1 else "")
            heads.append((f"{what:>{_CHAIN}}", "muted"))
        yield heads, None
        most = len(keys) if "chain" in self._whole else _CHAINS_MOST
        for key in keys[:most]:
            row = [one.get(key) for one in known]
            name = next(printable(one.name) for one in row if one is not None)
            pieces = [(fit(name, names), "plain")]
            pieces += [(f"{_latency(one):>{_CHAIN}}", "muted") for one in row]
            slowest = [
                f"{name} {one.slowest}"
                for name, one in zip("ab", row, strict=False)
                if one is not None and one.slowest is not None
            ]
            yield pieces, ("event", slowest[0]) if slowest else None
        if len(keys) > most:
            more = f"… and {len(keys) - most} more: Enter shows them"
            yield ((more, "muted"),), ("more", "chain")

    @property
    def _width(self) -> int:
        return max(min(self.app.size.width - 4, _WIDTH_MAX), 40)

    @property
    def _bars(self) -> int:
        return _BAR if self._width >= 100 else _BAR // 3

    def _columns(self, rows: Sequence[_Row]) -> tuple[int, list[_Column]]:
        """Return the room for names, and the columns of durations that fit beside them."""
        runs = len(self._session.runs)
        room = self._width - self._bars - 2 - _NUMBERS * runs
        columns = list(_times_of(rows, runs))
        columns = columns[: max(room - _NAMES_LEAST, 0) // _TIMES]
        return room - _TIMES * len(columns), columns

    def _table(
        self, title: str, field: str, rows: Sequence[_Row], names: int, columns: list[_Column]
    ) -> Iterator[_Line]:
        runs, bars = len(self._session.runs), self._bars
        heads = [(fit(f"{title}  {len(rows)}", names + bars + 2), "title")]
        what = "sent" if field == "topic" else "events"
        for name in ("a", "b") if runs > 1 else ("",):
            heads.append((f"{f'{what} {name}'.strip():>10}{'Hz':>9}", "muted"))
        heads += [(f"{words:>{_TIMES}}", "muted") for words, _ in columns]
        yield heads, None
        largest = max((_some(row).share for row in rows), default=0) or 1
        short = ShortNames(_name(row, field) for row in rows)
        most = len(rows)
        if field not in self._whole:
            shown = (self.app.size.height - _OTHER_LINES) // 3
            most = most if most <= shown + 1 else max(shown, _LINES_LEAST)
        for row in rows[:most]:
            some = _some(row)
            bar = "█" * round(some.share * bars / largest) or "▏"
            colour = None if field == "topic" else self._session.node_colours.get(some.node)
            pieces = [node_piece(short.fit(_name(row, field), names) + " ", colour)]
            pieces.append((fit(bar, bars) + " ", "bar"))
            differ = len({part.count if part else 0 for part in row}) > 1
            pieces += [(_numbers(part), "error" if differ else "plain") for part in row]
            pieces += [(f"{text(row):>{_TIMES}}", "muted") for _, text in columns]
            choice = ("filter", _filter_of(field, some))
            if field == "entity":
                self._asked[choice] = f"{some.node} {some.name}"
            yield pieces, choice
        if len(rows) > most:
            more = f"… and {len(rows) - most} more: Enter shows them"
            yield ((more, "muted"),), ("more", field)

    def on_list_view_chosen(self, event: ListView.Chosen) -> None:
        """Go to what was chosen; of a line that stands for nothing, to all events."""
        choice = self._lines[event.line][1]
        if choice is not None and choice[0] == "more":
            self._whole.add(choice[1])
            self.update_lines()
        else:
            self.dismiss(choice)


def _trouble(what: str, found: Sequence[Trouble | None]) -> _Line:
    some = next(one for one in found if one is not None)
    worst = any(one is not None and one.count for one in found)
    style = ("error" if some.bad else "warning") if worst else "muted"
    pieces = [(fit(what, _WHAT), style)]
    for one in found:
        count = one.count if one is not None else 0
        pieces.append((f"{count:>10,}", style if count else "muted"))
    if not worst:
        return pieces, None
    pieces.append((f"   {some.key} goes from one to the next" if some.key else "", "muted"))
    if some.filter:
        return pieces, ("filter", some.filter)
    firsts = [
        f"{name} {one.first}"
        for name, one in zip("ab", found, strict=False)
        if one is not None and one.first is not None
    ]
    return pieces, ("event", firsts[0]) if firsts else None


def _of_checks(checks: Checks, of_run: str) -> Iterator[tuple[str, str, int | None]]:
    """Yield what came of the checks of a run: text, style, and the first event of a violation."""
    if checks.error:
        yield f"checks{of_run} not evaluated: {printable(checks.error)}", "warning", None
    for one in checks.violated:
        first = one.violations[0].event
        times = "" if one.count == 1 else f"{one.count:,} times, first "
        where = "at the end" if first is None else f"at event {first:,}"
        text = f"check{of_run} violated {times}{where}: {printable(one.name)}"
        yield text, "error", first
    if checks.passed:
        number = "1 check" if checks.passed == 1 else f"{checks.passed} checks"
        yield f"{number}{of_run} passed", "good", None


def _latency(chain: Chain | None) -> str:
    """Return the latency of a chain, usual and longest, and how old its data gets."""
    if chain is None or chain.latency is None:
        return "-"
    times = (chain.latency.p50_ns, chain.latency.max_ns, chain.oldest_ns)
    return ", ".join("-" if one is None else format_duration(one, 3) for one in times)


def _ending(run: Run, name: str) -> Pieces:
    result = run.trace.result
    code = result.get("exit_code", "0")
    if not run.trace.complete:
        return ((f"{name} is not finished, or was cut off", "warning"),)
    text = f"{name} ended: {printable(result.get('stop_reason', ''))}"
    if code != "0":
        return ((f"{text}, exit code {printable(code)}", "error"),)
    return ((text, "plain"),)


_TIMES_OF: dict[str, Callable[[OverviewSection], Times | None]] = {
    "takes": lambda part: part.took,
    "waits": lambda part: part.paused,
    "on the way": lambda part: part.waited,
}


def _times_of(rows: Sequence[_Row], runs: int) -> Iterator[_Column]:
    """Yield the columns of durations that there is something for: their heads, and their texts."""
    what = "mean, max" if runs == 1 else "means a, b"
    for words, of in _TIMES_OF.items():
        found = [of(part) for row in rows for part in row if part is not None]
        if any(one is not None and one.most_ns for one in found):
            busy = words == "takes" and runs == 1
            yield f"{words}: {what}{', busy' * busy}", partial(_times, of, busy=busy)


def _times(of: Callable[[OverviewSection], Times | None], row: _Row, *, busy: bool) -> str:
    found = [None if part is None else of(part) for part in row]
    texts = [
        format_duration(one.mean_ns, 3) if one is not None and one.count else "" for one in found
    ]
    if len(found) == 1 and texts[0] and found[0] is not None:
        texts.append(format_duration(found[0].most_ns, 3))
    if busy and texts[0]:
        texts[-1] += f" {_some(row).share:>4.0%}"
    return ", ".join(text or "-" for text in texts) if any(texts) else ""


def _some(row: _Row) -> OverviewSection:
    return next(part for part in row if part is not None)


def _name(row: _Row, field: str) -> str:
    part = _some(row)
    if field == "entity":
        return printable(f"{part.node} {part.kind} {part.name}")
    return printable(f"{part.name}  {part.kind}" if field == "topic" else part.name)


def _numbers(part: OverviewSection | None) -> str:
    if part is None:
        return f"{'-':>10}{'':9}"
    rate = "" if part.rate_hz is None else f"{part.rate_hz:.4g}"
    return f"{part.count:>10,}{rate:>9}"


def _filter_of(field: str, part: OverviewSection) -> str:
    if field == "entity":
        return f'node:"{part.node}" entity:"{part.name}"'
    return f'{field}:"{part.node if field == "node" else part.name}"'
