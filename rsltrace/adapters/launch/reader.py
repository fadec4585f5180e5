"""Reads XML and YAML launch files without ROS's launch: nodes, groups, includes, conditions, …

The actions, their attributes and their order of effect are those of launch and launch_ros.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch.evaluation import Evaluation
from rsltrace.adapters.launch.model import (
    ENVIRONMENT,
    Argument,
    Attribute,
    Element,
    Launched,
    LaunchScope,
    ParameterFilePath,
    joined_namespace,
    not_a_launch_file,
)
from rsltrace.adapters.launch.nodes import Nodes
from rsltrace.adapters.launch.xml_file import parse_xml
from rsltrace.errors import JobError, nearest
from rsltrace.job.reading.yaml_source import Item, Place, parse_yaml
from rsltrace.job.values.times import ExactFloat, parse_time
from rsltrace.trace.model.regular_file import read_regular

# A YAML launch file as the same elements an XML one has.


def parse_launch_yaml(text: str, name: str, folder: str) -> Element:
    """Return the ``launch`` element. Raises ``JobError`` with the place of a mistake."""
    root = parse_yaml(text, name, folder=folder).root
    if root is None:
        raise not_a_launch_file(name, "the file is empty")
    if not isinstance(root.value, dict) or list(root.value) != ["launch"]:
        raise root.place.error("a YAML launch file has one key, 'launch', with a list below it")
    return _element("launch", root.value["launch"])


def _element(tag: str, item: Item) -> Element:
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


def _entities(item: Item) -> list[Element]:
    if not isinstance(item.value, list):
        raise item.place.error("expected a list of actions (- node: …)")
    found = []
    for one in item.value:
        if not isinstance(one.value, dict) or len(one.value) != 1:
            raise one.place.error("an action is a mapping with one key, its kind (- node: …)")
        ((tag, inner),) = one.value.items()
        found.append(_element(str(tag), inner))
    return found


def _is_list_of_mappings(item: Item) -> bool:
    return isinstance(item.value, list) and any(isinstance(one.value, dict) for one in item.value)


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if value is None:
        return ""
    return float(value) if isinstance(value, ExactFloat) else value


SIZE_MAX = 16 << 20
_INCLUDES_MAX = 50


def read_launch_file(path: Path, arguments: Mapping[str, str]) -> Launched:
    """Return what an XML or YAML launch file starts, given ``name:=value`` arguments.

    :raises JobError: with file, line and column, if something in it is wrong or missing.
    """
    reader = ActionReader(dict(arguments))
    reader.include(path, None)
    return reader.launched


class ActionReader(Evaluation):
    """Does the actions of launch files one by one; ``_files`` are those that are open.

    ``run`` does what a Python launch file says.
    """

    def __init__(
        self, arguments: dict[str, str], run: Callable[[Path], None] | None = None
    ) -> None:
        super().__init__(arguments)
        self._run = run
        self._files: list[Path] = []
        nodes = Nodes(self)
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
            "node": nodes.node,
            "lifecycle_node": nodes.node,
            "node_container": nodes.container,
            "load_composable_node": nodes.load,
            "executable": self._process,
            "timer": self._timer,
            "ros_timer": self._timer,
            "shutdown": self._shutdown,
        }

    # -- files and groups --------------------------------------------------------------------------

    def include(self, path: Path, place: Place | None) -> None:
        """Read a launch file and do what it says."""
        path = Path(os.path.abspath(path))
        if len(self._files) >= _INCLUDES_MAX:
            raise _at(place, path, f"launch files include each other: {self._files[-1].name}")
        if path.suffix == ".py":
            if self._run is None:
                raise ProgramNeededError
            _read(path, place)
            root = None
        else:
            root = _parse(path, place)
            self._note_arguments(root)
            root.check(["version"], None)
        self._files.append(path)
        try:
            with self.within(file=path):
                if root is not None:
                    self._children(root)
                elif self._run is not None:
                    self._run(path)
        finally:
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

    def _group(self, element: Element) -> None:
        element.check(["scoped", "forwarding"], None)
        keeps = {self.needed(k, "name"): self.needed(k, "value") for k in element.named("keep")}
        if not self.flag(element.get("scoped"), True):
            self._children(element, ("keep",))
            return
        scope = self.scope.copy()
        if not self.flag(element.get("forwarding"), True):
            scope = LaunchScope(environment=dict(self._environment))
        scope.configurations.update(keeps)
        with self.within(scope=scope):
            self._children(element, ("keep",))

    def _include(self, element: Element) -> None:
        element.check(["file"], ["arg", "let"])
        file = self.needed(element, "file")
        for child in (*element.named("arg"), *element.named("let")):
            child.check(["name", "value"])
            name = self.needed(child, "name")
            self.scope.configurations[name] = self.needed(child, "value")
        self.include(self.file.parent / file, element.need("file").place)

    def _timer(self, element: Element) -> None:
        element.check(["period"], None)
        attribute = element.need("period")
        period = self.text(attribute)
        try:
            period_ns = parse_time(float(period))
        except ValueError:
            raise attribute.place.error(
                f"the period of a timer is a number of seconds, not {period!r}"
            ) from None
        self.delay_ns += period_ns
        self._children(element)
        self.delay_ns -= period_ns

    # -- arguments, environment, defaults ----------------------------------------------------------

    def _arg(self, element: Element) -> None:
        element.check(["name", "default", "description"], ["choice"])
        name = self.needed(element, "name")
        configurations = self.scope.configurations
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
        given = [n for n in self.scope.configurations if n not in self.launched.arguments]
        near = nearest(name, given)
        return f" (there is a {near!r})" if near else ""

    def _let(self, element: Element) -> None:
        element.check(["name", "value"])
        name = self.needed(element, "name")
        self.scope.configurations[name] = self.needed(element, "value")

    def _set_env(self, element: Element) -> None:
        element.check(["name", "value"])
        name = self.needed(element, "name")
        self.scope.environment[name] = self.needed(element, "value")
        self._note_environment(element, name)

    def _note_environment(self, element: Element, name: str) -> None:
        where = element.place.source.where(element.place.mark)
        self.launched.ignored.append(ENVIRONMENT.format(where=where, name=name))

    def _append_env(self, element: Element) -> None:
        element.check(["name", "value", "prepend", "separator"])
        name, value = (
            self.needed(element, "name"),
            self.needed(element, "value"),
        )
        separator = self.optional(element, "separator") or os.pathsep
        old = self.scope.environment.get(name)
        parts = [value] if old is None else [old, value]
        if self.flag(element.get("prepend"), False):
            parts.reverse()
        self.scope.environment[name] = separator.join(parts)
        self._note_environment(element, name)

    def _unset_env(self, element: Element) -> None:
        element.check(["name"])
        name = self.needed(element, "name")
        self.scope.environment.pop(name, None)
        self._note_environment(element, name)

    def _reset_env(self, element: Element) -> None:
        self.scope.environment.clear()
        self.scope.environment.update(self._environment)

    def _reset(self, element: Element) -> None:
        element.check([], ["keep"])
        keeps = {self.needed(k, "name"): self.needed(k, "value") for k in element.named("keep")}
        self.scope.configurations.clear()
        self.scope.configurations.update(keeps)

    def _push_namespace(self, element: Element) -> None:
        element.check(["namespace"])
        own = self.needed(element, "namespace")
        self.scope.namespace = joined_namespace(self.scope.namespace, own) or "/"

    def _set_parameter(self, element: Element) -> None:
        element.check(["name", "value", "type"])
        value = self.value(element.need("value"), self.optional(element, "type"))
        self.scope.parameters += ({self.needed(element, "name"): value},)

    def _set_parameters_from_file(self, element: Element) -> None:
        element.check(["filename"])
        path = self.existing_file(element.need("filename"))
        self.scope.parameters += (ParameterFilePath(path),)

    def _set_remap(self, element: Element) -> None:
        element.check(["from", "to"])
        self.scope.remappings += ((self.needed(element, "from"), self.needed(element, "to")),)

    # -- what cannot be simulated ------------------------------------------------------------------

    def _shutdown(self, element: Element) -> None:
        self.refuse(element, "shutdown", "a run ends by the job's stop: conditions")

    def _process(self, element: Element) -> None:
        command = element.get("cmd")
        what = "a process" if command is None else f"process {self.text(command)!r}"
        self.refuse(element, what, "other programs do not run in a simulation")


class ProgramNeededError(Exception):
    """There is a Python launch file, and nobody to run it."""


def _parse(path: Path, place: Place | None) -> Element:
    name, text = _read(path, place)
    if path.suffix == ".xml" or text.lstrip().startswith("<"):
        return parse_xml(text, name, str(path.parent))
    return parse_launch_yaml(text, name, str(path.parent))


def _read(path: Path, place: Place | None) -> tuple[str, str]:
    """Return how to call a launch file in messages, and its text."""
    name = os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)
    try:
        data = read_regular(path, SIZE_MAX + 1)
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
    return name, text


def _at(place: Place | None, path: Path, message: str) -> JobError:
    return JobError(message, where=str(path)) if place is None else place.error(message)


def _unknown_action(tag: str, known: Mapping[str, object]) -> str:
    near = nearest(tag, known)
    hint = f"did you mean <{near}>?" if near else f"there are {', '.join(known)}"
    return f"unknown action <{tag}>; {hint}"
