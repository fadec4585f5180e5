"""A condition, and what watches for it in a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from rsltrace.checks.conditions.bounds import LimitError
from rsltrace.checks.conditions.expressions import Expression
from rsltrace.checks.conditions.view import EventView, PausedRun
from rsltrace.errors import ConditionError, RsltraceError

_COMES_AND_GOES = (IndexError, KeyError, ZeroDivisionError)
"""What an expression may raise of one message and not of the next: it is not true then."""

_SHOWN_MAX = 120


class ActiveCondition:
    """A condition that counts, in a run that is somewhere.

    ``note`` says why it could not be evaluated so far, if that is so: it may be mistyped.
    """

    note = ""

    def before(self, view: EventView) -> str:
        """Return why to stop before an event that is about to run, empty: go on.

        :raises ConditionError: it cannot be evaluated.
        """
        return ""

    def after(self, view: EventView) -> str:
        """Return why to stop after an event that has just ended, empty: go on.

        :raises ConditionError: it cannot be evaluated.
        """
        return ""


@dataclass(frozen=True, slots=True)
class EventCondition:
    """Where to stop.

    ``before`` and ``after`` say whether it wants to see events that are about to run, and those
    that have ended; ``reads`` which parts of them (``received``, ``sent``, ``findings``,
    ``nodes``). ``arm`` gives what watches for it, from a moment on.
    """

    text: str
    before: bool
    after: bool
    reads: frozenset[str]
    arm: Callable[[PausedRun], ActiveCondition] = field(repr=False)


def is_true(
    expression: Expression, view: EventView, text: str, message: object = None
) -> tuple[bool, str]:
    """Return whether an expression is true of an event, and if it cannot be, why.

    :raises ConditionError: it never will be: it is wrong.
    """
    try:
        return bool(expression.value(view, message=message)), ""
    except _COMES_AND_GOES as error:
        return False, error_text(error)
    except RsltraceError:
        raise
    except Exception as error:
        end = expression.begin + len(expression.text)
        hint = "; say any(...) or all(...)" if "ambiguous" in str(error) else ""
        raise ConditionError(
            f"event {view.index}: {error_text(error)}{hint}", text, expression.begin, end
        ) from None


def error_text(error: BaseException) -> str:
    """Return the message of an error, with its type unless that is the language's own."""
    if isinstance(error, LimitError):
        return str(error)
    return shown_text(f"{type(error).__name__}: {error}")


def shown(value: object) -> str:
    """Return a value as text of one line, for people."""
    try:
        text = repr(value)
    except Exception as error:
        text = f"<{type(value).__name__}, whose repr raised {type(error).__name__}>"
    return shown_text(text)


def shown_text(text: str) -> str:
    """Return a text on one line of bearable length."""
    text = " ".join(text.split())
    return text if len(text) <= _SHOWN_MAX else f"{text[: _SHOWN_MAX - 1]}…"
