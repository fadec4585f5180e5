"""Which files to look at: those of a path, or those that a job's nodes come from, and no others."""

from __future__ import annotations

import ast
import io
import os
import re
import sys
import tokenize
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from pathlib import Path

from rsltrace.guard.audit.scopes import Module, parse_scopes
from rsltrace.trace.model.module_search import find_module
from rsltrace.trace.model.regular_file import read_regular

_INSTALLED = {"site-packages", "dist-packages"}
_NOT_SOURCES = {"build", "install", "log", "node_modules", "__pycache__"}
_ALLOW = re.compile(r"#.*\brsltrace:\s*allow\b(?P<kinds>[\w ,\t-]*)")


@dataclass(eq=False)
class SourceFile:
    """A Python file to look at. ``allowed`` has the kinds that a comment allows, by line; an empty
    set allows all."""

    path: Path
    module: Module
    as_script: bool = False
    allowed: dict[int, frozenset[str]] = field(default_factory=dict)


def read_source(path: Path, name: str, *, as_script: bool = False) -> SourceFile:
    """Return a file taken apart.

    :raises OSError, SyntaxError, ValueError: if it is no Python source.
    """
    data = io.BytesIO(read_regular(path))
    encoding, _ = tokenize.detect_encoding(data.readline)
    data.seek(0)
    text = io.TextIOWrapper(data, encoding).read()
    tree = ast.parse(text, str(path))
    module = parse_scopes(tree, name, is_package=path.name == "__init__.py")
    return SourceFile(path, module, as_script, _allowed(text))


def _allowed(text: str) -> dict[int, frozenset[str]]:
    found = {}
    for number, line in enumerate(text.splitlines(), 1):
        match = _ALLOW.search(line)
        if match is not None:
            kinds = match["kinds"].split(" -", 1)[0]  # what follows a dash is the reason
            found[number] = frozenset(re.split(r"[\s,]+", kinds.strip())) - {""}
    return found


class Collection:
    """Files by module name, each once, with those that could not be read."""

    def __init__(self) -> None:
        self.files: dict[str, SourceFile] = {}
        self.troubles: list[str] = []
        self.notes: list[str] = []
        self._paths: set[Path] = set()

    def add(self, path: Path, name: str, *, as_script: bool = False) -> SourceFile | None:
        """Read a file that was not read yet, and return it."""
        real = path.resolve()
        if real in self._paths:
            return None
        self._paths.add(real)
        try:
            source = read_source(path, name, as_script=as_script)
        except SyntaxError as error:
            self.troubles.append(f"{path}:{error.lineno or 1}: not Python: {error.msg}")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            self.troubles.append(f"{path}: cannot be read: {reason}")
        else:
            unique = name
            while unique in self.files:
                unique += "'"  # two files of one name in different folders
            source.module.name = name
            self.files[unique] = source
            return source
        return None


def collect_path(path: Path) -> Collection:
    """Return the Python file at a path, or those below a folder."""
    found = Collection()
    if path.is_dir():
        for file in _below(path):
            found.add(file, module_name(file))
    else:
        found.add(path, module_name(path), as_script=True)
    return found


def _below(folder: Path) -> Iterator[Path]:
    for here, folders, files in os.walk(folder):
        if "pyvenv.cfg" in files:
            folders.clear()
            continue
        top = Path(here) == folder
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".") and not (name in _NOT_SOURCES and (top or name[0] == "_"))
        )
        yield from (Path(here, name) for name in sorted(files) if name.endswith(".py"))


def module_name(path: Path) -> str:
    """Return the full name of a file's module: as far up as there are packages."""
    path = path.absolute()
    parts = [] if path.name == "__init__.py" else [path.stem]
    folder = path.parent
    while (folder / "__init__.py").exists():
        parts.insert(0, folder.name)
        folder = folder.parent
    return ".".join(parts)


def collect_modules(
    names: Sequence[str],
    scripts: Sequence[Path],
    folders: Sequence[Path],
    programs: AbstractSet[str] = frozenset(),
) -> tuple[Collection, list[str]]:
    """Return modules by name, and what they import as far as it is the user's own; also the names
    that were not found. ``programs`` are those that ``python -m`` runs.

    The user's own are modules below ``folders`` (no virtual environment there), and of an installed
    package those of the package itself.
    """
    found = Collection()
    path = [*map(str, folders), *sys.path]
    missing = []
    waiting: list[tuple[str, str]] = [(name, name.partition(".")[0]) for name in names]
    for script in scripts:
        source = found.add(script, "__main__", as_script=True)
        if source is not None:
            waiting += [(name, "") for name in sorted(source.module.imports)]
            path.insert(0, str(script.parent))
    wanted = set(names)
    seen = set()
    while waiting:
        name, package = waiting.pop(0)
        if (name, package) in seen:
            continue
        seen.add((name, package))
        spec = find_module(name, path)
        if spec is None or spec.origin is None:
            if name in wanted and (spec is None or not spec.submodule_search_locations):
                missing.append(name)
            continue
        file = Path(spec.origin)
        if not _is_own(file, name, package, folders) and name not in wanted:
            continue
        if file.suffix != ".py":
            found.notes.append(f"{name} is compiled ({file.name}): it cannot be looked at")
            continue
        source = found.add(file, name, as_script=name in programs)
        if source is not None:
            parents = [name.rsplit(".", up)[0] for up in range(1, name.count(".") + 1)]
            imports = [*parents, *sorted(source.module.imports)]
            waiting += [(one, package) for one in imports]
    return found, missing


def _is_own(file: Path, name: str, package: str, folders: Sequence[Path]) -> bool:
    if _INSTALLED & set(file.parts):
        return bool(package) and name.partition(".")[0] == package
    return any(file.is_relative_to(folder) for folder in folders) or (
        bool(package) and name.partition(".")[0] == package
    )
