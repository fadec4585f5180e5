"""The results of a search: failures by cause, effects of settings, commands to repeat a run."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from rsltrace.errors import ExploreError
from rsltrace.search.explore.trial import Failure, JobSource, Trial, TrialResult

_COMMAND_MAX = 400
_AT_LINE = re.compile(r" at (?P<file>[^:\s]+):(?P<line>\d+)")

NO_CHECKS = (
    "the job has no checks: only exceptions, deadlocks, livelocks, crashes and timeouts are "
    "found. Add what must hold in every run to the job, e.g. checks: [never: log error] "
    "(docs/checks.md)"
)
"""A warning for searches of jobs without checks."""

Value = float | str


@dataclass(frozen=True, slots=True)
class ReducedRun:
    """A reduced failing run: its folder, and the one difference that decides."""

    folder: str
    decides: str = ""


@dataclass(frozen=True, slots=True)
class Exploration:
    """A search that has ended.

    ``coverage`` are sentences on what was tried, ``units`` the units of metrics, ``reduced`` the
    reduced runs by their failure's key, ``checks`` the number of checks.
    """

    source: JobSource
    results: Sequence[TrialResult]
    strategy: str = ""
    coverage: Sequence[str] = ()
    wall_s: float = 0.0
    units: Mapping[str, str] = field(default_factory=dict)
    reduced: Mapping[str, ReducedRun] = field(default_factory=dict)
    checks: int = 0

    @property
    def job(self) -> str:
        """The job file as it was named."""
        return self.source.path

    @property
    def caution(self) -> str:
        """A warning if the job has no checks, else empty."""
        return "" if self.checks else NO_CHECKS

    @property
    def failed(self) -> list[TrialResult]:
        """The runs that failed."""
        return [one for one in self.results if one.failure is not None]

    @property
    def digests(self) -> int:
        """How many different runs there were."""
        return len({one.digest for one in self.results if one.digest})


@dataclass(frozen=True, slots=True)
class FailureCause:
    """Failures of one cause: a check, or a line where an exception is raised.

    ``first`` is the run with the lowest number, ``shortest`` that with the fewest events.
    """

    key: str
    failure: Failure
    runs: Sequence[TrialResult]
    reduced: ReducedRun | None = None

    @property
    def first(self) -> TrialResult:
        """The run that showed it first."""
        return self.runs[0]

    @property
    def shortest(self) -> TrialResult:
        """The run that shows it in the fewest events, one with a trace if there is any."""
        return min(self.runs, key=lambda one: (one.trace is None, one.events, one.trial.number))

    @property
    def place(self) -> tuple[str, int] | None:
        """File (relative to the job) and line that the failure names."""
        found = _AT_LINE.search(self.key)
        return None if found is None else (found["file"], int(found["line"]))


def causes(explored: Exploration) -> list[FailureCause]:
    """Return the failures of a search by cause, the most frequent first."""
    groups: dict[str, list[TrialResult]] = {}
    for one in sorted(explored.failed, key=lambda one: one.trial.number):
        assert one.failure is not None
        groups.setdefault(one.failure.key, []).append(one)
    found = []
    for key, runs in groups.items():
        failure = runs[0].failure
        assert failure is not None
        found.append(FailureCause(key, failure, runs, explored.reduced.get(key)))
    return sorted(found, key=lambda cause: (-len(cause.runs), cause.first.trial.number))


def settings(trial: Trial) -> dict[str, Value]:
    """Return the settings of a trial that a metric could depend on, its faults included."""
    given: dict[str, Value] = {}
    for path, value in trial.overlay.get("set", {}).items():
        given[path] = _value(value)
    faults = [_fault(one) for one in trial.overlay.get("faults", ())]
    if faults:
        given["fault"] = ", ".join(faults)
    return given


def _value(value: Any) -> Value:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    return value if isinstance(value, str) else json.dumps(value)


def _fault(fault: Mapping[str, Any]) -> str:
    kind = next(iter(fault), "")
    return f"{kind} {fault.get(kind)}"


def repeat_command(explored: Exploration, result: TrialResult) -> str | None:
    """Return the command that repeats a run, None if it would be too long to read."""
    command = explored.source.command(result.trial)
    return command if len(command) <= _COMMAND_MAX else None


def view_command(result: TrialResult) -> str | None:
    """Return the command that shows where a run failed, None if its trace was not kept."""
    if result.trace is None:
        return None
    words = ["rsltrace", "view", result.trace]
    if result.failure is not None and result.failure.event is not None:
        words += ["--at", str(result.failure.event)]
    return shlex.join(words)


# Which setting matters: a setting with many values is ranked against the outcome (Spearman), one
# with few is a factor (Kruskal and Wallis). Neither assumes that anything is linear or normal. The
# p-values are corrected for the number of pairs (Holm).

FAILS = "fails"
"""The outcome that a run fails (1) or does not (0)."""

_FEW = 6
"""Up to so many values, a setting is a factor."""
_RUNS_MIN = 5
_SURE = 0.05


@dataclass(frozen=True, slots=True)
class SettingEffect:
    """The effect of a setting on an outcome (a metric, or ``fails``).

    ``strength`` is the share of the ranks' variance that it explains, 0 to 1; ``sign`` says whether
    a larger value gives more (1) or less (-1), 0 for texts. ``p`` is the corrected p-value,
    ``runs`` the number of runs compared.
    """

    setting: str
    outcome: str
    strength: float
    sign: int
    p: float
    runs: int

    @property
    def is_sure(self) -> bool:
        """Whether it is statistically significant."""
        return self.p < _SURE


def effects(results: Sequence[TrialResult]) -> list[SettingEffect]:
    """Return the effects of all settings, the surest first.

    :raises ExploreError: scipy is not installed.
    """
    varied = [settings(one.trial) for one in results]
    names = list(dict.fromkeys(name for one in varied for name in one))
    outcomes = list(dict.fromkeys(name for one in results for name in one.metrics))
    found = []
    for name in names:
        for outcome in [FAILS, *outcomes]:
            pairs = _pairs(name, outcome, varied, results)
            effect = _effect(name, outcome, pairs)
            if effect is not None:
                found.append(effect)
    found.sort(key=lambda one: (one.p, -one.strength))
    return _corrected(found)


def _pairs(
    name: str,
    outcome: str,
    varied: Sequence[Mapping[str, Value]],
    results: Sequence[TrialResult],
) -> list[tuple[Value, float]]:
    pairs = []
    for given, result in zip(varied, results, strict=True):
        if name not in given:
            continue
        if outcome == FAILS:
            pairs.append((given[name], float(result.failure is not None)))
        elif outcome in result.metrics:
            pairs.append((given[name], float(result.metrics[outcome])))
    return [pair for pair in pairs if pair[1] == pair[1]]  # NaN says nothing


def _effect(name: str, outcome: str, pairs: Sequence[tuple[Value, float]]) -> SettingEffect | None:
    values = {value for value, _ in pairs}
    if len(pairs) < _RUNS_MIN or len(values) < 2 or len({y for _, y in pairs}) < 2:
        return None
    try:
        from scipy import stats
    except ImportError:
        raise ExploreError(
            "the table of effects needs scipy: pip install 'rsltrace[explore]'"
        ) from None
    sign = 0
    if all(isinstance(value, float) for value in values):
        ranked = stats.spearmanr([x for x, _ in pairs], [y for _, y in pairs])
        related = float(ranked.statistic)
        sign = (related > 0) - (related < 0)
        if len(values) > _FEW:
            return SettingEffect(name, outcome, related**2, sign, float(ranked.pvalue), len(pairs))
    groups = [[y for x, y in pairs if x == value] for value in sorted(values, key=str)]
    tested = stats.kruskal(*groups)
    strength = min(float(tested.statistic) / (len(pairs) - 1), 1.0)
    return SettingEffect(name, outcome, strength, sign, float(tested.pvalue), len(pairs))


def _corrected(found: Sequence[SettingEffect]) -> list[SettingEffect]:
    """Return effects, in order of p, with Holm's correction."""
    corrected, least = [], 0.0
    for index, effect in enumerate(found):
        least = max(least, min(1.0, effect.p * (len(found) - index)))
        corrected.append(replace(effect, p=least))
    return corrected
