"""Reads XML and YAML launch files without ROS's launch: nodes, groups, includes, conditions, …

The actions, their attributes and their order of effect are those of launch and launch_ros.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rsltrace.errors import JobError
from rsltrace.job.reading.yaml_source import Place
from rsltrace.launch.element import Attribute, Element
from rsltrace.launch.model import ENVIRONMENT, Argument, Launched, Unsupported
from rsltrace.launch.nodes import Nodes
from rsltrace.launch.scope import ParameterFile, Values, joined_namespace
from rsltrace.launch.substitution import Substitutions, truth
from rsltrace.launch.values import typed
from rsltrace.launch.xml_file import parse_xml
from rsltrace.launch.yaml_file import parse_launch_yaml

SIZE_MAX = 16 << 20
_INCLUDES_MAX = 50
_PYTHON = (
    "a Python launch file is a program of ROS's launch: source a ROS 2 installation "
    "(packages launch and launch_ros), or name the nodes in the job"
)


def read_launch_file(path: Path, arguments: Mapping[str, str]) -> Launched:
    """Return what an XML or YAML launch file starts, given ``name:=value`` arguments.

    :raises JobError: with file, line and column, if something in it is wrong or missing.
    """
    reader = Reader(dict(arguments))
    reader.include(path, None)
    return reader.launched


class Reader:
    """The state of reading: the values of the innermost group, the files that are open."""

    def __init__(self, arguments: dict[str, str]) -> None:
        self.launched = Launched()
        self.values = Values(configurations=arguments)
        self._environment = dict(self.values.environment)
        self._files: list[Path] = []
        self._substitutions = Substitutions(self.values, Path())
        self._nodes = Nodes(self)
        self._actions: dict[str, Callable[[Element], None]] = {
            "arg": self._arg,
            "let": self._let,
            "group": self._group,
            "include": self._include,
            "set_env": self._set_env,
            "append_env": self._append_env,
            "unset_env": self._unset_env,
            "reset_env": self._reset_env,
            "reset": self._reset,
            "push_ros_namespace": self._push_namespace,
            "push-ros-namespace": self._push_namespace,
            "set_parameter": self._set_parameter,
            "set_parameters_from_file": self._set_parameters_from_file,
            "set_use_sim_time": lambda element: element.check(["value"]),
            "set_remap": self._set_remap,
            "set_ros_log_dir": lambda element: None,
            "log": lambda element: None,
            "log_info": lambda element: None,
            "node": self._nodes.node,
            "lifecycle_node": self._nodes.node,
            "node_container": self._nodes.container,
            "load_composable_node": self._nodes.load,
            "executable": self._process,
            "timer": self._timer,
            "ros_timer": self._timer,
            "shutdown": lambda element: self.refuse(
                element, "shutdown", "a run ends by the job's stop: conditions"
            ),
        }

    # -- values ------------------------------------------------------------------------------------

    def text(self, attribute: Attribute) -> str:
        """Return an attribute as text. Raises ``JobError`` at its place."""
        value = attribute.value
        if isinstance(value, bool):
            value = str(value).lower()
        return self.replaced(str(value), attribute.place)

    def optional(self, element: Element, name: str) -> str | None:
        """Return an attribute as text, or None if it is not given."""
        attribute = element.get(name)
        return None if attribute is None else self.text(attribute)

    def needed(self, element: Element, name: str) -> str:
        """Return an attribute as text. Raises ``JobError`` if it is missing."""
        return self.text(element.need(name))

    def replaced(self, written: str, place: Place) -> str:
        """Return a text with its substitutions replaced."""
        try:
            return self._substitutions.text(written)
        except ValueError as error:
            raise place.error(str(error)) from None

    def value(self, attribute: Attribute, kind: str | None) -> Any:
        """Return an attribute as the value of a parameter."""
        value = attribute.value
        if isinstance(value, list):
            value = [
                self.replaced(item, attribute.place) if isinstance(item, str) else item
                for item in value
            ]
            if kind is None and all(isinstance(item, str) for item in value):
                found = [typed(item, None) for item in value]
                value = found if len({type(item) for item in found}) == 1 else value
        elif isinstance(value, str):
            value = self.replaced(value, attribute.place)
        try:
            return typed(value, kind)
        except ValueError as error:
            raise attribute.place.error(str(error)) from None

    def flag(self, attribute: Attribute | None, default: bool) -> bool:
        """Return an attribute that is true or false."""
        if attribute is None:
            return default
        try:
            return truth(self.text(attribute))
        except ValueError as error:
            raise attribute.place.error(str(error)) from None

    def holds(self, element: Element) -> bool:
        """Return whether an element's conditions hold."""
        yes, no = element.get("if"), element.get("unless")
        if yes is not None and no is not None:
            raise no.place.error("give either 'if' or 'unless', not both")
        return self.flag(yes, True) and not self.flag(no, False)

    def refuse(self, element: Element, what: str, why: str) -> None:
        """Note that something cannot be simulated."""
        where = element.place.source.where(element.place.mark)
        self.launched.unsupported.append(Unsupported(where, what, why))

    # -- files and groups --------------------------------------------------------------------------

    def include(self, path: Path, place: Place | None) -> None:
        """Read a launch file and do what it says."""
        path = Path(os.path.abspath(path))
        if len(self._files) >= _INCLUDES_MAX:
            raise _at(place, path, f"launch files include each other: {self._files[-1].name}")
        root = _parse(path, place)
        self._note_arguments(root)
        self._files.append(path)
        outer_file = self._substitutions.file
        self._substitutions.file = path
        root.check(["version"], None)
        self._children(root)
        self._substitutions.file = outer_file
        self._files.pop()

    def _note_arguments(self, element: Element) -> None:
        for child in element.children:
            if child.tag == "arg" and element.tag != "include" and child.get("name") is not None:
                name = str(child.need("name").value)
                default, about = child.get("default"), child.get("description")
                argument = Argument(
                    name,
                    None if default is None else str(default.value),
                    "" if about is None else str(about.value),
                )
                self.launched.arguments.setdefault(name, argument)
            self._note_arguments(child)

    def _children(self, element: Element, skip: tuple[str, ...] = ()) -> None:
        for child in element.children:
            if child.tag in skip:
                continue
            action = self._actions.get(child.tag)
            if action is None:
                raise child.place.error(_unknown_action(child.tag, self._actions))
            if self.holds(child):
                action(child)

    @contextmanager
    def _scope(self, values: Values) -> Iterator[None]:
        outer = self.values
        self.values = self._substitutions.values = values
        try:
            yield
        finally:
            self.values = self._substitutions.values = outer

    def _group(self, element: Element) -> None:
        element.check(["scoped", "forwarding"], None)
        keeps = {self.needed(k, "name"): self.needed(k, "value") for k in element.named("keep")}
        if not self.flag(element.get("scoped"), True):
            self._children(element, ("keep",))
            return
        values = self.values.copy()
        if not self.flag(element.get("forwarding"), True):
            values = Values(environment=dict(self._environment))
        values.configurations.update(keeps)
        with self._scope(values):
            self._children(element, ("keep",))

    def _include(self, element: Element) -> None:
        element.check(["file"], ["arg", "let"])
        file = self.needed(element, "file")
        for child in (*element.named("arg"), *element.named("let")):
            child.check(["name", "value"])
            name = self.needed(child, "name")
            self.values.configurations[name] = self.needed(child, "value")
        path = self._substitutions.file.parent / file
        if path.suffix == ".py":
            self.refuse(element, f"include of {path.name}", _PYTHON)
            return
        self.include(path, element.need("file").place)

    # -- arguments, environment, defaults ----------------------------------------------------------

    def _arg(self, element: Element) -> None:
        element.check(["name", "default", "description"], ["choice"])
        name = self.needed(element, "name")
        configurations = self.values.configurations
        if name not in configurations:
            default = self.optional(element, "default")
            if default is None:
                about = self.optional(element, "description")
                raise element.place.error(
                    f"the launch argument {name!r}{f' ({about})' if about else ''} is required: "
                    f"give {name}:=…{self._misspelt(name)}"
                )
            configurations[name] = default
        choices = [self.needed(choice, "value") for choice in element.named("choice")]
        if choices and configurations[name] not in choices:
            raise element.place.error(
                f"the launch argument {name!r} is {configurations[name]!r}, which is none of "
                f"{', '.join(map(repr, choices))}"
            )

    def _misspelt(self, name: str) -> str:
        given = [n for n in self.values.configurations if n not in self.launched.arguments]
        near = difflib.get_close_matches(name, given, n=1)
        return f" (there is a {near[0]!r})" if near else ""

    def _let(self, element: Element) -> None:
        element.check(["name", "value"])
        name = self.needed(element, "name")
        self.values.configurations[name] = self.needed(element, "value")

    def _set_env(self, element: Element) -> None:
        element.check(["name", "value"])
        name = self.needed(element, "name")
        self.values.environment[name] = self.needed(element, "value")
        self._note_environment(element, name)

    def _note_environment(self, element: Element, name: str) -> None:
        where = element.place.source.where(element.place.mark)
        self.launched.ignored.append(ENVIRONMENT.format(where=where, name=name))

    def _append_env(self, element: Element) -> None:
        element.check(["name", "value", "prepend", "separator"])
        name, value = self.needed(element, "name"), self.needed(element, "value")
        separator = self.optional(element, "separator") or os.pathsep
        old = self.values.environment.get(name)
        parts = [value] if old is None else [old, value]
        if self.flag(element.get("prepend"), False):
            parts.reverse()
        self.values.environment[name] = separator.join(parts)
        self._note_environment(element, name)

    def _unset_env(self, element: Element) -> None:
        element.check(["name"])
        name = self.needed(element, "name")
        self.values.environment.pop(name, None)
        self._note_environment(element, name)

    def _reset_env(self, element: Element) -> None:
        self.values.environment.clear()
        self.values.environment.update(self._environment)

    def _reset(self, element: Element) -> None:
        element.check([], ["keep"])
        keeps = {self.needed(k, "name"): self.needed(k, "value") for k in element.named("keep")}
        self.values.configurations.clear()
        self.values.configurations.update(keeps)

    def _push_namespace(self, element: Element) -> None:
        element.check(["namespace"])
        own = self.needed(element, "namespace")
        self.values.namespace = joined_namespace(self.values.namespace, own)

    def _set_parameter(self, element: Element) -> None:
        element.check(["name", "value", "type"])
        value = self.value(element.need("value"), self.optional(element, "type"))
        self.values.parameters += ({self.needed(element, "name"): value},)

    def _set_parameters_from_file(self, element: Element) -> None:
        element.check(["filename"])
        path = self.file(element.need("filename"))
        self.values.parameters += (ParameterFile(path),)

    def _set_remap(self, element: Element) -> None:
        element.check(["from", "to"])
        self.values.remappings += ((self.needed(element, "from"), self.needed(element, "to")),)

    def file(self, attribute: Attribute) -> str:
        """Return the path of a file that must be there; relative to the launch file's folder."""
        path = self._substitutions.file.parent / self.text(attribute)
        if not path.is_file():
            raise attribute.place.error(f"there is no such file: {path}")
        return str(path)

    # -- what cannot be simulated ------------------------------------------------------------------

    def _process(self, element: Element) -> None:
        command = element.get("cmd")
        what = "a process" if command is None else f"process {self.text(command)!r}"
        self.refuse(element, what, "other programs do not run in a simulation")

    def _timer(self, element: Element) -> None:
        period = self.optional(element, "period")
        tags = ", ".join(child.tag for child in element.children) or "nothing"
        self.refuse(
            element,
            f"timer of {period} s ({tags})",
            "a run has all its nodes from the start: move them out of the timer",
        )


def _parse(path: Path, place: Place | None) -> Element:
    name = os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise _at(place, path, f"there is no launch file {name}") from None
    except OSError as error:
        raise _at(place, path, f"cannot read {name}: {error.strerror}") from None
    if len(data) > SIZE_MAX:
        raise _at(place, path, f"larger than {SIZE_MAX >> 20} MiB: this is not a launch file")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise _at(place, path, f"{name} is not UTF-8 text") from None
    if path.suffix == ".py":
        raise _at(place, path, _PYTHON)
    if path.suffix == ".xml" or text.lstrip().startswith("<"):
        return parse_xml(text, name, str(path.parent))
    return parse_launch_yaml(text, name, str(path.parent))


def _at(place: Place | None, path: Path, message: str) -> JobError:
    return JobError(message, where=str(path)) if place is None else place.error(message)


def _unknown_action(tag: str, known: Mapping[str, object]) -> str:
    near = difflib.get_close_matches(tag, known, n=1)
    hint = f"did you mean <{near[0]}>?" if near else f"there are {', '.join(known)}"
    return f"unknown action <{tag}>; {hint}"
