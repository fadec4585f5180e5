"""``$(…)`` in XML and YAML launch files: the grammar, and what each stands for."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from rsltrace.adapters.launch.api import substitutions as api
from rsltrace.adapters.launch.api.basics import LaunchContext, Substitution, SubstitutionFailure
from rsltrace.adapters.launch.expression import evaluate
from rsltrace.adapters.workspace.imports import unbuilt_prefix
from rsltrace.errors import nearest
from rsltrace.job.reading.substitute import package_prefix

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_DEPTH_MAX = 50


Template = tuple[str | Substitution, ...]
"""The pieces of a text, in order."""


def parse_template(text: str) -> Template:
    """Split a text into its parts. ``\\`` before a character takes its meaning away.

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
        parts: list[str | Substitution] = []
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
        parts: list[str | Substitution] = []
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


def _joined(parts: list[str | Substitution]) -> list[str | Substitution]:
    joined: list[str | Substitution] = []
    for part in parts:
        if isinstance(part, str) and joined and isinstance(joined[-1], str):
            joined[-1] += part
        else:
            joined.append(part)
    return joined


class SubstitutionCall(Substitution):
    """One substitution: ``$(env HOME)`` has the name ``env`` and one argument."""

    def __init__(self, name: str, arguments: tuple[Template, ...], written: str) -> None:
        self.name, self.arguments, self.written = name, arguments, written

    def describe(self) -> str:
        return self.written

    def perform(self, context: LaunchContext) -> str:
        """Return the text. Raises ``ValueError``, whose message begins with what is written."""
        if self.name in _REFUSED:
            raise ValueError(f"{self.written}: {_REFUSED[self.name]}; give the value itself")
        if self.name not in SUBSTITUTIONS:
            near = nearest(self.name, SUBSTITUTIONS)
            there = f"there are {', '.join(SUBSTITUTIONS)}"
            hint = f"did you mean $({near} …)?" if near else there
            raise ValueError(f"{self.written} is no substitution; {hint}")
        least, most, make = SUBSTITUTIONS[self.name]
        if not least <= len(self.arguments) <= most:
            number = f"{least}" if least == most else f"{least} to {most}"
            raise ValueError(
                f"{self.written}: {self.name} takes {number} values, here are "
                f"{len(self.arguments)} (quote a value with blanks in it)"
            )
        try:
            return make(*self.arguments).perform(context)
        except (ValueError, OSError, SubstitutionFailure) as error:
            said = str(error)
            raise ValueError(said if said.startswith("$(") else f"{self.written}: {said}") from None


class _TextFunction(Substitution):
    """What a function makes of texts."""

    def __init__(self, function: Callable[..., str], *arguments: Template) -> None:
        self._function, self._arguments = function, arguments

    def perform(self, context: LaunchContext) -> str:
        return self._function(*map(context.text, self._arguments))


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


def _function(function: Callable[..., str]) -> Callable[..., Substitution]:
    return lambda *arguments: _TextFunction(function, *arguments)


def _environment(name: Template, default: Template | None = None) -> Substitution:
    return api.EnvironmentVariable(name, default_value=default)


_REFUSED = {
    "command": "reading a launch file runs no commands",
    "param": "a parameter's value is not known before the nodes run",
    "launch_log_dir": "a simulation writes no log files",
    "log_dir": "a simulation writes no log files",
}
SUBSTITUTIONS: dict[str, tuple[int, int, Callable[..., Substitution]]] = {
    "var": (1, 2, lambda name, default=None: api.LaunchConfiguration(name, default=default)),
    "env": (1, 2, _environment),
    "optenv": (1, 2, lambda name, default=(): _environment(name, default)),
    "dirname": (0, 0, api.ThisLaunchFileDir),
    "filename": (0, 0, api.ThisLaunchFile),
    "find-pkg-share": (1, 1, _function(lambda name: str(_prefix(name) / "share" / name))),
    "find-pkg-prefix": (1, 1, _function(lambda name: str(_prefix(name)))),
    "exec-in-pkg": (2, 2, _function(_executable_in_package)),
    "find-exec": (1, 1, lambda name: api.FindExecutable(name=name)),
    "file-content": (1, 1, api.FileContent),
    "anon": (1, 1, api.AnonName),
    "eval": (1, 99, _function(lambda *words: str(evaluate(" ".join(words))))),
    "not": (1, 1, api.NotSubstitution),
    "and": (2, 2, api.AndSubstitution),
    "or": (2, 2, api.OrSubstitution),
    "any": (0, 99, api.AnySubstitution),
    "all": (0, 99, api.AllSubstitution),
    "equals": (2, 2, api.EqualsSubstitution),
    "not-equals": (2, 2, api.NotEqualsSubstitution),
    "if": (2, 3, api.IfElseSubstitution),
}
"""How many values each takes, and the substitution that it is. None runs code of the file's."""
