"""Reads XML, YAML and Python launch files without ROS's launch."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from xml.parsers import expat

from rsltrace.adapters.launch.api.basics import (
    LaunchContext,
    LaunchDescription,
    as_job_error,
    shown,
)
from rsltrace.adapters.launch.frontend import launch_description
from rsltrace.adapters.launch.model import (
    Attribute,
    Element,
    LaunchResult,
    argument_words,
    not_a_launch_file,
)
from rsltrace.errors import JobError
from rsltrace.job.reading.yaml_source import (
    SourcePlace,
    TextPosition,
    YamlSource,
    YamlValue,
    parse_yaml,
)
from rsltrace.job.values.times import ExactFloat
from rsltrace.trace.model.regular_file import read_regular

# An XML launch file as elements with lines and columns (which ElementTree throws away).


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


# A YAML launch file as the same elements an XML one has.


def parse_launch_yaml(text: str, name: str, folder: str) -> Element:
    """Return the ``launch`` element. Raises ``JobError`` with the place of a mistake."""
    root = parse_yaml(text, name, folder=folder).root
    if root is None:
        raise not_a_launch_file(name, "the file is empty")
    if not isinstance(root.value, dict) or list(root.value) != ["launch"]:
        raise root.place.error("a YAML launch file has one key, 'launch', with a list below it")
    return _element("launch", root.value["launch"])


def _element(tag: str, item: YamlValue) -> Element:
    element = Element(tag, item.key_place or item.place)
    if isinstance(item.value, list):
        element.children = _entities(item)
        return element
    if not isinstance(item.value, dict):
        raise item.place.error(f"{tag!r} takes a mapping (name: value), not {item.plain()!r}")
    for key, inner in item.value.items():
        name = str(key)
        if name == "children":
            element.children += _entities(inner)
        elif _is_list_of_mappings(inner):
            element.children += [_element(name, one) for one in inner.value]
        elif isinstance(inner.value, dict):
            raise inner.place.error(f"{name!r} in {tag!r} takes a value or a list, not a mapping")
        else:
            place = inner.key_place or inner.place
            element.attributes[name] = Attribute(_plain(inner.plain()), place)
    return element


def _entities(item: YamlValue) -> list[Element]:
    if not isinstance(item.value, list):
        raise item.place.error("expected a list of actions (- node: …)")
    found = []
    for one in item.value:
        if not isinstance(one.value, dict) or len(one.value) != 1:
            raise one.place.error("an action is a mapping with one key, its kind (- node: …)")
        ((tag, inner),) = one.value.items()
        found.append(_element(str(tag), inner))
    return found


def _is_list_of_mappings(item: YamlValue) -> bool:
    return isinstance(item.value, list) and any(isinstance(one.value, dict) for one in item.value)


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if value is None:
        return ""
    return float(value) if isinstance(value, ExactFloat) else value


SIZE_MAX = 16 << 20
_INCLUDES_MAX = 50


class ProgramNeededError(BaseException):
    """There is a Python launch file, and it must not run here. No error of a launch file."""


def read_launch_file(path: Path, arguments: Mapping[str, str]) -> LaunchResult:
    """Return what an XML or YAML launch file starts, given ``name:=value`` arguments.

    :raises JobError: with file, line and column, if something in it is wrong or missing.
    :raises ProgramNeededError: if it, or one that it includes, is in Python.
    """
    return LaunchFileReader(arguments, None).read(path)


class LaunchFileReader:
    """Does the actions of launch files; ``_open`` are those being read.

    ``load_python`` returns the description of a Python launch file.
    """

    def __init__(
        self,
        arguments: Mapping[str, str],
        load_python: Callable[[LaunchContext, Path], LaunchDescription] | None,
    ) -> None:
        self.context = LaunchContext(argv=argument_words(arguments), arguments=arguments)
        self.context.include = self._include
        self._load_python = load_python
        self._open: list[Path] = []

    def read(self, path: Path) -> LaunchResult:
        """Read a file, then do what its event handlers bring."""
        self._include(path)
        later = self.context.later
        while later:
            try:
                later.pop(0)()
            except Exception as error:
                raise as_job_error(error, shown(str(path))) from error
        return self.context.launched

    def _include(self, path: Path) -> None:
        path = Path(os.path.abspath(path))
        if len(self._open) >= _INCLUDES_MAX:
            names = dict.fromkeys(one.name for one in (*self._open, path))
            raise JobError(f"launch files include each other: {', '.join(names)}")
        where = "" if self._open else str(path)  # an include knows its own place
        name, text = _read(path, where)
        with self.context.within(file=path):
            if path.suffix != ".py":
                is_xml = path.suffix == ".xml" or text.lstrip().startswith("<")
                parse = parse_xml if is_xml else parse_launch_yaml
                description = launch_description(parse(text, name, str(path.parent)))
            elif self._load_python is None:
                raise ProgramNeededError
            else:
                description = self._load_python(self.context, path)
            self._open.append(path)
            try:
                description.visit(self.context)
            except Exception as error:
                raise as_job_error(error, shown(str(path))) from error
            finally:
                self._open.pop()


def shown_path(path: Path) -> str:
    return os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)


def _read(path: Path, where: str) -> tuple[str, str]:
    """Return how to call a launch file in messages, and its text."""
    name = shown_path(path)
    try:
        data = read_regular(path, SIZE_MAX + 1)
    except FileNotFoundError:
        raise JobError(f"there is no launch file {name}", where=where) from None
    except OSError as error:
        raise JobError(f"cannot read {name}: {error.strerror}", where=where) from None
    if len(data) > SIZE_MAX:
        raise JobError(
            f"{name} is larger than {SIZE_MAX >> 20} MiB: this is not a launch file", where=where
        )
    try:
        return name, data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise JobError(f"{name} is not UTF-8 text", where=where) from None
