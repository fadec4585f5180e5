"""Lays out what a package would have installed below ``share``, as links to its sources.

Everything lies where it lies in the package's folder (``config``, ``launch``, ``urdf``), and also
where ``setup.py`` (``data_files``) or ``CMakeLists.txt`` (``install``) puts it.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from rsltrace.workspace.cache import cached_folder, key_of
from rsltrace.workspace.packages import SourcePackage

_INDEX = "share/ament_index/resource_index/packages"
_NOT_INSTALLED = frozenset(("setup.py", "setup.cfg", "CMakeLists.txt", "test", "src", "include"))
_COMMENT = re.compile(r"#[^\n]*")
_INSTALL = re.compile(r"\binstall\s*\(\s*(DIRECTORY|FILES|PROGRAMS)\b([^)]*)\)", re.IGNORECASE)
_PROJECT = re.compile(r"\bproject\s*\(\s*([\w-]+)", re.IGNORECASE)
_END = re.compile(
    r"\b(?:PATTERN|REGEX|FILES_MATCHING|USE_SOURCE_PERMISSIONS|PERMISSIONS|OPTIONAL|RENAME)\b.*",
    re.DOTALL,
)
_ASK = """
import json, sys, types
sys.stdout = sys.stderr
said = {}
class Setuptools(types.ModuleType):
    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *words, **named: []
for name in ("setuptools", "distutils", "distutils.core", "setuptools.command"):
    sys.modules[name] = Setuptools(name)
    sys.modules[name].setup = lambda *words, **named: said.update(named)
code = compile(open("setup.py", "rb").read(), "setup.py", "exec")
sys.path.insert(0, "")
sys.argv[:] = ["setup.py"]
exec(code, {"__name__": "__main__", "__file__": "setup.py"})
files = [(str(to), [str(file) for file in files]) for to, files in said.get("data_files") or ()]
sys.stdout.flush()
json.dump(files, sys.__stdout__)
"""
"""Finds out what a ``setup.py`` tells setuptools, without setuptools."""
_ASK_SECONDS = 60


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
    for place, source in (*_of_setup(package), *_of_cmake(package)):
        if source.exists():
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


def _of_setup(package: SourcePackage) -> Iterator[tuple[PurePosixPath, Path]]:
    """Give what ``data_files`` puts below ``share/<package>``."""
    if not (package.folder / "setup.py").is_file():
        return
    try:
        done = subprocess.run(
            [sys.executable, "-c", _ASK],
            cwd=package.folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_ASK_SECONDS,
            check=False,
        )
        listed = json.loads(done.stdout or "[]")
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return  # what lies in its folder is there all the same
    for folder, files in listed:
        below = _below_share(folder, package.name)
        if below is not None:
            for file in files:
                yield below / os.path.basename(file), package.folder / file


def _of_cmake(package: SourcePackage) -> Iterator[tuple[PurePosixPath, Path]]:
    """Give what ``install`` puts below ``share/<package>``, as far as it says so in plain words."""
    try:
        text = (package.folder / "CMakeLists.txt").read_text("utf-8", "replace")
    except OSError:
        return
    text = _COMMENT.sub("", text)
    project = _PROJECT.search(text)
    for name in ("PROJECT_NAME", "CMAKE_PROJECT_NAME"):
        text = text.replace(f"${{{name}}}", project[1] if project else package.name)
    for name in ("CMAKE_CURRENT_SOURCE_DIR", "PROJECT_SOURCE_DIR", "CMAKE_SOURCE_DIR"):
        text = text.replace(f"${{{name}}}", str(package.folder))
    for kind, words in _INSTALL.findall(text):
        sources, _, rest = _END.sub("", words).partition("DESTINATION")
        target = (rest.split() or [""])[0].strip('"')
        below = _below_share(target, package.name)
        if below is None:
            continue
        for source in (word.strip('"') for word in sources.split()):
            path = package.folder / source
            if kind.upper() == "DIRECTORY" and source.endswith("/") and path.is_dir():
                for child in sorted(path.iterdir()):
                    yield below / child.name, child
            else:
                yield below / path.name, path


def _below_share(folder: str, package: str) -> PurePosixPath | None:
    """Return a folder relative to ``share/<package>``, or None if it is not below that."""
    parts = PurePosixPath(folder).parts
    if parts[:2] != ("share", package) or ".." in parts:
        return None
    return PurePosixPath(*parts[2:])


__all__ = ["share_prefix"]
