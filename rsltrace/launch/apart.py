"""Reads launch files in a process of their own: Python ones are programs.

What they import, print, set and start is none of the run's, nor is it if they end Python.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from rsltrace.errors import JobError
from rsltrace.launch.model import Launched
from rsltrace.terminal import tell

_OUTPUT_MAX = 1 << 16
_RUN = (
    "import json, sys; order = json.loads(sys.argv.pop()); sys.path[:] = order['path']; "
    "from rsltrace.launch.apart import main; main(order)"
)


def read_apart(path: Path, arguments: Mapping[str, str], folders: Sequence[Path]) -> Launched:
    """Return what a launch file starts; it and what it includes may be in Python.

    ``folders`` are where packages and modules are looked for, before Python's own path. What the
    launch file prints is told on standard error.

    :raises JobError: with file and line, if something in it is wrong, missing or not known here.
    """
    with tempfile.TemporaryDirectory(prefix="rsltrace-") as scratch:
        answer, output = Path(scratch, "answer"), Path(scratch, "output")
        order = {
            "file": str(path),
            "arguments": dict(arguments),
            "folders": [str(folder) for folder in folders],
            "answer": str(answer),
            "path": sys.path,
        }
        with output.open("wb") as stream:
            done = subprocess.run(
                [sys.executable, "-c", _RUN, json.dumps(order)],
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                check=False,
            )
        with output.open("rb") as stream:
            said = stream.read(_OUTPUT_MAX).decode("utf-8", "replace").rstrip()
        if said:
            tell(said)
        if not answer.is_file():
            raise JobError(
                f"the launch file ended the process that read it (exit status {done.returncode})",
                where=str(path),
            )
        found: Launched | str = pickle.loads(answer.read_bytes())
    if isinstance(found, str):
        raise JobError(found)
    return found


def main(order: Mapping[str, object]) -> None:
    """Do what an order asks, and write the answer: a ``Launched``, or the text of an error."""
    from rsltrace.launch.python_file import read_launch_file
    from rsltrace.workspace.imports import unbuilt_packages

    folders = [Path(folder) for folder in order["folders"]]  # type: ignore[attr-defined]
    sys.path[:0] = map(str, folders)
    sys.argv[1:] = []
    found: Launched | str
    try:
        with unbuilt_packages(folders):
            found = read_launch_file(Path(str(order["file"])), order["arguments"])  # type: ignore[arg-type]
    except JobError as error:
        found = str(error)
    answer = Path(str(order["answer"]))
    ready = answer.with_suffix(".new")
    ready.write_bytes(pickle.dumps(found))
    ready.rename(answer)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # threads that the launch file has started need not end


__all__ = ["read_apart"]
