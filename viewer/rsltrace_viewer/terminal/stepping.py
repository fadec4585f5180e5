"""Going from event to event: by rows, by what is the same, to causes, effects and marks."""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace_viewer.model.inspector.effects import Effects, effects_of
from rsltrace_viewer.model.inspector.event import summary_line
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.session import SEEK, Sought
from rsltrace_viewer.terminal.follow import walk
from rsltrace_viewer.terminal.screens.text import PickScreen
from rsltrace_viewer.terminal.shell import Shell
from rsltrace_viewer.terminal.widgets.inspector import Inspector


class Stepping(Shell):
    def _focused_inspector(self) -> Inspector | None:
        inspector = self.inspector
        return inspector if self.focused is inspector else None

    def action_step(self, step: int) -> None:
        """Go to the next row (or line of the inspector, if one is in it)."""
        inspector = self._focused_inspector()
        if inspector is not None:
            inspector.move(step)
            return
        self._step_rows(step)

    def _step_rows(self, rows: int, pages: int = 0) -> None:
        session = self.session
        if not session.rows.count:
            return
        row = max(min(session.row_of_place() + rows, session.rows.count - 1), 0)
        place = session.rows.at(row)
        if pages:
            self.timeline.page_to(row, pages)
        self.go(place, remember=False)

    def action_page(self, pages: int) -> None:
        inspector = self._focused_inspector()
        if inspector is not None:
            inspector.move(pages * inspector.page)
            return
        self._step_rows(pages * self.timeline.page, pages)

    def action_edge(self, edge: int) -> None:
        """Go to the first (-1) or last (1) row."""
        inspector = self._focused_inspector()
        if inspector is not None:
            inspector.move(edge * 10**9)
        elif self.session.rows.count:
            row = 0 if edge < 0 else self.session.rows.count - 1
            self.go(self.session.rows.at(row))

    def action_same(self, what: str, step: int) -> None:
        """Go to the next event of the same node, entity or topic."""
        found = self.session.same(what)
        if found is None:
            self._say(f"this event has no {what}")
            return
        sought, name = found
        self._seek(sought, step, f"event of {name}" if what != "topic" else f"event on {name}")

    def action_seek(self, what: str, step: int) -> None:
        """Go to the next exception, log record, warning or finding."""
        condition, name = SEEK[what]
        self._seek(dict.fromkeys(self.session.runs, condition), step, name)

    def action_next_match(self, step: int) -> None:
        """Go to the next match of the search; without one, to the next divergence."""
        session = self.session
        if session.search is not None:
            self._seek(session.search, step, f"match of {session.search_text}", wrap=True)
        elif session.comparison is not None:
            place = session.comparison.next_divergence(session.view, session.place, step)
            if place is None:
                self._say(f"no {'later' if step > 0 else 'earlier'} divergence")
            else:
                self.go(place, centre=True)
        else:
            self._say("nothing is searched: / searches")

    def _seek(self, sought: Sought, step: int, name: str, *, wrap: bool = False) -> None:
        """Go to the nearest place with an event that fulfils its run's condition. It is looked
        for in the background."""
        which = "next" if step > 0 else "previous"

        def steps() -> Iterator[int | None]:
            looked = enumerate(self.session.seek(sought, step, wrap=wrap), start=1)
            for count, place in looked:
                if place is not None:
                    yield place
                    return
                yield -count

        def arrive(found: int | None, done: bool) -> None:
            if found is not None and found >= 0:
                self.go(found, centre=True)
            elif done:
                self._say(f"no {'later' if step > 0 else 'earlier'} {name}")
            elif found is not None:
                share = min(-found / max(self.session.segments, 1), 1)
                self._say(f"looking for the {which} {name} … {share:.0%}, Esc stops")

        walk(self, "seek", steps(), arrive)

    # Cause and effect, history, marks.

    def action_cause(self) -> None:
        here = self.session.current()
        if here is None:
            return
        run, index = here
        cause = int(run.row(index)["cause_event"])
        if not 0 <= cause < run.count:
            self._say("no other event caused this one")
            return
        self.go(self.session.view.place_of(cause, other=run is self.session.b))

    def action_effect(self) -> None:
        here = self.session.current()
        if here is None:
            return
        run, index = here
        session = self.session

        def arrive(effects: Effects | None, done: bool) -> None:
            if not done or effects is None:
                return
            session.effects = effects
            if not effects.found:
                self._say(f"it caused nothing up to event {effects.searched}")
            elif len(effects.found) == 1:
                self._go_to_event(effects.found[0], other=run is session.b)
            else:
                self._choose_effect(run, effects)

        walk(self, "effects", effects_of(run, index), arrive)

    def _choose_effect(self, run: Run, effects: Effects) -> None:
        def chosen(number: int | None) -> None:
            if number is not None:
                self._go_to_event(effects.found[number], other=run is self.session.b)

        choices = [summary_line(run, index) for index in effects.found[:200]]
        self.push_screen(PickScreen(f"event {effects.event} caused", choices), chosen)

    def _go_to_event(self, index: int, *, other: bool) -> None:
        session = self.session
        side, place = session.side, session.show_event(index, other=other)
        if session.side != side:
            self.side_changed()
        self.go(place, centre=session.side != side)

    def side_changed(self) -> None:
        """Draw everything anew: another run is shown than before, or both."""
        self._fit(self.size.width, self.size.height)
        self._show_header()
        self._redraw()

    def action_go_back(self) -> None:
        self._travel(self.session.travel(-1), "the start of your way")

    def action_go_forward(self) -> None:
        self._travel(self.session.travel(1), "where you came from last")

    def _travel(self, place: int | None, what: str) -> None:
        if place is None:
            self._say(f"this is {what}")
        else:
            self.go(place, remember=False, centre=True)

    def action_mark(self) -> None:
        if not self.session.empty:
            self.session.toggle_mark()
            self.timeline.redraw()

    def action_next_mark(self, step: int) -> None:
        place = self.session.next_mark(step)
        if place is None:
            self._say("no mark there; m sets one")
        else:
            self.go(place, centre=True)
