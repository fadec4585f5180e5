"""What the viewer computes, without a terminal."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rsltrace_viewer.model.folder import Bookmarks, VisitedEvents
from rsltrace_viewer.model.inspector.effects import effects_of
from rsltrace_viewer.model.inspector.event import inspect
from rsltrace_viewer.model.inspector.message_tree import Openness, Role
from rsltrace_viewer.model.lane_maker import LaneWindow
from rsltrace_viewer.model.query import conditions
from rsltrace_viewer.model.rows import FilteredRows
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline import columns as columns_module
from rsltrace_viewer.model.timeline.columns import (
    EventColumn,
    EventRow,
    ListSpace,
    ShortNames,
    layout,
)
from rsltrace_viewer.model.timeline.events import EventTexts
from rsltrace_viewer.model.view import OneRun, Window, cells, fit, wrap
from rsltrace_viewer.terminal.screens.help import help_text

from rsltrace.job.values.times import parse_stamp
from rsltrace.trace.model.event import NO_EVENT
from rsltrace.trace.reader import Trace


def test_the_model_loads_no_terminal_library() -> None:
    code = (
        "import rsltrace_viewer.session, rsltrace_viewer.model.inspector.differences, "
        "rsltrace_viewer.model.plots.series, rsltrace_viewer.model.plots.series, sys\n"
        "print(*[m for m in ('textual', 'rerun', 'rclpy', 'pydantic') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("width", range(1, 12))
@pytest.mark.parametrize("text", ["", "abc", "日本語テキスト", "a日b本c", "x" * 30])
def test_fit_always_has_the_width(text: str, width: int) -> None:
    assert cells(fit(text, width)) == width
    assert cells(fit(text, width, right=True)) == width


def test_wrap_keeps_every_word_and_no_line_is_too_wide() -> None:
    text = "the quick brown fox 日本語テキスト jumpsoverthelazydogwithoutspaces\nagain"
    lines = wrap(text, 10)
    assert all(cells(line) <= 10 for line in lines)
    assert "".join("".join(lines).split()) == "".join(text.split())


SHARED = ["/camera_pipeline_front/raw", "/camera_pipeline_rear/raw"]
OF_TWO_ROBOTS = ["/robot_1/controller_manager", "/robot_2/controller_manager"]


def test_names_are_cut_where_they_stay_distinct() -> None:
    names = ShortNames([*SHARED, *OF_TWO_ROBOTS, "/a"])
    assert [names.fit(name, 16) for name in SHARED] == ["/camera…ront/raw", "/camera…rear/raw"]
    assert [names.fit(name, 12) for name in OF_TWO_ROBOTS] == ["/robot_1/co…", "/robot_2/co…"]
    alike = ShortNames(f"/warehouse_fleet_{n}_controller_of_all_wheels" for n in ("east", "west"))
    shown = [alike.fit(name, 16) for name in alike._names]
    assert shown == ["…leet_east_cont…", "…leet_west_cont…"]
    actions = [
        f"/{robot}/drive/{part}" for robot in ("robot_1", "robot_2") for part in ("goal", "status")
    ]
    of_actions = ShortNames(actions)  # all look alike at the beginning, two at the end
    assert [of_actions.fit(name, 8) for name in actions[:2]] == ["/ro…goal", "/ro…atus"]
    assert names.fit("/a", 5) == "/a   "
    assert names.fit("/not/one/of/them", 8) == "/not/on…"


@given(st.lists(st.text("/ab日本é_", max_size=16), max_size=8), st.integers(0, 12))
def test_a_cut_name_has_the_width_it_should_have(words: list[str], width: int) -> None:
    names = ShortNames(words)
    for word in words:
        assert cells(names.fit(word, width)) == width


@pytest.mark.parametrize("width", [20, 40, 60, 80, 100, 120, 200])
@pytest.mark.parametrize("signs", [False, True])
def test_columns_never_exceed_the_width(run: Run, width: int, signs: bool) -> None:
    texts = EventTexts(run)
    columns = layout(ListSpace(width, 5, 12, 12, signs=signs), {})
    row = columns.cells(EventRow(texts.of(7)))
    assert sum(cells(text) + 1 for _, text in row) <= width
    assert {"index", "mark"} <= {column.name for column, _ in row}


@pytest.mark.parametrize("width", range(10, 200))
def test_a_column_that_does_not_fit_is_followed_by_what_it_did_alone(width: int) -> None:
    names = [column.name for column, _ in layout(ListSpace(width, 5, 12, 12), {}).columns]
    every = [column.name for column, _ in layout(ListSpace(300, 5, 12, 12), {}).columns]
    assert names == every[: len(names) - 1] + every[-1:] or names == every[: len(names)]


def test_a_column_is_one_line_of_the_table(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    letters = EventColumn(
        "length", "length", width=lambda _: 6, text=lambda row, _: str(len(row.event.node))
    )
    monkeypatch.setattr(columns_module, "COLUMNS", (letters, *columns_module.COLUMNS))
    found = layout(ListSpace(80, 5, 12, 12), {})
    assert found.header().startswith(" length ")
    assert found.cells(EventRow(EventTexts(run).of(3)))[0][1] == "9     "


def test_rows_say_what_happened(run: Run) -> None:
    texts = EventTexts(run)
    timer, received = texts.of(2), texts.of(3)
    assert (timer.node, timer.kind, timer.entity, timer.outputs) == (
        "/talker",
        "timer",
        "tick",
        "/count",
    )
    assert (received.node, received.kind, received.entity) == ("/listener", "sub", "/count")
    last = texts.of(run.count - 1)
    assert last.raised
    assert last.outputs == "exception ValueError: too many"
    assert any("log INFO received" in texts.of(i).outputs for i in range(40))


def test_index_at_finds_the_first_event_at_a_time_or_later(long_run: Run) -> None:
    run = long_run
    stamps = np.concatenate([part["stamp"] for part in run.trace.events()])
    for stamp in [0, int(stamps[0]), int(stamps[5000]), int(stamps[5000]) + 1, int(stamps[-1])]:
        assert run.index_at(stamp) == int(np.searchsorted(stamps, np.uint64(stamp)))
    assert run.index_at(2**63) == run.count - 1


def test_effects_are_exactly_the_events_with_that_cause(long_run: Run) -> None:
    run = long_run
    causes = np.concatenate([part["cause_event"] for part in run.trace.events()])
    # Around the borders of segments, where effects are in the next one.
    first = int(run.segments["first_event"][1])
    for index in [*range(10), *range(first - 8, first + 4), run.count - 1]:
        *_, found = effects_of(run, index)
        assert found.done
        assert list(found.found) == np.flatnonzero(causes == np.uint64(index)).tolist()


def test_find_goes_both_ways_and_leaves_out_where_it_starts(long_run: Run) -> None:
    run = long_run
    condition = conditions.OfEntities(conditions.ids([4]))
    entities = np.concatenate([part["entity"] for part in run.trace.events()])
    wanted = np.flatnonzero(entities == 4)
    start = int(wanted[5000])
    after = [i for i in conditions.find(run, condition, start, 1) if i is not None]
    before = [i for i in conditions.find(run, condition, start, -1) if i is not None]
    assert after == wanted[5001:].tolist()
    assert before == wanted[:5000][::-1].tolist()


def test_filtered_rows_map_both_ways(long_run: Run) -> None:
    run = long_run
    condition = conditions.OfEntities(conditions.ids([4]))
    rows = FilteredRows([(run, condition, False)], OneRun(run.count))
    assert rows.count == 0
    while not rows.done:
        rows.advance()
    entities = np.concatenate([part["entity"] for part in run.trace.events()])
    wanted = np.flatnonzero(entities == 4).tolist()
    assert [rows.at(row) for row in range(rows.count)] == wanted
    for place in [0, wanted[0], wanted[700], wanted[700] + 1, wanted[-1], run.count - 1]:
        expected = next((i for i, w in enumerate(wanted) if w >= place), len(wanted) - 1)
        assert rows.near(place) == expected


def test_lanes_show_every_event_whatever_the_window(long_run: Run) -> None:
    run = long_run
    lanes = LaneWindow([run])
    maker = lanes.makers[0]
    for number in maker.order():
        maker.summarise(number)
    assert sorted(maker.order()) == list(range(len(run.segments)))
    made = lanes.lanes(OneRun(run.count), 0, (0, 0), 60)
    assert made.known == 1.0
    assert [lane.label for lane in made.lanes] == ["/talker", "/listener", "(run)"]
    assert all(any(lane.levels) for lane in made.lanes)
    last = made.window.column(run.end_ns - run.base_ns, 60)
    assert made.lanes[1].signs == {last: "!"}
    total = maker.count(made.window, 60).counts.sum()
    assert total == pytest.approx(run.count, rel=0.001)
    # A narrow window is made of the events themselves.
    stamp = run.stamp(1000)
    exact = maker.count(Window(stamp, stamp + 1), 1)
    assert exact.counts[0].tolist() == [1.0]


def test_zooming_in_ends_at_single_events_and_out_at_the_whole_run(long_run: Run) -> None:
    run = long_run
    lanes = LaneWindow([run])
    for _ in range(60):
        lanes.zoom(1, (0, 15_000), 80)
    assert lanes.window.order
    made = lanes.lanes(OneRun(run.count), 15_000, (0, 15_000), 80)
    column = made.window.column(15_000, 80)
    assert sum(lane.letters[column] != " " for lane in made.lanes) == 1
    for _ in range(60):
        lanes.zoom(-1, (0, 15_000), 80)
    assert lanes.window == lanes.whole


@pytest.mark.parametrize("columns", [1, 7, 80])
@pytest.mark.parametrize("length", [80, 81, 1234567])
def test_columns_and_positions_of_a_window_agree(columns: int, length: int) -> None:
    window = Window(1000, 1000 + length)
    for column in range(columns):
        assert window.column(window.at(column, columns), columns) == column


def test_history_goes_back_and_forward() -> None:
    history = VisitedEvents()
    first, second = (False, 1), (True, 5)
    history.leave(first)
    history.leave(second)
    assert history.back((False, 9)) == second
    assert history.back(second) == first
    assert history.back(first) is None
    assert history.forward(first) == second
    history.leave(second)
    assert history.forward((False, 7)) is None


def test_a_mark_is_that_of_all_events_in_a_row() -> None:
    marks = Bookmarks()
    row = [(False, 3), (True, 4)]
    assert marks.toggle(row)
    assert [marks.of([event]) for event in [*row, (True, 3)]] == [True, True, False]
    assert not marks.toggle(row[1:])
    assert marks.of(row[:1])


def test_the_inspector_decodes_input_and_outputs(run: Run) -> None:
    *_, effects = effects_of(run, 2)
    lines = inspect(run, 2, Openness(), effects)
    assert any(line.label == "data" for line in lines)
    links = [line.link for line in lines if line.link is not None]
    assert links == [3]
    received = inspect(run, 3, Openness())
    assert [line.link for line in received if line.link is not None] == [2]
    assert next(line for line in received if line.label == "input").value.startswith("/count")


def test_what_is_open_stays_open_from_event_to_event(run: Run) -> None:
    openness = Openness()
    assert not any(line.label == "chain hash" for line in inspect(run, 2, openness))
    openness.toggle("details")
    for index in (2, 4):
        assert any(line.label == "chain hash" for line in inspect(run, index, openness))


def test_every_event_can_be_inspected(run: Run) -> None:
    openness = Openness({"details", "parameters"})
    for index in range(run.count):
        lines = inspect(run, index, openness)
        assert lines
        assert not [line for line in lines if line.path.startswith("error")]
        paths = [line.path for line in lines]
        assert len(set(paths)) == len(paths)


def test_an_exception_shows_its_traceback(run: Run) -> None:
    lines = inspect(run, run.count - 1, Openness())
    assert any("ValueError: too many" in line.value and line.role is Role.FIELD for line in lines)
    assert int(run.row(run.count - 1)["cause_event"]) == NO_EVENT


@pytest.mark.parametrize(
    ("text", "ns"),
    [("1.5", 1_500_000_000), ("20ms", 20_000_000), ("3us", 3000), ("7 ns", 7), (".5s", 5 * 10**8)],
)
def test_times(text: str, ns: int) -> None:
    assert parse_stamp(text) == ns


@pytest.mark.parametrize("text", ["", "abc", "1.5x", "-3", "--", "9" * 400])
def test_what_is_no_time(text: str) -> None:
    with pytest.raises(ValueError, match=r"time|unit|large"):
        parse_stamp(text)


@pytest.mark.parametrize("two", [False, True])
def test_no_line_of_help_is_wider_than_its_column(two: bool) -> None:
    # Border, padding and scrollbar take 6: a line that is wrapped breaks all columns.
    for width in (118, 130, 200):
        assert max(line.cell_length for line in help_text(width, two=two).split("\n")) <= width - 6
    narrow = help_text(80, two=two).split("\n")
    assert max(line.cell_length for line in narrow) <= 62


def test_a_callback_that_goes_on_later_says_that_it_waits() -> None:
    sample = Path(__file__).parents[2] / "sample_traces" / "delayed_input" / "a.mcap"
    with Trace.open(sample) as trace:
        texts = EventTexts(Run(trace))
        assert [texts.of(index).outputs for index in (249, 250)] == [
            "/pose",
            "waits",
        ]
