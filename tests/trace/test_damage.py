"""Cut and corrupted traces: an error or the truth, never something else."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from trace_maker import Feeder, boundaries, opcodes, write_run

from rsltrace.diff.file_kind import is_trace
from rsltrace.errors import TraceError, TraceFormatError
from rsltrace.trace import writer as writer_module
from rsltrace.trace.format import METADATA_RESULT
from rsltrace.trace.index import metadata_checksum
from rsltrace.trace.reader import Trace
from rsltrace.trace.segments import event_of, output_of
from tests.tiers import cases

CHUNK = 0x06
EVENTS_PER_SEGMENT = 200
"""Small segments here: every cut is compared with everything that was written."""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Feeder]:
    path = tmp_path_factory.mktemp("small") / "run.mcap"
    feeder = write_run(path, 40)
    return path.read_bytes(), feeder


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Feeder]:
    """Three segments, the last one not full."""
    path = tmp_path_factory.mktemp("large") / "run.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer_module, "EVENTS_PER_SEGMENT", EVENTS_PER_SEGMENT)
        feeder = write_run(path, 2 * EVENTS_PER_SEGMENT + 70)
    return path.read_bytes(), feeder


def check_truth(trace: Trace, feeder: Feeder) -> int:
    """Compare all of a trace's events, outputs and payloads with what was written."""
    count = trace.event_count
    assert trace.digest == f"{feeder.events[count - 1].chain_hash if count else 0:016x}"
    events = [event_of(row) for part in trace.events() for row in part]
    assert events == feeder.events[:count]
    outputs = [output_of(row) for part in trace.outputs() for row in part]
    assert outputs == [output for own in feeder.outputs[:count] for output in own]
    for channel, payloads in feeder.payloads.items():
        topic = trace.channels[channel].topic if channel in trace.channels else ""
        found = list(trace.messages(topic))
        assert found == [(s, i, d) for i, (s, d) in enumerate(payloads)][: len(found)]
    for output in outputs:
        found = trace.payload(output)
        if found is not None and not found[1].startswith("/rsltrace/details"):
            channel = trace.channel_of(output)
            assert channel is not None
            assert (found[0], found[2]) == feeder.payloads[channel.id][output.sequence]
    return count


def open_and_check(path: Path, data: bytes, feeder: Feeder) -> int | None:
    """Return how many events a damaged file gives, all right; None if it gives an error."""
    path.write_bytes(data)
    try:
        with Trace.open(path) as trace:
            return check_truth(trace, feeder)
    except TraceError:
        return None


def test_cut_at_every_record_reads_up_to_the_last_whole_segment(
    tmp_path: Path, large: tuple[bytes, Feeder]
) -> None:
    data, feeder = large
    offsets = boundaries(data)
    codes = opcodes(data, offsets)
    with_events = [i for i, code in enumerate(codes) if code == CHUNK][3::3]  # first: entities
    path = tmp_path / "cut.mcap"
    for cut in range(2, len(offsets) - 1):
        expected = sum(1 for chunk in with_events if chunk < cut)
        events = open_and_check(path, data[: offsets[cut]], feeder)
        total = len(feeder.events) if expected == 3 else expected * EVENTS_PER_SEGMENT
        assert events == total, f"cut before record {cut}"


@pytest.mark.long
def test_cut_anywhere_reads_up_to_the_last_whole_segment(
    tmp_path: Path, large: tuple[bytes, Feeder]
) -> None:
    data, feeder = large
    offsets = boundaries(data)
    codes = opcodes(data, offsets)
    chunks = [i for i, code in enumerate(codes) if code == CHUNK]
    ends = [offsets[i + 1] for i in chunks[3::3]]
    rng = random.Random(1)
    path = tmp_path / "cut.mcap"
    for _ in range(150):
        cut = rng.randrange(offsets[2], len(data))
        whole = sum(1 for end in ends if end <= cut)
        expected = len(feeder.events) if whole == 3 else whole * EVENTS_PER_SEGMENT
        assert open_and_check(path, data[:cut], feeder) == expected, f"cut at {cut}"


def test_cut_at_every_byte_of_the_beginning_and_the_end(
    tmp_path: Path, small: tuple[bytes, Feeder]
) -> None:
    data, feeder = small
    first_chunk = boundaries(data)[opcodes(data, boundaries(data)).index(CHUNK)]
    path = tmp_path / "cut.mcap"
    for cut in range(0, first_chunk, 7):
        assert open_and_check(path, data[:cut], feeder) in (None, 0)
    for cut in range(len(data) - 60, len(data)):
        assert open_and_check(path, data[:cut], feeder) == len(feeder.events)


def test_a_trace_cut_behind_its_header_is_called_one(
    tmp_path: Path, small: tuple[bytes, Feeder]
) -> None:
    """A run may be killed between its first two records; a disk may leave zeros there."""
    data, _ = small
    path = tmp_path / "cut.mcap"
    _, header_end, format_end = boundaries(data)[:3]
    header = data[:header_end]
    for kept in (*(data[:end] for end in range(header_end, format_end)), header + bytes(5000)):
        path.write_bytes(kept)
        assert is_trace(path)
        with pytest.raises(TraceFormatError, match=r"a trace of rsltrace .* cut behind its header"):
            Trace.open(path)
    for other in (header.replace(b"rsltrace 0", b"rsltracer0"), header + data[format_end:-100]):
        path.write_bytes(other)
        assert not is_trace(path)
        with pytest.raises(TraceFormatError, match="not a trace of rsltrace"):
            Trace.open(path)


def test_zeros_where_a_crash_came_before_the_data_end_the_trace(
    tmp_path: Path, large: tuple[bytes, Feeder]
) -> None:
    data, feeder = large
    offsets = boundaries(data)
    chunks = [i for i, code in enumerate(opcodes(data, offsets)) if code == CHUNK]
    cut = offsets[chunks[4]]
    events = open_and_check(tmp_path / "run.mcap", data[:cut] + bytes(100_000), feeder)
    assert events == EVENTS_PER_SEGMENT


@pytest.mark.parametrize("chunk", range(4))
@pytest.mark.parametrize("complete", [True, False])
def test_a_corrupted_chunk_is_named_with_its_place(
    tmp_path: Path, small: tuple[bytes, Feeder], chunk: int, complete: bool
) -> None:
    data, _ = small
    offsets = boundaries(data)
    place = [i for i, code in enumerate(opcodes(data, offsets)) if code == CHUNK][chunk]
    damaged = bytearray(data if complete else data[:-20])
    middle = (offsets[place] + offsets[place + 1]) // 2
    damaged[middle] ^= 0x10
    path = tmp_path / "damaged.mcap"
    path.write_bytes(damaged)

    def read_all() -> None:
        with Trace.open(path) as trace:
            for part in (trace.events, trace.outputs):
                for _ in part():
                    pass
            list(trace.messages("/count"))
            assert trace.entities

    with pytest.raises(TraceError, match=rf"damaged\.mcap: .*chunk at offset {offsets[place]} "):
        read_all()


@settings(
    max_examples=cases(50, 400),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255), cut=st.booleans())
def test_a_corrupted_byte_gives_an_error_or_the_truth(
    tmp_path: Path, small: tuple[bytes, Feeder], place: float, flip: int, cut: bool
) -> None:
    data, feeder = small
    damaged = bytearray(data[:-8] if cut else data)
    damaged[int(place * len(damaged))] ^= flip
    open_and_check(tmp_path / "damaged.mcap", bytes(damaged), feeder)


@pytest.mark.long
def test_every_corrupted_byte_is_found_by_check(
    tmp_path: Path, small: tuple[bytes, Feeder]
) -> None:
    data, _ = small
    path = tmp_path / "damaged.mcap"
    missed = []
    for offset in range(0, len(data), 13):
        damaged = bytearray(data)
        damaged[offset] ^= 0x01
        path.write_bytes(damaged)
        try:
            with Trace.open(path) as trace:
                trace.check()
                # A broken last line only makes the file look interrupted: it says so.
                if trace.complete:
                    missed.append(offset)
        except TraceError:
            pass
    assert missed == []


def test_a_digest_that_contradicts_the_events_is_an_error(
    tmp_path: Path, small: tuple[bytes, Feeder]
) -> None:
    data, feeder = small
    text = feeder.digest.encode()
    assert data.count(text) == 1
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    with Trace.open(path) as trace:
        result = trace.metadata(METADATA_RESULT)
    wrong = data.replace(text, b"0123456789abcdef")
    path.write_bytes(wrong)
    with pytest.raises(TraceError, match=r"the checksum of 'rsltrace:result' does not match"):
        Trace.open(path)
    checksums = (
        metadata_checksum(METADATA_RESULT, {**result, "digest": digest}).encode()
        for digest in (result["digest"], "0123456789abcdef")
    )
    path.write_bytes(wrong.replace(*checksums))
    with pytest.raises(TraceError, match=r"contradicts itself.*0123456789abcdef"):
        Trace.open(path)


def test_garbage_behind_any_record_is_an_error_or_the_truth(
    tmp_path: Path, small: tuple[bytes, Feeder]
) -> None:
    data, feeder = small
    rng = random.Random(2)
    path = tmp_path / "damaged.mcap"
    for offset in boundaries(data)[2:]:
        for _ in range(4):
            open_and_check(path, data[:offset] + rng.randbytes(rng.randrange(200)), feeder)


def test_a_chunk_that_claims_to_be_huge_costs_no_memory(
    tmp_path: Path, small: tuple[bytes, Feeder]
) -> None:
    data, _ = small
    offsets = boundaries(data)
    place = offsets[opcodes(data, offsets).index(CHUNK)]
    path = tmp_path / "huge.mcap"
    for size in (2**40, 2**63, 2**64 - 1):
        damaged = bytearray(data[:-8])
        damaged[place + 25 : place + 33] = size.to_bytes(8, "little")
        path.write_bytes(damaged)
        with pytest.raises(TraceError, match=r"a chunk of \d+ bytes"):
            Trace.open(path)
