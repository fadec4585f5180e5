"""All keys in one table: what the app binds, the footer and the help show, and a test presses."""

from __future__ import annotations

from rsltrace.fast_dataclass import dataclass


@dataclass(frozen=True, slots=True)
class Key:
    """Keys (as Textual names them, separated by commas) and what they do.

    ``short`` is for the footer (empty: not there), where small ``rank`` comes first. ``shown`` is
    how the help writes the keys. ``two`` keys do something with two traces only.
    """

    keys: str
    shown: str
    action: str
    help: str
    group: str
    short: str = ""
    rank: int = 99
    two: bool = False

    @property
    def first(self) -> bool:
        """Whether the key is looked at before the focused pane gets it. Questions are opened so:
        what is typed right after must not reach that pane any more."""
        return self.action.startswith(("ask", "pane"))


MOVE = "Step through events"
FOLLOW = "Follow cause and effect"
JUMP = "Jump"
FIND = "Search and filter"
LOOK = "Look"
COMPARE = "Two traces"
RUN = "Run (--live)"

KEYS: tuple[Key, ...] = (
    Key("down,j", "↓ j", "step(1)", "next event", MOVE, "next", 1),
    Key("up,k", "↑ k", "step(-1)", "previous event", MOVE),
    Key("pagedown,space", "PgDn Space", "page(1)", "a page on", MOVE),
    Key("pageup", "PgUp", "page(-1)", "a page back", MOVE),
    Key("home", "Home", "edge(-1)", "first event", MOVE),
    Key("end,G", "End G", "edge(1)", "last event", MOVE),
    Key(
        "right_square_bracket",
        "]",
        "same('node', 1)",
        "next event of the same node",
        MOVE,
        "[ ] node",
        5,
    ),
    Key("left_square_bracket", "[", "same('node', -1)", "previous event of the same node", MOVE),
    Key("right_curly_bracket", "}", "same('entity', 1)", "next event of the same entity", MOVE),
    Key("left_curly_bracket", "{", "same('entity', -1)", "previous event of the same entity", MOVE),
    Key("right_parenthesis", ")", "same('topic', 1)", "next event on the same topic", MOVE),
    Key("left_parenthesis", "(", "same('topic', -1)", "previous event on the same topic", MOVE),
    Key("c", "c", "cause", "to the event that caused this one", FOLLOW, "cause", 3),
    Key("e", "e", "effect", "to what it caused (a list, if several)", FOLLOW, "effects", 4),
    Key("backspace,b", "b Backspace", "go_back", "back to where you were", FOLLOW, "back", 8),
    Key("f", "f", "go_forward", "forward again", FOLLOW),
    Key("r", "r", "reason", "why the callback came late or not at all", FOLLOW, "reason", 6),
    Key("m", "m", "mark", "set or remove a mark", FOLLOW),
    Key("apostrophe", "'", "next_mark(1)", "next mark", FOLLOW),
    Key("quotation_mark", '"', "next_mark(-1)", "previous mark", FOLLOW),
    Key("t", "t", "ask('time')", "go to a time", JUMP, "time", 9),
    Key("i", "i", "ask('index')", "go to an event by its number", JUMP),
    Key("x", "x", "seek('raised', 1)", "next exception", JUMP, "exception", 10),
    Key("X", "X", "seek('raised', -1)", "previous exception", JUMP),
    Key("l", "l", "seek('log', 1)", "next log record", JUMP),
    Key("L", "L", "seek('log', -1)", "previous log record", JUMP),
    Key("w", "w", "seek('warning', 1)", "next warning or worse", JUMP),
    Key("W", "W", "seek('warning', -1)", "previous warning or worse", JUMP),
    Key("u", "u", "seek('finding', 1)", "next finding of the guard", JUMP),
    Key("U", "U", "seek('finding', -1)", "previous finding of the guard", JUMP),
    Key(
        "slash",
        "/",
        "ask('search')",
        "search: a name, a text, or as in a filter",
        FIND,
        "search",
        2,
    ),
    Key("n", "n", "next_match(1)", "next match; without a search, divergence", FIND),
    Key("N", "N", "next_match(-1)", "previous match or divergence", FIND),
    Key("F", "F", "ask('filter')", "show only some events: node:/x …", FIND, "filter", 6),
    Key("escape", "Esc", "escape", "end search, filter, zoom, following", FIND),
    Key("enter", "Enter", "enter", "open or close a field; follow a link", LOOK, "open", 11),
    Key("tab", "Tab", "pane(1)", "next pane: events, event, lanes", LOOK, "pane", 7),
    Key("shift+tab", "⇧Tab", "pane(-1)", "previous pane", LOOK),
    Key(
        "plus,equals_sign",
        "+",
        "zoom(1)",
        "lanes: zoom in, down to single events",
        LOOK,
        "+ - zoom",
        12,
    ),
    Key("minus", "-", "zoom(-1)", "lanes: zoom out", LOOK),
    Key("0", "0", "zoom(0)", "lanes: the whole run", LOOK),
    Key("z", "z", "maximise", "this pane over the whole screen, and back", LOOK),
    Key("O", "O", "overview", "overview: what went wrong, nodes, topics", LOOK, "overview", 5),
    Key("g", "g", "log", "all log records", LOOK, "log", 12),
    Key("p", "p", "plot", "plot fields, rates and latencies", LOOK, "plot", 13),
    Key("s", "s", "source", "the callback's source, or not", LOOK, "source", 13),
    Key("E", "E", "edit", "open the callback in $VISUAL or $EDITOR", LOOK, "edit", 14),
    Key("y", "y", "yank", "copy the line one is at", LOOK),
    Key("greater_than_sign", ">", "resize(1)", "make this pane larger", LOOK),
    Key("less_than_sign", "<", "resize(-1)", "make this pane smaller", LOOK),
    Key("R", "R", "follow", "follow a file that is still recorded", LOOK),
    Key("d", "d", "theme", "dark or light", LOOK),
    Key("v", "v", "verdict", "why the runs diverge: the whole report", COMPARE, "why", 3, True),
    Key("o", "o", "other", "inspect run a, run b, or the differences", COMPARE, "a/b", 7, True),
    Key("question_mark", "?", "help", "all keys", LOOK, "help", 0),
    Key("q", "q", "quit", "quit", LOOK, "quit", 0),
)

LIVE_KEYS: tuple[Key, ...] = (
    Key(
        "full_stop",
        ".",
        "run(1)",
        "run on to the next breakpoint, or to the end",
        RUN,
        ". , run",
        1,
    ),
    Key("comma", ",", "run(-1)", "run back to the last breakpoint, or to the start", RUN),
    Key("B", "B", "ask('breakpoint')", "set a breakpoint", RUN, "break", 1),
    Key("D", "D", "clear", "remove a breakpoint", RUN),
    Key("V", "V", "ask('watch')", "watch an expression in the node", RUN, "watch", 2),
    Key("C", "C", "ask('changed')", "to the last change of an attribute", RUN, "changed", 2),
    Key("T", "T", "ask('first')", "to the first event with a condition", RUN),
)
"""What a run takes that goes on; all keys that go to an event execute it."""

_SHOWN = {"next": "↓↑", "cause": "c", "effects": "e"}


def key_names() -> set[str]:
    """Return the names that Textual gives to keys: ``down``, ``slash`` …"""
    from textual.keys import Keys, _character_to_key

    signs = {_character_to_key(chr(code)) for code in range(ord(" "), 127)}
    return signs | {str(key.value) for key in Keys}


def keys_of(*, two: bool, live: bool) -> list[Key]:
    """Return the keys that do something: with two traces, with a run that goes on."""
    found = [key for key in KEYS if two or not key.two]
    return [*LIVE_KEYS, *found] if live else found


def footer_keys(*, two: bool, searching: str, live: bool = False) -> list[tuple[str, str, str]]:
    """Return (key as shown, words, action) for the footer, the most needed first."""
    found = sorted((key for key in keys_of(two=two, live=live) if key.short), key=lambda k: k.rank)
    entries = []
    for key in found:
        if key.short.startswith(("[", "+", ".")):
            shown, _, words = key.short.rpartition(" ")
        else:
            shown, words = _SHOWN.get(key.short, key.shown.split(" ")[0]), key.short
        entries.append((shown, words, key.action))
    if searching:
        entries.insert(3, ("n N", searching, "next_match(1)"))
    return entries
