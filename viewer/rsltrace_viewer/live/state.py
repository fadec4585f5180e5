"""What is open and what of it was executed: the state behind the screen, without a screen."""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace.trace.words.entities import RUN_NAME
from rsltrace_viewer.live.execution import Executed
from rsltrace_viewer.model.inspector.message_tree import Line, Role
from rsltrace_viewer.session import Session


class LiveSession(Session):
    """A run whose selected event was executed again, or is about to be."""

    executed: Executed | None = None

    @property
    def here(self) -> Executed | None:
        """The selected event, if it has been executed."""
        selected = self.current()
        if self.executed is None or selected is None or self.executed.index != selected[1]:
            return None
        return self.executed

    def lines(self) -> list[Line]:
        """Return the lines of the inspector: what the event did to its node comes first."""
        return [*self._state_lines(), *super().lines()]

    def _state_lines(self) -> Iterator[Line]:
        here = self.here
        if here is None:
            if not self.empty:
                yield Line(0, "", "executing …", Role.NOTE, "live.waits")
            return
        if here.wrong:
            yield Line(0, "", here.wrong, Role.ERROR, "live.wrong")
            return
        for text, value in here.watched:
            yield Line(0, text, f"= {value}", Role.FIELD, f"live.watch.{text}")
        if here.node == RUN_NAME:
            return  # a main has no attributes
        changed = here.changed
        count = len(changed)
        said = f"{count} changed" if count else "unchanged"
        if not here.after:
            said = "destroyed" if here.before else "not there"
        is_open = self.openness.is_open("live", True)
        yield Line(0, f"state of {here.node}", said, Role.SECTION, "live", is_open)
        if not is_open:
            return
        for name in changed:
            yield Line(1, name, _change(here, name), Role.DIFFERENCE, f"live.{name}")
        for name, value in here.after.items():
            if name not in changed:
                yield Line(1, name, value, Role.FIELD, f"live.{name}")


def _change(here: Executed, name: str) -> str:
    if name not in here.before:
        return here.after[name] if not here.before else f"new: {here.after[name]}"
    if name not in here.after:
        return f"{here.before[name]} → gone"
    return f"{here.before[name]} → {here.after[name]}"
