"""The job of a command line: a job file, a launch file, ``--set``, ``--ros-args``."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.completion import complete_files
from rsltrace.cli.options import set_option
from rsltrace.job.values.mappings import split_ros_arguments

if TYPE_CHECKING:
    from rsltrace.job import Job

_META = "rsltrace.ros_args"


class RosArgsCommand(click.Command):
    """A command that takes ``--ros-args … [--]`` anywhere, as ROS programs do."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Remove the ROS arguments before click parses the others."""
        own, ctx.meta[_META] = split_ros_arguments(args)
        left = super().parse_args(ctx, own)
        if ctx.params.get("launch") is not None and not ctx.resilient_parsing:
            from rsltrace.adapters.launch.file_lookup import launch_file

            launch, words = launch_file(ctx.params["launch"], ctx.params["words"])
            ctx.params.update(launch=launch, words=tuple(words))
        return left


def job_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``words``, ``launch``, ``skip`` and ``overrides`` (see ``job_of``) to a command."""
    for decorate in reversed(
        (
            click.argument(
                "words",
                nargs=-1,
                metavar="[JOB] [NAME:=VALUE]...",
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


def ros_arguments_given() -> tuple[str, ...]:
    """Return the arguments between ``--ros-args`` and ``--`` of this command line."""
    return tuple(click.get_current_context().meta.get(_META, ()))


def job_of(
    words: Sequence[str],
    launch: Path | None,
    skip: bool,
    overrides: Sequence[str | tuple[str, str]],
) -> tuple[Job, Path]:
    """Return the job, and the path of the file that names it.

    :raises click.UsageError: the arguments contradict each other.
    :raises JobError: the job is wrong.
    """
    from rsltrace.job import job_from_text, load_job

    named, changes, text = job_words(words, launch, skip, overrides)
    if text is None:
        return load_job(named, overrides=changes), named
    return job_from_text(text, str(named), named.parent, overrides=changes), named


def job_words(
    words: Sequence[str],
    launch: Path | None,
    skip: bool,
    overrides: Sequence[str | tuple[str, str]],
) -> tuple[Path, list[str | tuple[str, str]], str | None]:
    """Return the path of the job or launch file, all overrides, and the job's text if there is
    no job file.

    :raises click.UsageError: the arguments contradict each other.
    """
    files = [word for word in words if ":=" not in word]
    given = dict(word.split(":=", 1) for word in words if ":=" in word)
    if len(files) > 1:
        raise click.UsageError(f"give one JOB, not {' and '.join(files)}")
    if not files and launch is None:
        raise click.UsageError("Missing argument 'JOB' (or --launch FILE).")
    if launch is None and (given or skip):
        what = f"{next(iter(given))}:=… is a launch argument" if given else "--skip-unsupported"
        raise click.UsageError(f"{what}: give the launch file with --launch FILE")
    if launch is not None and launch.suffix == ".mcap":
        raise click.UsageError(f"{launch} is a trace, not a launch file")
    named = Path(files[0]) if files else launch
    assert named is not None
    changes = list(overrides)
    if launch is not None:
        spec: dict[str, Any] = {"file": str(launch), "arguments": given}
        if skip:
            spec["skip_unsupported"] = True
        changes.append(f"launch.+={json.dumps(spec, ensure_ascii=False)}")
    ros = click.get_current_context().meta.get(_META, [])
    changes += [f"ros_arguments.+={json.dumps(word)}" for word in _with_paths(ros, named.parent)]
    return named, changes, None if files else "{}"


def all_overrides(
    overrides: Sequence[str], seed: int | None, until: str | None
) -> list[str | tuple[str, str]]:
    """Return the overrides of ``--set``, then those of ``--seed`` and ``--until``."""
    found: list[str | tuple[str, str]] = list(overrides)
    if seed is not None:
        found.append(("--seed", f"seed={seed}"))
    if until is not None:
        key = "time" if until.startswith("@") else "duration"
        time = until.removeprefix("@")
        time = f"{time}s" if time[-1:].isdigit() else time
        found.append(("--until", f"stop.{key}={json.dumps(time)}"))
    return found


def _with_paths(words: Sequence[str], folder: Path) -> list[str]:
    """Return ROS arguments with their paths relative to the job's folder."""
    found = list(words)
    for index, word in enumerate(found[:-1]):
        if word == "--params-file":
            found[index + 1] = os.path.relpath(found[index + 1], folder)
    return found
