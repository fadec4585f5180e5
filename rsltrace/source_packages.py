"""Finds ROS packages in source folders, as colcon does: by ``package.xml``."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

_MARK = "package.xml"
_KINDS = ("msg", "srv", "action")
_IGNORED = ("COLCON_IGNORE", "AMENT_IGNORE", "CATKIN_IGNORE")
_NO_SOURCES = frozenset("build install log site-packages dist-packages node_modules venv".split())
_DEPTH_MAX = 6
_FOLDERS_MAX = 5_000
"""A search path may be somebody's home folder; what lies further off has to be named."""


@dataclass(frozen=True)
class SourcePackage:
    """A ROS package by its name and the folder with its ``package.xml``."""

    name: str
    folder: Path

    @cached_property
    def interfaces(self) -> tuple[Path, ...]:
        """The ``.msg``, ``.srv`` and ``.action`` files, relative to ``folder``, sorted.

        Each lies below a folder of the name of its kind.
        """
        found = []
        for folder in _walk(self.folder, inside=True):
            for kind in set(_KINDS).intersection(folder.relative_to(self.folder).parts):
                found += [path for path in folder.glob(f"*.{kind}") if path.is_file()]
        return tuple(sorted(path.relative_to(self.folder) for path in found))


def source_packages(folders: Iterable[Path]) -> dict[str, SourcePackage]:
    """Return the packages in and below some folders, or around them, by name; the first counts."""
    found: dict[str, SourcePackage] = {}
    for folder in folders:
        for package in (*_around(folder), *_below(folder)):
            found.setdefault(package.name, package)
    return found


def sourced_package(name: str) -> SourcePackage | None:
    """Return the share of a package of the sourced ROS, if it has definitions of interfaces."""
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        share = Path(prefix, "share", name)
        if any((share / kind).is_dir() for kind in _KINDS):
            return SourcePackage(name, share)
    return None


def workspaces_of(file: Path) -> list[Path]:
    """Return the folders of the workspace that a file's package lies in; none if it has none.

    That is a ``src`` around the package; else a checkout or the package itself, and around it the
    working directory, where colcon searches.
    """
    above = file.resolve().parents
    own = next((folder for folder in above[:_DEPTH_MAX] if (folder / _MARK).is_file()), None)
    if own is None:
        return []
    around = own.parents[:_DEPTH_MAX]
    for folder in (own, *around):
        if folder != own and folder.name == "src":
            return [folder]
        if (folder / ".git").exists():
            own = folder
            break
    return [own, *(folder for folder in around if folder in own.parents and folder == Path.cwd())]


def _around(folder: Path) -> Iterator[SourcePackage]:
    """Give the package that a folder is a part of."""
    for parent in list(folder.parents)[:_DEPTH_MAX]:
        if (parent / _MARK).is_file():
            yield from _package_in(parent)
            return


def _below(folder: Path) -> Iterator[SourcePackage]:
    for place in _walk(folder, inside=False):
        if (place / _MARK).is_file():
            yield from _package_in(place)


def _package_in(folder: Path) -> Iterator[SourcePackage]:
    try:
        name = ElementTree.parse(folder / _MARK).findtext("name", "").strip()
    except (OSError, ElementTree.ParseError):
        return  # colcon passes over it, too
    if name.isidentifier():
        yield SourcePackage(name, folder)


def _walk(top: Path, *, inside: bool) -> Iterator[Path]:
    """Give the folders that may hold sources, in order of names; packages hold no others."""
    waiting = [(top, 0)]
    for _ in range(_FOLDERS_MAX):
        if not waiting:
            return
        folder, depth = waiting.pop()
        try:
            with os.scandir(folder) as listed:
                entries = sorted(
                    (entry.name, entry.is_dir(follow_symlinks=not depth)) for entry in listed
                )
        except OSError:
            continue
        names = {name for name, _ in entries}
        if not names.isdisjoint(_IGNORED) and depth:
            continue
        is_package = _MARK in names
        if inside and is_package and depth:
            continue
        yield folder
        if depth < _DEPTH_MAX and (inside or not is_package):
            waiting += [
                (folder / name, depth + 1)
                for name, is_folder in reversed(entries)
                if is_folder and not name.startswith(".") and name not in _NO_SOURCES
            ]
