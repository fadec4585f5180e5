"""The original code of user modules, for libraries that read code.

User modules are compiled with calls of the guard. numba compiles the instructions of a function,
dill and cloudpickle send them to other processes: these calls must not be in them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from types import CodeType, FunctionType
from typing import Any

from rsltrace.guard.guard import engage, engaged
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource

_sources: dict[str, bytes] = {}
"""The compiled sources by file: a file may change during a run."""
_MARK = "__rsltrace_"
_SETS = frozenset(("set", "frozenset"))


def keep_source(path: str, source: bytes) -> None:
    """Keep the source of a module of user code."""
    _sources[path] = source


def original_of(code: CodeType) -> CodeType:
    """Return code as Python compiles it, without calls of the guard."""
    source = _sources.get(code.co_filename)
    if source is None or not any(
        name.startswith(_MARK) for part in _all_in(code) for name in part.co_names
    ):
        return code
    module: CodeType = compile(source, code.co_filename, "exec", dont_inherit=True)
    found = [one for one in _all_in(module) if _place(one) == _place(code)]
    return found[0] if found else code


def _place(code: CodeType) -> tuple[object, ...]:
    name = getattr(code, "co_qualname", code.co_name)  # from Python 3.11 on
    return name, code.co_firstlineno, code.co_varnames, code.co_freevars


def _all_in(code: CodeType) -> Iterator[CodeType]:
    yield code
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield from _all_in(part)


def _original_for_numba(real: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def get_code_object(obj: Any) -> Any:
        code = real(obj)
        if isinstance(obj, FunctionType) and isinstance(code, CodeType):
            with engage(None):
                original = original_of(code)
            if original is not code:
                obj.__code__ = original
            if code.co_filename in _sources:
                _report_sets(original)
            return original
        return code

    return get_code_object


def _report_sets(code: CodeType) -> None:
    """Report a compiled function that uses sets: they keep Python's order."""
    if not any(_SETS & set(part.co_names) or _makes_set(part) for part in _all_in(code)):
        return
    guard = engaged()
    if guard is None:
        return
    frame: Any = sys._getframe(1)
    if guard.mode(NondeterminismSource.ORDER, frame) is not GuardMode.ALLOW:
        call = f"order of sets in {code.co_name}, which numba compiles"
        line = f"{code.co_filename.rpartition('/')[2]}:{code.co_firstlineno}"
        guard.report(NondeterminismSource.ORDER, GuardMode.WARN, call, line, frame)


def _makes_set(code: CodeType) -> bool:
    import dis

    return any(one.opname in ("BUILD_SET", "SET_ADD") for one in dis.get_instructions(code))


def _for_numba(name: str, stack: ExitStack) -> None:
    real = sys.modules[name].get_code_object
    ours = _original_for_numba(real)
    for module in list(sys.modules.values()):
        if getattr(module, "get_code_object", None) is real:
            stack.callback(setattr, module, "get_code_object", real)
            setattr(module, "get_code_object", ours)  # noqa: B010


def _for_dill(name: str, stack: ExitStack) -> None:
    table = sys.modules[name].Pickler.dispatch
    real = table[CodeType]
    stack.callback(table.__setitem__, CodeType, real)
    table[CodeType] = lambda pickler, code: real(pickler, original_of(code))


def _for_cloudpickle(name: str, stack: ExitStack) -> None:
    table = sys.modules[name].Pickler._dispatch_table
    real = table[CodeType]
    stack.callback(table.__setitem__, CodeType, real)
    table[CodeType] = lambda code: real(original_of(code))


_READERS: dict[str, Callable[[str, ExitStack], None]] = {
    "numba.core.bytecode": _for_numba,
    "dill._dill": _for_dill,
    "cloudpickle.cloudpickle": _for_cloudpickle,
    "joblib.externals.cloudpickle.cloudpickle": _for_cloudpickle,
}
CODE_READERS = tuple(_READERS)
"""Modules that read code, to be prepared when they are loaded."""


def show_original(name: str, stack: ExitStack) -> None:
    """Let one of the ``CODE_READERS``, which is loaded, see original code until ``stack`` ends."""
    try:
        _READERS[name](name, stack)
    except (AttributeError, KeyError):
        pass  # another version
