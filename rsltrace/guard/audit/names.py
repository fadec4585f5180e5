"""Resolve expressions to full names, through aliases and the user's own modules."""

from __future__ import annotations

import ast
import builtins
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet

from rsltrace.guard.audit.scopes import (
    AnnotatedName,
    Binding,
    ImportedName,
    ModuleSource,
    NameScope,
    is_self,
)
from rsltrace.guard.rules import RULES

_DEPTH_MAX = 20
_BUILTINS = frozenset(dir(builtins))
_LOADERS = ("builtins.__import__", "importlib.import_module")


class NameResolver:
    """Resolves expressions in a set of modules.

    ``passed`` collects the aliases (``now = time.time``) that led to a name.
    """

    def __init__(self, modules: Mapping[str, ModuleSource]) -> None:
        self._modules = modules
        self.passed: set[ast.AST] = set()
        self._asked: set[tuple[NameScope, str]] = set()
        """Names being resolved: ``line = line.strip()`` says nothing about ``line``, and a dozen
        such lines would take forever."""

    def of(self, node: ast.expr, scope: NameScope, depth: int = 0) -> str | None:
        """Return the full name of an expression, or None if it is not known."""
        if depth > _DEPTH_MAX:
            return None
        if isinstance(node, ast.Name):
            return self._first(
                self.bindings(node, scope), node.id, depth, _binding_scope(node.id, scope)
            )
        if isinstance(node, ast.Attribute):
            owner = scope.own_class
            if owner is not None and is_self(node.value):
                found = owner.attributes.get(node.attr) or owner.names.get(node.attr)
                if found:
                    bound = ((one, owner) for one in found)
                    return self._first(bound, f"self.{node.attr}", depth, owner)
            base = self.of(node.value, scope, depth + 1)
            return None if base is None else self._canonical(f"{base}.{node.attr}", depth + 1)
        if isinstance(node, ast.Call):
            return self._called(node, scope, depth)
        if isinstance(node, ast.IfExp):
            return self.of(node.body, scope, depth + 1) or self.of(node.orelse, scope, depth + 1)
        if isinstance(node, ast.BoolOp):
            for value in node.values:
                found_name = self.of(value, scope, depth + 1)
                if found_name is not None:
                    return found_name
        return None

    def is_made_by(
        self,
        node: ast.expr,
        scope: NameScope,
        makers: AbstractSet[str],
        depth: int = 0,
        seen: set[ast.expr] | None = None,
    ) -> bool:
        """Return whether an expression is what one of ``makers`` returns, or one of them.

        ``seen`` are the expressions that were asked about: names can be bound to each other.
        """
        seen = set() if seen is None else seen
        if node in seen:
            return False
        seen.add(node)
        if isinstance(node, ast.Call):
            return self.of(node.func, scope) in makers
        if self.of(node, scope) in makers:
            return True
        bound: list[tuple[Binding, NameScope]] = []
        if isinstance(node, ast.Name):
            bound = list(self.bindings(node, scope))
        elif isinstance(node, ast.Attribute) and scope.own_class and is_self(node.value):
            bound = [(one, scope) for one in scope.own_class.attributes.get(node.attr, [])]
        return depth < _DEPTH_MAX and any(
            self.is_made_by(one, scope.module.scope_of(one), makers, depth + 1, seen)
            for one, scope in bound
            if isinstance(one, ast.expr)
        )

    def bindings(self, node: ast.Name, scope: NameScope) -> Iterator[tuple[Binding, NameScope]]:
        """Yield what a name is bound to in the innermost scope that knows it."""
        place = _binding_scope(node.id, scope)
        if place is not None:
            for binding in place.names[node.id]:
                yield binding, _evaluated_in(binding, place)
            return
        for star in scope.module.stars:
            if f"{star}.{node.id}" in RULES or self._has(star, node.id):
                yield ImportedName(f"{star}.{node.id}"), scope
                return
        if node.id in _BUILTINS:
            yield ImportedName(f"builtins.{node.id}"), scope

    def _has(self, module: str, name: str) -> bool:
        loaded = self._modules.get(module)
        return loaded is not None and name in loaded.top.names

    def _first(
        self,
        bindings: Iterator[tuple[Binding, NameScope]],
        name: str,
        depth: int,
        place: NameScope | None,
    ) -> str | None:
        """Return the full name of a name in ``place`` (None: a built-in), or None."""
        key = None if place is None else (place, name)
        if key in self._asked:
            return None
        if key is not None:
            self._asked.add(key)
        try:
            for binding, scope in bindings:
                found = self._bound(binding, scope, depth)
                if found is not None:
                    return found
            return None
        finally:
            if key is not None:
                self._asked.remove(key)

    def _bound(self, binding: Binding, scope: NameScope, depth: int) -> str | None:
        if isinstance(binding, ImportedName):
            return self._canonical(binding.name, depth + 1)
        if isinstance(binding, ast.ClassDef):
            return f"{scope.module.name}.{_path(binding, scope.module)}"
        if isinstance(binding, ast.expr):
            if isinstance(binding, ast.Call) and not self._loads(binding, scope, depth):
                return None  # what a call returns is not what is called
            found = self.of(binding, scope, depth + 1)
            if found is not None:
                self.passed.add(binding)
            return found
        assert binding is None or isinstance(binding, AnnotatedName)
        return None

    def _loads(self, node: ast.Call, scope: NameScope, depth: int) -> bool:
        name = self.of(node.func, scope, depth + 1)
        return name in _LOADERS or name == "builtins.getattr"

    def _called(self, node: ast.Call, scope: NameScope, depth: int) -> str | None:
        """Return the full name of ``__import__("time")`` or ``getattr(time, "time")``."""
        name = self.of(node.func, scope, depth + 1)
        texts = [a.value if isinstance(a, ast.Constant) else None for a in node.args]
        if name in _LOADERS and texts and isinstance(texts[0], str):
            return texts[0]
        if name == "builtins.getattr" and len(texts) > 1 and isinstance(texts[1], str):
            base = self.of(node.args[0], scope, depth + 1)
            return None if base is None else self._canonical(f"{base}.{texts[1]}", depth + 1)
        return None

    def _canonical(self, name: str, depth: int) -> str | None:
        """Follow a name through the modules: their imports and the bases of their classes."""
        if depth > _DEPTH_MAX or name in RULES:
            return name
        parts = name.split(".")
        for count in range(len(parts) - 1, 0, -1):
            module = self._modules.get(".".join(parts[:count]))
            if module is None:
                continue
            return self._inside(module, parts[count:], depth)
        return name

    def _inside(self, module: ModuleSource, rest: list[str], depth: int) -> str | None:
        full = ".".join([module.name, *rest])
        if full in self._modules:
            return full
        scope = module.top
        for position, part in enumerate(rest):
            found = scope.names.get(part)
            if not found:
                inherited = self._inherited(scope, rest[position:], depth)
                return inherited or (full if scope.kind == "module" else None)
            classes = [one for one in found if isinstance(one, ast.ClassDef)]
            if classes:
                scope = module.scopes[classes[0]]
                continue
            bound = ((one, _evaluated_in(one, scope)) for one in found)
            name = self._first(bound, part, depth + 1, scope)
            if name is None:
                return None
            return self._canonical(".".join([name, *rest[position + 1 :]]), depth + 1)
        return full

    def _inherited(self, scope: NameScope, rest: list[str], depth: int) -> str | None:
        if not isinstance(scope.node, ast.ClassDef) or scope.parent is None:
            return None
        for base in scope.node.bases:
            name = self.of(base, scope.parent, depth + 1)
            found = self._canonical(".".join([name, *rest]), depth + 1) if name else None
            if found is not None:
                return found
        return None


def _path(node: ast.ClassDef, module: ModuleSource) -> str:
    parts = [node.name]
    place = module.parents.get(node)
    while place is not None:
        if isinstance(place, ast.ClassDef):
            parts.insert(0, place.name)
        place = module.parents.get(place)
    return ".".join(parts)


def _binding_scope(name: str, scope: NameScope) -> NameScope | None:
    """Return the innermost scope around an expression that knows a name."""
    place: NameScope | None = scope
    while place is not None:
        if (place is scope or place.kind != "class") and name in place.names:
            return place
        place = place.parent
    return None


def _evaluated_in(binding: Binding, scope: NameScope) -> NameScope:
    """Return the scope in which a bound expression is evaluated: of a default the outer one."""
    if isinstance(binding, ast.expr) and binding in scope.module.parents:
        return scope.module.scope_of(binding)
    return scope
