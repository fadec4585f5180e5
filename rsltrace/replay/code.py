"""Find the code files that a job would run, without importing any."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from rsltrace.adapters.workspace.installs import installed_files, module_folders
from rsltrace.errors import JobError
from rsltrace.job import Job
from rsltrace.job.values.checks import target_text
from rsltrace.run.plans.executables import executable_file, executable_source
from rsltrace.source_packages import source_packages
from rsltrace.trace.model.module_search import find_module

_OF_FILES = "file:"


@dataclass(frozen=True, slots=True)
class JobCodeFile:
    """A module (or script, or data file) of a job, and what has become of it since the recording.

    ``file`` is None where there is none. ``recorded`` and ``present`` are the first 16 hex digits
    of the file's SHA-256, empty where unknown: of what is installed, a trace holds the version.
    """

    name: str
    file: Path | None
    recorded: str
    present: str

    @property
    def change(self) -> str:
        """What has changed since, empty if nothing has as far as is known."""
        if self.file is None:
            return "is not here"
        return "has changed" if self.recorded and self.recorded != self.present else ""


def job_code_files(job: Job, sources: dict[str, str]) -> tuple[JobCodeFile, ...]:
    """Return the code files of a job; ``sources`` are their hashes in a trace."""
    places = [job.resolve(folder) for folder in job.search_path]
    if any(spec.executable is not None for spec in job.nodes):
        places += module_folders(places, ask=False)  # nothing is run to find out
    folders = [str(folder) for folder in places]
    named = dict.fromkeys(name for name in sources if not name.startswith(_OF_FILES))
    found = {name: module_file(name, folders) for name in named}
    for name, file in _named_by(job, folders):
        found.setdefault(name, file)
    for _, path in job.model_files():
        found[f"{_OF_FILES}{path}"] = job.resolve(path)
    return tuple(_code(name, file, sources.get(name, "")) for name, file in found.items())


def _code(name: str, file: Path | None, recorded: str) -> JobCodeFile:
    there = file is not None and file.is_file()  # no device, no pipe
    present = ""
    if there and recorded:
        assert file is not None
        with suppress(OSError):
            present = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    return JobCodeFile(name.removeprefix(_OF_FILES), file if there else None, recorded, present)


def _named_by(job: Job, folders: Sequence[str]) -> Iterator[tuple[str, Path | None]]:
    """Yield the modules and files that the job itself names, not what they import."""
    targets: list[Any] = [job.hooks.before, job.hooks.after, job.stop.function]
    targets.append(None if job.policy is None else job.policy.function)
    targets += [spec.node or spec.main for spec in job.nodes]
    for target in targets:
        if target is not None:
            module = target_text(target).partition(":")[0]
            yield module, module_file(module, folders)
    for spec in job.nodes:
        if spec.executable is not None:
            yield from _executable(spec.executable, folders)
        elif spec.script is not None:
            yield f"{_OF_FILES}{spec.script}", job.resolve(spec.script)
        elif spec.module is not None:
            inside = f"{spec.module}.__main__"
            file = module_file(inside, folders)
            yield (
                (spec.module, module_file(spec.module, folders)) if file is None else (inside, file)
            )
    for launch in job.launch:
        yield launch.file, job.resolve(launch.file)


def _executable(name: str, folders: Sequence[str]) -> Iterator[tuple[str, Path | None]]:
    file = executable_file(name) or _unbuilt_script(name, folders)
    if file is not None:
        yield f"{_OF_FILES}{name}", file
        return
    try:
        found = executable_source(name, where="")
    except JobError:
        if not any(Path(folder, "package.xml").is_file() for folder in folders):
            yield name, None  # else it is one of an unbuilt package
        return
    module = str(found).partition(":")[0]
    yield module, module_file(module, folders)


def _unbuilt_script(target: str, folders: Sequence[str]) -> Path | None:
    """Return the script that ``CMakeLists.txt`` of an unbuilt package installs as an executable."""
    package = source_packages(map(Path, folders)).get(target.partition("/")[0])
    installed = {} if package is None else dict(installed_files(package, ask=False))
    return installed.get(f"lib/{target}")


def module_file(module: str, folders: Sequence[str], *, installed: bool = True) -> Path | None:
    """Return the file a module would be loaded from: of ``folders``, then (``installed``) of
    Python's path."""
    if installed:
        spec = find_module(module, [*folders, *sys.path], _editable_spec)
    else:
        spec = find_module(module, folders)
    if spec is None or not spec.origin or not spec.has_location:
        return None
    return Path(spec.origin)


def _editable_spec(module: str) -> ModuleSpec | None:
    """Ask the finders of packages installed in editable mode."""
    for finder in sys.meta_path:
        if finder is not PathFinder and "editable" in f"{finder!r}".lower():
            with suppress(Exception):
                return finder.find_spec(module, None)
    return None
