"""One entry of ``nodes:``: what to construct, and how it is named, configured and connected."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.guard import GuardSpec, guard_part
from rsltrace.job.parts.launch import StartAfterSpec
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.parts.process import InputSpec, RespawnSpec, check_environment, inputs
from rsltrace.job.values.checks import (
    Target,
    attach,
    check,
    check_callable_target,
    flag,
    items,
    one_of,
    part,
    target_text,
    text,
)
from rsltrace.job.values.mappings import check_arguments, check_path, check_remappings
from rsltrace.job.values.names import (
    check_component,
    check_container,
    check_executable,
    check_module,
    check_namespace,
    check_node_name,
)
from rsltrace.job.values.problem import JobProblem, JobProblems, Loc, describe
from rsltrace.job.values.times import TimeLike

Scalar = bool | int | float | str
ParameterValue = Scalar | tuple[bool, ...] | tuple[int, ...] | tuple[float, ...] | tuple[str, ...]
"""A parameter's value. Lists are tuples, so that a job stays the same once it is built."""

INTEGER_MIN = -(2**63)
INTEGER_MAX = 2**63 - 1

_PARAMETER_KINDS = ((bool, "bool"), (int, "integer"), (float, "float"), (str, "text"))


def flatten_parameters(values: object) -> dict[str, ParameterValue]:
    """Return ``{"nested.a": 1}`` for ``{"nested": {"a": 1}}``.

    Raises ``JobProblems`` with the place of each value that is not a ROS parameter value.
    """
    if not isinstance(values, dict):
        raise JobProblem(f"expected a mapping of parameter names to values, got {describe(values)}")
    flat: dict[str, ParameterValue] = {}
    problems: list[JobProblem] = []
    for name, loc, value in _leaves(values, "", (), problems):
        try:
            if name in flat:
                raise JobProblem(f"the parameter {name!r} is given twice", loc, at_key=True)
            flat[name] = _value(value, loc)
        except JobProblem as problem:
            problems.append(problem)
    if problems:
        raise JobProblems(problems)
    return flat


def _leaves(
    values: dict[object, object], prefix: str, loc: Loc, problems: list[JobProblem]
) -> Iterator[tuple[str, Loc, object]]:
    for key, value in values.items():
        place = (*loc, key if isinstance(key, (str, int)) else str(key))
        if not isinstance(key, str):
            problems.append(
                JobProblem(f"a parameter's name is text, got {describe(key)}", place, at_key=True)
            )
        elif key == "ros__parameters":
            problems.append(
                JobProblem(
                    "this looks like a ROS parameter file: list it in parameter_files, or put the "
                    "values directly below 'parameters'",
                    place,
                    at_key=True,
                )
            )
        elif not all(key.split(".")):
            # Names are otherwise free: qos_overrides./scan.publisher.depth is one.
            problems.append(
                JobProblem(
                    f"{key!r} is not a parameter name: a part before or after a '.' is empty",
                    place,
                    at_key=True,
                )
            )
        elif isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.", place, problems)
        else:
            yield f"{prefix}{key}", place, value


def _value(value: object, loc: Loc) -> ParameterValue:
    if isinstance(value, (list, tuple)):
        return _list(value, loc)
    return _scalar(value, loc)


def _list(values: list[object] | tuple[object, ...], loc: Loc) -> ParameterValue:
    elements = tuple(_scalar(value, (*loc, index)) for index, value in enumerate(values))
    for index, element in enumerate(elements):
        first = _kind(elements[0])
        if _kind(element) != first:
            hint = ""
            if {first, _kind(element)} == {"integer", "float"}:
                hint = "; write the integers with a decimal point"
            raise JobProblem(
                f"element {index} is {_with_article(_kind(element))}, element 0 is "
                f"{_with_article(first)}: rcl takes lists of one type{hint}",
                (*loc, index),
            )
    return elements  # type: ignore[return-value]  # one type, checked above


def _scalar(value: object, loc: Loc) -> Scalar:
    if isinstance(value, bool):
        return value
    if isinstance(value, int):
        if not INTEGER_MIN <= value <= INTEGER_MAX:
            raise JobProblem(f"{value} does not fit a ROS integer (64 bits, signed)", loc)
        return int(value)
    if isinstance(value, float):
        return float(value)
    if isinstance(value, str):
        return str(value)
    if value is None:
        raise JobProblem("no value is given, and a ROS parameter cannot be null", loc)
    raise JobProblem(
        f"a ROS parameter is true or false, a number, text, or a list of these; got "
        f"{describe(value)}",
        loc,
    )


def _kind(value: object) -> str:
    return next(name for kind, name in _PARAMETER_KINDS if isinstance(value, kind))


def _with_article(kind: str) -> str:
    return {"integer": "an integer", "text": "text"}.get(kind, f"a {kind}")


_KINDS = ("node", "main", "executable", "script", "module", "program", "component")
"""What an entry may be."""
_ONE_OF = f"{', '.join(map(repr, _KINDS[:-1]))} and {_KINDS[-1]!r}"
_WITH_WORDS = ", ".join(f"'{kind}'" for kind in _KINDS[1:-1])


_ONLY_A_PROCESS = {
    "environment": "only a process has an environment of its own: 'program', or 'isolated: true'",
    "working_directory": "only a process has a folder of its own: 'program', or 'isolated: true'",
    "respawn": "only a process is started again: 'program', or 'isolated: true'",
    "instant_sleep": "only a process can sleep in no time: 'program', or 'isolated: true'",
    "intra_process": "only of a process would messages not be seen: 'program', or 'isolated: true'",
}
_RARE = (
    *("start_after", "stdin", "isolated", "environment", "working_directory", "respawn"),
    *("instant_sleep", "intra_process", "required", "container", "extra_arguments"),
)
"""Keys that are written down only where they say something."""

attach(
    flatten_parameters,
    schema={
        "type": "object",
        "propertyNames": {"not": {"const": "ros__parameters"}},
        "additionalProperties": {"$ref": "#/$defs/Parameter"},
    },
)


class NodeSpec(JobPart):
    """One entry of ``nodes:``: one of ``node``, ``main``, ``executable``, ``script``, ``module``,
    ``program``, ``component``.

    ``node`` is a Node subclass or a function returning a node or a list of nodes, ``main`` a
    function that initializes rclpy, makes nodes and spins, ``executable`` (``package/name``) an
    installed one, ``script`` a file to run as ``python script.py`` does, ``module`` one to run as
    ``python -m module`` does, ``program`` a file to run as a process, ``component`` what a
    ``container`` among the nodes is asked to load. ``arguments`` are keyword arguments of a
    ``node``, and command-line words (a list) of the others. ``parameters`` are flat (dotted names);
    paths are relative to the job's folder.
    """

    ONE_OF: ClassVar[tuple[str, ...]] = _KINDS

    @staticmethod
    def meant_key(word: str) -> str:
        """Return the key that text in place of an entry was meant for."""
        if word.endswith(".py"):
            return "script"
        return "executable" if "/" in word and ":" not in word else "node"

    node: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="A Node subclass or a function that returns nodes: `module:Class` or "
        "`folder/file.py:Class`.",
        examples=["my_robot.ekf:EkfNode"],
    )
    main: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="A function that initializes rclpy, makes nodes and spins.",
        examples=["my_robot.talker:main"],
    )
    executable: Annotated[str | None, check(text(check_executable), optional=True)] = Field(
        default=None,
        description="An executable: `package/name`, as for `ros2 run`.",
        examples=["demo_nodes_py/talker"],
    )
    script: Annotated[str | None, check(check_path, optional=True)] = Field(
        default=None,
        description="A Python file.",
        examples=["scripts/talker.py"],
    )
    module: Annotated[str | None, check(text(check_module), optional=True)] = Field(
        default=None,
        description="A module, run as `python -m` does.",
        examples=["my_robot.talker"],
    )
    program: Annotated[str | None, check(check_path, optional=True)] = Field(
        default=None,
        description="An executable file (C, C++), run in its own process.",
        examples=["build/talker"],
    )
    component: Annotated[str | None, check(text(check_component), optional=True)] = Field(
        default=None,
        description="A component, `package/plugin`, which a `container` loads.",
        examples=["image_proc/image_proc::RectifyNode"],
    )
    container: Annotated[str | None, check(text(check_container), optional=True)] = Field(
        default=None,
        description="Full name of the node that loads a `component`.",
        examples=["/camera/container"],
    )
    extra_arguments: Annotated[dict[str, ParameterValue], check(flatten_parameters)] = Field(
        default_factory=dict,
        description="Extra arguments of a `component`.",
        examples=[{"use_intra_process_comms": True}],
    )
    isolated: Annotated[bool, check(flag)] = Field(
        default=False,
        description="Whether an `executable`, `script` or `module` runs in its own process.",
        examples=[True],
    )
    environment: Annotated[dict[str, str], check(check_environment)] = Field(
        default_factory=dict,
        description="Additional environment variables of a process.",
        examples=[{"RCUTILS_LOGGING_USE_STDOUT": "1"}],
    )
    working_directory: Annotated[str | None, check(check_path, optional=True)] = Field(
        default=None,
        description="Working directory of a process.",
        examples=["data"],
    )
    respawn: Annotated[RespawnSpec | None, part("delay")] = Field(
        default=None,
        description="Delay after which an ended process starts again.",
        examples=["1s", {"delay": "500ms", "times": 3}],
    )
    instant_sleep: Annotated[bool, check(flag)] = Field(
        default=False,
        description="Whether `sleep`, `nanosleep`, `std::this_thread::sleep_for` and the like take "
        "no simulated time in a process.",
        examples=[True],
    )
    intra_process: Annotated[bool, check(flag)] = Field(
        default=False,
        description="Whether nodes of a process may use intra-process communication (off by "
        "default), whose messages are in no trace.",
        examples=[True],
    )
    required: Annotated[bool, check(flag)] = Field(
        default=False,
        description="Whether the run ends with this entry. Not for a `node`.",
        examples=[True],
    )
    name: Annotated[str | None, check(text(check_node_name), optional=True)] = Field(
        default=None,
        description="Name of the node, replacing its own.",
        examples=["ekf"],
    )
    namespace: Annotated[str | None, check(text(check_namespace), optional=True)] = Field(
        default=None, description="Namespace of the node.", examples=["/robot1"]
    )
    parameters: Annotated[dict[str, ParameterValue], check(flatten_parameters)] = Field(
        default_factory=dict,
        description="ROS parameters, overriding `parameter_files`. `a: {b: 1}` is the same as "
        "`a.b: 1`. An empty list is declared but not set.",
        examples=[{"frequency": 50.0, "noise": {"x": 0.1, "y": 0.1}}],
    )
    parameter_files: Annotated[tuple[str, ...], check(items(check_path))] = Field(
        default=(),
        description="ROS parameter files; later ones override earlier ones.",
        examples=[["ekf.yaml"]],
    )
    remappings: Annotated[dict[str, str], check(check_remappings)] = Field(
        default_factory=dict,
        description="Remapped topics and services.",
        examples=[{"odom": "/husky/odom"}],
    )
    arguments: Annotated[dict[str, Any] | tuple[str, ...], check(check_arguments)] = Field(
        default_factory=dict,
        description="Keyword arguments of a `node`; else a list of command-line arguments.",
        examples=[{"robots": 3}, ["--rate", 10]],
    )
    on_exception: Annotated[Literal["stop", "log"], check(one_of("stop", "log"))] = Field(
        default="stop",
        description="What an exception in a callback does: `stop` ends the run with status "
        "3, `log` continues. An exception in a constructor always ends the run.",
        examples=["log"],
    )
    guard: Annotated[GuardSpec | None, guard_part] = Field(
        default=None,
        description="Guard settings of this node that differ from the job's.",
        examples=[{"random": "allow"}],
    )
    start_after: Annotated[StartAfterSpec | None, part("delay")] = Field(
        default=None,
        description="When the entry starts: after a time, a topic, service, node or entry.",
        examples=["2s", {"service": "/set_mode"}, {"ended": "my_robot/calibrate", "delay": "1s"}],
    )
    stdin: Annotated[tuple[InputSpec, ...] | None, inputs] = Field(
        default=None,
        description="Terminal input: a text file or a list. Not for a `node`.",
        examples=["answers.txt", ["start", {"at": "2s", "keys": "wwq"}]],
    )
    # Not a key of a job file: where the entry came from, if not from the job itself.
    origin: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None, exclude=True, repr=False
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            node: Target | None = None,
            main: Target | None = None,
            executable: str | None = None,
            script: str | os.PathLike[str] | None = None,
            module: str | None = None,
            program: str | os.PathLike[str] | None = None,
            isolated: bool = False,
            component: str | None = None,
            container: str | None = None,
            extra_arguments: dict[str, Any] = ...,
            environment: dict[str, str] = ...,
            working_directory: str | os.PathLike[str] | None = None,
            respawn: RespawnSpec | dict[str, Any] | TimeLike | None = None,
            instant_sleep: bool = False,
            intra_process: bool = False,
            required: bool = False,
            name: str | None = None,
            namespace: str | None = None,
            parameters: dict[str, Any] = ...,
            parameter_files: list[str | os.PathLike[str]] | tuple[str | os.PathLike[str], ...] = (),
            remappings: dict[str, str] = ...,
            arguments: dict[str, Any] | Sequence[str] = ...,
            on_exception: Literal["stop", "log"] = "stop",
            start_after: StartAfterSpec | dict[str, Any] | TimeLike | None = None,
            stdin: str | Sequence[InputSpec | dict[str, Any] | str] | None = None,
            origin: str | None = None,
            guard: GuardSpec | dict[str, Any] | bool | None = None,
        ) -> None: ...

    @after_fields
    def _check_kind(self) -> None:
        kinds = [name for name in _KINDS if getattr(self, name) is not None]
        if not kinds:
            raise JobProblem(f"missing key: give one of {_ONE_OF}")
        if len(kinds) > 1:
            raise JobProblem(
                f"'{kinds[0]}' says what to run already: give only one of {_ONE_OF}",
                (kinds[1],),
                at_key=True,
            )
        if self.guard is not None and self.guard.pin is not None:
            raise JobProblem(
                "'pin' is for the process that all nodes share: write it in the job's own 'guard:'",
                ("guard", "pin"),
            )
        if self.node is not None and isinstance(self.arguments, tuple):
            raise JobProblem(
                "a node takes arguments by name (a mapping); a list of command-line words is for "
                f"{_WITH_WORDS}",
                ("arguments",),
            )
        if self.node is not None and self.stdin is not None:
            raise JobProblem(
                "a 'node' has no terminal of its own, all of them are in one process: give a "
                f"function that spins it as {_WITH_WORDS}",
                ("stdin",),
                at_key=True,
            )
        self._check_process(kinds[0])
        self._check_loading(kinds[0])
        if self.node is None and isinstance(self.arguments, dict) and self.arguments:
            raise JobProblem(
                f"'{kinds[0]}' takes a list of command-line words: arguments: [--rate, 10]",
                ("arguments",),
            )

    def _check_process(self, kind: str) -> None:
        if self.isolated and kind in ("node", "main", "component"):
            raise JobProblem(
                f"a '{kind}' is a part of a program: name what runs it as 'script', 'module' or "
                "'executable' to have it in a process of its own",
                ("isolated",),
            )
        if self.is_process and self.stdin is not None:
            raise JobProblem("a process has no terminal in a run", ("stdin",), at_key=True)
        if self.is_process and self.guard is not None:
            raise JobProblem(
                "the guard is for Python code in the process of the run", ("guard",), at_key=True
            )
        for key in _ONLY_A_PROCESS:
            if getattr(self, key) and not (self.is_process or kind == "executable"):
                raise JobProblem(_ONLY_A_PROCESS[key], (key,), at_key=True)
        if self.required and kind in ("node", "component"):
            raise JobProblem(
                f"a '{kind}' lasts as long as the run: only a program ends", ("required",)
            )

    def _check_loading(self, kind: str) -> None:
        if kind != "component":
            for key in ("container", "extra_arguments"):
                if getattr(self, key):
                    raise JobProblem(f"only a 'component' has '{key}:'", (key,), at_key=True)
            return
        if self.container is None:
            raise JobProblem("say which 'container:' loads the component, by its name: /container")
        for key, instead in (
            ("arguments", "a component takes 'parameters:' and 'extra_arguments:'"),
            ("stdin", "a component has no terminal in a run"),
            ("guard", "the guard is for Python code in the process of the run"),
        ):
            if getattr(self, key):
                raise JobProblem(instead, (key,), at_key=True)

    @property
    def is_process(self) -> bool:
        """Whether the entry says that it is a process (a compiled ``executable`` is one, too)."""
        return self.isolated or self.program is not None

    @property
    def kind(self) -> str:
        """Which of ``node``, ``main``, ``executable`` and so on the entry is."""
        return next(name for name in _KINDS if getattr(self, name) is not None)

    @property
    def absent(self) -> tuple[str, ...]:
        """The keys that stand for other kinds of entries, and those that only some entries have."""
        rare = (name for name in _RARE if getattr(self, name) in (None, False, {}))
        return (*(name for name in _KINDS if name != self.kind), *rare)

    @property
    def target(self) -> str:
        """What is run: ``module:attribute``, ``package/name``, a file, or a module."""
        return target_text(getattr(self, self.kind))

    @property
    def package(self) -> str:
        """The package that the entry names (or the module that is in none), "" for others."""
        other = self.script or self.program or self.component
        return "" if other else re.split("[:./]", self.target)[0]
