"""Sockets, TLS, event loops and devices: recorded once, given again with nobody there."""

from __future__ import annotations

import gc
import http.server
import json
import os
import pty
import socket
import socketserver
import ssl
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.reader import Trace
from tests.free_port import free_port
from tests.guard.conftest import node_code

pytestmark = pytest.mark.ros

ONCE = "if vars(self).setdefault('done', False): return\nself.done = True\n"


@pytest.fixture
def go(tmp_path: Path) -> Callable[..., Any]:
    """Record a job of node ``m:N`` with ``guard: {socket: record, file: record}``; its result."""

    def record(code: str, name: str, replay: Any = None, guard: str = "") -> Any:
        (tmp_path / "m.py").write_text(code)
        guard = guard or "{socket: record, file: record, random: virtual}"
        (tmp_path / "job.yaml").write_text(
            f"nodes: [{{node: 'm:N'}}]\nstop: {{duration: 1.2s}}\nguard: {guard}\n"
            "start: 1767225600\n"  # urllib3 does not believe 1970
        )
        path = replay.path if replay is not None else None
        done = run(load_job(tmp_path / "job.yaml"), tmp_path / f"{name}.mcap", replay=path)
        assert done.error is None, done.error
        return done

    return record


def said(result: Any) -> list[Any]:
    """What a run's node said."""
    with Trace.open(result.path) as trace:
        texts = [trace.decode("/rosout", data).msg for *_, data in trace.messages("/rosout")]  # type: ignore[attr-defined]
    return [json.loads(text) for text in texts if text.startswith("[")]


class _Answering(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        body = f"{time.time_ns()} ".encode() * 20_000
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *arguments: object) -> None:
        pass


@pytest.fixture
def https(tmp_path: Path) -> Iterator[http.server.HTTPServer]:
    """An HTTPS server, with a certificate that ``ca.pem`` vouches for."""
    trustme = pytest.importorskip("trustme")
    authority = trustme.CA()
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("localhost", "127.0.0.1").configure_cert(context)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), _Answering)
    server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


BY_HTTPS = {
    "urllib": "urllib.request.urlopen(URL, context=CONTEXT, timeout=200).read().decode()",
    "requests": "requests.get(URL, verify=CA, timeout=200).text",
    "httpx": "httpx.get(URL, verify=CONTEXT, timeout=200).text",
    "httpx in asyncio": "asyncio.run(asking())",
    "aiohttp": "asyncio.run(fetching())",
    "asyncio streams": "asyncio.run(streaming())",
}
CLIENTS = """
CONTEXT = ssl.create_default_context(cafile=CA)
async def asking():
    async with httpx.AsyncClient(verify=CONTEXT, timeout=200) as client:
        return (await client.get(URL)).text
async def fetching():
    async with aiohttp.ClientSession() as session:
        async with session.get(URL, ssl=CONTEXT) as answer:
            return await answer.text()
async def streaming():
    reader, writer = await asyncio.open_connection('127.0.0.1', PORT, ssl=CONTEXT)
    writer.write(b'GET / HTTP/1.0\\r\\n\\r\\n')
    text = await reader.read()
    writer.close()
    return text.decode().split()[-1]
"""


@pytest.mark.long
@pytest.mark.parametrize("client", BY_HTTPS)
@pytest.mark.parametrize("place", ["callback", "thread"])
def test_an_answer_over_tls_is_given_again_without_the_server(
    go: Callable[..., Any],
    https: http.server.HTTPServer,
    tmp_path: Path,
    client: str,
    place: str,
) -> None:
    library = client.split()[0]
    if library not in ("urllib", "asyncio"):
        pytest.importorskip(library)
    imports = {"urllib": "urllib.request"}.get(library, library)
    port = https.server_address[1]
    action = f"text = {BY_HTTPS[client]}; self.say(len(text), text[-20:])"
    if place == "thread":
        action = f"def work():\n    {action}\nthreading.Thread(target=work).start()"
    code = node_code(
        f"{ONCE}{action}",
        imports=f"import asyncio, ssl, threading\nimport {imports}",
        module=f"CA, PORT = {str(tmp_path / 'ca.pem')!r}, {port}\n"
        f"URL = 'https://127.0.0.1:{port}/x'\n{CLIENTS}",
    )
    first = go(code, "first")
    assert said(first), "it was answered"
    assert said(go(code, "other")) != said(first)
    https.shutdown()
    https.server_close()
    again = go(code, "again", replay=first)
    assert said(again) == said(first)
    assert again.digest == first.digest


@pytest.fixture
def echo() -> Iterator[socketserver.ThreadingTCPServer]:
    """A server that answers each line with a count of its own, after a while."""

    class Echo(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            for line in self.rfile:
                time.sleep(0.01)
                self.wfile.write(b"%d " % time.time_ns() + line)

    class Server(socketserver.ThreadingTCPServer):
        daemon_threads = True
        block_on_close = False

    with Server(("127.0.0.1", 0), Echo) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


BY_SOCKET = {
    "select": """
with socket.create_connection(ADDRESS) as s:
    s.sendall(b'a\\n')
    ready = select.select([s], [], [], 200)
    answers = [len(ready[0]), s.recv(99).decode(), select.select([s], [s], [], 0.05)[1] == [s]]
""",
    "poll": """
with socket.create_connection(ADDRESS) as s:
    poll = select.poll(); poll.register(s, select.POLLIN); s.sendall(b'a\\n')
    answers = [len(poll.poll(200_000)), s.recv(99).decode(), poll.poll(20)]
""",
    "epoll": """
with socket.create_connection(ADDRESS) as s, select.epoll() as poll:
    poll.register(s, select.EPOLLIN); s.sendall(b'a\\n')
    answers = [len(poll.poll(20)), s.recv(99).decode(), poll.poll(0.02)]
""",
    "selectors": """
with socket.create_connection(ADDRESS) as s, selectors.DefaultSelector() as selector:
    s.setblocking(False)
    selector.register(s, selectors.EVENT_READ, 'mine'); s.sendall(b'a\\n')
    answers = [[key.data for key, _ in selector.select(200)], s.recv(99).decode()]
    try: s.recv(1)
    except BlockingIOError: answers.append('none')
""",
    "timeout": """
with socket.create_connection(ADDRESS) as s:
    s.settimeout(0.05); answers = []
    try: s.recv(9)
    except TimeoutError as error: answers.append(str(error))
    s.settimeout(200); s.sendall(b'a\\n'); answers.append(s.makefile().readline())
""",
    "asyncio": """
async def talk(name):
    reader, writer = await asyncio.open_connection(*ADDRESS)
    writer.write(name + b'\\n')
    line = await reader.readline()
    try: await asyncio.wait_for(reader.readline(), 0.05)
    except asyncio.TimeoutError: line += b'late'
    writer.close()
    return line.decode()
async def both():
    return await asyncio.gather(talk(b'a'), talk(b'b'))
answers = asyncio.run(both())
""",
    "no such host": """
try: socket.getaddrinfo('no-such-host.invalid', 80)
except socket.gaierror as error: answers = [socket.gethostname(), str(error), time.time_ns()]
answers.append(socket.create_connection(ADDRESS).getsockname())
""",
}


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
@pytest.mark.parametrize("way", BY_SOCKET)
@pytest.mark.parametrize("place", ["callback", "thread"])
def test_however_a_socket_is_waited_for_its_answers_are_given_again(
    go: Callable[..., Any], echo: socketserver.ThreadingTCPServer, way: str, place: str
) -> None:
    action = f"{BY_SOCKET[way]}self.say(answers)"
    if place == "thread":
        lines = "\n    ".join(action.splitlines())
        action = f"def work():\n    {lines}\nthreading.Thread(target=work).start()"
    code = node_code(
        f"{ONCE}{action}",
        imports="import asyncio, select, selectors, socket, threading, time",
        module=f"ADDRESS = {echo.server_address!r}",
    )
    first = go(code, "first")
    assert said(first), "it was answered"
    assert said(go(code, "other")) != said(first)
    echo.shutdown()
    echo.server_close()
    again = go(code, "again", replay=first)
    assert again.digest == first.digest


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_server_in_a_node_is_asked_again_by_the_trace(go: Callable[..., Any]) -> None:
    """Whoever asks is outside: in the re-run nobody does."""
    port = free_port()
    code = node_code(
        "pass",
        imports="import socketserver, threading",
        module="class Handler(socketserver.StreamRequestHandler):\n"
        "    def handle(self):\n"
        "        line = self.rfile.readline().decode()\n"
        "        self.server.node.say(line)\n"
        "        self.wfile.write(line.upper().encode())\n"
        "class Server(socketserver.TCPServer): allow_reuse_address = True\n",
        init=f"self.server = Server(('127.0.0.1', {port}), Handler)\n"
        "self.server.node = self\n"
        "threading.Thread(target=self.server.serve_forever, args=(0.05,), daemon=True).start()",
    )
    answers: list[str] = []

    def ask() -> None:
        for _ in range(6000):
            try:
                with socket.create_connection(("127.0.0.1", port), timeout=600) as client:
                    client.sendall(b"%d\n" % time.time_ns())
                    answers.append(client.makefile().readline())
                    return
            except OSError:
                time.sleep(0.02)

    asking = threading.Thread(target=ask)
    asking.start()
    first = go(code, "first")
    asking.join()
    assert [[answer.lower()] for answer in answers] == said(first)
    assert len(answers) == 1
    again = go(code, "again", replay=first)
    assert again.digest == first.digest
    gc.collect()  # the server's socket, which nobody closes: here, and not in some other test


class Device:
    """A pseudo-terminal with somebody at the far end who answers each line."""

    def __init__(self) -> None:
        self._end, self._near = pty.openpty()
        tty.setraw(self._near)
        self.path = os.ttyname(self._near)
        self._thread = threading.Thread(target=self._answer)
        self._thread.start()

    def _answer(self) -> None:
        while b"quit" not in (asked := os.read(self._end, 99)):
            time.sleep(0.01)
            os.write(self._end, b"%d %s" % (time.time_ns(), asked))

    def unplug(self) -> None:
        os.write(self._near, b"quit")
        self._thread.join()
        os.close(self._end)
        os.close(self._near)


BY_DEVICE = {
    "os.read": """
fd = os.open(PATH, os.O_RDWR | os.O_NOCTTY)
tty.setraw(fd)
os.write(fd, b'ab\\n')
answers = [os.isatty(fd), os.read(fd, 99).decode(), stat.S_ISCHR(os.fstat(fd).st_mode)]
os.close(fd)
""",
    "pyserial": """
with serial.Serial(PATH, 115200, timeout=200) as port:
    port.write(b'ab\\n')
    answers = [port.readline().decode(), port.in_waiting]
    port.timeout = 0.02
    answers.append(port.read(5).decode())
""",
    "open": """
with open(PATH, 'rb+', buffering=0) as file:
    tty.setraw(file)
    file.write(b'ab\\n')
    answers = [file.read(99).decode(), file.isatty()]
""",
    "asyncio": """
async def lines():
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader()
    file = open(PATH, 'rb+', buffering=0)
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), file)
    file.write(b'ab\\n')
    return (await reader.readline()).decode()
answers = asyncio.run(lines())
""",
}


@pytest.mark.few(1)
@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
@pytest.mark.parametrize("way", BY_DEVICE)
@pytest.mark.parametrize("place", ["callback", "thread"])
def test_what_a_device_says_is_given_again_when_it_is_gone(
    go: Callable[..., Any], way: str, place: str
) -> None:
    if way == "pyserial":
        pytest.importorskip("serial")
    device = Device()
    action = f"{BY_DEVICE[way]}self.say(answers)"
    if place == "thread":
        lines = "\n    ".join(action.splitlines())
        action = f"def work():\n    {lines}\nthreading.Thread(target=work).start()"
    code = node_code(
        f"{ONCE}{action}",
        imports="import asyncio, os, stat, threading, tty\ntry: import serial\n"
        "except ImportError: pass",
        module=f"PATH = {device.path!r}",
    )
    try:
        first = go(code, "first")
        assert said(first), "it answered"
        assert said(go(code, "other")) != said(first)
    finally:
        device.unplug()
    assert not os.path.exists(device.path)
    again = go(code, "again", replay=first)
    assert said(again) == said(first)
    assert again.digest == first.digest


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("guard", "device", "read"),
    [
        ("", "far", "os.read(device, 99)"),
        ("{}", "far", "os.read(device, 99)"),
        ("", "far", "bytes(data[:os.readv(device, [data])])"),
        ("", "os.fdopen(far, 'rb', 0)", "device.read(99)"),
        ("", "os.fdopen(far)", "device.readline().encode()"),
        ("", "open(os.ttyname(self.far), 'rb', 0)", "device.read(99)"),
    ],
)
def test_a_device_that_a_thread_of_the_node_plays_stops_no_time(
    go: Callable[..., Any], guard: str, device: str, read: str
) -> None:
    code = node_code(
        "os.write(self.near, b'hello\\n')",
        imports="import os, pty, threading, tty",
        module=(
            "def play(device, say):\n    data = bytearray(99)\n"
            f"    while True:\n        say({read}.decode().strip())\n"
        ),
        init=(
            "far, self.near = pty.openpty()\n"
            f"if 'self.far' in {device!r}:\n    self.near, self.far = far, self.near\n"
            "tty.setraw(self.near)\n"
            f"far = {device}\n"
            "threading.Thread(target=play, args=(far, self.say), daemon=True).start()"
        ),
    )
    done = go(code, "run", guard=guard)
    assert done.end_ns - done.start_ns == 1_200_000_000
    assert said(done) == [["hello"], ["hello"]]
