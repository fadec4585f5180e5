"""Folders that are made once and used again: by name, complete or not there at all."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from rsltrace.errors import SetupError

_NEW = ".new-"
_LOCK = ".lock-"
_PLACE = "RSLTRACE_CACHE"
_LEFT_S = 3600.0


def key_of(parts: Iterable[str | bytes]) -> str:
    """Return a name for what is made of these parts."""
    digest = hashlib.sha256()
    for part in parts:
        data = part if isinstance(part, bytes) else part.encode("utf-8", "surrogateescape")
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()[:20]


def cached_folder(kind: str, name: str, make: Callable[[Path], None]) -> Path:
    """Return the folder ``kind/name`` of the cache; if it is not there, ``make`` fills it.

    Runs that begin at the same time wait for the one that fills it. Where files cannot be locked,
    each of them may: the first to be ready counts.

    :raises SetupError: if others can write there: what is in it may be run.
    """
    place = _root() / kind / name
    for folder in (place.parent, place):
        if folder.is_dir() and not _is_ours(folder):
            raise SetupError(
                f"others can change what is in {folder}: remove it, or name another folder for "
                "caches in XDG_CACHE_HOME"
            )
    if place.is_dir():
        return place
    place.parent.mkdir(0o755, parents=True, exist_ok=True)
    with _locked(place.parent / f"{_LOCK}{name}"):
        if not place.is_dir():
            _fill(place, make)
    return place


@contextmanager
def _locked(file: Path) -> Iterator[None]:
    """Lock a file as long as the ``with`` block lasts; the kernel unlocks that of a killed process.

    It is removed: whoever still waits for it finds the folder that was made, or makes it."""
    lock = os.open(file, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        file.unlink(missing_ok=True)
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_UN)  # a fork may have it open, too
        os.close(lock)


def _fill(place: Path, make: Callable[[Path], None]) -> None:
    _clear_leftovers(place.parent)
    made = Path(tempfile.mkdtemp(dir=place.parent, prefix=_NEW))
    try:
        make(made)
        made.chmod(0o755)
        try:
            made.rename(place)
        except OSError:
            if not place.is_dir():
                raise
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _clear_leftovers(folder: Path) -> None:
    """Remove what was begun long ago and is not complete: whoever made it was killed."""
    for left in folder.glob(f"{_NEW}*"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > _LEFT_S:
                shutil.rmtree(left, ignore_errors=True)


def lasting(path: str) -> str:
    """Return a path, with links followed if it lies in the cache, which anybody may empty."""
    return os.path.realpath(path) if Path(path).is_relative_to(_root()) else path


def same_place() -> dict[str, str]:
    """Return what a process needs in its environment to use this process's folder, whatever its
    ``HOME``: a node may well tell others where its share is."""
    return {_PLACE: str(_root())}


def _is_ours(folder: Path) -> bool:
    """Return whether nobody but this user and root can put something into a folder."""
    found = folder.stat()
    return found.st_uid in (os.geteuid(), 0) and not found.st_mode & stat.S_IWOTH


@cache
def _root() -> Path:
    """Return the user's folder for caches, or one for this process if that cannot be written, or
    not by this user alone."""
    if given := os.environ.get(_PLACE):
        return Path(given)
    folder = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(folder) if os.path.isabs(folder) else Path("~/.cache").expanduser()
    try:
        (root / "rsltrace").mkdir(0o755, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=root / "rsltrace").close()
        if not _is_ours(root / "rsltrace"):
            raise PermissionError
    except (OSError, RuntimeError):
        import atexit

        scratch = tempfile.mkdtemp(prefix="rsltrace-")
        atexit.register(shutil.rmtree, scratch, ignore_errors=True)
        return Path(scratch)
    return root / "rsltrace"
