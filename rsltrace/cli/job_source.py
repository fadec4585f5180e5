"""The job of a command line: a job file, a launch file, programs, ``--set``, ``--ros-args``."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.options import complete_files, set_option
from rsltrace.fast_dataclass import dataclass
from rsltrace.job.values.mappings import split_ros_arguments

if TYPE_CHECKING:
    from rsltrace.job import Job
    from rsltrace.search.history.run_record import RunRecord

_ADDED = ("nodes.+=", "launch.+=", "bags.+=")
Override = str | tuple[str, str]
"""A ``--set``, or an option and what that sets."""


class RosArgsCommand(click.Command):
    """A command that takes ``--ros-args … [--]`` anywhere, as ROS programs do, and whose last words
    may be programs, each after a ``--``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Remove the ROS arguments and the programs before click parses the others."""
        args, programs = split_programs(args)
        own, ros = split_ros_arguments(args)
        left = super().parse_args(ctx, own)
        if ctx.resilient_parsing:
            return left
        take = ctx.params.pop
        words, launch, bags, overrides = (
            take(name) for name in ("words", "launch", "bag", "overrides")
        )
        if launch is not None:
            from rsltrace.adapters.launch.specs import launch_file

            launch, words = launch_file(launch, words)
        entries = [("--bag", ("bags", {"path": str(path)})) for path in bags]
        program = ""
        if programs is not None:
            if launch is not None or words:
                given = words[0] if words else "--launch"
                raise click.UsageError(
                    f"give {given} or programs after '--', not both (--bag, --set and --until go "
                    "with programs, too)"
                )
            named = program_entries(programs)
            program = program_name(named[0])
            written = [f"-- {shlex.join(one)}" for one in programs]
            entries = [*zip(written, named, strict=True), *entries]
        more = (
            (option, f"{key}.+={json.dumps(entry, ensure_ascii=False)}")
            for option, (key, entry) in entries
        )
        ctx.params["given"] = JobArguments(
            words=tuple(words),
            launch=launch,
            skip=take("skip"),
            overrides=(*more, *overrides),
            ros=tuple(ros),
            folder=take("override_folder") or Path(),
            program=program,
            bags=bags,
        )
        return left


def split_programs(words: Sequence[str]) -> tuple[list[str], list[list[str]] | None]:
    """Return a command's own words, and those of the programs that follow, each after a ``--``.

    The ``--`` that ends the ROS arguments of the command itself begins no program.
    """
    inside = False
    for index, word in enumerate(words):
        if word == "--" and not inside:
            programs: list[list[str]] = []
            for one in words[index:]:
                if one == "--":
                    programs.append([])
                else:
                    programs[-1].append(one)
            return list(words[:index]), programs
        inside = word != "--" and (inside or word == "--ros-args")
    return list(words), None


def _check_bags(
    context: click.Context, option: click.Parameter, bags: tuple[Path, ...]
) -> tuple[Path, ...]:
    for bag in bags:
        if not bag.exists() and not context.resilient_parsing:
            raise click.BadParameter(f"there is no bag {bag} (record --export-bag writes one)")
    return bags


def job_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that name a job to a command (a ``RosArgsCommand``): its ``given``."""
    for decorate in reversed(
        (
            click.argument(
                "words",
                nargs=-1,
                metavar="[JOB] [NAME:=VALUE]... [-- PROGRAM...]...",
                shell_complete=complete_files,
            ),
            click.option(
                "--launch",
                type=click.Path(path_type=Path),
                help="Run the nodes of a launch file (--launch FILE or --launch PACKAGE FILE), "
                "with launch arguments NAME:=VALUE.",
            ),
            click.option(
                "--skip-unsupported",
                "skip",
                is_flag=True,
                help="Skip actions of the launch file that cannot be simulated.",
            ),
            set_option,
            click.option(
                "--bag",
                multiple=True,
                type=click.Path(path_type=Path),
                metavar="BAG",
                callback=_check_bags,
                help="Play this recording into the run, as bags: in a job does. Repeatable.",
            ),
            click.option(  # of child processes, whose working directory may be another one
                "--override-folder", hidden=True, type=click.Path(path_type=Path)
            ),
            click.option(
                "--ros-args",
                is_flag=True,
                expose_value=False,
                help="Pass the ROS arguments that follow (-p, -r, --params-file) to all nodes; "
                "-- ends them.",
            ),
        )
    ):
        function = decorate(function)
    return function


@dataclass(frozen=True, slots=True)
class JobArguments:
    """What a command line says of its job. ``overrides`` are those of ``--set`` and of what stands
    for one; ``seed``, ``until`` and ``no_pin`` are for child processes only.

    ``folder`` is where its paths start, ``program`` the name of the first program that is given in
    place of a job.
    """

    words: tuple[str, ...]
    launch: Path | None
    skip: bool
    overrides: tuple[Override, ...]
    ros: tuple[str, ...]
    folder: Path
    program: str
    bags: tuple[Path, ...]
    seed: int | None = None
    until: str | None = None
    no_pin: bool = False

    @property
    def files(self) -> list[str]:
        """The words that are no launch arguments."""
        return [word for word in self.words if ":=" not in word]

    def overridden(
        self, seed: int | None, until: str | None, last: str | None = None
    ) -> JobArguments:
        """Return the arguments with the overrides of ``--seed``, ``--until`` and ``--last``."""
        found = list(self.overrides)
        if seed is not None:
            found.append(("--seed", f"seed={seed}"))
        if until is not None:
            key = "time" if until.startswith("@") else "duration"
            found.append(("--until", f"stop.{key}={_time(until.removeprefix('@'))}"))
        if last is not None:
            found.append(("--last", f"record.last.duration={_time(last)}"))
        return replace(self, overrides=tuple(found))

    def job(self) -> tuple[Job, Path]:
        """Return the job, and the path of the file that names it.

        :raises click.UsageError: the arguments contradict each other.
        :raises JobError: the job is wrong.
        """
        from rsltrace.job import job_from_text, load_job

        named, changes, text = self.named()
        if text is None:
            return load_job(named, overrides=changes, given_in=self.folder), named
        name = self.source_name(named)
        return job_from_text(
            text, name, named.parent, overrides=changes, given_in=self.folder
        ), named

    def check_named(self) -> None:
        """Raise UsageError if this command line says nothing that a job could run."""
        texts = (one if isinstance(one, str) else one[1] for one in self.overrides)
        if not (self.files or self.launch or any(text.startswith(_ADDED) for text in texts)):
            raise click.UsageError("Missing argument 'JOB' (or --launch FILE, or -- PROGRAM).")

    def named(self) -> tuple[Path, list[Override], str | None]:
        """Return the path of the job or launch file, all overrides, and the job's text if there is
        no job file.

        :raises click.UsageError: the arguments contradict each other.
        """
        files, launch = self.files, self.launch
        arguments = dict(word.split(":=", 1) for word in self.words if ":=" in word)
        if len(files) > 1:
            raise click.UsageError(f"give one JOB, not {' and '.join(files)}")
        self.check_named()
        if launch is None and (arguments or self.skip):
            first = next(iter(arguments), "")
            what = f"{first}:=… is a launch argument" if arguments else "--skip-unsupported"
            raise click.UsageError(f"{what}: give the launch file with --launch FILE")
        if launch is not None and launch.suffix == ".mcap":
            raise click.UsageError(f"{launch} is a trace, not a launch file")
        named = Path(files[0]) if files else launch or self.folder / (self.program or "run")
        changes = list(self.overrides)
        if launch is not None:
            spec: dict[str, Any] = {"file": str(launch), "arguments": arguments}
            if self.skip:
                spec["skip_unsupported"] = True
            changes.append(("--launch", f"launch.+={json.dumps(spec, ensure_ascii=False)}"))
        words = self._ros_with(lambda path: os.path.relpath(path, named.parent))
        changes += [("--ros-args", f"ros_arguments.+={json.dumps(word)}") for word in words]
        return named, changes, None if files else "{}"

    def source_name(self, named: Path) -> str:
        """Return what messages and traces call the job."""
        from rsltrace.job.fields import COMMAND_LINE

        return str(named) if self.files or self.launch is not None else COMMAND_LINE

    def arguments(self, path: Callable[[str], object] = str) -> list[str]:
        """Return them as words; ``path`` converts each path for the process that uses them."""
        found = [word if ":=" in word else str(path(word)) for word in self.words]
        start = str(path(str(self.folder)))
        if os.path.isabs(start):  # a child process may have another working directory
            found += ["--override-folder", start]
        if self.launch is not None:
            found += ["--launch", str(path(str(self.launch)))]
        found += ["--skip-unsupported"] * self.skip
        for override in self.overrides:
            found += ["--set", override if isinstance(override, str) else override[1]]
        if self.seed is not None:
            found += ["--seed", str(self.seed)]
        if self.until is not None:
            found += ["--until", self.until]
        found += ["--no-pin"] * self.no_pin
        return found + (["--ros-args", *self._ros_with(path), "--"] if self.ros else [])

    def _ros_with(self, path: Callable[[str], object]) -> list[str]:
        """Return the ROS arguments with their paths converted."""
        found = list(self.ros)
        for index, word in enumerate(found[:-1]):
            if word == "--params-file":
                found[index + 1] = str(path(found[index + 1]))
        return found

    def recorded(self, history: str | None, by: str) -> AbstractContextManager[RunRecord]:
        """Give the record of this run, which goes to a history."""
        from rsltrace.search.history.run_record import recorded

        file = next(map(Path, self.files), self.launch or Path())
        return recorded(history, by, file, self.arguments)


def _time(text: str) -> str:
    return json.dumps(f"{text}s" if text[-1:].isdigit() else text)


# Programs, as ``ros2 run``, ``ros2 launch`` and ``python3`` start them.

Entry = tuple[str, dict[str, Any]]
"""The key of a job (``nodes`` or ``launch``), and what is added to its list."""

_PYTEST = ("pytest", "py.test")
_RUN_PYTEST = {"main": "rsltrace.testing.plugin:run_pytest"}
"""Pytest as a main whose failure is that of the test; alone it ends with an exit status."""

_PYTHON = re.compile(r"python(3(\.\d+)?)?$")
_FORMS = (
    "write 'ros2 run PACKAGE EXECUTABLE', 'ros2 launch PACKAGE FILE', 'python3 FILE', or the path "
    "of a program"
)


def program_entries(programs: Sequence[Sequence[str]]) -> list[Entry]:
    """Return the entries of a job that runs commands. It ends with pytest, if that is one of them.

    :raises click.UsageError: they are no command that a job can run.
    :raises JobError: there is no such launch file or parameter file.
    """
    entries = [_entry(words) for words in programs]
    for _, values in entries if len(entries) > 1 else ():
        values.update({"required": True} if "main" in values else {})
    return entries


def _entry(words: Sequence[str]) -> Entry:
    if not words:
        raise click.UsageError(f"there is no program after '--': {_FORMS}")
    if words[:2] == ["ros2", "launch"]:
        return "launch", _launch(words[2:])
    from rsltrace.adapters.launch.specs import RosWords

    target, rest = _target(words)
    own, ros = split_ros_arguments(rest)
    given = RosWords(ros, shlex.join(words))
    own += ["--ros-args", *given.others] if given.others else []
    return "nodes", {**target, **given.values(), **({"arguments": own} if own else {})}


def program_name(entry: Entry) -> str:
    """Return the name of an entry's program, for the files of its run."""
    (kind, target), *_ = entry[1].items()
    if kind == "main":
        words = filter(_is_python_file, entry[1].get("arguments", ()))
        target = next(words, _PYTEST[0]).partition("::")[0]
    name = str(target).rpartition("/")[2]
    return name if entry[0] == "launch" else name.removesuffix(".py")


def _launch(words: Sequence[str]) -> dict[str, Any]:
    options = [word for word in words if word.startswith("-")]
    if options:
        raise click.UsageError(f"ros2 launch {options[0]}: leave out the options of ros2 launch")
    files = [word for word in words if ":=" not in word]
    arguments = dict(word.split(":=", 1) for word in words if ":=" in word)
    if not files:
        raise click.UsageError("ros2 launch: name a launch file, or a package and its launch file")
    from rsltrace.adapters.launch.specs import launch_file

    path, left = launch_file(Path(files[0]), files[1:])
    if left:
        raise click.UsageError(f"ros2 launch: give one launch file, not {path} and {left[0]}")
    return {"file": str(path), **({"arguments": arguments} if arguments else {})}


def _target(words: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Return what a command runs, as a key of an entry, and the words for it."""
    first, *rest = words
    if first == "ros2":
        if rest[:1] != ["run"] or len(rest) < 3 or any(word.startswith("-") for word in rest[1:3]):
            raise click.UsageError(f"{shlex.join(words)}: {_FORMS}")
        return {"executable": f"{rest[1]}/{rest[2]}"}, rest[3:]
    if _PYTHON.match(Path(first).name):
        if rest[:1] == ["-m"] and len(rest) > 1:
            return _target(rest[1:]) if rest[1] in _PYTEST else ({"module": rest[1]}, rest[2:])
        if not rest or rest[0].startswith("-"):
            raise click.UsageError(
                f"{shlex.join(words)}: write 'python3 FILE' or 'python3 -m MODULE'"
            )
        return {"script": _file(rest[0])}, rest[1:]
    if Path(first).suffix in (".yaml", ".yml"):
        raise click.UsageError(f"{first} is a job, not a program: leave out the '--' before it")
    if first == "launch_test" or any(map(_is_launch_test, words)):
        raise click.UsageError(
            f"{shlex.join(words)}: a launch_testing file cannot run in simulated time; name its "
            "nodes and a pytest file with its tests: -- ros2 launch PACKAGE FILE -- pytest FILE"
        )
    if first in _PYTEST:
        for word in filter(_is_python_file, rest):
            _file(word.partition("::")[0])
        return _RUN_PYTEST, rest
    if "/" not in first and (package := _console_script(first)):
        return {"executable": f"{package}/{first}"}, rest
    import shutil  # not every program is searched for

    found = first if "/" in first or Path(first).is_file() else shutil.which(first)
    if found is None:
        raise click.UsageError(
            f"there is no program {first!r}: it is no file, no console script of this Python, and "
            f"not in PATH; {_FORMS}"
        )
    path = _file(found)
    from rsltrace.adapters.processes.build import is_python

    return {"script" if path.endswith(".py") or is_python(Path(path)) else "program": path}, rest


def _is_python_file(word: str) -> bool:
    return word.partition("::")[0].endswith(".py")


def _is_launch_test(word: str) -> bool:
    path = Path(word.partition("::")[0])
    is_there = _is_python_file(word) and path.is_file()
    return is_there and b"def generate_test_description" in path.read_bytes()


def _file(path: str) -> str:
    if not Path(path).is_file():
        raise click.UsageError(f"there is no file {path}")
    return path


def _console_script(name: str) -> str | None:
    """Return the distribution that has a console script, None if there is none."""
    from importlib import metadata

    for entry in metadata.entry_points(group="console_scripts", name=name):
        if entry.dist is not None:
            return entry.dist.name
    return None
