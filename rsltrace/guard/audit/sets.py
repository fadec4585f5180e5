"""Which expressions are sets, and where their order matters.

A set of plain integers has the same order in every process. Counting, sorting and testing members
does not depend on the order. Neither is reported.
"""

from __future__ import annotations

import ast

from rsltrace.guard.audit.names import NameResolver
from rsltrace.guard.audit.scopes import AnnotatedName, Binding, NameScope

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
