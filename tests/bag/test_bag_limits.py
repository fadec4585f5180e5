"""Recordings that ask for much, and things that are no files."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zstandard

from rsltrace.diff.file_kind import is_recording, is_trace
from rsltrace.errors import BagError
from rsltrace.trace.mcap.records import CHUNK_BYTES_MAX
from rsltrace.trace.recordings import metadata as metadata_module
from rsltrace.trace.recordings import open_bag
from rsltrace.trace.recordings import reader as reader_module

Maker = Callable[..., Path]


def message(path: Path | str) -> str:
    with pytest.raises(BagError) as caught:
        open_bag(path)
    return str(caught.value)


def test_a_chunk_larger_than_any_bag_has_is_refused(mcap_bytes: Any, tmp_path: Path) -> None:
    file = mcap_bytes().chunk([(0, 1, b"good")])
    file.chunk([(0, 10, b"12")], size=CHUNK_BYTES_MAX + 1).finish(tmp_path / "a.mcap", ["/a"])
    with open_bag(tmp_path / "a.mcap") as bag, pytest.raises(BagError, match="where at most") as e:
        list(bag.messages())
    assert f"a chunk of {CHUNK_BYTES_MAX + 1} bytes" in str(e.value)


def test_a_compressed_file_that_fills_the_disk_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader_module, "FILE_BYTES_MIN", 1 << 20)
    path = tmp_path / "a.mcap.zstd"
    path.write_bytes(zstandard.compress(bytes(100 << 20)))
    assert "unpacks to more than" in message(path)


def test_a_compressed_message_that_takes_all_memory_is_refused(
    bag_maker: Maker, samples: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = bag_maker(tmp_path / "bag", samples, compression="message", storage="sqlite3")
    monkeypatch.setattr(reader_module, "MESSAGE_BYTES_MAX", 8)
    assert "it has more than 8 bytes" in message(path)


def test_messages_that_are_a_view_without_an_end_are_refused(
    bag_maker: Maker, samples: Any, tmp_path: Path
) -> None:
    path = bag_maker(tmp_path / "bag", samples, storage="sqlite3")
    with closing(sqlite3.connect(next(path.glob("*.db3")))) as base:
        base.execute("ALTER TABLE messages RENAME TO m")
        base.execute(
            "CREATE VIEW messages AS WITH RECURSIVE c(topic_id, timestamp, data) AS "
            "(SELECT 1, 1, x'00' UNION ALL SELECT 1, timestamp, x'00' FROM c) SELECT * FROM c"
        )
        base.commit()
    assert "a database with views" in message(path)


def test_a_metadata_file_of_any_size_is_not_parsed(
    bag_maker: Maker, samples: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = bag_maker(tmp_path / "bag", samples)
    monkeypatch.setattr(metadata_module, "METADATA_YAML_BYTES_MAX", 100)
    assert "larger than any bag's" in message(path)


def test_brackets_without_end_are_no_metadata(
    bag_maker: Maker, mcap_maker: Maker, samples: Any, tmp_path: Path
) -> None:
    path = bag_maker(tmp_path / "bag", samples)
    (path / "metadata.yaml").write_text("[" * 5000)
    assert "metadata.yaml: brackets are nested too deeply" in message(path)
    mcap_maker(tmp_path / "a.mcap", samples, metadata={"offered_qos_profiles": "[" * 5000})
    assert "the QoS profiles are nested too deeply" in message(tmp_path / "a.mcap")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_pipes_and_devices_are_no_recordings(tmp_path: Path) -> None:
    """And are not opened to find out, which would wait for a writer."""
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)
    assert (
        message(pipe) == f"{pipe} is a named pipe, not a regular file: name a bag's folder or file"
    )
    assert "is not a regular file" in message("/dev/zero")
    for path in (pipe, Path("/dev/zero")):
        assert not is_trace(path)
        assert not is_recording(path)
