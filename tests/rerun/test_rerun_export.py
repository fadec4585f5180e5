"""A recording, loaded back: what is in it, on which timelines, how often, and with what values."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rerun_gallery as gallery
import trace_maker
from mcap.opcode import Opcode
from mcap.records import Chunk, Schema

from campaigns.attack import mcap_parts
from rsltrace.errors import OutputError, TraceError
from rsltrace.trace.model.event import NO_EVENT, OutputKind

pytest.importorskip("rerun")

from rsltrace_viewer.rerun_export.export import export
from rsltrace_viewer.rerun_export.messages import chunks as chunks_module

from tests.rerun.recording import Recording

STEPS = 30


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[trace_maker.Feeder, Recording]:
    folder = tmp_path_factory.mktemp("gallery")
    feeder = gallery.write_gallery(folder / "run.mcap", STEPS)
    done = export([folder / "run.mcap"], folder / "run.rrd")
    assert done.events == len(feeder.events)
    assert done.bytes == (folder / "run.rrd").stat().st_size
    return feeder, Recording(folder / "run.rrd")


@pytest.fixture(scope="module")
def recording(written: tuple[trace_maker.Feeder, Recording]) -> Recording:
    return written[1]


def sent_at() -> list[int]:
    """The events that publish: every other one, after the construction."""
    return [gallery.FIRST_EVENT + 2 * step for step in range(STEPS)]


def test_there_are_two_timelines_and_no_wall_clock(recording: Recording) -> None:
    assert recording.timelines == {"sim_time", "event"}
    assert "RecordingInfo:start_time" not in recording.static.get("/__properties", {})


def test_every_event_is_in_the_table(written: tuple[trace_maker.Feeder, Recording]) -> None:
    feeder, recording = written
    rows = sorted(recording.rows["/events"], key=lambda row: row["event"])
    assert [row["event"] for row in rows] == list(range(len(feeder.events)))
    for row, event in zip(rows, feeder.events, strict=True):
        assert row["input_hash"] == [f"{event.input_hash:016x}"]
        assert row["output_hash"] == [f"{event.output_hash:016x}"]
        assert row["kind"] == [event.kind.label]
        cause = row["cause"][0] if row["cause"] else None
        assert cause == (None if event.cause_event == NO_EVENT else event.cause_event)
        assert row["sim_time"] == event.stamp_ns
    assert rows[1]["node"] == ["/robot"]
    assert rows[1]["callback"] == ["Robot.on_timer"]
    assert rows[1]["outputs"][0].startswith("/tf, /odom, /scan, ")
    assert rows[2]["outputs"] == [""]
    assert rows[-1]["flags"] == ["raised"]


def test_every_entity_has_its_events(recording: Recording) -> None:
    timer = recording.events("/nodes/robot/timer/Robot.on_timer", "TextLog:text")
    assert timer == [*sent_at(), 2 * STEPS + 1]
    assert recording.values("/nodes/robot/timer/Robot.on_timer", "TextLog:level")[-1] == ["ERROR"]
    subscription = recording.events("/nodes/watcher/subscription/odom", "TextLog:text")
    assert subscription == [event + 1 for event in sent_at()]


def test_a_lane_is_filled_where_its_node_runs(recording: Recording) -> None:
    rows = [row for row in recording.rows["/nodes/robot"] if row.get("event") is not None]
    filled = [row["event"] for row in rows if row["StateChange:state"] == ["Robot.on_timer"]]
    ended = [row["event"] for row in rows if row["StateChange:state"] == [""]]
    assert sorted(filled) == [*sent_at(), 2 * STEPS + 1]
    assert sorted(ended) == [event + 1 for event in sorted(filled)]
    by_time = [row for row in recording.rows["/nodes/robot"] if row.get("sim_time") is not None]
    assert len(by_time) == STEPS + 1


def test_logs_have_their_levels_and_exceptions_their_traceback(recording: Recording) -> None:
    texts = [text for (text,) in recording.values("/nodes/robot/log", "TextLog:text")]
    assert texts[:2] == ["[robot] step 0", "[robot] step 1"]
    assert "ValueError: too far" in texts[-1]
    levels = [level for (level,) in recording.values("/nodes/robot/log", "TextLog:level")]
    assert levels[:5] == ["DEBUG", "INFO", "WARN", "ERROR", "CRITICAL"]
    assert levels[-1] == "CRITICAL"
    assert recording.events("/nodes/robot/log", "TextLog:text")[:-1] == sent_at()


def test_rates_are_those_of_the_run(recording: Recording) -> None:
    (name,) = recording.static["/nodes/robot/rate"]["SeriesLines:names"]
    assert name == "/robot [1/s]"
    rates = [rate for (rate,) in recording.values("/nodes/robot/rate", "Scalars:scalars")]
    assert max(rates) == 10.0


@pytest.mark.parametrize(
    ("place", "component"),
    [
        ("topics/tf", "Transform3D:translation"),
        ("topics/odom", "nav_msgs.msg.Odometry:message"),
        ("topics/odom/pose", "Arrows3D:vectors"),
        ("topics/odom/pose.pose.position", "Scalars:scalars"),
        ("topics/scan/points", "Points3D:positions"),
        ("topics/cloud", "Points3D:positions"),
        ("topics/camera/image", "Image:buffer"),
        ("topics/plan/path", "LineStrips3D:strips"),
        ("topics/particles/poses", "Arrows3D:origins"),
        ("topics/goal/pose", "Arrows3D:origins"),
        ("topics/goal", "InstancePoses3D:translations"),
        ("topics/cmd_vel/linear", "Scalars:scalars"),
        ("topics/imu", "Scalars:scalars"),
        ("topics/fix", "GeoPoints:positions"),
        ("topics/fix/altitude", "Scalars:scalars"),
        ("topics/joints/position", "Scalars:scalars"),
        ("topics/map", "GridMap:data"),
        ("topics/voltage", "Scalars:scalars"),
        ("topics/wheels/data", "Scalars:scalars"),
        ("topics/status", "TextDocument:text"),
        ("topics/markers/lines/0", "LineStrips3D:strips"),
        ("topics/marker/lines/0", "LineStrips3D:strips"),
    ],
)
def test_each_message_is_at_the_event_that_sent_it(
    recording: Recording, place: str, component: str
) -> None:
    assert recording.events(f"/{place}", component) == sent_at()


def test_what_is_drawn_is_where_it_was(recording: Recording) -> None:
    for step, ((origin,), scan) in enumerate(
        zip(
            recording.values("/topics/odom/pose", "Arrows3D:origins"),
            recording.values("/topics/scan/points", "Points3D:positions"),
            strict=True,
        )
    ):
        message = gallery.messages(step, 0)["/odom"][1]
        position = message.pose.pose.position
        assert origin == pytest.approx([position.x, position.y, position.z], abs=1e-6)
        assert len(scan) == 3, "rays without a hit (infinite, NaN) are no points"
        assert scan[1] == pytest.approx([2 * 0.8775826, 2 * -0.4794255, 0], abs=1e-5)
    assert recording.values("/topics/voltage", "Scalars:scalars")[3] == [pytest.approx(11.97)]
    assert recording.static["/topics/voltage"]["SeriesLines:names"] == ["data"]
    track = recording.static["/topics/odom/track"]["LineStrips3D:strips"]
    assert len(track[0]) == STEPS
    assert recording.static["/topics/odom/track"]["Points3D:labels"] == ["/odom"]
    clouds = recording.values("/topics/cloud", "Points3D:positions")
    colours = recording.values("/topics/cloud", "Points3D:colors")
    for cloud, colour in zip(clouds, colours, strict=True):
        order = np.argsort([point[2] for point in cloud], kind="stable")
        greens = [colour[at] >> 16 & 255 for at in order]
        assert greens == sorted(greens), "the higher the brighter"
        assert greens[0] < greens[-1]


def test_markers_go_when_they_are_deleted(recording: Recording) -> None:
    deleted = [event for step, event in enumerate(sent_at()) if step % 7 == 0]
    boxes = [f"/topics/markers/boxes/{number}" for number in range(3)]
    cleared = [e for box in boxes for e in recording.events(box, "Clear:is_recursive")]
    assert sorted(cleared) == deleted
    there: set[int] = set()
    drawn = []
    for step, event in enumerate(sent_at()):
        box = step % 3
        if step % 7 == 0:
            there.discard(box)
        elif box not in there:
            there.add(box)
            drawn.append(event)
    found = [e for box in boxes for e in recording.events(box, "Boxes3D:half_sizes")]
    assert sorted(found) == drawn, "one that is there already is not drawn again"


def test_the_layout_is_in_the_file(recording: Recording) -> None:
    assert len(recording.recordings) == 1
    assert len(recording.blueprints) == 1
    assert recording.views >= {
        *("3D", "2D", "TimeSeries", "StateTimeline", "TextLog", "Dataframe", "Map")
    }
    plots = set(recording.view_names.values())
    assert "/scan" not in plots, "it is drawn; its limits are no curves"
    assert "/voltage" in plots


@pytest.mark.long
def test_two_runs_have_their_own_roots_and_the_divergence_is_marked(tmp_path: Path) -> None:
    gallery.write_gallery(tmp_path / "a.mcap", STEPS)
    gallery.write_gallery(tmp_path / "b.mcap", STEPS, differs_from=20)
    export([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "ab.rrd")
    both = Recording(tmp_path / "ab.rrd")
    assert both.events("/run_a/topics/map", "GridMap:data") == sent_at()
    assert both.events("/run_b/topics/map", "GridMap:data") == sent_at()
    assert both.values("/run_b/topics/map", "CoordinateFrame:frame")[0] == ["b/odom"]
    assert both.static["/frames/odom/b"]["Transform3D:child_frame"] == ["b/odom"]
    assert both.static["/frames/odom/b"]["Transform3D:parent_frame"] == ["odom"]
    assert both.static["/run_b/topics/voltage"]["SeriesLines:names"] == ["b data"]

    diverged = sent_at()[20]
    agreement = both.rows["/divergence/agreement"]
    by_row = sorted((r["row"], *r["StateChange:state"]) for r in agreement if "row" in r)
    assert by_row[:2] == [(0, "the runs agree"), (diverged, "the runs differ")]
    by_time = [r["StateChange:state"] for r in agreement if "sim_time" in r]
    assert by_time == [["the runs agree"], ["the runs differ"]]
    (text,) = both.static["/divergence"]["TextDocument:text"]
    assert f"the first {diverged} events agree" in " ".join(text.split())
    assert "pose.pose.position.x" in text
    a, b = (gallery.messages(20, 0, shift)["/odom"][1] for shift in (0.0, 0.5))
    assert str(a.pose.pose.position.x)[:8] in text
    assert str(b.pose.pose.position.x)[:8] in text
    chain = [row["StateChange:state"][0] for row in both.rows["/divergence/chain"]]
    assert any(f"#{diverged} " in step for step in chain)


def test_two_runs_open_on_the_divergence_with_their_lanes_in_pairs(tmp_path: Path) -> None:
    gallery.write_gallery(tmp_path / "a.mcap", STEPS)
    gallery.write_gallery(tmp_path / "b.mcap", STEPS, differs_from=20)
    for by_event in (False, True):
        output = tmp_path / f"{by_event}.rrd"
        export([tmp_path / "a.mcap", tmp_path / "b.mcap"], output, by_event=by_event)
        both = Recording(output)
        lanes = [path for path in sorted(both.rows) if path.startswith("/lanes/robot")]
        assert lanes == ["/lanes/robot/a", "/lanes/robot/b"]
        row = sent_at()[20]
        stamp = next(r["sim_time"] for r in both.rows["/run_a/events"] if r["row"] == row)
        (opens,) = both.layout["TimePanelBlueprint:timeline"]
        assert opens == ("row" if by_event else "sim_time")
        (selected,) = both.layout["TimePanelBlueprint:time_selection"]
        assert selected["min"] == (row if by_event else stamp)
        tabs = [both.view_names.get(tab, "") for tab in both.active_tabs]
        assert ("Callbacks by row" if by_event else "Callbacks by time") in tabs


def test_commands_are_steps_and_axes_have_their_colours(tmp_path: Path) -> None:
    gallery.write_gallery(tmp_path / "run.mcap", 3)
    export([tmp_path / "run.mcap"], tmp_path / "run.rrd")
    static = Recording(tmp_path / "run.rrd").static
    steps = {p for p, curve in static.items() if "SeriesLines:interpolation_mode" in curve}
    assert {p for p in steps if p.startswith("/topics/cmd_vel/")} == {
        "/topics/cmd_vel/linear",
        "/topics/cmd_vel/angular",
    }
    assert not [p for p in steps if p.startswith(("/topics/odom", "/topics/scan"))]
    position = static["/topics/odom/pose.pose.position"]
    assert position["SeriesLines:names"] == ["x", "y", "z"]
    for place, colour in enumerate(position["SeriesLines:colors"]):
        red_green_blue = colour.to_bytes(4, "big")[:3]
        assert max(red_green_blue) == red_green_blue[place], "x is red, y green, z blue"


@pytest.mark.long
def test_the_distance_between_two_runs_is_that_of_their_last_values(tmp_path: Path) -> None:
    gallery.write_gallery(tmp_path / "a.mcap", STEPS)
    gallery.write_gallery(tmp_path / "b.mcap", STEPS, differs_from=20)
    export([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "ab.rrd")
    both = Recording(tmp_path / "ab.rrd")
    found = both.values("/divergence/distance/odom/pose.pose.position", "Scalars:scalars")
    assert [apart for (apart,) in found] == pytest.approx([0.0] * 20 + [0.5] * (STEPS - 20))
    assert "/divergence/distance/voltage" not in both.rows, "it is equal in both"
    assert both.static["/run_b/topics/odom/track"]["Points3D:labels"] == ["b"]


@pytest.mark.long
def test_two_equal_runs_are_said_to_be_equal(tmp_path: Path) -> None:
    for name in ("a", "b"):
        gallery.write_gallery(tmp_path / f"{name}.mcap", 3)
    export([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "ab.rrd")
    both = Recording(tmp_path / "ab.rrd")
    (text,) = both.static["/divergence"]["TextDocument:text"]
    assert text.startswith("# The runs are identical")
    assert not [path for path in both.rows if path.startswith("/divergence/distance")]
    states = [r["StateChange:state"] for r in both.rows["/divergence/agreement"]]
    assert states == [["the runs agree"]] * 2, "by time and by row"


def test_images_without_a_view_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gallery.write_gallery(tmp_path / "a.mcap", 3)
    for module in ("export", "layout"):
        monkeypatch.setattr(f"rsltrace_viewer.rerun_export.{module}.IMAGES_MAX", 0)
    done = export([tmp_path / "a.mcap"], tmp_path / "a.rrd")
    assert any("no view of the images on /camera/image" in note for note in done.notes)


@pytest.mark.long
def test_an_interrupted_run_is_shown_as_far_as_it_goes(tmp_path: Path) -> None:
    trace_maker.write_run(tmp_path / "run.mcap", 15_000)
    data = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    done = export([tmp_path / "cut.mcap"], tmp_path / "cut.rrd")
    assert f"it has only the first {done.events} events" in done.notes[0]
    cut = Recording(tmp_path / "cut.rrd")
    assert 4096 <= done.events < 15_000
    assert len(cut.rows["/events"]) == done.events
    assert len(cut.events("/topics/count", "Scalars:scalars")) > done.events // 4


def test_a_run_without_events_can_be_shown(tmp_path: Path) -> None:
    with trace_maker.Opened(tmp_path / "run.mcap") as feeder:
        feeder.writer.close(result={"stop_reason": "duration", "exit_code": "0"})
    assert export([tmp_path / "run.mcap"], tmp_path / "run.rrd").events == 0
    assert Recording(tmp_path / "run.rrd").blueprints


def test_a_service_call_is_below_services(tmp_path: Path) -> None:
    feeder = trace_maker.write_run(tmp_path / "run.mcap", 40)
    export([tmp_path / "run.mcap"], tmp_path / "run.rrd")
    recording = Recording(tmp_path / "run.rrd")
    calls = [
        event
        for event, outputs in enumerate(feeder.outputs)
        if any(output.kind is OutputKind.REQUEST for output in outputs)
    ]
    name = "std_srvs.srv.Trigger"
    sent = recording.events("/services/check/request", f"{name}_Request:message")
    assert sent == calls
    answered = recording.events("/services/check/response", f"{name}_Response:message")
    assert answered == [event + 1 for event in calls]
    assert recording.static["/services/check/response"]["SeriesLines:names"] == ["success"]
    assert "SeriesLines:names" not in recording.static["/services/check/request"]


def test_what_was_there_stays_until_the_recording_is_whole(tmp_path: Path) -> None:
    trace_maker.write_run(tmp_path / "run.mcap", 300)
    data = bytearray((tmp_path / "run.mcap").read_bytes())
    data[len(data) // 3] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(data)
    output = tmp_path / "run.rrd"
    output.write_bytes(b"precious")
    with pytest.raises(TraceError):
        export([tmp_path / "damaged.mcap"], output, force=True)
    assert output.read_bytes() == b"precious"
    export([tmp_path / "run.mcap"], output, force=True)
    assert Recording(output).blueprints
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("schema", "why"),
    [
        ("p/E[] all\n====\nMSG: p/E\n", "a sequence of p/msg/E, which has no fields"),
        (
            "p/T[2000] t\n====\nMSG: p/T\np/U[2000] u\n====\nMSG: p/U\nint8 x\n",
            " values, more than 1048576",
        ),
        ("nowhere/Type t\n", "is not usable"),
        (
            "p/T0 t\n"
            + "".join(f"====\nMSG: p/T{n}\np/T{n + 1} a\np/T{n + 1} b\n" for n in range(24))
            + "====\nMSG: p/T24\n",
            " values, more than 1048576",
        ),
        ("p/E[] all\n====\nMSG: p/E\np/F f\n====\nMSG: p/F\n", "a sequence of p/msg/E, which"),
    ],
)
def test_topics_whose_types_ask_for_everything_are_left_out(
    schema: str, why: str, tmp_path: Path
) -> None:
    trace_maker.write_run(tmp_path / "run.mcap", 300)
    parts = mcap_parts.take_apart((tmp_path / "run.mcap").read_bytes())
    for part in parts:
        record = part.record if part.opcode == Opcode.SCHEMA else None
        if isinstance(record, Schema) and record.name.startswith("std_msgs/"):
            record.data = schema.replace("====", "=" * 80).encode()
            part.record = record
    (tmp_path / "hostile.mcap").write_bytes(mcap_parts.put_together(parts))
    done = export([tmp_path / "hostile.mcap"], tmp_path / "run.rrd")
    assert done.notes
    assert all(why in line for line in done.notes)
    assert len(Recording(tmp_path / "run.rrd").rows["/events"]) == done.events


def test_a_damaged_chunk_is_found_before_the_loader_reads_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a chunk that unpacks to less than it says, it waits for the rest."""
    trace_maker.write_run(tmp_path / "run.mcap", 300)
    parts = mcap_parts.take_apart((tmp_path / "run.mcap").read_bytes())
    chunk = next(part for part in parts if part.opcode == Opcode.CHUNK)
    record = chunk.record
    assert isinstance(record, Chunk)
    record.uncompressed_size += 1000
    chunk.record = record
    (tmp_path / "hostile.mcap").write_bytes(mcap_parts.put_together(parts))
    monkeypatch.setattr(chunks_module, "McapReader", lambda *_, **__: pytest.fail("it is read"))
    with pytest.raises(TraceError, match=r"hostile\.mcap: the chunk at offset \d+ is damaged"):
        export([tmp_path / "hostile.mcap"], tmp_path / "run.rrd")
    assert not (tmp_path / "run.rrd").exists()


def fails_as_folder(folder: Path) -> None:
    export([folder / "run.mcap"], folder)


def fails_as_trace(folder: Path) -> None:
    export([folder / "run.mcap"], folder / "run.mcap", force=True)


def fails_as_existing(folder: Path) -> None:
    (folder / "run.rrd").write_bytes(b"precious")
    export([folder / "run.mcap"], folder / "run.rrd")


def fails_without_folder(folder: Path) -> None:
    export([folder / "run.mcap"], folder / "nowhere" / "run.rrd")


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (fails_as_folder, "is a folder"),
        (fails_as_trace, "is the trace itself"),
        (fails_as_existing, "use --force"),
        (fails_without_folder, "does not exist"),
    ],
)
def test_output_that_cannot_be_is_refused(
    tmp_path: Path, action: Callable[[Path], None], message: str
) -> None:
    trace_maker.write_run(tmp_path / "run.mcap", 10)
    before = (tmp_path / "run.mcap").read_bytes()
    with pytest.raises(OutputError, match=message):
        action(tmp_path)
    assert (tmp_path / "run.mcap").read_bytes() == before
    if (tmp_path / "run.rrd").exists():
        assert (tmp_path / "run.rrd").read_bytes() == b"precious"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_a_device_or_pipe_is_not_replaced(tmp_path: Path) -> None:
    """Root could have /dev/null replaced by a recording."""
    trace_maker.write_run(tmp_path / "run.mcap", 10)
    os.mkfifo(tmp_path / "run.rrd")
    (tmp_path / "link.rrd").symlink_to("run.rrd")
    for name in ("run.rrd", "link.rrd"):
        with pytest.raises(OutputError, match=rf"{name} is a named pipe"):
            export([tmp_path / "run.mcap"], tmp_path / name, force=True)
    assert (tmp_path / "run.rrd").is_fifo()


def test_a_link_leads_to_the_recording_that_is_replaced(tmp_path: Path) -> None:
    trace_maker.write_run(tmp_path / "run.mcap", 10)
    (tmp_path / "real.rrd").write_bytes(b"old")
    (tmp_path / "link.rrd").symlink_to("real.rrd")
    done = export([tmp_path / "run.mcap"], tmp_path / "link.rrd", force=True)
    assert (tmp_path / "link.rrd").is_symlink()
    assert (tmp_path / "real.rrd").stat().st_size == done.bytes > 100


@pytest.mark.long
def test_nothing_is_left_of_an_export_that_fails(tmp_path: Path) -> None:
    trace_maker.write_run(tmp_path / "run.mcap", 15_000)
    data = bytearray((tmp_path / "run.mcap").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 64] = bytes(range(100, 164))
    (tmp_path / "run.mcap").write_bytes(data)
    with pytest.raises(TraceError, match=r"run\.mcap"):
        export([tmp_path / "run.mcap"], tmp_path / "run.rrd")
    assert not (tmp_path / "run.rrd").exists()


@pytest.mark.parametrize("size", [4096, 40_000, 100_000])
def test_a_full_disk_is_said_and_nothing_is_left(tmp_path: Path, size: int) -> None:
    trace_maker.write_run(tmp_path / "run.mcap", 300)
    (tmp_path / "run.rrd").write_bytes(b"precious")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        with pytest.raises(OutputError, match=r"run\.rrd cannot be written: File too large"):
            export([tmp_path / "run.mcap"], tmp_path / "run.rrd", force=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "run.rrd").read_bytes() == b"precious"
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.long
def test_two_exports_of_a_run_hold_the_same(tmp_path: Path) -> None:
    from rsltrace_viewer.rerun_export.picture import fingerprint

    gallery.write_gallery(tmp_path / "a.mcap", 3)
    gallery.write_gallery(tmp_path / "b.mcap", 3, differs_from=1)
    prints = []
    for other in "aab":
        export([tmp_path / "a.mcap", tmp_path / f"{other}.mcap"], tmp_path / "x.rrd", force=True)
        prints.append(fingerprint(tmp_path / "x.rrd"))
    assert prints[0] == prints[1] != prints[2]
