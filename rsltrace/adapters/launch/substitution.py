"""What the substitutions of launch files stand for, without ROS's launch."""

from __future__ import annotations

import math
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rsltrace.adapters.launch.expression import evaluate
from rsltrace.adapters.launch.model import LaunchScope
from rsltrace.adapters.workspace.imports import unbuilt_prefix
from rsltrace.errors import did_you_mean, nearest
from rsltrace.job.reading.substitute import package_prefix
from rsltrace.trace.model.regular_file import read_regular

# Text with ``$(…)`` in it, taken apart: the grammar of substitutions in ROS's launch files.

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_DEPTH_MAX = 50


@dataclass(frozen=True, slots=True)
class SubstitutionCall:
    """One substitution: ``$(env HOME)`` has the name ``env`` and one argument."""

    name: str
    arguments: tuple[Template, ...]
    written: str


Template = tuple["str | SubstitutionCall", ...]
"""The pieces of a text, in order."""


def parse_template(text: str) -> Template:
    """Take a text apart. ``\\`` before a character takes its meaning away.

    :raises ValueError: if a substitution is not written properly.
    """
    return _TemplateParser(text).template()


class _TemplateParser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._depth = 0

    def template(self, end: str = "") -> Template:
        """Read up to the character ``end`` (a quote, which is skipped), or all there is."""
        parts: list[str | SubstitutionCall] = []
        plain = ""
        text = self._text
        while self._at < len(text):
            char = text[self._at]
            if end and char == end:
                break
            if char == "\\" and self._at + 1 < len(text):
                plain += text[self._at + 1]
                self._at += 2
            elif text.startswith("$(", self._at):
                if plain:
                    parts.append(plain)
                    plain = ""
                parts.append(self._call())
            else:
                plain += char
                self._at += 1
        if end:
            if self._at >= len(text):
                raise ValueError(f"a quote {end} is not closed in {text!r}")
            self._at += 1
        if plain:
            parts.append(plain)
        return tuple(parts)

    def _call(self) -> SubstitutionCall:
        start = self._at
        self._depth += 1
        if self._depth > _DEPTH_MAX:
            raise ValueError(f"substitutions are nested more than {_DEPTH_MAX} deep")
        self._at += 2
        name = _NAME.match(self._text, self._at)
        if name is None:
            raise ValueError(
                f"'$(' begins a substitution, such as $(var name), in {self._text!r}; write \\$( "
                "for plain text"
            )
        self._at = name.end()
        arguments = []
        while True:
            self._skip_blanks()
            if self._at >= len(self._text):
                raise ValueError(f"{self._text[start:]!r} has no closing parenthesis")
            if self._text[self._at] == ")":
                break
            arguments.append(self._argument())
        self._at += 1
        self._depth -= 1
        return SubstitutionCall(name.group(), tuple(arguments), self._text[start : self._at])

    def _argument(self) -> Template:
        text = self._text
        if text[self._at] in "'\"":
            self._at += 1
            return self.template(text[self._at - 1])
        parts: list[str | SubstitutionCall] = []
        while self._at < len(text) and text[self._at] not in " \t\r\n)":
            if text.startswith("$(", self._at):
                parts.append(self._call())
                continue
            if text[self._at] == "\\" and self._at + 1 < len(text):
                self._at += 1
            parts.append(text[self._at])
            self._at += 1
        return tuple(_joined(parts))

    def _skip_blanks(self) -> None:
        while self._at < len(self._text) and self._text[self._at] in " \t\r\n":
            self._at += 1


def _joined(parts: list[str | SubstitutionCall]) -> list[str | SubstitutionCall]:
    joined: list[str | SubstitutionCall] = []
    for part in parts:
        if isinstance(part, str) and joined and isinstance(joined[-1], str):
            joined[-1] += part
        else:
            joined.append(part)
    return joined


_TRUE, _FALSE = ("true", "1"), ("false", "0")

_REFUSED = {
    "command": "reading a launch file runs no commands",
    "param": "a parameter's value is not known before the nodes run",
    "launch_log_dir": "a simulation writes no log files",
    "log_dir": "a simulation writes no log files",
}


def truth(text: str) -> bool:
    """Return a condition's value, as launch reads it.

    :raises ValueError: if it is none of true, 1, false, 0.
    """
    word = text.strip().lower()
    if word in _TRUE:
        return True
    if word in _FALSE:
        return False
    raise ValueError(f"expected true, 1, false or 0, got {text!r}")


class Substitutions:
    """Replaces ``$(…)`` by what ``scope`` holds; ``file`` is the launch file being read."""

    def __init__(self, scope: LaunchScope, file: Path) -> None:
        self.scope = scope
        self.file = file
        self._anonymous: dict[str, str] = {}
        self._known: dict[str, tuple[int, int, Callable[..., str]]] = {
            "var": (1, 2, self._var),
            "env": (1, 2, self._env),
            "optenv": (1, 2, lambda name, default="": self._env(name, default)),
            "dirname": (0, 0, lambda: str(self.file.parent)),
            "filename": (0, 0, lambda: str(self.file)),
            "find-pkg-share": (1, 1, lambda package: str(_prefix(package) / "share" / package)),
            "find-pkg-prefix": (1, 1, lambda package: str(_prefix(package))),
            "exec-in-pkg": (2, 2, _executable_in_package),
            "find-exec": (1, 1, _find_executable),
            "file-content": (1, 1, _file_content),
            "anon": (1, 1, self.anonymous),
            "eval": (1, 99, lambda *words: str(evaluate(" ".join(words)))),
            "not": (1, 1, lambda a: _word(not truth(a))),
            "and": (2, 2, lambda a, b: _word(truth(a) and truth(b))),
            "or": (2, 2, lambda a, b: _word(truth(a) or truth(b))),
            "any": (0, 99, lambda *words: _word(any(map(truth, words)))),
            "all": (0, 99, lambda *words: _word(all(map(truth, words)))),
            "equals": (2, 2, lambda a, b: _word(equal_texts(a, b))),
            "not-equals": (2, 2, lambda a, b: _word(not equal_texts(a, b))),
            "if": (2, 3, lambda a, yes, no="": yes if truth(a) else no),
        }

    def text(self, written: str) -> str:
        """Return a text with every substitution in it replaced.

        :raises ValueError: if one is wrong; the message begins with it as it is written.
        """
        return self._evaluate(parse_template(written)) if written else ""

    def _evaluate(self, template: Template) -> str:
        return "".join(part if isinstance(part, str) else self._call(part) for part in template)

    def _call(self, call: SubstitutionCall) -> str:
        if call.name in _REFUSED:
            raise ValueError(f"{call.written}: {_REFUSED[call.name]}; give the value itself")
        if call.name not in self._known:
            near = nearest(call.name, self._known)
            there = f"there are {', '.join(self._known)}"
            hint = f"did you mean $({near} …)?" if near else there
            raise ValueError(f"{call.written} is no substitution; {hint}")
        least, most, function = self._known[call.name]
        if not least <= len(call.arguments) <= most:
            number = f"{least}" if least == most else f"{least} to {most}"
            raise ValueError(
                f"{call.written}: {call.name} takes {number} values, here are "
                f"{len(call.arguments)} (quote a value with blanks in it)"
            )
        arguments = [self._evaluate(argument) for argument in call.arguments]
        try:
            return function(*arguments)
        except (ValueError, OSError) as error:
            said = str(error)
            raise ValueError(said if said.startswith("$(") else f"{call.written}: {said}") from None

    def _var(self, name: str, default: str | None = None) -> str:
        value = self.scope.configurations.get(name, default)
        if value is None:
            names = sorted(self.scope.configurations)
            there = f"there are {', '.join(names)}" if names else "none is declared"
            hint = did_you_mean(name, names, there)
            raise ValueError(f"there is no launch argument {name!r}; {hint}")
        return value

    def _env(self, name: str, default: str | None = None) -> str:
        value = self.scope.environment.get(name, default)
        if value is None:
            raise ValueError(
                f"the environment variable {name} is not set: set it, or give a default, "
                f"$(env {name} default)"
            )
        return value

    def anonymous(self, name: str) -> str:
        """Return a name that nobody else has."""
        # ROS appends host, process and a random number; here runs must not differ.
        return self._anonymous.setdefault(name, f"{name}_{len(self._anonymous) + 1}")


def _word(value: bool) -> str:
    return str(value).lower()


def equal_texts(a: str, b: str) -> bool:
    """Return whether two texts are equal as launch compares them: truth values, numbers, text."""
    words = a.lower(), b.lower()
    if all(word in (*_TRUE, *_FALSE) for word in words):
        return (words[0] in _TRUE) == (words[1] in _TRUE)
    try:
        return math.isclose(float(a), float(b))
    except ValueError:
        return a == b


def _prefix(package: str) -> Path:
    prefix = package_prefix(package) or unbuilt_prefix(package)
    if prefix is None:
        raise ValueError(
            f"there is no ROS package {package!r} in AMENT_PREFIX_PATH, nor among the sources "
            "here: install it, or source the workspace that has it"
        )
    return prefix


def _executable_in_package(executable: str, package: str) -> str:
    path = _prefix(package) / "lib" / package / executable
    if not path.exists():
        raise ValueError(f"package {package!r} has no executable {executable!r}")
    return str(path)


def _find_executable(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        raise ValueError(f"there is no executable {name!r} in PATH")
    return os.path.abspath(path)


def _file_content(path: str) -> str:
    return read_regular(Path(path)).decode()
