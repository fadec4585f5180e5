"""Overview, log, source, editor, clipboard, and panes of other sizes."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rsltrace_viewer.model.logs import LogLine, event_of, read_logs
from rsltrace_viewer.model.overview import (
    Met,
    Overview,
    Times,
    callbacks_of,
    nodes_of,
    read_overview,
    topics_of,
    troubles_of,
)
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.source import source_of
from rsltrace_viewer.terminal.choose import command
from rsltrace_viewer.terminal.screens.logs import LogScreen
from rsltrace_viewer.terminal.screens.overview import OverviewScreen
from rsltrace_viewer.terminal.widgets.source import SourceView

from rsltrace.trace.contents import count_trace
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind, RandomDecision, encode_decision

Drive = Callable[..., None]
SAMPLES = Path(__file__).parents[2] / "sample_traces"


def test_the_overview_counts_what_the_trace_has(long_run: Run) -> None:
    overview = list(read_overview(long_run))[-1]
    counts = count_trace(long_run.trace)
    assert {e: s.count for e, s in overview.events.items()} == {
        e: s.count for e, s in counts.events.items()
    }
    assert overview.share == 1.0
    assert overview.raised == Met(1, long_run.count - 1)
    topics = {part.name: part for part in topics_of(long_run, overview)}
    assert topics["/count"].rate_hz == pytest.approx(50, rel=0.01)
    parts = nodes_of(long_run, overview)
    assert {part.name for part in parts} == {"/talker", "/listener"}
    assert sum(part.share for part in parts) == pytest.approx(1, abs=0.01)
    logs = list(read_logs(long_run))[-1]
    troubles = {one.what: one.count for one in troubles_of(long_run, overview, logs)}
    assert troubles["exceptions"] == 1


def test_what_goes_wrong_is_not_told_before_it_has(run: Run) -> None:
    part = Overview(share=0.5)
    screen = SimpleNamespace(_session=SimpleNamespace(logs={}, checks={}))
    title, *_ = OverviewScreen._troubles(screen, [(run, part)])  # type: ignore[arg-type]
    assert title == ((("nothing went wrong so far", "title"),), None)


def test_log_records_lead_to_the_events_that_logged_them(long_run: Run) -> None:
    logs = list(read_logs(long_run))[-1]
    assert len(logs.lines) > 1000
    for line in logs.lines[::701]:
        index = event_of(long_run, line)
        assert index is not None
        assert long_run.stamp(index) == line.stamp_ns
        logged = [o for o in long_run.outputs(index) if o.kind is OutputKind.LOG]
        assert line.sequence in [output.sequence for output in logged]
    nowhere = LogLine(long_run.end_ns, 10**6, logs.lines[0].record)
    assert event_of(long_run, nowhere) is None


@pytest.fixture
def many_alike(tmp_path: Path) -> Path:
    """Nodes with long names that share a beginning, which all log at the same instant."""
    from trace_maker import LOG_SCHEMA, Opened, log_message

    with Opened(tmp_path / "alike.mcap") as feeder:
        channel = feeder.writer.add_channel("/rosout", "rcl_interfaces/msg/Log", LOG_SCHEMA)
        log = log_message(5, 30, "node", "low")
        for number in range(12):
            node = feeder.entity(EntityKind.NODE, f"/front_left/sensing/lidar/detector_{number:02}")
            timer = feeder.entity(EntityKind.TIMER, "tick", node=node)
            feeder.output(OutputKind.LOG, node, log, feeder.payload(channel, 5, log))
            feeder.event(EventKind.TIMER, timer, 5)
        feeder.writer.close(result={"stop_reason": "done", "exit_code": "0"})
    return tmp_path / "alike.mcap"


def test_a_record_is_found_among_many_of_an_instant_without_reading_each_event(
    many_alike: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run.open(many_alike)
    lines = list(read_logs(run))[-1].lines
    made = []
    monkeypatch.setattr("rsltrace_viewer.model.run.output_of", lambda row, _: made.append(row))
    assert [event_of(run, line) for line in lines] == list(range(12))
    assert len(made) <= len(lines)
    run.close()


def test_the_overview_cuts_names_where_they_still_differ(many_alike: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        for number in range(5):
            assert f"detector_{number:02}  " in viewer.text.replace("█", " ")

    drive(many_alike, steps, overview=True, size=(60, 40))


def test_the_overview_says_how_long_callbacks_took_and_what_was_lost(tmp_path: Path) -> None:
    from trace_maker import Opened

    path = tmp_path / "drawn.mcap"
    took_ns = [3_000_000, 5_000_000, 1_000_000]
    with Opened(path) as feeder:
        node = feeder.entity(EntityKind.NODE, "/worker")
        timer = feeder.entity(EntityKind.TIMER, "tick", node=node)
        publisher = feeder.entity(EntityKind.PUBLISHER, "/out", node=node)
        feeder.event(EventKind.CONSTRUCT, 0, 0)
        for place, value in enumerate(took_ns):
            feeder.output(OutputKind.DRAW, timer, encode_decision(RandomDecision.EXECUTION, value))
            if place == 1:
                feeder.output(OutputKind.DRAW, publisher, encode_decision(RandomDecision.BURST))
            feeder.event(EventKind.TIMER, timer, 10_000_000 * place)
        feeder.event(EventKind.TASK, timer, 20_000_000)
        feeder.writer.close(result={"stop_reason": "done", "exit_code": "0"})
    run = Run.open(path)
    overview = list(read_overview(run))[-1]
    assert overview.took == {timer: Times(3, 9_000_000, 5_000_000)}
    assert overview.lost == Met(1, 2)
    assert overview.sent == {}
    (callback,) = callbacks_of(run, overview)
    assert callback.took == overview.took[timer]
    assert (callback.count, callback.rate_hz) == (4, 100)  # what goes on is no further start
    assert callback.rate_hz == count_trace(run.trace).rate_hz(timer)
    assert callback.share == pytest.approx(9 / 20)
    assert nodes_of(run, overview)[0].share == callback.share
    assert any("lost" in one.what for one in troubles_of(run, overview, None))
    run.close()


@pytest.mark.long
def test_one_trace_opens_with_the_overview(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        app = viewer.app
        assert isinstance(app.screen, OverviewScreen)
        assert "what went wrong" in viewer.text
        assert "301" in viewer.text
        await viewer.press("question_mark", "escape", "escape")
        assert app.focused is app.timeline
        assert viewer.text.splitlines()[-1].endswith("1/603")
        assert ">      0    0.000000" in viewer.text
        assert app.lanes.lanes is not None
        assert any(level for lane in app.lanes.lanes.lanes for level in lane.levels)
        await viewer.press("O", "x")  # a key of the events does what it does there
        assert app.session.current()[1] == 602
        await viewer.press("O", "slash")
        await viewer.type("kind:srv")
        assert app.session.search_text == "kind:srv"
        assert not isinstance(app.screen, OverviewScreen)
        await viewer.press("O", "q")
        assert len(app.screen_stack) == 1

    drive(made, steps, overview=True)


def test_the_viewer_can_be_left_from_its_first_screen(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("q")
        assert not viewer.app.is_running

    drive(made, steps, overview=True)


@pytest.mark.long
def test_the_overview_says_which_checks_are_violated(tmp_path: Path, drive: Drive) -> None:
    from trace_maker import write_run

    kept, broken = "  - never: finding clock\n", "  - never: log info\n"
    path = tmp_path / "checked.mcap"
    write_run(path, 600, checks=f"checks:\n{kept}{broken}  - {{function: 'not:called'}}\n")

    async def steps(viewer: Any) -> None:
        assert "1 check passed" in viewer.text
        run = viewer.app.session.a
        logged = [event_of(run, line) for line in list(read_logs(run))[-1].lines]
        line = f"check violated {len(logged)} times, first at event {logged[0]}: never log info"
        shown = [one.strip() for one in viewer.text.splitlines()]
        await viewer.press(*["j"] * (shown.index(line) - 1), "enter")
        assert viewer.app.session.current()[1] == logged[0]

    drive(path, steps, overview=True)

    write_run(path, 600, force=True, checks="checks:\n  - never: '/count: data <'\n")

    async def wrong(viewer: Any) -> None:
        assert "checks not evaluated: " in viewer.text

    drive(path, wrong, overview=True)


def test_the_overview_leads_to_events(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("O")
        assert isinstance(viewer.app.screen, OverviewScreen)
        for words in ("exceptions", "/talker", "/count", "exit code 3"):
            assert words in viewer.text
        assert "0 ns" not in viewer.text, "nothing took time"
        await viewer.press("j", "enter")
        assert viewer.app.session.current()[1] == 602
        await viewer.press("O", *["j"] * 8, "enter")
        assert viewer.app.session.filter_text.startswith("node:")
        await viewer.press("O", "escape")
        assert not isinstance(viewer.app.screen, OverviewScreen)

    drive(made, steps)


@pytest.mark.long
def test_the_log_leads_to_events_and_levels_can_be_left_out(drive: Drive) -> None:
    folder = SAMPLES / "missing_event"

    async def steps(viewer: Any) -> None:
        await viewer.press("g")
        assert isinstance(viewer.app.screen, LogScreen)
        assert "12 records" in viewer.text
        assert "the gripper has not answered yet" in viewer.text
        await viewer.press("w")
        assert "warnings and worse" in viewer.text
        await viewer.press("w")
        assert "0 records" in viewer.text
        await viewer.press("w", "home", "j", "enter")
        session = viewer.app.session
        index = session.view.b(viewer.place)
        assert any(o.kind is OutputKind.LOG for o in session.b.outputs(index))

    drive((folder / "a.mcap", folder / "b.mcap"), steps)


def test_names_in_the_log_and_the_overview_steer_nothing(odd: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        for key in ("g", "O"):
            await viewer.press(key)
            assert "\x1b" not in viewer.text
            assert "\u202e" not in viewer.text
            await viewer.press("escape")

    drive(odd, steps)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with its code beside it."""
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    import rsltrace

    folder = tmp_path_factory.mktemp("recorded")
    shutil.copytree(SAMPLES / "delayed_input", folder, dirs_exist_ok=True)
    job = rsltrace.load_job(folder / "job.yaml", overrides=["stop.duration=100ms"])
    rsltrace.record(job, folder / "run.mcap")
    return folder


@pytest.mark.long
@pytest.mark.ros
def test_the_source_of_a_callback_and_that_it_has_changed(
    recorded: Path, tmp_path: Path, drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "job"
    shutil.copytree(recorded, folder)
    monkeypatch.chdir(tmp_path)
    run = Run.open(folder / "run.mcap")
    index = next(i for i in range(run.count) if run.event(i).kind.label == "timer")
    source = source_of(run, index)
    assert source is not None
    assert source.lines[0].strip().startswith("def ")
    assert Path(source.file).read_text().splitlines()[source.line - 1] == source.lines[0]
    assert source.note == ""
    code = folder / "rover.py"
    code.write_text(code.read_text() + "\n# another line\n")
    changed = source_of(run, index)
    assert changed is not None
    assert "changed since this run" in changed.note
    assert changed.lines == source.lines
    copied: list[str] = []

    async def steps(viewer: Any) -> None:
        await viewer.press("s")
        shown = viewer.app.query_one(SourceView)
        assert shown.display
        assert "def " in viewer.text
        pane = shown.query_one("#code")
        shown.styles.width = 16  # a line that is cut says so
        await viewer.settle()
        assert "…" in "".join(pane.render_line(y).text for y in range(pane.size.height))
        shown.styles.width = None
        await viewer.settle()
        assert "changed since this run" in viewer.text
        monkeypatch.setattr(viewer.app, "suspend", nullcontext)
        note = tmp_path / "note"
        editor = tmp_path / "editor"
        editor.write_text(f'#!/bin/sh\necho "$@" > {note}\n')
        editor.chmod(0o755)
        monkeypatch.setenv("VISUAL", f"{editor} --wait")
        await viewer.press("E")
        assert note.read_text() == f"--wait +{source.line} {source.file}\n"
        monkeypatch.setenv("VISUAL", str(tmp_path / "none"))
        await viewer.press("E")
        assert "No such file" in viewer.text
        monkeypatch.setattr(viewer.app, "copy_to_clipboard", copied.append)
        await viewer.press("y")
        assert copied[0].startswith(f"{index} ")
        await viewer.press("s")
        assert not shown.display
        code.unlink()
        await viewer.press("E", "s")
        assert "not below this folder" in viewer.text
        assert "the job is" in viewer.text, "the note is wrapped"

    drive(folder / "run.mcap", steps, start=index)
    run.close()


def test_editors_get_the_line_as_they_want_it() -> None:
    path = Path("a/b.py")
    assert command(["vim", "-n"], path, 7) == ["vim", "-n", "+7", "a/b.py"]
    assert command(["/usr/bin/code", "--wait"], path, 7)[-2:] == ["--goto", "a/b.py:7"]
    assert command(["hx"], path, 7) == ["hx", "a/b.py:7"]


def test_copies_go_through_the_terminal(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        written: list[str] = []
        viewer.app._driver.write = written.append
        await viewer.press("j", "j", "y")
        found = [text for text in written if text.startswith("\x1b]52;c;")]
        copied = base64.b64decode(found[0].removeprefix("\x1b]52;c;").rstrip("\a")).decode()
        assert copied.startswith("2 0.020000000 /talker timer tick /count 3439")

    drive(made, steps)


def test_panes_can_be_resized(made: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        app = viewer.app
        for size, side in (((120, 36), "width"), ((80, 36), "height")):
            await viewer.resize(*size)
            before = getattr(app.timeline.size, side)
            await viewer.press("greater_than_sign")
            larger = getattr(app.timeline.size, side)
            assert larger > before
            await viewer.press("tab", "greater_than_sign", "greater_than_sign", "shift+tab")
            assert getattr(app.timeline.size, side) < larger
        rows = app.lanes.size.height
        await viewer.press("shift+tab", "less_than_sign")
        assert app.lanes.size.height < rows

    drive(made, steps)
