"""How far to run: the goal that a request to run describes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from rsltrace.checks.conditions.condition import ActiveCondition, EventCondition
from rsltrace.checks.conditions.names import RunNames
from rsltrace.checks.conditions.text import parse_condition
from rsltrace.checks.conditions.view import EventView
from rsltrace.debug.current_event import CurrentEventView
from rsltrace.line_protocol import Message

NOWHERE = 1 << 62


@dataclass
class WatchedCondition:
    """A condition with the number of its breakpoint (0: of a request)."""

    number: int
    text: str
    armed: ActiveCondition


@dataclass
class RunGoal:
    """Where a run stops: at ``until`` events, before the first event after ``until_ns``, where the
    callback of event ``is_next_at`` begins, and where one of the conditions is true.

    A goal that ``searches`` does not stop for conditions, but remembers the last of them that was
    true at an index ``below`` so many. ``ladder`` are indices at which to leave checkpoints,
    ``interval_s`` says after how much CPU time to leave others (0: none).
    """

    until: int | None = None
    until_ns: int | None = None
    is_next_at: int | None = None
    before: list[WatchedCondition] = field(default_factory=list)
    after: list[WatchedCondition] = field(default_factory=list)
    searches: bool = False
    below: int = NOWHERE
    ladder: list[int] = field(default_factory=list)
    interval_s: float = 0.0

    @property
    def asks_before(self) -> bool:
        """Whether to look at events before they run."""
        return bool(self.before) or self.until_ns is not None or self.is_next_at is not None

    def is_reached(self, index: int) -> bool:
        return self.until is not None and index >= self.until and self.is_next_at is None

    def notes(self) -> list[str]:
        """Return why conditions could not be evaluated."""
        found = {one.number: one for one in (*self.before, *self.after)}
        return [f"{one.text}: {one.armed.note}" for one in found.values() if one.armed.note]


class AfterNodeEvent(ActiveCondition):
    def __init__(self, node: str) -> None:
        self._node = node

    def after(self, view: EventView) -> str:
        return self._node if view.node == self._node else ""


def parse_goal(request: Message, view: CurrentEventView, names: Callable[[], RunNames]) -> RunGoal:
    """Return the goal of a request; its conditions count from where the run stands now.

    :raises ConditionError: a condition is wrong.
    """
    goal = RunGoal(
        until=request.get("until"),
        until_ns=request.get("until_ns"),
        is_next_at=request.get("is_next_at"),
        searches=bool(request.get("searches")),
        below=int(request.get("below", NOWHERE)),
        ladder=list(request.get("ladder", ())),
        interval_s=float(request.get("interval_s", 0.0)),
    )
    for one in request.get("breakpoints", ()):
        condition: EventCondition = parse_condition(one["text"], names())
        watched = WatchedCondition(int(one["number"]), condition.text, condition.arm(view))
        if condition.before:
            goal.before.append(watched)
        if condition.after:
            goal.after.append(watched)
    if "node" in request:
        goal.after.append(WatchedCondition(0, request["node"], AfterNodeEvent(request["node"])))
    return goal
