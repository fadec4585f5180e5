"""Rows say what was sent: values of messages, and how much later run b was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import make_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.message_values import message_values
from rsltrace_viewer.session import Session
from trace_maker import Opened, uint64_message

from rsltrace.diff.row_sign import Sign
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind

SAMPLES = Path(__file__).parents[2] / "sample_traces"


def message(**fields: Any) -> Any:
    return make_dataclass("Made", list(fields))(**fields)


@pytest.mark.parametrize(
    ("made", "text"),
    [
        (
            message(linear=message(x=0.31, y=0.0, z=-0.0), angular=message(x=0.0, y=0.0, z=-0.05)),
            "x=0.31 ω=-0.05",
        ),
        (message(x=0.0, y=0.0), "x=0 y=0"),
        (message(data=7), "7"),
        (message(header=message(stamp=1, frame_id="map"), ok=True, text="a\x1b[2J"), None),
        (message(orientation=message(x=0.0, y=0.0, z=1.0, w=0.0)), "3.142"),
        (message(ranges=np.zeros(360), covariance=np.ones(36), gain=2.5), "ranges=[360] gain=2.5"),
        (message(a=message(x=1.0), b=message(x=2.0)), "a.x=1 b.x=2"),
        (message(pair=np.array([1.5, 2.0]), empty=[]), "pair=[1.5 2]"),
    ],
)
def test_messages_in_a_few_words(made: Any, text: str | None) -> None:
    assert message_values(made) == (text or 'ok=true text="a\\x1b[2J"')


@pytest.mark.parametrize(
    ("name", "plot", "text"),
    [
        ("schedule", ("/torque", ""), "↓ a 7 /torque -1.148 → -0.5748"),
        (
            "nondeterministic_callback",
            ("/push", "x"),
            "/push x -0.19956212899502732 → -0.19956212899502734",
        ),
    ],
)
def test_rows_and_plots_of_two_runs_show_what_differs(
    name: str, plot: tuple[str, str], text: str
) -> None:
    session = Session(*(Run.open(SAMPLES / name / f"{run}.mcap") for run in "ab"))
    try:
        comparison = session.comparison
        assert comparison is not None
        comparison.finish_diff()
        assert session.plots().first() == plot
        rows = [row for row in range(comparison.count) if comparison.sign(row) is Sign.DIFFERS]
        list(session.read_values(rows))
        assert any(session.row(row).event.outputs.startswith(text) for row in rows)
    finally:
        session.close()


def test_rows_have_values_once_they_are_read(made: Path) -> None:
    run = Run.open(made)
    session = Session(run)
    assert session.row(2).event.outputs == "/count"
    assert list(session.read_values(range(20))) == list(range(1, 21))
    sent = session.row(2).event.outputs.split()
    assert sent[0] == "/count"
    assert session.row(3).event.outputs == f"got {sent[1]}"
    assert session.row(11).event.outputs == "call /check"  # a request without fields
    session.close()


def test_rows_say_how_much_later_run_b_was() -> None:
    folder = SAMPLES / "delayed_input"
    session = Session(Run.open(folder / "a.mcap"), Run.open(folder / "b.mcap"))
    assert session.comparison is not None
    names = [column.name for column, _ in session.columns(120).columns]
    assert "delta" in names
    assert session.row(session.row_of_place()).event.delta == "+15 ms"
    assert session.row(0).event.delta == ""
    session.close()


def test_times_since_1970_count_from_the_start(tmp_path: Path, drive: Callable[..., None]) -> None:
    start = 1_700_000_000_000_000_000
    path = tmp_path / "epoch.mcap"
    with Opened(path) as feeder:
        node = feeder.entity(EntityKind.NODE, "/n", created_ns=start)
        timer = feeder.entity(EntityKind.TIMER, "tick", node=node, created_ns=start)
        sender = feeder.entity(
            EntityKind.PUBLISHER, "/c", node=node, type_="std_msgs/msg/UInt64", created_ns=start
        )
        channel = feeder.writer.add_channel("/c", "std_msgs/msg/UInt64", "uint64 data\n")
        for place in range(50):
            stamp, data = start + place * 100_000_000, uint64_message(place)
            feeder.output(OutputKind.MESSAGE, sender, data, feeder.payload(channel, stamp, data))
            feeder.event(EventKind.TIMER, timer, stamp)
        feeder.writer.close(result={"stop_reason": "done", "exit_code": "0"})

    async def steps(viewer: Any) -> None:
        assert "17000000" not in viewer.text.split("\n", 1)[1].partition("event 0")[0]
        assert "from 2023-11-14 22:13:20 UTC" in viewer.text
        assert "/c 3" in viewer.text
        await viewer.press("t")
        await viewer.type("1.5")
        assert viewer.place == 15
        assert "1.5 s after the start, 1700000001.500000000 s" in viewer.text
        await viewer.press("t")
        await viewer.type("@1700000002")
        assert viewer.place == 20

    drive(path, steps, size=(140, 30))
