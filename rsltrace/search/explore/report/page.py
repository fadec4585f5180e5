"""A search as a self-contained page of HTML: no network, no scripts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, tostring

from rsltrace.errors import ExploreError
from rsltrace.search.explore.report.charts import histogram, number, progress, scatter
from rsltrace.search.explore.report.exploration import (
    FAILS,
    Exploration,
    FailureCause,
    SettingEffect,
    Value,
    causes,
    effects,
    repeat_command,
    settings,
    view_command,
)
from rsltrace.search.explore.trial import TrialResult
from rsltrace.trace.model.regular_file import replacement_of
from rsltrace.trace.model.texts import format_duration, printable, printable_lines

_RUNS_MAX = 200
_CHARTS_MAX = 24
_PLACES_MAX = 8
_TEXT_MAX = 24

_STYLE = """
:root { color-scheme: light dark; --good: #3b7dd8; --bad: #d0453b; --line: #8888; --soft: #8881 }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 68rem; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.5rem } h2 { font-size: 1.2rem; margin-top: 2.2rem } h3 { font-size: 1rem }
code, pre { font: 13px/1.45 ui-monospace, monospace }
pre { background: var(--soft); padding: .6rem .8rem; overflow-x: auto; border-radius: 4px }
.numbers { display: flex; flex-wrap: wrap; gap: .4rem 2rem; margin: 1rem 0; padding: 0 }
.numbers div { font-size: 1.4rem } .numbers span { display: block; font-size: .8rem; opacity: .75 }
.cause { border-left: 4px solid var(--bad); padding: .1rem 0 .1rem 1rem; margin: 1rem 0 }
.decides, .caution { font-weight: 600 }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(22rem, 1fr)); gap: 1rem }
.wide { overflow-x: auto }
table { border-collapse: collapse; font-size: .9rem } caption { text-align: left; opacity: .75 }
th, td { text-align: left; padding: .2rem .9rem .2rem 0; border-bottom: 1px solid var(--line) }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums }
svg { width: 100%; height: auto } svg text { font: 11px system-ui, sans-serif; fill: currentColor }
svg line { stroke: var(--line) } svg polyline { fill: none; stroke-width: 2 }
rect.good, circle.good { fill: var(--good) } rect.bad, circle.bad { fill: var(--bad) }
circle { opacity: .6 } polyline.good { stroke: var(--good) } polyline.bad { stroke: var(--bad) }
.key i { display: inline-block; width: .8em; height: .8em; border-radius: 2px }
.key .good { background: var(--good) } .key .bad { background: var(--bad) }
"""


def write_page(explored: Exploration, path: Path) -> None:
    """Write the page; an older one is replaced when it is whole.

    :raises OSError: it cannot be written.
    """
    with replacement_of(path) as work:
        work.write_bytes(page(explored))


def page(explored: Exploration) -> bytes:
    """Return the page of a search."""
    html = Element("html", {"lang": "en"})
    head = SubElement(html, "head")
    SubElement(head, "meta", {"charset": "utf-8"})
    view = {"name": "viewport", "content": "width=device-width, initial-scale=1"}
    SubElement(head, "meta", view)
    _add(head, "title", f"rsltrace explore: {explored.job}")
    SubElement(head, "style").text = _STYLE
    body = SubElement(html, "body")
    _add(body, "h1", f"Exploring {explored.job}")
    _numbers(body, explored)
    _failures(body, explored)
    _metrics(body, explored)
    _settings(body, explored)
    _coverage(body, explored)
    _runs(body, explored)
    whole: bytes = tostring(html, encoding="utf-8", method="html")
    return b"<!DOCTYPE html>\n" + whole


# -- the parts of the page -------------------------------------------------------------------------


def _numbers(body: Element, explored: Exploration) -> None:
    runs, failed = len(explored.results), len(explored.failed)
    rate = runs / explored.wall_s if explored.wall_s > 0 else 0.0
    box = SubElement(body, "div", {"class": "numbers"})
    for value, name in (
        (f"{runs:,}", "runs"),
        (f"{failed:,}", "failed"),
        (f"{len(causes(explored)):,}", "causes"),
        (f"{explored.digests:,}", "different digests"),
        (format_duration(round(explored.wall_s * 1e9)), "of real time"),
        (f"{rate:.1f}", "runs per second"),
        (explored.strategy or "-", "strategy"),
    ):
        one = _add(box, "div", value)
        _add(one, "span", name)


def _failures(body: Element, explored: Exploration) -> None:
    _add(body, "h2", "Failures by cause")
    found = causes(explored)
    if not found:
        _add(body, "p", f"None of the {len(explored.results):,} runs failed.")
    if explored.caution:
        _add(body, "p", f"{explored.caution[:1].upper()}{explored.caution[1:]}.", "caution")
    for cause in found:
        _cause(SubElement(body, "div", {"class": "cause"}), explored, cause)


def _cause(box: Element, explored: Exploration, cause: FailureCause) -> None:
    count, runs = len(cause.runs), len(explored.results)
    _add(box, "h3", f"{cause.failure.kind}: {cause.key}")
    first = cause.first
    why = f" ({first.trial.why})" if first.trial.why else ""
    share = f"{count:,} of {runs:,} runs ({count / runs:.1%})"
    _add(box, "p", f"{share}, first in run {first.trial.number}{why}.")
    _add(box, "pre", cause.failure.text)
    if cause.reduced is not None:
        if cause.reduced.decides:
            _add(box, "p", cause.reduced.decides, "decides")
        _add(box, "p", f"Reduced in {cause.reduced.folder}:")
    shown = cause.shortest
    lines = [line for line in (repeat_command(explored, shown), view_command(shown)) if line]
    if cause.reduced is not None:
        lines.insert(0, f"rsltrace record {cause.reduced.folder}/job.yaml")
    if lines:
        _add(box, "pre", "\n".join(lines))


def _metrics(body: Element, explored: Exploration) -> None:
    names = list(dict.fromkeys(name for one in explored.results for name in one.metrics))
    if not names:
        return
    _add(body, "h2", "Metrics")
    _key(body)
    rows, drawn = [], []
    for name in names:
        values = [
            (float(one.metrics[name]), one.failure is not None)
            for one in explored.results
            if name in one.metrics and math.isfinite(one.metrics[name])
        ]
        if not values:
            continue
        ordered = sorted(value for value, _ in values)
        middle = ordered[len(ordered) // 2]
        cells = (ordered[0], middle, sum(ordered) / len(ordered), ordered[-1])
        named = _with_unit(explored, name)
        rows.append((named, f"{len(values):,}", *map(number, cells)))
        drawn.append(histogram(values, named))
    _table(body, ("metric", "runs", "min", "median", "mean", "max"), rows)
    _charts(body, drawn)


def _settings(body: Element, explored: Exploration) -> None:
    varied = [settings(one.trial) for one in explored.results]
    if not any(varied):
        return
    _add(body, "h2", "Which setting matters")
    try:
        found = effects(explored.results)
    except ExploreError as error:
        _add(body, "p", str(error))
        return
    rows = [
        (
            one.setting,
            one.outcome,
            f"{one.strength:.0%}",
            {1: "increases", -1: "decreases", 0: ""}[one.sign],
            "< 0.0001" if one.p < 0.0001 else f"{one.p:.4f}",
            f"{one.runs:,}",
        )
        for one in found
    ]
    if rows:
        head = ("setting", "outcome", "share of ranks", "direction", "p (Holm)", "runs")
        _table(body, head, rows)
        _charts(body, _drawn(explored, varied, found))
    else:
        _add(body, "p", "No setting varied, or all runs had the same outcome.")


def _drawn(
    explored: Exploration, varied: Sequence[dict[str, Value]], found: Sequence[SettingEffect]
) -> Iterator[Element]:
    """Yield charts of the effects on metrics, the surest first."""
    for effect in found[:_CHARTS_MAX]:
        if effect.outcome == FAILS:
            continue
        pairs = [
            (given[effect.setting], one.metrics[effect.outcome], one.failure is not None)
            for given, one in zip(varied, explored.results, strict=True)
            if effect.setting in given and effect.outcome in one.metrics
        ]
        texts = sorted({x for x, _, _ in pairs if isinstance(x, str)})
        if len(texts) > _PLACES_MAX:
            continue
        places = {text: float(index) for index, text in enumerate(texts)}
        points = [(x if isinstance(x, float) else places[x], y, bad) for x, y, bad in pairs]
        named = _with_unit(explored, effect.outcome)
        shown = [printable(text)[:_TEXT_MAX] for text in texts]
        yield scatter(points, effect.setting, named, shown)


def _coverage(body: Element, explored: Exploration) -> None:
    _add(body, "h2", "What was tried")
    seen: set[str] = set()
    new = []
    for one in explored.results:
        new.append(one.digest not in seen)
        seen.add(one.digest)
    for sentence in explored.coverage:
        _add(body, "p", sentence)
    if new:
        _key(body, "new runs", "runs that failed")
        _charts(body, [progress(new, [one.failure is not None for one in explored.results])])


def _runs(body: Element, explored: Exploration) -> None:
    failed = explored.failed
    if not failed:
        return
    _add(body, "h2", "Runs that failed")
    rows = [_row(one) for one in failed[:_RUNS_MAX]]
    head = ("run", "tries", "failure", "event", "events", "digest", "trace")
    _table(body, head, rows)
    if len(failed) > _RUNS_MAX:
        _add(body, "p", f"and {len(failed) - _RUNS_MAX:,} more: they are in the table of results.")


def _row(result: TrialResult) -> tuple[str, ...]:
    failure = result.failure
    assert failure is not None
    event = "" if failure.event is None else str(failure.event)
    tries = (str(result.trial.number), result.trial.why)
    return (*tries, failure.key, event, f"{result.events:,}", result.digest, result.trace or "")


# -- elements --------------------------------------------------------------------------------------


def _add(parent: Element, tag: str, text: str, kind: str = "") -> Element:
    """Add an element with untrusted text."""
    one = SubElement(parent, tag, {"class": kind} if kind else {})
    one.text = printable_lines(text)
    return one


def _table(body: Element, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    box = SubElement(body, "div", {"class": "wide"})
    table = SubElement(box, "table")
    rows = list(rows)
    numeric = [
        all(row[i][:1] in "0123456789-<." for row in rows if row[i]) for i in range(len(head))
    ]
    line = SubElement(SubElement(table, "thead"), "tr")
    for name, is_number in zip(head, numeric, strict=True):
        _add(line, "th", name, "n" if is_number else "")
    body_of = SubElement(table, "tbody")
    for row in rows:
        line = SubElement(body_of, "tr")
        for text, is_number in zip(row, numeric, strict=True):
            _add(line, "td", text, "n" if is_number else "")


def _charts(body: Element, drawn: Iterable[Element]) -> None:
    box = SubElement(body, "div", {"class": "charts"})
    box.extend(drawn)


def _key(body: Element, good: str = "runs that did not fail", bad: str = "that failed") -> None:
    line = SubElement(body, "p", {"class": "key"})
    for kind, said in (("good", good), ("bad", bad)):
        mark = SubElement(line, "i", {"class": kind})
        mark.tail = f" {said}  "


def _with_unit(explored: Exploration, name: str) -> str:
    unit = explored.units.get(name)
    return printable(f"{name} [{unit}]" if unit else name)
