"""Functions of rclpy that a module replaces although no simulation calls them."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from rsltrace.guard.audit.names import Names
from rsltrace.guard.audit.scopes import Module
from rsltrace.trace.model.never_called import EXECUTOR, NEVER_CALLED

_FUNCTIONS = {f"{place}.{name}" for place, names in NEVER_CALLED.items() for name in names}
_READERS = ("builtins.getattr", "builtins.hasattr")


def exchanged(
    module: Module, node: ast.AST, names: Names
) -> Iterator[tuple[ast.stmt | ast.expr, str]]:
    """Yield where ``node`` replaces such a function, or overrides it, and its full name.

    Found are ``Executor._take_timer = …``, ``setattr(Executor, "_take_timer", …)`` and what else is
    called with a class and a name (``patch.object``), full names in a text (``patch``), and methods
    of an executor of one's own.
    """
    if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
        yield from _known(node, names.of(node, module.scope_of(node)))
    elif isinstance(node, ast.Call) and node.args:
        yield from _known(node, _called_with(module, node, names))
    elif isinstance(node, ast.ClassDef):
        own_module = EXECUTOR.rpartition(".")[0]
        for method in (one for one in node.body if isinstance(one, ast.FunctionDef)):
            for base in node.bases:
                name = names.of(ast.Attribute(base, method.name, ast.Load()), module.scope_of(base))
                if name is not None and name.startswith(own_module):
                    yield from _known(method, name)


def _known(
    node: ast.stmt | ast.expr, name: str | None
) -> Iterator[tuple[ast.stmt | ast.expr, str]]:
    if name in _FUNCTIONS:
        yield node, str(name)


def _called_with(module: Module, node: ast.Call, names: Names) -> str | None:
    texts = [one.value if isinstance(one, ast.Constant) else None for one in node.args[:2]]
    if isinstance(texts[0], str):
        return texts[0]
    scope = module.scope_of(node)
    if len(texts) < 2 or not isinstance(texts[1], str) or names.of(node.func, scope) in _READERS:
        return None
    return names.of(ast.Attribute(node.args[0], texts[1], ast.Load()), scope)
