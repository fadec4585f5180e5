"""The app as its user drives it: every key, the mouse, resizing, questions, two traces."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rsltrace_viewer.model.plots.series import Series
from rsltrace_viewer.model.query.conditions import ANY_LOG, find
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.terminal import screenshot
from rsltrace_viewer.terminal.app import ViewerApp
from rsltrace_viewer.terminal.keys import KEYS, LOOK, MOVE
from rsltrace_viewer.terminal.screens.help import HelpScreen
from rsltrace_viewer.terminal.screens.plot import PlotScreen, PlotView
from rsltrace_viewer.terminal.screens.report import ReportScreen
from rsltrace_viewer.terminal.widgets.bars import FooterBar
from rsltrace_viewer.terminal.widgets.inspector import Inspector
from rsltrace_viewer.terminal.widgets.lanes import LanesView
from rsltrace_viewer.terminal.widgets.timeline import Timeline
from textual import events, timer

Drive = Callable[..., None]
Steps = Callable[[Any], Awaitable[None]]


def test_stepping_and_edges(made: Path, run: Run, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        assert viewer.place == 0
        await viewer.press("down", "j")
        assert viewer.place == 2
        await viewer.press("up", "k", "k")
        assert viewer.place == 0
        page = viewer.app.timeline.page
        await viewer.press("pagedown", "space")
        assert viewer.place == 2 * page
        await viewer.press("pageup")
        assert viewer.place == page
        await viewer.press("end")
        assert viewer.place == run.count - 1
        assert "ValueError: too many" in viewer.text
        await viewer.press("home", "G")
        assert viewer.place == run.count - 1

    drive(made, steps)


@pytest.mark.long
def test_the_inspector_follows_an_event_that_gets_another_place(
    pair: tuple[Path, Path], drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A block of the comparison arrives between a step and what the inspector shows of it."""
    inspected = []
    monkeypatch.setattr(
        ViewerApp, "_show_inspector", lambda app, **_: inspected.append(app.session.place)
    )

    async def steps(viewer: Any) -> None:
        viewer.app.go(3)
        viewer.app.session.place = 5
        for _ in range(20_000):  # ten minutes
            await asyncio.sleep(0.03)
            if not viewer.app.busy:
                break
        assert not viewer.app.busy
        assert inspected[-1] == 5

    drive(pair, steps)


@pytest.mark.long
def test_the_cursor_is_always_in_sight(long: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        timeline = viewer.app.timeline

        def visible() -> bool:
            top = round(timeline.scroll_y)
            return bool(top <= timeline.cursor < top + timeline.page)

        for keys in (["pagedown"] * 3, ["j"] * 5, ["end"], ["k"] * 4, ["pageup"] * 2, ["home"]):
            for key in keys:
                await viewer.press(key)
                assert visible()
        assert f"{viewer.app.session.a.count:,}" in viewer.text

    drive(long, steps)


@pytest.mark.long
def test_same_node_entity_and_topic(made: Path, run: Run, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("i")
        await viewer.type("2")
        assert viewer.place == 2  # the timer of /talker
        await viewer.press("right_curly_bracket")
        second = viewer.place
        assert run.row(second)["entity"] == run.row(2)["entity"]
        await viewer.press("left_curly_bracket")
        assert viewer.place == 2
        await viewer.press("right_parenthesis")
        assert viewer.place == 3  # its subscription is on the same topic
        await viewer.press("left_parenthesis")
        assert viewer.place == 2
        await viewer.press("right_square_bracket")
        assert run.node_name(int(run.row(viewer.place)["entity"])) == "/talker"
        await viewer.press("left_square_bracket", "left_square_bracket")
        assert viewer.place == 0
        await viewer.press("left_square_bracket")
        assert "no earlier event of /talker" in viewer.text

    drive(made, steps)


@pytest.mark.long
def test_cause_effects_and_the_way_back(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("j", "j", "e")
        assert viewer.place == 3
        await viewer.press("c")
        assert viewer.place == 2
        await viewer.press("c")
        assert "no other event caused this one" in viewer.text
        await viewer.press("b")
        assert viewer.place == 3
        await viewer.press("backspace")
        assert viewer.place == 2
        await viewer.press("f")
        assert viewer.place == 3

    drive(made, steps)


@pytest.mark.long
def test_exceptions_logs_warnings_and_findings(made: Path, run: Run, drive: Drive) -> None:
    logs = [i for i in find(run, ANY_LOG, -1, 1) if i is not None]

    async def steps(viewer: Any) -> None:
        await viewer.press("l")
        assert viewer.place == logs[0]
        await viewer.press("l", "L")
        assert viewer.place == logs[0]
        await viewer.press("x")
        assert viewer.place == run.count - 1
        await viewer.press("x")
        assert "no later exception" in viewer.text
        await viewer.press("X")
        assert "no earlier exception" in viewer.text
        for key, what in (("w", "later warning"), ("W", "earlier warning")):
            await viewer.press(key)
            assert f"no {what}" in viewer.text
        for key, what in (("u", "later finding"), ("U", "earlier finding")):
            await viewer.press(key)
            assert f"no {what} of the guard" in viewer.text

    drive(made, steps)


@pytest.mark.long
def test_an_event_is_shown_on_a_machine_that_is_late(
    made: Path, drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Textual's own timers for one call are lost where a second passes before they start."""
    monkeypatch.setattr(screenshot, "_SETTLE_S", 20.0)

    async def steps(viewer: Any) -> None:
        seconds = count(1)
        monkeypatch.setattr(timer, "_time", SimpleNamespace(get_time=lambda: next(seconds)))
        await viewer.press("j")
        assert not viewer.app.busy

    drive(made, steps)


@pytest.mark.long
def test_marks(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("j", "m", "j", "j", "m", "home", "apostrophe")
        assert viewer.place == 1
        assert "*" in viewer.text
        await viewer.press("apostrophe")
        assert viewer.place == 3
        await viewer.press("quotation_mark")
        assert viewer.place == 1
        await viewer.press("m", "home", "apostrophe")
        assert viewer.place == 3

    drive(made, steps)


@pytest.mark.long
def test_going_to_a_time_and_an_index(made: Path, run: Run, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("t")
        await viewer.type("1.5s")
        assert run.stamp(viewer.place) >= 11_500_000_000 > run.stamp(viewer.place - 1)
        await viewer.press("t")
        await viewer.type("nonsense")
        assert viewer.app.prompt.asking
        assert "expected a time" in viewer.text
        await viewer.press("escape")
        assert not viewer.app.prompt.asking
        await viewer.press("i")
        await viewer.type("1,000,000")
        assert viewer.app.prompt.asking
        assert f"no event 1000000 (events: 0 to {run.count - 1})" in viewer.text
        await viewer.press("escape")
        await viewer.press("i")
        await viewer.type(f"{run.count - 1}")
        assert viewer.place == run.count - 1

    drive(made, steps)


@pytest.mark.long
def test_searching(made: Path, run: Run, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("n")
        assert "nothing is searched" in viewer.text
        await viewer.press("slash")
        await viewer.type("kind:srv")
        first = viewer.place
        assert run.row(first)["kind"] == 4
        await viewer.press("n")
        assert viewer.place > first
        await viewer.press("N")
        assert viewer.place == first
        await viewer.press("N")  # around the end
        assert viewer.place > first
        await viewer.press("escape")
        assert viewer.app.session.search is None

    drive(made, steps)


@pytest.mark.long
def test_typing_fast_goes_into_the_question(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        names = {"/": "slash", ":": "colon", "\r": "enter", "\t": "tab", "\x1b": "escape"}

        async def burst(text: str) -> None:  # no pause: as a fast hand does it
            for key in text:
                viewer.app.post_message(events.Key(names.get(key, key), key))
            await viewer.settle()

        await burst("Fkind:srv\r")
        assert viewer.app.session.filter_text == "kind:srv"
        await viewer.press("escape")
        await burst("Fno\t/lis\t\r")
        assert viewer.app.session.filter_text == "node:/listener"
        await viewer.press("escape")
        await burst("i10\rjj")
        assert viewer.place == 12
        await burst("t1\x1bk")
        assert viewer.place == 11
        await burst("/kind:srv\rnN")
        assert viewer.app.session.search_text == "kind:srv"

    drive(made, steps)


def test_filtering(made: Path, run: Run, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("F")
        await viewer.type("kind:timer")
        kinds = {int(run.row(viewer.app.session.rows.at(row))["kind"]) for row in range(20)}
        assert kinds == {2}
        assert "filter:" in viewer.text
        await viewer.press("j")
        assert run.row(viewer.place)["kind"] == 2
        await viewer.press("escape")
        assert viewer.app.session.rows.count == run.count
        await viewer.press("F")
        await viewer.type("kind:task")
        assert "no event passes the filter" in viewer.text
        await viewer.press("j", "G", "pagedown", "enter", "escape", "escape")
        assert viewer.app.session.rows.count == run.count

    drive(made, steps)


@pytest.mark.long
def test_a_wrong_filter_says_where(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("F")
        await viewer.type("kind:timer quux:3")
        assert viewer.app.prompt.asking
        shown = viewer.text.splitlines()
        place = next(place for place, line in enumerate(shown) if "quux:3" in line)
        assert shown[place + 1].index("^") == shown[place].index("quux")
        error = " ".join(shown[place + 1 : -1])  # wrapped: nothing of it is cut off
        assert "no field 'quux'" in error
        assert error.rstrip().endswith("where")

    drive(made, steps)


@pytest.mark.long
def test_tab_completes(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("F", "n", "tab")
        assert "node:" in viewer.text
        await viewer.press("slash", "l", "tab")
        await viewer.press("enter")
        assert viewer.app.session.filter_text == "node:/listener"

    drive(made, steps)


@pytest.mark.long
def test_the_inspector_opens_closes_and_follows(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        app = viewer.app
        await viewer.press("j", "j", "enter")
        assert isinstance(app.focused, Inspector)
        while app.inspector.current.link is None:
            await viewer.press("down")
        await viewer.press("enter")
        assert viewer.place == 3
        await viewer.press("end")
        while app.inspector.current.open is None:
            await viewer.press("up")
        before = len(app.inspector.lines)
        await viewer.press("enter")
        assert len(app.inspector.lines) != before
        await viewer.press("home", "pagedown", "pageup", "escape")
        assert isinstance(app.focused, Timeline)
        assert viewer.place == 3

    drive(made, steps)


@pytest.mark.long
def test_panes_zoom_and_maximise(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        app = viewer.app
        await viewer.press("tab")
        assert isinstance(app.focused, Inspector)
        await viewer.press("tab")
        assert isinstance(app.focused, LanesView)
        await viewer.press("right")
        assert viewer.place > 0
        await viewer.press("left", "tab")
        assert isinstance(app.focused, Timeline)
        await viewer.press("shift+tab")
        assert isinstance(app.focused, LanesView)
        await viewer.press("z")
        assert not app.query_one("#body").display
        await viewer.press("z", "equals_sign", *["plus"] * 11)
        assert app.session.lane_window.window.order
        assert "event 0" in viewer.text
        await viewer.press("minus")
        assert not app.session.lane_window.window.order
        await viewer.press("0")
        assert app.session.lane_window.window == app.session.lane_window.whole

    drive(made, steps)


@pytest.mark.long
def test_help_lists_every_key_and_any_of_its_keys_closes_it(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        for key in ("question_mark", "escape", "q", "enter"):
            await viewer.press("question_mark")
            assert isinstance(viewer.app.screen, HelpScreen)
            if key == "question_mark":
                for entry in KEYS:
                    assert entry.two or entry.help[:50] in viewer.text, entry
            await viewer.press(key)
            assert not isinstance(viewer.app.screen, HelpScreen)

    drive(made, steps, size=(140, 60))


def test_the_help_of_a_resized_screen_has_the_columns_it_has_room_for(
    made: Path, drive: Drive
) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("question_mark")
        for width, beside in ((60, False), (140, True), (80, False)):
            await viewer.resize(width, 40)
            line = next(line for line in viewer.text.splitlines() if MOVE in line)
            assert (LOOK in line) == beside, viewer.text

    drive(made, steps, size=(120, 40))


@pytest.mark.long
def test_themes(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        before = viewer.app.export_screenshot()
        await viewer.press("d")
        assert viewer.app.theme == "textual-light"
        assert viewer.app.export_screenshot() != before
        await viewer.press("d")
        assert viewer.app.theme == "textual-dark"

    drive(made, steps)


@pytest.mark.long
def test_plots(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("p")
        screen = viewer.app.screen
        assert isinstance(screen, PlotScreen)
        assert "/count" in viewer.text
        await viewer.press("enter")
        assert "data" in viewer.text
        assert any("⠀" < c <= "⣿" for c in viewer.text)
        await viewer.press("escape", "end")
        assert "latency" in viewer.text
        view = screen.query_one(PlotView)
        assert view.size.width > 40
        view.styles.height = 4
        view.show("two rows", [Series(np.arange(2.0), np.array([0.0, 8.0]))], None)
        await viewer.settle()
        labels = [view.render_line(row).text.split("┤")[0].strip() for row in (1, 2)]
        assert labels == ["8", "0"], "not the middle at the top"
        await viewer.press("up", "j", "k", "q")
        assert not isinstance(viewer.app.screen, PlotScreen)

    drive(made, steps)


@pytest.mark.long
def test_the_mouse(made: Path, run: Run, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.click("#timeline", 10, 5)
        assert viewer.place == 4
        await viewer.click("#lanes", 60, 1)
        assert 100 < viewer.place < run.count - 100
        footer = viewer.app.query_one(FooterBar)
        await viewer.click("#footer", viewer.text.splitlines()[-1].index("help"), 0)
        assert isinstance(viewer.app.screen, HelpScreen)
        assert footer.size.height == 1

    drive(made, steps)


@pytest.mark.long
def test_a_click_follows_a_link(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("j", "j")
        lines = viewer.text.splitlines()
        y = next(i for i, line in enumerate(lines) if "→ 3" in line)
        inspector = viewer.app.inspector
        await viewer.click("#inspector", 8, y - inspector.region.y)
        assert viewer.place == 3

    drive(made, steps)


@pytest.mark.long
def test_the_command_palette_offers_the_keys(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        offered = [one.help for one in viewer.app.get_system_commands(viewer.app.screen)]
        assert all(text.startswith("key ") for text in offered), "none of Textual's own"
        await viewer.press("ctrl+p")
        await viewer.type("next exception")
        await viewer.settle()
        assert viewer.place == viewer.app.session.a.count - 1

    drive(made, steps)


@pytest.mark.few(2)
@pytest.mark.parametrize("size", [(20, 5), (40, 12), (80, 24), (200, 60)])
def test_every_size(made: Path, drive: Drive, size: tuple[int, int]) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("j", "tab", "z", "z", "question_mark", "escape", "plus", "p", "q")
        lines = viewer.text.splitlines()
        assert len(lines) == size[1]
        assert any(">" in line for line in lines)

    drive(made, steps, size=size)


@pytest.mark.long
def test_resizing(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("end")
        for size in ((60, 20), (200, 50), (25, 6), (120, 40)):
            await viewer.resize(*size)
            assert len(viewer.text.splitlines()) == size[1]
            timeline = viewer.app.timeline
            top = round(timeline.scroll_y)
            assert top <= timeline.cursor < top + timeline.page

    drive(made, steps)


@pytest.mark.long
def test_starting_at_an_event_with_a_filter(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        assert viewer.app.session.rows.count < viewer.app.session.a.count
        assert "kind:timer" in viewer.app.session.filter_text
        assert viewer.place >= 100

    drive(made, steps, start=100, filter_text="kind:timer")


# Two traces.


def test_two_traces_open_at_their_divergence(pair: tuple[Path, Path], drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        comparison = viewer.app.session.comparison
        assert viewer.place == comparison.first_place == comparison.rows.agreeing
        text = viewer.text
        assert "same-input-different-output" in text
        assert "≠ output" in text
        await viewer.press("v")
        assert isinstance(viewer.app.screen, ReportScreen)
        assert "/obstacle_filter" in viewer.text
        await viewer.press("v", "home", "n")
        assert viewer.place == comparison.first_place
        await viewer.press("n")
        later = viewer.place
        await viewer.press("N")
        assert viewer.place <= later
        await viewer.press("home", "N")
        assert "no earlier divergence" in viewer.text

    drive(pair, steps)


@pytest.mark.long
def test_two_traces_inspected_one_by_one(pair: tuple[Path, Path], drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        session = viewer.app.session
        assert session.current()[0] is session.a
        await viewer.press("o")
        assert session.side == "a"
        assert "≠ output" not in viewer.text
        await viewer.press("o")
        assert session.current()[0] is session.b
        await viewer.press("o", "c")
        assert session.side == "diff"
        assert session.comparison.sign(viewer.place).value == "="

    drive(pair, steps)


@pytest.mark.long
def test_what_both_runs_share_is_shown_once_with_its_effects(
    pair: tuple[Path, Path], drive: Drive
) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("c", "enter", "z")
        assert viewer.text.count("2.100000000 s") == 1
        assert "effects  1" in viewer.text
        assert "→ 64" in viewer.text

    drive(pair, steps, size=(80, 40))


@pytest.mark.long
@pytest.mark.parametrize("name", ["schedule", "delayed_input", "missing_event"])
def test_every_sample_can_be_walked_through(drive: Drive, name: str) -> None:
    folder = Path(__file__).parents[2] / "sample_traces" / name

    async def steps(viewer: Any) -> None:
        session = viewer.app.session
        assert session.comparison.diff is not None
        assert session.comparison.runs.done
        covered_a = [session.view.a(place) for place in range(session.view.count)]
        covered_b = [session.view.b(place) for place in range(session.view.count)]
        # Every event of both runs is at exactly one place, and found there.
        assert sorted(i for i in covered_a if i is not None) == list(range(session.a.count))
        assert sorted(i for i in covered_b if i is not None) == list(range(session.b.count))
        for place, (a, b) in enumerate(zip(covered_a, covered_b, strict=True)):
            assert a is None or session.view.place_of(a) == place
            assert b is None or session.view.place_of(b, other=True) == place
            session.place = place
            assert session.lines()
        await viewer.press("home", "n", "n", "N", "F")
        await viewer.type("kind:timer")
        await viewer.press("G")

    drive((folder / "a.mcap", folder / "b.mcap"), steps)


@pytest.mark.long
def test_identical_traces_say_so(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        assert "identical: all 603 events" in viewer.text or "= identical" in viewer.text
        await viewer.press("n")
        assert "no later divergence" in viewer.text
        await viewer.press("v")
        assert "identical" in viewer.text

    drive((made, made), steps)


def test_the_report_names_the_command_of_an_option(pair: tuple[Path, Path], drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("v")
        assert "divergence: rsltrace diff --all shows them" in viewer.text

    folder = pair[0].parents[1] / "schedule"
    drive((folder / "a.mcap", folder / "b.mcap"), steps)


def test_the_first_lane_in_sight_names_its_node(pair: tuple[Path, Path], drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        view = viewer.app.query_one(LanesView)
        runs = set()
        for height in (4, 5):
            view.styles.height = height
            await viewer.settle()
            for _ in range(8):
                await viewer.press("down")
                runs.add(view.lanes.lanes[view._first_lane()].run)
                assert view.render_line(0).text.lstrip(" >").startswith("/")
        assert runs == {"a", "b"}

    drive(pair, steps)
