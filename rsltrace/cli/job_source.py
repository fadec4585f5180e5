"""The job of a command line: a job file, a launch file, programs, ``--set``, ``--ros-args``."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.completion import complete_files
from rsltrace.cli.options import set_option
from rsltrace.job.values.mappings import split_ros_arguments

if TYPE_CHECKING:
    from rsltrace.job import Job

_META = "rsltrace.ros_args"
_PROGRAMS = "rsltrace.programs"
_ADDED = ("nodes.+=", "launch.+=", "bags.+=")
Override = str | tuple[str, str]
"""A ``--set``, or an option and what that sets."""
_BAGS = "rsltrace.bags"
_FOLDER = "rsltrace.override_folder"


class RosArgsCommand(click.Command):
    """A command that takes ``--ros-args … [--]`` anywhere, as ROS programs do, and whose last words
    may be programs, each after a ``--``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Remove the ROS arguments and the programs before click parses the others."""
        args, programs = split_programs(args)
        own, ctx.meta[_META] = split_ros_arguments(args)
        left = super().parse_args(ctx, own)
        if ctx.resilient_parsing:
            return left
        params = ctx.params
        if params.get("launch") is not None:
            from rsltrace.adapters.launch.file_lookup import launch_file

            launch, words = launch_file(params["launch"], params["words"])
            params.update(launch=launch, words=tuple(words))
        entries = [("--bag", ("bags", {"path": str(path)})) for path in ctx.meta.get(_BAGS, ())]
        if programs is not None:
            from rsltrace.cli.programs import program_entries, program_name

            if params["launch"] is not None or params["words"]:
                given = params["words"][0] if params["words"] else "--launch"
                raise click.UsageError(
                    f"give {given} or programs after '--', not both (--bag, --set and --until go "
                    "with programs, too)"
                )
            named = program_entries(programs)
            ctx.meta[_PROGRAMS] = program_name(named[0])
            written = [f"-- {shlex.join(words)}" for words in programs]
            entries = [*zip(written, named, strict=True), *entries]
        more = (
            (option, f"{key}.+={json.dumps(entry, ensure_ascii=False)}")
            for option, (key, entry) in entries
        )
        params["overrides"] = (*more, *params["overrides"])
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


def _keep_bags(context: click.Context, option: click.Parameter, bags: Sequence[Path]) -> None:
    for bag in bags:
        if not bag.exists() and not context.resilient_parsing:
            raise click.BadParameter(f"there is no bag {bag} (record --export-bag writes one)")
    context.meta[_BAGS] = bags


def _keep_folder(context: click.Context, option: click.Parameter, folder: Path | None) -> None:
    context.meta[_FOLDER] = folder or Path()


def job_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``words``, ``launch``, ``skip`` and ``overrides`` (see ``job_of``) to a command."""
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
                expose_value=False,
                callback=_keep_bags,
                help="Play this recording into the run, as bags: in a job does. Repeatable.",
            ),
            click.option(  # of child processes, whose working directory may be another one
                "--override-folder",
                hidden=True,
                type=click.Path(path_type=Path),
                expose_value=False,
                callback=_keep_folder,
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


def programs_given() -> bool:
    """Return whether this command line names programs in place of a job."""
    return _PROGRAMS in click.get_current_context().meta


def bags_given() -> bool:
    """Return whether this command line names a bag."""
    return bool(click.get_current_context().meta[_BAGS])


def check_named(
    files: Sequence[object], launch: Path | None, overrides: Iterable[Override]
) -> None:
    """Raise UsageError if this command line says nothing that a job could run."""
    texts = (one if isinstance(one, str) else one[1] for one in overrides)
    if not (files or launch or any(text.startswith(_ADDED) for text in texts)):
        raise click.UsageError("Missing argument 'JOB' (or --launch FILE, or -- PROGRAM).")


def override_folder() -> Path:
    """Return where the paths of a command line start."""
    return Path(click.get_current_context().meta[_FOLDER])


def source_name(named: Path, launch: Path | None, text: str | None) -> str:
    """Return what messages and traces call a job of ``job_words``."""
    from rsltrace.job.fields import COMMAND_LINE

    return COMMAND_LINE if text is not None and launch is None else str(named)


def ros_arguments_given() -> tuple[str, ...]:
    """Return the arguments between ``--ros-args`` and ``--`` of this command line."""
    return tuple(click.get_current_context().meta.get(_META, ()))


def job_of(
    words: Sequence[str],
    launch: Path | None,
    skip: bool,
    overrides: Sequence[Override],
) -> tuple[Job, Path]:
    """Return the job, and the path of the file that names it.

    :raises click.UsageError: the arguments contradict each other.
    :raises JobError: the job is wrong.
    """
    from rsltrace.job import job_from_text, load_job

    named, changes, text = job_words(words, launch, skip, overrides)
    folder = override_folder()
    if text is None:
        return load_job(named, overrides=changes, given_in=folder), named
    return job_from_text(
        text, source_name(named, launch, text), named.parent, overrides=changes, given_in=folder
    ), named


def job_words(
    words: Sequence[str],
    launch: Path | None,
    skip: bool,
    overrides: Sequence[Override],
) -> tuple[Path, list[Override], str | None]:
    """Return the path of the job or launch file, all overrides, and the job's text if there is
    no job file.

    :raises click.UsageError: the arguments contradict each other.
    """
    files = [word for word in words if ":=" not in word]
    given = dict(word.split(":=", 1) for word in words if ":=" in word)
    if len(files) > 1:
        raise click.UsageError(f"give one JOB, not {' and '.join(files)}")
    check_named(files, launch, overrides)
    if launch is None and (given or skip):
        what = f"{next(iter(given))}:=… is a launch argument" if given else "--skip-unsupported"
        raise click.UsageError(f"{what}: give the launch file with --launch FILE")
    if launch is not None and launch.suffix == ".mcap":
        raise click.UsageError(f"{launch} is a trace, not a launch file")
    name = click.get_current_context().meta.get(_PROGRAMS, "run")
    named = Path(files[0]) if files else launch or override_folder() / name
    changes = list(overrides)
    if launch is not None:
        spec: dict[str, Any] = {"file": str(launch), "arguments": given}
        if skip:
            spec["skip_unsupported"] = True
        changes.append(("--launch", f"launch.+={json.dumps(spec, ensure_ascii=False)}"))
    ros = click.get_current_context().meta.get(_META, [])
    changes += [f"ros_arguments.+={json.dumps(word)}" for word in _with_paths(ros, named.parent)]
    return named, changes, None if files else "{}"


def all_overrides(
    overrides: Sequence[Override], seed: int | None, until: str | None, last: str | None = None
) -> list[Override]:
    """Return the overrides of ``--set``, then those of ``--seed``, ``--until`` and ``--last``."""
    found: list[Override] = list(overrides)
    if seed is not None:
        found.append(("--seed", f"seed={seed}"))
    if until is not None:
        key = "time" if until.startswith("@") else "duration"
        found.append(("--until", f"stop.{key}={_time(until.removeprefix('@'))}"))
    if last is not None:
        found.append(("--last", f"record.last.duration={_time(last)}"))
    return found


def _time(text: str) -> str:
    return json.dumps(f"{text}s" if text[-1:].isdigit() else text)


def _with_paths(words: Sequence[str], folder: Path) -> list[str]:
    """Return ROS arguments with their paths relative to the job's folder."""
    found = list(words)
    for index, word in enumerate(found[:-1]):
        if word == "--params-file":
            found[index + 1] = os.path.relpath(found[index + 1], folder)
    return found
