"""What ``importlib.metadata`` says of packages that nobody has built: version and entry points."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from importlib.metadata import Distribution, DistributionFinder
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from rsltrace.adapters.workspace.build_files import entry_points, name_and_version
from rsltrace.guard.guard import engage

if TYPE_CHECKING:
    from rsltrace.source_packages import SourcePackage

_NO_VERSION = "0.0.0"


class SourceDistribution(Distribution):
    """A package among sources, as if it were installed."""

    def __init__(self, package: SourcePackage) -> None:
        self._package = package

    def read_text(self, filename: str) -> str | None:
        """Return the text of ``METADATA`` or ``entry_points.txt``, None for other files."""
        with engage(None):
            if filename == "METADATA":
                return _metadata(self._package)
            return _entry_points(self._package) if filename == "entry_points.txt" else None

    def locate_file(self, path: str | os.PathLike[str]) -> Path:
        """Return the place of a file among the sources."""
        return self._package.folder / path


def _metadata(package: SourcePackage) -> str:
    name, version = name_and_version(package.folder)
    if version is None:
        try:
            tree = ElementTree.parse(package.folder / "package.xml")
            version = tree.findtext("version", "").strip() or _NO_VERSION
        except (OSError, ElementTree.ParseError):  # it was there a moment ago
            version = _NO_VERSION
    lines = ("Metadata-Version: 2.1", f"Name: {name or package.name}", f"Version: {version}")
    return "".join(f"{line}\n" for line in lines)


def _entry_points(package: SourcePackage) -> str:
    groups = entry_points(package.folder)
    return "".join(
        f"[{group}]\n" + "".join(f"{name} = {target}\n" for name, target in targets.items())
        for group, targets in groups.items()
    )


def distributions(
    packages: Mapping[str, SourcePackage], context: DistributionFinder.Context
) -> Iterator[SourceDistribution]:
    """Give the packages of a workspace, or that of the name which is asked for."""
    for package in packages.values():
        if context.name is None or _plain(context.name) == _plain(package.name):
            yield SourceDistribution(package)


def _plain(name: str) -> str:
    return name.replace("-", "_").replace(".", "_").lower()
