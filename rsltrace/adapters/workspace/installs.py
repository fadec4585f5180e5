"""What the build files of a package would install: files and folders, modules, executables."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath

from rsltrace.adapters.workspace.build_files import (
    console_scripts_in,
    entry_points,
    package_dir,
    packages,
    setup_py,
    source_root,
)
from rsltrace.adapters.workspace.cache import cached_folder, key_of
from rsltrace.adapters.workspace.cmake import CMakeCommand, commands, is_expanded
from rsltrace.source_packages import SourcePackage, source_packages

_KINDS = ("DIRECTORY", "FILES", "PROGRAMS")
_OPTIONS = frozenset(
    "DESTINATION TYPE RENAME PATTERN REGEX FILES_MATCHING EXCLUDE USE_SOURCE_PERMISSIONS "
    "PERMISSIONS FILE_PERMISSIONS DIRECTORY_PERMISSIONS CONFIGURATIONS COMPONENT OPTIONAL "
    "EXCLUDE_FROM_ALL MESSAGE_NEVER DIRECTORY FILES PROGRAMS".split()
)
"""The keywords of ``install``, each of which ends the list before it."""
_PYTHON_PACKAGE, _PYTHON_MODULE = "ament_python_install_package", "ament_python_install_module"
_PROGRAMS = ("add_executable", "ament_auto_add_executable")
_NO_MODULES = frozenset("test tests launch setup conftest scripts doc docs config resource".split())


def installed_files(package: SourcePackage, *, ask: bool = True) -> Iterator[tuple[str, Path]]:
    """Give where each file or folder would be installed below the prefix, and where it is now.

    Unless ``ask``, no ``setup.py`` is run to find out.
    """
    setup = setup_py(package.folder) if ask else {}
    for folder, files in setup.get("data_files", ()):
        for file in files:
            yield f"{folder}/{os.path.basename(file)}", package.folder / file
    for file in setup.get("scripts", ()):
        yield f"lib/{package.name}/{os.path.basename(file)}", package.folder / file
    for command in commands(package):
        yield from _installed(command)


def _installed(command: CMakeCommand) -> Iterator[tuple[str, Path]]:
    """Give what an ``install`` of ``CMakeLists.txt`` puts where."""
    words = command.words
    if command.name != "install" or words[:1] not in [(kind,) for kind in _KINDS]:
        return
    (target,) = _values(words, "DESTINATION")[:1] or ("",)
    target = target.strip("/")
    renamed = _values(words, "RENAME")
    for source in filter(is_expanded, _values(words, words[0])):
        path = command.folder / source
        if words[0] == "DIRECTORY" and source.endswith("/") and path.is_dir():
            for child in sorted(path.iterdir()):
                yield f"{target}/{child.name}", child
        else:
            yield f"{target}/{renamed[0] if renamed else path.name}", path


def _values(words: Sequence[str], keyword: str) -> list[str]:
    """Return the words after a keyword of ``install``, up to the next one."""
    if keyword not in words:
        return []
    rest = words[words.index(keyword) + 1 :]
    return list(takewhile(lambda word: word not in _OPTIONS, rest))


def executables(package: SourcePackage) -> dict[str, str | Path]:
    """Return what ``ros2 run`` would find: ``module:function`` or a script, by name."""
    found: dict[str, str | Path] = dict(_console_scripts(package))
    for place, source in installed_files(package):
        folder, _, name = place.rpartition("/")
        if folder == f"lib/{package.name}" and source.is_file():
            found.setdefault(name, source)
    return found


def compiled_executables(package: SourcePackage) -> set[str]:
    """Return the names of the programs that a package has to be built for."""
    found = set()
    for command in commands(package):
        if command.name in _PROGRAMS:
            found |= set(command.words[:1])
        elif command.name == "rclcpp_components_register_node":
            found |= set(_option(command, "EXECUTABLE"))
    return set(filter(is_expanded, found))


def unknown_installs(package: SourcePackage) -> list[str]:
    """Say which files and modules are installed that have no name before the package is configured,
    with the line of ``CMakeLists.txt``."""
    said = (
        command.unknown()
        for command in commands(package)
        if (command.name == "install" and command.words[:1] in [(kind,) for kind in _KINDS])
        or command.name in (*_PROGRAMS, _PYTHON_PACKAGE, _PYTHON_MODULE)
    )
    return [one for one in said if one is not None]


def modules(package: SourcePackage) -> dict[str, Path]:
    """Return the modules that a package would install, by name: files, or folders with modules."""
    found = {**_modules_of_build_files(package.folder), **_modules_of_cmake(package)}
    for place in dict.fromkeys((package.folder, package.folder / source_root(package.folder))):
        for init in sorted(place.glob("*/__init__.py")):
            if init.parent.name not in _NO_MODULES:
                found.setdefault(init.parent.name, init.parent)
        if any((place / package.name).glob("*.py")):  # without __init__.py: a namespace package
            found.setdefault(package.name, place / package.name)
    return {name: path for name, path in found.items() if _is_module(name, path)}


def _is_module(name: str, path: Path) -> bool:
    """Whether a path is a module; find_namespace_packages() takes every folder for one."""
    is_package = (path / "__init__.py").is_file()
    return path.is_file() or is_package or (path.is_dir() and name not in _NO_MODULES)


def _modules_of_build_files(folder: Path) -> dict[str, Path]:
    given = package_dir(folder)
    root = folder / source_root(folder)
    setup = setup_py(folder)
    found = {str(name): root / f"{name}.py" for name in setup.get("py_modules", ())}
    for name in {name.partition(".")[0] for name in packages(folder)}:
        found[name] = folder / given[name] if name in given else root / name
    return found


def _modules_of_cmake(package: SourcePackage) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for command in commands(package):
        words = command.words
        if command.name == _PYTHON_PACKAGE and words and is_expanded(words[0]):
            folder = _option(command, "PACKAGE_DIR")[:1] or [words[0]]
            if is_expanded(folder[0]):
                found[words[0]] = command.folder / folder[0]
        elif command.name == _PYTHON_MODULE and words and is_expanded(words[0]):
            path = command.folder / words[0]
            found[path.stem] = path
    return found


def _option(command: CMakeCommand, keyword: str) -> list[str]:
    """Return the word after a keyword, if it is there."""
    words = command.words
    return list(words[words.index(keyword) + 1 :][:1]) if keyword in words else []


def module_folders(folders: Iterable[Path], *, ask: bool = True) -> list[Path]:
    """Return where the modules of the packages in and below some folders lie.

    Unless ``ask``, no ``setup.py`` is run to find out: they may lie where people have them.
    """
    packages = source_packages(folders).values()
    if not ask:
        return [place for one in packages for place in (one.folder, one.folder / "src")]
    return list(dict.fromkeys(path.parent for one in packages for path in modules(one).values()))


def _console_scripts(package: SourcePackage) -> dict[str, str]:
    found = dict(entry_points(package.folder).get("console_scripts", {}))
    for command in commands(package):  # ament_python_install_package(NAME SETUP_CFG FILE)
        if command.name == _PYTHON_PACKAGE and command.words:
            given = _option(command, "SETUP_CFG") or [
                f"{path}/../setup.cfg" for path in _option(command, "PACKAGE_DIR")
            ]
            for file in filter(is_expanded, given):
                found |= console_scripts_in(command.folder / file)
    return {name: target.partition("[")[0].strip() for name, target in found.items()}


# Lays out what a package would have installed below ``share``, as links to its sources.
#
# Everything lies where it lies in the package's folder (``config``, ``launch``, ``urdf``), and
# also where ``setup.py`` (``data_files``) or ``CMakeLists.txt`` (``install``) puts it.

_INDEX = "share/ament_index/resource_index/packages"
_NOT_INSTALLED = frozenset(("setup.py", "setup.cfg", "CMakeLists.txt", "test", "src", "include"))


class _LinkTree:
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
    tree = _LinkTree()
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
