"""A YAML file as plain values, with the line and column of every key and value kept apart.

ruamel.yaml composes the node tree; the values are made from it here, because a job needs what a
constructor throws away: the text of each number, the place of each key, and keys given twice.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from rsltrace.errors import JobError
from rsltrace.job.problems import Loc
from rsltrace.job.times import ExactFloat

VALUES_MAX = 100_000
"""Aliases can make a small file mean an enormous one; no job needs this many values."""

SHOWN_COLUMNS = 100

_TAG = "tag:yaml.org,2002:"
_LINE_BREAK = re.compile("\r\n|[\n\r\x85\u2028\u2029]")


@dataclass(frozen=True)
class Mark:
    """A place in the file; line and column count from 1."""

    line: int
    column: int


@dataclass
class YamlSource:
    """The text of a YAML file with its values and their places."""

    name: str
    text: str
    value: object = None
    values: dict[Loc, Mark] = field(default_factory=dict)
    keys: dict[Loc, Mark] = field(default_factory=dict)

    def mark(self, loc: Loc, *, at_key: bool = False) -> Mark:
        """Return the place of the value (or key) at ``loc``, or of the nearest one around it."""
        if at_key and loc in self.keys:
            return self.keys[loc]
        while loc and loc not in self.values:
            loc = loc[:-1]
        return self.values.get(loc, Mark(1, 1))

    def where(self, mark: Mark) -> str:
        """Return ``file:line:column``."""
        return f"{self.name}:{mark.line}:{mark.column}"

    def excerpt(self, mark: Mark) -> str:
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
        gutter = f"{mark.line:>5} | "
        return f"\n{gutter}{shown.rstrip()}\n{' ' * (len(gutter) - 2)}| {before}^"

    def error(self, message: str, mark: Mark) -> JobError:
        """Return the error that ``message`` is wrong at ``mark``."""
        return JobError(f"{message}{self.excerpt(mark)}", where=self.where(mark))


def parse_yaml(text: str, name: str) -> YamlSource:
    """Return the values and places of the one document in ``text``; ``name`` is the file's.

    Raises ``JobError`` for anything that is not plain YAML 1.2 data with distinct keys.
    """
    source = YamlSource(name, text)
    try:
        root = YAML().compose(text)
        if root is not None:
            source.value = _Builder(source).build(root, ())
    except MarkedYAMLError as error:
        raise _syntax_error(source, error) from None
    except ReaderError as error:
        mark = _mark_at(text, error.position)
        raise source.error(f"{error.reason}: {text[error.position]!r}", mark) from None
    except YAMLError as error:
        raise JobError(f"not YAML: {error}", where=name) from None
    except RecursionError:
        raise JobError("the values are nested too deeply", where=name) from None
    return source


class _Builder:
    """Makes plain values of composed nodes and notes where each came from."""

    def __init__(self, source: YamlSource) -> None:
        self.source = source
        self.open: set[int] = set()
        self.count = 0

    def build(self, node: Node, loc: Loc) -> object:
        mark = _mark(node)
        self.source.values[loc] = mark
        self.count += 1
        if self.count > VALUES_MAX:
            raise self.source.error(
                f"more than {VALUES_MAX} values once aliases are followed", mark
            )
        if isinstance(node, ScalarNode):
            return self._scalar(node)
        if id(node) in self.open:
            raise self.source.error("an alias refers to a value that contains it", mark)
        self.open.add(id(node))
        value: object
        if isinstance(node, SequenceNode) and _tag(node) == f"{_TAG}seq":
            value = [self.build(item, (*loc, index)) for index, item in enumerate(node.value)]
        elif isinstance(node, MappingNode) and _tag(node) == f"{_TAG}map":
            value = self._mapping(node, loc)
        else:
            raise self._unknown_tag(node)
        self.open.discard(id(node))
        return value

    def _mapping(self, node: MappingNode, loc: Loc) -> dict[object, object]:
        values: dict[object, object] = {}
        for key, (key_node, value_node) in self._pairs(node).items():
            place = (*loc, key if isinstance(key, (str, int)) else str(key))
            self.source.keys[place] = _mark(key_node)
            values[key] = self.build(value_node, place)
            if isinstance(value_node, ScalarNode) and not _is_written(value_node):
                # The mark of a value that is not there lies wherever the next token begins.
                self.source.values[place] = self.source.keys[place]
        return values

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
            for key, pair in self._pairs(mapping).items():
                pairs.setdefault(key, pair)
            self.open.discard(id(mapping))
        return pairs

    def _scalar(self, node: ScalarNode) -> object:
        tag, text = _tag(node), str(node.value)
        kind = tag[len(_TAG) :] if tag.startswith(_TAG) else ""
        if kind == "null":
            return None
        if kind == "bool":
            return text.lower() in ("true", "yes", "on")
        if kind in ("int", "float"):
            try:
                return _integer(text) if kind == "int" else ExactFloat(_float(text), text)
            except ValueError:
                raise self.source.error(f"{text!r} is not a number", _mark(node)) from None
        # A date is text to a job, and so is the lone '=' that YAML 1.1 gave a meaning.
        if kind in ("str", "timestamp", "value", "merge"):
            return text
        raise self._unknown_tag(node)

    def _unknown_tag(self, node: Node) -> JobError:
        tag = _tag(node).replace(_TAG, "!!")
        return self.source.error(f"the YAML tag {tag} has no meaning in a job", _mark(node))


def _tag(node: Any) -> str:
    return str(node.tag)


def _is_written(node: ScalarNode) -> bool:
    return bool(node.value) or node.style is not None


def _mark(node: Any) -> Mark:
    return Mark(node.start_mark.line + 1, node.start_mark.column + 1)


def _mark_at(text: str, position: int) -> Mark:
    lines = _LINE_BREAK.split(text[:position])
    return Mark(len(lines), len(lines[-1]) + 1)


_ADVICE = {
    "mapping values are not allowed here": "check the indentation, or quote a text with ': ' in it",
    "expected <block end>": "check the indentation",
    "found character '\\t'": "indent with spaces, not tabs",
    "but found another document": "a job file holds one document, without '---' in between",
    "expected ',' or": "a bracket is not closed, or a comma is missing",
}
"""What to do about the parser's commonest complaints, by how they begin."""


def _syntax_error(source: YamlSource, error: Any) -> JobError:
    began, place = error.context_mark, error.problem_mark or error.context_mark
    mark = Mark(place.line + 1, place.column + 1) if place else Mark(1, 1)
    problem = str(error.problem or error.context)
    advice = next((text for start, text in _ADVICE.items() if problem.startswith(start)), None)
    message = f"not YAML: {problem}"
    if error.context and began and began.line + 1 < mark.line:
        if source.excerpt(mark):
            message += f", {error.context} that began in line {began.line + 1}"
        else:
            # The file ended; what was left open is what to look at.
            mark = Mark(began.line + 1, began.column + 1)
            message += f", {error.context} that begins here"
    return source.error(f"{message}; {advice}" if advice else message, mark)


def _integer(text: str) -> int:
    digits = text.replace("_", "")
    unsigned = digits.lstrip("+-")
    if unsigned[:2].lower() in ("0x", "0o", "0b"):
        return int(digits, 0)
    return int(digits)


def _float(text: str) -> float:
    return float(text.replace("_", "").lower().replace(".inf", "inf").replace(".nan", "nan"))
