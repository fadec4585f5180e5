"""User modules, compiled with calls of the guard where Python offers no other hook.

These are ``np.datetime64("now")``, functions with ``where=``, the method ``__hash__`` and, from
Python 3.13 on, ``[*s]`` and ``r += s`` (``set_order`` handles all other iterations over sets).
Line numbers stay.
"""

from __future__ import annotations

import ast
import builtins
import importlib.machinery
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import CodeType, ModuleType
from typing import Any

from rsltrace.guard.addresses import hash_method
from rsltrace.guard.callers import is_installed, is_rsltrace_module, is_user_file
from rsltrace.guard.libraries import importing, is_library
from rsltrace.guard.loading import found_otherwise
from rsltrace.guard.virtual.arrays import filled
from rsltrace.guard.virtual.clocks import numpy_now
from rsltrace.guard.virtual.original_code import keep_source
from rsltrace.guard.virtual.set_order import LISTS_READ_SETS, in_set_order

_ORDERED = "__rsltrace_ordered__"
_HASH = "__rsltrace_hash__"
_NOW = "__rsltrace_now__"
_FILLED = "__rsltrace_filled__"
_WORDS = (b"datetime64", b"__hash__", b"where")
"""A module without these words stays unchanged (before Python 3.13)."""
_NEVER_SETS = (
    *(ast.Constant, ast.JoinedStr, ast.Compare, ast.Lambda),
    *(ast.List, ast.Tuple, ast.Dict, ast.ListComp, ast.DictComp, ast.GeneratorExp),
)
_OF_SETS = (ast.Sub, ast.BitOr, ast.BitAnd, ast.BitXor)


class _Rewriter(ast.NodeTransformer):
    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        function = node.func
        name = getattr(function, "id", None) or getattr(function, "attr", None)
        instead = ""
        if name == "datetime64" and node.args and _says_now(node.args[0]):
            instead = _NOW
        elif any(word.arg == "where" for word in node.keywords):
            instead = _FILLED
        if instead:
            node.args.insert(0, function)
            node.func = ast.copy_location(ast.Name(instead, ast.Load()), function)
            return ast.fix_missing_locations(node)
        return node

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        if [ast.unparse(target) for target in node.targets] != ["__hash__"]:
            self.generic_visit(node)  # else: a class that has the method of another
        return node

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        self.generic_visit(node)
        if node.attr == "__hash__" and isinstance(node.ctx, ast.Load):
            return _call(_HASH, node.value)
        return node


class _ListRewriter(_Rewriter):
    """Puts sets in order where lists are made of them."""

    def visit_Starred(self, node: ast.Starred) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.ctx, ast.Load):
            node.value = _in_order(node.value)
        return node

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.op, ast.Add):
            node.value = _in_order(node.value)
        return node


def _call(function: str, node: ast.expr) -> ast.expr:
    call = ast.Call(ast.Name(function, ast.Load()), [node], [])
    return ast.fix_missing_locations(ast.copy_location(call, node))


def _in_order(node: ast.expr) -> ast.expr:
    if isinstance(node, _NEVER_SETS):
        return node
    if isinstance(node, ast.BinOp) and not isinstance(node.op, _OF_SETS):
        return node
    return _call(_ORDERED, node)


def _says_now(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value in ("now", "today")


def rewrite(tree: ast.Module) -> None:
    """Put the guard's calls into the code of a module."""
    (_ListRewriter if LISTS_READ_SETS else _Rewriter)().visit(tree)


def rewritten(source: bytes, path: str) -> CodeType:
    """Return a module's code with the guard's calls."""
    keep_source(path, source)
    if not LISTS_READ_SETS and not any(word in source for word in _WORDS):
        plain: CodeType = compile(source, path, "exec", dont_inherit=True)
        return plain
    tree = ast.parse(source, path)
    rewrite(tree)
    code: CodeType = compile(tree, path, "exec", dont_inherit=True)
    return code


def code_of_script(source: bytes, path: str) -> CodeType:
    """Return the code of a program, compiled as modules are at present.

    :raises SyntaxError, ValueError: if it is not Python.
    """
    if any(type(finder) is _ModuleFinder and finder.rewrites for finder in sys.meta_path):
        return rewritten(source, path)
    code: CodeType = compile(source, path, "exec", dont_inherit=True)
    return code


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads a user module (``rewrites``: with the guard's calls) or an installed one."""

    def __init__(self, instead_of: Any, *, rewrites: bool, library: bool) -> None:
        super().__init__(instead_of.name, instead_of.path)
        self._rewrites = rewrites
        self._library = library

    def get_code(self, fullname: str) -> CodeType | None:
        if not self._rewrites:
            return super().get_code(fullname)
        path = self.get_filename(fullname)
        return rewritten(self.get_data(path), path)

    def exec_module(self, module: ModuleType) -> None:
        with importing(library=self._library):
            super().exec_module(module)


class _ModuleFinder:
    """Finds user modules, and those of libraries, which have their own import time."""

    def __init__(self, packages: frozenset[str], rewrites: bool) -> None:
        self._packages = packages
        self.rewrites = rewrites

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a module's spec, with its own loader unless it is one of Python's or ROS's."""
        if name in sys.builtin_module_names or is_rsltrace_module(name):
            return None
        spec = found_otherwise(self, name, path, target)
        if spec is None or type(spec.loader) is not importlib.machinery.SourceFileLoader:
            return None
        file = spec.origin or ""
        of_node = name.partition(".")[0] in self._packages
        if of_node or is_user_file(file):
            library = is_installed(file) and not of_node
            spec.loader = _Loader(spec.loader, rewrites=self.rewrites, library=library)
        elif is_library(file):
            spec.loader = _Loader(spec.loader, rewrites=False, library=True)
        return spec


@contextmanager
def user_modules(packages: frozenset[str], *, rewrites: bool = True) -> Iterator[None]:
    """Compile user modules imported from now on with the guard's calls, if ``rewrites``."""
    helpers: dict[str, Callable[..., Any]] = {
        _ORDERED: in_set_order,
        _HASH: hash_method,
        _NOW: numpy_now,
        _FILLED: filled,
    }
    for name, function in helpers.items():
        setattr(builtins, name, function)  # for good: modules may outlive the run
    finder = _ModuleFinder(packages, rewrites)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
