"""Opening what a trace is read from: a file, or an address."""

from __future__ import annotations

import re
from pathlib import Path

from rsltrace.errors import TraceError
from rsltrace.trace.mcap.source import ByteSource, FileSource, public_address

_ADDRESS_AS_PATH = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")
"""A path has one slash where an address has two; drives of Windows have one letter."""


def open_source(place: Path | str) -> ByteSource:
    """Open a file, or an address such as ``https://…`` or ``s3://…``. Raises TraceError.

    Raises SetupError for an address if fsspec is not installed.
    """
    if isinstance(place, str) and "://" in place:
        from rsltrace.trace.mcap.remote import open_remote  # a library that local files do not need

        return open_remote(place)
    if _ADDRESS_AS_PATH.match(str(place)) and not Path(place).exists():
        address = public_address(str(place).replace(":/", "://", 1))
        raise TraceError(f"{address} is an address, which only `rsltrace diff` reads; download it")
    return FileSource(Path(place))
