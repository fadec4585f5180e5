"""The pages for the browser say what the traces say, and nothing in a trace becomes markup."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from rsltrace_viewer.model.lanes import KIND_LETTERS
from rsltrace_viewer.model.plots.series import Series
from rsltrace_viewer.pages.charts import curves, histogram

from campaigns.attack import mcap_parts
from campaigns.attack.families.texts import with_strings
from rsltrace.cli.main import cli
from rsltrace.diff import diff_files
from rsltrace.diff.traces.aligned_runs import AlignedRuns
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.entities import SHORT_KINDS
from tests.pages.page import MARKUP, Page, contained, with_names

SAMPLES = Path(__file__).parents[2] / "sample_traces"
PAIRS = sorted(path.parent for path in SAMPLES.glob("*/a.mcap"))
_ROW_VALUE = re.compile(r"(-?[\d.e+-]+) → (-?[\d.e+-]+)")
_CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)


def made(*words: str) -> str:
    """Return the page that a command prints."""
    result = CliRunner().invoke(cli, [*words, "--format", "html"])
    assert result.exit_code in (0, 1), result.output
    return result.output


@pytest.mark.parametrize("folder", PAIRS, ids=lambda path: path.name)
def test_rows_fields_and_order_are_those_of_the_traces(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    text = made("diff", "a.mcap", "b.mcap")
    contained(text)
    page, diff = Page(text), diff_files("a.mcap", "b.mcap")
    assert diff.shown is not None
    rows = [row for row in page.rows if len(row) == 8][1:]
    assert len(rows) == 30
    here = [row for row, kind in zip(page.rows, page.classes, strict=True) if "here" in kind]
    with Trace.open("a.mcap") as a, Trace.open("b.mcap") as b:
        runs = AlignedRuns(a, b)
        stamps = [[e["stamp"] for block in t.events() for e in block] for t in (a, b)]
        for number, event in ((1, diff.shown.a), (2, diff.shown.b)):
            own = [int(row[number]) for row in rows if row[number]]
            assert own == list(range(own[0], own[-1] + 1))  # each once, in order
            if event is not None:
                assert str(event.index) in [row[number] for row in here]
        for sign, *numbers, time, _, _, _, did in rows:
            indexes = [int(number) if number else None for number in numbers]
            which = 0 if indexes[0] is not None else 1
            index = indexes[which]
            assert index is not None
            assert time == format_seconds(int(stamps[which][index]))
            place = runs.rows.place_of(index, of_b=bool(which))
            assert runs.rows.row(place).sign.value == sign
            pair = runs.rows.row(place).pair
            fields = (
                [f for one in runs.differences(*pair) for f in one.fields]
                if all(side is not None for side in pair)
                else []
            )
            for old, new in _ROW_VALUE.findall(did) if sign == "≠" else ():
                assert any(
                    float(old) == pytest.approx(float(f.a), rel=1e-3)
                    and float(new) == pytest.approx(float(f.b), rel=1e-3)
                    for f in fields
                ), did
    kinds = {row[5] for row in rows}
    for kind, letter in KIND_LETTERS.items():
        assert (f"{letter} {kind.label}" in page.text) == (SHORT_KINDS[kind] in kinds)
    for message in diff.shown.messages:
        for field in message.fields:
            assert f"{field.a} → {field.b}" in page.text
    assert (diff.shown.next_step or "rsltrace diff") in page.text
    assert page.tags.count("button") >= 2


def test_an_event_that_moved_stands_in_both_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(SAMPLES / "delayed_input")
    rows = [row for row in Page(made("diff", "a.mcap", "b.mcap")).rows if len(row) == 8]
    assert ["252", "", "+15 ms ↓ b 253"] in [[*r[1:3], r[7][:14]] for r in rows if r[0] == "~"]
    assert ["", "253", "+15 ms ↑ a 252"] in [[*r[1:3], r[7][:14]] for r in rows if r[0] == "~"]


def with_logs(parts: list[mcap_parts.Part], extra: str) -> None:
    """Put ``extra`` into the texts that nodes log and answer."""
    mcap_parts.change_messages(
        parts,
        "/rosout",
        lambda data, nth: with_strings(data, "/rosout", lambda n, text: text and extra.encode()),
    )


@pytest.mark.parametrize("words", [("diff", "a", "b"), ("info", "b")])
def test_nothing_in_a_trace_becomes_markup(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for sample, write in (
        ("nondeterministic_callback", with_names),
        ("missing_event", with_logs),
    ):
        pages = []
        for extra in (MARKUP, "x" * len(MARKUP)):
            name = extra.replace("/", "_")[:60]
            paths = {side: f"{side}{name}.mcap" for side in "ab"}
            for side, path in paths.items():
                parts = mcap_parts.take_apart((SAMPLES / sample / f"{side}.mcap").read_bytes())
                write(parts, extra)
                (tmp_path / path).write_bytes(mcap_parts.put_together(parts))
            text = made(words[0], *(paths[side] for side in words[1:]))
            contained(text)
            pages.append(Page(text))
        assert MARKUP[:20] in pages[0].text
        assert pages[0].tags == pages[1].tags
        names = [[name for name, _ in page.attributes] for page in pages]
        assert names[0] == names[1]


@pytest.mark.parametrize("words", [("diff", "a.mcap", "b.mcap"), ("info", "b.mcap")])
def test_texts_of_any_length_make_no_large_page(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for sample, write in (("nondeterministic_callback", with_names), ("missing_event", with_logs)):
        for side in "ab":
            parts = mcap_parts.take_apart((SAMPLES / sample / f"{side}.mcap").read_bytes())
            write(parts, "<" * 6_000)
            (tmp_path / f"{side}.mcap").write_bytes(mcap_parts.put_together(parts))
        contained(made(*words))


def test_the_page_of_a_run_has_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(SAMPLES / "missing_event")
    text = made("info", "b.mcap")
    assert ["name", "events", "Hz", "share"] in Page(text).rows, "a node is not of a node"
    contained(text)
    page = Page(text)
    with Trace.open("b.mcap") as trace:
        assert trace.digest in page.text
    assert ["warnings logged", "12", "32"] in page.rows
    assert "the gripper has not answered yet" in page.text
    assert ["/picked", "std_msgs/msg/UInt32"] in [row[:2] for row in page.rows]
    assert page.tags.count("marker") == 1  # the graph


def test_several_runs_and_equal_ones_have_a_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(SAMPLES / "schedule")
    text = made("diff", "a.mcap", "a.mcap", "b.mcap")
    contained(text)
    page = Page(text)
    assert "1 of 2 runs diverges from a.mcap." in page.text
    assert page.rows[2][:2] == ["b.mcap", "schedule"]
    contained(made("diff", "a.mcap", "a.mcap"))


def history_lines(text: str, runs: int = 300) -> str:
    """Return lines of a history with ``text`` in every field that may have it."""
    return "".join(
        json.dumps(
            {
                "time": f"2026-11-01T10:{number // 60:02d}:{number % 60:02d}.000Z",
                "by": "explore",
                "job": f"{number % 3}{text}",
                "commit": f"{number // 3}{text}",
                "branch": text,
                "digest": f"{number // 100:016x}",
                "verdict": ("passed", "passed", "failed")[number % 3],
                "reason": text,
                "runs": 10,
                "failed": number % 2,
            }
        )
        + "\n"
        for number in range(1, runs + 1)
    )


def test_the_page_of_a_history_has_its_jobs_and_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs.jsonl").write_text(history_lines(".yaml") + "{\n")
    text = made("history", "runs.jsonl")
    contained(text)
    page = Page(text)
    assert "300 runs of 3 jobs at 101 commits" in page.text
    assert "1 line could not be read" in page.text
    kinds = [value for name, value in page.attributes if name == "class" and value in _CELLS]
    explained, warned = 1, 1
    cells = [kinds.count(kind) for kind in _CELLS]
    assert cells == [76 + explained, 38 + explained + warned, 3, 1]
    changes = [row for row in page.rows if len(row) == 5 and "→" in row[3]]
    assert len(changes) == 4
    assert changes[0][1:3] == ["0.yaml", ".yaml"]
    (failing,) = [row for row in page.rows if "of 100 runs" in row[1:2][0] if len(row) > 1]
    assert failing[:3] == ["2.yaml", "100 of 100 runs (100 %)", "50 of 1,000 orders (5 %)"]


_CELLS = ("good", "bad", "good changed", "bad changed")


def test_nothing_in_a_history_becomes_markup(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    pages = []
    for text in (MARKUP, "x" * len(MARKUP), "<" * 6_000):
        Path("runs.jsonl").write_text(history_lines(text, runs=130))
        pages.append(made("history", "runs.jsonl"))
        contained(pages[-1])
    one, other, long = map(Page, pages)
    assert MARKUP[:20] in one.text
    assert "130 runs" in long.text  # no line of it was skipped
    assert one.tags == other.tags
    assert [name for name, _ in one.attributes] == [name for name, _ in other.attributes]


@pytest.mark.skipif(_CHROMIUM is None, reason="needs chromium")
@pytest.mark.long
def test_a_browser_shows_them_and_has_nothing_to_complain_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(SAMPLES / "delayed_input")
    assert _CHROMIUM is not None
    for name, words in (("diff", ("diff", "a.mcap", "b.mcap")), ("info", ("info", "a.mcap"))):
        path = tmp_path / f"{name}.html"
        path.write_text(made(*words), encoding="utf-8")
        flags = ("--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr")
        done = subprocess.run(
            [_CHROMIUM, *flags, f"--user-data-dir={tmp_path / 'browser'}", "--dump-dom", str(path)],
            capture_output=True,
            text=True,
            env={**os.environ, "HOME": str(tmp_path)},
        )
        assert "</svg>" in done.stdout
        assert "CONSOLE" not in done.stderr  # what the policy refuses is told there


def test_a_page_does_not_replace_what_it_is_made_of(tmp_path: Path) -> None:
    a, b = (shutil.copy(path, tmp_path / path.name) for path in sorted(PAIRS[0].glob("*.mcap"))[:2])
    before = Path(b).read_bytes()
    for words in (["info", str(b)], ["diff", str(a), str(b)]):
        done = CliRunner().invoke(cli, [*words, "--format", "html", "-o", str(b)])
        assert done.exit_code == 2
        assert "is the trace itself; choose another name" in str(done.output) + done.stderr
    assert Path(b).read_bytes() == before
    kept = tmp_path / "runs.jsonl"
    kept.touch()
    done = CliRunner().invoke(cli, ["history", str(kept), "-o", str(kept)])
    assert "is the history itself; choose another name" in str(done.output) + done.stderr


def test_numbers_too_large_for_a_half_are_drawn() -> None:
    for values in ((1.7e18, 1.7e18), (-1e308, 1e308)):
        one = Series(np.array([0.0, 1.0]), np.array(values), "")
        text = str(curves([one], "data", None))
        assert "nan" not in text
        assert "points" in text
        assert histogram([(value, False) for value in values], "data")
