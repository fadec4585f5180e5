"""One-line changes to a node, made by a tool: other operators, constants, conditions."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

_OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.FloorDiv: "*",
    ast.Mod: "+",
}
_COMPARISONS: dict[type[ast.cmpop], str] = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
}


@dataclass(frozen=True)
class Mutation:
    """A source with one expression exchanged in ``line``; ``what`` says it for a message."""

    line: int
    what: str
    source: str


def mutations(source: str) -> Iterator[Mutation]:
    """Yield every change of one operator, number or condition within the functions of a module."""
    lines = source.splitlines(keepends=True)
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef):
            for statement in function.body:
                for node in ast.walk(statement):
                    if isinstance(node, ast.FunctionDef):
                        break
                    new = _changed(node)
                    if new is not None:
                        yield _mutation(lines, node, new)


def _changed(node: ast.AST) -> str | None:
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        left, right = ast.unparse(node.left), ast.unparse(node.right)
        return f"(({left}) {_OPERATORS[type(node.op)]} ({right}))"
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in _COMPARISONS:
        left, right = ast.unparse(node.left), ast.unparse(node.comparators[0])
        return f"(({left}) {_COMPARISONS[type(node.ops[0])]} ({right}))"
    if isinstance(node, ast.Constant) and type(node.value) is float:
        return repr(node.value * 1.25 + 0.01)
    if isinstance(node, ast.Constant) and type(node.value) is int:
        return repr(node.value + 1)
    if isinstance(node, ast.IfExp):
        return f"(not ({ast.unparse(node.test)}))"
    return None


def _mutation(lines: list[str], node: ast.AST, new: str) -> Mutation:
    assert isinstance(node, ast.expr)
    assert node.end_lineno is not None
    assert node.end_col_offset is not None
    first, last = node.lineno - 1, node.end_lineno - 1
    head = lines[first].encode()[: node.col_offset].decode()
    tail = lines[last].encode()[node.end_col_offset :].decode()
    old = ast.unparse(node)
    changed = [*lines[:first], f"{head}{new}{tail}", *lines[last + 1 :]]
    return Mutation(node.lineno, f"line {node.lineno}: {old} -> {new}", "".join(changed))
