"""Reports of hand-made diffs: what people read is a golden file, what programs read a contract.

``pytest --update-golden tests/diff/test_report.py`` rewrites the golden files; look at their diff.
"""

from __future__ import annotations

import dataclasses
import json
import re
import time
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsltrace.diff.facts.bags import (
    BagMessage,
    BagVerdict,
    ComparedRecording,
    LoneTopic,
    MessageDivergence,
    TopicDiff,
)
from rsltrace.diff.facts.causes import (
    CallbackAbsence,
    DifferentOutput,
    EventInOneRun,
    ExceptionInOneRun,
    NoEarlierDifference,
    Root,
    Verdict,
)
from rsltrace.diff.facts.evidence import (
    AffectedTopic,
    CauseLink,
    CauseLinkKind,
    CauseStep,
    EventRow,
    EventSummary,
    FieldDifference,
    FieldNote,
    FieldNoteKind,
    MessageDifference,
    NoFieldsReason,
    Presence,
    Setting,
    SettingKind,
)
from rsltrace.diff.facts.remarks import (
    EqualUntilTruncated,
    Identical,
    LogTimesIgnored,
    ReaderNote,
    RunsDiverge,
    TruncatedRecording,
)
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report import FORMATS, render
from rsltrace.diff.report.differences import payload_lines
from rsltrace.diff.result import BagDiff, ComparedRun, Diff, Divergence, EntityCount
from rsltrace.diff.row_sign import RowSign
from rsltrace.errors import TraceError
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind
from rsltrace.trace.model.texts import Stamp
from rsltrace.trace.words.entities import EntityKey
from rsltrace.trace.words.phrases import as_sentence
from tests.golden_files import check_golden
from tests.tiers import cases

GOLDEN = Path(__file__).parent.parent / "golden" / "diff"
DOCUMENT = Path(__file__).parent.parent.parent / "docs" / "diff.md"
JSON_DOCUMENT = DOCUMENT.parent / "reference" / "diff-json.md"
MS = 1_000_000

SCAN_TYPE = "sensor_msgs/msg/LaserScan"
SCAN = EntityKey("/scan_filter", "subscription", "/scan", SCAN_TYPE)
TICK = EntityKey("/driver", "timer", "tick", "")
PLAN = EntityKey("/planner", "subscription", "/points", SCAN_TYPE, ordinal=1)
ALL_FIELDS = (
    FieldDifference("header.stamp", "1.350000000", "1.350000001", 1e-9),
    FieldDifference("ranges[17]", "0.1", "0.2", 0.1, 13421773, elements=(1, 360)),
    FieldDifference(
        "intensities",
        "[0.0, 1.0, … 360 in all]",
        "[0.0, 2.0, … 360 in all]",
        ulp=99,
        notes=(FieldNote(FieldNoteKind.NAN_IN_B, count=1),),
        elements=(17, 360),
        first=((1, "1.0", "2.0"), (4, "1.0", "nan"), (9, "3.0", "4.0")),
        smallest=1e-7,
        largest=1.0,
    ),
    FieldDifference("header.frame_id", '"laser of the front bumper"', '"laser"'),
    FieldDifference(
        "data",
        "500 bytes",
        "500 bytes",
        notes=(FieldNote(FieldNoteKind.FIRST_BYTE, 18),),
        elements=(2, 500),
        binary=True,
        first=((16, "00 01 02 03 04 05 06 07 08 09 0a", "00 01 ff 03 04 05 06 07 08 09 0a"),),
    ),
)


def event(
    index: int,
    ms: int,
    entity: EntityKey = SCAN,
    kind: EventKind = EventKind.SUBSCRIPTION,
    **changes: Any,
) -> EventSummary:
    made = EventSummary(
        index=index,
        stamp_ns=Stamp(ms * MS),
        entity=entity,
        kind=kind,
        flags=EventFlag.NONE,
        cause_event=NO_EVENT,
        cause_output=0,
        input_hash=1,
        output_hash=0xABC,
        state_hash=0,
        outputs=1,
        position=index // 3,
        summary="/points",
    )
    return dataclasses.replace(made, **changes)


def side(name: str, digest: str, **changes: Any) -> ComparedRun:
    made = ComparedRun(
        f"runs/{name}.mcap", digest, 5210, 10_000 * MS, True, "duration of 10.000000000 s"
    )
    return dataclasses.replace(made, **changes)


def identical() -> Diff:
    sides = (side("run1", "0123456789abcdef"), side("run2", "0123456789abcdef"))
    return Diff(*sides, Verdict.IDENTICAL, Identical(5210), 5210)


def nondeterministic() -> Diff:
    """A callback that got the same and did something else; everything there can be is there."""
    a = event(123, 1350, cause_event=122)
    b = event(123, 1350, cause_event=122, output_hash=0xDEF)
    tick = event(122, 1350, TICK, EventKind.TIMER, summary="/scan")
    before = tuple(
        event(i, 730 + 5 * i, *((TICK, EventKind.TIMER) if i % 2 else (PLAN,)), summary="/cmd_vel")
        for i in range(118, 123)
    )
    message = MessageDifference(
        OutputKind.MESSAGE, "/points", SCAN_TYPE, 0, Presence.BOTH, 1, 2, ALL_FIELDS, more_fields=3
    )
    log = MessageDifference(
        OutputKind.LOG,
        "/rosout",
        "",
        1,
        Presence.ONLY_B,
        None,
        5,
        preview='msg: "nothing in reach"',
    )
    found = Divergence(
        Verdict.SAME_INPUT_DIFFERENT_OUTPUT,
        Root.CALLBACK,
        DifferentOutput(),
        NoEarlierDifference("callback", state_unknown=False, guard_is_off=False),
        a,
        b,
        messages=(message, log),
        chain=(CauseStep(tick, tick, CauseLink(CauseLinkKind.PUBLISHED, "/scan")), CauseStep(a, b)),
        rows=same(*before),
        node_rows=same(event(100, 1200)),
        reaches=(AffectedTopic("/points", 0, 3), AffectedTopic("/cmd_vel", 50 * MS, 2)),
        next_step="rsltrace cat runs/run1.mcap --node /scan_filter --from 1.35 --to 1.35",
    )
    later = dataclasses.replace(
        found,
        verdict=Verdict.EXCEPTION,
        what=ExceptionInOneRun("ValueError: no plan"),
        a=event(200, 2000, PLAN),
        b=event(201, 2000, PLAN, flags=EventFlag.RAISED, summary="exception"),
        chain=(),
        why=None,
        messages=(),
    )
    return Diff(
        side("run1", "0123456789abcdef"),
        side("run2", "fedcba9876543210", events=5208),
        found.verdict,
        RunsDiverge(),
        123,
        (found, later),
        (
            Setting(SettingKind.JOB, "job.yaml", "  gain: 1.0", "  gain: 1.5", line=12),
            Setting(SettingKind.ENVIRONMENT, "numpy", "1.26.4", None),
        ),
        (EntityCount(SCAN, 100, 3, 1, 0), EntityCount(PLAN, 90, 2, 0, 1)),
        (200, 199),
        (2123, 2122),
        4096,
        (ReaderNote("run2.mcap was recorded on another machine"),),
    )


def same(*events: EventSummary) -> tuple[EventRow, ...]:
    return tuple(EventRow(one, one, RowSign.MATCH) for one in events)


def missing() -> Diff:
    """An event of a that b does not have, in a run that was interrupted, without payloads."""
    gone = event(40, 900, TICK, EventKind.TIMER)
    instead = event(40, 950, PLAN)
    found = Divergence(
        Verdict.MISSING,
        Root.MISSING,
        EventInOneRun(instead),
        None,
        gone,
        None,
        messages=(
            MessageDifference(
                OutputKind.MESSAGE,
                "/scan",
                SCAN_TYPE,
                0,
                Presence.ONLY_A,
                77,
                None,
                no_fields=NoFieldsReason.NOT_RECORDED_IN_A,
            ),
        ),
        rows=(
            *same(event(37, 870)),
            EventRow(event(38, 880, TICK, EventKind.TIMER), None, RowSign.MOVED, 39, is_below=True),
            EventRow(event(39, 890), event(38, 890, output_hash=1), RowSign.DIFFERS),
            EventRow(None, event(39, 895, TICK, EventKind.TIMER), RowSign.MOVED, 38),
            EventRow(gone, None, RowSign.ONLY_A),
        ),
        next_step="rsltrace cat runs/run1.mcap --from 0.9 --to 0.9",
        absence=CallbackAbsence("b", "timer_cancelled", "timer tick was cancelled", "p.py:3", 31),
    )
    return Diff(
        side("run1", "0123456789abcdef"),
        side("run2", "fedcba9876543210", complete=False, stop_reason=""),
        found.verdict,
        RunsDiverge(),
        40,
        (found,),
    )


def tolerated() -> Diff:
    base = nondeterministic()
    close = (dataclasses.replace(ALL_FIELDS[1], within_tolerance=True),)
    message = MessageDifference(
        OutputKind.MESSAGE, "/points", SCAN_TYPE, 0, Presence.BOTH, 1, 2, close, more_fields=4
    )
    found = dataclasses.replace(base.divergences[0], messages=(message,))
    return dataclasses.replace(
        base, divergences=(found,), remarks=(), settings=(), tolerance=equal_within_tolerance()
    )


def recordings() -> BagDiff:
    first = MessageDivergence(
        "/odom",
        "nav_msgs/msg/Odometry",
        Presence.BOTH,
        BagMessage(500, 129 * 1000 * MS, "header: {stamp: 129.1}"),
        BagMessage(499, 229 * 1000 * MS, "header: {stamp: 129.1}"),
        16_691 * MS,
        ALL_FIELDS[:2],
        2,
        before=(BagMessage(499, 128 * 1000 * MS, 'header: {stamp: 128.9, frame_id: "odom"}'),),
    )
    lost = MessageDivergence(
        "/imu",
        "sensor_msgs/msg/Imu",
        Presence.ONLY_A,
        BagMessage(7, 130 * 1000 * MS, "header: {stamp: 130.0}"),
        None,
        17_000 * MS,
    )
    return BagDiff(
        ComparedRecording("bags/monday", "mcap", 4, 1207, 112 * 1000 * MS, 203 * 1000 * MS),
        ComparedRecording(
            "bags/tuesday", "sqlite3", 3, 1199, 212 * 1000 * MS, 303 * 1000 * MS, False
        ),
        BagVerdict.DIFFERENT,
        "order",
        (
            TopicDiff(
                "/odom", "nav_msgs/msg/Odometry", "nav_msgs/msg/Odometry", 690, 5, 3, 0, 1, first
            ),
            TopicDiff("/scan", SCAN_TYPE, SCAN_TYPE, 400, 0, 0, 0, 0),
            TopicDiff("/imu", "sensor_msgs/msg/Imu", "sensor_msgs/msg/Imu", 90, 0, 0, 1, 0, lost),
        ),
        (LoneTopic("/tf", "tf2_msgs/msg/TFMessage", 17),),
        (),
        first,
        "rsltrace diff bags/monday bags/tuesday --topic /odom --context 20",
        (LogTimesIgnored(),),
    )


def equal_within_tolerance() -> BagDiff:
    return dataclasses.replace(
        recordings(),
        verdict=BagVerdict.WITHIN_TOLERANCE,
        topics=(TopicDiff("/odom", "a/msg/B", "a/msg/B", 690, 5, 0, 0, 0),),
        topics_only_a=(),
        first=None,
        next_step="",
    )


def cut() -> Diff:
    """Two runs that agree until one recording ends: green nowhere."""
    sides = (side("run1", "0123456789abcdef"), side("run2", "fedcba9876543210", events=4096))
    return Diff(
        sides[0],
        dataclasses.replace(sides[1], complete=False, stop_reason="interrupted"),
        Verdict.AGREE_UNTIL_TRUNCATED,
        EqualUntilTruncated(4096, ("b",)),
        4096,
        remarks=(TruncatedRecording("b", "runs/run2.mcap", 4096, 10_000 * MS),),
    )


def cut_recording() -> BagDiff:
    return dataclasses.replace(
        equal_within_tolerance(),
        b=dataclasses.replace(recordings().b, complete=False),
        verdict=BagVerdict.AGREE_UNTIL_TRUNCATED,
        topics=(TopicDiff("/odom", "a/msg/B", "a/msg/B", 690, 0, 0, 0, 0),),
    )


CASES: dict[str, Callable[[], Diff | BagDiff]] = {
    "identical": identical,
    "nondeterministic": nondeterministic,
    "missing": missing,
    "tolerated": tolerated,
    "recordings": recordings,
    "equal_within_tolerance": equal_within_tolerance,
    "cut": cut,
    "cut_recording": cut_recording,
}
SUFFIXES = {
    "text": "txt",
    "json": "json",
    "markdown": "md",
    "junit": "xml",
    "github": "github.txt",
}


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("case", list(CASES))
def test_golden_reports(case: str, form: str) -> None:
    check_golden(GOLDEN / f"{case}.{SUFFIXES[form]}", render(CASES[case](), form))


def test_golden_report_of_everything() -> None:
    text = render(nondeterministic(), "text", DiffOptions(everything=True))
    check_golden(GOLDEN / "nondeterministic_all.txt", text)
    assert "independent divergence 2: exception" in text
    assert "… 3 more fields" in text
    check_golden(
        GOLDEN / "recordings_all.txt", render(recordings(), "text", DiffOptions(everything=True))
    )


@pytest.mark.parametrize("form", FORMATS)
def test_golden_reports_of_several_runs(form: str) -> None:
    runs: list[Diff | BagDiff] = [nondeterministic(), identical(), missing(), tolerated(), cut()]
    check_golden(GOLDEN / f"several.{SUFFIXES[form]}", render(runs, form))


@pytest.mark.parametrize("made", [cut, cut_recording])
def test_a_cut_recording_is_green_nowhere_unless_that_is_enough(
    made: Callable[[], Diff | BagDiff],
) -> None:
    diff = made()
    assert (diff.identical, diff.failed, diff.exit_code) == (False, True, 1)
    assert 'failures="1"' in render(diff, "junit")
    assert render(diff, "github").startswith("::error ")
    assert "identical" not in render(diff, "markdown")
    assert json.loads(render(diff, "json"))["verdict"] == "agree-until-truncated"
    assert "agree" in render(diff).splitlines()[0]
    enough = dataclasses.replace(diff, allow_truncated=True)
    assert (enough.identical, enough.failed, enough.exit_code) == (False, False, 0)
    assert 'failures="0"' in render(enough, "junit")
    assert render(enough, "github").startswith("::notice ")
    assert json.loads(render(enough, "json"))["failed"] is False
    assert "1 of 2 runs agrees only up to where a recording is truncated." in render([diff, enough])
    assert "agree with runs" in render([enough, enough]) or "agree with bags" in render(
        [enough] * 2
    )


@pytest.mark.parametrize("case", list(CASES))
def test_the_first_line_is_the_verdict_in_one_sentence(case: str) -> None:
    diff = CASES[case]()
    text = render(diff, "text", width=400)
    assert text.splitlines()[0] == as_sentence(diff.sentence)


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_report_fits_a_screen_whatever_there_is_to_say(width: int) -> None:
    crowded = crowd(nondeterministic())
    lines = render(crowded, "text", width=width).splitlines()
    assert len(lines) <= 40
    text = "\n".join(lines)
    for needed in ("ranges[17]", "<- h", "no earlier event", "affects", "next: ", "job.yaml"):
        assert needed in text, needed
    # only what names the two files (a digest must not be cut) and commands may be wider
    wide = [row for row in lines if len(row) > width]
    assert all("digest" in row or row.startswith("next: ") for row in wide), wide
    assert len(render(crowded, "text", DiffOptions(everything=True)).splitlines()) > 100


def crowd(diff: Diff) -> Diff:
    """Give a diff too much of everything."""
    found = diff.divergences[0]
    step = found.chain[0]
    events = tuple(event(i, i) for i in range(60, 80))
    others = tuple(event(i, i, PLAN) for i in range(61, 81))
    found = dataclasses.replace(
        found,
        what=ExceptionInOneRun("no " * 200),
        chain=(step,) * 15 + found.chain[1:],
        messages=found.messages * 6,
        rows=tuple(EventRow(a, b, RowSign.DIFFERS) for a, b in zip(events, others, strict=True)),
        node_rows=tuple(EventRow(event(i, i), None, RowSign.ONLY_A) for i in range(20)),
        reaches=found.reaches * 20,
    )
    return dataclasses.replace(
        diff,
        divergences=(found, *diff.divergences),
        settings=diff.settings * 20,
        counts=diff.counts * 20,
        remarks=diff.remarks * 10,
    )


@pytest.mark.parametrize(("width", "shown"), [(60, 5), (200, 21)])
def test_of_many_topics_as_many_are_shown_as_two_lines_hold(width: int, shown: int) -> None:
    """Trying every number of them would take a minute."""
    found = nondeterministic().divergences[0]
    reaches = tuple(AffectedTopic(f"/t{n}", 0, 1) for n in range(5000))
    diff = dataclasses.replace(
        nondeterministic(), divergences=(dataclasses.replace(found, reaches=reaches),)
    )
    begin = time.process_time()
    text = render(diff, "text", width=width)
    assert time.process_time() - begin < 2
    affects = " ".join(text[text.index("affects /t0") :].split())
    assert affects.count(" immediately, ", 0, affects.index("more")) == shown
    assert f" immediately, and {5000 - shown} more" in affects


def test_one_more_field_is_no_plural() -> None:
    assert "… 1 more field " in f"{payload_lines((), 1, '', '', 80)} ".replace("'", " ")


def test_a_longer_context_is_shown() -> None:
    found = nondeterministic().divergences[0]
    events = tuple(event(i, i) for i in range(60, 90))
    found = dataclasses.replace(found, rows=same(*events))
    diff = dataclasses.replace(nondeterministic(), divergences=(found,))
    lines = render(diff, "text", DiffOptions(context=30)).splitlines()
    assert sum("  0.0" in row for row in lines) == 30


HOSTILE = "/x\x1b]0;pwned\x07\n::error::injected\r`|<script>&\u202e@everyone"


def poisoned(value: Any) -> Any:
    """Put hostile text in every text of a diff that comes from a file."""
    if isinstance(value, Enum):
        return value
    if isinstance(value, str):
        return value + HOSTILE
    if isinstance(value, tuple):
        return tuple(map(poisoned, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kept = ("digest", "by", "source", "run", "doubt")
        # values of fields are printable when they are made
        made = isinstance(value, FieldDifference)
        return dataclasses.replace(
            value,
            **{
                field.name: poisoned(getattr(value, field.name))
                for field in dataclasses.fields(value)
                if field.name not in kept and not made
            },
        )
    return value


@pytest.mark.parametrize("case", ["nondeterministic", "missing", "recordings"])
@pytest.mark.parametrize("form", ["text", "markdown", "junit", "github"])
def test_what_a_file_says_cannot_steer_a_terminal_or_a_build(case: str, form: str) -> None:
    clean, text = render(CASES[case](), form), render(poisoned(CASES[case]()), form)
    for character in ("\x1b", "\x07", "\r", "\u202e"):
        assert character not in text
    assert not re.search(r"^::error::injected", text, re.MULTILINE)
    if form == "github":
        commands = [row for row in text.splitlines() if not row.startswith("::")]
        assert commands == []
        assert 0 < len(text.splitlines()) <= len(clean.splitlines())
    if form == "junit":
        ElementTree.fromstring(text)
    if form == "markdown":
        outside = re.sub(r"^(`{3,})text$.*?^\1$", "", text, flags=re.MULTILINE | re.DOTALL)
        assert "<script>" not in outside
        assert not re.search(r"(?<!\\)@everyone", outside)


@settings(max_examples=cases(10, 50))
@given(st.text(max_size=30))
def test_junit_is_well_formed_whatever_the_sentence(sentence: str) -> None:
    plain, told = (
        ElementTree.fromstring(
            render(
                dataclasses.replace(missing(), outcome=RunsDiverge(None, (each, "ab c"))), "junit"
            )
        )
        for each in ("x", sentence or "x")
    )
    assert [each.tag for each in told.iter()] == [each.tag for each in plain.iter()]
    shown = told[0][0][0].attrib["message"].lower()
    assert all(word.lower() in shown for word in re.findall(r"[A-Za-z0-9]+", sentence)), shown


def test_junit_counts() -> None:
    suite = ElementTree.fromstring(render([missing(), identical()], "junit"))[0]
    assert (suite.attrib["tests"], suite.attrib["failures"]) == ("2", "1")
    failure = suite[0][0]
    assert (failure.tag, failure.attrib["type"]) == ("failure", "missing")
    assert suite[1][0].tag == "system-out"


def test_json_is_strict_and_versioned() -> None:
    for make in CASES.values():
        content = json.loads(render(make(), "json"))
        assert (content["format"], content["version"]) == ("rsltrace-diff", 1)
        assert content["kind"] in ("traces", "bags")
        assert content["exit_code"] == make().exit_code
    infinite = dataclasses.replace(ALL_FIELDS[0], absolute=float("inf"))
    message = dataclasses.replace(tolerated().divergences[0].messages[0], fields=(infinite,))
    found = dataclasses.replace(tolerated().divergences[0], messages=(message,))
    text = render(dataclasses.replace(tolerated(), divergences=(found,)), "json")
    strict = json.loads(text, parse_constant=lambda name: pytest.fail(name))
    fields = strict["divergences"][0]["messages"][0]["fields"]
    assert fields[0]["absolute"] == "Infinity"


def documented_keys() -> set[str]:
    """The keys in the tables of docs/reference/diff-json.md: first column, in backticks."""
    rows = re.findall(r"^\| (`[^|]+`) \|", JSON_DOCUMENT.read_text(encoding="utf-8"), re.MULTILINE)
    return {key for row in rows for key in re.findall(r"`([a-z_]+)`", row)}


def all_keys(value: Any) -> set[str]:
    if isinstance(value, dict) and "fact" in value:
        return {"fact"}  # whose keys are those of its class
    if isinstance(value, dict):
        return set(value) | {key for item in value.values() for key in all_keys(item)}
    if isinstance(value, list):
        return {key for item in value for key in all_keys(item)}
    return set()


def test_every_key_of_the_json_is_documented() -> None:
    used = set()
    for make in CASES.values():
        used |= all_keys(json.loads(render(make(), "json")))
    used |= all_keys(json.loads(render([missing(), identical()], "json")))
    assert used - documented_keys() == set()


def test_verdicts_are_documented() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    for verdict in (*Verdict, *Root, *BagVerdict):
        assert f"`{verdict.value}`" in text, verdict


def test_tolerance_is_said_and_has_its_own_exit_status() -> None:
    text = render(tolerated(), "text")
    assert "equal within tolerance, not identical" in text
    assert tolerated().exit_code == equal_within_tolerance().exit_code == 3
    assert "equal within tolerance" not in render(nondeterministic(), "text")
    # what is tolerated where the runs diverge may have grown later
    partly = dataclasses.replace(tolerated(), tolerance=recordings())
    assert partly.exit_code == 1
    text = render(partly, "text")
    assert "equal within tolerance" not in text
    assert "not within tolerance: the messages first diverge on /odom" in " ".join(text.split())
    assert json.loads(render(tolerated(), "json"))["within_tolerance"] is True
    for near in (tolerated(), equal_within_tolerance()):
        assert "::notice" in render(near, "github")
        assert "<failure" not in render(near, "junit")


def test_the_exit_status_of_several_is_the_worst() -> None:
    def status(*runs: Diff | BagDiff) -> int:
        content = json.loads(render(list(runs), "json"))
        assert isinstance(content["exit_code"], int)
        return content["exit_code"]

    assert status(identical(), tolerated(), nondeterministic()) == 1
    assert status(identical(), tolerated()) == 3
    assert status(identical(), identical()) == 0
    assert "All 2 runs agree with runs/run1.mcap, 1 of them within tolerance." in render(
        [identical(), tolerated()]
    )


def test_unknown_format_and_nothing_to_report() -> None:
    with pytest.raises(TraceError, match="no report format 'yaml'; there are text, json"):
        render(identical(), "yaml")
    with pytest.raises(TraceError, match="nothing to report"):
        render([], "text")
