"""Topics of traces made elsewhere, whose names mean something to a shell."""

from __future__ import annotations

from pathlib import Path

import pytest

from rsltrace.trace.recordings import open_bag
from rsltrace.trace.recordings.export import export_bag
from rsltrace.trace.writer import TraceWriter

TEXT = "string data\n"
SAY = b"\0\1\0\0\2\0\0\0"


@pytest.mark.parametrize("name", ["/a[bc]d", "/*", "/a?", "/a[", "/[!a]"])
def test_a_topic_is_exported_as_itself(tmp_path: Path, name: str) -> None:
    names = [name, "/abd", "/ab"]
    with TraceWriter(tmp_path / "run.mcap", force=False) as writer:
        for number, topic in enumerate(names):
            channel = writer.add_channel(topic, "std_msgs/msg/String", TEXT)
            writer.add_payload(channel, number, SAY + bytes([65 + number, 0]))
        writer.close(result={})
    assert export_bag(tmp_path / "run.mcap", tmp_path / "all") == 3
    with open_bag(tmp_path / "all") as bag:
        found = {bag.topics[number].name: data[8:9] for _, number, data in bag.messages()}
    assert found == {name: b"A", "/abd": b"B", "/ab": b"C"}
