"""What the source of a node tells without running it: is it there, and which parameters it has.

Nothing is imported: modules are looked up as Python would, and their text is read as syntax.
"""

from __future__ import annotations

import ast
import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsltrace.errors import JobError, did_you_mean
from rsltrace.job.values.names import check_node_name, check_target, check_topic
from rsltrace.trace.model.module_search import find_module

_DECLARE_ONE = "declare_parameter"
_DECLARE_SEVERAL = "declare_parameters"


@dataclass(frozen=True)
class NodeSource:
    """A target in its source. ``folder`` is where its module was found (None: Python's own path).

    ``parameters`` are those that are declared with a literal name; the value is None where the
    source does not give a literal default. ``name`` is the node's, "" where the source does not
    give it literally. ``is_main`` is a function that returns nothing, so no node. ``topics`` are
    those that it publishes on, as far as the source has literal names.
    """

    target: str
    folder: Path | None
    parameters: dict[str, Any]
    name: str = ""
    is_main: bool = False
    topics: tuple[str, ...] = ()


def inspect_target(target: str, folders: list[Path]) -> NodeSource:
    """Find ``module:Class`` in ``folders`` or Python's own path.

    :raises JobError: if there is no such module, or it has no such class or function.
    """
    try:
        check_target(target)
    except ValueError as error:
        raise JobError(str(error)) from None
    module, _, attribute = target.partition(":")
    folder, file = _file_of(module, folders)
    tree = _parsed(file)
    name = attribute.partition(".")[0]
    body = next((n for n in ast.walk(tree) if getattr(n, "name", None) == name), None)
    if body is None:
        names = sorted(_top_names(tree))
        if name not in names:
            raise JobError(f"{target}: {file} has no {name!r}{did_you_mean(name, names)}")
    if body is None:
        return NodeSource(target, folder, {})
    name, is_main = _node_name(body), _is_main(body)
    topics = _topics(body if isinstance(body, ast.ClassDef) else tree, name)
    return NodeSource(target, folder, _parameters(body), name, is_main, topics)


def inspect_file(source: str) -> NodeSource:
    """Find ``path/to/file.py:Class``, or the one class of nodes in ``path/to/file.py``.

    Its module is named from the folder above the outermost package that the file is in.

    :raises JobError: if there is no such file, or it has no such class or function.
    """
    path, _, attribute = source.partition(":")
    file = Path(path)
    if not file.is_file():
        raise JobError(f"{source}: there is no file {path}")
    if not attribute:
        classes = [
            node.name
            for node in _parsed(file).body
            if isinstance(node, ast.ClassDef) and _is_of_nodes(node)
        ]
        if len(classes) != 1:
            some = f"one of {', '.join(classes)}" if classes else "the class of the node"
            raise JobError(f"{path}: say which class: {path}:Class ({some})")
        attribute = classes[0]
    folder, module = Path(os.path.abspath(file.parent)), file.stem
    while (folder / "__init__.py").is_file() and folder.name:
        folder, module = folder.parent, f"{folder.name}.{module}"
    return inspect_target(f"{module}:{attribute}", [folder])


def _parsed(file: Path) -> ast.Module:
    try:
        return ast.parse(file.read_text("utf-8", "replace"))
    except SyntaxError as error:
        raise JobError(f"{file}:{error.lineno}: not Python: {error.msg}") from None


def _is_of_nodes(node: ast.ClassDef) -> bool:
    bases = (getattr(base, "attr", getattr(base, "id", "")) for base in node.bases)
    return any(base.endswith("Node") for base in bases)


def _node_name(body: ast.AST) -> str:
    """Return the literal name that a class gives ``super().__init__`` of its node."""
    for node in ast.walk(body):
        if not (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr == "__init__"
            and isinstance(body, ast.ClassDef)
            and _is_of_nodes(body)
        ):
            continue
        keyword = next((k.value for k in node.keywords if k.arg == "node_name"), None)
        first = node.args[0] if node.args else keyword
        name = _literal(first) if first is not None else None
        try:
            check_node_name(str(name))
        except ValueError:
            return ""
        return name if isinstance(name, str) else ""
    return ""


def _is_main(body: ast.AST) -> bool:
    if not isinstance(body, ast.FunctionDef):
        return False
    returned = (node.value for node in ast.walk(body) if isinstance(node, ast.Return))
    return all(value is None or isinstance(value, ast.Constant) for value in returned)


def _file_of(module: str, folders: list[Path]) -> tuple[Path | None, Path]:
    for folder in [*folders, None]:
        spec = find_module(module, [str(folder)] if folder is not None else sys.path)
        if spec is not None and spec.origin is not None and spec.origin.endswith(".py"):
            return folder, Path(spec.origin)
    places = ", ".join(str(folder) for folder in folders)
    raise JobError(
        f"there is no module {module!r} in {places} or Python's own path: go to the folder it is "
        "in, or install its package"
    )


def _top_names(tree: ast.Module) -> set[str]:
    names = {getattr(node, "name", "") for node in tree.body}
    for node in tree.body:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            names |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names - {""}


def _parameters(body: ast.AST) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for node in ast.walk(body):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        arguments = list(node.args)
        if node.func.attr == _DECLARE_ONE and arguments:
            default = next((k.value for k in node.keywords if k.arg == "value"), None)
            _add(found, "", [arguments[0], *(arguments[1:2] or ([default] if default else []))])
        elif node.func.attr == _DECLARE_SEVERAL and len(arguments) == 2:
            space = _literal(arguments[0])
            items = arguments[1].elts if isinstance(arguments[1], (ast.List, ast.Tuple)) else []
            for item in items:
                if isinstance(item, ast.Tuple):
                    _add(found, f"{space}." if space else "", item.elts)
    return found


def _add(found: dict[str, Any], prefix: str, parts: list[ast.expr]) -> None:
    name = _literal(parts[0])
    if isinstance(name, str) and name:
        found[prefix + name] = _literal(parts[1]) if len(parts) > 1 else None


def _topics(body: ast.AST, node_name: str) -> tuple[str, ...]:
    """Return the full names of the topics for which publishers are made."""
    found: list[str] = []
    for node in ast.walk(body):
        if not isinstance(node, ast.Call) or getattr(node.func, "attr", "") != "create_publisher":
            continue
        keyword = next((k.value for k in node.keywords if k.arg == "topic"), None)
        given = node.args[1] if len(node.args) > 1 else keyword
        topic = _literal(given) if given is not None else None
        if not isinstance(topic, str) or not topic:
            continue
        if topic.startswith("~/"):
            if not node_name:
                continue
            topic = f"{node_name}/{topic[2:]}"
        topic = f"/{topic.lstrip('/')}"
        with suppress(ValueError):
            check_topic(topic)
            found.append(topic)
    return tuple(dict.fromkeys(found))


def _literal(node: ast.expr) -> Any:
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError):
        return None
