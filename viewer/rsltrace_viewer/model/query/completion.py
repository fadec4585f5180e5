"""What a filter that is being typed could become."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from rsltrace_viewer.model.query.fields import FIELDS
from rsltrace_viewer.model.run import Run

Choices = Mapping[str, Callable[[], list[str]]]
"""What could follow each field."""


def completions(text: str, run: Run) -> list[str]:
    """Return what ``text`` could become by finishing its last word, most likely first."""
    return complete(text, {name: partial(field.choices, run) for name, field in FIELDS.items()})


def complete(text: str, fields: Choices) -> list[str]:
    """Return what ``text`` could become in a language with these fields."""
    head, word = _last_word(text)
    sign = "-" if word.startswith("-") else ""
    name, colon, value = word[len(sign) :].partition(":")
    if not colon:
        if not name:
            return []
        return [f"{head}{sign}{field}:" for field in fields if field.startswith(name.lower())]
    find = fields.get(name.lower())
    if find is None:
        return []
    done, comma, last = value.rpartition(",")
    choices = find()
    folded = last.casefold()
    begins = [c for c in choices if c.casefold().startswith(folded)]
    contains = [c for c in choices if folded and folded in c.casefold() and c not in begins]
    # What is completed in place must continue what was typed; the rest is offered as a list.
    return [f"{head}{sign}{name}:{done}{comma}{choice}" for choice in begins + contains]


def _last_word(text: str) -> tuple[str, str]:
    start = max(text.rfind(" "), text.rfind("(")) + 1
    return text[:start], text[start:]
