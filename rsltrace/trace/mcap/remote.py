"""Remote traces: byte ranges fetched through fsspec, as few and as small as possible.

A request costs a round trip whatever its size, and a trace is read in many small pieces close
together. So whole blocks are fetched and cached, neighbours together, and sequential reading
fetches ever larger pieces.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, TypeVar

from rsltrace.errors import SetupError, TraceError
from rsltrace.trace.mcap import records as limits
from rsltrace.trace.mcap.source import public_address, range_problem, redacted

T = TypeVar("T")

BLOCK_BYTES = 32 << 10
"""Small: on average half a block is fetched in vain on either side."""

CACHE_BYTES = 24 << 20
"""Enough for everything that a diff reads of one file."""

_AHEAD_BYTES_MAX = 4 << 20
_IN_A_ROW = 4
"""After this many neighbouring fetches, reading counts as sequential."""

Fetch = Callable[[int, int], bytes]
"""``fetch(begin, end)`` returns the bytes ``begin <= offset < end``; may raise anything."""


class RemoteSource:
    """A ByteSource of blocks from ``fetch``. ``requests`` counts its calls."""

    is_remote = True

    def __init__(self, name: str, size: int, fetch: Fetch) -> None:
        self.name = name
        self.size = size
        self._fetch = fetch
        self._blocks: OrderedDict[int, bytes] = OrderedDict()
        self._whole: bytes | None = None
        self._last_end = -1
        self._in_a_row = 0
        self._ahead = 0
        self.bytes_read = 0
        self.requests = 0

    def read_at(self, offset: int, length: int) -> bytes:
        """Return ``length`` bytes from ``offset``. Raises TraceError if that fails."""
        if problem := range_problem(self, offset, length):
            raise TraceError(problem)
        end = offset + length
        if self._whole is not None:
            return self._whole[offset:end]
        first, last = offset // BLOCK_BYTES, -(-end // BLOCK_BYTES)
        pieces = self._collect(first, last)
        begin = first * BLOCK_BYTES
        if len(pieces) == 1:
            return pieces[0][offset - begin : end - begin]
        return b"".join(pieces)[offset - begin : end - begin]

    def close(self) -> None:
        self._blocks.clear()
        self._whole = None

    def _collect(self, first: int, last: int) -> list[bytes]:
        """Return the blocks ``first <= number < last``; fetch those that are missing."""
        pieces: dict[int, bytes] = {}
        missing: list[int] = []
        for number in range(first, last):
            block = self._blocks.get(number)
            if block is None:
                missing.append(number)
            else:
                self._blocks.move_to_end(number)
                pieces[number] = block
        while missing:
            run = 1
            while run < len(missing) and missing[run] == missing[0] + run:
                run += 1
            for number, block in self._fetch_blocks(missing[0], missing[0] + run):
                self._blocks[number] = block
                if first <= number < last:
                    pieces[number] = block
            del missing[:run]
        while len(self._blocks) * BLOCK_BYTES > CACHE_BYTES:
            self._blocks.popitem(last=False)
        return [pieces[number] for number in range(first, last)]

    def _fetch_blocks(self, first: int, last: int) -> list[tuple[int, bytes]]:
        begin = first * BLOCK_BYTES
        end = min(last * BLOCK_BYTES, self.size)
        self._in_a_row = self._in_a_row + 1 if begin == self._last_end else 0
        if self._in_a_row >= _IN_A_ROW:
            self._ahead = min(max(2 * self._ahead, 2 * BLOCK_BYTES), _AHEAD_BYTES_MAX)
            end = min(max(end, begin + self._ahead), self.size)
        else:
            self._ahead = 0
        self._last_end = end
        data = self._range(begin, end)
        return [
            (first + place // BLOCK_BYTES, data[place : place + BLOCK_BYTES])
            for place in range(0, len(data), BLOCK_BYTES)
        ]

    def _range(self, begin: int, end: int) -> bytes:
        self.requests += 1
        try:
            data = self._fetch(begin, end)
        except Exception as error:
            raise TraceError(f"{self.name} cannot be read at offset {begin}: {error}") from None
        self.bytes_read += len(data)
        if len(data) == end - begin:
            return data
        if len(data) == self.size:
            if self.size > limits.RESPONSE_BYTES_MAX:
                raise TraceError(
                    f"the server of {self.name} sends the whole file ({self.size} bytes) instead "
                    "of the range asked for; download it and compare the copy"
                )
            self._whole = data
            return data[begin:end]
        raise TraceError(
            f"{self.name} became shorter or longer while it was read ({len(data)} bytes at offset "
            f"{begin} instead of {end - begin}); try again"
        )


def open_remote(address: str) -> RemoteSource:
    """Open an address that fsspec knows. Raises TraceError if it is not there.

    Raises SetupError if fsspec, or a package for this kind of address, is not installed.
    """
    name = public_address(address)
    filesystem, path = filesystem_of(address)
    clock = _RequestTimer(address)
    try:
        size = clock.within(lambda: filesystem.info(path)["size"])
    except FileNotFoundError:
        raise TraceError(f"{name} does not exist, or cannot be reached") from None
    except Exception as error:  # whatever the storage's library raises: there are many
        raise TraceError(f"{name} cannot be opened: {clock.reason(error)}") from None
    if size is None:
        raise TraceError(f"{name} does not say how large it is; download it first")
    is_http = address.partition("://")[0] in ("http", "https")
    fetch = _http_fetch(filesystem, address) if is_http else None

    def fetch_range(begin: int, end: int) -> bytes:
        try:
            if fetch is not None:
                return clock.within(lambda: fetch(begin, end))
            return clock.within(lambda: bytes(filesystem.cat_file(path, start=begin, end=end)))
        except Exception as error:  # as above
            raise _FetchError(clock.reason(error)) from None

    return RemoteSource(name, int(size), fetch_range)


def filesystem_of(address: str) -> tuple[Any, str]:
    """Return fsspec's file system of an address, and the path there.

    :raises SetupError: fsspec, or a package for this kind of address, is not installed.
    :raises TraceError: it is no address.
    """
    name = public_address(address)
    scheme = address.partition("://")[0]
    try:
        import fsspec
    except ImportError as error:
        raise SetupError(
            f"reading {name} needs fsspec: pip install 'rsltrace[remote]', or download the file"
        ) from error
    try:
        filesystem, path = fsspec.core.url_to_fs(address)
    except ImportError as error:
        raise SetupError(
            f"fsspec needs another package for {scheme}:// addresses: {error}; install it, or "
            "download the file"
        ) from error
    except ValueError as error:
        reason = redacted(str(error), address)
        raise TraceError(f"{name} is no address that can be read: {reason}") from None
    return filesystem, path


def _http_fetch(filesystem: Any, address: str) -> Fetch:
    """Return a function that fetches a range over HTTP, with a limit on what it accepts.

    fsspec itself reads all that a server sends, until memory is exhausted.
    """
    from aiohttp import ClientTimeout
    from fsspec.asyn import sync

    async def fetch(begin: int, end: int) -> bytes:
        session = await filesystem.set_session()
        headers = {"Range": f"bytes={begin}-{end - 1}", "Accept-Encoding": "identity"}
        timeout = ClientTimeout(total=limits.REQUEST_SECONDS_MAX)
        async with session.get(address, headers=headers, timeout=timeout) as response:
            if response.status >= 400:
                raise _FetchError(f"{response.status}, {response.reason}")
            pieces, length = [], 0
            most = max(end - begin, limits.RESPONSE_BYTES_MAX)
            async for piece in response.content.iter_any():
                pieces.append(piece)
                length += len(piece)
                if length > most:
                    raise _FetchError(
                        f"the server sends more than {most} bytes where {end - begin} are asked "
                        "for; download it and compare the copy"
                    )
            return b"".join(pieces)

    return lambda begin, end: bytes(sync(filesystem.loop, fetch, begin, end))


class _FetchError(Exception):
    """A failed fetch, described without secrets."""


class _RequestTimer:
    """Limits the time spent waiting for one address."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._left_s = limits.REMOTE_SECONDS_MAX

    def within(self, call: Callable[[], T]) -> T:
        """Return the result of ``call``, or raise _FetchError if it takes too long.

        The call then continues in a daemon thread: a library that waits for a server cannot be
        stopped.
        """
        answer: list[T | Exception] = []

        def run() -> None:
            try:
                answer.append(call())
            except Exception as error:
                answer.append(error)

        begin = time.monotonic()
        allowed_s = min(limits.REQUEST_SECONDS_MAX, self._left_s)
        thread = threading.Thread(target=run, name="rsltrace-fetch", daemon=True)
        thread.start()
        thread.join(max(allowed_s, 0))
        took_s = time.monotonic() - begin
        self._left_s -= took_s
        # the library's own time limit may be over before we have waited
        if not answer or (isinstance(answer[0], Exception) and took_s >= allowed_s):
            which = "one request" if allowed_s == limits.REQUEST_SECONDS_MAX else "all requests"
            most = limits.REQUEST_SECONDS_MAX if which[0] == "o" else limits.REMOTE_SECONDS_MAX
            raise _FetchError(
                f"the server is too slow: {which} took more than {most:g} s; download the file"
            )
        if isinstance(answer[0], Exception):
            raise answer[0]
        return answer[0]

    def reason(self, error: Exception) -> str:
        """Return the text of a library's error without the secrets of the address."""
        return redacted(str(error) or type(error).__name__, self._address)
