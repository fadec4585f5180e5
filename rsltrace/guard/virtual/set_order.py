"""Sets in an order of their own: user modules ask here before they go through a set.

A set of texts is in the order of their hashes, which differ from process to process; a set of
objects in that of their addresses. Python offers no hook for that, so the modules of user code are
compiled with one: wherever a loop, a comprehension or one of a few functions goes through a value,
it is passed through ``ordered`` first. Line numbers stay.
"""

from __future__ import annotations

import ast
import builtins
import importlib.machinery
import sys
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import CodeType, FrameType, ModuleType
from typing import Any

from rsltrace.guard import frames
from rsltrace.guard.addresses import is_by_address
from rsltrace.guard.callers import is_installed, is_own, is_user_file
from rsltrace.guard.frames import caller
from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.libraries import is_library
from rsltrace.guard.library_imports import importing
from rsltrace.guard.virtual.clocks import numpy_now
from rsltrace.guard.virtual.original_code import keep_source
from rsltrace.model.finding import Mode, Source

_ORDER, _ALLOW, _VIRTUAL = Source.ORDER, Mode.ALLOW, Mode.VIRTUAL
_ORDERED = "__rsltrace_ordered__"
_EACH = "__rsltrace_each__"
_SHOWN = "__rsltrace_shown__"
_POP = "__rsltrace_pop__"
_NOW = "__rsltrace_now__"
_GOES_THROUGH = frozenset(
    "list tuple sum iter enumerate map filter zip max min dict deque join fromkeys extend "
    "fromiter".split()
)
_SHOWS = frozenset("str repr print format".split())
_NUMBERS = frozenset((int, float, bool))
"""Their places in a set are the same in every process."""
_TEXTS = frozenset((str,))
_PLAIN = (str, bytes, int, float, bool, type(None))


def ordered(thing: Any) -> Any:
    """Return what stands for ``thing`` where its elements are asked for: a set in an order that
    stays."""
    kind = type(thing)
    if kind is not set and kind is not frozenset and kind is not weakref.WeakSet:
        return thing
    if len(thing) < 2 or _NUMBERS.issuperset(map(type, thing)):
        return thing
    guard = engaged()
    if guard is None:
        return thing
    in_order = _order(guard, thing, caller())
    return thing if in_order is None else _Watched(thing, in_order)


def each(thing: Any) -> Any:
    """Return what a loop over ``thing`` should go through, once: ``ordered`` for less."""
    kind = type(thing)
    if kind is not set and kind is not frozenset and kind is not weakref.WeakSet:
        return thing
    if len(thing) < 2 or _NUMBERS.issuperset(map(type, thing)):
        return thing
    guard = engaged()
    if guard is None:
        return thing
    try:
        frame = frames.next_caller()
    except frames.INTERRUPTED:
        frame = frames.lost_caller()
    in_order = _order(guard, thing, frame)
    return thing if in_order is None else _through(thing, in_order)


def _order(guard: Guard, thing: Any, frame: FrameType) -> list[Any] | None:
    """Return the elements of a set in an order that stays, or None if they are left as they are."""
    mode = guard.mode(_ORDER, frame)
    are_texts = _TEXTS.issuperset(map(type, thing))
    if mode is _ALLOW or not (are_texts or any(map(_has_no_order, thing))):
        return None
    if mode is _VIRTUAL:
        in_order = sorted(thing) if are_texts else _in_order(guard, thing)
        if in_order is not None:  # else: objects that nothing tells apart but their addresses
            guard.count(_ORDER, "order of a set", frame)
            return in_order
    kinds = ", ".join(sorted({type(item).__qualname__ for item in thing}))
    call = f"order of a {type(thing).__name__} of {kinds}"
    guard.watched(_ORDER, call, f"{len(thing)} elements", frame)
    return None


def _in_order(guard: Guard, thing: Any) -> list[Any] | None:
    try:
        return sorted(thing, key=_key)
    except TypeError:
        return guard.numbers.in_order(thing)


def shown(thing: Any) -> Any:
    """Return what a text of ``thing`` should be made of: a set's elements in order."""
    if type(thing) is not set and type(thing) is not frozenset:
        return thing
    in_order = ordered(thing)
    if not isinstance(in_order, _Watched):
        return thing
    inside = "{" + ", ".join(map(repr, in_order.items)) + "}"
    return _Text(inside if type(thing) is set else f"frozenset({inside})")


def pop(owner: Any, *arguments: Any) -> Any:
    """Do ``owner.pop(...)``; of a set, take the first element in order."""
    if type(owner) is set and not arguments:
        in_order = ordered(owner)
        if isinstance(in_order, _Watched):
            first = in_order.items[0]
            owner.remove(first)
            return first
    return owner.pop(*arguments)


class _Text(str):
    """A text that is its own ``repr``, as the text of a set is."""

    def __repr__(self) -> str:
        return str(self)


def _through(thing: Any, in_order: list[Any]) -> Iterator[Any]:
    size = len(thing)
    for item in in_order:
        if len(thing) != size:
            raise RuntimeError("Set changed size during iteration")
        yield item


class _Watched:
    """The elements of a set in order; like a set, it notices when that changes on the way."""

    def __init__(self, of: Any, items: list[Any]) -> None:
        self.items = items
        self._of = of

    def __iter__(self) -> Iterator[Any]:
        return _through(self._of, self.items)

    def __len__(self) -> int:
        return len(self.items)


def _has_no_order(item: object) -> bool:
    """Whether an element's place in a set differs from process to process, pinned or not."""
    return isinstance(item, (str, bytes)) or is_by_address(item)


def _key(item: Any) -> tuple[str, Any]:
    kind = type(item)
    if kind in _PLAIN:
        return kind.__name__, item
    if kind is tuple:
        return "tuple", tuple(map(_key, item))
    raise TypeError


# -- compiling user modules with the calls above -------------------------------------------------


class _Rewriter(ast.NodeTransformer):
    def _call(self, function: str, node: ast.expr, *more: ast.expr) -> ast.expr:
        name = ast.Name(function, ast.Load())
        call = ast.Call(name, [node, *more], [])
        return ast.fix_missing_locations(ast.copy_location(call, node))

    def visit_For(self, node: ast.For) -> ast.AST:
        self.generic_visit(node)
        if not _is_harmless(node.iter):
            node.iter = self._call(_EACH, node.iter)
        return node

    def visit_comprehension(self, node: ast.comprehension) -> ast.AST:
        self.generic_visit(node)
        if not node.is_async and not _is_harmless(node.iter):
            node.iter = self._call(_EACH, node.iter)
        return node

    def visit_Starred(self, node: ast.Starred) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.ctx, ast.Load):
            node.value = self._call(_ORDERED, node.value)
        return node

    def visit_FormattedValue(self, node: ast.FormattedValue) -> ast.AST:
        self.generic_visit(node)
        node.value = self._call(_SHOWN, node.value)
        return node

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        self.generic_visit(node)
        if any(isinstance(target, (ast.Tuple, ast.List)) for target in node.targets):
            node.value = self._call(_ORDERED, node.value)
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        function = node.func
        name = getattr(function, "id", None) or getattr(function, "attr", None)
        if isinstance(function, ast.Attribute) and name == "pop" and not node.keywords:
            popped = ast.Call(ast.Name(_POP, ast.Load()), [function.value, *node.args], [])
            return ast.fix_missing_locations(ast.copy_location(popped, node))
        if name == "datetime64" and node.args and _says_now(node.args[0]):
            node.args.insert(0, function)
            node.func = ast.copy_location(ast.Name(_NOW, ast.Load()), function)
            return ast.fix_missing_locations(node)
        if name in _GOES_THROUGH or name in _SHOWS:
            wrap = _ORDERED if name in _GOES_THROUGH else _SHOWN
            node.args = [
                a if isinstance(a, ast.Starred) or _is_harmless(a) else self._call(wrap, a)
                for a in node.args
            ]
        return node


def _says_now(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value in ("now", "today")


def _is_harmless(node: ast.expr) -> bool:
    """Whether an expression cannot be a set, as far as one can see."""
    if isinstance(node, (ast.Constant, ast.List, ast.Tuple, ast.Dict, ast.Lambda, ast.ListComp)):
        return True
    return isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("range", "sorted", "len")


def order_sets(tree: ast.Module) -> None:
    """Put sets in order wherever the code of a module goes through one."""
    _Rewriter().visit(tree)


def rewritten(source: bytes, path: str) -> CodeType:
    """Return a module's code with sets in order."""
    tree = ast.parse(source, path)
    order_sets(tree)
    keep_source(path, source)
    code: CodeType = compile(tree, path, "exec", dont_inherit=True)
    return code


def code_of_script(source: bytes, path: str) -> CodeType:
    """Return the code of a program that is not imported, with sets in order while a guard sees to
    that.

    :raises SyntaxError, ValueError: if it is not Python.
    """
    if any(type(finder) is _Finder and finder.orders for finder in sys.meta_path):
        return rewritten(source, path)
    code: CodeType = compile(source, path, "exec", dont_inherit=True)
    return code


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads a module of user code (``ordered``: with its sets in order) or of what is installed."""

    def __init__(self, instead_of: Any, *, ordered: bool, library: bool) -> None:
        super().__init__(instead_of.name, instead_of.path)
        self._ordered = ordered
        self._library = library

    def get_code(self, fullname: str) -> CodeType | None:
        if not self._ordered:
            return super().get_code(fullname)
        path = self.get_filename(fullname)
        return rewritten(self.get_data(path), path)

    def exec_module(self, module: ModuleType) -> None:
        with importing(library=self._library):
            super().exec_module(module)


class _Finder:
    """Finds modules of user code, and those of libraries, which have their own import time."""

    def __init__(
        self,
        packages: frozenset[str],
        on_loaded: Mapping[str, Callable[[], None]],
        orders: bool,
    ) -> None:
        self._packages = packages
        self._on_loaded = on_loaded
        self.orders = orders

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a module's spec, with a loader of ours if it is not one of Python's or ROS's."""
        if name in sys.builtin_module_names or is_own(name):
            return None
        spec = self._found_otherwise(name, path, target)
        if spec is None or type(spec.loader) is not importlib.machinery.SourceFileLoader:
            return None
        file = spec.origin or ""
        of_node = name.partition(".")[0] in self._packages
        if of_node or is_user_file(file):
            library = is_installed(file) and not of_node
            spec.loader = _Loader(spec.loader, ordered=self.orders, library=library)
        elif is_library(file):
            spec.loader = _Loader(spec.loader, ordered=False, library=True)
        if name in self._on_loaded:
            _tell(spec.loader, self._on_loaded[name])
        return spec

    def _found_otherwise(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None
    ) -> importlib.machinery.ModuleSpec | None:
        """Ask those who would be asked without us: editable packages have finders of their own."""
        for finder in sys.meta_path:
            find_spec = getattr(finder, "find_spec", None)
            if finder is not self and find_spec is not None:
                spec: importlib.machinery.ModuleSpec | None = find_spec(name, path, target)
                if spec is not None:
                    return spec
        return None


def _tell(loader: Any, on_loaded: Callable[[], None]) -> None:
    """Have a loader say when it has loaded its module."""
    real = loader.exec_module

    def exec_module(module: ModuleType) -> None:
        real(module)
        on_loaded()

    loader.exec_module = exec_module


@contextmanager
def ordered_sets(
    packages: frozenset[str],
    on_loaded: Mapping[str, Callable[[], None]],
    *,
    orders: bool = True,
) -> Iterator[None]:
    """Let user modules that are imported from now on go through sets in order, if ``orders``.

    ``on_loaded`` has libraries, by name, and what to do as soon as they are loaded.
    """
    helpers: dict[str, Callable[..., Any]] = {
        _ORDERED: ordered,
        _EACH: each,
        _SHOWN: shown,
        _POP: pop,
        _NOW: numpy_now,
    }
    finder = _Finder(packages, on_loaded, orders)
    for name, function in helpers.items():
        setattr(builtins, name, function)  # for good: modules may outlive the run
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
