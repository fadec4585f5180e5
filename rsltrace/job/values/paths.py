"""Paths in a job: they start at the folder of the file they are written in."""

from __future__ import annotations

import os
from pathlib import Path

from rsltrace.errors import nearest
from rsltrace.job.values.checks import attach, text
from rsltrace.job.values.problem import Problem


class FileText(str):
    """Text from a file of another folder than the job's: a path in it starts at ``folder``."""

    folder: str

    def __new__(cls, value: str, folder: str) -> FileText:
        self = super().__new__(cls, value)
        self.folder = folder
        return self


def check_path(value: object) -> str:
    """Check a path given as text or (in Python) as a path object; return it as the job's folder
    sees it, whichever file it was written in."""
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, str) and not value:
        raise Problem("a path cannot be empty")
    path = text()(value)
    if not isinstance(value, FileText) or os.path.isabs(path):
        return path
    return os.path.normpath(os.path.join(value.folder, path)).replace(os.sep, "/")


attach(check_path, schema={"type": "string", "minLength": 1})


def near_path(full: Path, path: str, *, but: str = "") -> str:
    """Return what there is instead of ``path`` (absolute: ``full``), to follow "no such file".

    ``but`` is a file that cannot be meant.
    """
    if path.startswith("~"):
        return "; '~' is not known here: write $(env HOME)"
    if path.startswith("$"):
        return "; variables of the environment are written $(env NAME)"
    if full.exists():
        return ""
    folder, _ = os.path.split(path)
    if not full.parent.is_dir():
        return f" (there is no folder {folder!r} either)"
    names = sorted(entry.name for entry in full.parent.iterdir() if entry.name != but)
    near = nearest(full.name, names)
    return f"; did you mean {os.path.join(folder, near)!r}?" if near else ""
