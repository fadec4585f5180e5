"""What the viewer asks for, and which answers are good: a search, a filter, a time, an index."""

from __future__ import annotations

from rsltrace.words.times import parse_time_in_run
from rsltrace_viewer.model.query.completion import completions
from rsltrace_viewer.model.query.parser import parse
from rsltrace_viewer.session import Session
from rsltrace_viewer.terminal.widgets.prompt import Question


def question_of(kind: str, session: Session) -> Question:
    """Return the question of a kind: ``search``, ``filter``, ``time`` or ``index``."""

    def check_query(text: str) -> object:
        return parse(text, session.a)

    def complete(text: str) -> list[str]:
        return completions(text, session.a)

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
        "index": Question(
            "index", "go to event", f"0 to {max(session.a.count - 1, 0)}", "", parse_index
        ),
    }
    return questions[kind]


def parse_index(text: str) -> int:
    """Return the number of an event. Raises ValueError."""
    cleaned = text.strip().replace(",", "").replace("_", "").lstrip("#")
    if not cleaned.isdecimal():
        raise ValueError(f"{text!r} is no whole number")
    return int(cleaned)
