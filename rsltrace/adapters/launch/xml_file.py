"""An XML launch file as elements with lines and columns (which ElementTree throws away)."""

from __future__ import annotations

from typing import Any
from xml.parsers import expat

from rsltrace.adapters.launch.model import Attribute, Element, not_a_launch_file
from rsltrace.errors import JobError
from rsltrace.job.reading.yaml_source import SourcePlace, TextPosition, YamlSource

_DEPTH_MAX = 100


def parse_xml(text: str, name: str, folder: str) -> Element:
    """Return the ``<launch>`` element. Raises ``JobError`` with the place of a mistake."""
    reader = _XmlReader(YamlSource(name, text, folder))
    root = reader.read()
    if root.tag != "launch":
        raise root.place.error(f"a launch file begins with <launch>, not with <{root.tag}>")
    return root


class _XmlReader:
    def __init__(self, source: YamlSource) -> None:
        self._source = source
        self._parser = parser = expat.ParserCreate("utf-8")
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._text
        parser.StartDoctypeDeclHandler = self._doctype
        self._open: list[Element] = []
        self._root: Element | None = None

    def read(self) -> Element:
        try:
            self._parser.Parse(self._source.text.encode(), True)
        except expat.ExpatError as error:
            mark = TextPosition(error.lineno, error.offset + 1)
            said = expat.ErrorString(error.code)
            raise self._source.error(f"not XML: {said}", mark) from None
        if self._root is None:
            raise not_a_launch_file(self._source.name, "the file is empty")
        return self._root

    def _place(self) -> SourcePlace:
        parser = self._parser
        return SourcePlace(
            self._source, TextPosition(parser.CurrentLineNumber, parser.CurrentColumnNumber + 1)
        )

    def _start(self, tag: str, values: dict[str, str]) -> None:
        place = self._place()
        element = Element(tag, place)
        for name, value in values.items():
            separator = values.get(f"{name}-sep")
            if name.endswith("-sep") and name[:-4] in values:
                continue
            given: Any = value if separator is None else value.split(separator)
            element.attributes[name] = Attribute(given, self._attribute_place(place, name))
        if len(self._open) >= _DEPTH_MAX:
            raise place.error(f"elements are nested more than {_DEPTH_MAX} deep")
        if self._open:
            self._open[-1].children.append(element)
        else:
            self._root = element
        self._open.append(element)

    def _attribute_place(self, start: SourcePlace, name: str) -> SourcePlace:
        """Return where an attribute stands: expat tells only where its element begins."""
        lines = self._source.text.split("\n")
        line, column = start.mark.line, start.mark.column - 1
        while line <= len(lines) and line < start.mark.line + 50:
            text = lines[line - 1]
            for before in (" ", "\t", ""):
                at = text.find(f"{before}{name}=", column)
                if at >= 0 and (before or at == 0):
                    return SourcePlace(self._source, TextPosition(line, at + len(before) + 1))
            line, column = line + 1, 0
        return start

    def _end(self, tag: str) -> None:
        self._open.pop()

    def _text(self, text: str) -> None:
        if text.strip():
            raise self._place().error(
                f"text {text.strip()[:40]!r} between elements means nothing in a launch file"
            )

    def _doctype(self, *declaration: object) -> None:
        raise JobError(
            "a launch file has no <!DOCTYPE>: entities are not expanded", where=self._source.name
        )
