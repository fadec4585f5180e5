"""What is wrong with a value of a job: a message for its author, and the place within the value.

Checks raise ``JobProblem``; all findings about a job are told at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from rsltrace.errors import nearest

Loc = tuple["str | int", ...]
"""A place in a job as keys and list indices: ``("nodes", 0, "name")``."""


class JobProblem(ValueError):
    """One finding. ``loc`` is relative to the value being validated; ``at_key`` blames the key."""

    def __init__(self, message: str, loc: Loc = (), *, at_key: bool = False) -> None:
        super().__init__(message)
        self.message = message
        self.loc = loc
        self.at_key = at_key


class JobProblems(ValueError):
    """Several findings of one validator."""

    def __init__(self, items: list[JobProblem]) -> None:
        super().__init__("; ".join(item.message for item in items))
        self.items = items


class ProblemCollector:
    """What is wrong with the entries of a list or mapping, to be raised all at once."""

    def __init__(self) -> None:
        self._items: list[JobProblem] = []

    @contextmanager
    def at(self, *loc: str | int, at_key: bool = False) -> Iterator[None]:
        """Take the ``ValueError`` that is raised within for a problem at ``loc``."""
        try:
            yield
        except ValueError as error:
            self._items.append(JobProblem(str(error), loc, at_key=at_key))

    def check(self) -> None:
        """Raise ``JobProblems`` if there was one."""
        if self._items:
            raise JobProblems(self._items)


def format_loc(loc: Loc) -> str:
    """Return ``nodes[0].parameters.rate`` for ``("nodes", 0, "parameters", "rate")``."""
    text = ""
    for part in loc:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def describe(value: object) -> str:
    """Name a value as it looks in YAML: ``true``, ``nothing``, ``text 'abc'``, ``a list``."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"text {value!r}"
    if isinstance(value, (int, float)):
        return f"the number {getattr(value, 'text', value)}"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, (list, tuple)):
        return "a list"
    return f"an object of {type(value).__name__}"


_BY_NAME = ("topics", "nodes")
"""Keys below which names stand as keys."""


def unknown_key(
    key: object, valid: Iterable[str], loc: Loc, *, below: Iterable[str] = ()
) -> JobProblem:
    """Return the finding that ``key``, below ``loc``, is none of the ``valid`` keys; ``below`` are
    those of them that have such a key."""
    below = list(below)
    names = list(valid)
    inside = f" in {format_loc(loc)}" if loc else ""
    text = str(key)
    near = meant_by(text, names) or nearest(text, names)
    glued, colon, value = text.replace("\xa0", " ").partition(":")
    if colon and glued in names:
        advice = f"put a blank after the colon: '{glued}: {value.strip()}'"
    elif near:
        advice = f"did you mean {near!r}?"
    elif text.startswith("/") and (part := next((n for n in _BY_NAME if n in names), None)):
        advice = f"names of {part} go below '{part}:'"
    elif below:
        advice = f"it goes below {' or '.join(f'{key!r}' for key in below)}"
    else:
        advice = f"valid keys are {', '.join(names)}"
    shown = repr(key) if isinstance(key, str) else describe(key).removeprefix("the number ")
    place = key if isinstance(key, (str, int)) else text
    return JobProblem(f"unknown key {shown}{inside}; {advice}", (*loc, place), at_key=True)


_OTHER_WORDS = {
    "mean": ("mu", "average", "avg", "loc"),
    "sd": ("std", "stddev", "std_dev", "sigma", "stdev", "deviation"),
    "min": ("low", "lower", "from", "a"),
    "max": ("high", "upper", "to", "b"),
    "shape": ("alpha", "k"),
    "scale": ("theta",),
    "good_to_bad": ("p",),
    "bad_to_good": ("r", "q"),
    "drop": ("loss", "lose", "p", "probability"),
    "default": ("constant", "all", "delay"),
    "node": ("class", "plugin", "component"),
    "executable": ("exec", "package", "pkg"),
    "namespace": ("ns",),
    "arguments": ("args", "kwargs", "argv"),
    "quiescence": ("quiet", "silence", "idle"),
    "workers": ("threads",),
    "file": ("path", "filename", "csv"),
    "path": ("file", "bag", "uri"),
    "from": ("start", "begin", "since", "sender", "publisher", "source", "src"),
    "to": ("end", "until", "stop", "receiver", "subscriber", "subscription", "destination", "dst"),
    "permutation": ("random", "shuffle", "shuffled"),
    "rate_monotonic": ("rm", "rms"),
    "at": ("time", "when"),
    "by": ("size", "jump"),
}
"""Words that other programs have for a key."""


def meant_by(word: str, names: Iterable[str]) -> str | None:
    """Return the name that is called ``word`` elsewhere, if there is one."""
    return next((name for name in names if word in _OTHER_WORDS.get(name, ())), None)


def as_flag(value: object) -> str:
    """Say how to write true or false: YAML 1.2 knows neither ``yes`` nor ``on``."""
    word = value.lower() if isinstance(value, str) else None
    if word in ("yes", "on", "y", "true"):
        return "; write true"
    return "; write false" if word in ("no", "off", "n", "false") else ""
