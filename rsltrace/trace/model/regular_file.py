"""Files that are read as a whole: named pipes and devices are refused before they are opened.

Opening a named pipe waits for a writer, and a device may never end.
"""

from __future__ import annotations

import errno
import stat
from pathlib import Path


def not_regular(path: Path) -> str:
    """Return what ``path`` is if it is no file, "" if it is one. Raises OSError if it is nothing.

    To be asked before it is opened.
    """
    mode = path.stat().st_mode
    if stat.S_ISREG(mode):
        return ""
    if stat.S_ISDIR(mode):
        return "a folder"
    return "a named pipe, not a regular file" if stat.S_ISFIFO(mode) else "not a regular file"


def read_regular(path: Path, size_max: int = -1) -> bytes:
    """Return what is in a file, at most ``size_max`` bytes of it.

    :raises OSError: if it cannot be read, or is no file; ``strerror`` says what it is.
    """
    kind = not_regular(path)
    if kind and kind != "a folder":  # opening that says so itself
        raise OSError(errno.EINVAL, f"it is {kind}", str(path))
    with path.open("rb") as file:
        return file.read(size_max)


def in_the_way(path: Path) -> str:
    """Return what is at ``path`` if a file must not replace it, "" for a file or nothing.

    Renaming replaces whatever has the name: for root, /dev/null, too.
    """
    try:
        return not_regular(path)
    except OSError:
        return ""
