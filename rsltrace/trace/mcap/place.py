"""Opening a file or an address, whichever a place is."""

from __future__ import annotations

import re
from pathlib import Path

from rsltrace.errors import TraceError
from rsltrace.trace.mcap.source import ByteSource, FileSource

_ADDRESS_AS_PATH = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")
"""As a path an address has one slash; a drive of Windows has one letter."""


def open_source(place: Path | str) -> ByteSource:
    """Open a file, or an address such as ``https://…`` or ``s3://…``. Raises TraceError.

    Raises SetupError for an address when fsspec, which reads it, is not installed.
    """
    if isinstance(place, str) and "://" in place:
        from rsltrace.trace.mcap.remote import open_remote  # a library that local files do not need

        return open_remote(place)
    if _ADDRESS_AS_PATH.match(str(place)) and not Path(place).exists():
        from rsltrace.trace.mcap.source import public

        address = public(str(place).replace(":/", "://", 1))
        raise TraceError(f"{address} is an address, which only `rsltrace diff` reads; download it")
    return FileSource(Path(place))
