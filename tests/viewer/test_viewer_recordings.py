"""Bags and native recordings: topics, messages, plots; two side by side."""

from __future__ import annotations

import asyncio
import shutil
import sqlite3
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from rsltrace_viewer.model.folder import found_in
from rsltrace_viewer.model.plots.series import Series, difference
from rsltrace_viewer.model.query.tokens import QueryError
from rsltrace_viewer.model.recordings.plots import RecordingPlots
from rsltrace_viewer.model.recordings.recording import Pairs, Topic
from rsltrace_viewer.model.recordings.session import RecordingSession
from rsltrace_viewer.terminal.choose import ChooseApp
from rsltrace_viewer.terminal.recordings import RecordingApp, open_recordings
from rsltrace_viewer.terminal.screens.help import KeysScreen
from rsltrace_viewer.terminal.screens.plot import PlotScreen
from rsltrace_viewer.terminal.screens.report import ReportScreen
from rsltrace_viewer.terminal.screenshot import settle, text_of
from textual import events
from trace_maker import uint64_message

from rsltrace.cli.main import cli
from rsltrace.diff.row_sign import RowSign
from rsltrace.job.values.times import START, parse_time_in_run
from rsltrace.trace.decode import to_plain

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
        size = options.pop("size", (120, 36))
        app = RecordingApp(open_recordings(paths), **options)
        async with app.run_test(size=size) as pilot:

            async def press(*keys: str) -> str:
                for key in keys:
                    await pilot.press(key)
                    await settle(app, pilot.pause)
                return text_of(app)

            await settle(app, pilot.pause)
            await steps(app, press)

    asyncio.run(run())


def typed(text: str) -> list[str]:
    """Return the keys that type a text."""
    names = {" ": "space", ":": "colon", "/": "slash", ".": "full_stop", ">": "greater_than_sign"}
    return [names.get(character, character) for character in text]


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
        if pairs.sign(row) is RowSign.MATCH:
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


@pytest.mark.long
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


@pytest.mark.few(1)
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


def _chosen(session: RecordingSession, text: str) -> set[tuple[str, int]]:
    list(session.set_filter(text))
    session.show_found()
    chosen = set()
    for place, (name, _) in enumerate(session.keys):
        session.place = place
        chosen |= {(name, int(number)) for number in session.pairs.a}
    return chosen


@pytest.mark.long
@pytest.mark.parametrize("kept", [1 << 28, 4000], ids=["in memory", "read again"])
def test_filters_mean_the_messages_that_they_say(
    bags: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, kept: int
) -> None:
    monkeypatch.setattr("rsltrace_viewer.model.recordings.recording._KEPT_BYTES", kept)
    session = open_recordings(bags[:1])
    list(session.read())
    recording = session.recordings[0]
    everything = {}
    for topic in recording.topics:
        for number, stamp in enumerate(topic.stamps):
            *_, message = recording.message(topic, number)
            text = str(to_plain(message)).casefold()
            everything[topic.name, number] = (stamp - recording.start_ns) / 1e9, text
    texts = {key: text for key, (_, text) in everything.items()}
    for text, means in {
        "topic:/pose": lambda key: key[0] == "/pose",
        "-topic:/pose": lambda key: key[0] != "/pose",
        "pose": lambda key: "pose" in key[0],
        "type:Pose2D or index:<3": lambda key: key[0] == "/pose" or key[1] < 3,
        "time:0.5..1": lambda key: 0.5 <= everything[key][0] <= 1,
        "time:>1.5 index:100..": lambda key: everything[key][0] > 1.5 and key[1] >= 100,
        "text:0.55": lambda key: "0.55" in texts[key],
        "topic:/pose (text:0.55 or text:0.56) -index:140": lambda key: (
            key[0] == "/pose" and ("0.55" in texts[key] or "0.56" in texts[key]) and key[1] != 140
        ),
        "level:warn": lambda key: False,
        "": lambda key: True,
    }.items():
        assert _chosen(session, text) == {key for key in everything if means(key)}, text
    for text in ("nod:/x", "topic:/nothing", "time:soon", "index:x", "level:loud", "text:", '""'):
        with pytest.raises(QueryError):
            session.set_filter(text)


def test_a_filter_by_a_time_that_is_not_there_says_which_are(tmp_path: Path) -> None:
    path, start_ns = tmp_path / "bag.mcap", 1_700_000_000_000_000_000
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/UInt64", "ros2msg", b"uint64 data")
        channel = writer.register_channel("/c", "cdr", schema)
        for place in range(5):
            stamp_ns = start_ns + place * 1_000_000_000
            writer.add_message(channel, stamp_ns, uint64_message(place), stamp_ns)
        writer.finish()
    session = open_recordings((path,))
    list(session.read())
    here = r"from the start, 0\.0 to 4\.0 s, or @1700000000\.0 to @1700000004\.0"
    for text in ("time:5..", "time:@5..@6", "time:1600000000.."):
        with pytest.raises(QueryError, match=here):
            session.set_filter(text)
    with pytest.raises(QueryError, match="write @1700000001s"):
        session.set_filter("time:1700000001..")
    for text in ("time:1..", "time:@1700000001.."):
        assert len(_chosen(session, text)) == 4


@pytest.mark.long
def test_filters_and_searches_on_the_screen(bags: tuple[Path, Path]) -> None:
    async def steps(app: RecordingApp, press: Callable[..., Awaitable[str]]) -> None:
        session = app.session
        topics = len(session.keys)
        text = await press("F", *typed("top"))
        assert "topic:" in text
        text = await press("tab", *typed("/pose time:>1"), "enter")
        assert [name for name, _ in session.keys] == ["/pose"]
        assert f"{session.pairs.count} of 250" in text
        assert f"filter: {session.pairs.count} messages" in text
        assert session.pairs.at(0) == (100, None)
        text = await press("escape")
        assert len(session.keys) == topics
        assert "filter:" not in text
        assert session.keys[session.place][0] == "/pose"
        assert session.pairs.at(session.row) == (100, None)
        await press("slash", *typed("text:0.559"), "enter")
        found = session.row
        assert "0.559" in "".join(session.message_text(found)[2])
        assert app.focused is app.messages
        await press("n", "N")
        assert session.row == found
        assert "no match" in await press("slash", *typed("text:qzx"), "enter")
        await press("escape", "escape")
        assert not session.search_text

    drive(bags[:1], steps)


@pytest.mark.long
def test_a_filter_of_two_recordings_keeps_what_either_has(bags: tuple[Path, Path]) -> None:
    async def steps(app: RecordingApp, press: Callable[..., Awaitable[str]]) -> None:
        session = app.session
        assert session.pairs.at(session.row) == (144, 144)
        assert session.filter_text == "topic:/pose index:140..150"
        assert session.pairs.count == 11
        assert session.row == 4
        await press("n")
        assert "no later difference" in text_of(app)

    drive(bags, steps, filter_text="topic:/pose index:140..150")


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("at", "expected"),
    [
        ("1.445s", ("/pose", 144)),
        ("0", ("", 0)),
        ("99999", ("", -1)),
        ("99s", ("", -1)),
    ],
)
def test_starting_somewhere_in_a_recording(
    bags: tuple[Path, Path], tmp_path: Path, at: str, expected: tuple[str, int]
) -> None:
    session = open_recordings(bags[:1])
    list(session.read())
    session.go_to_message(*((int(at), START) if at.isdecimal() else (None, parse_time_in_run(at))))
    recording = session.recordings[0]
    name, number = session.keys[session.place][0], session.number_of(session.row)
    topic = session.topics(session.keys[session.place])[0]
    assert topic is not None
    if expected[0]:
        assert (name, number) == expected
    else:
        edge = recording.start_ns if expected[1] == 0 else recording.end_ns
        assert topic.stamps[number] == edge
    screen = tmp_path / "screen.txt"
    done = CliRunner().invoke(cli, ["view", str(bags[0]), "--at", at, "--export", str(screen)])
    assert done.exit_code == 0, done.output
    shown = screen.read_text()
    assert f"message {number}" in shown
    assert ("this is the last" in shown) == (expected[1] == -1)


def test_the_chooser_knows_recordings(
    bags: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(bags[0], tmp_path / "bag")
    (file,) = (tmp_path / "bag").glob("*.mcap")
    shutil.copy(file, tmp_path / "plain.mcap")
    (tmp_path / "sub").mkdir()
    shutil.copy(SAMPLES / "a.mcap", tmp_path / "sub" / "run.mcap")
    sqlite3.connect(tmp_path / "broken.db3").close()
    (tmp_path / "cut.mcap.zstd").write_bytes(b"\x28\xb5\x2f\xfd")
    monkeypatch.chdir(tmp_path)
    found = {entry.name: entry for entry in found_in(Path())}
    assert set(found) == {"bag/", "plain.mcap", "sub/run.mcap", "cut.mcap.zstd"}
    assert found["bag/"].amount == found["plain.mcap"].amount == "316 messages"
    assert "mcap recording" in found["bag/"].what
    assert "events" in found["sub/run.mcap"].amount

    async def choose(*keys: str) -> Any:
        app = ChooseApp(list(found.values()))
        async with app.run_test(size=(80, 24)) as pilot:
            await pilot.press(*keys)
        return app.return_value

    chosen = asyncio.run(choose("space", "down", "enter"))
    assert chosen == [entry.path for entry in found.values()][:2]
    monkeypatch.chdir(tmp_path / "bag")
    assert [entry.name for entry in found_in(Path())] == ["./"]


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
        ([bags[0], "--follow"], "need traces"),
        ([bags[0], "--at", "soon"], "or the number of a message"),
        ([bags[0], "--filter", "topic:/nothing"], "there are"),
        ([bags[0], "--filter", "node:/base"], "there is no field"),
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


@pytest.mark.parametrize("size", [(80, 24), (120, 36)])
def test_a_click_meets_the_line_below_the_title_of_a_list(
    bags: tuple[Path, Path], size: tuple[int, int]
) -> None:
    async def steps(app: RecordingApp, press: Any) -> None:
        place = len(app.session.keys) - 1
        x, y = app.topics.region.x + 4, app.topics.region.y + place + 1
        app.topics.on_click(
            events.Click(app.topics, 4, place + 1, 0, 0, 1, False, False, False, x, y)
        )
        await press("home")
        assert app.session.place == place
        assert "values" in str(app.messages.border_title)

    drive(bags[:1], steps, size=size)
