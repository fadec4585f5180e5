"""Servers that are slow, drip or never end, and addresses with secrets in them."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from diff_simulator import MS, Fault, NodePlan, Plan, Publication, Simulation

import rsltrace
from rsltrace.diff.report import render
from rsltrace.errors import TraceError
from rsltrace.trace.mcap import records as limits
from rsltrace.trace.mcap.source import public_address, redacted
from rsltrace.trace.reader import Trace
from tests.range_server import RangeServer

PLAN = Plan((NodePlan("/source", timers=((MS, (Publication("/a"),)),)),), end_ns=100 * MS)
SECRETS = ("hunter2", "alice", "5ecretS1gnature", "AKIA0123")

Behaviour = Callable[[socket.socket, bytes], None]


@pytest.fixture
def hostile() -> Iterator[Callable[[Behaviour], str]]:
    """Start a server that does as told with every connection; return its address."""
    pytest.importorskip("fsspec")
    pytest.importorskip("aiohttp")
    listening = socket.create_server(("127.0.0.1", 0))
    stopped = threading.Event()

    def start(behaviour: Behaviour) -> str:
        def answer(connection: socket.socket) -> None:
            with connection:
                try:
                    while not stopped.is_set() and (request := connection.recv(65536)):
                        behaviour(connection, request)
                except OSError:
                    pass

        def accept() -> None:
            while True:
                try:
                    connection, _ = listening.accept()
                except OSError:
                    return
                threading.Thread(target=answer, args=(connection,), daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        return f"http://127.0.0.1:{listening.getsockname()[1]}/run.mcap"

    yield start
    stopped.set()
    listening.close()


def head(length: int, status: str = "200 OK") -> bytes:
    return f"HTTP/1.1 {status}\r\nContent-Length: {length}\r\n\r\n".encode()


def opened(address: str) -> str:
    """Return the error of opening an address: one line."""
    with pytest.raises(TraceError) as caught:
        Trace.open(address)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_server_that_never_answers(
    hostile: Callable[[Behaviour], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "REQUEST_SECONDS_MAX", 0.3)
    address = hostile(lambda connection, request: time.sleep(600))
    begin = time.monotonic()
    assert "the server is too slow: one request took more than 0.3 s" in opened(address)
    assert time.monotonic() - begin < 300, "it did not wait for the answer"


def test_a_server_that_drips(
    hostile: Callable[[Behaviour], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each byte comes in time, the answer does not."""
    monkeypatch.setattr(limits, "REQUEST_SECONDS_MAX", 0.5)

    def drip(connection: socket.socket, request: bytes) -> None:
        connection.sendall(head(1_000_000))
        while not request.startswith(b"HEAD"):
            connection.sendall(b"x")
            time.sleep(0.02)

    assert "took more than 0.5 s" in opened(hostile(drip))  # the answer would take six hours


def test_a_server_that_is_slow_all_the_time(
    hostile: Callable[[Behaviour], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "REMOTE_SECONDS_MAX", 0.8)

    def slow(connection: socket.socket, request: bytes) -> None:
        time.sleep(0.25)
        if request.startswith(b"HEAD"):
            connection.sendall(head(10_000_000))
        else:
            first, last = map(int, request.split(b"bytes=")[1].split(b"\r\n")[0].split(b"-"))
            data = b"\x89MCAP0\r\n" + b"\x01" + (9_999_000).to_bytes(8, "little")
            body = (data + bytes(10_000_000))[first : last + 1]
            connection.sendall(head(len(body), "206 Partial Content") + body)

    assert "all requests took more than 0.8 s" in opened(hostile(slow))


def test_a_server_without_end(
    hostile: Callable[[Behaviour], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "RESPONSE_BYTES_MAX", 1 << 20)
    sent = 0

    def endless(connection: socket.socket, request: bytes) -> None:
        nonlocal sent
        if request.startswith(b"HEAD"):
            connection.sendall(head(1_000_000))
            return
        connection.sendall(b"HTTP/1.1 206 Partial\r\nTransfer-Encoding: chunked\r\n\r\n")
        while True:
            connection.sendall(b"10000\r\n" + bytes(65536) + b"\r\n")
            sent += 65536

    assert "sends more than 1048576 bytes where 16960 are asked for" in opened(hostile(endless))
    assert sent < 64 << 20


# -- secrets --------------------------------------------------------------------------------------


def signed(address: str, name: str) -> str:
    host = address.partition("://")[2]
    query = "X-Amz-Credential=AKIA0123%2Feu&X-Amz-Signature=5ecretS1gnature"
    return f"http://alice:hunter2@{host}/{name}?{query}"


class QueryServer(RangeServer):
    """Serves files whatever the query is, as a store with signed addresses does."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        handler = self._server.RequestHandlerClass
        answer = handler._answer

        def without_query(request: object, *, send: bool) -> None:
            request.path = request.path.partition("?")[0]  # type: ignore[attr-defined]
            answer(request, send=send)

        handler._answer = without_query


@pytest.fixture
def server(tmp_path: Path) -> Iterator[QueryServer]:
    pytest.importorskip("fsspec")
    pytest.importorskip("aiohttp")
    server = QueryServer(tmp_path)
    yield server
    server.close()


def test_secrets_of_an_address_are_in_no_report(server: QueryServer, tmp_path: Path) -> None:
    Simulation(PLAN, tmp_path / "a.mcap").run()
    Simulation(PLAN, tmp_path / "b.mcap", (Fault("bit", 50),)).run()
    diff = rsltrace.diff(signed(server.address, "a.mcap"), signed(server.address, "b.mcap"))
    assert diff.divergences
    assert diff.a.path == f"{server.address}/a.mcap?…"
    for form in ("text", "json", "markdown", "junit", "github"):
        report = "".join(render(diff, form))
        assert "a.mcap" in report or form == "github"
        assert not any(secret in report for secret in SECRETS), report


def test_secrets_of_an_address_are_in_no_error(server: QueryServer, tmp_path: Path) -> None:
    Simulation(PLAN, tmp_path / "a.mcap").run()
    (tmp_path / "text.mcap").write_bytes(b"hello, this is text")
    addresses = [signed(server.address, name) for name in ("text.mcap", "none.mcap")]
    addresses.append(signed("http://127.0.0.1:9", "closed.mcap"))
    addresses.append("nothing://alice:hunter2@host/a?sig=5ecretS1gnature")
    errors = list(map(opened, addresses))
    server.broken = True
    errors.append(opened(signed(server.address, "a.mcap")))
    assert "500" in errors[-1]
    for error in errors:
        assert not any(secret in error for secret in SECRETS), error
        assert "://" in error


@pytest.mark.parametrize("command", ["info", "cat"])
def test_an_address_where_a_path_is_wanted(command: str) -> None:
    from click.testing import CliRunner

    from rsltrace.cli.main import cli

    result = CliRunner().invoke(cli, [command, signed("https://example.org", "a.mcap")])
    assert result.exit_code == 2
    said = " ".join(result.output.split())
    assert "http://example.org/a.mcap?… is an address" in said
    assert not any(secret in said for secret in SECRETS)


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("https://host/a.mcap", "https://host/a.mcap"),
        ("https://user:p@ss@host:8/a.mcap#frag", "https://host:8/a.mcap"),
        ("https://host/a@b.mcap?sig=1", "https://host/a@b.mcap?…"),
        ("s3://key:secret@bucket/a.mcap", "s3://bucket/a.mcap"),
        ("simplecache::https://user:pass@host/a.mcap", "simplecache::https://host/a.mcap"),
    ],
)
def test_what_is_shown_of_an_address(address: str, shown: str) -> None:
    assert public_address(address) == shown
    told = redacted(f"500, url=URL('{address}') {json.dumps(address)}", address)
    assert told.count(shown) == 2


def test_a_library_that_writes_an_address_in_its_own_way() -> None:
    address = "https://us%65r:p%40ss@host/a?sig=abc%2Fdef"
    told = redacted("cannot open ('user', 'p@ss') https://x:y@host/?sig=abc/def", address)
    assert told == "cannot open ('…', '…') https://host/?…"
