"""From a file to a command line: what runs it, and the environment it needs."""

from __future__ import annotations

import os
import stat
import struct
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from rsltrace.adapters.processes.build import Library
from rsltrace.adapters.processes.door import Program

_ELF = b"\x7fELF"
_ELF_HEAD = struct.Struct("<32xQ14xHH6x")
"""Of its 64 bytes: where the program headers are, their size and number."""
_PT_INTERP = struct.pack("<I", 3)
_UNBUFFERED = "PYTHONUNBUFFERED"


def is_compiled(path: Path) -> bool:
    """Return whether a file is a compiled program."""
    with path.open("rb") as file:
        return file.read(len(_ELF)) == _ELF


def why_not_run(path: Path) -> str:
    """Return why a compiled program cannot take part in a run, "" if it can."""
    with path.open("rb") as file, Path(sys.executable).open("rb") as own:
        head, own_head = file.read(_ELF_HEAD.size), own.read(_ELF_HEAD.size)
        if len(head) < _ELF_HEAD.size or head[:6] != own_head[:6] or head[18:20] != own_head[18:20]:
            return "is a program for another machine"
        start, size, count = _ELF_HEAD.unpack(head)
        if start + size * count > path.stat().st_size:
            return "is damaged: its headers lie outside of the file"
        if _has_other_rights(path):
            return (
                "runs with other rights than its user's (setuid, setgid or capabilities), so that "
                "nothing can be put before its middleware"
            )
        for number in range(count):
            file.seek(start + number * size)
            if file.read(4) == _PT_INTERP:
                return ""
    return "is linked statically, so that nothing can be put before its middleware"


def _has_other_rights(path: Path) -> bool:
    """Return whether the system gives a program rights that who starts it has not."""
    found, user = path.stat(), os.geteuid()
    if found.st_mode & stat.S_ISUID and found.st_uid != user:
        return True
    if found.st_mode & stat.S_ISGID and found.st_gid != os.getegid():
        return True
    return user != 0 and "security.capability" in os.listxattr(path)


def interpreter(path: Path) -> list[str]:
    """Return the words before the file in the command that a script's ``#!`` line stands for.

    ``env`` is looked through. The list is empty if there is no such line.
    """
    with path.open("rb") as file:
        first = file.readline(256)
    words = first[2:].decode(errors="replace").split() if first.startswith(b"#!") else []
    if words and Path(words[0]).name == "env":
        return [word for word in words[1:] if word != "-S"]
    return words


def is_python(path: Path) -> bool:
    """Return whether a file is run by Python: a ``.py``, or a script that says so."""
    with path.open("rb") as file:
        first = file.readline(256)
    return path.suffix == ".py" or (first.startswith(b"#!") and b"python" in first)


def program(
    command: Sequence[str],
    library: Library,
    *,
    surroundings: Mapping[str, str],
    environment: Mapping[str, str],
    folder: Path | None,
    search_path: Sequence[str] = (),
    prefixes: Sequence[str] = (),
    pinned: bool = True,
) -> Program:
    """Return a command as a process of the run: with variables of ``surroundings`` but for those of
    ``environment``.

    Python finds modules in ``search_path``, and the ament index packages in ``prefixes``.
    Python's output is not buffered: a process may be killed at any time. Programs without Python
    get stand-ins for the symbols of Python that libraries of ROS ask for.
    """
    path = Path(command[0])
    preload = [str(library.path)]
    with path.open("rb") as file:
        needs_symbols = b"libpython" not in file.read() and is_compiled(path)
    if needs_symbols and path.resolve() != Path(sys.executable).resolve():
        preload.append(str(library.python_symbols))
    libraries = [str(place) for place in library.ros.libraries]
    around = {**surroundings, _UNBUFFERED: "1", **environment}
    around["LD_PRELOAD"] = os.pathsep.join([*preload, *_listed(around, "LD_PRELOAD")])
    around["LD_LIBRARY_PATH"] = os.pathsep.join([*libraries, *_listed(around, "LD_LIBRARY_PATH")])
    if search_path:
        around["PYTHONPATH"] = os.pathsep.join([*search_path, *_listed(around, "PYTHONPATH")])
    if prefixes:  # what is built comes first
        found = [*_listed(around, "AMENT_PREFIX_PATH"), *prefixes]
        around["AMENT_PREFIX_PATH"] = os.pathsep.join(found)
    return Program(list(command), around, folder, pinned)


def _listed(environment: Mapping[str, str], name: str) -> list[str]:
    value = environment.get(name, "")
    return [value] if value else []
