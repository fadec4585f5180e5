"""Entries that run as separate processes: their command lines and environments."""

from __future__ import annotations

import os
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

from rsltrace.adapters.processes.adapter import ProcessAdapter, ProcessProgram, TypeLookup
from rsltrace.adapters.processes.build import (
    PreloadLibrary,
    interpreter,
    is_compiled,
    is_python,
    library,
    program,
    why_not_run,
)
from rsltrace.adapters.rclpy.arguments import RosArguments
from rsltrace.adapters.rclpy.entry import JobEntry
from rsltrace.adapters.rclpy.messages.interfaces import get_message_class, message_type
from rsltrace.adapters.rclpy.world import World
from rsltrace.adapters.workspace.imports import unbuilt_names, unbuilt_prefix
from rsltrace.errors import JobError, RunError, SetupError
from rsltrace.guard.pin import pinned_variables
from rsltrace.job import Job, NodeSpec
from rsltrace.run.plans.executables import compiled_file, process_command
from rsltrace.run.plans.network import clock_rules
from rsltrace.simulation.chance.stream import ClockModel
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.middleware.interface import MessageType, ServiceType
from rsltrace.trace.model.regular_file import not_regular
from rsltrace.trace.model.texts import printable


def as_python(job: Job, spec: NodeSpec) -> NodeSpec:
    """Return an entry as native runs observe it: Python is run by Python code of ours, and not with
    the library that processes of a simulation have. A command of a launch file keeps its own:
    ``ros2 bag play`` sends from C++, and others start processes."""
    changes: dict[str, object] = {"isolated": False}
    if spec.program is not None and spec.origin is None:
        path = job.resolve(spec.program)
        if path.is_file() and is_python(path):
            changes |= {"program": None, "script": spec.program}
    return spec.with_values(**changes)


def ros_words(arguments: Sequence[RosArguments]) -> list[str]:
    """Return the ROS arguments of a process; none if they say nothing: it may not be ROS's."""
    said = [part.arguments for part in arguments if part.arguments != ("--ros-args",)]
    return [word for words in said for word in words]


class ProcessPrograms:
    """Makes the command lines of a job's processes; the first one builds the library."""

    def __init__(self, job: Job, note: Callable[[str], None]) -> None:
        self._job = job
        self._note = note
        self._library: PreloadLibrary | None = None
        pinned = pinned_variables() if job.guard.pins else {}  # this process need not be
        self._surroundings = {**os.environ, **pinned}
        """As they are before modules of nodes are imported, which may set variables."""

    def find(
        self, spec: NodeSpec, arguments: Sequence[RosArguments], *, where: str
    ) -> ProcessProgram | None:
        """Return the process that an entry starts, None if it runs in this process.

        :raises JobError: the file does not exist or is not executable.
        :raises SetupError: the library cannot be built.
        """
        command = self.command(spec, where)
        if command is None:
            return None
        if self._library is None:
            try:
                self._library = library(self._note)
            except SetupError as error:
                raise JobError(str(error), where=where) from error
        return program(
            [*command, *spec.arguments, *ros_words(arguments)],
            self._library,
            surroundings=self._surroundings,
            environment=spec.environment,
            folder=self.folder(spec, where),
            search_path=self.search_path,
            prefixes=self.prefixes,
            pinned=self._job.guard.pins,
            instant_sleep=spec.instant_sleep,
            intra_process=spec.intra_process,
        )

    @cached_property
    def search_path(self) -> list[str]:
        """The module folders; unbuilt packages first, since source folders
        (``src/my_robot/my_robot``) look like packages themselves."""
        from rsltrace.adapters.workspace.installs import (
            module_folders,  # which loads a parser of XML
        )

        given = [self._job.resolve(path) for path in self._job.search_path]
        return [str(path) for path in dict.fromkeys([*module_folders(given), *given])]

    @cached_property
    def prefixes(self) -> list[str]:
        """The install prefixes of these packages and of wheels, as in this process."""
        found = [str(path) for name in sorted(unbuilt_names()) if (path := unbuilt_prefix(name))]
        has_wheels = Path(sys.prefix, "share", "ament_index").is_dir()
        return [*found, sys.prefix] if has_wheels else found

    def folder(self, spec: NodeSpec, where: str) -> Path | None:
        """Return the working directory of an entry, None for the current one.

        :raises JobError: it does not exist.
        """
        if spec.working_directory is None:
            return None
        folder = self._job.resolve(spec.working_directory)
        if not folder.is_dir():
            raise JobError(f"there is no folder {spec.working_directory} to run in", where=where)
        return folder

    def command(self, spec: NodeSpec, where: str) -> list[str] | None:
        """Return the command of an entry without its arguments; None if it is not a process.

        :raises JobError: the file does not exist or is not executable.
        """
        if spec.program is not None:
            return _executable(self._job.resolve(spec.program), spec.program, where)
        if spec.executable is not None:
            compiled = compiled_file(spec.executable)
            if compiled is not None:
                return _compiled(compiled, spec.executable, where)
        if not spec.isolated:
            return None
        if spec.module is not None:
            return [sys.executable, "-m", spec.module]
        if spec.script is not None:
            path = self._job.resolve(spec.script)
            _check_file(path, spec.script, where)
            return [sys.executable, str(path)]
        assert spec.executable is not None
        return process_command(spec.executable, where=where)


def _check_file(path: Path, given: str, where: str) -> None:
    if not path.exists():
        raise JobError(f"there is no file {given}", where=where)
    if kind := not_regular(path):
        raise JobError(f"{given} is {kind}, not a program", where=where)


def _compiled(path: Path, given: str, where: str) -> list[str]:
    if reason := why_not_run(path):
        raise JobError(f"{given} {reason}", where=where)
    return [str(path)]


def _executable(path: Path, given: str, where: str) -> list[str]:
    _check_file(path, given, where)
    if is_python(path):
        return [sys.executable, str(path)]
    if not os.access(path, os.X_OK):
        raise JobError(f"{given} cannot be executed: chmod +x it, or build it", where=where)
    if is_compiled(path):
        return _compiled(path, given, where)
    words = interpreter(path)
    if not words:
        raise JobError(f"{given} is neither a compiled program nor a script", where=where)
    found = shutil.which(words[0]) if "\0" not in words[0] else None
    if found is None:
        raise JobError(
            f"{given} is a script for {printable(words[0])}, which is not there: install it, or "
            "mend the #! line",
            where=where,
        )
    return [found, *words[1:], str(path)]


def _message_type(name: str) -> MessageType:
    """Return a message type; by name only if Python has no class for it."""
    try:
        found = get_message_class(name)
    except SetupError:  # its package has nothing for Python
        return MessageType(name)
    try:
        known = message_type(found)
    except TypeError:
        file = getattr(sys.modules.get(found.__module__), "__file__", None)
        raise RunError(
            f"a process uses {name}, whose class in Python ({found.__module__}.{found.__name__}"
            f"{f' in {file}' if file else ''}) was not generated by rosidl: build the package and "
            "source its workspace, or move away what hides it"
        ) from None
    return replace(known, describe=partial(_described, known))


def _described(known: MessageType) -> tuple[str, str]:
    try:
        return known.describe()
    except (SetupError, TypeError):  # a field of a type that rclpy does not have, or of no package
        return "", ""


def _service_type(name: str) -> ServiceType:
    return ServiceType(name, _message_type(f"{name}_Request"), _message_type(f"{name}_Response"))


def _shown(world: World, node: str | None, looks: bool) -> tuple[int, bool]:
    """Return what a process's clock shows, and whether that is constant during the event."""
    clocks, now_ns = world.clocks, world.domain.loop.now_ns
    assert clocks is not None, "the job has some"
    shown_ns = clocks.look(node, now_ns) if looks else clocks.shows(node, now_ns)
    return shown_ns, not clocks.advances(node)


def make_process_adapter(job: Job, world: World) -> ProcessAdapter:
    """Return the adapter through which a job's processes take part in its world."""
    interfaces = TypeLookup(_message_type, _service_type)
    adapter = ProcessAdapter(world.domain, interfaces, seed=job.seed, log=world.show_log)
    adapter.parallel = job.parallel and type(world.domain.loop) is EventLoop
    programs = world.runtime.programs
    restarts: Counter[str] = Counter()

    def ended(key: str) -> None:
        programs.tell("ended", key)
        entry = next(one for one in world.constructed if one.key == key)
        if entry.respawn is None or world.domain.loop.stopped is not None:
            return
        delay_ns, times = entry.respawn
        if times is None or restarts[key] < times:
            restarts[key] += 1
            world.starts.add_at(entry, world.domain.loop.now_ns + delay_ns)

    adapter.on_end = ended
    adapter.follows_clock = lambda node: world.clocks is not None and world.clocks.follows(node)

    if any(rule.advances or rule.model != ClockModel() for rule in clock_rules(job)):
        adapter.clock = lambda node, looks: _shown(world, node, looks)

    def start(entry: JobEntry, cause: tuple[int, int]) -> None:
        assert isinstance(entry.program, ProcessProgram)
        adapter.start(
            entry.program,
            name=entry.name,
            key=entry.key,
            log_failure=entry.log_exceptions or entry.respawn is not None,
            cause=cause,
            on_start=lambda: programs.tell("started", entry.key),
        )

    world.start_process = start
    return adapter
