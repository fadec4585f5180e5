"""What is asked about recordings, and which answers are good: a search, a filter, a time."""

from __future__ import annotations

from rsltrace.trace.words.times import parse_time_in_run
from rsltrace_viewer.model.query.completion import complete
from rsltrace_viewer.model.recordings.filter import choices, read_filter
from rsltrace_viewer.model.recordings.session import RecordingSession
from rsltrace_viewer.terminal.widgets.prompt import Question


def question_of(kind: str, session: RecordingSession) -> Question:
    """Return the question of a kind: ``search``, ``filter`` or ``time``."""
    recordings = session.recordings
    known = choices(recordings)

    def check(text: str) -> object:
        return read_filter(text, recordings)

    def completed(text: str) -> list[str]:
        return complete(text, known)

    fields = "topic: type: time: text: …"
    questions = {
        "search": Question(
            "search",
            "search",
            f"a word, or {fields} as in a filter; Enter finds the next",
            "",
            check,
            completed,
        ),
        "filter": Question(
            "filter",
            "filter",
            f"{fields}  Tab completes, empty shows all",
            session.filter_text,
            check,
            completed,
        ),
        "time": Question("time", "go to", "seconds after the start, or 2ms", "", parse_time_in_run),
    }
    return questions[kind]
