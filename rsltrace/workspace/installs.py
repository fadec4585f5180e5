"""What the build files of a package would install: files and folders, modules, executables.

Of ``CMakeLists.txt`` the plain words are read.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from rsltrace.source_packages import SourcePackage, source_packages
from rsltrace.workspace.build_files import entry_points, setup_cfg, setup_py, text_mapping

_COMMENT = re.compile(r"#[^\n]*")
_INSTALL = re.compile(r"\binstall\s*\(\s*(DIRECTORY|FILES|PROGRAMS)\b([^)]*)\)", re.IGNORECASE)
_PYTHON_PACKAGE = re.compile(r"\bament_python_install_package\s*\(\s*([\w./-]+)([^)]*)\)")
_PROJECT = re.compile(r"\bproject\s*\(\s*([\w-]+)", re.IGNORECASE)
_PROGRAM = re.compile(
    r"\b(?:ament_auto_)?add_executable\s*\(\s*([^\s)]+)"
    r"|\brclcpp_components_register_node\s*\([^)]*\bEXECUTABLE\s+([^\s)]+)",
    re.IGNORECASE,
)
_RENAME = re.compile(r"\bRENAME\s+(\S+)")
_END = re.compile(
    r"\b(?:PATTERN|REGEX|FILES_MATCHING|USE_SOURCE_PERMISSIONS|PERMISSIONS|OPTIONAL|RENAME)\b.*",
    re.DOTALL,
)
_NO_MODULES = frozenset("test tests launch setup conftest scripts doc docs config resource".split())


def installed_files(package: SourcePackage) -> Iterator[tuple[str, Path]]:
    """Give where each file or folder would be installed below the prefix, and where it is now."""
    setup = setup_py(package.folder)
    for folder, files in setup.get("data_files", ()):
        for file in files:
            yield f"{folder}/{os.path.basename(file)}", package.folder / file
    for file in setup.get("scripts", ()):
        yield f"lib/{package.name}/{os.path.basename(file)}", package.folder / file
    for kind, words in _INSTALL.findall(_cmake(package)):
        sources, _, rest = _END.sub("", words).partition("DESTINATION")
        target = (rest.split() or [""])[0].strip('"')
        renamed = _RENAME.search(words)
        for source in (word.strip('"') for word in sources.split()):
            path = package.folder / source
            if kind.upper() == "DIRECTORY" and source.endswith("/") and path.is_dir():
                for child in sorted(path.iterdir()):
                    yield f"{target}/{child.name}", child
            else:
                yield f"{target}/{renamed[1] if renamed else path.name}", path


def executables(package: SourcePackage) -> dict[str, str | Path]:
    """Return what ``ros2 run`` would find: ``module:function`` or a script, by name."""
    found: dict[str, str | Path] = dict(_console_scripts(package.folder))
    for place, source in installed_files(package):
        folder, _, name = place.rpartition("/")
        if folder == f"lib/{package.name}" and source.is_file():
            found.setdefault(name, source)
    return found


def compiled_executables(package: SourcePackage) -> set[str]:
    """Return the names of the programs that a package has to be built for, as far as they are
    written out."""
    return {(name or other).strip('"') for name, other in _PROGRAM.findall(_cmake(package))}


def modules(package: SourcePackage) -> dict[str, Path]:
    """Return the modules that a package would install, by name: files, or folders with modules."""
    setup = setup_py(package.folder)
    given = text_mapping(setup.get("package_dir"))
    root = package.folder / (given.get("") or _source_root(package.folder))
    found: dict[str, Path] = {}
    for name in setup.get("py_modules", ()):
        found[name] = root / f"{name}.py"
    for name in {str(name).partition(".")[0] for name in setup.get("packages", ())}:
        found[name] = package.folder / given[name] if name in given else root / name
    for name, words in _PYTHON_PACKAGE.findall(_cmake(package)):
        folder = re.search(r"\bPACKAGE_DIR\s+(\S+)", words)
        found[name] = package.folder / (folder[1].strip('"') if folder else name)
    for place in (package.folder, root):
        for init in sorted(place.glob("*/__init__.py")):
            if init.parent.name not in _NO_MODULES:
                found.setdefault(init.parent.name, init.parent)
    return {name: path for name, path in found.items() if path.exists()}


def module_folders(folders: Iterable[Path], *, ask: bool = True) -> list[Path]:
    """Return where the modules of the packages in and below some folders lie.

    Unless ``ask``, no ``setup.py`` is run to find out: they may lie where people have them.
    """
    packages = source_packages(folders).values()
    if not ask:
        return [place for one in packages for place in (one.folder, one.folder / "src")]
    return list(dict.fromkeys(path.parent for one in packages for path in modules(one).values()))


def _source_root(folder: Path) -> str:
    """Return the folder of the modules as ``setup.cfg`` has it, or as people have it."""
    options = setup_cfg(folder)
    given = options.get("options", "package_dir", fallback="").strip()
    if given.startswith("="):
        return given[1:].strip()
    return "src" if (folder / "src").is_dir() and not (folder / "CMakeLists.txt").is_file() else "."


def _console_scripts(folder: Path) -> dict[str, str]:
    found = entry_points(folder).get("console_scripts", {})
    return {name: target.partition("[")[0].strip() for name, target in found.items()}


def _cmake(package: SourcePackage) -> str:
    """Return ``CMakeLists.txt`` without comments, with what a project's own variables stand for."""
    try:
        text = (package.folder / "CMakeLists.txt").read_text("utf-8", "replace")
    except OSError:
        return ""
    text = _COMMENT.sub("", text)
    project = _PROJECT.search(text)
    for name in ("PROJECT_NAME", "CMAKE_PROJECT_NAME"):
        text = text.replace(f"${{{name}}}", project[1] if project else package.name)
    for name in ("CMAKE_CURRENT_SOURCE_DIR", "PROJECT_SOURCE_DIR", "CMAKE_SOURCE_DIR"):
        text = text.replace(f"${{{name}}}", str(package.folder))
    return text


__all__ = [
    "compiled_executables",
    "executables",
    "installed_files",
    "module_folders",
    "modules",
]
