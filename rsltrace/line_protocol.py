"""JSON lines over a stream socket; file descriptors may come along with a line."""

from __future__ import annotations

import fcntl
import json
import resource
import select
import socket
from collections import deque
from contextlib import suppress
from typing import Any

from rsltrace.errors import DebugError

LINE_BYTES_MAX = 64 << 20
"""A longer line is a mistake, or somebody who speaks something else."""

_PIECE_BYTES = 1 << 16
_DESCRIPTORS_MAX = 4
_HIGHEST = 4096
_ROOM = 128

Message = dict[str, Any]


class Lines:
    """One end of a conversation. ``receive`` waits; ``take`` returns what has arrived."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._poll = _poll_of(end)
        self._data = bytearray()
        self._searched = 0
        self._descriptors: deque[int] = deque()
        self.ended = False
        """Whether the other end is gone."""

    def fileno(self) -> int:
        """Return the socket's descriptor, for ``select``."""
        return self._end.fileno()

    def send(self, message: Message, *descriptors: int) -> None:
        """Send a message; ``descriptors`` are duplicated into the other process.

        :raises OSError: if the other end is gone.
        """
        if descriptors:
            message = {**message, "descriptors": len(descriptors)}
        data = json.dumps(message, separators=(",", ":")).encode() + b"\n"
        if descriptors:
            sent = socket.send_fds(self._end, [data], descriptors)
            data = data[sent:]
        if data:
            self._end.sendall(data)

    def receive(self) -> Message | None:
        """Wait for a message; None once the other end is gone.

        :raises DebugError: what comes is no message.
        """
        while True:
            message = self.next()
            if message is not None or self.ended:
                return message
            self.read()

    def has_more(self) -> bool:
        """Say whether something has arrived that has not been read."""
        return bool(self._poll.poll(0))

    def read(self) -> None:
        """Read what has arrived; waits if nothing has."""
        try:
            data, descriptors, _, _ = socket.recv_fds(self._end, _PIECE_BYTES, _DESCRIPTORS_MAX)
        except (ConnectionResetError, BrokenPipeError):
            data, descriptors = b"", []
        self._descriptors.extend(descriptors)
        if not data:
            self.ended = True
        self._data += data

    def next(self) -> Message | None:
        """Return the next message that has been read, or None.

        :raises DebugError: it is none.
        """
        end = self._data.find(b"\n", self._searched)
        if end < 0:
            self._searched = len(self._data)
            if self._searched > LINE_BYTES_MAX:
                raise DebugError(f"a line of more than {LINE_BYTES_MAX} bytes is no message")
            return None
        line = bytes(self._data[:end])
        del self._data[: end + 1]
        self._searched = 0
        try:
            message = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise DebugError(f"not a line of JSON: {error}") from None
        if not isinstance(message, dict):
            raise DebugError("a message is a JSON object")
        count = message.pop("descriptors", 0)
        if count and len(self._descriptors) >= count:
            message["with"] = [self._descriptors.popleft() for _ in range(count)]
        return message

    def move_high(self) -> None:
        """Give this end a high descriptor: nodes close and use up the low ones."""
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        lowest = max((limit if 0 < limit < _HIGHEST else _HIGHEST) - _ROOM, 3)
        with suppress(OSError):
            number = fcntl.fcntl(self._end.fileno(), fcntl.F_DUPFD_CLOEXEC, lowest)
            self._end.close()
            self._end = socket.socket(fileno=number)
            self._poll = _poll_of(self._end)

    def close(self) -> None:
        """Close this end."""
        self.ended = True
        self._end.close()


def _poll_of(end: socket.socket) -> select.poll:
    poll = select.poll()  # ``select`` knows small descriptors only
    poll.register(end, select.POLLIN)
    return poll
