"""Small files that ask for much: memory and time follow what is there, not what is claimed."""

from __future__ import annotations

import itertools
import json
import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zstandard
from mcap.opcode import Opcode
from trace_maker import Opened, boundaries, opcodes, write_run

from rsltrace.errors import OutputError, TraceError
from rsltrace.trace import writer as writer_module
from rsltrace.trace.decode import Decoder, Decoders
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.mcap import records as limits
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.states import state_after
from rsltrace.trace.writer import TraceWriter

CHUNK = 0x06


def peak_mb(script: str) -> float:
    """Run a script in a process of its own and return the most memory it had, in MB.

    What ``getrusage`` gives is never less than that of whoever started it.
    """
    ending = "\nfor line in open('/proc/self/status'):"
    ending += "\n    if line.startswith('VmHWM:'): print(int(line.split()[1]) / 1024)"
    done = subprocess.run(
        [sys.executable, "-c", script + ending], capture_output=True, text=True, check=True
    )
    return float(done.stdout.splitlines()[-1])


def bomb(size: int) -> bytes:
    """Zeros that take a thirty-thousandth of their size."""
    compressor = zstandard.ZstdCompressor(level=19).compressobj(size=size)
    block = bytes(1 << 20)
    return b"".join(compressor.compress(block) for _ in range(size >> 20)) + compressor.flush()


@pytest.mark.long
@pytest.mark.parametrize("complete", [True, False])
def test_a_chunk_that_unpacks_to_gigabytes_is_refused(tmp_path: Path, complete: bool) -> None:
    """As large as it says, so that only a limit helps: 70 kB for 2 GB."""
    path = tmp_path / "run.mcap"
    write_run(path, 40)
    data = path.read_bytes()
    offsets = boundaries(data)
    at = offsets[opcodes(data, offsets).index(CHUNK)]
    size = 2 << 30
    packed = bomb(size)
    body = bytes(16) + size.to_bytes(8, "little") + bytes(4) + b"\4\0\0\0zstd"
    body += len(packed).to_bytes(8, "little") + packed
    path.write_bytes(data[:at] + b"\6" + len(body).to_bytes(8, "little") + body)
    assert path.stat().st_size < 150_000
    script = f"""
from rsltrace.errors import TraceError
from rsltrace.trace.reader import Trace
try:
    Trace.open({str(path)!r})
    raise SystemExit("it was opened")
except TraceError as error:
    assert "a chunk of {size} bytes" in str(error), error
"""
    assert peak_mb(script) < 800


def test_a_chunk_of_events_is_as_large_as_the_table_says(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, 40)
    with Trace.open(path) as trace:
        trace._segments.table = trace.segments.copy()
        trace._segments.table["events"] = 3
        with pytest.raises(TraceError, match=r"a chunk of \d+ bytes, where at most 315 can be"):
            list(trace.events())


def test_an_entity_with_an_id_that_no_run_reaches_is_refused(tmp_path: Path) -> None:
    """Tables by id would have 32 GiB."""
    path = tmp_path / "run.mcap"
    with TraceWriter(path, force=True) as writer:
        writer.add_entity(Entity(1, 1, EntityKind.NODE, "/a", "", 0, {}))
        writer.add_entity(Entity(2**32 - 1, 1, EntityKind.TIMER, "t", "", 0, {}))
        writer.close(result={})
    with Trace.open(path) as trace, pytest.raises(TraceError, match="has the id 4294967295"):
        _ = trace.entities


def test_a_schema_of_many_strings_is_refused_at_once() -> None:
    text = "".join(f"string[4096] text_{number}\n" for number in range(500))
    begin = time.process_time()
    with pytest.raises(TraceError, match="2048000 strings or messages"):
        Decoder(ChannelInfo(1, "/t", "x/msg/T", "ros2msg", text, {}))
    assert time.process_time() - begin < 5


def test_schemas_have_a_limit_together(monkeypatch: pytest.MonkeyPatch) -> None:
    decoders = Decoders()
    monkeypatch.setattr(limits, "SCHEMAS_ITEMS_MAX", 50)
    for number in range(40):
        text = f"string[10] text_{number % 5}\n"  # five schemas, on eight channels each
        decoders.of(ChannelInfo(number, f"/t{number}", "x/msg/T", "ros2msg", text, {}))
    decoders.of(ChannelInfo(100, "/more", "x/msg/T", "ros2msg", "string[10] a\n", {}))
    with pytest.raises(TraceError, match="/last cannot be decoded: the schemas of this trace"):
        decoders.of(ChannelInfo(101, "/last", "x/msg/T", "ros2msg", "string[10] b\n", {}))


def test_a_shared_decoder_names_the_topic_of_the_message() -> None:
    decoders = Decoders()
    for number, topic in enumerate(("/one", "/two")):
        decoder = decoders.of(ChannelInfo(number, topic, "x/msg/T", "ros2msg", "uint64 a\n", {}))
        with pytest.raises(TraceError, match=f"a message on {topic} does not fit"):
            decoder.decode(b"\0\1\0\0")


def test_a_state_has_the_bytes_that_are_there(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    leaf = {"dtype": "<f8", "shape": [1 << 28], "blocks": {"0": "AAAA"}}
    with Opened(path) as feeder:
        node = feeder.entity(EntityKind.NODE, "/n")
        feeder.writer.add_state(0, node, 0, json.dumps({"x": {"x": leaf}}))
        feeder.event(EventKind.TIMER, node, 0)
        feeder.writer.close(result={})
    with Trace.open(path) as trace, pytest.raises(TraceError, match="of which there are fewer"):
        state_after(trace, node, 0)


def test_a_message_that_no_reader_would_take_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "MESSAGE_BYTES_MAX", 1 << 20)
    with Opened(tmp_path / "run.mcap") as feeder:
        channel = feeder.writer.add_channel("/big", "x/msg/T", "uint8[] data\n")
        feeder.payload(channel, 0, bytes(1 << 20))
        with pytest.raises(OutputError, match=r"leave its topic out \(record: exclude:"):
            feeder.payload(channel, 0, bytes(2 << 20))


@pytest.mark.skipif(sys.platform == "win32", reason="no named pipes")
def test_a_trace_is_not_written_over_a_pipe_or_a_device(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="it is a named pipe"):
        TraceWriter(tmp_path / "pipe", force=True)
    with pytest.raises(OutputError, match="it is a device"):
        TraceWriter(Path(os.devnull), force=True)


# -- what is stored is checked --------------------------------------------------------------------


def flipped(path: Path, target: Path, text: bytes, offset: int = 0) -> Path:
    """Write a copy of a file with one bit of a text in it changed."""
    data = bytearray(path.read_bytes())
    data[data.index(text) + offset] ^= 0x01
    target.write_bytes(data)
    return target


def test_info_and_diff_find_a_flipped_bit_of_the_settings(tmp_path: Path) -> None:
    from click.testing import CliRunner

    from rsltrace.cli.main import cli

    runs = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for steps, path in zip((40, 41), runs, strict=True):
        with Opened(path) as feeder:
            feeder.writer.add_metadata("rsltrace:environment", {"numpy": "2.3.4"})
            node = feeder.entity(EntityKind.NODE, "/n")
            for step in range(steps):
                feeder.event(EventKind.TIMER, node, step)
            feeder.event(EventKind.TIMER, node, 1000 + steps)
            feeder.writer.close(result={})
    damaged = flipped(runs[1], tmp_path / "damaged.mcap", b"2.3.4")
    for arguments in (["info", damaged], ["diff", runs[0], damaged], ["diff", damaged, runs[0]]):
        result = CliRunner().invoke(cli, list(map(str, arguments)))
        assert result.exit_code == 2, result.output
        said = " ".join(result.output.split())
        assert "damaged.mcap: the metadata" in said, said
        assert "the checksum of 'rsltrace:environment' does not match" in said, said
    assert CliRunner().invoke(cli, ["diff", *map(str, runs)]).exit_code == 1


def test_a_flipped_bit_in_the_metadata_of_a_cut_trace_is_found_wherever_it_is(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, 300)
    data = path.read_bytes()
    offsets = boundaries(data)
    codes = list(opcodes(data, offsets))
    cut_at = offsets[len(codes) - 1 - codes[::-1].index(Opcode.CHUNK)]
    path.write_bytes(data[:cut_at])
    with Trace.open(path) as trace:
        assert not trace.complete
        assert trace.environment["python"] == "3.12.3"
    records = [at for at, code in zip(offsets, codes, strict=False) if code == Opcode.METADATA]
    for record in (at for at in records if at < cut_at):
        (length,) = struct.unpack_from("<Q", data, record + 1)
        for at in range(record + 9, record + 9 + length):
            damaged = bytearray(data[:cut_at])
            damaged[at] ^= 0x01
            path.write_bytes(damaged)
            with pytest.raises(TraceError, match=r"damaged|no trace|not a trace|trace format"):
                Trace.open(path).close()


# -- interrupted, or damaged ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[int]]:
    """A trace of three segments without its end, and where its records begin."""
    path = tmp_path_factory.mktemp("cut") / "run.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer_module, "EVENTS_PER_SEGMENT", 100)
        write_run(path, 300)
    data = path.read_bytes()
    offsets = boundaries(data)
    chunks = [
        at for at, code in zip(offsets, opcodes(data, offsets), strict=False) if code == CHUNK
    ]
    return data[: chunks[-1] + 50], [at for at in offsets if at <= chunks[-1]]


@pytest.mark.parametrize("byte", [0, 1, 3, 5])
def test_damage_in_the_middle_of_a_cut_trace_does_not_pass_for_an_earlier_cut(
    tmp_path: Path, cut: tuple[bytes, list[int]], byte: int
) -> None:
    """The opcode, or the length, of each record but those that say what the file is."""
    data, offsets = cut
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    with Trace.open(path) as trace:
        assert not trace.complete
        whole = trace.event_count
    for at in offsets[3:-1]:
        damaged = bytearray(data)
        damaged[at + byte] ^= 0x40
        path.write_bytes(damaged)
        with pytest.raises(TraceError) as caught:
            Trace.open(path)
        said = str(caught.value)
        found = int(said.split("the first ")[1].split()[0])
        assert found <= at, said
        assert f"of {len(data)} bytes are whole, and more follows" in said
        path.write_bytes(data[:found])  # what the message says helps
        with Trace.open(path) as trace:
            assert trace.event_count <= whole


@pytest.mark.long
def test_a_cut_trace_whose_channels_are_damaged_has_all_events_or_is_refused(
    tmp_path: Path, cut: tuple[bytes, list[int]]
) -> None:
    """MCAP has no checksum for them, and chunks of an unknown channel are no events."""
    data, offsets = cut
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    with Trace.open(path) as trace:
        whole = trace.event_count, len(trace.entities)
    refused = 0
    for at, end in itertools.pairwise(offsets):
        for byte in range(at + 9, end) if data[at] == Opcode.CHANNEL else ():
            damaged = bytearray(data)
            damaged[byte] ^= 0x04
            path.write_bytes(damaged)
            try:
                with Trace.open(path) as trace:
                    assert (trace.event_count, len(trace.entities)) == whole, byte
            except TraceError:
                refused += 1
    assert refused > 4 * len("/rsltrace/events")


def test_an_opcode_that_no_record_has_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, 10)
    data = path.read_bytes()
    at = boundaries(data)[opcodes(data, boundaries(data)).index(CHUNK)]
    path.write_bytes(data[:at] + b"\x7f" + data[at + 1 : -8])
    with pytest.raises(TraceError, match=f"no record of MCAP begins with 127.*first {at} of"):
        Trace.open(path)
