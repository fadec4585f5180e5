"""Which fields are not compared, and which may differ by how much.

Globs are matched against paths such as ``poses[3].position.x``: ``*`` is any text (dots too), ``?``
any character, and brackets are brackets, unlike in a shell, since paths have them. A glob that
matches a parent holds for all below it, and indexes may be left out: ``poses.position`` holds for
``poses[3].position.x``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from rsltrace.diff.options import DiffOptions

_INDEX = re.compile(r"\[\d+\]")
_BOUNDARY = re.compile(r"[.\[]")
_WILD = {"*": ".*", "?": "."}


class FieldRules:
    """The field globs of ``DiffOptions``, compiled; answers are remembered per path."""

    def __init__(self, options: DiffOptions) -> None:
        self.empty = not (options.ignore or options.tolerant)
        self._ignore = _pattern(options.ignore)
        self._absolute = [(_pattern([glob]), value) for glob, value in options.absolute]
        self._relative = [(_pattern([glob]), value) for glob, value in options.relative]
        globs = [*options.ignore]
        globs += [glob for glob, _ in (*options.absolute, *options.relative)]
        self.by_element = any("[" in glob for glob in globs)
        """Whether some glob may single out elements of an array."""
        self._tolerances: dict[str, tuple[float, float] | None] = {}

    def ignored(self, path: str) -> bool:
        """Whether a field, or what it is part of, is not to be compared."""
        return self._ignore is not None and _matches(self._ignore, path)

    def tolerance(self, path: str) -> tuple[float, float] | None:
        """Return the (absolute, relative) tolerance of a field; None if it has none at all.

        Where several globs match, the most generous one counts.
        """
        if not (self._absolute or self._relative):
            return None
        if path not in self._tolerances:
            if len(self._tolerances) > 10_000:
                self._tolerances.clear()  # long arrays: every element has a path
            absolute = [v for pattern, v in self._absolute if pattern and _matches(pattern, path)]
            relative = [v for pattern, v in self._relative if pattern and _matches(pattern, path)]
            found = bool(absolute or relative)
            self._tolerances[path] = (
                (max(absolute, default=0.0), max(relative, default=0.0)) if found else None
            )
        return self._tolerances[path]

    def covers(self, path: str, difference: float, size: float) -> bool:
        """Whether |a-b| = ``difference`` is tolerated, ``size`` being the larger of |a| and |b|."""
        tolerance = self.tolerance(path)
        if tolerance is None:
            return False
        absolute, relative = tolerance
        return difference <= absolute or difference <= relative * size


def _pattern(globs: Sequence[str]) -> re.Pattern[str] | None:
    if not globs:
        return None
    parts = ("".join(_WILD.get(char) or re.escape(char) for char in glob) for glob in globs)
    return re.compile("|".join(f"(?:{part})" for part in parts), re.DOTALL)


def _matches(pattern: re.Pattern[str], path: str) -> bool:
    return any(pattern.fullmatch(name) for name in _names(path))


def _names(path: str) -> Iterator[str]:
    """Yield the path and its parents, each also without its indexes."""
    ends = [match.start() for match in _BOUNDARY.finditer(path)]
    for end in (*ends, len(path)):
        name = path[:end]
        yield name
        if "[" in name:
            yield _INDEX.sub("", name)
