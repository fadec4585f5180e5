"""Opening a file in the user's editor, while the viewer waits."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

from textual.app import App, SuspendNotSupported

_COMMON = ("sensible-editor", "nano", "vim", "vi")
_WITH_GOTO = ("code", "codium", "code-insiders", "cursor")
_WITH_COLON = ("subl", "hx", "helix", "zed", "zeditor")


def edit(app: App[Any], path: Path, line: int) -> str:
    """Open ``path`` at ``line`` and wait for the editor; return what went wrong, or nothing."""
    try:
        editor = _editor()
    except ValueError as error:
        return f"$VISUAL or $EDITOR cannot be understood: {error}"
    if not editor:
        return "no editor: set $VISUAL or $EDITOR"
    try:
        with app.suspend():
            done = subprocess.run(command(editor, path, line), check=False)
    except SuspendNotSupported:
        return "an editor can only be opened from a terminal"
    except OSError as error:
        return f"{editor[0]}: {error.strerror or error}"
    return "" if done.returncode == 0 else f"{editor[0]} ended with {done.returncode}"


def command(editor: list[str], path: Path, line: int) -> list[str]:
    """Return the command that opens a file at a line in an editor, as that editor wants it."""
    name = Path(editor[0]).name
    if name in _WITH_GOTO:
        return [*editor, "--goto", f"{path}:{line}"]
    if name in _WITH_COLON:
        return [*editor, f"{path}:{line}"]
    return [*editor, f"+{line}", str(path)]


def _editor() -> list[str]:
    for name in ("VISUAL", "EDITOR"):
        if chosen := shlex.split(os.environ.get(name, "")):
            return chosen
    return next(([found] for name in _COMMON if (found := shutil.which(name))), [])
