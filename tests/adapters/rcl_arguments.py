"""ROS arguments parsed by rcl itself: the reference for ``rsltrace.adapters.rclpy.arguments``.

rclpy reaches rcl's parser only through a Node, which opens a DDS participant, so the C functions
are called directly here.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence
from ctypes import (
    POINTER,
    Structure,
    byref,
    c_bool,
    c_char_p,
    c_double,
    c_int64,
    c_size_t,
    c_void_p,
)
from functools import lru_cache
from pathlib import Path
from typing import Any

from rsltrace.adapters.rclpy.arguments import InvalidArgumentsError, UnknownArgumentsError

_OK = 0


class _Allocator(Structure):
    _fields_ = (
        ("allocate", c_void_p),
        ("deallocate", c_void_p),
        ("reallocate", c_void_p),
        ("zero_allocate", c_void_p),
        ("state", c_void_p),
    )


class _Arguments(Structure):
    _fields_ = (("impl", c_void_p),)


def _array_of(kind: Any) -> type[Structure]:
    return type(
        f"_Array_{kind.__name__}",
        (Structure,),
        {"_fields_": (("values", POINTER(kind)), ("size", c_size_t))},
    )


class _ErrorString(Structure):
    _fields_ = (("text", ctypes.c_char * 1024),)


class _StringArray(Structure):
    _fields_ = (("size", c_size_t), ("data", POINTER(c_char_p)), ("allocator", _Allocator))


_ByteArray = _array_of(ctypes.c_uint8)
_BoolArray = _array_of(c_bool)
_IntArray = _array_of(c_int64)
_DoubleArray = _array_of(c_double)


class _Variant(Structure):
    _fields_ = (
        ("bool_value", POINTER(c_bool)),
        ("integer_value", POINTER(c_int64)),
        ("double_value", POINTER(c_double)),
        ("string_value", c_char_p),
        ("byte_array_value", POINTER(_ByteArray)),
        ("bool_array_value", POINTER(_BoolArray)),
        ("integer_array_value", POINTER(_IntArray)),
        ("double_array_value", POINTER(_DoubleArray)),
        ("string_array_value", POINTER(_StringArray)),
    )


class _NodeParams(Structure):
    _fields_ = (
        ("names", POINTER(c_char_p)),
        ("values", POINTER(_Variant)),
        ("size", c_size_t),
        ("capacity", c_size_t),
    )


class _Params(Structure):
    _fields_ = (
        ("node_names", POINTER(c_char_p)),
        ("params", POINTER(_NodeParams)),
        ("size", c_size_t),
        ("capacity", c_size_t),
        ("allocator", _Allocator),
    )


@lru_cache(maxsize=1)
def _library() -> Any:
    """Load the librcl that rclpy's extension has loaded into this process."""
    paths = {
        line.split()[-1]
        for line in Path("/proc/self/maps").read_text().splitlines()
        if re.search(r"/librcl(_yaml_param_parser)?\.so", line)
    }
    rcl = ctypes.CDLL(next(p for p in sorted(paths) if "/librcl.so" in p))
    yaml = ctypes.CDLL(next(p for p in sorted(paths) if "param_parser" in p))
    rcl.rcutils_get_default_allocator.restype = _Allocator
    rcl.rcl_get_zero_initialized_arguments.restype = _Arguments
    rcl.rcl_parse_arguments.argtypes = (
        ctypes.c_int,
        POINTER(c_char_p),
        _Allocator,
        POINTER(_Arguments),
    )
    rcl.rcl_arguments_fini.argtypes = (POINTER(_Arguments),)
    rcl.rcl_arguments_get_count_unparsed_ros.argtypes = (POINTER(_Arguments),)
    rcl.rcl_arguments_get_unparsed_ros.argtypes = (
        POINTER(_Arguments),
        _Allocator,
        POINTER(POINTER(ctypes.c_int)),
    )
    rcl.rcl_arguments_get_param_overrides.argtypes = (
        POINTER(_Arguments),
        POINTER(POINTER(_Params)),
    )
    two = (POINTER(_Arguments), POINTER(_Arguments))
    for name, strings in (
        ("rcl_remap_topic_name", 3),
        ("rcl_remap_service_name", 3),
        ("rcl_remap_node_name", 1),
        ("rcl_remap_node_namespace", 1),
    ):
        getattr(rcl, name).argtypes = (*two, *(c_char_p,) * strings, _Allocator, POINTER(c_void_p))
    rcl.rcutils_get_error_string.restype = _ErrorString
    rcl.rcutils_error_is_set.restype = c_bool
    yaml.rcl_yaml_node_struct_fini.argtypes = (POINTER(_Params),)
    return rcl, yaml


class RosArguments:
    """A parsed argument list; ``RosArguments([])`` remaps nothing."""

    def __init__(self, arguments: Sequence[str]) -> None:
        """Parse ``arguments``.

        :raises InvalidArgumentsError: if rcl refuses them; the text is rcl's.
        """
        self._rcl, self._yaml = _library()
        self.arguments = tuple(arguments)
        self._allocator = self._rcl.rcutils_get_default_allocator()
        self._parsed = self._rcl.rcl_get_zero_initialized_arguments()
        encoded = [argument.encode() for argument in arguments]
        array = (c_char_p * max(len(encoded), 1))(*encoded)
        code = self._rcl.rcl_parse_arguments(
            len(encoded), array if encoded else None, self._allocator, byref(self._parsed)
        )
        if code != _OK:
            raise InvalidArgumentsError(self._error(f"rcl refuses the arguments (code {code})"))
        if self._rcl.rcl_arguments_get_count_unparsed_ros(byref(self._parsed)) > 0:
            raise UnknownArgumentsError(self._unknown())

    def _unknown(self) -> list[str]:
        count = self._rcl.rcl_arguments_get_count_unparsed_ros(byref(self._parsed))
        places = POINTER(ctypes.c_int)()
        self._rcl.rcl_arguments_get_unparsed_ros(
            byref(self._parsed), self._allocator, byref(places)
        )
        words = [self.arguments[places[index]] for index in range(count)]
        self._deallocate(ctypes.cast(places, c_void_p).value)
        return words

    def _deallocate(self, address: int | None) -> None:
        deallocate = ctypes.CFUNCTYPE(None, c_void_p, c_void_p)(self._allocator.deallocate)
        deallocate(address, self._allocator.state)

    def __del__(self) -> None:
        if getattr(self, "_parsed", None) is not None and self._parsed.impl:
            self._rcl.rcl_arguments_fini(byref(self._parsed))

    def _error(self, fallback: str) -> str:
        if not self._rcl.rcutils_error_is_set():
            return fallback
        text: bytes = self._rcl.rcutils_get_error_string().text
        self._rcl.rcutils_reset_error()
        # rcl appends where in its own sources the error was raised.
        return re.sub(r", at \S+:\d+", "", text.decode(errors="replace"))

    def parameters(self, node_fqn: str) -> dict[str, Any]:
        """Return the parameter overrides for a node, later ones over earlier ones.

        The rule for wildcards is rclpy's: ``/*`` stands for one level of names, ``/**`` for any
        number (rclpy/src/rclpy/node.cpp).
        """
        params = POINTER(_Params)()
        code = self._rcl.rcl_arguments_get_param_overrides(byref(self._parsed), byref(params))
        if code != _OK:
            raise InvalidArgumentsError(self._error("cannot read parameter overrides"))
        values: dict[str, Any] = {}
        if not params:
            return values
        try:
            for index in range(params.contents.size):
                pattern = params.contents.node_names[index].decode()
                if not pattern.startswith("/"):
                    pattern = "/" + pattern
                pattern = pattern.replace("/*", r"(/\w+)")
                if not re.fullmatch(pattern, node_fqn):
                    continue
                node = params.contents.params[index]
                for number in range(node.size):
                    values[node.names[number].decode()] = _value(node.values[number])
        finally:
            self._yaml.rcl_yaml_node_struct_fini(params)
        return values

    def _remap(self, function: Any, outer: RosArguments | None, *names: str) -> str | None:
        output = c_void_p()
        outer_ref = byref(outer._parsed) if outer is not None else None
        code = function(
            byref(self._parsed),
            outer_ref,
            *(name.encode() for name in names),
            self._allocator,
            byref(output),
        )
        if code != _OK:
            raise InvalidArgumentsError(self._error(f"cannot remap {names[0]}"))
        if not output.value:
            return None
        try:
            return ctypes.string_at(output.value).decode()
        finally:
            self._deallocate(output.value)

    def remap_node_name(self, name: str, outer: RosArguments | None) -> str:
        """Return the name a node gets; these arguments go before ``outer`` (global) ones."""
        return self._remap(self._rcl.rcl_remap_node_name, outer, name) or name

    def remap_namespace(self, namespace: str, name: str, outer: RosArguments | None) -> str:
        """Return the namespace a node of ``name`` gets."""
        return self._remap(self._rcl.rcl_remap_node_namespace, outer, name) or namespace

    def remap_topic(
        self, topic: str, name: str, namespace: str, outer: RosArguments | None, *, service: bool
    ) -> str:
        """Return what a fully qualified topic or service name becomes."""
        function = self._rcl.rcl_remap_service_name if service else self._rcl.rcl_remap_topic_name
        return self._remap(function, outer, topic, name, namespace) or topic


def _value(variant: Any) -> Any:
    if variant.bool_value:
        return bool(variant.bool_value.contents.value)
    if variant.integer_value:
        return int(variant.integer_value.contents.value)
    if variant.double_value:
        return float(variant.double_value.contents.value)
    if variant.string_value is not None:
        return variant.string_value.decode()
    if variant.byte_array_value:
        array = variant.byte_array_value.contents
        return [bytes([array.values[i]]) for i in range(array.size)]
    for name in ("bool_array_value", "integer_array_value", "double_array_value"):
        pointer = getattr(variant, name)
        if pointer:
            return [pointer.contents.values[i] for i in range(pointer.contents.size)]
    if variant.string_array_value:
        strings = variant.string_array_value.contents
        return [strings.data[i].decode() for i in range(strings.size)]
    return None
