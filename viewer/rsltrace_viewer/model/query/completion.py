"""What a filter that is being typed could become."""

from __future__ import annotations

from rsltrace_viewer.model.query.fields import FIELDS
from rsltrace_viewer.model.run import Run


def completions(text: str, run: Run) -> list[str]:
    """Return what ``text`` could become by finishing its last word, most likely first."""
    head, word = _last_word(text)
    sign = "-" if word.startswith("-") else ""
    name, colon, value = word[len(sign) :].partition(":")
    if not colon:
        if not name:
            return []
        return [f"{head}{sign}{field}:" for field in FIELDS if field.startswith(name.lower())]
    field = FIELDS.get(name.lower())
    if field is None:
        return []
    done, comma, last = value.rpartition(",")
    choices = field.choices(run)
    folded = last.casefold()
    begins = [c for c in choices if c.casefold().startswith(folded)]
    contains = [c for c in choices if folded and folded in c.casefold() and c not in begins]
    # What is completed in place must continue what was typed; the rest is offered as a list.
    return [f"{head}{sign}{name}:{done}{comma}{choice}" for choice in begins + contains]


def _last_word(text: str) -> tuple[str, str]:
    start = max(text.rfind(" "), text.rfind("(")) + 1
    return text[:start], text[start:]
