"""Opening a file or an address, whichever a place is."""

from __future__ import annotations

from pathlib import Path

from rsltrace.mcap.source import ByteSource, FileSource


def open_source(place: Path | str) -> ByteSource:
    """Open a file, or an address such as ``https://…`` or ``s3://…``. Raises TraceError.

    Raises SetupError for an address when fsspec, which reads it, is not installed.
    """
    if isinstance(place, str) and "://" in place:
        from rsltrace.mcap.remote import open_remote  # a library that local files do not need

        return open_remote(place)
    return FileSource(Path(place))
