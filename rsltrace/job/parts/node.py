"""One entry of ``nodes:``: what to construct, and how it is named, configured and connected."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.guard import GuardSpec, guard_part
from rsltrace.job.parts.launch import StartAfterSpec
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.parts.process import InputSpec, RespawnSpec, check_environment, inputs
from rsltrace.job.values.checks import attach, check, flag, items, one_of, part, text
from rsltrace.job.values.mappings import check_arguments, check_path, check_remappings
from rsltrace.job.values.names import (
    check_component,
    check_container,
    check_executable,
    check_module,
    check_namespace,
    check_node_name,
)
from rsltrace.job.values.parameters import ParameterValue, flatten_parameters
from rsltrace.job.values.problem import JobProblem
from rsltrace.job.values.target import Target, check_callable_target, target_text
from rsltrace.job.values.times import TimeLike

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
