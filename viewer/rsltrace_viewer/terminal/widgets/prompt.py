"""The line at the bottom that asks for something: a search, a filter, a time, an index."""

from __future__ import annotations

from collections.abc import Callable

from textual import events
from textual.app import ComposeResult
from textual.containers import Vertical
from textual.content import Content
from textual.message import Message
from textual.suggester import Suggester
from textual.widgets import Input, Static

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.texts import printable
from rsltrace_viewer.model.view import cells

_SHOWN_COMPLETIONS = 8


@dataclass(frozen=True, slots=True)
class Question:
    """What is asked. ``check`` raises ValueError for a bad answer; with ``start`` and ``end`` as
    QueryError has them, the place is pointed at. ``complete`` gives what a text could become."""

    kind: str
    label: str
    hint: str
    value: str
    check: Callable[[str], object]
    complete: Callable[[str], list[str]] | None = None


class _Completer(Suggester):
    def __init__(self, complete: Callable[[str], list[str]]) -> None:
        super().__init__(use_cache=False, case_sensitive=True)
        self._complete = complete

    async def get_suggestion(self, value: str) -> str | None:
        return next((c for c in self._complete(value) if c.startswith(value)), None)


class _Field(Input):
    """Where the answer is typed. It takes the keys that end or complete an answer itself: as
    bindings of the app they would overtake, or be overtaken by, what a fast hand types."""

    async def _on_key(self, event: events.Key) -> None:
        prompt = self.query_ancestor(Prompt)
        if not prompt.asking:  # typed right after Enter, when the focus was still here
            self.app.post_message(events.Key(event.key, event.character))
        elif event.key == "enter":
            prompt.answer()
        elif event.key == "escape":
            prompt.put_aside()
        elif event.key == "tab":
            prompt.complete()
        else:
            return
        event.stop()
        event.prevent_default()


class Prompt(Vertical):
    """Hidden until something is asked."""

    DEFAULT_CSS = """
    Prompt { height: auto; background: $panel; padding: 0 1; }
    Prompt Input { border: none; height: 1; padding: 0; background: $panel; }
    Prompt Input:focus { border: none; background-tint: $foreground 0%; }
    Prompt #line { height: 1; layout: horizontal; }
    Prompt #label { width: auto; text-style: bold; color: $text-primary; }
    Prompt #hint { height: auto; max-height: 5; color: $text-muted; }
    Prompt #hint.wrong { color: $text-error; }
    """

    class Answered(Message):
        """An answer that ``check`` accepts; None if the question was put aside."""

        def __init__(self, kind: str, text: str | None) -> None:
            super().__init__()
            self.kind = kind
            self.text = text

    def __init__(self, *, id: str) -> None:  # Textual's name for it
        super().__init__(id=id)
        self._question: Question | None = None
        self.display = False

    def compose(self) -> ComposeResult:
        with Vertical(id="line"):
            yield Static(id="label")
            yield _Field(id="answer", select_on_focus=False, compact=True)
        yield Static(id="hint")

    @property
    def asking(self) -> bool:
        return self._question is not None

    def ask(self, question: Question) -> None:
        self._question = question
        self.query_one("#label", Static).update(f"{question.label} ")
        field = self.query_one(Input)
        field.suggester = _Completer(question.complete) if question.complete else None
        self.display = True
        field.value = question.value
        field.cursor_position = len(question.value)
        # At once: what is typed next must not be taken for keys of the viewer.
        self.screen.set_focus(field)
        self._say(question.value)

    def put_aside(self) -> None:
        self._close(None)

    def on_input_changed(self, event: Input.Changed) -> None:
        """Say what is wrong, or how it could go on."""
        event.stop()
        self._say(event.value)

    def answer(self) -> None:
        question, value = self._question, self.query_one(Input).value
        if question is None:
            return
        try:
            question.check(value)
        except ValueError as error:
            self._complain(error)
            return
        self._close(value)

    def complete(self) -> None:
        """Finish the last word as far as there is one way to."""
        question, field = self._question, self.query_one(Input)
        if question is None or question.complete is None:
            return
        found = question.complete(field.value)
        if found:
            field.value = found[0] if len(found) == 1 else _common(found, field.value)
            field.cursor_position = len(field.value)

    def _say(self, value: str) -> None:
        question = self._question
        if question is None:
            return
        hint = self.query_one("#hint", Static)
        hint.remove_class("wrong")
        choices = question.complete(value) if question.complete and value else []
        # A value that is typed out is still right to be checked: nothing to complete, or the end.
        try:
            if value.strip():
                question.check(value)
        except ValueError as error:
            if not choices:
                self._complain(error)
                return
        shown = [_tail(choice) for choice in choices if choice != value][:_SHOWN_COMPLETIONS]
        more = "  …" if len(choices) > _SHOWN_COMPLETIONS else ""
        hint.update(Content(printable("  ".join(shown)) + more if shown else question.hint))

    def _complain(self, error: ValueError) -> None:
        hint = self.query_one("#hint", Static)
        hint.add_class("wrong")
        start, end = getattr(error, "start", None), getattr(error, "end", None)
        text = printable(str(error))
        if start is not None and end is not None and self._question is not None:
            before = self.query_one(Input).value[:start]
            offset = cells(self._question.label) + 1 + cells(before)
            width = self.size.width - 2
            pointer = " " * offset + "^" * max(end - start, 1)
            if len(pointer) + 1 + cells(text) <= width:
                text = f"{pointer} {text}"
            elif len(pointer) <= width:
                text = f"{pointer}\n{text}"
            else:
                text = f"at character {start + 1}: {text}"
        hint.update(Content(text))

    def _close(self, text: str | None) -> None:
        question, self._question = self._question, None
        if question is None:
            return
        self.display = False
        # At once, and straight to the app: what is typed next must find the answer given.
        self.screen.set_focus(None)
        self.app.post_message(self.Answered(question.kind, text))


def _tail(text: str) -> str:
    return text[max(text.rfind(" "), text.rfind("(")) + 1 :]


def _common(choices: list[str], value: str) -> str:
    """Return the longest beginning that all choices share, if it is longer than ``value``."""
    first, last = min(choices), max(choices)
    size = 0
    while size < min(len(first), len(last)) and first[size] == last[size]:
        size += 1
    return first[:size] if size > len(value) else choices[0]
