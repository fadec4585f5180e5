"""What a search has found: causes, effects, a page, and formats for machines."""

from __future__ import annotations

import json
import random
import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest
from rsltrace_viewer.pages.search_page import exploration_page

from rsltrace.search.explore.report import (
    FAILS,
    Exploration,
    ReducedRun,
    causes,
    effects,
    github_text,
    json_values,
    junit_text,
    repeat_command,
)
from rsltrace.search.explore.trial import CHECK, EXCEPTION, Failure, JobSource, Trial, TrialResult

LATE = Failure(CHECK, "it is <late> & wrong\x1b[2J", "never /late", 41)
RAISED = Failure(EXCEPTION, "raised KeyError", "KeyError at nodes.py:12", 7)


def explored(count: int = 300) -> Exploration:
    """Make results in which the gain decides on the error, and the colour on nothing."""
    draw = random.Random(5)
    results = []
    for number in range(count):
        gain, colour = draw.uniform(0, 2), draw.choice(["red", "green"])
        failure = LATE if gain > 1.5 else RAISED if number % 40 == 3 else None
        overlay = {"seed": number, "set": {"nodes.0.parameters.gain": gain, "colour": colour}}
        metrics = {"error": gain**2 + draw.gauss(0, 0.1), "noise": draw.random()}
        trace = f"out/traces/{number:06d}.mcap" if failure else None
        results.append(
            TrialResult(
                Trial(number, overlay, f"seed {number}"),
                digest=f"{number % 50:016x}",
                events=100 + number,
                failure=failure,
                metrics=metrics,
                trace=trace,
            )
        )
    return Exploration(
        JobSource("robot/job.yaml"),
        results,
        strategy="mixed",
        coverage=["Every order of up to 2 departures was tried."],
        wall_s=12.5,
        units={"error": "m"},
        reduced={LATE.key: ReducedRun("out/small", "/scan before /tf decides")},
    )


def test_failures_are_put_together_by_cause() -> None:
    late, raised = causes(explored())
    assert (late.key, raised.key) == (LATE.key, RAISED.key)
    assert len(late.runs) + len(raised.runs) == len(explored().failed)
    assert late.first.trial.number == min(one.trial.number for one in late.runs)
    assert late.shortest.events == min(one.events for one in late.runs)
    assert late.reduced is not None
    assert raised.place == ("nodes.py", 12)
    assert late.place is None


@pytest.mark.long
def test_the_setting_that_matters_is_told_from_those_that_do_not() -> None:
    found = effects(explored().results)
    by_pair = {(one.setting, one.outcome): one for one in found}
    gain = "nodes.0.parameters.gain"
    assert by_pair[gain, "error"].is_sure
    assert by_pair[gain, "error"].strength > 0.9
    assert by_pair[gain, "error"].sign == 1
    assert by_pair[gain, FAILS].is_sure
    assert {pair for pair, one in by_pair.items() if one.is_sure} == {
        (gain, "error"),
        (gain, FAILS),
    }
    assert [one.p for one in found] == sorted(one.p for one in found)


def test_a_setting_that_harms_in_the_middle_is_seen() -> None:
    results = [
        TrialResult(
            Trial(number, {"set": {"mode": number % 3}}),
            metrics={"x": float(number % 3 == 1) + number / 1000},
        )
        for number in range(60)
    ]
    (one,) = effects(results)
    assert one.is_sure
    assert one.strength > 0.5


def test_nothing_is_said_of_what_does_not_vary() -> None:
    same = [TrialResult(Trial(n, {"set": {"a": 1.0}}), metrics={"x": n}) for n in range(20)]
    few = [TrialResult(Trial(n, {"set": {"a": n}}), metrics={"x": n}) for n in range(4)]
    nan = [TrialResult(Trial(n, {"set": {"a": n}}), metrics={"x": float("nan")}) for n in range(20)]
    for results in (same, few, nan, []):
        assert effects(results) == []


class _Balanced(HTMLParser):
    """Sees that what is opened is closed, and keeps texts and classes."""

    VOID = frozenset(("meta", "link", "br", "img"))

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_needs_nothing_beside_it_and_nobodys_text_is_markup() -> None:
    seen = _Balanced()
    seen.feed(exploration_page(explored()))
    assert seen.open == []
    assert seen.links == []
    assert seen.tags.count("script") == 1  # our own
    assert seen.tags.count("svg") >= 3
    assert "it is <late> & wrong\\x1b[2J" in seen.text
    assert "/scan before /tf decides" in seen.text
    assert "rsltrace record out/small/job.yaml" in seen.text
    assert re.search(r"rsltrace view out/traces/\d+\.mcap --at 41", seen.text)
    assert "Every order of up to 2 departures" in seen.text
    assert "error [m]" in seen.text


@pytest.mark.parametrize(
    ("count", "numbers", "failed"),
    [
        (0, ("0runs", "0different digests"), "None of the 0 runs failed"),
        (1, ("1run", "1different digest"), "The run did not fail"),
    ],
)
def test_a_page_of_next_to_nothing(count: int, numbers: tuple[str, ...], failed: str) -> None:
    seen, results = _Balanced(), explored(count).results
    seen.feed(exploration_page(Exploration(JobSource("job.yaml"), results, wall_s=13.4734)))
    assert seen.open == []
    for said in (*numbers, "13.5 sof real time", failed):
        assert re.search(rf"{said}(?!s)", seen.text), seen.text


@pytest.mark.long
def test_a_large_search_makes_no_large_page() -> None:
    assert len(exploration_page(explored(20_000))) < 1_000_000


def test_formats_for_machines(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    values = json.loads(json.dumps(json_values(explored())))
    assert values["runs"] == 300
    assert sum(cause["runs"] for cause in values["causes"]) == values["failed"]
    assert values["causes"][0]["decides"] == "/scan before /tf decides"
    suite = ElementTree.fromstring(junit_text(explored()))
    assert suite.attrib["failures"] == suite.attrib["tests"] == "2"
    assert [one.attrib["type"] for one in suite.iter("failure")] == [CHECK, EXCEPTION]
    late, raised = github_text(explored()).splitlines()
    assert late.startswith("::error file=robot/job.yaml,title=check%3A never /late::")
    assert "%0A" in late
    assert raised.startswith("::error file=robot/nodes.py,line=12,title=")
    kept = Exploration(JobSource("job.yaml"), [TrialResult(Trial(0, {}))])
    assert ElementTree.fromstring(junit_text(kept)).attrib["failures"] == "0"
    assert github_text(kept).startswith("::notice file=job.yaml::1 runs, none failed; the job has ")


def test_a_job_without_checks_is_told_what_was_not_looked_for() -> None:
    result = TrialResult(Trial(0, {}), digest="1")
    for checks, said in ((0, True), (2, False)):
        found = Exploration(JobSource("job.yaml"), [result], checks=checks)
        for text in (
            exploration_page(found),
            json.dumps(json_values(found)),
            junit_text(found),
            github_text(found),
        ):
            assert ("he job has no checks: only exceptions" in text) is said
            assert ("never: log error" in text.replace("%3A", ":")) is said


def test_a_command_that_nobody_can_read_is_not_shown() -> None:
    one = TrialResult(Trial(1, {"seed": 4, "policy": {"departures": [{"choice": 2, "run": 1}]}}))
    found = Exploration(JobSource("my job.yaml"), [one])
    shown = repeat_command(found, one)
    assert shown is not None
    assert shown.startswith("rsltrace record 'my job.yaml' --set seed=4 --set 'policy=")
    program = (("nodes.+", 'nodes.+={"script": "a.py"}'),)
    found = Exploration(JobSource("<command line>", program, "nodes: []"), [one])
    shown = repeat_command(found, one)
    assert shown is not None
    assert shown.startswith("rsltrace record --set 'nodes.+={")
    many = [{"choice": number, "run": 1} for number in range(100)]
    assert repeat_command(found, TrialResult(Trial(1, {"policy": {"departures": many}}))) is None


def test_a_table_can_be_queried_and_merged_with_another(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb")
    from rsltrace.search.explore.report import write_parquet

    for name in "ab":
        (tmp_path / name).mkdir()
        write_parquet(explored(), tmp_path / name / "results.parquet")
    write_parquet(Exploration(JobSource("job.yaml"), []), tmp_path / "empty.parquet")
    other = TrialResult(Trial(0, {"set": {"colour": 3.0, "load": "high"}}), metrics={"time": 2.0})
    write_parquet(Exploration(JobSource("job.yaml"), [other]), tmp_path / "b" / "more.parquet")
    assert sorted(path.name for path in tmp_path.rglob(".*")) == []
    both = f"read_parquet('{tmp_path}/*/*.parquet', union_by_name=true)"
    runs, failed = duckdb.sql(
        f"SELECT count(*), count(cause) FROM {both} WHERE job = 'robot/job.yaml'"
    ).fetchall()[0]
    assert (runs, failed) == (600, 2 * len(explored().failed))
    (gain,) = duckdb.sql(
        f"SELECT min(\"set.nodes.0.parameters.gain\") FROM {both} WHERE cause = 'never /late'"
    ).fetchall()[0]
    assert gain > 1.5
    assert duckdb.sql(f'SELECT "metric.time" FROM {both} WHERE "set.load" = \'high\'').fetchall()
