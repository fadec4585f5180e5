"""Lays out what a package would have installed below ``share``, as links to its sources.

Everything lies where it lies in the package's folder (``config``, ``launch``, ``urdf``), and also
where ``setup.py`` (``data_files``) or ``CMakeLists.txt`` (``install``) puts it.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from rsltrace.adapters.workspace.cache import cached_folder, key_of
from rsltrace.adapters.workspace.installs import installed_files
from rsltrace.source_packages import SourcePackage

_INDEX = "share/ament_index/resource_index/packages"
_NOT_INSTALLED = frozenset(("setup.py", "setup.cfg", "CMakeLists.txt", "test", "src", "include"))


class _Tree:
    """Links by where they are to be: a folder that is linked is opened if more is put into it."""

    def __init__(self) -> None:
        self.links: dict[PurePosixPath, Path] = {}

    def put(self, place: PurePosixPath, source: Path) -> None:
        if place in self.links or any(place in link.parents for link in self.links):
            return
        for parent in place.parents:
            opened = self.links.get(parent)
            if opened is not None:
                if (opened / place.relative_to(parent)).exists():
                    return
                del self.links[parent]
                for child in sorted(opened.iterdir()):
                    self.links[parent / child.name] = child
                self.put(place, source)
                return
        self.links[place] = source


def share_prefix(package: SourcePackage) -> Path:
    """Return a prefix in which ``share/<package>`` has what the package would have installed."""
    tree = _Tree()
    for path in sorted(package.folder.iterdir()):
        if not path.name.startswith(".") and path.name not in _NOT_INSTALLED:
            tree.put(PurePosixPath(path.name), path)
    for target, source in installed_files(package):
        place = _below_share(target, package.name)
        if place is not None and source.exists():
            tree.put(place, source)
    links = sorted((str(place), str(source)) for place, source in tree.links.items())
    key = key_of([package.name, *(text for link in links for text in link)])

    def make(into: Path) -> None:
        mark = into / _INDEX / package.name
        mark.parent.mkdir(parents=True)
        mark.touch()
        for place, source in links:
            link = into / "share" / package.name / place
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(source)

    return cached_folder("shares", f"{package.name}-{key}", make)


def _below_share(folder: str, package: str) -> PurePosixPath | None:
    """Return a folder relative to ``share/<package>``, or None if it is not below that."""
    parts = PurePosixPath(folder).parts
    if parts[:2] != ("share", package) or ".." in parts:
        return None
    return PurePosixPath(*parts[2:])


__all__ = ["share_prefix"]
