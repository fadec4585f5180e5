"""Sockets whose answers are recorded, TLS included, and returned again without a peer.

Of TLS the plain text is recorded: keys are drawn in C, so the encrypted bytes differ each time.
"""

from __future__ import annotations

import _socket
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import FrameType
from typing import Any

from rsltrace.guard.frames import replace_member
from rsltrace.guard.guard import Guard
from rsltrace.guard.loading import when_loaded
from rsltrace.guard.recorded.descriptors import connected_ends, recording_call, recording_guard
from rsltrace.guard.redirect import redirect
from rsltrace.guard.waiting import wait_readable, wait_recorded, wait_unrecorded, waiting_guard
from rsltrace.trace.model.finding import NondeterminismSource

_RECEIVING = ("recv", "recvfrom", "recvmsg")
_RECEIVING_INTO = ("recv_into", "recvfrom_into")
_PLAIN = (
    *("connect", "connect_ex", "send", "sendall", "sendto", "sendmsg", "bind", "getsockname"),
    *("getpeername", "shutdown", "listen", "setsockopt", "getsockopt"),
)
_RESOLVING = (
    *("getaddrinfo", "gethostbyname", "gethostbyname_ex", "gethostbyaddr", "getnameinfo"),
    *("gethostname", "if_nameindex"),
)
_TLS = (
    *("do_handshake", "write", "shutdown", "pending", "getpeercert", "cipher", "version"),
    *("selected_alpn_protocol", "compression", "get_channel_binding", "shared_ciphers"),
)
_BUFFERED = ("read", "write")


def _recorded_of(sock: Any, frame: FrameType) -> Guard | None:
    """Return the guard if a socket's answers are recorded: it leads outside of the run."""
    guard = recording_guard(NondeterminismSource.SOCKET, frame)
    if guard is None or guard.descriptors.far_end(sock.fileno()) is not None:
        return None
    return guard


def _answer(
    guard: Guard,
    sock: Any,
    call: str,
    real: Callable[[], Any],
    frame: FrameType,
    *,
    waits: bool,
    tls: Any = None,
) -> Any:
    """``tls``: a TLS socket is not readable while decrypted bytes are left."""
    number, timeout_s = guard.descriptors.number(sock), sock.gettimeout()
    if not waits or not guard.context.is_aside() or timeout_s == 0:
        return guard.record(NondeterminismSource.SOCKET, call, real, frame, number)
    wire = wait_readable(sock.fileno(), lambda: [real()])

    def look(seconds: float) -> Any:
        return [real()] if tls is not None and tls.pending() else wire(seconds)

    found = wait_recorded(
        guard, NondeterminismSource.SOCKET, call, look, frame, number=number, timeout_s=timeout_s
    )
    if found is None:
        raise TimeoutError("timed out" if tls is None else "The read operation timed out")
    return found[0]


def _wait_for(sock: Any, frame: FrameType) -> None:
    """Let others go on until an unrecorded socket is readable."""
    guard, timeout_s = waiting_guard(frame), sock.gettimeout()
    if guard is None or timeout_s == 0 or sock.fileno() < 0:
        return
    look = wait_readable(sock.fileno(), lambda: True)
    if wait_unrecorded(guard, look, frame, timeout_s) is None:
        raise TimeoutError("timed out")


def _of_socket(name: str, real: Callable[..., Any], *, waits: bool = False) -> Any:
    call = f"socket.{name}()"

    def method(self: Any, *arguments: Any, **options: Any) -> Any:
        frame = sys._getframe(1)
        guard = _recorded_of(self, frame)
        if guard is None:
            if waits:
                _wait_for(self, frame)
            return real(self, *arguments, **options)
        return _answer(
            guard, self, call, lambda: real(self, *arguments, **options), frame, waits=waits
        )

    return method


def _into(name: str, real: Callable[..., Any]) -> Any:
    call = f"socket.{name}()"

    def method(self: Any, buffer: Any, nbytes: int = 0, flags: int = 0) -> Any:
        frame = sys._getframe(1)
        guard = _recorded_of(self, frame)
        if guard is None:
            _wait_for(self, frame)
            return real(self, buffer, nbytes, flags)

        def receive() -> list[Any]:
            found = real(self, buffer, nbytes, flags)
            count = found[0] if isinstance(found, tuple) else found
            return [bytes(memoryview(buffer).cast("B")[:count]), found]

        data, found = _answer(guard, self, call, receive, frame, waits=True)
        memoryview(buffer).cast("B")[: len(data)] = data
        return found

    return method


def _accepting(real: Callable[[Any], Any]) -> Any:
    def accept(self: Any) -> Any:
        frame = sys._getframe(1)
        guard = _recorded_of(self, frame)
        if guard is None:
            _wait_for(self, frame)
            return real(self)
        accepted: list[int] = []

        def connection() -> Any:
            fd, address = real(self)
            accepted.append(fd)
            return address

        address = _answer(guard, self, "socket.accept()", connection, frame, waits=True)
        if not accepted:
            accepted.append(_socket.socket(self.family, self.type, self.proto).detach())
        guard.descriptors.drop(accepted[0])
        return accepted[0], address

    return accept


# -- TLS ------------------------------------------------------------------------------------------


def _reading(real: Callable[..., Any]) -> Any:
    def read(self: Any, size: int, buffer: Any = None, /) -> Any:
        frame = sys._getframe(1)
        guard = recording_guard(NondeterminismSource.SOCKET, frame)
        if guard is None:
            return real(self, size) if buffer is None else real(self, size, buffer)

        def receive() -> Any:
            if buffer is None:
                return real(self, size)
            return bytes(memoryview(buffer).cast("B")[: real(self, size, buffer)])

        owner, call = self.owner, "TLS.read()"
        if isinstance(owner, socket.socket):
            data = _answer(guard, owner, call, receive, frame, waits=True, tls=self)
        else:
            data = guard.record(NondeterminismSource.SOCKET, call, receive, frame)
        if buffer is None:
            return data
        memoryview(buffer).cast("B")[: len(data)] = data
        return len(data)

    return read


def _pending(real: Any) -> property:
    def pending(self: Any) -> Any:
        guard = recording_guard(NondeterminismSource.SOCKET, sys._getframe(1))
        if guard is None:
            return real.__get__(self)
        return guard.record(
            NondeterminismSource.SOCKET,
            "MemoryBIO.pending",
            lambda: real.__get__(self),
            sys._getframe(1),
        )

    return property(pending)


@contextmanager
def recorded_sockets() -> Iterator[None]:
    """Record the answers of sockets; in a re-run, return them from the trace."""
    with ExitStack() as stack:
        for name in _RESOLVING:
            redirect(
                stack,
                getattr(_socket, name),
                partial(recording_call, NondeterminismSource.SOCKET, f"socket.{name}()"),
            )
        redirect(stack, _socket.socketpair, connected_ends)
        kind: Any = socket.socket
        makers: list[tuple[str, Any]] = [
            *((name, partial(_of_socket, name)) for name in _PLAIN),
            *((name, partial(_of_socket, name, waits=True)) for name in _RECEIVING),
            *((name, partial(_into, name)) for name in _RECEIVING_INTO),
            ("_accept", _accepting),
        ]
        for name, make in makers:
            put_back = partial(setattr, kind, name, vars(kind).get(name))
            stack.callback(put_back if name in vars(kind) else partial(delattr, kind, name))
            setattr(kind, name, make(getattr(kind, name)))
        when_loaded(stack, "_ssl", partial(_record_tls, stack))
        yield


def _record_tls(stack: ExitStack) -> None:
    module: Any = sys.modules["_ssl"]
    tls, memory = module._SSLSocket, module.MemoryBIO  # below ssl.SSLSocket and ssl.SSLObject
    for owner, shown, names in ((tls, "TLS", _TLS), (memory, "MemoryBIO", _BUFFERED)):
        for name in names:
            call = f"{shown}.{name}()"
            making = partial(recording_call, NondeterminismSource.SOCKET, call)
            replace_member(stack, owner, name, making)
    replace_member(stack, tls, "read", _reading)
    replace_member(stack, memory, "pending", _pending)
