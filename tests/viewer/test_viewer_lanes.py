"""Lanes without aliasing: what comes at a steady rate looks steady at every zoom and width."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rsltrace_viewer.model.lane_maker import LaneMaker, LaneWindow
from rsltrace_viewer.model.lanes import Lanes, axis_text, drawn
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.view import (
    OneRun,
    Window,
    ends_of,
    fine_step_from,
    spread,
    step_below,
    step_from,
)

from rsltrace.trace.model.texts import format_seconds

_S = 1_000_000_000


@given(st.integers(1, 10**15))
def test_steps_are_one_two_or_five(least: int) -> None:
    step = step_from(least)
    assert step >= least > step_below(step) or least == 1
    assert str(step).rstrip("0") in ("1", "2", "5")


@given(st.integers(20, 10**15))
def test_a_fine_step_is_hardly_longer_than_needed(least: int) -> None:
    step = fine_step_from(least)
    assert least <= step <= least * 1.1 + 1
    assert fine_step_from(step_from(least)) == step_from(least)  # zooming keeps its steps


@given(st.floats(0.5, 1000), st.integers(40, 200))
def test_a_whole_run_fills_the_lanes(length_s: float, columns: int) -> None:
    run = Window(0, round(length_s * _S))
    assert run.fitted(columns).length <= run.length * 1.1


@given(st.integers(30, 150), st.booleans(), st.floats(-0.5, 1.5), st.sets(st.integers(0, 149)))
@example(63, False, 0.4, set(range(30, 63)))
@example(63, False, 0.9, set(range(63)))
@example(63, False, 0.0, {61})
def test_marks_do_not_cover_what_the_axis_says(
    columns: int, order: bool, at: float, marks: set[int]
) -> None:
    window = Window(0, columns if order else 31 * _S // 10, order)
    position = int(window.end * at)
    cursor, marks = window.column(position, columns), {m for m in marks if m < columns}
    line = axis_text(Lanes(window, columns, ()), position, cursor, marks)
    assert len(line) == columns
    assert ("≠" in line) == bool(marks) or "▲" in line
    here = f"{position}" if order else f"{format_seconds(position)[:-3]} s"
    told = [rf"▲ {here}|{here} ▲", "event 0", str(window.end - 1), "0.000 s", "3.100 s"]
    told += ["one column is one event", r"[\d.]+ ms per column"]
    assert set(re.sub(rf"(?<!\S)({'|'.join(told)})(?!\S)", "", line)) <= {" ", "≠"}
    assert ("▲" in line) == (0 <= cursor < columns)


@given(st.integers(0, 2 * 10**18), st.integers(1, 10**14), st.integers(1, 400))
def test_windows_hold_all_in_columns_of_whole_steps(start: int, length: int, columns: int) -> None:
    fitted = Window(start, start + length).fitted(columns)
    step = fitted.step(columns)
    assert step * columns == fitted.length
    assert fine_step_from(step) == step
    assert fitted.start % step == 0
    assert fitted.start <= start
    assert start + length <= fitted.end
    assert fitted.fitted(columns) == fitted
    assert all(fitted.column(fitted.at(c, columns), columns) == c for c in range(columns))


_RATES = st.one_of(
    st.sampled_from([0.5, 1, 5, 7, 10, 15, 24, 25, 30, 50, 60, 100, 200, 400, 1000]),
    st.floats(0.05, 3000),
)


@given(
    rate=_RATES,
    columns=st.integers(20, 250),
    columns_per_event=st.floats(0.01, 12),
    offset=st.floats(0, 1),
)
@example(rate=30, columns=60, columns_per_event=0.66, offset=0.0)
@example(rate=10, columns=60, columns_per_event=1.0, offset=0.3)
@settings(deadline=None)
def test_a_steady_sensor_looks_steady(
    rate: float, columns: int, columns_per_event: float, offset: float
) -> None:
    """Either all columns are as high, or events stand apart, evenly to within a column."""
    period = round(_S / rate)
    step = step_from(max(round(period / columns_per_event), 1))
    stamps = np.arange(0, columns * step + 20 * period, period) + round(offset * period)
    starts = (stamps - 10 * period).astype(np.float64)
    ones = np.ones(len(starts))
    counts = spread(starts, ends_of(starts, ones), ones, step, columns, exact=True)
    if period <= 4 * step:
        assert counts.max() - counts.min() <= 2e-6
        assert counts[0] == pytest.approx(step / period, abs=1e-5)
    else:
        assert set(counts.tolist()) <= {0.0, 1.0}
        gaps = np.diff(np.flatnonzero(counts))
        assert not len(gaps) or gaps.max() - gaps.min() <= 1


def test_silence_is_seen_and_bursts_are() -> None:
    starts = np.concatenate((np.arange(50), np.arange(80, 130))).astype(np.float64) * 1e8
    ones = np.ones(len(starts))
    counts = spread(starts, ends_of(starts, ones), ones, _S, 13, exact=True)
    assert counts.tolist() == [10] * 5 + [0] * 3 + [10] * 5
    instants = np.array([0.0, 4.5e9])
    counts = spread(
        instants, ends_of(instants, np.array([1.0, 30.0])), np.array([1.0, 30.0]), _S, 6, exact=True
    )
    assert counts.tolist() == [1, 0, 0, 0, 30, 0]


@pytest.mark.parametrize("columns", [30, 61, 110, 180])
def test_a_steady_run_is_drawn_steadily_at_every_zoom(steady: Run, columns: int) -> None:
    lanes = LaneWindow([steady])
    maker = lanes.makers[0]
    for number in maker.order():
        maker.summarise(number)
    view = OneRun(steady.count)
    middle = steady.count // 2
    seen = set()
    while not lanes.window.order:
        made = lanes.lanes(view, middle, (0, middle), columns)
        step = made.window.step(columns)
        assert step not in seen
        seen.add(step)
        ends = (one - steady.base_ns for one in (steady.start_ns, steady.end_ns))
        first, last = (made.window.column(one, columns) for one in ends)
        for lane in made.lanes:
            if lane.label == "(run)":
                continue
            inside = lane.levels[max(first + 1, 0) : min(last, columns)]
            gaps = np.diff(np.flatnonzero(inside))
            spaced = len(gaps) and gaps.min() >= 4 and gaps.max() - gaps.min() <= 1
            assert len(set(inside)) <= 1 or spaced, (lane.label, step, lane.levels)
        lanes.zoom(1, (0, middle), columns)
    assert len(seen) > 5


def test_both_runs_are_drawn_to_one_scale(steady: Run, run: Run) -> None:
    makers = [LaneMaker(steady), LaneMaker(run)]
    for maker in makers:
        for number in maker.order():
            maker.summarise(number)
    window = makers[0].whole.fitted(60)
    counted = [maker.count(window, 60) for maker in makers]
    made = drawn(window, 60, list(zip("ab", counted, strict=True)))
    labels = [(lane.label, lane.run) for lane in made.lanes if lane.label != "(run)"]
    assert labels[:3] == [("/cam", "a"), ("/lidar", "a"), ("/talker", "b")]
    assert max(max(lane.levels) for lane in made.lanes) == 8


@pytest.fixture(scope="module")
def steady(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Forty thousand events of a camera of 30 Hz and a lidar of 10 Hz that calls back twice."""
    from trace_maker import Opened

    from rsltrace.trace.model.entity import EntityKind
    from rsltrace.trace.model.event import EventKind

    path: Path = tmp_path_factory.mktemp("steady") / "steady.mcap"
    with Opened(path) as feeder:
        timers = []
        for name, count in (("/cam", 1), ("/lidar", 2)):
            node = feeder.entity(EntityKind.NODE, name)
            timers += [feeder.entity(EntityKind.TIMER, f"t{n}", node=node) for n in range(count)]
        thirtieth = 33_333_333
        due = [(n * thirtieth, timers[0]) for n in range(20_000)]
        due += [(n * 100_000_000 + 7, timers[1]) for n in range(6_667)]
        due += [(n * 100_000_000 + 2_000_000, timers[2]) for n in range(6_667)]
        for stamp, timer in sorted(due):
            feeder.event(EventKind.TIMER, timer, 10 * _S + stamp)
        feeder.writer.close(result={"stop_reason": "done", "exit_code": "0"})
    opened = Run.open(path)
    yield opened
    opened.close()
