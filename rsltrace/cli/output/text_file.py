"""Files that a command writes as a whole: complete under their name, or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rsltrace.errors import OutputError


@contextmanager
def undone(path: Path) -> Iterator[None]:
    """Remove a file that was made here if the ``with`` block does not end well."""
    try:
        yield
    except BaseException:
        with suppress(OSError):
            path.unlink()
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text to a file, or to the device or pipe that is there.

    :raises OutputError: if it cannot be written; what was there stays.
    """
    final = Path(os.path.realpath(path))
    work = final.with_name(f".{final.name}.part-{os.getpid()}")
    try:
        if path.exists() and not path.is_file():
            path.write_text(text, encoding="utf-8")
            return
        with work.open("x", encoding="utf-8") as file, undone(work):
            file.write(text)
            file.flush()
            if final.exists():
                os.chmod(work, final.stat().st_mode & 0o777)
            os.replace(work, final)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
