"""Reduce a failing trial: leave out all that it does not need to fail for the same cause."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from rsltrace.errors import ExploreError, RsltraceError
from rsltrace.run.plans.recorded_order import ATTACHMENT_CHOICES
from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.trial import ERROR, Failure, JobSource, Trial, TrialResult
from rsltrace.search.explore.workers import Worker
from rsltrace.simulation.loop.policy import decode_choices
from rsltrace.trace.model.texts import Stamp
from rsltrace.trace.reader import Trace

T = TypeVar("T")


def ddmin(items: Sequence[T], fails: Callable[[list[T]], bool]) -> list[T]:
    """Return a minimal selection of ``items``, in their order, for which ``fails`` is true: none of
    it can be left out alone (delta debugging: Zeller and Hildebrandt, 2002).

    ``fails`` must be true for all items and need not be monotonic. It is called once for each
    selection: at most about n^2 + 3n times, about 2 log2(n) if a single item is the cause.
    """
    known: dict[tuple[int, ...], bool] = {tuple(range(len(items))): True}

    def still_fails(chosen: Sequence[int]) -> bool:
        key = tuple(chosen)
        if key not in known:
            known[key] = fails([items[index] for index in key])
        return known[key]

    left = list(range(len(items)))
    if still_fails([]):
        return []
    parts = 2
    while len(left) >= 2:
        pieces = _pieces(left, parts)
        rests = [[one for one in left if one not in piece] for piece in pieces]
        for smaller, next_parts in (
            *((piece, 2) for piece in pieces),
            *((rest, max(parts - 1, 2)) for rest in rests if parts > 2),
        ):
            if still_fails(smaller):
                left, parts = smaller, next_parts
                break
        else:
            if parts >= len(left):
                break
            parts = min(2 * parts, len(left))
    return [items[index] for index in left]


def _pieces(left: Sequence[int], count: int) -> list[list[int]]:
    """Return ``left`` in ``count`` pieces of nearly the same length, none of them empty."""
    ends = [len(left) * number // count for number in range(count + 1)]
    return [list(left[begin:end]) for begin, end in pairwise(ends)]


_TIMES_TRIED = 12
_PASSING_TRIED = 16


@dataclass(frozen=True, slots=True)
class OverlayParts:
    """The overlay of a failing trial, part by part.

    ``departures`` is None where the job's own policy stays; ``without`` are the indexes of the
    entries of ``nodes`` that are left out, ``until_ns`` is a simulated time.
    """

    seed: int | None = None
    departures: tuple[Mapping[str, Any], ...] | None = None
    faults: tuple[Mapping[str, Any], ...] | None = None
    settings: tuple[tuple[str, Any], ...] = ()
    until_ns: int | None = None
    without: tuple[int, ...] = ()

    def overlay(self) -> dict[str, Any]:
        """Return the overlay of a trial with these parts."""
        found: dict[str, Any] = {}
        if self.seed is not None:
            found["seed"] = self.seed
        if self.departures is not None:
            found["policy"] = {"departures": list(self.departures)}
        if self.faults is not None:
            found["faults"] = list(self.faults)
        taken = {f"nodes.{place}": None for place in sorted(self.without, reverse=True)}
        if self.settings or taken:
            found["set"] = {**dict(self.settings), **taken}
        if self.until_ns is not None:
            found["until"] = f"{self.until_ns}ns"
        return found

    def one_fewer(self) -> list[tuple[str, OverlayParts]]:
        """Return (description, parts) of each that has one departure, fault or setting less."""
        found = []
        for key, word in (
            ("departures", "departure"),
            ("faults", "fault"),
            ("settings", "setting"),
        ):
            items: Sequence[Any] = getattr(self, key) or ()
            for index, item in enumerate(items):
                left = tuple(one for place, one in enumerate(items) if place != index)
                changed: Any = {key: left}
                found.append((f"without the {word} {_worded(item)}", replace(self, **changed)))
        return found


@dataclass(frozen=True, slots=True)
class ReducedTrial:
    """A reduced trial: ``result`` is its run, found in ``runs`` runs; ``is_minimal`` says that
    nothing more can be left out alone. ``passing`` are the parts of the nearest passing run, None
    if there is none; ``passing_words`` says what differs in it. ``chosen`` says for each departure
    what runs before what, ``left_out`` names the entries of ``nodes`` that are.
    """

    parts: OverlayParts
    result: TrialResult
    runs: int
    is_minimal: bool
    passing: OverlayParts | None
    passing_words: str
    chosen: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


class TrialReduction:
    """Reduces ``result``, a failed trial of ``source``. If its trace is missing, it is run again.

    ``scratch`` is a folder for traces, ``runs_max`` limits the runs.
    """

    def __init__(
        self,
        source: JobSource,
        result: TrialResult,
        worker: Worker,
        scratch: Path,
        *,
        runs_max: int = 1000,
        timeout_s: float | None = None,
    ) -> None:
        assert result.failure is not None, "it fails"
        self._source = source
        self._failure = result.failure
        self._given = result
        self._worker = worker
        self._scratch = scratch
        self._left = runs_max
        self._timeout_s = timeout_s
        self.runs = 0
        self._numbers = itertools.count(1)

    def reduce(self) -> ReducedTrial:
        """Return the trial with as little as it needs to fail for the same cause.

        :raises ExploreError: it does not fail again, or is no trial of this job.
        """
        parts = self._given_parts()
        first = self._run(parts, keep=True)
        if not self._is_same(first):
            got = "nothing fails" if first.failure is None else first.failure.text
            raise ExploreError(
                f"trial {self._given.trial.number} does not fail again in the same order ({got}): "
                "the job is not deterministic; run rsltrace verify to see why"
            )
        while True:
            before = parts
            if parts.seed is not None and self._fails(replace(parts, seed=None)):
                parts = replace(parts, seed=None)
            parts = self._fewer(parts, "faults")
            parts = self._fewer(parts, "settings")
            parts = self._fewer(parts, "departures")
            parts = self._shorter(parts)
            parts = self._fewer_nodes(parts)
            if parts == before or self._left <= 0:
                break
        last = self._run(parts, keep=True, steps=True)
        passing, words = self._nearest_passing(parts, last)
        nodes = self._source.job().nodes
        return ReducedTrial(
            parts,
            last,
            self.runs,
            self._left > 0,
            passing,
            words,
            tuple(_chosen(parts, last)),
            tuple(nodes[place].name or nodes[place].target for place in parts.without),
        )

    def _given_parts(self) -> OverlayParts:
        overlay = self._given.trial.overlay
        parts = OverlayParts(
            overlay.get("seed"),
            None,
            tuple(overlay["faults"]) if "faults" in overlay else None,
            tuple(overlay.get("set", {}).items()),
        )
        with Trace.open(self._trace()) as trace:
            choices = trace.attachment(ATTACHMENT_CHOICES)
            end_ns = trace.stamp(trace.end_ns)
        if "policy" in overlay or choices is not None:
            made = enumerate(decode_choices(choices or b""))
            departures = tuple({"choice": number, "run": run} for number, run in made if run)
            parts = replace(parts, departures=departures)
        return replace(parts, until_ns=end_ns) if "until" in overlay else parts

    def _trace(self) -> Path:
        """Return the trace of the given trial, made again if it is not there."""
        trial = self._given.trial
        if self._given.trace is not None and Path(self._given.trace).is_file():
            return Path(self._given.trace)
        self.runs += 1
        place = self._scratch / "given.mcap"
        again = self._worker.run(trial, place, TrialOptions(keep=True), self._timeout_s)
        if again.trace is None:
            said = "it did not fail" if again.failure is None else again.failure.text
            raise ExploreError(f"trial {trial.number} leaves no trace: {said}")
        return Path(again.trace)

    def _fewer(self, parts: OverlayParts, key: str) -> OverlayParts:
        """Leave out departures, faults or settings."""

        def with_some(some: Sequence[Any]) -> OverlayParts:
            changed: Any = {key: tuple(some)}
            return replace(parts, **changed)

        items: Sequence[Any] = getattr(parts, key) or ()
        return (
            with_some(ddmin(items, lambda some: self._fails(with_some(some)))) if items else parts
        )

    def _fewer_nodes(self, parts: OverlayParts) -> OverlayParts:
        """Leave out entries of ``nodes``."""
        count = len(self._source.job().nodes)
        present = [place for place in range(count) if place not in parts.without]
        if len(present) < 2:
            return parts

        def with_some(some: Sequence[int]) -> OverlayParts:
            return replace(parts, without=tuple(p for p in range(count) if p not in some))

        def fails(some: Sequence[int]) -> bool:
            return bool(some) and self._fails_for_its_parts(with_some(some))

        return with_some(ddmin(present, fails))

    def _fails_for_its_parts(self, parts: OverlayParts) -> bool:
        """Whether a trial fails for the same cause, while the same nodes pass in the same time
        without its changes. Else it fails because a node is missing, or because it ends too soon.
        """
        if not self._fails(parts):
            return False
        if parts.seed is None and not parts.one_fewer():
            return True
        plain = OverlayParts(until_ns=parts.until_ns, without=parts.without)
        return self._run(plain).failure is None

    def _shorter(self, parts: OverlayParts) -> OverlayParts:
        """End the run as early as possible: at the failing event, or by bisection of the time."""
        result = self._run(parts, keep=True)
        if not self._is_same(result) or result.trace is None or result.failure is None:
            return parts
        with Trace.open(result.trace) as trace:
            start_ns, end_ns = trace.start_ns, trace.end_ns
            event = result.failure.event
            at_ns = end_ns if event is None else trace.event(event).stamp_ns
        at_ns = min(at_ns, end_ns)
        if at_ns < end_ns and self._fails_for_its_parts(replace(parts, until_ns=at_ns)):
            return replace(parts, until_ns=Stamp(at_ns, start_ns))
        passes_ns, fails_ns = max(at_ns, start_ns) if at_ns < end_ns else start_ns, end_ns
        for _ in range(_TIMES_TRIED):
            middle_ns = (passes_ns + fails_ns) // 2
            if middle_ns in (passes_ns, fails_ns):
                break
            if self._fails_for_its_parts(replace(parts, until_ns=middle_ns)):
                fails_ns = middle_ns
            else:
                passes_ns = middle_ns
        return parts if fails_ns == end_ns else replace(parts, until_ns=Stamp(fails_ns, start_ns))

    def _nearest_passing(
        self, parts: OverlayParts, failing: TrialResult
    ) -> tuple[OverlayParts | None, str]:
        """Return the run with one part less (else the plain run, or that without delays) that
        passes and agrees longest with the failing run."""
        from rsltrace.diff import diff_files

        best: tuple[int, OverlayParts, str] | None = None
        candidates = parts.one_fewer()[:_PASSING_TRIED] or [("the job as it is", OverlayParts())]
        if self._source.job().delay is not None:
            undelayed = OverlayParts(settings=(("delay", None),))
            candidates.append(("the job without delays", undelayed))
        for words, fewer in candidates:
            if best is not None and fewer.settings == (("delay", None),):
                break  # it differs in more
            result = self._run(fewer, keep=True)
            if result.failure is not None or result.trace is None or failing.trace is None:
                continue
            agreeing = diff_files(failing.trace, result.trace).agreeing
            if best is None or agreeing > best[0]:
                best = agreeing, fewer, words
        return (None, "") if best is None else best[1:]

    def _fails(self, parts: OverlayParts) -> bool:
        """Whether a trial fails for the same cause; False if no more runs are allowed."""
        if self._left <= 0:
            return False
        self._left -= 1
        return self._is_same(self._run(parts))

    def _is_same(self, result: TrialResult) -> bool:
        found, wanted = result.failure, self._failure
        return found is not None and (found.kind, found.key) == (wanted.kind, wanted.key)

    def _run(self, parts: OverlayParts, *, keep: bool = False, steps: bool = False) -> TrialResult:
        """Run a trial; one that cannot start counts as a failure of another cause."""
        number = next(self._numbers)
        trial = Trial(number, parts.overlay(), "made smaller")
        trace = self._scratch / f"{number}.mcap"
        self.runs += 1
        try:
            result = self._worker.run(
                trial, trace, TrialOptions(keep=keep, steps=steps), self._timeout_s
            )
        except RsltraceError as error:
            failure = Failure(ERROR, str(error), "it cannot be made")
            return TrialResult(trial, failure=failure)
        if not keep:
            trace.unlink(missing_ok=True)
        return result


def _chosen(parts: OverlayParts, result: TrialResult) -> Iterator[str]:
    """Yield what each departure lets run, and what would have run in the plain order."""
    choices = [step for step in result.steps if len(step.ready) > 1]
    for departure in parts.departures or ():
        number, run = departure["choice"], departure["run"]
        if number < len(choices) and run < len(choices[number].ready):
            ready = [name.rpartition(" #")[0] or name for name in choices[number].ready]
            yield f"{ready[run]} before {ready[0]}"
        else:
            yield ""


def _worded(item: Any) -> str:
    if isinstance(item, tuple):
        return f"{item[0]}: {item[1]}"
    return ", ".join(f"{key}: {value}" for key, value in item.items())
