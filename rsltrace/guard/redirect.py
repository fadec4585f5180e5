"""Make a built-in function call a Python function, wherever it is bound already.

``time.time = other`` misses ``from time import time``, default arguments and tables of functions.
All of these hold the same function object, so the object itself is changed: its method definition
becomes one that calls the other function. (CPython's ``PyObject_Vectorcall`` has exactly the
signature of a built-in with keywords.) Nothing is compiled, the call costs as much as a call of a
Python function, and ``restore`` puts three pointers back.

CPython has had this layout since 3.8; it is checked before anything is written.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial, update_wrapper, wraps
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

from rsltrace.errors import SetupError

_FASTCALL_KEYWORDS = 0x82
_NO_ARGUMENTS = 0x4
_api = ctypes.pythonapi
_EXPORTED = hasattr(_api, "PyObject_Vectorcall")  # not by Python 3.10
_VECTORCALL_OF = _api.PyObject_Vectorcall if _EXPORTED else _api._PyFunction_Vectorcall
_CALL = ctypes.cast(_VECTORCALL_OF, ctypes.c_void_p).value
_NEXT = ctypes.cast(_api.PyIter_Next, ctypes.c_void_p).value
_new_function = ctypes.PYFUNCTYPE(
    ctypes.py_object, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p
)(("PyCFunction_NewEx", _api))
_new_descriptor = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object, ctypes.c_void_p)(
    ("PyDescr_NewMethod", _api)
)
_count_up = ctypes.PYFUNCTYPE(None, ctypes.c_void_p)(("Py_IncRef", _api))
_count_down = ctypes.PYFUNCTYPE(None, ctypes.c_void_p)(("Py_DecRef", _api))


class _MethodDef(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_char_p),
        ("function", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    )


class _Function(ctypes.Structure):
    _fields_ = (
        ("references", ctypes.c_ssize_t),
        ("type", ctypes.c_void_p),
        ("definition", ctypes.c_void_p),
        ("owner", ctypes.c_void_p),
        ("module", ctypes.c_void_p),
        ("weak_references", ctypes.c_void_p),
        ("vectorcall", ctypes.c_void_p),
    )


class _Method(ctypes.Structure):
    _fields_ = (
        ("references", ctypes.c_ssize_t),
        ("type", ctypes.c_void_p),
        ("function", ctypes.c_void_p),
        ("owner", ctypes.c_void_p),
    )


def _vectorcall(address: int | None, flags: int) -> int:
    """Return how Python calls built-in functions with these flags."""
    definition = _MethodDef(b"", address, flags, None)
    function = _new_function(ctypes.addressof(definition), id(None), None)
    return int(_Function.from_address(id(function)).vectorcall)


_VECTORCALLS = {
    _FASTCALL_KEYWORDS: _vectorcall(_CALL, _FASTCALL_KEYWORDS),
    _NO_ARGUMENTS: _vectorcall(_NEXT, _NO_ARGUMENTS),
}


class Redirected:
    """A built-in function that calls ``target`` until ``restore``. ``real`` does what it did
    before."""

    def __init__(self, function: BuiltinFunctionType, target: Callable[..., Any]) -> None:
        self._turn(function, _callable(target), _CALL, _FASTCALL_KEYWORDS)

    def _turn(
        self, function: BuiltinFunctionType, target: object, address: int | None, flags: int
    ) -> None:
        _check_is_built_in(function)
        self._function = function
        self._target = target
        self.real = copy_of(function)
        place = _Function.from_address(id(function))
        self._saved = (place.definition, place.owner, place.vectorcall)
        told = _MethodDef.from_address(place.definition).doc if place.definition else None
        self._definition = _MethodDef(function.__name__.encode(), address, flags, told)
        _count_up(id(target))
        place.definition = ctypes.addressof(self._definition)
        place.owner = id(target)
        place.vectorcall = _VECTORCALLS[flags]

    def restore(self) -> None:
        place = _Function.from_address(id(self._function))
        place.definition, place.owner, place.vectorcall = self._saved
        _count_down(id(self._target))


class RedirectedReader(Redirected):
    """A built-in function without arguments; ``target`` gets the globals of the calling module.

    C code fetches them, which costs a fraction of a frame: no Python code runs before ``target``.
    """

    def __init__(
        self, function: BuiltinFunctionType, target: Callable[[dict[str, Any]], Any]
    ) -> None:
        self._turn(function, map(target, iter(globals, None)), _NEXT, _NO_ARGUMENTS)


def has_no_arguments(function: BuiltinFunctionType) -> bool:
    """Return whether a built-in function takes no arguments, so ``RedirectedReader`` fits."""
    _check_is_built_in(function)
    definition = _Function.from_address(id(function)).definition
    return bool(_MethodDef.from_address(definition).flags == _NO_ARGUMENTS)


def _callable(target: Callable[..., Any]) -> Callable[..., Any]:
    """Return a callable for ``_CALL``: on Python 3.10 only functions work."""
    if _EXPORTED or isinstance(target, FunctionType):
        return target

    def call(*arguments: Any, **options: Any) -> Any:
        return target(*arguments, **options)

    return call


class RedirectedMethod:
    """A bound method (``random.seed``) that calls ``target`` instead, until ``restore``."""

    def __init__(self, method: MethodType, target: Callable[..., Any]) -> None:
        self._method = method
        self._target = target
        self.real: Callable[..., Any] = MethodType(method.__func__, method.__self__)
        place = _Method.from_address(id(method))
        if place.function != id(method.__func__) or place.owner != id(method.__self__):
            raise _unknown_layout()
        self._saved = place.function
        update_wrapper(target, method.__func__)  # inspect.signature shows that of the method
        _count_up(id(target))
        place.function = id(target)

    def restore(self) -> None:
        _Method.from_address(id(self._method)).function = self._saved
        _count_down(id(self._target))


def redirect(stack: ExitStack, function: Any, make: Callable[[Any], Callable[..., Any]]) -> None:
    """Redirect a built-in function to ``make(copy of it)`` until ``stack`` ends."""
    stack.callback(Redirected(function, make(copy_of(function))).restore)


def redirect_reader(
    stack: ExitStack, function: Any, make: Callable[[Any], Callable[[dict[str, Any]], Any]]
) -> None:
    """Redirect a built-in function without arguments; see ``RedirectedReader``."""
    stack.callback(RedirectedReader(function, make(copy_of(function))).restore)


def replace_attribute(stack: ExitStack, owner: Any, name: str, value: object) -> None:
    """Set an attribute of a module or class until ``stack`` ends."""
    stack.callback(setattr, owner, name, getattr(owner, name))
    setattr(owner, name, value)


def module_with(module: ModuleType, **attributes: object) -> ModuleType:
    """Return a module that differs from ``module`` in these attributes only: what stands in for
    one that rclpy imports is the user's, too, after ``from rclpy.executors import *``."""
    changed = ModuleType(module.__name__)
    vars(changed).update(attributes, __getattr__=partial(getattr, module))
    return changed


def redirect_function(
    stack: ExitStack, module: Any, name: str, make: Callable[[Any], Callable[..., Any]]
) -> None:
    """Redirect a function, if the module has it: one of C wherever it is bound, one of Python in
    every loaded module that has it under this name."""
    function = getattr(module, name, None)
    if isinstance(function, BuiltinFunctionType):
        redirect(stack, function, make)
    elif function is not None:
        replacement = wraps(function)(make(function))
        for owner in list(sys.modules.values()):
            if getattr(owner, "__dict__", {}).get(name) is function:
                replace_attribute(stack, owner, name, replacement)


def copy_of(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a second function object that does what ``function`` does now.

    Of a redirected function this is its target, because its definition will be gone; what is not
    built in (a tool has replaced it) is never redirected, and its own copy.
    """
    if not isinstance(function, BuiltinFunctionType):
        return function
    place = _Function.from_address(id(function))
    definition = place.definition
    calls = _MethodDef.from_address(definition).function if definition else None
    if calls in (_CALL, _NEXT):
        target: Any = function.__self__
        return target if calls == _CALL else target.__next__  # type: ignore[no-any-return]
    name = _MethodDef.from_address(definition).name if definition else None
    owner = function.__self__
    if name != function.__name__.encode() or place.owner not in (None, id(owner)):
        raise _unknown_layout()
    copy: Callable[..., Any] = _new_function(definition, place.owner, place.module)
    return copy


def method_of(kind: type, name: str, function: Any) -> Callable[..., Any]:
    """Return a C function of CPython that takes an object of ``kind``, as a Python function."""
    address = ctypes.cast(function, ctypes.c_void_p).value
    definition = _MethodDef(name.encode(), address, _NO_ARGUMENTS, None)
    _kept.append(definition)
    method: Callable[..., Any] = _new_descriptor(kind, ctypes.addressof(definition))
    return method


_kept: list[_MethodDef] = []


def _check_is_built_in(function: Any) -> None:
    """Raise SetupError for what a tool has put in the place of a built-in function."""
    if not isinstance(function, BuiltinFunctionType):
        code = getattr(function, "__code__", None)
        place = "" if code is None else f" ({code.co_filename}:{code.co_firstlineno})"
        raise SetupError(
            f"{getattr(function, '__name__', function)}() of this Python has been replaced{place} "
            "before the run, so that it cannot be simulated: run rsltrace without what has done so"
        )


def _unknown_layout() -> SetupError:
    return SetupError(
        f"Python {sys.version.split()[0]} ({sys.implementation.name}) has a layout of functions "
        "that the guard does not know; write 'guard: false' in the job to record without it"
    )
