"""Files that are read or written as a whole.

Reading refuses named pipes and devices before opening them: a pipe waits for a writer, and a device
may never end.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from rsltrace.errors import OutputError


def not_regular(path: Path) -> str:
    """Return what ``path`` is if it is no file, "" if it is one. Raises OSError if nothing is
    there."""
    mode = path.stat().st_mode
    if stat.S_ISREG(mode):
        return ""
    if stat.S_ISDIR(mode):
        return "a folder"
    return "a named pipe, not a regular file" if stat.S_ISFIFO(mode) else "not a regular file"


def read_regular(path: Path, size_max: int = -1) -> bytes:
    """Return the content of a file, at most ``size_max`` bytes.

    :raises OSError: if it cannot be read, or is no file; ``strerror`` says what it is.
    """
    kind = not_regular(path)
    if kind and kind != "a folder":  # opening that says so itself
        raise OSError(errno.EINVAL, f"it is {kind}", str(path))
    with path.open("rb") as file:
        return file.read(size_max)


def not_replaceable(path: Path) -> str:
    """Return what is at ``path`` if a file must not replace it, "" for a file or nothing.

    A rename replaces anything: for root even /dev/null.
    """
    try:
        return not_regular(path)
    except OSError:
        return ""


@contextmanager
def replacement_of(path: Path) -> Iterator[Path]:
    """Give a path to write to; its file takes the place of ``path`` when the block ends well.

    So nobody sees half a file, and what was there stays if writing fails. It keeps its mode, and a
    symbolic link still points to it.

    :raises OSError: if the file cannot take the place.
    """
    final = Path(os.path.realpath(path))
    work = final.with_name(f".{final.name}.part-{os.getpid()}")
    try:
        yield work
        with suppress(FileNotFoundError):
            work.chmod(stat.S_IMODE(final.stat().st_mode))
        work.replace(final)
    finally:
        with suppress(OSError):
            work.unlink()


def check_output_file(output: Path, traces: Sequence[Path], *, force: bool, example: str) -> None:
    """Raise OutputError if ``output``, which is made from ``traces``, cannot be written.

    ``force`` allows to replace a file, but no folder, pipe or device. ``example`` is a file name.
    """
    if output.is_dir():
        raise OutputError(f"{output} is a folder; name a file, such as {output / example}")
    check_not_input(output, traces)
    if kind := not_replaceable(output):
        raise OutputError(f"{output} is {kind}; name a file, or remove it")
    if output.exists() and not force:
        raise OutputError(f"{output} exists; use --force to replace it, or another name")
    if not output.absolute().parent.is_dir():
        raise OutputError(f"the folder {output.parent} does not exist")


def check_not_input(output: Path, inputs: Iterable[Path], what: str = "trace") -> None:
    """Raise OutputError if a file that is to be written is one of those that are read: ``what``."""
    if output.exists() and any(one.exists() and output.samefile(one) for one in inputs):
        raise OutputError(f"{output} is the {what} itself; choose another name")
