"""Scopes and their names: ``now`` is ``time.time`` after ``from time import time as now``.

A scope keeps for each name every expression bound to it; None if unknown (a parameter, a loop
variable). The order of execution does not matter.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from dataclasses import dataclass, field
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class ImportedName:
    """A name of a module or of something in one, by its full name."""

    name: str


@dataclass(frozen=True, slots=True)
class AnnotatedName:
    """A name of which only the type is known."""

    type: ast.expr


Binding: TypeAlias = "ast.expr | ImportedName | AnnotatedName | ast.ClassDef | None"


@dataclass(eq=False)
class NameScope:
    """The names of a module, class, function or comprehension."""

    kind: str
    parent: NameScope | None
    module: ModuleSource
    node: ast.AST | None = None
    names: dict[str, list[Binding]] = field(default_factory=lambda: defaultdict(list))
    attributes: dict[str, list[Binding]] = field(default_factory=lambda: defaultdict(list))
    """Of a class: what its methods bind to ``self.name``."""

    @property
    def own_class(self) -> NameScope | None:
        """The class of the method that this scope is in."""
        scope: NameScope | None = self
        while scope is not None and scope.kind != "class":
            scope = scope.parent
        return scope


@dataclass(eq=False)
class ModuleSource:
    """One parsed source file."""

    name: str
    is_package: bool
    tree: ast.Module
    scopes: dict[ast.AST, NameScope] = field(default_factory=dict)
    """The scopes of functions, classes, lambdas and comprehensions, and of the file."""
    parents: dict[ast.AST, ast.AST] = field(default_factory=dict)
    stars: list[str] = field(default_factory=list)
    imports: set[str] = field(default_factory=set)
    """Full names of everything that the file imports."""

    @property
    def top(self) -> NameScope:
        """The scope of the file itself."""
        return self.scopes[self.tree]

    def scope_of(self, node: ast.AST) -> NameScope:
        """Return the scope in which an expression is evaluated."""
        child, place = node, self.parents.get(node)
        while place is not None:
            if place in self.scopes and not _outside_of(child, place):
                return self.scopes[place]
            child, place = place, self.parents.get(place)
        return self.top


def _outside_of(child: ast.AST, place: ast.AST) -> bool:
    """Whether a part of a function or class is evaluated outside: defaults, bases, …"""
    if isinstance(place, ast.ClassDef):
        return child not in place.body
    if isinstance(place, (ast.FunctionDef, ast.AsyncFunctionDef)):
        return child not in place.body
    if isinstance(place, ast.Lambda):
        return child is not place.body
    if isinstance(place, _COMPREHENSIONS):
        return child is place.generators[0].iter
    return False


_COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)


def parse_scopes(tree: ast.Module, name: str, *, is_package: bool = False) -> ModuleSource:
    module = ModuleSource(name, is_package, tree)
    for parent in ast.walk(tree):
        for child in ast.iter_child_nodes(parent):
            module.parents[child] = parent
    _Binder(module).visit(tree)
    return module


class _Binder(ast.NodeVisitor):
    def __init__(self, module: ModuleSource) -> None:
        self.module = module
        self.scope = NameScope("module", None, module)
        module.scopes[module.tree] = self.scope

    def _within(self, node: ast.AST, kind: str) -> None:
        outer = self.scope
        self.scope = NameScope(kind, outer, self.module, node)
        self.module.scopes[node] = self.scope
        if isinstance(node, _FUNCTIONS):
            self._parameters(node.args)
        self.generic_visit(node)
        self.scope = outer

    def _bind(self, target: ast.AST, value: Binding) -> None:
        if isinstance(target, ast.Name):
            self.scope.names[target.id].append(value)
        elif isinstance(target, ast.Attribute):
            owner = self.scope.own_class
            if owner is not None and is_self(target.value):
                owner.attributes[target.attr].append(value)
        elif isinstance(target, ast.Starred):
            self._bind(target.value, None)
        elif isinstance(target, (ast.Tuple, ast.List)):
            values: list[Binding] = [None] * len(target.elts)
            if isinstance(value, (ast.Tuple, ast.List)) and len(value.elts) == len(target.elts):
                values = list(value.elts)
            for one, part in zip(target.elts, values, strict=True):
                self._bind(one, part)

    def _parameters(self, arguments: ast.arguments) -> None:
        plain = [*arguments.posonlyargs, *arguments.args]
        defaults: list[ast.expr | None] = [None] * (len(plain) - len(arguments.defaults))
        pairs = [*zip(plain, [*defaults, *arguments.defaults], strict=True)]
        pairs += zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
        pairs += [(one, None) for one in (arguments.vararg, arguments.kwarg) if one is not None]
        for parameter, default in pairs:
            annotation = parameter.annotation
            given = default is not None and not isinstance(default, ast.Constant)
            known = AnnotatedName(annotation) if annotation is not None else None
            self.scope.names[parameter.arg].append(default if given else known)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self.scope.names[node.name].append(None)
        self._within(node, "function")

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> None:
        self.scope.names[node.name].append(None)
        self._within(node, "function")

    def visit_Lambda(self, node: ast.Lambda) -> None:
        self._within(node, "function")

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self.scope.names[node.name].append(node)
        self._within(node, "class")

    def _comprehension(self, node: ast.AST) -> None:
        self._within(node, "function")

    visit_ListComp = visit_SetComp = visit_DictComp = visit_GeneratorExp = _comprehension  # noqa: N815

    def visit_comprehension(self, node: ast.comprehension) -> None:
        self._bind(node.target, None)
        self.generic_visit(node)

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            self.module.imports.add(alias.name)
            first = alias.name.partition(".")[0]
            bound = ImportedName(alias.name if alias.asname else first)
            self.scope.names[alias.asname or first].append(bound)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        source = _imported_module(self.module, node)
        self.module.imports.add(source)
        for alias in node.names:
            if alias.name == "*":
                self.module.stars.append(source)
                continue
            full = f"{source}.{alias.name}" if source else alias.name
            self.module.imports.add(full)
            self.scope.names[alias.asname or alias.name].append(ImportedName(full))

    def visit_Assign(self, node: ast.Assign) -> None:
        for target in node.targets:
            self._bind(target, node.value)
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self._bind(node.target, AnnotatedName(node.annotation))
        self.generic_visit(node)

    def visit_NamedExpr(self, node: ast.NamedExpr) -> None:
        self._bind(node.target, node.value)
        self.generic_visit(node)

    def visit_For(self, node: ast.For | ast.AsyncFor) -> None:
        self._bind(node.target, None)
        self.generic_visit(node)

    visit_AsyncFor = visit_For  # noqa: N815

    def visit_withitem(self, node: ast.withitem) -> None:
        if node.optional_vars is not None:
            self._bind(node.optional_vars, None)
        self.generic_visit(node)

    def visit_ExceptHandler(self, node: ast.ExceptHandler) -> None:
        if node.name:
            self.scope.names[node.name].append(None)
        self.generic_visit(node)

    def visit_Global(self, node: ast.Global) -> None:
        for name in node.names:  # the function's bindings are the module's
            self.scope.names[name] = self.module.top.names[name]


def is_self(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id in ("self", "cls")


def _imported_module(module: ModuleSource, node: ast.ImportFrom) -> str:
    """Return the full name of the module in ``from … import``."""
    if not node.level:
        return node.module or ""
    parts = module.name.split(".")
    up = node.level - 1 if module.is_package else node.level
    parts = parts[: len(parts) - up] if up else parts
    return ".".join([*parts, *([node.module] if node.module else [])])
