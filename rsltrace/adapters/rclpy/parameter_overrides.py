"""Parameter values of ROS arguments, by the rules of ``rcl_yaml_param_parser``.

They are not YAML's: scalars are typed as C's ``strtoll`` and ``strtod`` read them, and a file is a
sequence of events in which the place of a key decides what it means.
"""

from __future__ import annotations

import re
from bisect import insort
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

from rsltrace.adapters.rclpy.names import namespace_fault, node_name_fault

_PARAMETERS = "ros__parameters"
_STRING_TAG = "tag:yaml.org,2002:str"
_BOOL = {
    **dict.fromkeys("Y y yes Yes YES true True TRUE on On ON".split(), True),
    **dict.fromkeys("N n no No NO false False FALSE off Off OFF".split(), False),
}
# Compiled for the first override: few runs have one.
_INTEGER = r"(?a)\s*([+-]?)(?:0[xX]([0-9a-fA-F]+)|(0[0-7]*)|([1-9][0-9]*))"
_BASES = (16, 8, 10)
_DECIMAL = r"(?a)\s*[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_HEXADECIMAL = (
    r"(?a)\s*[+-]?0[xX](?:[0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)(?:[pP][+-]?[0-9]+)?"
)
_NO_NUMBER = r"(?ai)\s*([+-]?)(?:(inf(?:inity)?)|nan(?:\([0-9a-z_]*\))?)"
_OF_YAML = r"([+-]?)\.(?:(inf|Inf|INF))|\.(?:nan|NaN|NAN)"
_SMALLEST_NORMAL = 2.0**-1022

_TYPES = {bool: "bool", int: "integer", float: "double", str: "string"}
_KINDS = [(listed, type_) for listed in (False, True) for type_ in _TYPES]
"""The values that a parameter can have at once, in the order in which rclpy looks for one."""


NO_TEXT = "error not set"
"""ROS's text for what it gives no reason for."""


class ParameterFault(ValueError):
    """A text or a file is no parameter; the text is ROS's."""


def scalar(text: str) -> bool | int | float | str:
    """Return what ROS takes an unquoted scalar for."""
    if text in _BOOL:
        return _BOOL[text]
    if found := re.fullmatch(_INTEGER, text):
        digits = zip(found.groups()[1:], _BASES, strict=True)
        try:
            number = next(int(word, base) for word, base in digits if word is not None)
        except ValueError:
            number = 2**63  # of more digits than Python reads: out of range
        number = -number if found[1] == "-" else number
        if -(2**63) <= number < 2**63:
            return number
    if found := re.fullmatch(_OF_YAML, text) or re.fullmatch(_NO_NUMBER, text):
        value = float("inf" if found[2] else "nan")
        return -value if found[1] == "-" else value
    double = _double(text)
    return text if double is None else double


def _double(text: str) -> float | None:
    """Read a number as ``strtod`` does; None if it is none, or not in the range of a double."""
    try:
        if re.fullmatch(_DECIMAL, text):
            value = float(text)
        elif re.fullmatch(_HEXADECIMAL, text):
            value = float.fromhex(text.strip())
        else:
            return None
    except OverflowError:
        return None
    if value in (float("inf"), float("-inf")):
        return None
    if abs(value) < _SMALLEST_NORMAL and not _is_exact(text.strip(), value):
        return None  # rounded below the normal numbers: out of range
    return value


def _is_exact(text: str, value: float) -> bool:
    base, mark = (16, "p") if "x" in text.lower() else (10, "e")
    digits, _, exponent = text.lower().lstrip("+-").partition(mark)
    whole, _, part = digits.removeprefix("0x").partition(".")
    number = int(whole + part, base)
    if number == 0 or value == 0.0:
        return number == 0
    scale = Fraction(2 if base == 16 else 10) ** int(exponent or 0)
    return Fraction(number, base ** len(part)) * scale == Fraction(abs(value))


class ParameterOverrides:
    """The parameters of a list of arguments: by (pattern of the) name of a node, in order."""

    def __init__(self) -> None:
        self._nodes: dict[str, _Parameters] = {}

    def of_node(self, full_name: str) -> dict[str, Any]:
        """Return the parameters of a node, later ones over earlier ones.

        The rule for wildcards is rclpy's: ``/*`` stands for one level of names, ``/**`` for any
        number (rclpy/src/rclpy/node.cpp).
        """
        values: dict[str, Any] = {}
        for name, parameters in self._nodes.items():
            pattern = name if name.startswith("/") else f"/{name}"
            if re.fullmatch(pattern.replace("/*", r"(/\w+)"), full_name):
                values.update((one.name, one.value()) for one in parameters)
        return values

    def add_text(self, node: str, name: str, text: str) -> None:
        """Add a parameter whose value is a text.

        :raises ParameterFault: if ROS could not read it.
        """
        if not text:
            raise ParameterFault(NO_TEXT)
        parameter, sequence = self._nodes.setdefault(node, _Parameters()).named(name), _Sequence()
        for event in _events(text.encode(), lambda _: "Error parsing an event"):
            kind = type(event).__name__
            if kind == "ScalarEvent":
                parameter.take(event, sequence)
            elif kind == "SequenceStartEvent":
                sequence.open()
            elif kind == "SequenceEndEvent":
                sequence.is_open = False
            elif not kind.startswith(("Stream", "Document")):
                raise ParameterFault("Unknown YAML event")

    def add_file(self, path: str) -> None:
        """Add the parameters in a file.

        :raises ParameterFault: if ROS could not read it.
        """
        try:
            with open(path, "rb") as file:
                content = file.read()
        except IsADirectoryError:
            raise ParameterFault("Error parsing a event near line 0") from None
        except (OSError, ValueError):
            raise ParameterFault("Error opening YAML file") from None
        reader = _FileReader(self._nodes)
        for event in _events(content, lambda line: f"Error parsing a event near line {line}"):
            reader.take(event)


class _Sequence:
    """The sequence that is read, if there is one."""

    def __init__(self) -> None:
        self.is_open = False
        self.type_: type | None = None

    def open(self) -> None:
        self.is_open, self.type_ = True, None


class _Parameter:
    """One parameter. It may have values of several types: a file sets one and leaves the others."""

    def __init__(self, name: str, number: int) -> None:
        self.name = name
        self.number = number
        """Its place in the order of the node's parameters."""
        self._values: dict[tuple[bool, type], Any] = {}

    def take(self, event: Any, sequence: _Sequence) -> None:
        """Set a value, or add it to the open sequence."""
        text, line = event.value.partition("\0")[0], event.start_mark.line + 1
        quoted = event.style in ("'", '"')
        if not quoted and not event.value:
            raise ParameterFault(f"No value at line {line}")
        value = text if quoted or event.tag == _STRING_TAG else scalar(text)
        type_ = type(value)
        if not sequence.is_open:
            self._values[False, type_] = value
            return
        if sequence.type_ is None:
            sequence.type_ = type_
            self._values[True, type_] = []
        elif sequence.type_ is not type_:
            raise ParameterFault(
                f"Sequence should be of same type. Value type '{_TYPES[type_]}' do not belong at "
                f"line_num {line}"
            )
        self._values.setdefault((True, type_), []).append(value)

    def value(self) -> Any:
        """Return the value that rclpy finds, None if it has none."""
        return next((self._values[kind] for kind in _KINDS if kind in self._values), None)


class _Parameters:
    """The parameters of a node. Several may have one name, which means the first of them."""

    def __init__(self) -> None:
        self._all: list[_Parameter] = []
        self._by_name: dict[str, list[_Parameter]] = {}

    def __iter__(self) -> Iterator[_Parameter]:
        return iter(self._all)

    def named(self, name: str) -> _Parameter:
        """Return the parameter of a name, which is added if need be."""
        found = self._by_name.setdefault(name, [])
        if not found:
            found.append(_Parameter(name, len(self._all)))
            self._all += found
        return found[0]

    def give_name(self, one: _Parameter, name: str) -> None:
        """Give a parameter another name."""
        self._by_name[one.name].remove(one)
        one.name = name
        insort(self._by_name.setdefault(name, []), one, key=lambda other: other.number)


def _events(text: bytes, fault: Callable[[int], str]) -> Iterator[Any]:
    """Give the events of YAML; ``fault`` says what is wrong after a line."""
    import yaml  # type: ignore[import-untyped]

    line = 0
    try:
        for event in yaml.parse(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
            line = event.start_mark.line + 1
            yield event
    except yaml.YAMLError:
        raise ParameterFault(fault(line)) from None


class _Path:
    """Names that maps within maps have, joined by a separator."""

    def __init__(self, separator: str) -> None:
        self.text = ""
        self.count = 0
        self._separator = separator

    def push(self, name: str) -> None:
        if self.count == 0:
            self.text = name
        else:
            end = "" if self.text.endswith(self._separator) else self._separator
            self.text += end + name
        self.count += 1

    def pop(self) -> None:
        if self.count:
            head, found, _ = self.text.rpartition(self._separator)
            self.text = head if found and self.count > 1 else self.text
            self.count -= 1


class _FileReader:
    """Reads the events of a parameter file into ``nodes``."""

    def __init__(self, nodes: dict[str, _Parameters]) -> None:
        self._nodes = nodes
        self._parameters: _Parameters | None = None
        """Those of the node that is read."""
        self._at: _Parameter | None = None
        """The parameter that the last key has named."""
        self._node_path, self._path = _Path("/"), _Path(".")
        self._sequence = _Sequence()
        self._is_key, self._below_parameters, self._is_new_map = True, False, False
        self._depth = 0

    def take(self, event: Any) -> None:
        line = event.start_mark.line + 1
        kind = type(event).__name__
        if kind == "ScalarEvent":
            if self._is_key:
                self._key(event.value.partition("\0")[0], line)
                self._is_key = False
            else:
                if not self._below_parameters or self._at is None:
                    fault = f"Cannot have a value before {_PARAMETERS} at line {line}"
                    raise ParameterFault(fault)
                self._at.take(event, self._sequence)
                self._is_key = not self._sequence.is_open
        elif kind == "SequenceStartEvent":
            if self._is_key:
                raise ParameterFault(f"Sequences cannot be key at line {line}")
            if not self._below_parameters:
                raise ParameterFault(
                    f"Sequences can only be values and not keys in params. Error at line {line}\n"
                )
            self._sequence.open()
        elif kind == "SequenceEndEvent":
            self._sequence.is_open, self._is_key = False, True
        elif kind == "MappingStartEvent":
            self._depth += 1
            # The map right below ros__parameters is none within a parameter.
            self._is_new_map = not (
                self._below_parameters and self._depth - self._node_path.count - 1 == 2
            )
            self._is_key = True
        elif kind == "MappingEndEvent":
            self._leave_map()
        elif kind == "AliasEvent":
            raise ParameterFault(f"Will not support aliasing at line {line}\n")

    def _leave_map(self) -> None:
        if self._below_parameters:
            if self._path.count:
                self._path.pop()
            else:
                self._below_parameters = False
        elif self._depth == self._node_path.count + 1:
            self._node_path.pop()
        self._depth -= 1

    def _key(self, name: str, line: int) -> None:
        if not name:
            raise ParameterFault(f"No key at line {line}")
        if self._below_parameters:
            self._parameter_key(name, line)
        elif not name.startswith(_PARAMETERS):
            self._node_path.push(name)
        else:
            if not self._node_path.count:
                fault = f"There are no node names before {_PARAMETERS} at line {line}"
                raise ParameterFault(fault)
            _check_node(self._node_path.text)
            self._parameters = self._nodes.setdefault(self._node_path.text, _Parameters())
            self._at = next(iter(self._parameters), None)
            self._node_path.pop()
            self._below_parameters = True

    def _parameter_key(self, name: str, line: int) -> None:
        assert self._parameters is not None
        if self._is_new_map:  # the last key was no parameter, but what parameters are below
            if self._at is None:
                raise ParameterFault(f"Internal error creating param namespace at line {line}")
            self._path.text = self._at.name
            self._path.count += 1
            self._is_new_map = False
        if not self._path.count:
            self._at = self._parameters.named(name)
        else:
            self._at = self._parameters.named(self._path.text)
            self._parameters.give_name(self._at, f"{self._path.text}.{name}")


def _check_node(name: str) -> None:
    """Raise ParameterFault if a name, which may have wildcards, is none of a node."""
    if name in ("/**", "/*"):
        return
    namespace, slash, node = name.rpartition("/")
    if slash and namespace:
        absolute = f"{namespace}/" if namespace.startswith("/") else f"/{namespace}/"
        for level in absolute[1:-1].split("/"):
            if not level:
                raise ParameterFault(f"{absolute} contains repeated forward slash")
            if level not in ("*", "**") and (fault := namespace_fault(f"/{level}")):
                raise ParameterFault(fault[0])
    if node not in ("*", "**") and (found := node_name_fault(node)):
        raise ParameterFault(found[0])
