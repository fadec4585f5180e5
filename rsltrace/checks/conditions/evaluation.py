"""The language of expressions: which parts they have, and what each part is worth.

A text is parsed as Python writes expressions, but never run as Python: each part that the language
has becomes a function of the event, and what it does not have is refused with its place. So a
text from somebody's trace can read fields of messages and compute within bounds, and nothing else.
Rejected: ``eval`` of a tree that was looked through (one attribute that was forgotten, as
``__globals__``, is all of Python), and a library with a language of its own (nobody who writes
nodes in Python knows it).
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import warnings
from array import array
from collections.abc import Callable, Iterator, Mapping
from types import (
    BuiltinFunctionType,
    CodeType,
    FrameType,
    FunctionType,
    GeneratorType,
    MethodType,
    ModuleType,
)
from typing import Any, Protocol

from rsltrace.checks.conditions.bounds import (
    DEPTH_MAX,
    STEPS_EACH,
    TEXT_MAX,
    LimitError,
    StepBudget,
    spend_for,
    within_limits,
)
from rsltrace.checks.conditions.functions import (
    CONSTANTS,
    FUNCTIONS,
    METHODS,
    OF_FLOATS,
    OF_MODULES,
    items,
)
from rsltrace.checks.conditions.operators import BINARY, COMPARE, UNARY, USUAL, element
from rsltrace.errors import ConditionError, did_you_mean
from rsltrace.trace.model.texts import PLACEHOLDERS

LANGUAGE = (
    "fields, numbers, texts, comparisons, and, or, not, in, arithmetic, indexes, A if B else C, "
    "comprehensions and fixed functions"
)
"""What an expression may have, in the words of its errors."""


class ExpressionContext:
    """What an expression is evaluated for. ``message`` is the one whose fields it names,
    ``moment`` what its other names are looked up in."""

    __slots__ = ("budget", "message", "moment", "own", "reading")

    def __init__(self, moment: Any, message: Any, budget: StepBudget) -> None:
        self.moment = moment
        self.message = message
        self.budget = budget
        self.reading = budget.reading
        self.own: dict[str, Any] = {}


Evaluate = Callable[[ExpressionContext], Any]
"""A part of an expression, ready to be evaluated."""


class Vocabulary(Protocol):
    """The names that one use of the language offers, beside those of the language itself."""

    def name(self, name: str) -> Evaluate | None:
        """Return how a name is looked up; None: it has no such name."""

    def call(self, name: str, arguments: list[ast.expr]) -> Evaluate | str | None:
        """Return how a function of its own is called, or what is wrong with its arguments; None:
        it has no such function."""

    def functions(self) -> list[str]:
        """Return the names of its own functions."""

    def unknown(self, name: str) -> str:
        """Return what is wrong with a name that nobody knows."""


class UnsupportedExpression(Exception):
    """A part of an expression is not of the language."""

    def __init__(self, node: ast.AST, message: str) -> None:
        super().__init__(message)
        self.node = node
        self.message = message


# -- reading ---------------------------------------------------------------------------------------


def parsed(text: str, whole: str, begin: int) -> ast.expr:
    """Return the tree of an expression that begins at ``begin`` in ``whole``.

    :raises ConditionError: it is none, or too long, or too deeply nested.
    """
    if not text:
        raise ConditionError("an expression is missing here", whole, begin)
    if len(text) > TEXT_MAX:
        raise ConditionError(f"it is longer than {TEXT_MAX} characters", whole, begin)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that 1 is 1 is somebody's own affair
            tree = ast.parse(text, mode="eval").body
    except SyntaxError as error:
        last = len(text) - 1  # also where Python has no place to name
        at = min(error.offset - 1, last) if error.lineno == 1 and error.offset else last
        message = f"not an expression: {error.msg}"
        raise ConditionError(message, whole, begin + at, begin + at + 1) from None
    except (ValueError, RecursionError, MemoryError) as error:
        end = begin + len(text)
        raise ConditionError(f"not an expression: {error}", whole, begin, end) from None
    left: list[tuple[ast.AST, int]] = [(tree, 1)]
    while left:
        node, depth = left.pop()
        if depth > DEPTH_MAX:
            raise ConditionError(f"it is nested more than {DEPTH_MAX} deep", whole, begin)
        left += [(inner, depth + 1) for inner in ast.iter_child_nodes(node)]
    return tree


class TextPositions:
    """Where parts of an expression stand in its text: ``ast`` counts bytes of lines."""

    def __init__(self, text: str) -> None:
        self._text = text

    def of(self, node: ast.AST) -> tuple[int, int]:
        """Return the first character of a part, and the one after its last."""
        found: Any = node
        begin = self._at(found.lineno, found.col_offset)
        return begin, self._at(found.end_lineno, found.end_col_offset)

    def _at(self, line: int, column: int) -> int:
        lines = self._text.splitlines(keepends=True)
        before = sum(map(len, lines[: line - 1]))
        return before + len(lines[line - 1].encode()[:column].decode(errors="ignore"))


def evaluation(tree: ast.expr, vocabulary: Vocabulary) -> Evaluate:
    """Return how a tree is evaluated.

    :raises Refused: a part of it is not of the language.
    """
    return _ExpressionCompiler(vocabulary).part(tree, {}, 0)


def value_of(evaluate: Evaluate, moment: Any, message: Any, budget: StepBudget) -> Any:
    """Return what an expression is worth. Raises whatever its parts raise."""
    budget.left += STEPS_EACH
    found = evaluate(ExpressionContext(moment, message, budget))
    if type(found) is GeneratorType:
        raise TypeError("a comprehension has no value of its own: say any(...) or all(...)")
    return found


class _ExpressionCompiler:
    """Makes functions of the parts of a tree. ``own`` are the names of comprehensions around a
    part, with where their values are kept; ``depth`` counts these comprehensions."""

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._vocabulary = vocabulary
        self._parts: Mapping[type[ast.AST], Callable[..., Evaluate]] = {
            ast.Constant: self._constant,
            ast.Name: self._name,
            ast.Attribute: self._attribute,
            ast.Subscript: self._subscript,
            ast.Slice: self._slice,
            ast.List: self._list,
            ast.Tuple: self._tuple,
            ast.Compare: self._compare,
            ast.BoolOp: self._logic,
            ast.BinOp: self._binary,
            ast.UnaryOp: self._unary,
            ast.IfExp: self._choice,
            ast.Call: self._call,
            ast.GeneratorExp: self._generator,
            ast.ListComp: self._comprehension,
        }
        self._count = 0
        self._budget = StepBudget()

    def part(self, node: ast.AST, own: Mapping[str, str], depth: int) -> Evaluate:
        make = self._parts.get(type(node))
        if make is None:
            what = _WORDS.get(type(node), type(node).__name__)
            raise UnsupportedExpression(
                node, f"{what} has no place in an expression, which has {LANGUAGE}"
            )
        return make(node, own, depth)

    def _constant(self, node: ast.Constant, own: Mapping[str, str], depth: int) -> Evaluate:
        value = node.value
        if not isinstance(value, (int, float, str, bytes, type(None))):
            raise UnsupportedExpression(node, f"{ast.unparse(node)} has no place in an expression")
        try:
            within_limits(value)
        except LimitError as error:
            raise UnsupportedExpression(node, str(error)) from None
        return _Constant(value)

    def _name(self, node: ast.Name, own: Mapping[str, str], depth: int) -> Evaluate:
        if node.id in own:
            key = own[node.id]
            return lambda scope: scope.own[key]
        found = self._vocabulary.name(node.id)
        if found is not None:
            return found
        if node.id in CONSTANTS:
            return _Constant(CONSTANTS[node.id])
        if node.id in FUNCTIONS or node.id in OF_MODULES:
            raise UnsupportedExpression(node, f"{node.id} is a function here: {node.id}(...)")
        raise UnsupportedExpression(node, self._vocabulary.unknown(node.id))

    def _attribute(self, node: ast.Attribute, own: Mapping[str, str], depth: int) -> Evaluate:
        module = self._module(node.value, own)
        if module is not None:
            if node.attr in CONSTANTS:
                return _Constant(CONSTANTS[node.attr])
            raise UnsupportedExpression(node, _no_function(f"{module}.{node.attr}"))
        name = node.attr
        if name.startswith("__"):
            raise UnsupportedExpression(node, f"{name!r} is no field of a message")
        inner = self.part(node.value, own, depth)
        return lambda scope: field(inner(scope), name)

    def _module(self, node: ast.expr, own: Mapping[str, str]) -> str | None:
        """Return ``np`` or ``math`` where one is named: they are part of names of functions."""
        if isinstance(node, ast.Name) and node.id in OF_MODULES and node.id not in own:
            return node.id
        if isinstance(node, ast.Attribute) and node.attr == "linalg":
            outer = self._module(node.value, own)
            return None if outer is None else f"{outer}.linalg"
        return None

    def _subscript(self, node: ast.Subscript, own: Mapping[str, str], depth: int) -> Evaluate:
        value = self.part(node.value, own, depth)
        index = self.part(node.slice, own, depth)
        if isinstance(index, _Constant) and type(index.value) is int:
            number = index.value
            return lambda scope: element(scope.budget, value(scope), number)
        if depth:
            return lambda scope: element(scope.budget, value(scope), index(scope))
        return lambda scope: element(scope.reading, value(scope), index(scope))

    def _slice(self, node: ast.Slice, own: Mapping[str, str], depth: int) -> Evaluate:
        parts = [
            _Constant(None) if one is None else self.part(one, own, depth)
            for one in (node.lower, node.upper, node.step)
        ]
        return lambda scope: slice(*[part(scope) for part in parts])

    def _list(self, node: ast.List, own: Mapping[str, str], depth: int) -> Evaluate:
        parts = [self.part(one, own, depth) for one in node.elts]

        def made(scope: ExpressionContext) -> list[Any]:
            found = [part(scope) for part in parts]
            spend_for(found, scope.budget)
            return found

        return made

    def _tuple(self, node: ast.Tuple, own: Mapping[str, str], depth: int) -> Evaluate:
        parts = [self.part(one, own, depth) for one in node.elts]
        if all(isinstance(part, _Constant) for part in parts):
            return _Constant(tuple(part.value for part in parts))  # type: ignore[attr-defined]

        def made(scope: ExpressionContext) -> tuple[Any, ...]:
            found = tuple([part(scope) for part in parts])
            spend_for(found, scope.budget)
            return found

        return made

    def _compare(self, node: ast.Compare, own: Mapping[str, str], depth: int) -> Evaluate:
        left = self.part(node.left, own, depth)
        (compare, right), *rest = [
            (COMPARE[type(sign)], self.part(one, own, depth))
            for sign, one in zip(node.ops, node.comparators, strict=True)
        ]
        if rest:
            return _chain(left, compare, right, rest)
        if isinstance(right, _Constant) and type(right.value) in _SMALL:
            constant = right.value
            if not depth:
                return lambda scope: compare(left(scope), constant)

            def compared_with(scope: ExpressionContext) -> Any:
                a = left(scope)
                if type(a) in _SMALL:
                    return compare(a, constant)
                return _compared(scope, compare, a, constant)

            return compared_with

        def compared(scope: ExpressionContext) -> Any:
            a, b = left(scope), right(scope)
            if type(a) in _SMALL and type(b) in _SMALL:
                return compare(a, b)
            return _compared(scope, compare, a, b)

        return compared

    def _logic(self, node: ast.BoolOp, own: Mapping[str, str], depth: int) -> Evaluate:
        *firsts, last = (self.part(one, own, depth) for one in node.values)
        is_or = isinstance(node.op, ast.Or)

        def logic(scope: ExpressionContext) -> Any:
            for part in firsts:
                found = part(scope)
                if bool(found) is is_or:
                    return found
            return last(scope)

        return logic

    def _binary(self, node: ast.BinOp, own: Mapping[str, str], depth: int) -> Evaluate:
        operate = BINARY.get(type(node.op))
        if operate is None:
            raise UnsupportedExpression(
                node, f"@ has no place in an expression, which has {LANGUAGE}: dot(a, b)"
            )
        left, right = self.part(node.left, own, depth), self.part(node.right, own, depth)
        if isinstance(left, _Constant) and isinstance(right, _Constant):
            try:
                return _Constant(operate(self._budget, left.value, right.value))
            except LimitError as error:
                raise UnsupportedExpression(node, str(error)) from None
            except Exception:
                pass  # it is said where it is evaluated
        usual = USUAL.get(type(node.op))
        if usual is None:
            return lambda scope: operate(
                scope.budget if depth else scope.reading, left(scope), right(scope)
            )

        def computed(scope: ExpressionContext) -> Any:
            a, b = left(scope), right(scope)
            if type(a) is float and type(b) in _REALS:
                return usual(a, b)
            return operate(scope.budget if depth else scope.reading, a, b)

        return computed

    def _unary(self, node: ast.UnaryOp, own: Mapping[str, str], depth: int) -> Evaluate:
        operate = UNARY[type(node.op)]
        inner = self.part(node.operand, own, depth)
        if isinstance(inner, _Constant) and type(inner.value) in (int, float, bool):
            try:
                return _Constant(operate(inner.value))
            except TypeError:
                pass  # it is said where it is evaluated
        return lambda scope: within_limits(operate(inner(scope)))

    def _choice(self, node: ast.IfExp, own: Mapping[str, str], depth: int) -> Evaluate:
        test, then, other = (self.part(p, own, depth) for p in (node.test, node.body, node.orelse))
        return lambda scope: then(scope) if test(scope) else other(scope)

    # -- functions ---------------------------------------------------------------------------------

    def _call(self, node: ast.Call, own: Mapping[str, str], depth: int) -> Evaluate:
        if isinstance(node.func, ast.Name) and node.func.id not in own:
            found = self._vocabulary.call(node.func.id, node.args)
            if isinstance(found, str) or (found is not None and node.keywords):
                raise UnsupportedExpression(
                    node, found if isinstance(found, str) else "it takes no keywords"
                )
            if found is not None:
                return found
        function, values = self._function(node, own, depth)
        values += [self.part(one, own, depth) for one in node.args]
        options = {}
        for option in node.keywords:
            if option.arg not in _OPTIONS:
                words = ", ".join(_OPTIONS)
                raise UnsupportedExpression(
                    option.value, f"functions here take no {option.arg}=, only {words}"
                )
            options[option.arg] = self.part(option.value, own, depth)
        try:
            inspect.signature(function).bind(None, *values, **options)
        except TypeError as error:
            raise UnsupportedExpression(node, f"{ast.unparse(node.func)}: {error}") from None
        if options:

            def called_with(scope: ExpressionContext) -> Any:
                budget = scope.budget if depth else scope.reading
                made = {name: part(scope) for name, part in options.items()}
                return within_limits(function(budget, *[value(scope) for value in values], **made))

            return called_with
        if len(values) == 1:
            (only,) = values
            usual = OF_FLOATS.get(function)
            if usual is not None:

                def called_often(scope: ExpressionContext) -> Any:
                    value = only(scope)
                    if type(value) is float:
                        return usual(value)
                    return within_limits(function(scope.budget if depth else scope.reading, value))

                return called_often
            if depth:
                return lambda scope: within_limits(function(scope.budget, only(scope)))
            return lambda scope: within_limits(function(scope.reading, only(scope)))

        def called(scope: ExpressionContext) -> Any:
            budget = scope.budget if depth else scope.reading
            return within_limits(function(budget, *[value(scope) for value in values]))

        return called

    def _function(
        self, node: ast.Call, own: Mapping[str, str], depth: int
    ) -> tuple[Callable[..., Any], list[Evaluate]]:
        """Return the function that a call names, and the value that stands before its name."""
        named = node.func
        for one in (*node.args, *(option.value for option in node.keywords)):
            if isinstance(one, ast.Starred):
                raise UnsupportedExpression(one, "a function takes plain arguments here")
        if isinstance(named, ast.Name):
            if named.id in FUNCTIONS and named.id not in own:
                return FUNCTIONS[named.id], []
            own_functions = self._vocabulary.functions()
            raise UnsupportedExpression(node, _no_function(named.id, own_functions))
        if isinstance(named, ast.Attribute):
            module = self._module(named.value, own)
            if module is not None:
                outer, _, inner = f"{module}.{named.attr}".partition(".")
                if inner not in OF_MODULES[outer]:
                    raise UnsupportedExpression(node, _no_function(f"{outer}.{inner}"))
                return OF_MODULES[outer][inner], []
            if named.attr in METHODS:
                return METHODS[named.attr], [self.part(named.value, own, depth)]
            raise UnsupportedExpression(node, _no_function(named.attr, methods=True))
        raise UnsupportedExpression(node, _no_function(""))

    # -- comprehensions ----------------------------------------------------------------------------

    def _generator(
        self, node: ast.GeneratorExp | ast.ListComp, own: Mapping[str, str], depth: int
    ) -> Evaluate:
        keys = dict(own)
        loops = []
        for at, one in enumerate(node.generators):
            if one.is_async:
                raise UnsupportedExpression(node, "async has no place in an expression")
            among = self.part(one.iter, keys, depth + at)
            self._count += 1
            names = _targets(one.target)
            unpacks = not isinstance(one.target, ast.Name)
            keys = {**keys, **{name: f"{name} {self._count}" for name in names}}
            tests = [self.part(test, keys, depth + at + 1) for test in one.ifs]
            targets = [keys[name] for name in names]
            loops.append((among, targets, unpacks, tests, depth + at == 0))
        result = self.part(node.elt, keys, depth + len(loops))
        cost = 1 + sum(1 for _ in ast.walk(node.elt)) // 4

        def run(scope: ExpressionContext, at: int) -> Iterator[Any]:
            among, targets, unpacks, tests, is_free = loops[at]
            own_values, budget = scope.own, scope.budget
            is_last = at == len(loops) - 1
            first, *others = targets
            for item in items(scope.reading if is_free else budget, among(scope)):
                if not is_free:
                    budget.spend(cost)
                if not unpacks:
                    own_values[first] = item
                elif len(others) == 1:
                    own_values[first], own_values[others[0]] = item
                else:
                    own_values.update(zip(targets, item, strict=True))
                for test in tests:
                    if not test(scope):
                        break
                else:
                    if is_last:
                        found = result(scope)
                        if type(found) not in _SMALL:
                            spend_for(found, budget)
                        yield found
                    else:
                        yield from run(scope, at + 1)

        among, targets, _, tests, is_free = loops[0]
        if len(loops) > 1 or tests or len(targets) != 1 + unpacks:
            return lambda scope: run(scope, 0)

        def simple(scope: ExpressionContext) -> Iterator[Any]:  # the usual loop
            own_values, budget = scope.own, scope.budget
            first, second = targets[0], targets[-1]
            for item in items(scope.reading if is_free else budget, among(scope)):
                if not is_free:
                    budget.spend(cost)
                if first is second and not unpacks:
                    own_values[first] = item
                else:
                    own_values[first], own_values[second] = item
                found = result(scope)
                if type(found) not in _SMALL:
                    spend_for(found, budget)
                yield found

        return simple

    def _comprehension(self, node: ast.ListComp, own: Mapping[str, str], depth: int) -> Evaluate:
        generate = self._generator(node, own, depth)

        return lambda scope: list(generate(scope))


_REALS = frozenset((int, float, bool))
_SMALL = frozenset((int, float, bool, type(None)))
_NESTED = frozenset((list, tuple))
_OPTIONS = ("default", "start", "reverse", "ndigits", "axis")
_WORDS: Mapping[type[ast.AST], str] = {
    ast.NamedExpr: "an assignment (:=)",
    ast.Await: "await",
    ast.Yield: "yield",
    ast.YieldFrom: "yield",
    ast.Lambda: "lambda",
    ast.JoinedStr: "an f-string",
    ast.Starred: "*",
    ast.Dict: "a dictionary",
    ast.DictComp: "a dictionary",
    ast.Set: "{…}",
    ast.SetComp: "{…}",
}


def _chain(
    left: Evaluate,
    compare: Callable[[Any, Any], Any],
    right: Evaluate,
    rest: list[tuple[Callable[[Any, Any], Any], Evaluate]],
) -> Evaluate:
    """Return how ``0.1 < x < 3`` is evaluated: each part once."""

    def chained(scope: ExpressionContext) -> Any:
        a, b = left(scope), right(scope)
        small = type(a) in _SMALL and type(b) in _SMALL
        found = compare(a, b) if small else _compared(scope, compare, a, b)
        for compare_next, following in rest:
            if not found:
                return found
            a, b = b, following(scope)
            small = type(a) in _SMALL and type(b) in _SMALL
            found = compare_next(a, b) if small else _compared(scope, compare_next, a, b)
        return found

    if len(rest) == 1 and isinstance(left, _Constant) and isinstance(rest[0][1], _Constant):
        low, below, high = left.value, rest[0][0], rest[0][1].value
        if type(low) in _SMALL and type(high) in _SMALL:

            def between(scope: ExpressionContext) -> Any:
                value = right(scope)
                if type(value) in _SMALL:
                    return compare(low, value) and below(value, high)
                return chained(scope)

            return between
    return chained


def _compared(scope: ExpressionContext, compare: Callable[[Any, Any], Any], a: Any, b: Any) -> Any:
    """Compare two values of which one may be large, and pay for it inside of loops."""
    if type(b) in _NESTED:
        spend_for(b, scope.budget)
    elif scope.own and hasattr(b, "__len__"):
        scope.budget.spend(len(b) >> 6)
    if scope.own and hasattr(a, "__len__"):
        scope.budget.spend(len(a) >> 6)
    return compare(a, b)


class _Constant:
    """A part that is worth the same for all events."""

    __slots__ = ("value",)

    def __init__(self, value: Any) -> None:
        self.value = value

    def __call__(self, scope: ExpressionContext) -> Any:
        return self.value


def _targets(node: ast.expr) -> list[str]:
    if isinstance(node, ast.Name):
        return [node.id]
    if isinstance(node, ast.Tuple) and all(isinstance(one, ast.Name) for one in node.elts):
        return [one.id for one in node.elts if isinstance(one, ast.Name)]
    raise UnsupportedExpression(node, "a comprehension names one value, or (a, b)")


def _no_function(name: str, own: list[str] | None = None, *, methods: bool = False) -> str:
    outer, _, inner = name.partition(".")
    known = METHODS if methods else OF_MODULES[outer] if inner else FUNCTIONS
    there = [*(own or ()), *known]
    hint = did_you_mean(inner or name, there, f"there are {', '.join(sorted(there))}")
    what = f"{name!r} is no function here" if name else "only functions can be called"
    return f"{what}; {hint}"


# -- fields ----------------------------------------------------------------------------------------

_NO_STATE = (
    *(BuiltinFunctionType, CodeType, FrameType, FunctionType, GeneratorType, MethodType),
    *(ModuleType, type, str, bytes, int, float, list, tuple, dict, set, frozenset, range),
    *(bytearray, type(None)),
)
"""What has attributes that are no fields: an expression does not see them."""

_FIELDS: dict[type, frozenset[str]] = {}
"""The names of fields by the class of a message."""
_FIELDS_MAX = 10_000


def field(value: Any, name: str) -> Any:
    """Return a field of a message, or an attribute of a node that runs or of what it holds.

    :raises AttributeError: there is none.
    """
    names = _FIELDS.get(type(value))
    if names is None:
        names = _fields_of(value)
    if names is not None:
        if name in names:
            found = getattr(value, name)
            return _as_array(found) if type(found) is array else found
        hint = did_you_mean(name, sorted(names), f"it has {', '.join(sorted(names))}")
        raise AttributeError(f"{type(value).__name__} has no field {name!r}; {hint}")
    if isinstance(value, _NO_STATE) or type(value).__module__ == "numpy":
        raise AttributeError(f"{type(value).__name__} has no field {name!r}")
    return getattr(value, name)  # of a node


def message_field(message: Any, name: str) -> Any:
    """Return a field of a message, or ``NO_FIELD``."""
    names = _FIELDS.get(type(message))
    if names is None:
        names = _fields_of(message) or frozenset(field_names(message))
    if name not in names:
        return NO_FIELD
    found = getattr(message, name)
    return _as_array(found) if type(found) is array else found


NO_FIELD = object()


def field_names(message: Any) -> list[str]:
    """Return the names of a message's fields, in their order where it says one."""
    known = getattr(message, "get_fields_and_field_types", None)
    if known is not None:
        return list(known())
    if dataclasses.is_dataclass(message):
        return [one.name for one in dataclasses.fields(message) if one.name not in PLACEHOLDERS]
    return list(getattr(message, "__dict__", ()))


def _fields_of(value: Any) -> frozenset[str] | None:
    """Return the names of the fields of a message, None of anything else."""
    kind = type(value)
    marks = ("get_fields_and_field_types", "__msgtype__", "of_event")
    if isinstance(value, type) or not any(hasattr(kind, mark) for mark in marks):
        return None
    names = frozenset(field_names(value))
    if len(_FIELDS) >= _FIELDS_MAX:
        _FIELDS.clear()
    _FIELDS[kind] = names
    return names


def _as_array(value: Any) -> Any:
    """Return a sequence of numbers in a message of a node as it is in messages of a trace."""
    import numpy

    return numpy.array(value)
