"""Files that a command writes as a whole: complete under their name, or not there."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from rsltrace.errors import OutputError, SetupError
from rsltrace.trace.model.regular_file import replacement_of


def write_text(path: Path, text: str) -> None:
    """Write a text to a file, or to the device or pipe that is there.

    :raises OutputError: if it cannot be written; what was there stays.
    """
    try:
        if path.exists() and not path.is_file():
            path.write_text(text, encoding="utf-8")
            return
        with replacement_of(path) as work, work.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error


# Pictures that a command draws with matplotlib.

_SUFFIXES = (".png", ".svg", ".pdf")


def check_picture(path: Path) -> None:
    """Raise what would be wrong with drawing to ``path``.

    :raises SetupError: matplotlib is not installed.
    :raises OutputError: nothing can be drawn to such a file.
    """
    if path.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{path}: a picture is one of {', '.join(_SUFFIXES)}")
    if importlib.util.find_spec("matplotlib") is None:
        raise SetupError("--plot needs matplotlib: pip install 'rsltrace[fit]'")
    if not path.absolute().parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}")


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure to a file, whose name says in which format.

    :raises OutputError: the file cannot be written; what was there stays.
    """
    try:
        with replacement_of(path) as work:
            figure.savefig(work, format=path.suffix[1:].lower(), dpi=150)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
