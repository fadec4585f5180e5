"""The options of a comparison, for the engine, the bags and the reports."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from fnmatch import fnmatchcase

from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass

BY_ORDER = "order"
BY_STAMP = "stamp"


@dataclass(frozen=True, slots=True)
class DiffOptions:
    """How to compare and how much to say.

    ``context`` is the number of events (or messages) shown before a divergence. ``everything``
    (``--all``) looks at both runs to their ends and reports every independent divergence;
    otherwise ``window`` events after the first one are aligned. ``nodes`` and ``topics`` are globs
    on full names: what matches none is left out of the report (none given: all is in).

    ``ignore`` are globs on field paths that are not compared; ``absolute`` and ``relative`` are
    pairs of such a glob and a tolerance: a difference is covered when |a-b| is at most the
    absolute one, or at most the relative one times the larger of |a| and |b|. Any field glob may
    begin with a glob of topics and a colon (``/odom:header.stamp``); it then holds for these only.

    ``by`` says how the messages of two bags are matched: ``order`` or ``stamp`` (the log time).
    ``allow_truncated``: truncated recordings pass if they agree up to their end.
    Raises TraceError for values that make no sense.
    """

    context: int = 5
    everything: bool = False
    nodes: tuple[str, ...] = ()
    topics: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    absolute: tuple[tuple[str, float], ...] = ()
    relative: tuple[tuple[str, float], ...] = ()
    window: int = 2000
    by: str = BY_ORDER
    allow_truncated: bool = False

    def __post_init__(self) -> None:
        if self.context < 0 or self.window < 1:
            raise TraceError(
                f"a context of {self.context} events in a window of {self.window} cannot be shown; "
                "give a context of 0 or more and a window of 1 or more"
            )
        if self.by not in (BY_ORDER, BY_STAMP):
            raise TraceError(f"messages are matched by {BY_ORDER} or {BY_STAMP}, not by {self.by}")
        for glob, tolerance in self.absolute + self.relative:
            if not (math.isfinite(tolerance) and tolerance >= 0):
                raise TraceError(
                    f"the tolerance {tolerance} of {glob} is not a number of 0 or more"
                )

    @property
    def tolerant(self) -> bool:
        """Whether some difference could be covered by a tolerance."""
        return bool(self.absolute or self.relative)

    def for_topic(self, topic: str) -> DiffOptions:
        """Return the options as they hold for one topic: field globs without their topics."""
        if not any(":" in glob for glob in (*self.ignore, *self._tolerance_globs())):
            return self
        return replace(
            self,
            ignore=tuple(g for glob in self.ignore if (g := _on_topic(glob, topic)) is not None),
            absolute=_tolerances_on(self.absolute, topic),
            relative=_tolerances_on(self.relative, topic),
        )

    def wants_topic(self, topic: str) -> bool:
        return not self.topics or any(fnmatchcase(topic, glob) for glob in self.topics)

    def wants_node(self, node: str) -> bool:
        return not self.nodes or any(fnmatchcase(node, glob) for glob in self.nodes)

    def _tolerance_globs(self) -> tuple[str, ...]:
        return tuple(glob for glob, _ in self.absolute + self.relative)


def _tolerances_on(
    tolerances: tuple[tuple[str, float], ...], topic: str
) -> tuple[tuple[str, float], ...]:
    return tuple(
        (g, value) for glob, value in tolerances if (g := _on_topic(glob, topic)) is not None
    )


def _on_topic(glob: str, topic: str) -> str | None:
    """Return the field glob of ``[TOPICS:]FIELDS``, or None if it does not hold for ``topic``."""
    topics, colon, fields = glob.rpartition(":")
    return fields if not colon or fnmatchcase(topic, topics) else None


# The exit status of a comparison: 0 identical, 1 diverged or cut, 3 equal within tolerance.

EXIT_DIVERGED = 1

EXIT_WITHIN_TOLERANCE = 3
"""Neither identical (0) nor diverged (1), and not what others use for trouble (2)."""


def exit_code_of_several(codes: Iterable[int]) -> int:
    """Return the worst: diverged, then within tolerance, then identical."""
    found = set(codes)
    return next((code for code in (EXIT_DIVERGED, EXIT_WITHIN_TOLERANCE) if code in found), 0)
