"""Rerun opens a trace by itself, without any export: it is a plain ROS 2 MCAP."""

from __future__ import annotations

from pathlib import Path

import pytest
import rerun_gallery as gallery

pytest.importorskip("rerun")

from rerun.chunk import McapReader


def test_reruns_own_loader_opens_a_trace_as_it_is(tmp_path: Path) -> None:
    steps = 12
    feeder = gallery.write_gallery(tmp_path / "run.mcap", steps)
    reader = McapReader(tmp_path / "run.mcap", timeline_type="duration_ns")
    assert reader.info().profile == "ros2"
    rows: dict[str, int] = {}
    components: dict[str, set[str]] = {}
    for chunk in reader.stream():
        place = str(chunk.entity_path)
        names = set(chunk.to_record_batch().schema.names)
        if not chunk.is_static and "message_log_time" in names:
            components.setdefault(place, set()).update(names)
            for name in names:
                key = f"{place} {name}"
                rows[key] = rows.get(key, 0) + chunk.num_rows
    assert rows["/cloud Points3D:positions"] == steps
    assert rows["/camera/image Image:buffer"] == steps
    assert rows["/map GridMap:data"] == steps
    assert rows["/tf Transform3D:translation"] == steps
    assert rows["/rosout TextLog:text"] == steps
    assert rows["/odom nav_msgs.msg.Odometry:message"] == steps
    events = "/rsltrace/events rsltrace_msgs.msg.CallbackEvent:message"
    assert rows[events] == len(feeder.events)
    raw = {place for place, names in components.items() if "McapMessage:data" in names}
    assert raw == set(), "a schema that Rerun cannot read leaves bytes"
