"""Traces on servers that are slow, endless, wrong, or that only want to know a secret.

The servers are processes of our own on 127.0.0.1; nothing goes beyond this machine.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import threading
import time
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from random import Random

from campaigns.attack import oracle
from campaigns.attack.corpus import Corpus
from campaigns.attack.families.common import Attack, Family
from campaigns.attack.model import Case, Complaint, Limits, Ran, Wrong

_LIMITS = Limits(cpu_s=15, rss_mib=500)
_SECRETS = ("hunter2-password", "signature-0123456789", "token-abcdef")
_BLOCK = 1 << 16


class _Asked:
    """One request: what was asked for, and how to answer."""

    def __init__(self, connection: socket.socket, data: bytes, nth: int) -> None:
        self.connection = connection
        self.data = data
        self.nth = nth
        self.head = b""
        while b"\r\n\r\n" not in self.head:
            piece = connection.recv(65536)
            if not piece:
                raise ConnectionError
            self.head += piece
        self.only_head = self.head.startswith(b"HEAD")
        wanted = re.search(rb"(?i)range: bytes=(\d+)-(\d*)", self.head)
        self.ranged = wanted is not None
        self.first = int(wanted[1]) if wanted else 0
        last = int(wanted[2]) if wanted and wanted[2] else len(data) - 1
        self.end = min(last + 1, len(data))

    def send(self, status: str, body: bytes, **headers: object) -> None:
        """Answer; headers that are None are left out."""
        lines = [f"HTTP/1.1 {status}"]
        fields = {"Content_Length": len(body), "Accept_Ranges": "bytes", "Connection": "close"}
        for name, value in {**fields, **headers}.items():
            if value is not None:
                lines.append(f"{name.replace('_', '-')}: {value}")
        head = ("\r\n".join(lines) + "\r\n\r\n").encode("utf-8", "surrogatepass")
        self.connection.sendall(head if self.only_head else head + body)

    def part(self, shift: int = 0) -> bytes:
        """Return the bytes that were asked for."""
        return self.data[self.first + shift : self.end + shift]

    def right(self) -> None:
        """Answer as one should."""
        if self.ranged:
            where = f"bytes {self.first}-{self.end - 1}/{len(self.data)}"
            self.send("206 Partial Content", self.part(), Content_Range=where)
        else:
            self.send("200 OK", self.data)


Serve = Callable[[_Asked], None]


def _no_ranges(asked: _Asked) -> None:
    asked.send("200 OK", asked.data, Accept_Ranges=None)


def _wrong_range(asked: _Asked) -> None:
    if not asked.ranged:
        return asked.right()
    where = f"bytes {asked.first + 7}-{asked.end + 6}/{len(asked.data)}"
    return asked.send("206 Partial Content", asked.part(7), Content_Range=where)


def _shifted(asked: _Asked) -> None:
    """Other bytes than it says."""
    if not asked.ranged:
        return asked.right()
    where = f"bytes {asked.first}-{asked.end - 1}/{len(asked.data)}"
    body = asked.part(13).ljust(asked.end - asked.first, b"\0")
    return asked.send("206 Partial Content", body, Content_Range=where)


def _short(asked: _Asked) -> None:
    body = asked.part()
    asked.send(
        "206 Partial Content" if asked.ranged else "200 OK",
        body[: len(body) // 2],
        Content_Length=len(body),
    )


def _long(asked: _Asked) -> None:
    asked.send("206 Partial Content" if asked.ranged else "200 OK", asked.part() + bytes(1 << 20))


def _size_lies(size: object) -> Serve:
    def serve(asked: _Asked) -> None:
        if asked.only_head or not asked.ranged:
            return asked.send("200 OK", b"", Content_Length=size)
        where = f"bytes {asked.first}-{asked.end - 1}/{size}"
        return asked.send("206 Partial Content", asked.part(), Content_Range=where)

    return serve


def _size_changes(asked: _Asked) -> None:
    asked.data = asked.data[: len(asked.data) - 100 * asked.nth]
    asked.end = min(asked.end, len(asked.data))
    asked.right()


def _content_changes(asked: _Asked) -> None:
    asked.data = asked.data[: len(asked.data) // 2] + bytes([asked.nth % 256]) * (
        len(asked.data) // 2
    )
    asked.right()


def _status(status: str) -> Serve:
    return lambda asked: asked.send(status, b"\x1b]0;owned\x07 no " * 10)


def _fails_later(asked: _Asked) -> None:
    if asked.nth < 3:
        return asked.right()
    return asked.send("500 Broken \x1b[31m", b"")


def _redirects(target: str) -> Serve:
    return lambda asked: asked.send("302 Found", b"", Location=target)


def _garbage(asked: _Asked) -> None:
    asked.connection.sendall(b"\x1b]0;owned\x07" * 100 + b"\r\n\r\n")


def _many_headers(asked: _Asked) -> None:
    asked.connection.sendall(b"HTTP/1.1 200 OK\r\n" + b"X-Y: " + b"z" * 100 + b"\r\n")
    for _ in range(20_000):
        asked.connection.sendall(b"X-Y: zzzzzzzzzzzzzzzzzzzzz\r\n")
    asked.connection.sendall(b"\r\n")


def _closes(asked: _Asked) -> None:
    asked.connection.close()


def _packed_bomb(asked: _Asked) -> None:
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    body = b"".join(packer.compress(bytes(1 << 24)) for _ in range(32)) + packer.flush()
    asked.send("200 OK", body, Content_Encoding="gzip")


def _endless(asked: _Asked) -> None:
    if asked.only_head:
        return asked.send("200 OK", b"", Content_Length=None)
    asked.connection.sendall(b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n")
    while True:
        asked.connection.sendall(bytes(_BLOCK))


def _silent(asked: _Asked) -> None:
    time.sleep(1000)


def _drips(asked: _Asked) -> None:
    body = asked.part()
    head = f"HTTP/1.1 206 Partial\r\nContent-Length: {len(body)}\r\n\r\n".encode()
    asked.connection.sendall(head)
    for byte in body if not asked.only_head else b"":
        asked.connection.sendall(bytes([byte]))
        time.sleep(0.5)


def _drips_headers(asked: _Asked) -> None:
    asked.connection.sendall(b"HTTP/1.1 200 OK\r\n")
    while True:
        asked.connection.sendall(b"X: y\r\n")
        time.sleep(0.5)


def _each_slow(asked: _Asked) -> None:
    time.sleep(8)
    asked.right()


def _serve(listener: socket.socket, serve: Serve, data: bytes) -> None:
    count = 0
    while True:
        connection, _ = listener.accept()
        count += 1
        threading.Thread(target=_answer, args=(connection, serve, data, count), daemon=True).start()


def _answer(connection: socket.socket, serve: Serve, data: bytes, nth: int) -> None:
    with contextlib.suppress(OSError, ConnectionError), connection:
        serve(_Asked(connection, data, nth))


def _attack(serve: Serve, *, right: bool = False, secret: bool = False) -> Attack:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        data = corpus.robot
        listener = socket.create_server(("127.0.0.1", 0))
        port = listener.getsockname()[1]
        pid = os.fork()
        if pid == 0:
            try:
                _serve(listener, serve, data)
            finally:
                os._exit(0)
        listener.close()
        case.cleanup.append(partial(_end, pid))
        (case.folder / "local.mcap").write_bytes(data)
        query = ""
        user = ""
        case.names = (f"127.0.0.1:{port}",)
        if secret:
            user = f"user:{_SECRETS[0]}@"
            query = f"?X-Amz-Signature={_SECRETS[1]}&token={_SECRETS[2]}"
            case.secrets = _SECRETS
        address = f"http://{user}127.0.0.1:{port}/trace.mcap{query}"
        words = [
            ("diff", "local.mcap", address),
            ("diff", address, "local.mcap", "--check", "--format", "json"),
            ("info", address),
            ("view", address, "--export", "screen.txt"),
        ]
        chosen = words if secret else words[:2]
        case.commands += [oracle.reading(*each, cwd=case.folder, limits=_LIMITS) for each in chosen]
        case.judge = lambda runs: _judge(runs, right=right)

    return attack


def _end(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    with contextlib.suppress(ChildProcessError):
        os.waitpid(pid, 0)


def _judge(runs: Sequence[Ran], *, right: bool) -> list[Complaint]:
    if not right:
        return []
    return [
        Complaint(Wrong.ANSWER, f"status {ran.status}, though the server is honest", ran.line)
        for ran in runs
        if ran.status != 0 and ran.command.words[0] == "diff"
    ]


FAMILY = Family(
    "servers",
    {
        "honest": _attack(_Asked.right, right=True),
        "honest-with-secrets": _attack(_Asked.right, right=True, secret=True),
        "no-ranges": _attack(_no_ranges, right=True),
        "wrong-range": _attack(_wrong_range),
        "shifted": _attack(_shifted),
        "short": _attack(_short),
        "long": _attack(_long),
        "size-huge": _attack(_size_lies(2**63)),
        "size-petabyte": _attack(_size_lies(2**50)),
        "size-negative": _attack(_size_lies(-5)),
        "size-text": _attack(_size_lies("x\x1b[31m")),
        "size-zero": _attack(_size_lies(0)),
        "size-changes": _attack(_size_changes),
        "content-changes": _attack(_content_changes),
        "not-found": _attack(_status("404 Not Found \x1b]0;owned\x07"), secret=True),
        "forbidden": _attack(_status("403 \x1b[31mForbidden"), secret=True),
        "fails-later": _attack(_fails_later, secret=True),
        "redirect-file": _attack(_redirects("file:///etc/passwd")),
        "redirect-loop": _attack(_redirects("/trace.mcap")),
        "redirect-secret": _attack(
            _redirects(f"http://user:{_SECRETS[0]}@127.0.0.1:1/x?token={_SECRETS[2]}"), secret=True
        ),
        "garbage": _attack(_garbage, secret=True),
        "many-headers": _attack(_many_headers),
        "closes": _attack(_closes, secret=True),
        "packed-bomb": _attack(_packed_bomb),
        "endless": _attack(_endless),
        "silent": _attack(_silent),
        "drips": _attack(_drips),
        "drips-headers": _attack(_drips_headers),
        "each-slow": _attack(_each_slow),
    },
    sliced=frozenset(
        (
            "honest",
            "honest-with-secrets",
            "no-ranges",
            "wrong-range",
            "short",
            "size-huge",
            "not-found",
            "redirect-file",
            "redirect-secret",
            "packed-bomb",
        )
    ),
    slow=frozenset(("endless", "silent", "drips", "drips-headers", "each-slow")),
)
