"""What the viewer asks for, and which answers are good: a search, a filter, a time, an index."""

from __future__ import annotations

from itertools import chain

from rsltrace.trace.words.times import parse_time_in_run
from rsltrace_viewer.model.query.completion import completions
from rsltrace_viewer.session import Session
from rsltrace_viewer.terminal.widgets.prompt import Question


def question_of(kind: str, session: Session) -> Question:
    """Return the question of a kind: ``search``, ``filter``, ``time`` or ``index``."""

    def check_query(text: str) -> object:
        return session.parse(text)

    def complete(text: str) -> list[str]:
        found = (completions(text, run) for run in session.runs.values())
        return list(dict.fromkeys(chain.from_iterable(found)))

    questions = {
        "search": Question(
            "search",
            "search",
            "a word, or node: topic: kind: text: level: … as in a filter; Enter finds the next",
            "",
            check_query,
            complete,
        ),
        "filter": Question(
            "filter",
            "filter",
            "node: topic: kind: level: time: text: …  Tab completes, empty shows all",
            session.filter_text,
            check_query,
            complete,
        ),
        "time": Question(
            "time",
            "go to time",
            "seconds after the start, or 20ms, 3us; @ and a simulated time",
            "",
            parse_time_in_run,
        ),
        "index": Question("index", "go to event", _numbers(session), "", parse_index),
    }
    return questions[kind]


def _numbers(session: Session) -> str:
    """Return which events there are: ``0 to 99``, of two runs ``a 0 to 99, b 0 to 98``."""
    shown = session.shown.items()
    return ", ".join(
        f"{name + ' ' if len(shown) > 1 else ''}0 to {max(run.count - 1, 0)}" for name, run in shown
    )


def parse_index(text: str) -> tuple[str, int]:
    """Return the run (``a``, ``b``; empty: not said) and the number of an event. Raises
    ValueError."""
    cleaned = text.strip().replace(",", "").replace("_", "").lstrip("#")
    name = cleaned[:1].lower() if cleaned[:1].lower() in ("a", "b") else ""
    number = cleaned[len(name) :].strip()
    if not number.isdecimal():
        raise ValueError(f"{text!r} is no whole number")
    return name, int(number)
