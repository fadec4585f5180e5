"""Files that a command writes completely or not at all."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from rsltrace.errors import OutputError, SetupError
from rsltrace.trace.model.regular_file import replacement_of


def write_text(path: Path, text: str) -> None:
    """Write a text to a file, device or pipe.

    :raises OutputError: it cannot be written; an existing file is kept.
    """
    try:
        if path.exists() and not path.is_file():
            path.write_text(text, encoding="utf-8")
            return
        with replacement_of(path) as work, work.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error


_SUFFIXES = (".png", ".svg", ".pdf")


def check_picture(path: Path) -> None:
    """Check that a picture can be written to ``path``.

    :raises SetupError: matplotlib is not installed.
    :raises OutputError: the file name has another suffix, or its folder does not exist.
    """
    if path.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{path}: the file name must end in {', '.join(_SUFFIXES)}")
    if importlib.util.find_spec("matplotlib") is None:
        raise SetupError("--plot needs matplotlib: pip install 'rsltrace[fit]'")
    if not path.absolute().parent.is_dir():
        raise OutputError(f"{path}: the folder {path.parent} does not exist")


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure to a file, in the format of its suffix.

    :raises OutputError: the file cannot be written; an existing file is kept.
    """
    try:
        with replacement_of(path) as work:
            figure.savefig(work, format=path.suffix[1:].lower(), dpi=150)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
