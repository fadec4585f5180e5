"""Traces that are empty, cut off, damaged, huge or strange; the viewer shows what there is."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.terminal import follow
from rsltrace_viewer.terminal.screens.text import PickScreen
from trace_maker import Opened, boundaries, write_run

from rsltrace.errors import TraceError
from rsltrace.trace.model.event import EventKind

Drive = Callable[..., None]

EVERY_KEY = (
    "down up pagedown pageup home end right_square_bracket left_square_bracket right_curly_bracket "
    "left_curly_bracket right_parenthesis left_parenthesis c e b f m apostrophe quotation_mark x X "
    "l L w W u U n N escape enter escape tab shift+tab plus minus 0 z z p q R d d v o "
    "question_mark q"
).split()


@pytest.mark.long
def test_an_empty_trace(tmp_path: Path, drive: Drive) -> None:
    path = tmp_path / "empty.mcap"
    with Opened(path) as feeder:
        feeder.writer.close(result={"stop_reason": "nothing", "exit_code": "0"})

    async def steps(viewer: Any) -> None:
        assert "no events in this trace" in viewer.text
        assert "0 events" in viewer.text
        await viewer.press(*EVERY_KEY)
        for kind in ("F", "slash", "t", "i"):
            await viewer.press(kind)
            await viewer.type("1")
            await viewer.press("escape")
        assert "no events" in viewer.text

    drive(path, steps)


@pytest.mark.long
def test_one_event(tmp_path: Path, drive: Drive) -> None:
    path = tmp_path / "one.mcap"
    with Opened(path) as feeder:
        feeder.event(EventKind.CLOCK_JUMP, 0, 10**18)
        feeder.writer.close(result={"stop_reason": "nothing", "exit_code": "0"})

    async def steps(viewer: Any) -> None:
        assert "from 2001-09-09 01:46:40 UTC" in viewer.text
        await viewer.press(*EVERY_KEY)
        assert viewer.place == 0
        await viewer.press(*["plus"] * 20)
        assert viewer.app.session.lane_window.window.order

    drive(path, steps)


@pytest.mark.parametrize("stamp_ns", [2**63 - 1, 2**64 - 1])
def test_times_that_no_run_has(tmp_path: Path, stamp_ns: int) -> None:
    path = tmp_path / "late.mcap"
    with Opened(path) as feeder:
        feeder.event(EventKind.CLOCK_JUMP, 0, stamp_ns)
        feeder.writer.close(result={"stop_reason": "nothing", "exit_code": "0"})
    with pytest.raises(TraceError, match=r"late\.mcap: an event is later than any time of ROS"):
        Run.open(path)


@pytest.mark.long
def test_a_trace_that_was_cut_off(tmp_path: Path, drive: Drive) -> None:
    path = tmp_path / "cut.mcap"
    write_run(path, 9000, close=False)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - 1000])

    async def steps(viewer: Any) -> None:
        assert "not finished" in viewer.text
        assert 0 < viewer.app.session.a.count < 9000
        await viewer.press(*EVERY_KEY)
        await viewer.resize(60, 20)
        assert "not finished" in viewer.text

    drive(path, steps)


@pytest.mark.long
def test_a_damaged_chunk_is_shown_where_it_is(tmp_path: Path, drive: Drive) -> None:
    path = tmp_path / "damaged.mcap"
    write_run(path, 9000)
    data = bytearray(path.read_bytes())
    from rsltrace.trace.reader import Trace

    with Trace.open(path) as trace:
        row = trace.segments[1]
        middle = int(row["events_offset"]) + int(row["events_length"]) // 2
        first = int(row["first_event"])
    data[middle] ^= 0xFF
    path.write_bytes(bytes(data))
    assert boundaries(bytes(data))

    async def steps(viewer: Any) -> None:
        await viewer.press("i")
        await viewer.type(str(first + 5))
        assert "unreadable" in viewer.text
        assert viewer.place == first + 5
        await viewer.press("k", "k", "k", "k", "k", "k", "k")
        assert viewer.place == first - 2
        await viewer.press("F")
        await viewer.type("kind:srv")
        assert viewer.app.session.rows.count > 0
        await viewer.press("escape", *EVERY_KEY)

    drive(path, steps)


@pytest.mark.long
def test_odd_things_are_shown_as_what_they_are(odd: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        seen = viewer.text
        await viewer.press("j")
        assert viewer.place == 1
        seen += viewer.text
        assert "10000000: [0, 0, 0" in viewer.text
        await viewer.press("e")
        assert isinstance(viewer.app.screen, PickScreen)
        seen += viewer.text
        await viewer.press("j", "enter")
        assert viewer.place == 3
        await viewer.press("end", "k")
        seen += viewer.text
        assert all(words in viewer.text for words in ("cannot be", "decoded"))
        assert "6a 75 6e 6b" in viewer.text
        assert "not recorded" in viewer.text
        assert "waits" in viewer.text
        await viewer.press("j")
        seen += viewer.text
        assert "log WARN too" in viewer.text
        await viewer.press("w", "W", *EVERY_KEY)
        for size in ((80, 24), (200, 60), (33, 9)):
            await viewer.resize(*size)
            seen += viewer.text
        assert not re.search("[\x00-\x09\x0b-\x1f\x7f\u202e]", seen)
        assert "ロボット" in seen

    drive(odd, steps, size=(120, 60))


def test_a_search_for_text_in_odd_messages(odd: Path, drive: Drive) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("slash")
        await viewer.type("text:bold")
        assert viewer.app.session.a.count - 1 == viewer.place

    drive(odd, steps)


@pytest.mark.few(1)
@pytest.mark.parametrize("size", [(1, 1), (5, 2), (10, 4)])
def test_a_terminal_that_is_far_too_small(made: Path, drive: Drive, size: tuple[int, int]) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press("j", "question_mark", "escape", "pagedown", "F", "escape", "p", "q", "j")
        await viewer.resize(120, 36)
        assert "/talker" in viewer.text

    drive(made, steps, size=size)


def test_a_growing_file_is_followed(tmp_path: Path, drive: Drive) -> None:
    whole, growing = tmp_path / "whole.mcap", tmp_path / "growing.mcap"
    write_run(whole, 20_000)
    data = whole.read_bytes()
    growing.write_bytes(data[: len(data) // 2])

    async def steps(viewer: Any) -> None:
        app = viewer.app
        before = app.session.a.count
        await viewer.press("G")
        growing.write_bytes(data[: len(data) * 3 // 4])
        await wait(viewer, lambda: app.session.a.count > before)
        assert viewer.place == app.session.a.count - 1
        assert "following" in viewer.text
        await viewer.press("home")
        growing.write_bytes(data)
        await wait(viewer, lambda: app.session.a.trace.complete)
        assert viewer.place == 0
        assert "the recording has ended" in viewer.text
        await viewer.press("R")
        assert "nothing to follow" in viewer.text

    drive(growing, steps, follow=True)


@pytest.mark.long
def test_the_end_of_a_recording_is_shown_at_once(
    tmp_path: Path, drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long an unfinished file takes to open, and is therefore left alone for a while."""
    monkeypatch.setattr(follow, "_IDLE_FACTOR", 1e9)
    whole, growing = tmp_path / "whole.mcap", tmp_path / "growing.mcap"
    write_run(whole, 20_000)
    data = whole.read_bytes()
    growing.write_bytes(data[: len(data) // 2])

    async def steps(viewer: Any) -> None:
        session = viewer.app.session
        growing.write_bytes(data[: len(data) * 3 // 4])
        await wait(viewer, lambda: viewer.app._follow._not_before > 0)
        growing.write_bytes(data)
        await wait(viewer, lambda: session.a.trace.complete)
        assert session.a.trace.event_count >= 20_000

    drive(growing, steps, follow=True)


async def wait(viewer: Any, happened: Callable[[], bool]) -> None:
    """Wait until something happened."""
    import asyncio

    for _ in range(12000):
        if happened():
            break
        await asyncio.sleep(0.05)
    assert happened()
    await viewer.settle()
