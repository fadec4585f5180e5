"""``$(env …)``, ``$(var …)``, ``$(find-pkg-share …)``, ``$(dirname)`` in a job, as in launch files.

Only looking up, never running: a job is read without executing anything.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from rsltrace.errors import JobError, did_you_mean, nearest
from rsltrace.job.reading.yaml_source import SourcePlace, TextPosition, YamlValue, bare_value

SUBSTITUTIONS = {
    "env": "env NAME [default]",
    "var": "var NAME",
    "find-pkg-share": "find-pkg-share PACKAGE",
    "find-pkg-prefix": "find-pkg-prefix PACKAGE",
    "dirname": "dirname",
}
"""Name of each substitution, and how it is written."""

_NOT_HERE = {
    "command": "a job does not run commands: put the result into an environment variable, $(env …)",
    "eval": "a job does not evaluate code: put the result into an environment variable, $(env …)",
    "arg": "write $(var NAME), and the value in 'vars:'",
    "find": "write $(find-pkg-share PACKAGE)",
    "optenv": "write $(env NAME default)",
}


class JobSubstitution:
    """Replaces ``$(...)`` in values. ``variables`` are those of ``vars:``, or None before these
    are known; ``folders`` returns where packages are looked for that nobody has built."""

    def __init__(
        self,
        variables: Mapping[object, YamlValue] | None,
        folders: Callable[[], Iterable[Path]] = lambda: (),
    ) -> None:
        self._variables = variables
        self._folders = folders
        self._open: list[str] = []
        self.used = False

    def tree(self, item: YamlValue) -> YamlValue:
        """Return ``item`` with every text in it replaced. Raises ``JobError`` at the place."""
        value = item.value
        if isinstance(value, dict):
            return replace(item, value={key: self.tree(inner) for key, inner in value.items()})
        if isinstance(value, list):
            return replace(item, value=[self.tree(inner) for inner in value])
        if not isinstance(value, str) or "$(" not in value:
            return item
        self.used = True
        text = self._text(value, item)
        return replace(item, value=bare_value(text) if item.is_bare else text)

    def _text(self, text: str, item: YamlValue) -> str:
        done, at = "", 0
        while (start := text.find("$(", at)) >= 0:
            if start and text[start - 1] == "\\":
                done, at = done + text[at : start - 1] + "$(", start + 2
                continue
            end = _closing(text, start)
            if end is None:
                message = f"{text[start:]!r} has no closing parenthesis"
                if item.is_bare:
                    message += " (a ',' or ': ' in it may have ended the value: quote it then)"
                raise _error(item, text[start:], message)
            written = text[start : end + 1]
            inner = self._text(text[start + 2 : end], item)
            done += text[at:start] + self._one(written, inner, item)
            at = end + 1
        return done + text[at:]

    def _one(self, written: str, inner: str, item: YamlValue) -> str:
        try:
            name, *arguments = shlex.split(inner) or [""]
        except ValueError:
            raise _error(item, written, f"a quote in {written} is not closed") from None
        if name not in SUBSTITUTIONS:
            raise _error(item, written, _unknown(written, name))
        most = 2 if name == "env" else 0 if name == "dirname" else 1
        if not min(most, 1) <= len(arguments) <= most:
            raise _error(
                item, written, f"expected $({SUBSTITUTIONS[name]}), got {written}{_many(arguments)}"
            )
        if name == "dirname":
            return item.place.source.folder or os.getcwd()
        if name == "env":
            return self._env(written, item, *arguments)
        if name == "var":
            return self._var(written, item, arguments[0])
        return self._of_package(written, item, arguments[0], shared=name == "find-pkg-share")

    def _of_package(self, written: str, item: YamlValue, package: str, *, shared: bool) -> str:
        """Return the share of a package (of one that is not built: its folder), or its prefix."""
        prefix = package_prefix(package)
        if prefix is not None:
            return str(prefix / "share" / package if shared else prefix)
        from rsltrace.source_packages import source_packages  # which loads a parser of XML

        sources = source_packages(self._folders())
        if package not in sources:
            hint = did_you_mean(package, sources)
            raise _error(
                item,
                written,
                f"there is no ROS package {package!r} in AMENT_PREFIX_PATH, {sys.prefix} or the "
                f"search_path{hint}: install it, source the workspace that has it, or add its "
                "folder to search_path",
            )
        if not shared:
            raise _error(
                item,
                written,
                f"nobody has built {package!r} ({sources[package].folder}), so that it has no "
                f"prefix: write $(find-pkg-share {package}), or build it",
            )
        return str(sources[package].folder)

    def _env(self, written: str, item: YamlValue, name: str, default: str | None = None) -> str:
        value = os.environ.get(name, default)
        if value is None:
            import difflib  # only for whoever made a mistake

            close = difflib.get_close_matches(name, sorted(os.environ), n=1, cutoff=0.8)
            hint = f" ({close[0]} is)" if close else ""
            raise _error(
                item,
                written,
                f"the environment variable {name} is not set{hint}: set it, or give a default, "
                f"$(env {name} default)",
            )
        return value

    def _var(self, written: str, item: YamlValue, name: str) -> str:
        if self._variables is None:
            raise _error(item, written, "'base:' and 'include:' come before 'vars:'; use $(env …)")
        found = self._variables.get(name)
        if found is None:
            names = sorted(str(key) for key in self._variables)
            there = f"write it below 'vars:', or give --set vars.{name}=..."
            hint = did_you_mean(name, names, f"there are {', '.join(names)}" if names else there)
            raise _error(item, written, f"there is no variable {name!r}: {hint}")
        if name in self._open:
            cycle = " -> ".join([*self._open[self._open.index(name) :], name])
            raise _error(item, written, f"the variables refer to each other: {cycle}")
        if isinstance(found.value, (dict, list)) or found.value is None:
            raise found.place.error(f"vars.{name}: a variable is text, a number, true or false")
        self._open.append(name)
        try:
            return self._text(as_text(found.value), found)
        finally:
            self._open.pop()


def as_text(value: object) -> str:
    """Return a scalar as it is written in YAML."""
    if isinstance(value, bool):
        return str(value).lower()
    return str(getattr(value, "text", value))


def _closing(text: str, start: int) -> int | None:
    depth = 0
    for at in range(start + 1, len(text)):
        depth += {"(": 1, ")": -1}.get(text[at], 0)
        if depth == 0:
            return at
    return None


def _unknown(written: str, name: str) -> str:
    if name in _NOT_HERE:
        return f"{written}: {_NOT_HERE[name]}"
    near = nearest(name, SUBSTITUTIONS)
    known = ", ".join(f"$({form})" for form in SUBSTITUTIONS.values())
    hint = f"did you mean $({SUBSTITUTIONS[near]})?" if near else f"there are {known}"
    return f"{written} is no substitution; {hint} (for plain text write \\$( )"


def _many(arguments: list[str]) -> str:
    return ": quote a default with blanks in it" if len(arguments) > 2 else ""


def _error(item: YamlValue, written: str, message: str) -> JobError:
    """Return an error at ``written`` within the text of ``item``, if it is found there."""
    place = item.place
    lines = place.source.text.splitlines()
    mark = place.mark
    if mark.line <= len(lines):
        column = lines[mark.line - 1].find(written, mark.column - 1)
        if column >= 0:
            place = SourcePlace(place.source, TextPosition(mark.line, column + 1))
    return place.error(message)


def package_prefix(package: str) -> Path | None:
    """Return the prefix a package is installed in: ament's, or that of wheels."""
    for prefix in installed_prefixes():
        if package and (prefix / "share" / package).is_dir():
            return prefix
    return None


def installed_prefixes() -> list[Path]:
    """Return the prefixes in which ROS packages are installed: ament's, and that of wheels."""
    listed = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [Path(folder) for folder in [*filter(None, listed), sys.prefix]]
