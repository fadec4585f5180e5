"""The keys of the screen of recordings: what it binds, the footer and the help show."""

from __future__ import annotations

from rsltrace_viewer.terminal.keys import COMPARE, FIND, LOOK, MOVE, Key

RECORDING_KEYS: tuple[Key, ...] = (
    Key("down,j", "↓ j", "", "next line", MOVE, "next", 1),
    Key("up,k", "↑ k", "", "previous line", MOVE),
    Key("pagedown,space", "PgDn Space", "", "a page on; PgUp back, Home and End", MOVE),
    Key("tab", "Tab", "pane(1)", "next pane: topics, messages, message", LOOK, "pane", 2),
    Key("shift+tab", "⇧Tab", "pane(-1)", "previous pane", LOOK),
    Key("enter", "Enter", "", "to the messages of a topic; open a field", LOOK, "open", 3),
    Key("t", "t", "ask('time')", "go to a time since the start", FIND, "time", 6),
    Key("slash", "/", "ask('search')", "search: a word, or as in a filter", FIND, "search", 4),
    Key("F", "F", "ask('filter')", "show only some messages: topic:/x …", FIND, "filter", 5),
    Key("n", "n", "next_match(1)", "next match; without a search, difference", FIND),
    Key("N", "N", "next_match(-1)", "previous match or difference", FIND),
    Key("v", "v", "report", "how the recordings compare: the report", COMPARE, "why", 3, True),
    Key("p", "p", "plot", "plot fields and rates", LOOK, "plot", 4),
    Key("y", "y", "yank", "copy the line one is at", LOOK),
    Key("d", "d", "theme", "dark or light", LOOK),
    Key("escape", "Esc", "escape", "end search, filter; back to the topics", LOOK),
    Key("question_mark", "?", "help", "all keys", LOOK, "help", 0),
    Key("q", "q", "quit", "quit", LOOK, "quit", 0),
)


def recording_keys(*, two: bool) -> list[Key]:
    """Return the keys that do something with one recording, or with two."""
    return [key for key in RECORDING_KEYS if two or not key.two]
