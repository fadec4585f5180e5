"""Bags and native recordings: topics, messages, plots; two side by side."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from rsltrace_viewer.model.plots.data import difference
from rsltrace_viewer.model.plots.series import Series
from rsltrace_viewer.model.recordings.pairs import Pairs
from rsltrace_viewer.model.recordings.plots import RecordingPlots
from rsltrace_viewer.model.recordings.recording import Topic
from rsltrace_viewer.model.view import Sign
from rsltrace_viewer.terminal.recordings.app import RecordingApp, open_recordings
from rsltrace_viewer.terminal.screens.help import KeysScreen
from rsltrace_viewer.terminal.screens.plot import PlotScreen
from rsltrace_viewer.terminal.screens.report import ReportScreen
from rsltrace_viewer.terminal.screenshot import settle, text_of
from trace_maker import uint64_message

from rsltrace.cli.main import cli

SAMPLES = Path(__file__).parents[2] / "sample_traces" / "delayed_input"


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two bags that differ on /pose from message 144 on."""
    folder = tmp_path_factory.mktemp("bags")
    for name in ("a", "b"):
        arguments = ["export", str(SAMPLES / f"{name}.mcap"), "--bag", str(folder / name)]
        done = CliRunner().invoke(cli, arguments)
        assert done.exit_code == 0, done.output
    return folder / "a", folder / "b"


def drive(paths: tuple[Path, ...], steps: Callable[..., Awaitable[None]], **options: Any) -> None:
    async def run() -> None:
        app = RecordingApp(open_recordings(paths))
        async with app.run_test(size=options.get("size", (120, 36))) as pilot:

            async def press(*keys: str) -> str:
                for key in keys:
                    await pilot.press(key)
                    await settle(app, pilot.pause)
                return text_of(app)

            await settle(app, pilot.pause)
            await steps(app, press)

    asyncio.run(run())


def topic_of(hashes: list[int]) -> Topic:
    topic = Topic(0, "/t", "x/msg/T")
    topic.hashes.extend(hashes)
    topic.stamps.extend(range(len(hashes)))
    return topic


@given(st.lists(st.integers(0, 5), max_size=30), st.lists(st.integers(0, 5), max_size=30))
def test_pairs_have_every_message_once_and_in_order(a: list[int], b: list[int]) -> None:
    pairs = Pairs(topic_of(a), topic_of(b))
    rows = [pairs.at(row) for row in range(pairs.count)]
    assert [one for one, _ in rows if one is not None] == list(range(len(a)))
    assert [other for _, other in rows if other is not None] == list(range(len(b)))
    for row, (one, other) in enumerate(rows):
        if pairs.sign(row) is Sign.MATCH:
            assert one is not None
            assert other is not None
            assert a[one] == b[other]
    if a == b:
        assert not pairs.differs.any()
    firsts = []
    row: int | None = -1
    while (row := pairs.next_difference(row, 1)) is not None:
        firsts.append(row)
    assert all(pairs.differs[one] and (one == 0 or not pairs.differs[one - 1]) for one in firsts)


def test_a_bag(bags: tuple[Path, Path]) -> None:
    async def steps(app: RecordingApp, press: Callable[..., Awaitable[str]]) -> None:
        text = await press("down")
        for words in ("316 messages", "one recording", "/pose", "/odom", "100 Hz", "25 Hz"):
            assert words in text
        text = await press("enter", "down", "down")
        assert app.session.row == 2
        assert "message 2" in text
        assert "theta" in text
        text = await press("t", "1", "full_stop", "5", "enter")
        assert "1.5 s after the start" in text
        text = await press("p")
        assert isinstance(app.screen, PlotScreen)
        assert any("⠀" < c <= "⣿" for c in text)
        await press("q", "question_mark")
        assert isinstance(app.screen, KeysScreen)
        copied: list[str] = []
        app.copy_to_clipboard = copied.append  # type: ignore[method-assign]
        await press("escape", "y", "d")
        assert "theta=" in copied[0]

    drive(bags[:1], steps)


@pytest.mark.parametrize("size", [(80, 24), (200, 60)], ids=["80x24", "200x60"])
def test_two_bags_open_where_they_differ(bags: tuple[Path, Path], size: tuple[int, int]) -> None:
    async def steps(app: RecordingApp, press: Callable[..., Awaitable[str]]) -> None:
        text = await press("tab")
        assert "two recordings" in text
        assert "first diverge on /pose" in text
        assert app.session.pairs.at(app.session.row) == (144, 144)
        row = next(line for line in text.splitlines() if "1.450000 ≠" in line)
        assert "x=0.55973193" in row
        assert "x=0.55973195" in row
        await press("N")
        assert "no earlier difference" in text_of(app)
        text = await press("v")
        assert isinstance(app.screen, ReportScreen)
        text = await press("escape", "p")
        assert "a − b" in text
        assert "/pose  x" in text

    drive(bags, steps, size=size)


def test_a_bag_beside_the_trace_it_was_made_from(bags: tuple[Path, Path]) -> None:
    async def steps(app: RecordingApp, press: Callable[..., Awaitable[str]]) -> None:
        assert "=" in text_of(app).splitlines()[1]
        assert not app.session.pairs.differs.any()

    drive((bags[0], SAMPLES / "a.mcap"), steps)


def test_messages_that_are_not_kept_are_read_again(
    bags: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rsltrace_viewer.model.recordings.recording._KEPT_BYTES", 4000)
    session = open_recordings(bags[:1])
    list(session.read())
    topic = next(topic for topic in session.recordings[0].topics if topic.name == "/pose")
    assert topic.data[-1] is None
    *_, message = session.recordings[0].message(topic, 249)
    whole = open_recordings(bags[:1])
    monkeypatch.undo()
    list(whole.read())
    data = next(one for one in whole.recordings[0].topics if one.name == "/pose").data[249]
    assert data is not None
    assert str(message) == str(whole.recordings[0].decode(topic, data))
    source = next(s for s in RecordingPlots(session).fields("/pose") if s.field == "x")
    *_, series = RecordingPlots(session).series(source)
    assert "not kept in memory" in series[0].note


def test_recordings_that_cannot_be_opened(tmp_path: Path, bags: tuple[Path, Path]) -> None:
    (tmp_path / "folder").mkdir()
    for arguments, words in (
        ([tmp_path / "folder"], "metadata.yaml"),
        ([bags[0], "--at", "3"], "need traces"),
        ([bags[0], tmp_path / "none.mcap"], "none.mcap"),
    ):
        done = CliRunner().invoke(
            cli, ["view", *map(str, arguments), "--export", str(tmp_path / "x.txt")]
        )
        assert done.exit_code == 2
        assert words in done.output
        assert "Traceback" not in done.output


def test_a_damaged_bag_is_shown_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "damaged.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=8192, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/UInt64", "ros2msg", b"uint64 data\n")
        channel = writer.register_channel("/count", "cdr", schema)
        for stamp in range(3000):
            writer.add_message(channel, stamp * 10**6, uint64_message(stamp), stamp * 10**6)
        writer.finish()
    data = bytearray(path.read_bytes())
    place = len(data) // 2
    data[place : place + 12_000] = b"\x55" * 12_000
    path.write_bytes(data)

    async def steps(app: RecordingApp, press: Callable[..., Awaitable[str]]) -> None:
        assert not app.busy
        assert 1000 < app.session.recordings[0].count < 2000
        assert "damaged.mcap" in app.session.damage
        assert "message 2" in await press("enter", "down", "down")

    drive((path,), steps)


def test_the_difference_of_two_curves() -> None:
    import numpy as np

    a = Series(np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.0, 1.0, 2.0, 3.0]))
    b = Series(np.array([0.5, 2.5]), np.array([0.0, 2.0]))
    found = difference([a, b])
    assert found is not None
    assert found.times.tolist() == [1.0, 2.0]
    assert found.values.tolist() == [0.5, 0.5]
    assert found.note == "|a − b| ≤ 0.5"
    assert difference([a]) is None
