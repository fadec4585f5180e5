"""All keys and the filter language, on one screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import ClassVar

from textual.binding import BindingType
from textual.content import Content

from rsltrace_viewer.model.lanes import KIND_LETTERS
from rsltrace_viewer.model.query.fields import FIELDS
from rsltrace_viewer.model.view import fit
from rsltrace_viewer.terminal.keys import Key, keys_of
from rsltrace_viewer.terminal.screens.text import TextScreen

_KEY_WIDTH = 13
_COLUMN = 56
_COLUMNS_MAX = 3
_WIDTH_MAX = 200
_FRAME = 6


class HelpScreen(TextScreen):
    BINDINGS: ClassVar[list[BindingType]] = [("question_mark", "dismiss(None)", "close")]
    DEFAULT_CSS = "HelpScreen > VerticalScroll { max-width: 200; }"

    def __init__(self, *, two: bool, live: bool = False) -> None:
        super().__init__("rsltrace view: keys")
        self._two = two
        self._live = live

    def text(self) -> Content:
        return help_text(self.app.size.width, two=self._two, live=self._live)


class KeysScreen(HelpScreen):
    """The keys of another screen, and the ``fields`` of its filters with what they mean."""

    def __init__(self, keys: Sequence[Key], fields: Mapping[str, str]) -> None:
        super().__init__(two=False)
        self._keys = keys
        self._fields = fields

    def text(self) -> Content:
        found = _filter_block(self._fields, _EXAMPLE_OF_MESSAGES)
        return _in_columns([*_keys_blocks(self._keys), found], self.app.size.width)


def help_text(width: int, *, two: bool, live: bool = False) -> Content:
    """Return the help for a screen of ``width`` cells, in columns where there is room."""
    blocks = [*_keys_blocks(keys_of(two=two, live=live)), _signs_block(two), _lanes_block()]
    fields = {name: field.help for name, field in FIELDS.items()}
    return _in_columns([*blocks, _filter_block(fields, _EXAMPLE)], width)


def _in_columns(blocks: Sequence[Sequence[Content]], width: int) -> Content:
    count = max(1, min((width - _FRAME) // _COLUMN, _COLUMNS_MAX))
    if count == 1:
        return Content("\n").join([line for block in blocks for line in [*block, Content("")]])
    room = (min(width, _WIDTH_MAX) - _FRAME) // count
    total = sum(len(block) + 1 for block in blocks)
    columns: list[list[Content]] = [[]]
    for block in blocks:
        if len(columns) < count and len(columns[-1]) + len(block) // 2 > total / count:
            columns.append([])
        columns[-1] += [*block, Content("")]
    lines = []
    for row in zip_longest(*columns, fillvalue=Content("")):
        cut = [one.truncate(room - 1, ellipsis=True, pad=True) for one in row]
        lines.append(Content(" ").join(cut))
    return Content("\n").join(lines)


def _keys_blocks(keys: Sequence[Key]) -> list[list[Content]]:
    return [_keys_block(group, keys) for group in dict.fromkeys(key.group for key in keys)]


def _keys_block(group: str, keys: Sequence[Key]) -> list[Content]:
    lines = [Content.styled(group, "bold underline")]
    lines += [_entry(key.shown, key.help) for key in keys if key.group == group]
    if group == "Look" and any(key.action == "follow" for key in keys):
        lines.append(_entry("Ctrl+P", "command palette"))
    return lines


def _entry(shown: str, text: str) -> Content:
    return Content.assemble("  ", (fit(shown, _KEY_WIDTH), "bold $text-primary"), text)


def _signs_block(two: bool) -> list[Content]:
    signs = [
        (">", "the selected event"),
        ("←", "its cause"),
        ("→", "its effect"),
        ("!", "raised an exception"),
        ("w", "logged a warning or worse"),
        ("*", "marked"),
    ]
    if two:
        signs += [
            ("=", "the same in both runs"),
            ("≠", "differs"),
            ("-", "in run a only"),
            ("+", "in run b only"),
            ("~", "the same, at another time or place"),
            ("?", "not compared"),
        ]
    head = Content.styled("Signs at the left of an event", "bold underline")
    return [head, *(_entry(sign, text) for sign, text in signs)]


def _lanes_block() -> list[Content]:
    lines = [Content.styled("Lanes, zoomed in to one event per column (+)", "bold underline")]
    lines.append(Content("  ! exception  w warning  g finding  ≠ runs diverge"))
    pairs = [f"{letter} {kind.label}" for kind, letter in KIND_LETTERS.items()]
    for start in range(0, len(pairs), 4):
        lines.append(Content("  " + "  ".join(pairs[start : start + 4])))
    return lines


_EXAMPLE = "node:/ekf -kind:timer (level:warn or is:raised)"
_EXAMPLE_OF_MESSAGES = "topic:/scan time:>2 (text:nan or index:<5)"


def _filter_block(fields: Mapping[str, str], example: str) -> list[Content]:
    lines = [Content.styled("Filters (F) and searches (/)", "bold underline")]
    lines += [_entry(f"{name}:", text) for name, text in fields.items()]
    lines += [
        Content("  a bare word looks in names, logs and exceptions"),
        Content("  all must hold; or  not  ( )  and - before a field"),
        Content(f"  {example}"),
    ]
    return lines
