"""Callbacks that a process sets for what arrives (``set_on_new_message_callback`` and its like)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros


def test_callbacks_for_what_arrives_are_called_once_for_each_arrival(
    compiled: Callable[[str], Path], tmp_path: Path
) -> None:
    (tmp_path / "job.yaml").write_text(f"nodes: [{{program: {compiled('listener.c')}}}]\n")
    result = run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap")
    assert result.error is None
    with Trace.open(tmp_path / "t.mcap") as trace:
        told = [trace.decode("/told", data).data for _, _, data in trace.messages("/told")]  # type: ignore[attr-defined]
        client = next(e for e in trace.entities.values() if e.kind is EntityKind.CLIENT)
        lines = [line.place.rpartition("/")[2] for line in trace.code_lines[client.id]]
    calls = (Path(__file__).parent / "listener.c").read_text().splitlines()
    assert lines == [
        f"listener.c:{number}" for number, line in enumerate(calls, 1) if "rcl_send_request" in line
    ]
    assert told == [1, 0, 1, 0, 3, 2, 2, 2, 1, 1]
    assert any("/listener: service /ask 4 (depth 2)" in note for note in result.notes)
