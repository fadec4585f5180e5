"""What the screens say of two runs is what the two traces say, read with the mcap package alone.

In the mode of one run its events stand there, all of them, in its order, with its numbers, times
and values, and nothing of the other. In the mode of both every event of both stands there, each run
in its order; a row that differs has both values; what moved points to its other place.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
from textual._compositor import Compositor

from campaigns.attack import mcap_parts
from rsltrace.diff import diff_files
from rsltrace.diff.options import DiffOptions
from tests.pages.page import MARKUP, Page, aligned_rows, check_page, contained, with_names
from tests.viewer.raw_trace import Event, read
from tests.viewer.shown_rows import NUMBER, Row, check_both_runs, check_one_run, rows_on

Drive = Callable[..., None]
SAMPLES = Path(__file__).parents[2] / "sample_traces"
NAMES = ("schedule", "delayed_input", "missing_event", "nondeterministic_callback")
MS = 1_000_000


@pytest.fixture(autouse=True)
def _no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compose nothing for the terminal that is not there: that takes most of the time."""
    monkeypatch.setattr(Compositor, "render_update", lambda self, **_: self._dirty_regions.clear())


def screens(drive: Drive, pair: tuple[Path, Path]) -> tuple[list[list[Row]], list[list[Event]]]:
    """Return the rows of the modes of both, a and b, on a screen that holds all of them, and the
    events of the two traces."""
    traces = [read(path) for path in pair]
    height = sum(map(len, traces)) + 60
    found = []

    async def steps(viewer: Any) -> None:
        for _ in range(3):
            found.append(rows_on(viewer.text))
            await viewer.press("o")

    drive(pair, steps, size=(300, height))
    return found, traces


async def whole_list(viewer: Any) -> list[Row]:
    """Return the rows of the list of events, read a page at a time from the first to the last."""
    await viewer.press("home")
    rows = rows_on(viewer.text)
    while True:
        await viewer.press("pagedown")
        page = rows_on(viewer.text)
        first = next((n for n, row in enumerate(rows) if row.numbers == page[0].numbers), len(rows))
        again = len(rows) - first
        assert [row.numbers for row in rows[first:]] == [row.numbers for row in page[:again]]
        if again == len(page):
            return rows
        rows += page[again:]


def check_everywhere(drive: Drive, pair: tuple[Path, Path], folder: Path) -> None:
    """Check every row of a pair on screens of three sizes, in Rerun's recording and on the page."""
    a, b = map(read, pair)
    rows: list[Row] = []

    async def steps(viewer: Any) -> None:
        check_both_runs(rows_on(viewer.text), a, b)
        await viewer.press("z")
        for width, height in ((80, 24), (120, 40), (200, 60)):
            await viewer.resize(width, height)
            shown = await whole_list(viewer)
            check_both_runs(shown, a, b)
            assert not rows or [row.numbers for row in shown] == [row.numbers for row in rows]
            rows[:] = shown
        for own in (a, b):
            await viewer.press("o")
            check_one_run(await whole_list(viewer), own)

    drive(pair, steps, size=(80, 24))
    for side, own in enumerate((a, b)):
        assert len([row for row in rows if row.numbers[side] is not None]) == len(own)
    check_recording([row.numbers for row in rows], pair, (a, b), folder / "pair.rrd")
    on_page = check_page(page_of(pair), a, b)
    shown = [row for row in rows if row.numbers in [one.numbers for one in on_page]]
    assert [(row.sign, row.numbers) for row in on_page] == [(r.sign, r.numbers) for r in shown]


def page_of(pair: tuple[Path, Path]) -> str:
    """Return what ``rsltrace diff --format html`` prints."""
    from rsltrace_viewer.pages.diff_page import diff_page

    return diff_page([diff_files(*map(str, pair))], DiffOptions())


def check_recording(
    rows: list[tuple[int | None, ...]],
    pair: tuple[Path, Path],
    events: tuple[list[Event], list[Event]],
    output: Path,
) -> None:
    """Check that a recording has the rows of the screen, and the events and values of the runs."""
    pytest.importorskip("rerun")
    from rsltrace_viewer.rerun_export.export import export

    from tests.rerun.recording import Recording

    export(pair, output)
    both = Recording(output)
    assert both.timelines == {"sim_time", "row"}
    for side, own in enumerate(events):
        table = sorted(both.rows[f"/run_{'ab'[side]}/events"], key=lambda row: row["row"])
        assert [row["number"] for row in table] == [[event.index] for event in own]
        assert [row["sim_time"] for row in table] == [event.stamp_ns for event in own]
        numbers = {row["row"]: row["number"][0] for row in table}
        assert numbers == {
            place: row[side] for place, row in enumerate(rows) if row[side] is not None
        }
        lanes = [path for path in both.rows if re.fullmatch(f"/lanes/.*/{'ab'[side]}", path)]
        busy = [
            row["row"]
            for path in lanes
            for row in both.rows[path]
            if row.get("row") is not None and row["StateChange:state"] != [""]
        ]
        assert sorted(busy) == sorted(numbers), "an event is in one lane, in its row"
        for path, found in both.rows.items():
            curve = re.fullmatch(rf"/run_{'ab'[side]}/topics/(?!rsltrace).*", path)
            for row in found if curve else ():
                values = numbers_of(own[numbers[row["row"]]], path.split("/topics")[1])
                for value in row.get("Scalars:scalars") or ():
                    assert value in values or value != value, (path, row)


def numbers_of(event: Event, place: str) -> set[float]:
    """Return the numbers that an event sent in a field, by its place in a recording."""
    found = set()
    for message in event.outputs:
        name, field = place[: len(message.name)], place[len(message.name) + 1 :]
        for path, value in message.leaves or () if name == message.name else ():
            names = re.sub(r"\[\d+\]", "", path)
            if f".{field}." in f"..{names}." and NUMBER.fullmatch(value):
                found.add(float(value))
    return found


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "missing_event" else pytest.mark.long)
        for name in NAMES
    ],
)
def test_samples_everywhere(drive: Drive, name: str, tmp_path: Path) -> None:
    check_everywhere(drive, (SAMPLES / name / "a.mcap", SAMPLES / name / "b.mcap"), tmp_path)


@pytest.fixture(scope="session")
def faults() -> list[str]:
    """Fifty of the faults that ``make truth`` plants."""
    pytest.importorskip("rclpy")
    from campaigns.truth import faults

    faults.load()
    names = [name for name in faults.FAULTS if faults.FAMILIES[name] != "recordings"]
    return names[:: len(names) // 50]


@pytest.mark.long
@pytest.mark.ros
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # files left open
@pytest.mark.parametrize("number", [0, 13, *(n for n in range(50) if n not in (0, 13))])
def test_planted_pairs_everywhere(
    drive: Drive, faults: list[str], number: int, tmp_path: Path
) -> None:
    """Also where every name is markup: nothing but the names is another on the page."""
    from campaigns.truth.campaign import try_case

    try_case(faults[number], 0, tmp_path)
    pair = tmp_path / "a.mcap", tmp_path / "b.mcap"
    check_everywhere(drive, pair, tmp_path)
    pages = []
    for extra in ("", MARKUP, "x" * len(MARKUP)):
        named = tmp_path / f"a{len(pages)}.mcap", tmp_path / f"b{len(pages)}.mcap"
        for path, output in zip(pair, named, strict=True):
            parts = mcap_parts.take_apart(path.read_bytes())
            with_names(parts, extra)
            output.write_bytes(mcap_parts.put_together(parts))
        text = page_of(named)
        contained(text)
        pages.append(Page(text))
    assert pages[1].tags == pages[2].tags
    plain, hostile = (
        [(r.sign, r.numbers, r.time_ns, r.delta, r.text.replace(MARKUP, "")[:20]) for r in rows]
        for rows in map(aligned_rows, pages[:2])
    )
    assert plain == hostile


@pytest.mark.parametrize(
    "name", [*(pytest.param(name, marks=pytest.mark.long) for name in NAMES[:2]), *NAMES[2:]]
)
def test_samples(drive: Drive, name: str) -> None:
    both, (a, b) = screens(drive, (SAMPLES / name / "a.mcap", SAMPLES / name / "b.mcap"))
    counts = check_both_runs(both[0], a, b)
    compared = check_one_run(both[1], a), check_one_run(both[2], b)
    if name == "missing_event":
        assert counts["only"] > 30
    else:
        assert counts["values"] > 20
    assert min(compared) > 10 or name == "schedule"  # whose messages are single numbers
    assert (counts["moved"] > 100) == (name == "schedule")


@pytest.fixture(scope="session")
def simulator() -> Any:
    """The simulator that the tests of diff have."""
    if "diff_simulator" not in sys.modules:
        path = Path(__file__).parents[1] / "diff" / "simulate.py"
        spec = spec_from_file_location("diff_simulator", path)
        assert spec is not None
        assert spec.loader is not None
        sys.modules["diff_simulator"] = module = module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules["diff_simulator"]


CASES = {
    "order": ("swap", {"which": 1}),
    "value": ("bit", {}),
    "missing": ("drop", {}),
    "more": ("extra", {}),
    "late": ("late", {"delay_ns": 5 * MS}),
}


@pytest.mark.few(2)
@pytest.mark.parametrize("case", [*CASES, "many moves"])
def test_constructed_pairs(drive: Drive, simulator: Any, tmp_path: Path, case: str) -> None:
    plan = simulator.NodePlan
    sent = simulator.Publication
    whole = simulator.Plan(
        (
            plan("/source", timers=((10 * MS, (sent("/a"),)),)),
            plan("/left", subscriptions=(("/a", (sent("/l"),)),), timers=((10 * MS, ()),)),
            plan("/right", subscriptions=(("/a", (sent("/r"),)),)),
            plan("/sum", subscriptions=(("/l", (sent("/s"),)), ("/r", (sent("/s"),)))),
        ),
        end_ns=200 * MS,
    )
    clean = simulator.Simulation(whole, tmp_path / "a.mcap").run()
    first = next(
        event.index
        for event in clean.log
        if event.index > 30
        and event.node == ("/source" if case == "late" else "/left")
        and event.name == ("tick" if case == "late" else "/a")
    )
    if case == "many moves":
        ticks = [e.index for e in clean.log if e.index > 30 and e.name == "/a"][::2]
        faults = [simulator.Fault("swap", index, which=1) for index in ticks]
    else:
        kind, more = CASES[case]
        faults = [simulator.Fault(kind, first, **more)]
    simulator.Simulation(whole, tmp_path / "b.mcap", tuple(faults)).run()
    found, (a, b) = screens(drive, (tmp_path / "a.mcap", tmp_path / "b.mcap"))
    counts = check_both_runs(found[0], a, b)
    pair = tmp_path / "a.mcap", tmp_path / "b.mcap"
    check_recording([row.numbers for row in found[0]], pair, (a, b), tmp_path / "pair.rrd")
    assert check_one_run(found[1], a) > 20
    assert check_one_run(found[2], b) > 20
    expected = {
        "order": "moved",
        "many moves": "moved",
        "value": "values",
        "missing": "only",
        "more": "only",
        "late": "moved",
    }
    assert counts[expected[case]] >= (10 if case == "many moves" else 1), json.dumps(counts)


@pytest.mark.parametrize("size", [(80, 24), (120, 40), (200, 60)])
def test_a_difference_can_be_read_in_every_size(drive: Drive, size: tuple[int, int]) -> None:
    """Also at 80 columns both numbers, the place in the other run and both values are there."""
    folder = SAMPLES / "schedule"

    async def steps(viewer: Any) -> None:
        if size == (80, 24):
            await viewer.press("z")
        lines = viewer.text.splitlines()
        here, there = (line for line in lines if "-1.148 → -0.5748" in line)
        assert re.match(r">≠ +5 +0.020000", here)
        assert "↓ a 7" in here
        assert re.match(r" ≠ +7 +0.020000", there)
        assert "↑ b 5" in there

    drive((folder / "a.mcap", folder / "b.mcap"), steps, size=size)


@pytest.mark.long
def test_what_depends_on_rows_stands_on_events_of_the_run_that_is_shown(drive: Drive) -> None:
    folder = SAMPLES / "schedule"
    pair = folder / "a.mcap", folder / "b.mcap"
    a, b = (read(path) for path in pair)

    async def steps(viewer: Any) -> None:
        app, session = viewer.app, viewer.app.session

        def selected() -> tuple[bool, int]:
            run, index = session.current()
            return run is session.b, index

        # Both: the row of b alone comes first, its link leads to the same event of a.
        assert selected() == (True, 5)
        await viewer.press("enter")
        while "stands below" not in app.inspector.current.value:
            await viewer.press("down")
        await viewer.press("enter")
        assert selected() == (False, 7)
        await viewer.press("b", "escape")
        assert selected() == (True, 5)
        # b alone: the next event of the node, a filter, a search, a number, a time, a mark.
        await viewer.press("o", "o")
        assert selected() == (True, 5)
        await viewer.press("m", "right_square_bracket")
        assert "controller" in session.own_lane()
        after = selected()[1]
        assert after > 5
        await viewer.press("i")
        await viewer.type("100")
        assert selected() == (True, 100)
        await viewer.press("t")
        await viewer.type("1")
        first = next(event.index for event in b if event.stamp_ns >= 10**9)
        assert selected() == (True, first)
        await viewer.press("quotation_mark")
        assert selected() == (True, 5)
        await viewer.press("F")
        await viewer.type("node:/controller kind:timer")
        shown = [row.numbers[0] for row in rows_on(viewer.text)]
        kinds = {int(session.b.row(index)["kind"]) for index in shown if index is not None}
        assert kinds == {2}
        await viewer.press("o")  # both, with the filter: the timers of both
        assert session.filter_text
        places = [session.rows.at(row) for row in range(session.rows.count)]
        for name, run in session.runs.items():
            events = {session.view.a(p) if name == "a" else session.view.b(p) for p in places}
            wanted = {
                index
                for index in range(run.count)
                if int(run.row(index)["kind"]) == 2
                and run.node_name(int(run.row(index)["entity"])) == "/controller"
            }
            assert events - {None} >= wanted
        assert len(places) == len(set(places))
        assert places == sorted(places)
        assert len(a) == session.a.count

    drive(pair, steps, size=(200, 60))
