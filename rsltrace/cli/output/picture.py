"""Pictures that a command draws with matplotlib."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

from rsltrace.cli.output.text_file import undone
from rsltrace.errors import OutputError, SetupError

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
    work = path.with_name(f".{path.name}.part-{os.getpid()}")
    try:
        with undone(work):
            figure.savefig(work, format=path.suffix[1:].lower(), dpi=150)
            os.replace(work, path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
