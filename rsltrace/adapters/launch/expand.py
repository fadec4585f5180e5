"""A job with launch files becomes a job without: their nodes, spelt out."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from rsltrace.adapters.launch import JobExpansion, ros_launch
from rsltrace.adapters.launch.model import LaunchArgument, LaunchResult, argument_words
from rsltrace.adapters.launch.reader import ProgramNeededError, read_launch_file, shown_path
from rsltrace.adapters.launch.specs import node_specs
from rsltrace.adapters.workspace.imports import unbuilt_packages
from rsltrace.child_processes import rsltrace_command
from rsltrace.errors import JobError, did_you_mean
from rsltrace.job import Job, NodeSpec, locate, showing_line
from rsltrace.source_packages import source_packages, workspaces_of
from rsltrace.terminal import tell

# Reads launch files in a process of their own: Python ones are programs.
#
# What they import, print, set and start is none of the run's, nor is it if they end Python.

_OUTPUT_MAX = 1 << 16


def read_in_child_process(
    path: Path, arguments: Mapping[str, str], folders: Sequence[Path]
) -> LaunchResult:
    """Return what a launch file starts; it and what it includes may be in Python.

    ``folders`` are where packages and modules are looked for, before Python's own path. What the
    launch file prints goes to standard error.

    :raises JobError: with file and line, if something in it is wrong, missing or not known here.
    """
    with tempfile.TemporaryDirectory(prefix="rsltrace-") as scratch:
        answer, output = Path(scratch, "answer"), Path(scratch, "output")
        order = {
            "file": str(path),
            "arguments": dict(arguments),
            "folders": [str(folder) for folder in folders],
            "answer": str(answer),
            "path": sys.path,
        }
        with output.open("wb") as stream:
            done = subprocess.run(
                rsltrace_command([json.dumps(order)], __name__),
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                check=False,
            )
        with output.open("rb") as stream:
            said = stream.read(_OUTPUT_MAX).decode("utf-8", "replace").rstrip()
        if said:
            tell(said)
        if not answer.is_file():
            raise JobError(
                f"the launch file ended the process that read it (exit status {done.returncode})",
                where=str(path),
            )
        try:
            found = pickle.loads(answer.read_bytes())
        except Exception:
            found = None
    if isinstance(found, LaunchResult):
        return found
    if isinstance(found, str):
        raise JobError(found)
    raise JobError(
        "the launch file has changed Python or rsltrace, so that what it starts cannot be read",
        where=str(path),
    )


def main(order: Mapping[str, object]) -> None:
    """Do what an order asks, and write the answer: a ``LaunchResult``, or the text of an error."""
    from rsltrace.adapters.launch.api.basics import as_job_error, shown
    from rsltrace.adapters.launch.python_file import read_launch_file

    sys.path[:] = order["path"]  # type: ignore[call-overload]
    folders = [Path(folder) for folder in order["folders"]]  # type: ignore[attr-defined]
    sys.path[:0] = map(str, folders)
    arguments: Mapping[str, str] = order["arguments"]  # type: ignore[assignment]
    sys.argv[:] = ["ros2", "launch", str(order["file"]), *argument_words(arguments)]
    found: LaunchResult | str
    try:
        with unbuilt_packages(folders):
            found = read_launch_file(Path(str(order["file"])), arguments)
    except BaseException as error:
        found = str(as_job_error(error, shown(str(order["file"]))))
    answer = Path(str(order["answer"]))
    ready = answer.with_suffix(".new")
    try:
        data = pickle.dumps(found)
    except Exception as error:
        data = pickle.dumps(
            f"{shown(str(order['file']))}: something that the launch file gives a node is no plain "
            f"value: {error}"
        )
    ready.write_bytes(data)
    ready.rename(answer)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # threads that the launch file has started need not end


def expand(
    job: Job,
    *,
    why_not: Callable[[str, str], str | None],
    is_process: Callable[[str, str], bool],
    programs: bool = True,
    native: bool = False,
) -> JobExpansion:
    """Return a job whose launch files have become nodes.

    A Python launch file is a program, and so is the ``setup.py`` of a package that nobody has
    built: they are run to do so, or not used if ``programs`` is False.
    ``why_not(package, executable)`` says why an executable cannot be simulated, if it cannot, and
    ``is_process`` whether it runs as a process of its own. Only a ``native`` run has programs that
    are no nodes.

    :raises JobError: if a launch file is wrong, or starts what cannot be simulated.
    """
    if not job.launch:
        return JobExpansion(job)
    if not programs:
        return _expand(job, None, why_not, is_process, native)
    folders = [job.resolve(folder) for folder in job.search_path]
    around = [f for spec in job.launch for f in workspaces_of(job.resolve(spec.file))]
    new = [folder for folder in dict.fromkeys(around) if folder not in folders]
    with unbuilt_packages([*folders, *new]):
        expanded = _expand(job, [*folders, *new], why_not, is_process, native)
    job = expanded.job
    named = {spec.executable.partition("/")[0] for spec in job.nodes if spec.executable}
    if new and not named.isdisjoint(source_packages(new)):
        more = [os.path.relpath(folder, job.base_dir) for folder in new]
        job = job.replace(search_path=[*job.search_path, *more])
    return JobExpansion(job, expanded.notes)


def _expand(
    job: Job,
    folders: Sequence[Path] | None,
    why_not: Callable[[str, str], str | None],
    is_process: Callable[[str, str], bool],
    native: bool,
) -> JobExpansion:
    """Do so; ``folders`` are those of packages and modules, None if no programs are to run."""
    nodes: list[NodeSpec] = list(job.nodes)
    notes: list[str] = []
    for index, spec in enumerate(job.launch):
        launched = _read(job, index, folders)
        nodes += node_specs(
            launched,
            skip_unsupported=spec.skip_unsupported,
            why_not=why_not,
            is_process=is_process,
            before=nodes,
            native=native,
        )
        notes += [f"left out: {item}" for item in launched.unsupported]
        notes += launched.ignored
    if not nodes and not job.bags:
        where = locate(job, ("launch", 0, "file"))
        if not where[-1:].isdigit():  # on the command line, or made in Python
            where = shown_path(job.resolve(job.launch[0].file))
        raise JobError("the launch file starts nothing that can be simulated", where=where)
    return JobExpansion(job.replace(nodes=nodes, launch=()), tuple(notes))


def _read(job: Job, index: int, folders: Sequence[Path] | None) -> LaunchResult:
    spec = job.launch[index]
    path = job.resolve(spec.file)
    try:
        read = ros_launch.read_launch_file if ros_launch.can_read(path) else read_launch_file
        launched = read(path, spec.arguments)
    except ProgramNeededError:
        if folders is None:
            raise JobError("a Python launch file is a program", where=shown_path(path)) from None
        launched = read_in_child_process(path, spec.arguments, folders)
    _check_known(job, index, launched.arguments)
    return launched


def _check_known(job: Job, index: int, known: Mapping[str, LaunchArgument]) -> None:
    """Raise ``JobError`` if an argument is given that no launch file declares."""
    spec = job.launch[index]
    for name in spec.arguments:
        if name in known:
            continue
        listed = "".join(f"\n  {argument}" for argument in known.values()) or " none"
        loc = ("launch", index, "arguments", name)
        where = locate(job, loc)
        in_file = where[-1:].isdigit()  # not on the command line, nor made in Python
        of = f" of {spec.file}" if in_file else ""
        wrong = (
            f"unknown launch argument {name!r}{of}{did_you_mean(name, known)}\nthere are:{listed}"
        )
        with showing_line(job, loc):
            shown = where if in_file else os.path.relpath(job.resolve(spec.file))
            raise JobError(wrong, where=shown)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
