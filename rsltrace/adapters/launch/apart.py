"""Reads launch files in a process of their own: Python ones are programs.

What they import, print, set and start is none of the run's, nor is it if they end Python.
"""

from __future__ import annotations

import ctypes
import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from rsltrace.adapters.launch.model import Launched, argument_words
from rsltrace.errors import JobError
from rsltrace.terminal import tell

_OUTPUT_MAX = 1 << 16
_PR_SET_PDEATHSIG = 1
_RUN = (
    "import json, sys; order = json.loads(sys.argv.pop()); sys.path[:] = order['path']; "
    "from rsltrace.adapters.launch.apart import main; main(order)"
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
            "reader": os.getpid(),
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
        try:
            found = pickle.loads(answer.read_bytes())
        except Exception:
            found = None
    if isinstance(found, Launched):
        return found
    if isinstance(found, str):
        raise JobError(found)
    raise JobError(
        "the launch file has changed Python or rsltrace, so that what it starts cannot be read",
        where=str(path),
    )


def main(order: Mapping[str, object]) -> None:
    """Do what an order asks, and write the answer: a ``Launched``, or the text of an error."""
    from rsltrace.adapters.launch.api.basics import as_job_error, shown
    from rsltrace.adapters.launch.python_file import read_launch_file
    from rsltrace.adapters.workspace.imports import unbuilt_packages

    _end_with(int(str(order["reader"])))
    folders = [Path(folder) for folder in order["folders"]]  # type: ignore[attr-defined]
    sys.path[:0] = map(str, folders)
    arguments: Mapping[str, str] = order["arguments"]  # type: ignore[assignment]
    sys.argv[:] = ["ros2", "launch", str(order["file"]), *argument_words(arguments)]
    found: Launched | str
    try:
        with unbuilt_packages(folders):
            found = read_launch_file(Path(str(order["file"])), arguments)
    except BaseException as error:
        found = str(as_job_error(error, shown(str(order["file"]))))
    answer = Path(str(order["answer"]))
    ready = answer.with_suffix(".new")
    try:
        data = pickle.dumps(found)
    except Exception as error:
        data = pickle.dumps(
            f"{shown(str(order['file']))}: something that the launch file gives a node is no plain "
            f"value: {error}"
        )
    ready.write_bytes(data)
    ready.rename(answer)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # threads that the launch file has started need not end


def _end_with(parent: int) -> None:
    """Let the system kill this process when the one that wants the answer is gone."""
    prctl = getattr(ctypes.CDLL(None), "prctl", None)  # Linux
    if prctl is not None:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)


__all__ = ["read_apart"]
