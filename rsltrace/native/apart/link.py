"""What a native run and the process of one of its entries say to each other: frames on a socket."""

from __future__ import annotations

import io
import pickle
import socket
import struct
import threading
from typing import Any

_HEAD = struct.Struct("<I")
_PART = 1 << 20

Frame = tuple[Any, ...]
"""A word for what it is about, then values."""


class LinkError(Exception):
    """What came is no frame: something else has written to the socket."""


class _PlainValues(pickle.Unpickler):
    """Reads what a process of user code says: numbers, texts, bytes and lists of them, no objects
    that run code."""

    def find_class(self, module: str, name: str) -> Any:
        raise LinkError(f"{module}.{name} is no plain value")


class Link:
    """One end of the socket. Any thread may send; one receives."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._lock = threading.Lock()
        self._got = bytearray()

    def send(self, *frame: Any) -> None:
        """Send a frame; it waits for as long as the other end does not read.

        :raises OSError: there is no other end any more.
        """
        data = pickle.dumps(frame, protocol=5)
        with self._lock:
            self._socket.sendall(_HEAD.pack(len(data)))
            self._socket.sendall(data)

    def receive(self, *, trusted: bool = False) -> Frame | None:
        """Wait for a frame; None at the end. ``trusted``: it may have objects in it.

        :raises TimeoutError: the socket has a timeout, and it has passed; nothing is lost then.
        :raises LinkError: what came is no frame.
        """
        got = self._got
        size = _HEAD.size
        while len(got) < _HEAD.size or len(got) < (size := _HEAD.size + _HEAD.unpack_from(got)[0]):
            try:
                part = self._socket.recv(max(min(size - len(got), _PART), _HEAD.size))
            except ConnectionResetError:
                part = b""
            if not part:
                return None
            got += part
        data = bytes(got[_HEAD.size : size])
        del got[:size]
        try:
            frame = pickle.loads(data) if trusted else _PlainValues(io.BytesIO(data)).load()
        except Exception as error:
            raise LinkError(str(error)) from error
        if not isinstance(frame, tuple) or not frame:
            raise LinkError("an empty frame")
        return frame

    def close(self) -> None:
        """Close this end."""
        self._socket.close()
