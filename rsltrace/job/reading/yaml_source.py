"""A YAML file as plain values, with the line and column of every key and value beside them.

ruamel.yaml composes the node tree; the values are made from it here, because a job needs what a
constructor throws away: the text of each number, the place of each key, and keys given twice.
"""

from __future__ import annotations

import re
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from rsltrace.errors import JobError
from rsltrace.fast_dataclass import dataclass
from rsltrace.job.values.times import ExactFloat
from rsltrace.trace.model.operation import NESTING_MAX, nested_too_deep

VALUES_MAX = 100_000
"""Aliases can make a small file mean an enormous one; no job needs this many values."""

REPEATED_MAX = 10_000
"""Values and keys that aliases and ``<<`` repeat: what is written once costs the most then."""

SHOWN_COLUMNS = 100

_TAG = "tag:yaml.org,2002:"
_SHOWN_MAX = 40
_DIGITS_MAX = 100
_LINE_BREAK = re.compile("\r\n|[\n\r\x85\u2028\u2029]")


@dataclass(frozen=True)
class TextPosition:
    """A place in the file; line and column count from 1."""

    line: int
    column: int


@dataclass(eq=False)
class YamlSource:
    """The text of a YAML file (or of an option, ``is_option``) with its values.

    ``name`` is how messages call it, ``folder`` (absolute) is where paths in it start.
    """

    name: str
    text: str
    folder: str | None = None
    is_option: bool = False
    root: YamlValue | None = None

    @property
    def value(self) -> object:
        """All values, without their places."""
        return None if self.root is None else self.root.plain()

    def where(self, mark: TextPosition) -> str:
        """Return ``file:line:column``; an option is short enough to do without."""
        return self.name if self.is_option else f"{self.name}:{mark.line}:{mark.column}"

    def excerpt(self, mark: TextPosition) -> str:
        """Return the line of ``mark`` with a caret below the column, or nothing past the end."""
        lines = _LINE_BREAK.split(self.text)
        line = lines[mark.line - 1] if mark.line <= len(lines) else ""
        if not line.strip():
            return ""
        column = mark.column - 1
        start = max(0, column - SHOWN_COLUMNS // 2) if len(line) > SHOWN_COLUMNS else 0
        shown = line[start : start + SHOWN_COLUMNS]
        # Tabs stay tabs, so that the caret lines up however wide a terminal draws them.
        before = "".join("\t" if c == "\t" else " " for c in shown[: column - start])
        shown = "".join(c if c == "\t" or c.isprintable() else "\ufffd" for c in shown)
        gutter = "      | " if self.is_option else f"{mark.line:>5} | "
        return f"\n{gutter}{shown.rstrip()}\n{' ' * (len(gutter) - 2)}| {before}^"

    def error(self, message: str, mark: TextPosition) -> JobError:
        return JobError(f"{message}{self.excerpt(mark)}", where=self.where(mark))


@dataclass(frozen=True)
class SourcePlace:
    """A mark in one of the files a job is made of."""

    source: YamlSource
    mark: TextPosition

    def error(self, message: str) -> JobError:
        """Return the error that ``message`` is wrong here."""
        return self.source.error(message, self.mark)


@dataclass(frozen=True)
class YamlValue:
    """A value with its place: a scalar, or a list or mapping of items.

    ``key_place`` is where its key stands, if it has one. ``is_bare`` tells text without quotes,
    which may turn out to be a number once ``$(...)`` in it is replaced.
    """

    value: Any
    place: SourcePlace
    key_place: SourcePlace | None = None
    is_bare: bool = False

    def plain(self) -> object:
        """Return the value without places."""
        if isinstance(self.value, dict):
            return {key: item.plain() for key, item in self.value.items()}
        if isinstance(self.value, list):
            return [item.plain() for item in self.value]
        return self.value


def parse_yaml(
    text: str, name: str, *, folder: str | None = None, option: str | None = None
) -> YamlSource:
    """Return the values and places of the one document in ``text``; ``name`` is the file's.

    ``option`` is the whole text of a command line option that ``text`` is the end of; places then
    count in the option. Raises ``JobError`` for anything that is not plain YAML 1.2 data with
    distinct keys.
    """
    _check_nesting(text, name)
    source = YamlSource(name, text if option is None else option, folder, option is not None)
    # Blanks in front keep the columns; they mean nothing in front of a value on one line.
    written = text if option is None else " " * (len(option) - len(text)) + text
    try:
        root = YAML().compose(written)
        if root is not None:
            source.root = _YamlValueBuilder(source).build(root)
    except MarkedYAMLError as error:
        raise _syntax_error(source, error) from None
    except ReaderError as error:
        mark = _mark_at(written, error.position)
        raise source.error(f"{error.reason}: {written[error.position]!r}", mark) from None
    except YAMLError as error:
        raise JobError(f"not YAML: {error}", where=name) from None
    except RecursionError:
        raise JobError("the values are nested too deeply", where=name) from None
    return source


def _check_nesting(text: str, name: str) -> None:
    """Refuse at once what would keep the parser busy for long: its time grows with the square."""
    at = nested_too_deep(text)
    if at >= 0:
        line = text.count("\n", 0, at) + 1
        raise JobError(f"brackets are nested more than {NESTING_MAX} deep", where=f"{name}:{line}")


def bare_value(text: str) -> object:
    """Return what ``text`` without quotes means in YAML: a number, true, null, or itself."""
    kind = str(YAML().resolver.resolve(ScalarNode, text, (True, False)))
    try:
        return _value(kind.removeprefix(_TAG), text)
    except ValueError:
        return text


class _YamlValueBuilder:
    """Makes items of composed nodes."""

    def __init__(self, source: YamlSource) -> None:
        self.source = source
        self.open: set[int] = set()
        self.count = 0
        self.repeated = 0
        self.seen: set[int] = set()

    def build(self, node: Node, key: Node | None = None) -> YamlValue:
        place = SourcePlace(self.source, _mark(node))
        key_place = None if key is None else SourcePlace(self.source, _mark(key))
        self.count += 1
        if self.count > VALUES_MAX:
            raise place.error(f"more than {VALUES_MAX} values")
        if id(node) in self.seen:
            self._repeat(node)
        self.seen.add(id(node))
        if isinstance(node, ScalarNode):
            if key_place is not None and not _is_written(node):
                # The mark of a value that is not there lies wherever the next token begins.
                place = key_place
            value = self._scalar(node)
            return YamlValue(value, place, key_place, is_bare=node.style is None)
        if id(node) in self.open:
            raise place.error("an alias refers to a value that contains it")
        self.open.add(id(node))
        inner: object
        if isinstance(node, SequenceNode) and _tag(node) == f"{_TAG}seq":
            inner = [self.build(item) for item in node.value]
        elif isinstance(node, MappingNode) and _tag(node) == f"{_TAG}map":
            pairs = self._pairs(node).items()
            inner = {name: self.build(item, name_node) for name, (name_node, item) in pairs}
        else:
            raise self._unknown_tag(node)
        self.open.discard(id(node))
        return YamlValue(inner, place, key_place)

    def _repeat(self, node: Node) -> None:
        self.repeated += 1
        if self.repeated > REPEATED_MAX:
            message = f"aliases and '<<' repeat more than {REPEATED_MAX} values"
            raise self.source.error(message, _mark(node))

    def _pairs(self, node: MappingNode) -> dict[object, tuple[ScalarNode, Node]]:
        """Return the keys of a mapping, then those that ``<<`` merges in and it lacks itself."""
        pairs: dict[object, tuple[ScalarNode, Node]] = {}
        merged: list[Node] = []
        for key_node, value_node in node.value:
            if not isinstance(key_node, ScalarNode):
                raise self.source.error("a key must be plain text", _mark(key_node))
            if _tag(key_node) == f"{_TAG}merge":
                merged += value_node.value if isinstance(value_node, SequenceNode) else [value_node]
                continue
            key = self._scalar(key_node)
            if key in pairs:
                first = _mark(pairs[key][0]).line
                message = f"the key {key!r} is given twice, first in line {first}"
                raise self.source.error(message, _mark(key_node))
            pairs[key] = (key_node, value_node)
        for mapping in merged:
            if not isinstance(mapping, MappingNode) or id(mapping) in self.open:
                raise self.source.error("'<<' takes other mappings only", _mark(mapping))
            self.open.add(id(mapping))
            self._repeat(mapping)
            for key, pair in self._pairs(mapping).items():
                self._repeat(mapping)
                pairs.setdefault(key, pair)
            self.open.discard(id(mapping))
        return pairs

    def _scalar(self, node: ScalarNode) -> object:
        tag, text = _tag(node), str(node.value)
        kind = tag[len(_TAG) :] if tag.startswith(_TAG) else ""
        if kind not in _SCALARS:
            raise self._unknown_tag(node)
        try:
            return _value(kind, text)
        except ValueError:
            shown = text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}..."
            wrong = "too long a number" if len(text) > _DIGITS_MAX else "not a number"
            raise self.source.error(f"{shown!r} is {wrong}", _mark(node)) from None

    def _unknown_tag(self, node: Node) -> JobError:
        tag = _tag(node).replace(_TAG, "!!")
        return self.source.error(
            f"the YAML tag {tag} has no meaning in a job: quote a text that begins with '!'",
            _mark(node),
        )


# A date is text to a job, and so is the lone '=' that YAML 1.1 gave a meaning.
_SCALARS = ("null", "bool", "int", "float", "str", "timestamp", "value", "merge")


def _value(kind: str, text: str) -> object:
    """Return the value of a scalar. Raises ``ValueError`` for what looks like a number only."""
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() in ("true", "yes", "on")
    if kind == "int":
        return _integer(text)
    return ExactFloat(_float(text), text) if kind == "float" else text


def _tag(node: Any) -> str:
    return str(node.tag)


def _is_written(node: ScalarNode) -> bool:
    return bool(node.value) or node.style is not None


def _mark(node: Any) -> TextPosition:
    return TextPosition(node.start_mark.line + 1, node.start_mark.column + 1)


def _mark_at(text: str, position: int) -> TextPosition:
    lines = _LINE_BREAK.split(text[:position])
    return TextPosition(len(lines), len(lines[-1]) + 1)


_ADVICE = {
    "mapping values are not allowed here": "check the indentation, or quote a text with ': ' in it",
    "expected <block end>, but found '<scalar>'": "put a text that has quotes in it in single "
    "quotes: '…'",
    "expected <block end>": "check the indentation: this does not line up with what is above",
    "found character '\\t'": "indent with spaces, not tabs",
    "but found another document": "a job file holds one document, without '---' in between",
    "expected the node content": "a value is missing, or a bracket is not closed",
    "expected ',' or": "a bracket is not closed, or a comma is missing",
    "could not find expected ':'": "there is no ': ' after this key",
    "found unexpected end of stream": "a quote is not closed",
    "found character '@'": "quote a text that begins with '@'",
    "found character '%'": "quote a text that begins with '%'",
    "found character '`'": "quote a text that begins with '`'",
    "found undefined alias": "quote a text that begins with '*'",
}
"""What to do about the parser's commonest complaints, by how they begin."""

_WHERE_IT_BEGAN = ("expected ',' or", "could not find expected ':'")
"""Complaints that are made long after the place to look at."""


def _syntax_error(source: YamlSource, error: Any) -> JobError:
    began, place = error.context_mark, error.problem_mark or error.context_mark
    mark = TextPosition(place.line + 1, place.column + 1) if place else TextPosition(1, 1)
    problem = str(error.problem or error.context)
    glued = _glued_dash(source, began.line, mark.line) if began else None
    if glued is not None and problem.startswith("expected <block end>"):
        return source.error("not YAML: a list entry begins with '- ', a blank after the '-'", glued)
    advice = next((text for start, text in _ADVICE.items() if problem.startswith(start)), None)
    message = problem
    if error.context and began and began.line + 1 < mark.line:
        first = TextPosition(began.line + 1, began.column + 1)
        if problem.startswith(_WHERE_IT_BEGAN):
            message += f" in line {mark.line}, {error.context} that begins here"
            mark = first
        elif source.excerpt(mark):
            message += f", {error.context} that began in line {first.line}"
        else:
            # The file ended; what was left open is what to look at.
            mark = first
            message += f", {error.context} that begins here"
    return source.error(
        f"not YAML: {advice} ({message})" if advice else f"not YAML: {message}", mark
    )


def _glued_dash(source: YamlSource, first: int, last: int) -> TextPosition | None:
    """Return the place of a list entry without the blank: ``-node: x`` (lines count from 0)."""
    for number, line in enumerate(_LINE_BREAK.split(source.text)[first:last], first + 1):
        found = re.match(r"\s*-[^\s-]+:", line)
        if found:
            return TextPosition(number, line.index("-") + 1)
    return None


def _integer(text: str) -> int:
    digits = text.replace("_", "")
    if len(digits) > _DIGITS_MAX:
        raise ValueError
    unsigned = digits.lstrip("+-")
    if unsigned[:2].lower() in ("0x", "0o", "0b"):
        return int(digits, 0)
    return int(digits)


def _float(text: str) -> float:
    return float(text.replace("_", "").lower().replace(".inf", "inf").replace(".nan", "nan"))
