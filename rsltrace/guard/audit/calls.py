"""Find call sites in one module: calls, and functions passed on to be called later."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rsltrace.guard import rules
from rsltrace.guard.audit.names import NameResolver
from rsltrace.guard.audit.scopes import AnnotatedName, Binding, ModuleSource, NameScope
from rsltrace.guard.rules import (
    ATTRIBUTES,
    METHODS,
    RULES,
    SHARED_GENERATORS,
    Rule,
    c_function_rule,
    sql_call,
)
from rsltrace.trace.model.finding import EXECUTOR, NEVER_CALLED

# Which expressions are sets, and where their order matters.
#
# A set of plain integers has the same order in every process. Counting, sorting and testing members
# does not depend on the order. Neither is reported.

_MAKERS = {"builtins.set", "builtins.frozenset", "weakref.WeakSet"}
_TYPES = _MAKERS | {
    f"{module}.{name}"
    for module in ("typing", "collections.abc")
    for name in ("Set", "FrozenSet", "AbstractSet", "MutableSet")
}
_METHODS = {"union", "intersection", "difference", "symmetric_difference", "copy"}
_OPERATORS = (ast.BitOr, ast.BitAnd, ast.BitXor, ast.Sub)

_UNORDERED = {
    *(f"builtins.{name}" for name in "sorted min max len any all set frozenset bool".split()),
    *(f"statistics.{name}" for name in "mean fmean median pstdev pvariance stdev variance".split()),
    "math.fsum",
}
"""Their results do not depend on the order of members, unless a key makes some equal."""
_ORDERED = {
    *(
        f"builtins.{name}"
        for name in "list tuple enumerate zip map filter iter sum dict str repr print".split()
    ),
    *(f"builtins.{name}" for name in "format bytes bytearray dict.fromkeys".split()),
    "functools.reduce",
    "pickle.dump",
    "pickle.dumps",
}
_ORDERED_IN = ("collections.", "heapq.", "itertools.", "numpy.", "random.", "statistics.")
"""Modules whose functions iterate over their arguments."""
_KEEPING = {"extend", "join", "writelines", "extendleft", "fromlist", "dump"}
_INSENSITIVE_CALLS = {"add", "discard", "remove"}


def is_set(node: ast.expr, scope: NameScope, names: NameResolver) -> bool:
    """Return whether an expression is a set whose order is not known."""
    return _is_set(node, scope, names, frozenset()) is True


def _is_set(
    node: ast.expr, scope: NameScope, names: NameResolver, asked: frozenset[object]
) -> bool | None:
    """Do ``is_set``; None: unknown, as ``s = s | more`` leaves ``s`` what it is. ``asked`` are the
    bindings being resolved."""
    if isinstance(node, ast.Set):
        return not all(isinstance(x, ast.Constant) and type(x.value) is int for x in node.elts)
    if isinstance(node, ast.SetComp):
        return True
    if isinstance(node, ast.BinOp) and isinstance(node.op, _OPERATORS):
        left = _is_set(node.left, scope, names, asked)
        if left or isinstance(node.op, ast.Sub):
            return left
        return _is_set(node.right, scope, names, asked) or left
    if isinstance(node, ast.IfExp):
        body = _is_set(node.body, scope, names, asked)
        return body or _is_set(node.orelse, scope, names, asked) or body
    if isinstance(node, ast.Call):
        function = node.func
        if isinstance(function, ast.Attribute) and function.attr in _METHODS:
            return _is_set(function.value, scope, names, asked)
        made = names.of(function, scope) in _MAKERS
        return made and not (node.args and _is_range(node.args[0], scope, names))
    bindings: list[tuple[Binding, NameScope]] = []
    if isinstance(node, ast.Name):
        bindings = list(names.bindings(node, scope))
    elif isinstance(node, ast.Attribute):
        owner = scope.own_class
        if owner is not None and isinstance(node.value, ast.Name) and node.value.id == "self":
            bindings = [(one, scope) for one in owner.attributes.get(node.attr, [])]
            bindings = bindings or [(one, owner) for one in owner.names.get(node.attr, [])]
    if not bindings:
        return False
    others = [pair for pair in bindings if pair[0] not in asked]
    asked = asked.union(binding for binding, _ in others if isinstance(binding, ast.expr))
    answer: bool | None = None
    for binding, place in others:
        one = _binds_set(binding, place, names, asked)
        if one is False:
            return False
        answer = answer or one
    return answer


def _binds_set(
    binding: Binding, scope: NameScope, names: NameResolver, asked: frozenset[object]
) -> bool | None:
    if isinstance(binding, AnnotatedName):
        return _annotates_set(binding.type, scope, names)
    if isinstance(binding, ast.expr):
        return _is_set(binding, scope.module.scope_of(binding), names, asked)
    return False


def _annotates_set(node: ast.expr, scope: NameScope, names: NameResolver) -> bool:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        try:
            node = ast.parse(node.value, mode="eval").body
        except SyntaxError:
            return False
    if isinstance(node, ast.Subscript):
        member = node.slice
        if isinstance(member, ast.Name) and member.id in ("int", "bool"):
            return False
        node = node.value
    return names.of(node, scope) in _TYPES


def _is_range(node: ast.expr, scope: NameScope, names: NameResolver) -> bool:
    return isinstance(node, ast.Call) and names.of(node.func, scope) == "builtins.range"


def order_matters(node: ast.expr, scope: NameScope, names: NameResolver) -> bool:
    """Return whether the context of a set depends on the order of its members."""
    parent = scope.module.parents.get(node)
    if isinstance(parent, (ast.For, ast.AsyncFor)):
        return parent.iter is node and not _only_collects(parent)
    if isinstance(parent, ast.comprehension):
        return parent.iter is node and _comprehension_matters(parent, scope, names)
    if isinstance(parent, ast.Call):
        return node in parent.args and _call_matters(parent, scope, names)
    if isinstance(parent, ast.AugAssign):
        return isinstance(parent.op, ast.Add)  # to a list
    if isinstance(parent, ast.Assign):
        return any(map(_unpacks, parent.targets))
    if isinstance(parent, ast.Attribute):
        used = scope.module.parents.get(parent)
        called = isinstance(used, ast.Call) and used.func is parent
        return called and parent.attr == "pop" and not getattr(used, "args", None)
    if isinstance(parent, ast.FormattedValue):
        return parent.value is node
    if isinstance(parent, ast.Starred):
        user = scope.module.parents.get(parent)
        return not isinstance(user, ast.Set) and not _ends_unordered(parent, scope, names)
    return isinstance(parent, ast.YieldFrom)


def _unpacks(target: ast.expr) -> bool:
    """Whether an assignment unpacks a set: ``a, b = s``, ``r[1:] = s``."""
    if isinstance(target, ast.Subscript):
        return isinstance(target.slice, ast.Slice)
    return isinstance(target, (ast.Tuple, ast.List))


def _call_matters(call: ast.Call, scope: NameScope, names: NameResolver) -> bool:
    name = names.of(call.func, scope) or ""
    if name in _UNORDERED:
        return any(word.arg == "key" for word in call.keywords)
    if name in _ORDERED or name.startswith(_ORDERED_IN):
        return not _ends_unordered(call, scope, names)
    return isinstance(call.func, ast.Attribute) and call.func.attr in _KEEPING


def _comprehension_matters(part: ast.comprehension, scope: NameScope, names: NameResolver) -> bool:
    whole = scope.module.parents[part]
    if isinstance(whole, ast.SetComp):
        return False
    return not _ends_unordered(whole, scope, names)


def _ends_unordered(node: ast.AST, scope: NameScope, names: NameResolver) -> bool:
    """Whether the result goes directly into a function that ignores its order."""
    user = scope.module.parents.get(node)
    return (
        isinstance(user, ast.Call)
        and node in user.args
        and names.of(user.func, scope) in _UNORDERED
        and not any(word.arg == "key" for word in user.keywords)
    )


def _only_collects(loop: ast.For | ast.AsyncFor) -> bool:
    """Whether a loop only adds members to other sets, or deletes what they name."""
    return all(
        isinstance(line, ast.Delete)
        or (
            isinstance(line, ast.Expr)
            and isinstance(line.value, ast.Call)
            and isinstance(line.value.func, ast.Attribute)
            and line.value.func.attr in _INSENSITIVE_CALLS
        )
        for line in loop.body
    )


# Differences of two reads of a ROS clock in one function: 0 in a simulation.

_DEPTH_MAX = 8
_CONVERSIONS = ("float", "int", "abs")


def is_difference_of_now(node: ast.expr, scope: NameScope, depth: int = 0) -> bool:
    """Return whether an expression is the difference of two times read in this function."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
        return all(_is_now(side, scope, depth) for side in (node.left, node.right))
    return _within(node, scope, depth, is_difference_of_now)


def _is_now(node: ast.expr, scope: NameScope, depth: int) -> bool:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        return node.func.attr == "now" and not node.args and _is_clock(node.func.value)
    return _within(node, scope, depth, _is_now)


def _is_clock(node: ast.expr) -> bool:
    """Return whether an expression is a ROS clock, judging by its name."""
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Attribute) and node.func.attr == "get_clock"
    name = node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")
    return str(name).lower().endswith("clock")


def _within(
    node: ast.expr, scope: NameScope, depth: int, holds: Callable[[ast.expr, NameScope, int], bool]
) -> bool:
    """Look through conversions of a time and names of the function."""
    if depth > _DEPTH_MAX:
        return False
    if isinstance(node, ast.Attribute) and node.attr in ("nanoseconds", "nanosec", "sec"):
        return holds(node.value, scope, depth + 1)
    if isinstance(node, ast.BinOp) and isinstance(node.right, ast.Constant):
        return holds(node.left, scope, depth + 1)
    if isinstance(node, ast.Call) and len(node.args) == 1 and isinstance(node.func, ast.Name):
        return node.func.id in _CONVERSIONS and holds(node.args[0], scope, depth + 1)
    if isinstance(node, ast.Name) and scope.kind == "function":
        bound = scope.names.get(node.id, [])
        return bool(bound) and all(
            isinstance(one, ast.expr) and holds(one, scope, depth + 1) for one in bound
        )
    return False


# Functions of rclpy that a module replaces although no simulation calls them.

_FUNCTIONS = {f"{place}.{name}" for place, names in NEVER_CALLED.items() for name in names}
_READERS = ("builtins.getattr", "builtins.hasattr")


def replaced_functions(
    module: ModuleSource, node: ast.AST, names: NameResolver
) -> Iterator[tuple[ast.stmt | ast.expr, str]]:
    """Yield where ``node`` replaces or overrides such a function, and its full name.

    Finds ``Executor._take_timer = …``, ``setattr(Executor, "_take_timer", …)`` and other calls with
    a class and a name (``patch.object``), full names in a text (``patch``), and methods of the
    user's executors.
    """
    if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
        yield from _never_called(node, names.of(node, module.scope_of(node)))
    elif isinstance(node, ast.Call) and node.args:
        yield from _never_called(node, _called_with(module, node, names))
    elif isinstance(node, ast.ClassDef):
        own_module = EXECUTOR.rpartition(".")[0]
        for method in (one for one in node.body if isinstance(one, ast.FunctionDef)):
            for base in node.bases:
                name = names.of(ast.Attribute(base, method.name, ast.Load()), module.scope_of(base))
                if name is not None and name.startswith(own_module):
                    yield from _never_called(method, name)


def _never_called(
    node: ast.stmt | ast.expr, name: str | None
) -> Iterator[tuple[ast.stmt | ast.expr, str]]:
    if name in _FUNCTIONS:
        yield node, str(name)


def _called_with(module: ModuleSource, node: ast.Call, names: NameResolver) -> str | None:
    texts = [one.value if isinstance(one, ast.Constant) else None for one in node.args[:2]]
    if isinstance(texts[0], str):
        return texts[0]
    scope = module.scope_of(node)
    if len(texts) < 2 or not isinstance(texts[1], str) or names.of(node.func, scope) in _READERS:
        return None
    return names.of(ast.Attribute(node.args[0], texts[1], ast.Load()), scope)


_C_LIBRARIES = frozenset(
    ("ctypes.CDLL", "ctypes.PyDLL", "ctypes.cdll.LoadLibrary", "ctypes.pythonapi")
)
_SORTERS = ("builtins.sorted", "builtins.min", "builtins.max")
_DIVISIONS = (ast.Div, ast.FloorDiv, ast.Mod)
_ORDERINGS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)
_LISTINGS_UNORDERED = (
    "builtins.sorted",
    "builtins.len",
    "builtins.set",
    "builtins.frozenset",
    "builtins.any",
    "builtins.all",
    "builtins.min",
    "builtins.max",
)
_SHOWING = ("str", "repr", "hex", "print", "format", "sorted", "min", "max", "divmod")


@dataclass(frozen=True, slots=True)
class CallSite:
    """A call that the audit reports. ``alias`` is the expression if it only binds a name."""

    node: ast.expr | ast.stmt
    call: str
    rule: Rule
    alias: ast.expr | None = None


def find_calls(
    module: ModuleSource, names: NameResolver, *, as_script: bool = False
) -> Iterator[CallSite]:
    """Yield the call sites of a module; ``as_script``: its ``__main__`` block runs, too."""
    skipped = set() if as_script else set(_never_run(module))
    seeded = _seeded_generators(module, names)
    stack: list[ast.AST] = [module.tree]
    while stack:
        node = stack.pop()
        if node in skipped:
            continue
        for place in _call_sites(module, node, names):
            shared = place.rule.is_shared and place.call.startswith(tuple(seeded))
            if not shared:
                yield place
        stack.extend(ast.iter_child_nodes(node))


def _call_sites(module: ModuleSource, node: ast.AST, names: NameResolver) -> Iterator[CallSite]:
    for place, name in replaced_functions(module, node, names):
        yield CallSite(place, name, rules.REPLACED_FUNCTION)
    if isinstance(node, ast.Call):
        yield from _call(module, node, names)
    elif isinstance(node, (ast.Name, ast.Attribute)) and isinstance(node.ctx, ast.Load):
        yield from _reference(module, node, names)
    elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
        if node.name == "__del__" and isinstance(module.parents.get(node), ast.ClassDef):
            yield CallSite(node, "__del__()", rules.FINALIZER)
    elif isinstance(node, ast.FormattedValue):
        spec = node.format_spec
        last = spec.values[-1] if isinstance(spec, ast.JoinedStr) and spec.values else None
        if isinstance(last, ast.Constant) and str(last.value).endswith("n"):
            yield CallSite(node.value, "format 'n'", rules.LOCALE)
    elif (
        isinstance(node, ast.BinOp)
        and isinstance(node.op, _DIVISIONS)
        and is_difference_of_now(node.right, module.scope_of(node))
    ):
        yield CallSite(node, f"division by {_text(node.right)}", rules.ZERO_DURATION)
    if isinstance(node, ast.expr):
        scope = module.scope_of(node)
        if is_set(node, scope, names) and order_matters(node, scope, names):
            yield CallSite(node, f"order of the set {_text(node)}", rules.ORDER)


def _call(module: ModuleSource, node: ast.Call, names: NameResolver) -> Iterator[CallSite]:
    scope = module.scope_of(node)
    names.passed.clear()
    name = names.of(node.func, scope)
    if isinstance(node.func, ast.Attribute) and node.func.attr == "__hash__":
        if not _inside_hash(module, node):
            yield CallSite(node, "__hash__()", rules.HASH)
        return
    if name is None:
        if isinstance(node.func, ast.Attribute):
            rule = METHODS.get(node.func.attr)
            in_c = c_function_rule(node.func.attr)
            if in_c is not None and names.is_made_by(node.func.value, scope, _C_LIBRARIES):
                yield CallSite(node, f"C library: {node.func.attr}()", in_c)
            if rule is not None and not _is_order_ignored(module, node, scope, names):
                yield CallSite(node, f"{node.func.attr}()", rule)
            if node.func.attr in ("execute", "executemany", "executescript") and node.args:
                yield from _sql(node)
            elif node.func.attr == "sort":
                yield from _sorting(node, scope, names)
        return
    rule = RULES.get(name)
    if rule is not None:
        listed = rule.kind == "directory" and _is_order_ignored(module, node, scope, names)
        if (rule.when is None or rule.when(node)) and not listed:
            first = node.args[0] if node.args and rule.kind in ("environment", "clock") else None
            given = repr(first.value) if isinstance(first, ast.Constant) else ""
            yield CallSite(node, f"{name.removeprefix('builtins.')}({given})", rule)
    elif name == "builtins.id":
        if _shows_address(module, node, scope, names):
            yield CallSite(node, "id()", rules.ADDRESS)
    elif name == "builtins.hash":
        if not _inside_hash(module, node) and not _plain_number(node):
            yield CallSite(node, "hash()", rules.HASH)
    elif name in _SORTERS:
        yield from _sorting(node, scope, names)


def _reference(
    module: ModuleSource, node: ast.Name | ast.Attribute, names: NameResolver
) -> Iterator[CallSite]:
    parent = module.parents.get(node)
    scope = module.scope_of(node)
    if isinstance(parent, ast.Attribute):
        if parent.value is node and names.of(node, scope) == "os.environ":
            yield from _environ(module, parent)
        return
    if isinstance(parent, ast.Call) and parent.func is node:
        return
    if _in_annotation(module, node):
        return
    name = names.of(node, scope)
    if name is None:
        if isinstance(node, ast.Attribute):
            yield from _attribute(node)
        return
    if name == "os.environ":
        if isinstance(parent, ast.Subscript) and not isinstance(parent.ctx, ast.Load):
            return
        if isinstance(parent, (ast.Assign, ast.AnnAssign)):
            return  # an alias: what is read through it is found there
        key = parent.slice if isinstance(parent, ast.Subscript) else None
        shown = f"[{key.value!r}]" if isinstance(key, ast.Constant) else ""
        yield CallSite(node, f"os.environ{shown}", rules.ENVIRONMENT)
        return
    rule = RULES.get(name)
    if rule is None:
        return
    if rule.is_class or rule.kind in ("finalizer", "locale"):
        is_base = isinstance(parent, ast.ClassDef) and node in parent.bases
        is_value = name.startswith("time.")  # tzname and its like are no functions
        if not (is_base and rule.kind in ("thread", "process")) and not is_value:
            return
    shown = name.removeprefix("builtins.")
    if rule.kind in ("thread", "process") and isinstance(parent, ast.ClassDef):
        yield CallSite(node, f"class {parent.name}({shown})", rule)
    else:
        bound = isinstance(parent, (ast.Assign, ast.AnnAssign, ast.arguments))
        yield CallSite(node, shown, rule, alias=node if bound else None)


def _attribute(node: ast.Attribute) -> Iterator[CallSite]:
    names = [node.attr]
    if isinstance(node.value, ast.Attribute):
        names.append(f"{node.value.attr}.{node.attr}")
    for name in names:
        if name in ATTRIBUTES:
            yield CallSite(node, f".{name}", ATTRIBUTES[name])


def _environ(module: ModuleSource, attribute: ast.Attribute) -> Iterator[CallSite]:
    if attribute.attr in ("update", "clear", "__setitem__", "__delitem__"):
        return
    call = module.parents.get(attribute)
    first = call.args[0] if isinstance(call, ast.Call) and call.args else None
    given = f"[{first.value!r}]" if isinstance(first, ast.Constant) else ""
    yield CallSite(attribute, f"os.environ{given}", rules.ENVIRONMENT)


def _sorting(node: ast.Call, scope: NameScope, names: NameResolver) -> Iterator[CallSite]:
    """Find ``sorted(items, key=id)``."""
    for word in node.keywords:
        name = names.of(word.value, scope) if word.arg == "key" else None
        if name in ("builtins.id", "builtins.hash"):
            rule = rules.ADDRESS if name == "builtins.id" else rules.HASH
            yield CallSite(word.value, f"order by {name.removeprefix('builtins.')}()", rule)


def _sql(node: ast.Call) -> Iterator[CallSite]:
    first = node.args[0]
    if isinstance(first, ast.Constant) and isinstance(first.value, str):
        found = sql_call(first.value)
        if found is not None:
            yield CallSite(first, *found)


def _is_order_ignored(
    module: ModuleSource, node: ast.expr, scope: NameScope, names: NameResolver
) -> bool:
    """Whether the order of a listing does not matter: ``sorted(os.listdir(folder))``."""
    place: ast.AST = node
    user = module.parents.get(place)
    while isinstance(user, (ast.comprehension, ast.GeneratorExp, ast.ListComp, ast.SetComp)):
        if isinstance(user, ast.SetComp):
            return True
        place, user = user, module.parents.get(user)
    return (
        isinstance(user, ast.Call)
        and place in user.args
        and names.of(user.func, scope) in _LISTINGS_UNORDERED
    )


def _shows_address(
    module: ModuleSource, node: ast.Call, scope: NameScope, names: NameResolver
) -> bool:
    """Whether an ``id()`` is compared, shown or computed with; as a key it does no harm."""
    user = module.parents.get(node)
    if isinstance(user, ast.Compare):
        return any(isinstance(op, _ORDERINGS) for op in user.ops)
    if isinstance(user, (ast.FormattedValue, ast.BinOp)):
        return True
    if isinstance(user, ast.Lambda):
        word = module.parents.get(user)
        return isinstance(word, ast.keyword) and word.arg == "key"
    if isinstance(user, ast.Tuple):
        outer = module.parents.get(user)
        pushed = isinstance(outer, ast.Call) and names.of(outer.func, scope)
        return bool(pushed) and str(pushed).startswith("heapq.")
    if isinstance(user, ast.Call):
        name = names.of(user.func, scope) or ""
        return name.removeprefix("builtins.") in _SHOWING
    return False


def _inside_hash(module: ModuleSource, node: ast.AST) -> bool:
    place: ast.AST | None = node
    while place is not None and not isinstance(place, (ast.FunctionDef, ast.AsyncFunctionDef)):
        place = module.parents.get(place)
    return isinstance(place, ast.FunctionDef) and place.name in ("__hash__", "__eq__")


def _plain_number(node: ast.Call) -> bool:
    first = node.args[0] if node.args else None
    return isinstance(first, ast.Constant) and isinstance(first.value, (int, float))


def _in_annotation(module: ModuleSource, node: ast.AST) -> bool:
    """Whether a name only names a type: in an annotation, ``isinstance``, ``except``."""
    child, parent = node, module.parents.get(node)
    while isinstance(parent, ast.expr):
        if isinstance(parent, ast.Call) and isinstance(parent.func, ast.Name):
            checks = parent.func.id in ("isinstance", "issubclass", "cast", "TypeVar")
            if checks and child in parent.args:
                return True
        if isinstance(parent, (ast.Call, ast.Lambda)):
            return False
        child, parent = parent, module.parents.get(parent)
    if isinstance(parent, ast.AnnAssign):
        return parent.annotation is child
    if isinstance(parent, (ast.FunctionDef, ast.AsyncFunctionDef)):
        return parent.returns is child
    return isinstance(parent, (ast.arg, ast.ExceptHandler))


def _seeded_generators(module: ModuleSource, names: NameResolver) -> set[str]:
    """Return the prefixes of shared generators that the module seeds itself."""
    found = set()
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Call) and not rules.is_unseeded(node):
            name = names.of(node.func, module.scope_of(node))
            found |= {prefix for prefix, seed in SHARED_GENERATORS.items() if name == seed}
    return found


def _never_run(module: ModuleSource) -> Iterator[ast.stmt]:
    """Yield the statements that run only as a script, or only for type checkers."""
    for node in module.tree.body:
        if isinstance(node, ast.If):
            text = ast.dump(node.test)
            main = isinstance(node.test, ast.Compare) and "'__name__'" in text
            if main or "'TYPE_CHECKING'" in text:
                yield from node.body


def _text(node: ast.expr) -> str:
    text = ast.unparse(node)
    return text if len(text) <= 40 else text[:39] + "…"
