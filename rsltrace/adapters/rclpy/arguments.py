"""ROS arguments (``--ros-args -r … -p … --params-file …``), parsed as rcl parses them.

The rules are those of ``rcl_parse_arguments`` and ``rcl_remap_*``; errors have rcl's texts.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from enum import IntEnum
from typing import Any

from rsltrace.adapters.rclpy.names import expand
from rsltrace.adapters.rclpy.parameter_overrides import NO_TEXT, ParameterFault, ParameterOverrides
from rsltrace.fast_dataclass import dataclass


class InvalidArgumentsError(ValueError):
    """rcl could not parse the ROS arguments."""


class UnknownArgumentsError(InvalidArgumentsError):
    """rcl does not know some of the ROS arguments."""

    def __init__(self, unknown: list[str]) -> None:
        super().__init__(f"unknown ROS arguments: {unknown}")
        self.unknown = unknown


class _Lexeme(IntEnum):
    """The kinds of words in rules, with rcl's numbers, which errors name."""

    NONE = 0
    EOF = 1
    TILDE_SLASH = 2
    URL_SERVICE = 3
    URL_TOPIC = 4
    COLON = 5
    NODE = 6
    NS = 7
    SEPARATOR = 8
    BACKREFERENCE = 9  # to 17, by the digit
    TOKEN = 18
    FORWARD_SLASH = 19
    WILD_ONE = 20
    WILD_MULTI = 21
    DOT = 22


_WORDS = re.compile(
    r"(?P<TILDE_SLASH>~/)|(?P<URL_SERVICE>rosservice://)|(?P<URL_TOPIC>rostopic://)"
    r"|(?P<SEPARATOR>:=)|(?P<COLON>:)|(?P<NODE>__node|__name)|(?P<NS>__ns)"
    r"|(?P<BACKREFERENCE>\\[1-9])"
    r"|(?P<TOKEN>[A-Za-z][A-Za-z0-9]*(?:_[A-Za-z0-9]+)*_?"
    r"|_(?!_)(?:[A-Za-z0-9]+(?:_[A-Za-z0-9]+)*_?)?)"
    r"|(?P<FORWARD_SLASH>/)|(?P<WILD_MULTI>\*\*)|(?P<WILD_ONE>\*)|(?P<DOT>\.)"
    # What rcl has read when it finds that it is none of these.
    r"|(?P<NONE>__n(?:o(?:d.?|.)?|a(?:m.?|.)?|.)?|__.?|\\.?|~.?|.)",
    re.DOTALL,
)
_NAMES = (_Lexeme.TOKEN, _Lexeme.FORWARD_SLASH)


class _Fault(Exception):
    """A rule that rcl cannot parse, with its text."""


class _Reader:
    """Reads the words of a rule. Places are counted in bytes."""

    def __init__(self, rule: str) -> None:
        self._text = rule.encode().decode("latin-1")
        self.at = 0

    def peek(self, start: int | None = None) -> _Lexeme:
        found = _WORDS.match(self._text, self.at if start is None else start)
        return _Lexeme.EOF if found is None else _Lexeme[str(found.lastgroup)]

    def begins_with(self, first: _Lexeme, second: _Lexeme) -> bool:
        """Whether the next two words are these."""
        found = _WORDS.match(self._text, self.at)
        return found is not None and self.peek() is first and self.peek(found.end()) is second

    def accept(self) -> str:
        start = self.at
        found = _WORDS.match(self._text, start)
        if found is not None:
            self.at = found.end()
        return self.text(start, self.at)

    def expect(self, wanted: _Lexeme) -> str:
        """Read a word of this kind.

        :raises _Fault: if it is another.
        """
        kind = self.peek()
        if kind is wanted:
            return self.accept()
        if kind in (_Lexeme.NONE, _Lexeme.EOF):
            raise _Fault(
                f"Expected lexeme type ({wanted:d}) not found, search ended at index {self.at}"
            )
        number = int(kind)
        if kind is _Lexeme.BACKREFERENCE:
            number += int(self._text[self.at + 1]) - 1
        raise _Fault(f"Expected lexeme type {wanted:d}, got {number} at index {self.at}")

    def text(self, start: int, end: int | None = None) -> str:
        return self._text[start:end].encode("latin-1").decode()

    def path(self, token: Callable[[_Reader], None], end: _Lexeme) -> str:
        """Read names between slashes up to ``end``; ``token`` reads one."""
        start = self.at
        if self.peek() in (_Lexeme.TILDE_SLASH, _Lexeme.FORWARD_SLASH):
            self.accept()
        token(self)
        while self.peek() is not end:
            self.expect(_Lexeme.FORWARD_SLASH)
            token(self)
        return self.text(start, self.at)


def _check_match_token(reader: _Reader, allowed: Sequence[_Lexeme]) -> None:
    kind = reader.peek()
    if kind not in allowed:
        if kind in (_Lexeme.WILD_ONE, _Lexeme.WILD_MULTI):
            raise _Fault(f"Wildcard '{reader.accept()}' is not implemented")
        raise _Fault("Expecting token or wildcard")


def _match_token(reader: _Reader) -> None:
    _check_match_token(reader, [_Lexeme.TOKEN])
    reader.accept()


def _replacement_token(reader: _Reader) -> None:
    kind = reader.peek()
    if kind is _Lexeme.BACKREFERENCE:
        raise _Fault("Backreferences are not implemented")
    if kind is not _Lexeme.TOKEN:
        raise _Fault(NO_TEXT)
    reader.accept()


def _node_prefix(reader: _Reader) -> str | None:
    """Read the ``node:`` before a rule, if there is one."""
    if not reader.begins_with(_Lexeme.TOKEN, _Lexeme.COLON):
        return None
    node = reader.accept()
    reader.accept()
    return node


_SERVICE, _TOPIC, _NODE, _NAMESPACE = "service", "topic", "node name", "namespace"


@dataclass(frozen=True)
class _Rule:
    """A remapping rule: for one node or for all, for names of these kinds."""

    node: str | None
    kinds: tuple[str, ...]
    match: str
    replacement: str


def _remap_rule(text: str) -> _Rule:
    reader = _Reader(text)
    node = _node_prefix(reader)
    kind = reader.peek()
    kinds: tuple[str, ...]
    match = ""
    if kind is _Lexeme.NODE:
        reader.accept()
        reader.expect(_Lexeme.SEPARATOR)
        kinds, replacement = (_NODE,), reader.expect(_Lexeme.TOKEN)
    elif kind is _Lexeme.NS:
        reader.accept()
        reader.expect(_Lexeme.SEPARATOR)
        kinds, replacement = (_NAMESPACE,), _namespace(reader)
    else:
        kinds = (_TOPIC, _SERVICE)
        if kind in (_Lexeme.URL_SERVICE, _Lexeme.URL_TOPIC):
            reader.accept()
            kinds = (_SERVICE,) if kind is _Lexeme.URL_SERVICE else (_TOPIC,)
        match = reader.path(_match_token, _Lexeme.SEPARATOR)
        reader.expect(_Lexeme.SEPARATOR)
        replacement = reader.path(_replacement_token, _Lexeme.EOF)
    reader.expect(_Lexeme.EOF)
    return _Rule(node, kinds, match, replacement)


def _namespace(reader: _Reader) -> str:
    start = reader.at
    reader.expect(_Lexeme.FORWARD_SLASH)
    while reader.peek() is _Lexeme.TOKEN:
        reader.accept()
        if reader.peek() is not _Lexeme.FORWARD_SLASH:
            break
        reader.accept()
    return reader.text(start, reader.at)


def _parameter(text: str, overrides: ParameterOverrides) -> None:
    reader = _Reader(text)
    node = _node_prefix(reader)
    start = reader.at
    while True:
        _check_match_token(reader, _NAMES)
        while reader.peek() in _NAMES:
            reader.accept()
        if reader.peek() is _Lexeme.SEPARATOR:
            break
        reader.expect(_Lexeme.DOT)
    name = reader.text(start, reader.at)
    reader.accept()
    overrides.add_text(node or "/**", name, reader.text(reader.at))


def _check_log_level(text: str) -> None:
    reader = _Reader(text)
    while reader.peek() not in (_Lexeme.SEPARATOR, _Lexeme.EOF):
        reader.accept()
    level = text
    if reader.peek() is _Lexeme.SEPARATOR:
        if reader.at == 0:
            raise _Fault("Argument has an invalid logger item that name is empty")
        reader.accept()
        level = reader.expect(_Lexeme.TOKEN)
        reader.expect(_Lexeme.EOF)
    if level.upper() not in LEVELS:
        raise _Fault("Argument does not use a valid severity level")


_FLAGS = {
    **dict.fromkeys(("-p", "--param"), ("parameter override rule", "parameter override rule")),
    **dict.fromkeys(("-r", "--remap"), ("remap rule", "remap rule")),
    "--params-file": ("params file", "file path provided"),
    "--log-level": ("log level", ""),
    "--log-file-name": ("log file name prefix", "string prefix provided"),
    "--log-config-file": ("log configuration file", "file path provided"),
    **dict.fromkeys(("-e", "--enclave"), ("enclave name", "enclave path provided")),
}
"""The flags with a value: what the value is, and what there is none of without it."""
_SWITCHES = {
    f"--{word}-{logs}-logs"
    for word in ("enable", "disable")
    for logs in ("stdout", "rosout", "external-lib")
}


class RosArguments:
    """A parsed argument list; ``RosArguments([])`` remaps nothing."""

    def __init__(self, arguments: Sequence[str]) -> None:
        """Parse ``arguments``.

        :raises InvalidArgumentsError: if rcl refuses them; the text is rcl's.
        """
        self.arguments = tuple(arguments)
        self.others: list[str] = []
        """Those that are not ROS's."""
        self._rules: list[_Rule] = []
        self._overrides = ParameterOverrides()
        unknown = []
        is_ros = False
        words = iter(self.arguments)
        for word in words:
            if word == "--ros-args":
                is_ros = True
            elif not is_ros:
                self._deprecated_rule(word)
            elif word == "--":
                is_ros = False
            elif word in _FLAGS:
                self._take(word, words)
            elif word not in _SWITCHES:
                unknown.append(word)
        if unknown:
            raise UnknownArgumentsError(unknown)

    def _deprecated_rule(self, word: str) -> None:
        try:
            self._rules.append(_remap_rule(word))
        except _Fault:
            self.others.append(word)

    def _take(self, flag: str, words: Iterator[str]) -> None:
        what, missing = _FLAGS[flag]
        value = next(words, None)
        if value is None:
            if flag == "--log-level":
                text = f"Couldn't parse trailing log level flag: '{flag}'. No log level provided."
            else:
                found = "" if missing.endswith("provided") else " found"
                text = f"Couldn't parse trailing {flag} flag. No {missing}{found}."
            raise InvalidArgumentsError(text)
        try:
            if flag in ("-p", "--param"):
                _parameter(value, self._overrides)
            elif flag in ("-r", "--remap"):
                self._rules.append(_remap_rule(value))
            elif flag == "--params-file":
                self._overrides.add_file(value)
            elif flag == "--log-level":
                _check_log_level(value)
        except (_Fault, ParameterFault) as error:
            text = f"Couldn't parse {what}: '{flag} {value}'. Error: {error}"
            raise InvalidArgumentsError(text) from error

    def log_levels(self) -> dict[str, str]:
        """Return the levels of ``--log-level`` by logger, ``""`` for all."""
        levels: dict[str, str] = {}
        for flag, value in zip(self.arguments, self.arguments[1:], strict=False):
            if flag == "--log-level":
                logger, _, level = value.rpartition(":=")
                levels[logger] = level.upper()
        return levels

    def rosout(self) -> bool | None:
        """Return whether nodes publish on /rosout, None if not given."""
        said = [a for a in self.arguments if a in ("--enable-rosout-logs", "--disable-rosout-logs")]
        return said[-1].startswith("--enable") if said else None

    def parameters(self, node_fqn: str) -> dict[str, Any]:
        """Return the parameter overrides for a node, later ones over earlier ones."""
        return self._overrides.of_node(node_fqn)

    def _remap(
        self, kind: str, outer: RosArguments | None, old: str, name: str, namespace: str
    ) -> str:
        for rule in self._rules + (outer._rules if outer is not None else []):
            if kind not in rule.kinds or rule.node not in (None, name):
                continue
            if not rule.match:
                return rule.replacement
            try:
                if expand(rule.match, name, namespace) == old:
                    return expand(rule.replacement, name, namespace)
            except ValueError:
                raise InvalidArgumentsError(f"cannot remap {old}") from None
        return old

    def remap_node_name(self, name: str, outer: RosArguments | None) -> str:
        """Return the name a node gets; these arguments go before ``outer`` (global) ones."""
        return self._remap(_NODE, outer, name, name, "")

    def remap_namespace(self, namespace: str, name: str, outer: RosArguments | None) -> str:
        """Return the namespace a node of ``name`` gets."""
        return self._remap(_NAMESPACE, outer, namespace, name, "")

    def remap_topic(
        self, topic: str, name: str, namespace: str, outer: RosArguments | None, *, service: bool
    ) -> str:
        """Return what a fully qualified topic or service name becomes."""
        return self._remap(_SERVICE if service else _TOPIC, outer, topic, name, namespace)


# The levels of loggers, by the rules of rcutils.

LEVELS = {"UNSET": 0, "DEBUG": 10, "INFO": 20, "WARN": 30, "ERROR": 40, "FATAL": 50}


class LogLevels:
    """The levels that are set, by the names of loggers; the logger "" stands for all."""

    def __init__(self) -> None:
        self._levels: dict[str, int] = {}

    def reset(self) -> None:
        self._levels.clear()

    def set(self, name: str, level: int) -> None:
        """Set the level of a logger; UNSET takes it back.

        :raises ValueError: if there is no such level.
        """
        if not 0 <= level <= LEVELS["FATAL"]:
            raise ValueError("Invalid severity level specified for logger")
        if level not in LEVELS.values():
            raise ValueError("Unable to determine severity_string for severity")
        self._levels[name] = level

    def get(self, name: str) -> int:
        """Return the level that was set for a logger itself, UNSET if none was."""
        return self._levels.get(name, 0 if name else LEVELS["INFO"])

    def effective(self, name: str) -> int:
        """Return the level of a logger: its own, that of the next one above it, or the default."""
        while name:
            if level := self._levels.get(name, 0):
                return level
            name = name.rpartition(".")[0]
        return self.get("")
