"""From what a launch file starts to entries of a job."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch.api.parameters import flat, parameters_for
from rsltrace.adapters.launch.model import (
    LaunchedNode,
    LaunchResult,
    ParameterFilePath,
    ProcessSettings,
    UnsupportedItem,
    full_name,
    inferred,
)
from rsltrace.adapters.workspace.cache import lasting
from rsltrace.errors import JobError, did_you_mean
from rsltrace.job import NodeSpec
from rsltrace.job.parts.launch import StartAfterSpec
from rsltrace.job.parts.process import RespawnSpec
from rsltrace.job.reading.substitute import package_prefix
from rsltrace.job.values.mappings import near_path, split_ros_arguments
from rsltrace.source_packages import source_packages

_LISTED_MAX = 30


def node_specs(
    launched: LaunchResult,
    *,
    skip_unsupported: bool,
    why_not: Callable[[str, str], str | None],
    is_process: Callable[[str, str], bool] = lambda package, executable: False,
    before: Sequence[NodeSpec] = (),
    native: bool = False,
) -> list[NodeSpec]:
    """Return the nodes as entries of a job; ``launched.unsupported`` grows by what is left out.

    ``why_not(package, executable)`` says why an executable cannot be simulated, ``is_process``
    whether it runs as a process of its own. ``before`` are the entries that the job has already.
    Only a ``native`` run has other programs.

    :raises JobError: with everything that cannot be simulated, unless that is to be skipped.
    """
    first = len(before)
    containers = {full_name(spec.namespace, spec.name) for spec in before if spec.name}
    runs: list[LaunchedNode] = []
    for node in _without_idle_containers(launched.nodes, why_not):
        if node.is_program:
            why = _why_no_program(node) if native else "other programs do not run in a simulation"
        else:
            why = _why_not(node, why_not, containers)
        if why is not None:
            launched.unsupported.append(UnsupportedItem(node.where, node.title, why))
        else:
            runs.append(node)
            containers |= {node.full_name} if node.is_container else set()
    runs = _without_orphans(runs, launched)
    _note_what_is_lost(runs, launched, is_process)
    numbers: dict[int, int] = {}
    for position, node in enumerate(runs, first):
        numbers.setdefault(node.number, position)
    required = launched.required
    specs = [
        _spec(node, numbers, is_process(node.package, node.executable), node.number in required)
        for node in runs
    ]
    launched.unsupported.sort(key=_position)
    if launched.unsupported and not skip_unsupported:
        ran = "run" if native else "simulated"
        listed = launched.unsupported[:_LISTED_MAX]
        more = len(launched.unsupported) - len(listed)
        lines = "".join(f"\n  {item}" for item in listed) + (f"\n  and {more} more" if more else "")
        raise JobError(
            f"not all of the launch file can be {ran}; --skip-unsupported (skip_unsupported: "
            f"true in a job) leaves this out:{lines}"
        )
    return specs


def _position(item: UnsupportedItem) -> tuple[str, list[int]]:
    file, *numbers = item.where.split(":")
    return file, [int(number) for number in numbers if number.isdigit()]


def _without_orphans(nodes: list[LaunchedNode], launched: LaunchResult) -> list[LaunchedNode]:
    """Return the nodes but those that wait for one that is left out, which are left out, too."""
    while True:
        there = {node.number for node in nodes}
        kept = [node for node in nodes if node.after is None or node.after[1] in there]
        if len(kept) == len(nodes):
            return nodes
        for node in nodes:
            if node not in kept and node.after is not None:
                why = f"it starts when something has {node.after[0]} that is left out itself"
                launched.unsupported.append(UnsupportedItem(node.where, node.title, why))
        nodes = kept


def _without_idle_containers(
    nodes: Sequence[LaunchedNode], why_not: Callable[[str, str], str | None]
) -> list[LaunchedNode]:
    """Return the nodes but those containers of which nothing would come: Python components are
    nodes of the run without one."""
    busy = {node.container for node in nodes if "::" in node.plugin}
    idle = {node.container for node in nodes if node.plugin} - busy
    return [
        node
        for node in nodes
        if not node.is_container
        or node.full_name in busy
        or (node.full_name not in idle and why_not(node.package, node.executable) is None)
    ]


def _note_what_is_lost(
    nodes: Sequence[LaunchedNode], launched: LaunchResult, is_process: Callable[[str, str], bool]
) -> None:
    for node in nodes:
        said = node.surroundings
        if node.is_program or is_process(node.package, node.executable):
            if said.without:
                why = "processes are started as they are"
                launched.ignored.append(f"{node.where}: {', '.join(said.without)}: {why}")
        elif lost := (*said.without, *said.own):
            why = "it runs in the process of rsltrace"
            launched.ignored.append(f"{node.where}: {', '.join(lost)}: {why}")


def _why_not(
    node: LaunchedNode,
    of_executable: Callable[[str, str], str | None],
    containers: Collection[str],
) -> str | None:
    if not node.plugin:
        return of_executable(node.package, node.executable)
    if "::" in node.plugin:
        if node.container in containers:
            return None
        return f"it is a C++ component, and its container {node.container} is not there"
    if "." not in node.plugin and ":" not in node.plugin:
        return "a Python component is written module.Class, or module:Class"
    return None


def _program(node: LaunchedNode) -> str | None:
    """Return the path of what a command starts, as its process would look for it."""
    said = node.surroundings
    name, path = node.command[0], dict(said.environment).get("PATH")
    if "/" in name:
        name = os.path.abspath(os.path.join(said.folder, name))
    return shutil.which(name, path=path)


def _why_no_program(node: LaunchedNode) -> str | None:
    if not node.command:
        return "it has no command"
    return None if _program(node) else f"there is no program {node.command[0]}"


def _spec(
    node: LaunchedNode, numbers: Mapping[int, int], is_process: bool, is_required: bool
) -> NodeSpec:
    if node.fault:
        raise JobError(node.fault)
    words, ros_words = split_ros_arguments(node.arguments)
    given = RosWords([*node.ros_arguments, *ros_words], node.where)
    name = given.name or node.name
    namespace = given.namespace or node.namespace
    whole = None if name is None else full_name(namespace, name)
    files, parameters = _in_order([*node.parameters, *given.parameters], whole)
    words += ["--ros-args", *given.others] if given.others else []
    values: dict[str, Any] = {
        "name": name,
        "namespace": namespace,
        "parameters": parameters,
        "parameter_files": files,
        "remappings": _first_counts([*node.remappings, *given.remappings]),
        "origin": node.where,
    }
    if node.after is not None:
        moment, number = node.after
        rule: dict[str, Any] = {"delay": f"{node.delay_ns}ns", moment: numbers[number]}
        values["start_after"] = StartAfterSpec(**rule)
    elif node.delay_ns:
        values["start_after"] = StartAfterSpec.after(node.delay_ns)
    try:
        if node.is_program:
            values = {key: values[key] for key in ("origin", "start_after") if key in values}
            return NodeSpec(
                program=_program(node),
                arguments=node.command[1:],
                required=is_required,
                **_surroundings(node.surroundings),
                **values,
            )
        if "::" in node.plugin:
            extra = [item for item in node.extra_arguments if isinstance(item, dict)]
            return NodeSpec(
                component=f"{node.package}/{node.plugin}",
                container=node.container,
                extra_arguments={name: v for item in extra for name, v in flat(item)},
                **values,
            )
        if node.plugin:
            module, _, attribute = node.plugin.replace(":", ".").rpartition(".")
            return NodeSpec(node=f"{module}:{attribute}", **values)
        target = f"{node.package}/{node.executable}"
        if is_process:
            values |= _surroundings(node.surroundings)
        values["required"] = is_required
        return NodeSpec(executable=target, arguments=words, **values)
    except JobError as error:
        raise JobError(str(error).removeprefix("NodeSpec: "), where=node.where) from None


def _surroundings(said: ProcessSettings) -> dict[str, Any]:
    values: dict[str, Any] = {"environment": dict(said.environment)}
    if said.folder:
        values["working_directory"] = said.folder
    if said.respawn is not None:
        delay_ns, times = said.respawn
        values["respawn"] = RespawnSpec.after(delay_ns, times)
    return values


def _first_counts(remappings: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Return remappings of which the first of a name counts, in their order."""
    return dict(reversed(dict(reversed(remappings)).items()))


def _in_order(
    parameters: Sequence[ParameterFilePath | dict[str, Any]], full_name: str | None
) -> tuple[list[str], dict[str, Any]]:
    """Return files and values such that each parameter has the value given last.

    A job's values win over its files, so a value that a later file gives again is left out.
    """
    files: list[str] = []
    values: dict[str, Any] = {}
    for item in parameters:
        if isinstance(item, ParameterFilePath):
            files.append(lasting(item.path))
            for name in parameters_for(item.path, full_name):
                values.pop(name, None)
        else:
            values.update(flat(item))
    return files, values


class RosWords:
    """What ``--ros-args`` words say about one program; ``others`` are those that no key of a job
    says: rules for one node of it, and log options."""

    def __init__(self, words: Sequence[str], where: str) -> None:
        self.name: str | None = None
        self.namespace: str | None = None
        self.parameters: list[ParameterFilePath | dict[str, Any]] = []
        self.remappings: list[tuple[str, str]] = []
        self.others: list[str] = []
        self._where = where
        rest = list(words)
        while rest:
            option = rest.pop(0)
            if option in ("--ros-args", "--"):
                continue
            if option.startswith(("--enable-", "--disable-")):
                continue
            if not rest:
                raise JobError(f"the ROS argument {option} has no value", where=where)
            self._add(option, rest.pop(0))

    def values(self) -> dict[str, Any]:
        """Return the keys of an entry of a job; paths start at the working directory."""
        whole = None if self.name is None else full_name(self.namespace, self.name)
        files, parameters = _in_order(self.parameters, whole)
        found = {
            "name": self.name,
            "namespace": self.namespace,
            "parameters": parameters,
            "parameter_files": [os.path.relpath(path) for path in files],
            "remappings": _first_counts(self.remappings),
        }
        return {key: value for key, value in found.items() if value}

    def _add(self, option: str, value: str) -> None:
        if option in ("--log-file-name", "--log-config-file", "-e", "--enclave"):
            return
        if option == "--log-level":
            self.others += [option, value]
            return
        if option == "--params-file":
            path = os.path.abspath(value)
            if not os.path.isfile(path):
                raise JobError(f"there is no parameter file {value}", where=self._where)
            self.parameters.append(ParameterFilePath(path))
            return
        name, assigned, to = value.partition(":=")
        if option not in ("-r", "--remap", "-p", "--param") or not assigned:
            raise JobError(f"unknown ROS argument {option} {value}", where=self._where)
        if ":" in name.removeprefix("rostopic://").removeprefix("rosservice://"):
            self.others += [option, value]
        elif option in ("-p", "--param"):
            self.parameters.append({name: inferred(to)})
        elif name in ("__node", "__name"):
            self.name = to
        elif name == "__ns":
            self.namespace = to
        else:
            self.remappings.append((name, to))


# Finds the launch file that a command line names: a path, or a package and a file of it.

_OPTION = "--launch"
_SUFFIXES = (".py", ".xml", ".yaml", ".yml")


def launch_file(named: Path, words: Sequence[str]) -> tuple[Path, list[str]]:
    """Return the path of a launch file, and the words that are left.

    As ``ros2 launch`` has it, ``named`` may be a package and the first of ``words`` a file of it:
    of a package that is installed, or that lies in or around the working directory.

    :raises JobError: if there is no such file, or several.
    """
    left = list(words)
    files = [word for word in words if word.endswith(_SUFFIXES) and ":=" not in word]
    file = next((word for word in files if "launch" in word), files[-1] if files else None)
    is_package = named.name == str(named) and not named.suffix
    if named.is_file() or file is None or not is_package:
        return _existing(named), left
    left.remove(file)
    return _of_package(named.name, file), left


def _existing(path: Path) -> Path:
    if path.is_file() or path.suffix == ".mcap":
        return path
    if path.is_dir():
        listed = ", ".join(str(one.relative_to(path)) for one in _launch_files(path)[:10])
        has = f"name a launch file in it: {listed}" if listed else "name a launch file"
        raise JobError(f"{path} is a folder; {has}", where=_OPTION)
    near = near_path(path.absolute(), str(path))
    hint = near or ("" if path.suffix else f" (of a package: --launch {path} FILE)")
    raise JobError(f"there is no such launch file: {path}{hint}", where=_OPTION)


def _of_package(package: str, file: str) -> Path:
    here = source_packages([Path.cwd()])
    prefix = package_prefix(package)
    if prefix is not None:
        folder = prefix / "share" / package
    elif package in here:
        folder = here[package].folder
    else:
        raise JobError(
            f"there is no package {package!r}{did_you_mean(package, here)}: it is neither "
            f"installed (AMENT_PREFIX_PATH, this Python) nor below {Path.cwd()}",
            where=_OPTION,
        )
    exact = folder / file
    if exact.is_file():
        return Path(os.path.relpath(exact))
    found = [path for path in sorted(folder.rglob(Path(file).name)) if _ends_with(path, file)]
    if len(found) == 1:
        return Path(os.path.relpath(found[0]))
    if found:
        listed = ", ".join(str(path.relative_to(folder)) for path in found)
        raise JobError(f"{file} is several files of {package}: {listed}", where=_OPTION)
    names = sorted({path.name for path in _launch_files(folder)})
    there = f"there are {', '.join(names[:10])}" if names else "it has none"
    raise JobError(
        f"package {package!r} ({folder}) has no launch file {file!r}: "
        f"{did_you_mean(file, names, there)}",
        where=_OPTION,
    )


def _ends_with(path: Path, file: str) -> bool:
    parts = Path(file).parts
    return path.is_file() and path.parts[-len(parts) :] == parts


def _launch_files(folder: Path) -> list[Path]:
    return [
        path
        for path in sorted(folder.rglob("*launch*"))
        if path.suffix in _SUFFIXES and path.is_file()
    ]
