"""Traces on a server: few requests, few bytes, and clear words when it does not work."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from diff_simulator import MS, Fault, NodePlan, Plan, Publication, Simulation, Storage
from hypothesis import given
from hypothesis import strategies as st

import rsltrace
from rsltrace.errors import SetupError, TraceError, TraceFormatError
from rsltrace.trace.mcap.open import open_source
from rsltrace.trace.mcap.remote import BLOCK_BYTES, CACHE_BYTES, RemoteSource
from rsltrace.trace.mcap.source import FileSource
from rsltrace.trace.reader import Trace
from tests.range_server import RangeServer

PLAN = Plan(
    (
        NodePlan("/source", timers=((MS, (Publication("/a"),)),)),
        NodePlan("/filter", subscriptions=(("/a", (Publication("/b"),)),)),
        NodePlan("/sink", subscriptions=(("/b", ()),)),
    ),
    end_ns=4000 * MS,
)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[RangeServer]:
    pytest.importorskip("fsspec")
    pytest.importorskip("aiohttp")
    server = RangeServer(tmp_path)
    yield server
    server.close()


def test_a_diff_over_http(server: RangeServer, tmp_path: Path) -> None:
    Simulation(PLAN, tmp_path / "a.mcap").run()
    fault = Fault("bit", 3 + 3 * 3000 + 1)
    Simulation(PLAN, tmp_path / "b.mcap", (fault,)).run()
    local = rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap")
    remote = rsltrace.diff(f"{server.address}/a.mcap", f"{server.address}/b.mcap")
    assert remote.agreeing == fault.at
    assert remote.divergences[0].messages == local.divergences[0].messages
    assert remote.divergences[0].messages[0].fields
    assert len(server.requests) < 40
    assert server.sent == remote.bytes_read < 1_500_000
    whole = (tmp_path / "a.mcap").stat().st_size + (tmp_path / "b.mcap").stat().st_size
    assert server.sent < whole * 0.8, "even here, where the files are small"


@pytest.mark.long
def test_identical_runs_over_http_cost_a_few_requests(server: RangeServer, tmp_path: Path) -> None:
    Simulation(PLAN, tmp_path / "a.mcap").run()
    assert rsltrace.diff(f"{server.address}/a.mcap", f"{server.address}/a.mcap").identical
    assert len(server.requests) <= 8
    assert server.sent < 10 * BLOCK_BYTES


@pytest.mark.long
def test_an_interrupted_trace_over_http(server: RangeServer, tmp_path: Path) -> None:
    """It has no index and is read from front to back, in pieces that grow."""
    Simulation(PLAN, tmp_path / "a.mcap", storage=Storage(100, "")).run()
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    diff = rsltrace.diff(tmp_path / "a.mcap", f"{server.address}/cut.mcap")
    assert diff.verdict is rsltrace.Verdict.AGREE_UNTIL_TRUNCATED
    assert not diff.b.complete
    assert len(server.requests) < len(data) // BLOCK_BYTES / 2


def test_a_server_without_ranges(server: RangeServer, tmp_path: Path) -> None:
    """It sends the whole file each time it is asked: once is enough."""
    server.ranges = False
    Simulation(PLAN, tmp_path / "a.mcap").run()
    with Trace.open(f"{server.address}/a.mcap") as trace:
        digest = trace.digest
        assert trace.bytes_read == trace.size
    with Trace.open(tmp_path / "a.mcap") as trace:
        assert trace.digest == digest
    assert len(server.requests) == 2


def test_what_is_not_there(server: RangeServer, tmp_path: Path) -> None:
    with pytest.raises(TraceError, match=rf"{server.address}/none.mcap does not exist"):
        Trace.open(f"{server.address}/none.mcap")
    (tmp_path / "text.mcap").write_bytes(b"hello, this is text")
    with pytest.raises(TraceFormatError, match=r"text.mcap is not a trace"):
        Trace.open(f"{server.address}/text.mcap")
    Simulation(PLAN, tmp_path / "a.mcap").run()
    server.broken = True
    with pytest.raises(TraceError, match=r"a.mcap cannot be read at offset \d+: .*500"):
        Trace.open(f"{server.address}/a.mcap")
    with pytest.raises((TraceError, SetupError), match=r"nothing://a/b"):
        Trace.open("nothing://a/b")


def test_a_recording_at_an_address(server: RangeServer, tmp_path: Path) -> None:
    from click.testing import CliRunner
    from mcap.writer import Writer

    from rsltrace.cli.main import cli

    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="somebody")
        writer.finish()
    result = CliRunner().invoke(cli, ["diff", f"{server.address}/bag.mcap", "other.mcap"])
    assert result.exit_code == 2
    said = " ".join(result.output.split())
    assert "plain MCAP recording" in said, said
    assert "download the recording first" in said, said


def test_without_fsspec(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(SetupError, match=r"pip install 'rsltrace\[remote\]'"):
        Trace.open("https://example.org/a.mcap")


def test_a_path_is_no_address(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"x")
    source = open_source(str(tmp_path / "a.mcap"))
    assert isinstance(source, FileSource)
    source.close()


CONTENT = bytes(range(256)) * 2000  # 512 kB


@given(st.lists(st.tuples(st.integers(0, len(CONTENT)), st.integers(0, 200_000)), max_size=20))
def test_blocks_give_what_was_asked_for(reads: list[tuple[int, int]]) -> None:
    fetched: list[tuple[int, int]] = []

    def fetch(begin: int, end: int) -> bytes:
        fetched.append((begin, end))
        return CONTENT[begin:end]

    source = RemoteSource("memory", len(CONTENT), fetch)
    for offset, length in reads:
        length = min(length, len(CONTENT) - offset)
        assert source.read_at(offset, length) == CONTENT[offset : offset + length]
    covered = [
        n for begin, end in fetched for n in range(begin // BLOCK_BYTES, -(-end // BLOCK_BYTES))
    ]
    assert len(covered) == len(set(covered)), "no block is fetched twice"
    assert source.requests == len(fetched)
    with pytest.raises(TraceError, match="beyond the end"):
        source.read_at(len(CONTENT) - 1, 2)


def test_memory_stays_bounded() -> None:
    source = RemoteSource("zeros", 1 << 40, lambda begin, end: bytes(end - begin))
    for place in range(200):
        source.read_at(place << 30, 300_000)
    assert len(source._blocks) * BLOCK_BYTES <= CACHE_BYTES
    assert len(source.read_at(5, CACHE_BYTES + 7)) == CACHE_BYTES + 7


def test_a_file_that_changes_while_it_is_read() -> None:
    source = RemoteSource("short", 1000, lambda begin, end: b"too little")
    with pytest.raises(TraceError, match="became shorter or longer"):
        source.read_at(0, 100)
    large = RemoteSource("large", 1 << 30, lambda begin, end: _Huge(1 << 30))
    with pytest.raises(TraceError, match="sends the whole file"):
        large.read_at(0, 100)


class _Huge(bytes):
    """Says that it is long."""

    def __new__(cls, length: int) -> _Huge:
        return super().__new__(cls)

    def __init__(self, length: int) -> None:
        self._length = length

    def __len__(self) -> int:
        return self._length
