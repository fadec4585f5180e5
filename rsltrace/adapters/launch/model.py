"""What reading a launch file gives: nodes to simulate, and what cannot be simulated."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import field, replace
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import YAMLError

from rsltrace.errors import JobError, did_you_mean
from rsltrace.fast_dataclass import dataclass
from rsltrace.job.reading.yaml_source import SourcePlace
from rsltrace.trace.model.operation import nested_too_deep
from rsltrace.trace.model.texts import printable, yaml_problem

# What a launch file can see while it is read: arguments, environment, namespace, defaults.


@dataclass(frozen=True, slots=True)
class ParameterFilePath:
    """A file of parameters (absolute), at its place among a node's parameters."""

    path: str


Parameters = tuple["ParameterFilePath | dict[str, Any]", ...]
"""Files and mappings in order; what comes later has the last word."""


@dataclass(slots=True)
class LaunchScope:
    """What one group can see; ``copy`` gives an inner group its own."""

    configurations: dict[str, str] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=lambda: dict(os.environ))
    namespace: str = ""
    parameters: Parameters = ()
    remappings: tuple[tuple[str, str], ...] = ()

    def copy(self) -> LaunchScope:
        """Return a copy that can be changed without changing this."""
        return replace(
            self, configurations=dict(self.configurations), environment=dict(self.environment)
        )


def absolute_namespace(base: str, own: str | None) -> str | None:
    """Return the namespace of a node below another one; None if there is neither. An empty one
    is the root, if there is no other."""
    namespace = joined_namespace(base, own)
    if namespace and not namespace.startswith("/"):
        namespace = f"/{namespace}"
    return namespace or (None if own is None else "/")


def full_name(namespace: str | None, name: str) -> str:
    """Return the name of a node with its namespace; a name that is a path already stands alone."""
    return name if name.startswith("/") else f"{(namespace or '').rstrip('/')}/{name}"


def joined_namespace(base: str, own: str | None) -> str:
    """Return a namespace below another one, as launch joins them; absolute ones stand alone."""
    if own is None or own == "":
        return base
    if own.startswith("/"):
        return "/" + own.strip("/")
    return f"{base.rstrip('/')}/{own.strip('/')}"


# Values of parameters in launch files: what a text or a typed YAML value becomes.


class _LaunchYamlConstructor(SafeConstructor):
    """Reads what ROS's launch writes, too: it has tuples where a file has lists.

    Names are text, even if they are ``n`` or ``on``.
    """

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:bool":
                key.tag = "tag:yaml.org,2002:str"
        return super().construct_mapping(node, deep)


_LaunchYamlConstructor.add_constructor(
    "tag:yaml.org,2002:python/tuple",
    lambda constructor, node: constructor.construct_sequence(node, deep=True),
)


def yaml_value(text: str) -> Any:
    """Return what YAML 1.1 (that of ROS) reads, or the text itself where it is not YAML."""
    if nested_too_deep(text) >= 0:
        return text
    try:
        return _yaml().load(text)
    except (YAMLError, ValueError):
        return text


def yaml_mistake(text: str) -> str:
    """Return why a text is not YAML, ``""`` if it is."""
    if nested_too_deep(text) >= 0:
        return "brackets are nested too deeply"
    try:
        _yaml().load(text)
    except (YAMLError, ValueError) as error:
        return yaml_problem(error)
    return ""


def _yaml() -> YAML:
    yaml = YAML(typ="safe", pure=True)
    yaml.Constructor = _LaunchYamlConstructor
    yaml.version = (1, 1)
    return yaml


def inferred(text: str) -> Any:
    """Return a number, a truth value or a list if the text is one, else the text."""
    value = yaml_value(text)
    if isinstance(value, list) and value and all(isinstance(v, type(value[0])) for v in value):
        return value if isinstance(value[0], (bool, int, float, str)) else text
    return value if isinstance(value, (bool, int, float)) else text


def typed(value: Any, kind: str | None) -> Any:
    """Return ``value`` as ``kind`` (``int``, ``list_of_str``, …; None: as it looks).

    :raises ValueError: if it is none, or there is no such kind.
    """
    if kind is None:
        return inferred(value) if isinstance(value, str) else value
    if kind == "yaml":
        return yaml_value(value) if isinstance(value, str) else value
    if kind.startswith("list_of_"):
        items = yaml_value(value) if isinstance(value, str) else value
        if not isinstance(items, list):
            raise ValueError(f"expected a list ([a, b]), got {value!r}")
        return [_one(item, kind.removeprefix("list_of_")) for item in items]
    return _one(value, kind)


def _one(value: Any, kind: str) -> Any:
    if kind == "str":
        return value if isinstance(value, str) else str(value)
    found = yaml_value(value) if isinstance(value, str) else value
    if kind == "bool" and isinstance(found, bool):
        return found
    if kind == "int" and isinstance(found, int) and not isinstance(found, bool):
        return found
    if kind == "float" and isinstance(found, (int, float)) and not isinstance(found, bool):
        return float(found)
    if kind not in ("bool", "int", "float"):
        raise ValueError(
            f"unknown type {kind!r}: there are bool, int, float, str, yaml and list_of_ these"
        )
    raise ValueError(f"expected {kind}, got {value!r}")


_TRUE, _FALSE = ("true", "1"), ("false", "0")


def truth(text: str) -> bool:
    """Return a condition's value, as launch reads it.

    :raises ValueError: if it is none of true, 1, false, 0.
    """
    word = text.strip().lower()
    if word not in (*_TRUE, *_FALSE):
        raise ValueError(f"expected true, 1, false or 0, got {text!r}")
    return word in _TRUE


def equal_texts(a: str, b: str) -> bool:
    """Return whether two texts are equal as launch compares them: truth values, numbers, text."""
    words = a.lower(), b.lower()
    if all(word in (*_TRUE, *_FALSE) for word in words):
        return (words[0] in _TRUE) == (words[1] in _TRUE)
    try:
        return math.isclose(float(a), float(b))
    except ValueError:
        return a == b


# The tree that XML and YAML launch files have in common, every part with its place.

Scalar = str | int | float | bool


@dataclass(frozen=True)
class Attribute:
    """A value as written: text (with substitutions in it), or a typed value or list of YAML."""

    value: Any
    place: SourcePlace


@dataclass(eq=False)
class Element:
    """One tag of a launch file."""

    tag: str
    place: SourcePlace
    attributes: dict[str, Attribute] = field(default_factory=dict)
    children: list[Element] = field(default_factory=list)

    def get(self, name: str) -> Attribute | None:
        """Return an attribute, or None if it is not given."""
        return self.attributes.get(name)

    def need(self, name: str) -> Attribute:
        """Return an attribute. Raises ``JobError`` if it is missing."""
        found = self.attributes.get(name)
        if found is None:
            raise self.place.error(f"<{self.tag}> needs the attribute '{name}'")
        return found

    def named(self, tag: str) -> list[Element]:
        return [child for child in self.children if child.tag == tag]

    def check(self, attributes: Iterable[str], children: Iterable[str] | None = ()) -> None:
        """Raise ``JobError`` at anything else in it; ``children`` None: any."""
        allowed = [*attributes, "if", "unless"]
        for name, attribute in self.attributes.items():
            if name not in allowed:
                raise attribute.place.error(_unknown("attribute", name, self.tag, allowed))
        if children is None:
            return
        tags = list(children)
        for child in self.children:
            if child.tag not in tags:
                raise child.place.error(_unknown("element", child.tag, self.tag, tags))


def _unknown(what: str, name: str, tag: str, known: list[str]) -> str:
    there = f"there are {', '.join(known)}" if known else "it has none"
    return f"unknown {what} {name!r} in <{tag}>; {did_you_mean(name, known, there)}"


def not_a_launch_file(name: str, why: str) -> JobError:
    return JobError(f"{why}; a launch file is <launch>…</launch> or 'launch: [...]'", where=name)


ENVIRONMENT = (
    "{where}: environment variable {name}: it counts for the launch file and for processes; nodes "
    "in rsltrace's process see the environment that it was started with"
)


@dataclass(frozen=True, slots=True)
class ProcessSettings:
    """What a launch file says of the process of a node: where it runs, and when again.

    ``environment`` is what differs from that of the launch file; ``own`` names what of these is
    said for the process alone, ``without`` what processes of nodes are not given here
    (``launch-prefix``).
    ``respawn`` is how much later (ns) it starts again, and how often at most.
    """

    environment: tuple[tuple[str, str], ...] = ()
    folder: str = ""
    respawn: tuple[int, int | None] | None = None
    own: tuple[str, ...] = ()
    without: tuple[str, ...] = ()


def respawning(delay_s: float, times: int) -> tuple[int, int | None] | None:
    """Return ``ProcessSettings.respawn`` as launch files say it; negative ``times``: no limit."""
    return None if times == 0 else (round(max(delay_s, 0) * 1e9), None if times < 0 else times)


@dataclass(frozen=True, slots=True)
class LaunchedNode:
    """A node, or another program, that a launch file starts.

    ``executable`` is that of ``package``; another program has a ``command`` instead. A component
    has a ``plugin``, and the full name of a ``container`` that loads it. ``name`` and
    ``namespace`` are None where the launch file leaves them to the node. ``where`` is
    ``file:line:column``, as far as it is known. It starts ``delay_ns`` after the launch file
    (``<timer>``); or, if there is an ``after``, after the node with that ``number`` has ``started``
    or ``ended``. ``fault`` is what is wrong with it, should it not be left out.
    """

    where: str
    package: str = ""
    executable: str = ""
    command: tuple[str, ...] = ()
    plugin: str = ""
    name: str | None = None
    namespace: str | None = None
    parameters: Parameters = ()
    remappings: tuple[tuple[str, str], ...] = ()
    arguments: tuple[str, ...] = ()
    ros_arguments: tuple[str, ...] = ()
    delay_ns: int = 0
    after: tuple[str, int] | None = None
    number: int = 0
    fault: str = ""
    surroundings: ProcessSettings = ProcessSettings()
    is_container: bool = False
    container: str = ""
    extra_arguments: Parameters = ()

    @property
    def is_program(self) -> bool:
        """Whether it is no node of a package, but another program."""
        return not self.package

    @property
    def full_name(self) -> str:
        """Its name with its namespace, as far as the launch file says it."""
        return full_name(self.namespace, self.name or "")

    @property
    def title(self) -> str:
        """How to call it in a message."""
        if self.is_program:
            return f"process {' '.join(self.command)!r:.200}" if self.command else "a process"
        what = f"{self.package}/{self.executable or self.plugin}"
        return printable(f"{what} ({self.name})" if self.name else what)


@dataclass(frozen=True, slots=True)
class UnsupportedItem:
    """Something in a launch file that cannot be simulated, and why."""

    where: str
    what: str
    why: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}: {self.why}"


@dataclass(frozen=True, slots=True)
class LaunchArgument:
    """A declared launch argument; ``default`` is as written, None for a required one."""

    name: str
    default: str | None = None
    description: str = ""

    def __str__(self) -> str:
        value = "required" if self.default is None else f"default {self.default!r}"
        return f"{self.name} ({value}{', ' + self.description if self.description else ''})"


def argument_words(arguments: Mapping[str, str]) -> list[str]:
    """Return launch arguments as words of a command line: launch files look at these, too."""
    return [f"{name}:={value}" for name, value in arguments.items()]


@dataclass(slots=True)
class LaunchResult:
    """All of a launch file. ``ignored`` is what has no meaning in a simulation, for information.
    Where a node of which ``required`` has the number ends, everything does."""

    nodes: list[LaunchedNode] = field(default_factory=list)
    unsupported: list[UnsupportedItem] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)
    arguments: dict[str, LaunchArgument] = field(default_factory=dict)
    required: set[int] = field(default_factory=set)
