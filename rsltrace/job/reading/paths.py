"""What to say of a path in a job that leads nowhere."""

from __future__ import annotations

import difflib
import os
from pathlib import Path


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
    close = difflib.get_close_matches(full.name, names, n=1)
    return f"; did you mean {os.path.join(folder, close[0])!r}?" if close else ""
