"""Differences of two looks at a ROS clock in one function: in a simulation they are 0."""

from __future__ import annotations

import ast
from collections.abc import Callable

from rsltrace.guard.audit.scopes import Scope

_DEPTH_MAX = 8
_CONVERSIONS = ("float", "int", "abs")


def is_difference_of_now(node: ast.expr, scope: Scope, depth: int = 0) -> bool:
    """Return whether an expression is a difference of two times that this function looked up,
    however converted."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
        return all(_is_now(side, scope, depth) for side in (node.left, node.right))
    return _within(node, scope, depth, is_difference_of_now)


def _is_now(node: ast.expr, scope: Scope, depth: int) -> bool:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        return node.func.attr == "now" and not node.args and _is_clock(node.func.value)
    return _within(node, scope, depth, _is_now)


def _is_clock(node: ast.expr) -> bool:
    """Return whether an expression is a ROS clock, as far as its name tells."""
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Attribute) and node.func.attr == "get_clock"
    name = node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")
    return str(name).lower().endswith("clock")


def _within(
    node: ast.expr, scope: Scope, depth: int, holds: Callable[[ast.expr, Scope, int], bool]
) -> bool:
    """Look below conversions of a time, and behind names of the function."""
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
