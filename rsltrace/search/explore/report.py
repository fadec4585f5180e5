"""The results of a search: failures by cause, effects of settings, commands to repeat a run."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from rsltrace.diff.report.ci import command_data, command_property
from rsltrace.errors import ExploreError
from rsltrace.search.explore.trial import Failure, JobSource, Trial, TrialResult
from rsltrace.trace.model.regular_file import replacement_of
from rsltrace.trace.model.texts import printable, printable_lines

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


# JSON, JUnit, annotations for GitHub, a Parquet table of all runs.


# The runs of a search as a Parquet table, one row each, for DuckDB, pandas and the like.
#
# What was varied and every metric have columns of their own (``set.nodes.0.parameters.speed``,
# ``metric.error``), so tables of several searches are merged by the names of their columns.


def write_parquet(explored: Exploration, path: Path) -> None:
    """Write the table; an older one is replaced when it is whole.

    :raises ExploreError: pyarrow is not installed.
    :raises OSError: it cannot be written.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise ExploreError("a Parquet table needs pip install 'rsltrace[explore]'") from None
    rows = [_row(explored, one) for one in explored.results]
    fixed = dict(_COLUMNS)
    names = list(dict.fromkeys([*fixed, *(name for row in rows for name in row)]))
    columns, types = [], []
    for name in names:
        values = [row.get(name) for row in rows]
        kind = fixed.get(name)
        if kind is None:  # a setting that is a number in one run and a text in another is a text
            is_text = any(isinstance(value, str) for value in values)
            kind = "string" if is_text else "float64"
            if is_text:
                values = [None if value is None else str(value) for value in values]
        columns.append(values)
        types.append(pa.field(name, getattr(pa, kind)()))
    table = pa.table(columns, schema=pa.schema(types))
    with replacement_of(path) as work:
        parquet.write_table(table, work)


_COLUMNS = (
    ("job", "string"),
    ("strategy", "string"),
    ("run", "int64"),
    ("tries", "string"),
    ("seed", "int64"),
    ("overlay", "string"),
    ("digest", "string"),
    ("final_state", "string"),
    ("verdict", "string"),
    ("cause", "string"),
    ("text", "string"),
    ("event", "int64"),
    ("events", "int64"),
    ("choices", "int64"),
    ("simulated_s", "float64"),
    ("wall_s", "float64"),
    ("trace", "string"),
)
"""Columns that every table has, with the types that pyarrow calls them by."""


def _row(explored: Exploration, result: TrialResult) -> dict[str, Any]:
    failure = result.failure
    overlay = result.trial.overlay
    values: dict[str, Any] = {
        "job": explored.job,
        "strategy": explored.strategy,
        "run": result.trial.number,
        "tries": result.trial.why,
        "seed": overlay.get("seed"),
        "overlay": json.dumps(dict(overlay)),
        "digest": result.digest,
        "final_state": result.final_state,
        "verdict": "kept" if failure is None else failure.kind,
        "cause": None if failure is None else failure.key,
        "text": None if failure is None else failure.text,
        "event": None if failure is None else failure.event,
        "events": result.events,
        "choices": result.choices,
        "simulated_s": result.end_ns / 1e9,
        "wall_s": result.wall_s,
        "trace": result.trace,
    }
    values.update({f"set.{name}": value for name, value in settings(result.trial).items()})
    values.update({f"metric.{name}": float(value) for name, value in result.metrics.items()})
    return values


def json_values(explored: Exploration) -> dict[str, Any]:
    """Return a search as JSON values: its numbers, its failures by cause, what matters."""
    return {
        "job": explored.job,
        "strategy": explored.strategy,
        "runs": len(explored.results),
        "failed": len(explored.failed),
        "checks": explored.checks,
        "caution": explored.caution,
        "digests": explored.digests,
        "wall_s": round(explored.wall_s, 3),
        "coverage": list(explored.coverage),
        "causes": [_cause_values(explored, cause) for cause in causes(explored)],
        "effects": _effect_values(explored),
    }


def json_text(explored: Exploration) -> str:
    """Return a search as one line of JSON."""
    return json.dumps(json_values(explored))


def _cause_values(explored: Exploration, cause: FailureCause) -> dict[str, Any]:
    shown = cause.shortest
    reduced = cause.reduced
    return {
        "key": cause.key,
        "kind": cause.failure.kind,
        "text": cause.failure.text,
        "runs": len(cause.runs),
        "first_run": cause.first.trial.number,
        "why": cause.first.trial.why,
        "overlay": dict(cause.first.trial.overlay),
        "digest": cause.first.digest,
        "event": cause.first.failure.event if cause.first.failure else None,
        "trace": shown.trace,
        "repeat": repeat_command(explored, shown),
        "view": view_command(shown),
        "reduced": None if reduced is None else reduced.folder,
        "decides": None if reduced is None else reduced.decides,
    }


def _effect_values(explored: Exploration) -> list[dict[str, Any]]:
    if not any(settings(one.trial) for one in explored.results):
        return []
    try:
        found = effects(explored.results)
    except ExploreError:  # without scipy; the page says so
        return []
    return [asdict(one) for one in found]


def junit_text(explored: Exploration) -> str:
    """Return a search as JUnit XML: a test that failed for each cause, one that passed if none."""
    found = causes(explored)
    count = str(max(len(found), 1))
    numbers = {"tests": count, "failures": str(len(found)), "errors": "0"}
    time = f"{explored.wall_s:.3f}"
    suites = Element("testsuites", {"name": "rsltrace explore", **numbers, "time": time})
    suite = SubElement(
        suites, "testsuite", {"name": printable(explored.job), **numbers, "time": time}
    )
    for cause in found:
        case = _case(suite, explored, f"{cause.failure.kind}: {cause.key}")
        said = f"{len(cause.runs)} of {len(explored.results)} runs: {cause.failure.text}"
        kind = {"type": cause.failure.kind, "message": printable(said)}
        SubElement(case, "failure", kind).text = printable_lines(_details(explored, cause))
    if not found:
        case = _case(suite, explored, f"{len(explored.results)} runs")
        if explored.caution:
            SubElement(case, "system-out").text = explored.caution
    indent(suites)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + tostring(suites, encoding="unicode")


def _case(suite: Element, explored: Exploration, name: str) -> Element:
    return SubElement(
        suite, "testcase", {"classname": printable(explored.job), "name": printable(name)}
    )


def _details(explored: Exploration, cause: FailureCause) -> str:
    lines = [cause.failure.text]
    if cause.reduced is not None:
        lines += [cause.reduced.decides, f"made small in {cause.reduced.folder}"]
    shown = cause.shortest
    lines += [line for line in (repeat_command(explored, shown), view_command(shown)) if line]
    return "\n".join(filter(None, lines))


def github_text(explored: Exploration) -> str:
    """Return a search as workflow commands of GitHub Actions: an error for each cause, at the line
    it names or else at the job, and a notice where there is none."""
    found = causes(explored)
    if not found:
        name = command_property(printable(_from_here(explored.job)))
        said = f"{len(explored.results)} runs, none failed"
        said += f"; {explored.caution}" if explored.caution else ""
        return f"::notice file={name}::{command_data(printable_lines(said))}"
    lines = []
    for cause in found:
        file, line = _place(explored, cause)
        where = f"file={command_property(printable(file))}" + (f",line={line}" if line else "")
        title = command_property(printable(f"{cause.failure.kind}: {cause.key}"))
        said = f"{len(cause.runs)} of {len(explored.results)} runs\n{_details(explored, cause)}"
        lines.append(f"::error {where},title={title}::{command_data(printable_lines(said))}")
    return "\n".join(lines)


def _place(explored: Exploration, cause: FailureCause) -> tuple[str, int | None]:
    if cause.place is None:
        return _from_here(explored.job), None
    file, line = cause.place
    return _from_here(os.path.join(os.path.dirname(explored.job), file)), line


def _from_here(path: str) -> str:
    """Return a path as GitHub wants it: from the folder of the checkout."""
    shown = os.path.relpath(path)
    return Path(os.path.abspath(path) if shown.startswith("..") else shown).as_posix()
