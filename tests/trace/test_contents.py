"""``--check`` finds what was changed under right checksums: messages and entities have hashes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from mcap.opcode import Opcode
from mcap.records import Schema

from campaigns.attack import mcap_parts
from campaigns.attack.families.texts import with_strings
from rsltrace.cli.main import cli
from rsltrace.errors import TraceError
from rsltrace.trace.contents import check_contents
from rsltrace.trace.reader import Trace

SAMPLES = Path(__file__).parents[2] / "sample_traces"
SAMPLE = SAMPLES / "nondeterministic_callback" / "a.mcap"

Change = Callable[[bytes, int], bytes]


def _forged(folder: Path, topic: str, change: Change) -> Path:
    parts = mcap_parts.take_apart(SAMPLE.read_bytes())
    mcap_parts.change_messages(parts, topic, change)
    path = folder / "forged.mcap"
    path.write_bytes(mcap_parts.put_together(parts))
    return path


def _renamed(old: bytes, new: bytes) -> Change:
    return lambda data, nth: with_strings(
        data, "/rsltrace/entities", lambda n, text: new if text == old else text
    )


def _checked(path: Path) -> None:
    with Trace.open(path) as trace:
        trace.check()
        check_contents(trace)


@pytest.mark.parametrize(
    "path", sorted(SAMPLES.glob("*/*.mcap")), ids=lambda path: path.parent.name
)
def test_what_was_recorded_passes(path: Path) -> None:
    _checked(path)


@pytest.mark.parametrize(
    ("topic", "change", "said"),
    [
        ("/push", lambda data, nth: data[:-1] + bytes([data[-1] ^ 1]), "message 0 on /push is not"),
        ("/scan", lambda data, nth: data[:-4] if nth == 3 else data, "message 3 on /scan is"),
        ("/scan", lambda data, nth: data[::-1], "message 0 on /scan is not the one that event 3"),
        ("/rsltrace/entities", _renamed(b"/push", b"/pull"), "/pull|entity"),
        ("/rsltrace/entities", _renamed(b"/obstacle_filter", b"/obstacle_fister"), "entity"),
    ],
)
def test_what_was_changed_under_right_checksums_does_not(
    tmp_path: Path, topic: str, change: Change, said: str
) -> None:
    path = _forged(tmp_path, topic, change)
    with Trace.open(path) as trace, Trace.open(SAMPLE) as sample:
        assert trace.digest == sample.digest, "the chain says nothing of it"
    with pytest.raises(TraceError, match=said) as raised:
        _checked(path)
    assert str(path) in str(raised.value)
    assert "after it was recorded" in str(raised.value) or "damaged" in str(raised.value)


def _without_channel(parts: list[mcap_parts.Part], end: int) -> None:
    parts.remove(next(part for part in parts if part.opcode == Opcode.CHANNEL))


def _with_another_type(parts: list[mcap_parts.Part], end: int) -> None:
    part = [part for part in parts[:end] if part.opcode == Opcode.SCHEMA][-1]
    schema = part.record
    assert isinstance(schema, Schema)
    schema.name += "s"
    part.record = schema


def _with_another_type_in_between(parts: list[mcap_parts.Part], end: int) -> None:
    place = max(at for at in range(end) if parts[at].opcode == Opcode.SCHEMA)
    parts.insert(place + 1, mcap_parts.Part(Opcode.SCHEMA, parts[place].body))
    _with_another_type(parts, end)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_without_channel, "its channels are not those before it"),
        (_with_another_type, "its channels are not those before it"),
        (_with_another_type_in_between, "defined twice, in two ways"),
    ],
)
def test_definitions_that_the_summary_has_otherwise_are_found(
    tmp_path: Path, change: Callable[[list[mcap_parts.Part], int], None], said: str
) -> None:
    """Who reads a file from its start sees those, and no summary."""
    parts = mcap_parts.take_apart(SAMPLE.read_bytes())
    change(parts, [part.opcode for part in parts].index(Opcode.DATA_END))
    path = tmp_path / "forged.mcap"
    path.write_bytes(mcap_parts.put_together(parts))
    with pytest.raises(TraceError, match=said):
        _checked(path)


def test_a_number_of_outputs_that_no_memory_holds_is_refused(tmp_path: Path) -> None:
    parts = mcap_parts.take_apart(SAMPLE.read_bytes())
    huge = struct.pack("<I", (1 << 32) - 1)
    mcap_parts.change_messages(
        parts, "/rsltrace/events", lambda data, nth: data[:68] + huge + data[72:]
    )
    mcap_parts.rehash(parts)
    path = tmp_path / "forged.mcap"
    path.write_bytes(mcap_parts.put_together(parts))
    with pytest.raises(TraceError, match="not as many as the events say"):
        _checked(path)


def test_forging_nothing_passes(tmp_path: Path) -> None:
    _checked(_forged(tmp_path, "/push", lambda data, nth: data))


def test_a_cut_trace_passes(tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(SAMPLE.read_bytes()[:-500])
    _checked(path)


@pytest.mark.parametrize(
    ("field", "text", "said"),
    [(2, b"no JSON", "its detail is no JSON"), (0, b"\xff", "an entity of the trace cannot")],
)
def test_what_cannot_be_read_is_told_with_the_file(
    tmp_path: Path, field: int, text: bytes, said: str
) -> None:
    """Two files are open in a diff."""
    path = _forged(
        tmp_path,
        "/rsltrace/entities",
        lambda data, nth: with_strings(
            data, "/rsltrace/entities", lambda n, old: text if n == field else old
        ),
    )
    with Trace.open(path) as trace, pytest.raises(TraceError, match=said) as raised:
        _ = trace.entities
    assert str(raised.value).startswith(f"{path}: ")


def test_a_record_that_lies_about_its_length_under_right_checksums_is_found(tmp_path: Path) -> None:
    """Reading goes by the summary and never meets it; other tools walk the file and do."""
    with SAMPLE.open("rb") as file:
        data = bytearray(file.read())
    end = struct.unpack_from("<Q", data, len(data) - 8 - 20)[0]  # the footer: where the summary is
    at = 8
    while data[at] != Opcode.MESSAGE_INDEX:
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    struct.pack_into("<Q", data, at + 1, 1 << 40)
    struct.pack_into("<I", data, end - 4, zlib.crc32(data[: end - 13]))
    path = tmp_path / "lies.mcap"
    path.write_bytes(data)
    with (
        Trace.open(path) as trace,
        pytest.raises(TraceError, match=f"record at byte {at} runs past the end"),
    ):
        trace.check()


def test_a_message_that_lies_about_its_length_is_found_in_every_chunk(tmp_path: Path) -> None:
    for number, of_sample in enumerate(mcap_parts.take_apart(SAMPLE.read_bytes())):
        if of_sample.opcode != Opcode.CHUNK:
            continue
        parts = mcap_parts.take_apart(SAMPLE.read_bytes())
        data = bytearray(mcap_parts.chunk_data(parts[number]))
        data[1] ^= 1
        mcap_parts.set_chunk_data(parts[number], bytes(data))
        path = tmp_path / "lies.mcap"
        path.write_bytes(mcap_parts.put_together(parts))
        with pytest.raises(TraceError, match="damaged"):
            _checked(path)


def test_a_kind_that_nobody_knows_is_told_with_the_file(tmp_path: Path) -> None:
    parts = mcap_parts.take_apart(SAMPLE.read_bytes())
    mcap_parts.change_messages(
        parts, "/rsltrace/events", lambda data, nth: data[:-2] + b"\xff" + data[-1:]
    )
    path = tmp_path / "forged.mcap"
    path.write_bytes(mcap_parts.put_together(parts))
    with Trace.open(path) as trace, pytest.raises(TraceError, match=r"forged\.mcap: event 0: 255"):
        trace.event(0)
    shown = CliRunner().invoke(cli, ["cat", str(path)])
    assert shown.exit_code == 2
    assert "forged.mcap: event 0: 255 is not a valid EventKind" in " ".join(shown.output.split())
