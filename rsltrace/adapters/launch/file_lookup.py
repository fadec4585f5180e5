"""Finds the launch file that a command line names: a path, or a package and a file of it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from rsltrace.errors import JobError, did_you_mean
from rsltrace.job.reading.substitute import package_prefix
from rsltrace.job.values.mappings import near_path
from rsltrace.source_packages import source_packages

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
