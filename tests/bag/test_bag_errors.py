# ruff: noqa: E501  the table of messages reads better in one line each
"""What cannot be played is refused with the file's name and what to do."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType

from rsltrace.errors import BagError
from rsltrace.trace.recordings import open_bag

Maker = Callable[..., Path]
Sample = tuple[int, str, bytes]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def message(path: str | Path, **options: Any) -> str:
    with pytest.raises(BagError) as caught, open_bag(path, **options) as bag:
        list(bag.messages())
    return str(caught.value)


def test_nothing_there() -> None:
    assert message("nowhere") == "nowhere: there is no such bag"


def test_a_folder_that_is_no_bag(folder: Path) -> None:
    (folder / "bag").mkdir()
    assert message("bag") == "bag: not a bag: there is no metadata.yaml and no recording in it"
    (folder / "bag" / "x_0.mcap").touch()
    assert message("bag") == (
        "bag: there is no metadata.yaml; make one with 'ros2 bag reindex bag', or name a file in "
        "it (x_0.mcap)"
    )


def test_files_that_are_no_bags(folder: Path) -> None:
    (folder / "a.mcap").write_bytes(b"")
    assert message("a.mcap") == (
        "a.mcap: the file is empty: nothing was recorded, or the copy failed"
    )
    (folder / "a.txt").write_bytes(b"hello")
    assert message("a.txt") == (
        "a.txt: not a bag: neither MCAP nor sqlite3 (name a bag's folder, or one .mcap or .db3 "
        "file)"
    )
    (folder / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    assert message("a.bag") == "a.bag: a ROS 1 bag; convert it with 'rosbags-convert'"


def test_metadata_named_instead_of_its_folder(bag_maker: Maker, samples: list[Sample]) -> None:
    bag_maker(Path("bag"), samples)
    assert message("bag/metadata.yaml") == "bag/metadata.yaml: name the bag's folder, bag"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("storage_identifier: mcap", "storage_identifier: rocks", "bag/metadata.yaml: the storage 'rocks' is unknown (only mcap and sqlite3); convert the bag with 'ros2 bag convert'"),
        ("storage_identifier: mcap", "storage_identifier: sqlite3", "bag/bag.mcap: mcap, but metadata.yaml says sqlite3; run 'ros2 bag reindex'"),
        ("storage_identifier: mcap", "x: mcap", "bag/metadata.yaml: the key 'storage_identifier' is missing; run 'ros2 bag reindex'"),
        ("- bag.mcap", "- gone.mcap", "bag/metadata.yaml: gone.mcap is listed but not there; put it back, or run 'ros2 bag reindex' to do without"),
        ("- bag.mcap", "- ../../bag.mcap", None),
        ("compression_mode: ''", "compression_mode: lzma", "bag/metadata.yaml: the compression '' by 'lzma' is unknown (only zstd, by file or message); convert the bag with 'ros2 bag convert'"),
        ("rosbag2_bagfile_information:", "rosbag2_bagfile_information: 3\nx:", "bag/metadata.yaml: not the metadata of a bag; run 'ros2 bag reindex'"),
    ],
)  # fmt: skip
def test_metadata_that_is_wrong(
    bag_maker: Maker, samples: list[Sample], old: str, new: str, expected: str | None
) -> None:
    metadata = bag_maker(Path("bag"), samples) / "metadata.yaml"
    text = metadata.read_text(encoding="utf-8")
    assert old in text
    metadata.write_text(text.replace(old, new, 1), encoding="utf-8")
    if expected is None:  # only the name counts: a bag cannot point outside its folder
        open_bag("bag").close()
    else:
        assert message("bag") == expected


def test_metadata_that_is_no_yaml(bag_maker: Maker, samples: list[Sample]) -> None:
    metadata = bag_maker(Path("bag"), samples) / "metadata.yaml"
    metadata.write_bytes(b"a: [\n")
    problem = "expected the node content, but found '<stream end>' in line 2"
    assert message("bag") == f"bag/metadata.yaml: not YAML ({problem}); run 'ros2 bag reindex'"
    metadata.write_bytes(b"\xff\xfe")
    assert message("bag").startswith("bag/metadata.yaml: not YAML (")
    metadata.write_bytes(b"")
    assert message("bag") == (
        "bag/metadata.yaml: not the metadata of a bag; run 'ros2 bag reindex'"
    )


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_without_messages(bag_maker: Maker, storage: str) -> None:
    bag_maker(Path("bag"), [], storage=storage, topics=["/a"])
    assert message("bag") == "bag: the bag is empty: it holds no messages"


def test_selections_that_leave_nothing(bag_maker: Maker, samples: list[Sample]) -> None:
    bag_maker(Path("bag"), samples, topics=["/quiet"])
    assert message("bag", topics=["/t1", "/imu/*"]) == (
        "bag: no topic matches '/imu/*'; there are /quiet, /t0, /t1, /t2"
    )
    assert message("bag", exclude=["*"]) == (
        "bag: every topic is excluded: the bag has /quiet, /t0, /t1, /t2"
    )
    assert message("bag", topics=["/quiet"]) == (
        "bag: nothing to play: no message on the selected topics (/quiet)"
    )
    assert message("bag", start_offset_ns=10**9) == (
        "bag: nothing to play: no message on the selected topics from 1 s after the start on (the "
        "bag is 290 ns long)"
    )
    assert message("bag", start_offset_ns=-1) == (
        "bag: the start offset must not be negative, got -1 ns"
    )


def test_recordings_of_other_kinds(mcap_maker: Maker, samples: list[Sample]) -> None:
    mcap_maker(Path("a.mcap"), samples, profile="ros1")
    assert message("a.mcap") == (
        "a.mcap: not a ROS 2 recording: its MCAP profile is 'ros1'; convert it with "
        "'rosbags-convert'"
    )
    mcap_maker(Path("a.mcap"), samples, profile="", encoding="json")
    assert message("a.mcap") == (
        "a.mcap: topic /t0 is encoded as 'json'; only ROS 2's 'cdr' can play: exclude it"
    )
    # Without a profile it is still a recording, as long as the messages are CDR.
    open_bag(mcap_maker(Path("a.mcap"), samples, profile="")).close()


def test_log_times_beyond_ros_time(mcap_maker: Maker) -> None:
    mcap_maker(Path("a.mcap"), [(2**63, "/a", b"\0\1\0\0")])
    assert message("a.mcap") == (
        "a.mcap: log times are not within 0 to 2^63 - 1 nanoseconds; the recorder's clock or the "
        "file is broken"
    )


def test_qos_that_cannot_be_read(mcap_maker: Maker, samples: list[Sample]) -> None:
    mcap_maker(Path("a.mcap"), samples, metadata={"offered_qos_profiles": "[1]"})
    assert message("a.mcap") == "a.mcap: topic /t0: a QoS profile was expected, not 1"


def outcome(path: Path) -> tuple[list[Sample], str | None]:
    """What a file gives: its messages, or the text of the error."""
    try:
        with open_bag(path) as bag:
            topics = bag.topics
            return [
                (stamp, topics[topic].name, data) for stamp, topic, data in bag.messages()
            ], None
    except BagError as error:
        return [], str(error)


# --- cut off --------------------------------------------------------------------------------------


def test_a_cut_file_says_how_far_it_is_good(mcap_maker: Maker, samples: list[Sample]) -> None:
    path = mcap_maker(Path("a.mcap"), samples, chunk_size=150, compression=CompressionType.NONE)
    path.write_bytes(path.read_bytes()[:1500])
    assert message("a.mcap") == (
        "a.mcap: the recording was cut off, its footer and index are missing: the first 1462 of "
        "1500 bytes are whole, with 5 chunks, up to log time 0.000001150. Repair it with 'mcap "
        "recover a.mcap -o repaired.mcap' (and 'ros2 bag reindex' if it belongs to a bag folder)"
    )
    path.write_bytes(b"\x89MCAP0\r\n")
    assert "the first 8 of 8 bytes are whole, with 0 chunks. Repair it" in message("a.mcap")


def test_a_cut_file_without_chunks_says_how_far_it_is_good(
    mcap_maker: Maker, samples: list[Sample]
) -> None:
    path = mcap_maker(Path("a.mcap"), samples, use_chunking=False)
    path.write_bytes(path.read_bytes()[:1200])
    assert (
        "bytes are whole, with 0 chunks and 23 messages outside chunks, up to log time 0.000001220"
    ) in message("a.mcap")


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}])
def test_a_file_cut_anywhere_is_refused(mcap_maker: Maker, options: dict[str, Any]) -> None:
    samples = [(i, "/a", b"\0\1\0\0" + bytes(8)) for i in range(2)]
    data = mcap_maker(Path("a.mcap"), samples, chunk_size=60, **options).read_bytes()
    for size in range(len(data)):
        Path("cut.mcap").write_bytes(data[:size])
        assert message("cut.mcap").startswith("cut.mcap: ")


def test_a_missing_middle_is_refused(mcap_maker: Maker, samples: list[Sample]) -> None:
    path = mcap_maker(Path("a.mcap"), samples, chunk_size=150)
    data = path.read_bytes()
    for start in range(100, 1000, 37):
        path.write_bytes(data[:start] + data[start + 50 :])
        assert "repair it with 'mcap recover'" in message(path)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.99])
def test_a_cut_database_is_refused(bag_maker: Maker, share: float) -> None:
    samples = [(i, "/a", bytes(500)) for i in range(2000)]
    path = bag_maker(Path("bag"), samples, storage="sqlite3") / "bag.db3"
    size = path.stat().st_size
    with path.open("r+b") as file:
        file.truncate(int(size * share))
    assert message("bag") == (
        f"bag/bag.db3: the database was cut off: {int(size * share)} of {size} bytes are there; "
        "recover it with sqlite3's '.recover', then run 'ros2 bag reindex' on the bag's folder"
    )


def test_a_cut_compressed_file_is_refused(bag_maker: Maker, samples: list[Sample]) -> None:
    path = bag_maker(Path("bag"), samples, compression="file") / "bag.mcap.zstd"
    path.write_bytes(path.read_bytes()[:-20])
    assert "bag.mcap" in message("bag")


def test_a_database_of_something_else(folder: Path) -> None:
    database = sqlite3.connect("a.db3")
    database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY)")
    database.commit()
    database.close()
    assert message("a.db3") == ("a.db3: a database, but not one of rosbag2 (tables are missing)")


# --- damaged --------------------------------------------------------------------------------------


def test_a_wrong_crc_is_noticed_on_reaching_its_chunk(mcap_bytes: Any) -> None:
    file = mcap_bytes()
    file.chunk([(0, 10, b"good")]).chunk([(0, 20, b"bad")], crc=1234)
    file.finish(Path("a.mcap"), ["/a"])
    with open_bag("a.mcap") as bag:
        messages = bag.messages()
        assert next(messages) == (10, 0, b"good")
        with pytest.raises(BagError) as caught:
            next(messages)
    assert str(caught.value) == (
        "a.mcap: the chunk's CRC does not match its content, in the chunk at byte 117 (log time "
        "0.000000020 to 0.000000020); repair it with 'mcap recover'"
    )


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"times": (5, 15)}, "messages lie outside the times the index promises"),
        ({"times": (15, 30)}, "messages lie outside the times the index promises"),
        ({"compression": "brotli"}, "the compression 'brotli' is unknown (not zstd or lz4)"),
        ({"compression": "x" * 600}, "the compression 'xxx"),
        ({"compression": "zstd"}, "the chunk cannot be decompressed"),
        ({"compression": "lz4"}, "the chunk cannot be decompressed"),
        ({"size": 3}, "the chunk holds 65 bytes where 3 are promised"),
        ({"size": 2**62}, f"a chunk of {2**62} bytes"),
        ({"inner": b"\x05" + b"\xff" * 40}, "a message runs past the end of its chunk"),
        ({"inner": b"\x03" + b"\xff" * 40}, "a record runs past the end of its chunk"),
        ({"inner": b"\x05\x01" + bytes(7) + b"x"}, "a record runs past the end of its chunk"),
        ({"inner": b"\x05\x01"}, "a record runs past the end of its chunk"),
    ],
)
def test_damaged_chunks(mcap_bytes: Any, wrong: dict[str, Any], expected: str) -> None:
    file = mcap_bytes().chunk([(0, 1, b"good")])
    file.chunk([(0, 10, b"12"), (0, 20, b"3")], **wrong).finish(Path("a.mcap"), ["/a"])
    text = message("a.mcap")
    assert text.startswith(f"a.mcap: {expected}")
    assert "in the chunk at byte 117 " in text


def test_a_chunk_that_claims_to_be_enormous_takes_no_memory(mcap_bytes: Any) -> None:
    import lz4.frame
    import zstandard

    for name, bomb in (
        ("zstd", zstandard.compress(bytes(100 << 20))),
        ("lz4", lz4.frame.compress(bytes(100 << 20))),
    ):
        file = mcap_bytes()
        file.chunk([(0, 1, b"")], inner=bomb, compression=name, size=10)
        file.finish(Path("a.mcap"), ["/a"])
        assert "bytes where 10 are promised" in message("a.mcap")


def test_a_chunk_index_that_points_nowhere(mcap_bytes: Any) -> None:
    file = mcap_bytes().chunk([(0, 1, b"x")])
    good = file.indexes[0]
    for offset in (0, 30, 10**6):
        file = mcap_bytes().chunk([(0, 1, b"x")])
        file.indexes[0] = good[:16] + offset.to_bytes(8, "little") + good[24:]
        file.finish(Path("a.mcap"), ["/a"])
        assert message("a.mcap").endswith("repair it with 'mcap recover'")


WRITERS: list[dict[str, Any]] = [
    {},
    {"compression": CompressionType.NONE},
    {"use_chunking": False, "enable_data_crcs": True},
    {"index_types": IndexType.NONE, "use_statistics": False, "enable_data_crcs": True},
]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.data(), st.sampled_from(WRITERS))
def test_a_changed_byte_is_an_error_or_changes_nothing(
    mcap_maker: Maker, data: Any, options: dict[str, Any]
) -> None:
    samples = [(i * 7, f"/t{i % 2}", b"\0\1\0\0" + bytes([i]) * 8) for i in range(12)]
    with tempfile.TemporaryDirectory() as folder:
        path = mcap_maker(Path(folder, "a.mcap"), samples, chunk_size=150, **options)
        content = bytearray(path.read_bytes())
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] ^= data.draw(st.integers(1, 255))
        path.write_bytes(content)
        got, error = outcome(path)
        assert error.startswith(str(path)) if error else got == samples


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.data())
def test_a_damaged_database_is_never_a_crash(tmp_path: Path, bag_maker: Maker, data: Any) -> None:
    original = tmp_path / "bag" / "bag.db3"
    if not original.exists():
        bag_maker(tmp_path / "bag", [(i, "/a", bytes(300)) for i in range(100)], storage="sqlite3")
    path = tmp_path / "damaged.db3"
    shutil.copy(original, path)
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    content[at : at + 16] = data.draw(st.binary(min_size=16, max_size=16))
    path.write_bytes(content)
    _, error = outcome(path)
    assert error is None or error.startswith(str(path))


def test_a_closed_bag_says_so(mcap_maker: Maker, samples: list[Sample]) -> None:
    bag = open_bag(mcap_maker(Path("a.mcap"), samples))
    bag.close()
    with pytest.raises(ValueError, match=r"a\.mcap is closed"):
        next(bag.messages())
