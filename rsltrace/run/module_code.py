"""What a module's code is, comments and layout apart, and which other modules it uses."""

from __future__ import annotations

import ast
import hashlib
import json
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path


def module_code(modules: Mapping[str, Path]) -> dict[str, str]:
    """Return for each module, as JSON, ``hash`` of its syntax tree and which of the others it
    ``imports``; what is not Python is left out."""
    found = {}
    for name, path in modules.items():
        if path.suffix != ".py":
            continue
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Python has said it when it compiled them
                tree = ast.parse(path.read_bytes())
        except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
            continue
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        imports = sorted({*_imported(tree, package)} & {*modules} - {name})
        found[name] = json.dumps({"hash": _hash(tree), "imports": imports})
    return found


def _hash(tree: ast.Module) -> str:
    return hashlib.sha256(ast.dump(tree).encode("utf-8", "surrogatepass")).hexdigest()[:16]


def _imported(tree: ast.Module, package: str) -> Iterator[str]:
    """Yield the names of modules that may be imported, those of their packages included."""
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*(parents if node.level else []), *filter(None, [node.module])])
            names = [f"{base}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            yield from (".".join(parts[:count]) for count in range(1, len(parts) + 1))
