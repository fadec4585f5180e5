"""``view --serve`` under attack: by strangers on the machine, by pages gone mad, by kills.

A client in a process of its own does what the attack says while the server runs, then looks
whether an honest page is still served, and ends the server. What it finds wrong it writes down.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import re
import signal
import socket
import struct
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from campaigns.attack import hostile
from campaigns.attack.corpus import Corpus
from campaigns.attack.families.common import Attack, Family
from campaigns.attack.model import Case, Command, Complaint, Limits, Ran, Wrong

_FOUND = "found.json"
_LIMITS = Limits(cpu_s=20, rss_mib=300, wall_s=400)
_SOON_S = 120.0
_ENDS = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}


class _Server:
    """The server as its clients see it."""

    def __init__(self, pid: int, port: int, said: Path) -> None:
        self.pid = pid
        self.port = port
        self._said = said
        self.token = ""
        self.wrong: list[str] = []

    def wait(self) -> None:
        """Wait until it says where it is, and is there."""
        until = time.monotonic() + _SOON_S
        while time.monotonic() < until:
            with contextlib.suppress(OSError):
                found = re.search(r"http://127\.0\.0\.1:\d+/([^/]+)/", self._said.read_text())
                if found:
                    self.token = found[1]
                    self.connect().close()
                    return
            time.sleep(0.05)
        raise TimeoutError("the server did not come up")

    def connect(self) -> socket.socket:
        """Return a new connection."""
        return socket.create_connection(("127.0.0.1", self.port), timeout=_SOON_S)

    def ask(self, path: str, *headers: str, method: str = "GET") -> bytes:
        """Return the answer to one request that is written as it is."""
        lines = [f"{method} {path} HTTP/1.1", *headers]
        if not any(header.lower().startswith("host:") for header in headers):
            lines.append(f"Host: 127.0.0.1:{self.port}")
        request = "\r\n".join([*lines, "Connection: close", "", ""])
        return self.send(request.encode("latin-1", "replace"))

    def send(self, data: bytes) -> bytes:
        """Send bytes; return the first that come back, empty if none do."""
        answer = b""
        with contextlib.suppress(OSError), self.connect() as connection:
            connection.sendall(data)
            while len(answer) < 65536 and (piece := connection.recv(65536)):
                answer += piece
        return answer

    def page(self) -> socket.socket:
        """Return a connection on which a page's messages go, which has started a viewer."""
        connection = self.connect()
        key = base64.b64encode(os.urandom(16)).decode()
        connection.sendall(
            f"GET /{self.token}/ws?width=80&height=24 HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\n"
            f"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: {key}\r\n"
            "Sec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        if b" 101 " not in connection.recv(4096):
            raise ConnectionError("no page")
        return connection

    def viewers(self) -> list[int]:
        """Return its children."""
        found = []
        for place in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError, ValueError, IndexError):
                state, parent = place.read_text().rpartition(")")[2].split()[:2]
                if int(parent) == self.pid and state not in "ZX":
                    found.append(int(place.parent.name))
        return found


def frame(data: bytes, opcode: int = 1, *, masked: bool = True, length: int | None = None) -> bytes:
    """Return a websocket's frame, with another length than its own if one is given."""
    size = len(data) if length is None else length
    mask = b"\0\0\0\0" if masked else b""
    bit = 0x80 if masked else 0
    if size < 126:
        head = struct.pack(">BB", 0x80 | opcode, bit | size)
    elif size < 1 << 16:
        head = struct.pack(">BBH", 0x80 | opcode, bit | 126, size)
    else:
        head = struct.pack(">BBQ", 0x80 | opcode, bit | 127, size % 2**63)
    return head + mask + data


# -- attacks: what a client does, before it looks whether all is well ------------------------------

_Client = Callable[[Random, _Server], None]


def _strangers(rng: Random, server: _Server) -> None:
    """Without the token nothing is served, whatever one asks for."""
    token = server.token
    guesses = [
        "",
        "ws",
        "static/",
        token[:-1] + "/",
        token[:-1] + ("A" if token[-1] != "A" else "B") + "/",
        token.swapcase() + "/",
        "x" + token + "/",
        "%00" + token + "/",
        "../" + token[:8] + "/",
        "static/../../../../etc/passwd",
        "%2e%2e/%2e%2e/etc/passwd",
        "?" + token,
        "#" + token,
        "download/" + "0" * 32,
        *(rng.choice(hostile.texts(Path("/nowhere"))).replace("\n", "") for _ in range(4)),
    ]
    for guess in rng.sample(guesses, 10):
        answer = server.ask("/" + guess.replace(" ", "%20"))
        _must_refuse(server, answer, guess)
    for inside in ("static/../../../../../../etc/passwd", "static//etc/passwd", "static/%2e%2e/"):
        answer = server.ask(f"/{token}/{inside}")
        if b"root:" in answer or b"server.py" in answer:
            server.wrong.append(f"a file of the machine is served at {inside}")


def _other_pages(rng: Random, server: _Server) -> None:
    """A page of somebody's in the same browser knows no token; but should it, it stays out."""
    path = f"/{server.token}/" + rng.choice(("", "ws"))
    for header in (
        "Origin: http://example.org",
        "Origin: null",
        f"Origin: http://127.0.0.1:{server.port}.example.org",
        f"Origin: http://127.0.0.1:{server.port - 1}",
        f"Origin: https://localhost:{server.port}@example.org",
        "Host: example.org",
        f"Host: example.org:{server.port}",
        "Host: ",
        "Host: 127.0.0.1",
    ):
        _must_refuse(server, server.ask(path, header), header)


def _must_refuse(server: _Server, answer: bytes, what: str) -> None:
    status = re.match(rb"HTTP/1\.[01] (\d+)", answer)
    if status and int(status[1]) < 400:
        server.wrong.append(f"{status[1].decode()} for a stranger's {what[:100]!r}")
    if b"/talker" in answer or b"hostile.mcap" in answer or server.token.encode() in answer:
        server.wrong.append(f"a stranger's {what[:100]!r} is told what it must not know")


def _half_requests(rng: Random, server: _Server) -> None:
    """Requests that never end, many of them at once, and an honest page beside them."""
    whole = f"GET /{server.token}/ HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n".encode()
    held = []
    for _ in range(rng.choice((5, 60))):
        held.append(server.connect())
        with contextlib.suppress(OSError):
            held[-1].sendall(whole[: rng.randrange(len(whole) - 2)])
    _must_serve(server)
    for connection in held:
        connection.close()


def _garbage(rng: Random, server: _Server) -> None:
    """Bytes that are no HTTP, or no good HTTP."""
    port = server.port
    host = f"Host: 127.0.0.1:{port}\r\n".encode()
    start = f"GET /{server.token}/".encode()
    requests = [
        rng.randbytes(3000),
        b"\x16\x03\x01\x02\x00" + rng.randbytes(300),
        b"GET / HTTP/1.1\r\n" + b"X: " + b"y" * 200_000 + b"\r\n\r\n",
        b"GET /" + b"a" * 200_000 + b" HTTP/1.1\r\n" + host + b"\r\n",
        b"".join((b"GET / HTTP/1.1\r\n", *(b"X%d: y\r\n" % n for n in range(5000)), b"\r\n")),
        b"BREW / HTTP/9.9\r\n\r\n",
        start + b" HTTP/1.1\r\n" + host + b"User-Agent: \x1b]0;owned\x07\x9b31m\r\n\r\n",
        start + b"?fontsize=\x1b[31m HTTP/1.1\r\n" + host + b"\r\n",
        start + b"%1b]0;owned%07 HTTP/1.1\r\n" + host + b"Referer: \xc2\x9b31m\r\n\r\n",
        b"POST /x HTTP/1.1\r\n" + host + b"Content-Length: 99999999999\r\n\r\nx",
        b"POST /x HTTP/1.1\r\n" + host + b"Transfer-Encoding: chunked\r\n\r\nFFFFFFFFFFFFFFFFF\r\n",
        start + b"ws HTTP/1.1\r\n" + host + b"Upgrade: websocket\r\nConnection: Upgrade\r\n\r\n",
    ]
    for request in rng.sample(requests, 6):
        with contextlib.suppress(OSError), server.connect() as connection:
            connection.settimeout(5)
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            connection.recv(4096)


def _mad_pages(rng: Random, server: _Server) -> None:
    """A page with the token that sends what no page does."""
    messages: list[Any] = [
        {},
        [],
        "stdin",
        7,
        None,
        [["stdin"]],
        ["stdin"],
        ["stdin", 7],
        ["stdin", "\ud800"],
        ["resize", {"width": "x", "height": None}],
        ["resize", {"width": hostile.number(rng), "height": hostile.number(rng)}],
        ["resize", {"width": -5, "height": 1e300}],
        ["resize", {}],
        ["resize"],
        ["ping", "\x1b]0;owned\x07" * 1000],
        ["ping"],
        ["focus", "blur"],
        ["quit"],
        ["deliver_file_start", "x"],
        ["stdin", "x" * 1_000_000],
        ["stdin", "\x1b[200~" + "\x1b]52;c;AAAA\x07" * 100],
    ]
    raw = [
        frame(b"{"),
        frame(b"\xff\xfe"),
        frame(b"[" * 100_000),
        frame(b"1" * 5000),
        frame(rng.randbytes(500), 2),
        frame(b"x", 9),
        frame(b"x" * 200, 9),
        frame(b"", 8),
        frame(b"", 15),
        frame(b"x", masked=False),
        frame(b"x", length=2**62),
        rng.randbytes(2000),
        *(frame(json.dumps(message).encode()) for message in messages),
    ]
    for data in rng.sample(raw, 4):
        with contextlib.suppress(OSError, TimeoutError), server.page() as page:
            page.settimeout(2)
            page.sendall(data)
            page.recv(65536)


def _mad_sizes(rng: Random, server: _Server) -> None:
    """A page that says it has a million columns, or none."""
    width, height = (rng.choice((0, -1, "x", 10**6, 10**12)) for _ in range(2))
    key = base64.b64encode(bytes(16)).decode()
    with contextlib.suppress(OSError), server.connect() as page:
        page.settimeout(10)
        page.sendall(
            f"GET /{server.token}/ws?width={width}&height={height} HTTP/1.1\r\n"
            f"Host: 127.0.0.1:{server.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        until = time.monotonic() + 6
        while time.monotonic() < until and page.recv(1 << 20):
            _viewers_are_small(server)


def _viewers_are_small(server: _Server) -> None:
    for pid in server.viewers():
        with contextlib.suppress(OSError):
            high = re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
            if high and int(high[1]) > 600 << 10:
                server.wrong.append(f"a viewer has taken {int(high[1]) >> 10} MiB")
                os.kill(pid, signal.SIGKILL)


def _pages_that_vanish(rng: Random, server: _Server) -> None:
    """Pages whose browser is gone, at any moment; and viewers that are killed."""
    pages = [server.page() for _ in range(rng.choice((1, 3)))]
    time.sleep(rng.choice((0.0, 0.3, 2.0)))
    if rng.random() < 0.3:
        for pid in server.viewers():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, rng.choice((signal.SIGKILL, signal.SIGSTOP)))
    for page in pages:
        if rng.random() < 0.7:  # a reset, not a farewell
            page.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        page.close()
    until = time.monotonic() + _SOON_S
    while server.viewers():
        if time.monotonic() > until:
            server.wrong.append(f"{len(server.viewers())} viewers outlive their pages")
            return
        time.sleep(0.1)


def _many_connections(rng: Random, server: _Server) -> None:
    """As many connections as a stranger can hold, and as many pages as nobody looks at."""
    held = []
    with contextlib.suppress(OSError):
        for _ in range(400):
            held.append(server.connect())
    _must_serve(server)
    pages = []
    with contextlib.suppress(OSError):
        for _ in range(24):
            pages.append(server.page())
    for one in (*held, *pages):
        one.close()
    if len(pages) > 20:
        server.wrong.append(f"{len(pages)} viewers at once")


def _ended_with_pages(rng: Random, server: _Server) -> None:
    """The server ends while pages are open: so do their viewers."""
    pages = [server.page() for _ in range(rng.choice((1, 2)))]
    time.sleep(rng.choice((0.0, 1.0, 3.0)))
    os.kill(server.pid, rng.choice((*_ENDS, signal.SIGKILL)))
    with contextlib.suppress(OSError):
        pages[0].settimeout(_SOON_S)
        while pages[0].recv(65536):
            pass


def _must_serve(server: _Server) -> None:
    """Ask as an honest page does."""
    answer = server.ask(f"/{server.token}/")
    if b"200 OK" not in answer[:20] or b"rsltrace view" not in answer:
        server.wrong.append(f"an honest page is told {answer[:200]!r}")


def _client(
    attack: _Client, rng: Random, port: int, said: Path, place: Path, served: bool, pid: int
) -> None:
    """Attack, see whether an honest page is served, end the server, write down what is wrong."""
    server = _Server(pid, port, said)
    try:
        server.wait()
        attack(rng, server)
        if served:
            _must_serve(server)
    except Exception as error:
        server.wrong.append(f"{type(error).__name__}: {error}")
    place.write_text(json.dumps(server.wrong))
    if served:
        os.kill(pid, rng.choice((signal.SIGINT, signal.SIGTERM)))


def _attack(client: _Client, *, served: bool = True) -> Attack:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        folder = case.folder
        (folder / "hostile.mcap").write_bytes(corpus.robot)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        case.names = ("hostile.mcap", str(port))
        said = folder.parent / "streams" / "stderr"
        said.unlink(missing_ok=True)
        act = partial(_client, client, rng, port, said, folder / _FOUND, served)
        allowed = frozenset((0, *_ENDS.values(), *(-number for number in _ENDS), -signal.SIGKILL))
        words = ("view", "hostile.mcap", "--serve", "--port", str(port))
        case.commands.append(
            Command(words, allowed, folder, fresh=True, limits=_LIMITS, client=act)
        )
        case.judge = lambda runs: _judge(case, runs)

    return attack


def _judge(case: Case, runs: Sequence[Ran]) -> list[Complaint]:
    (ran,) = runs
    place = case.folder / _FOUND
    if not place.exists():
        return [Complaint(Wrong.BROKEN, "the client did not come to an end", ran.line)]
    return [Complaint(Wrong.ANSWER, text, ran.line) for text in json.loads(place.read_text())]


FAMILY = Family(
    "serving",
    {
        "strangers": _attack(_strangers),
        "other-pages": _attack(_other_pages),
        "half-requests": _attack(_half_requests),
        "garbage": _attack(_garbage),
        "mad-pages": _attack(_mad_pages),
        "mad-sizes": _attack(_mad_sizes),
        "pages-that-vanish": _attack(_pages_that_vanish),
        "many-connections": _attack(_many_connections),
        "ended-with-pages": _attack(_ended_with_pages, served=False),
    },
    sliced=frozenset(("strangers", "garbage", "ended-with-pages")),
)
