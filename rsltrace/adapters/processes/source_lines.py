"""Source lines of compiled programs: what addr2line and nm (GNU binutils) say of their DWARF."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Sequence
from functools import cache, lru_cache
from itertools import takewhile
from pathlib import Path

from rsltrace.adapters.processes.wire import RecordReader

Frame = tuple[str, int]
"""The file of a program or library, and an address in it."""

_DEBUG_SECTION = b".debug_line"
_OF_PYTHON = re.compile(r"(?:.*/)?(?:(?:lib)?python[\d.]*[dmt]*(?:\.so[\d.]*)?|lib-dynload/[^/]*)")
_LAMBDA_CALL = "::operator()"


@cache
def _has_lines(module: str) -> bool:
    """Return whether a file has debug information: without, no tool need be started. The lines of
    a Python interpreter are not those of its program."""
    try:
        return _OF_PYTHON.fullmatch(module) is None and _DEBUG_SECTION in Path(module).read_bytes()
    except OSError:
        return False


@lru_cache(maxsize=4096)
def stack_text(packed: bytes) -> str:
    """Return the lines of the program's own code (``node.cpp:24 in Node::tick()``), innermost
    first, one per line of text, none of a template of ROS; where there is no debug information, the
    innermost address, as addr2line takes it. ``packed`` is a stack as the process sends it.

    :raises WireError: if it is none.
    """
    frames = list(RecordReader(packed).frames())
    lines = _lines_of(frames)
    if lines or not frames or _has_lines(frames[0][0]):
        return "\n".join(lines)
    module, address = frames[0]
    return f"{Path(module).name}+{address:#x}"


_FRAME = re.compile(r"^( +)(.* \()?(/.+)\+(0x[0-9a-f]+)(\)?)$", re.MULTILINE)


def report_text(report: str) -> str:
    """Return a report on threads in which lines of source code, where they are known, take the
    place of the addresses in their stacks."""
    _lines_of([(module, int(address, 16)) for _, _, module, address, _ in _FRAME.findall(report)])

    def lines(frame: re.Match[str]) -> str:
        begin, name, module, address, end = frame.groups(default="")
        found = _lines[module, int(address, 16)]
        found = found or [f"{name}{Path(module).name}+{address}{end}"]
        return "\n".join(f"{begin}{line}" for line in found)

    return _FRAME.sub(lines, report)


_lines: dict[Frame, list[str]] = {}
"""The lines at each address: the inlined function first."""


def _lines_of(frames: Sequence[Frame]) -> list[str]:
    unknown = dict.fromkeys(frame for frame in frames if frame not in _lines)
    _lines.update((frame, []) for frame in unknown)
    for module in dict.fromkeys(module for module, _ in unknown):
        if _has_lines(module):
            found = [address for file, address in unknown if file == module]
            said = _output(["addr2line", "-e", module, "-afiC", *map(hex, found)])
            for address, part in zip(found, re.split(r"^0x", said, flags=re.M)[1:], strict=False):
                _lines[module, address] = _functions(part.splitlines()[1:])
    return [line for frame in frames for line in _lines[frame]]


def _functions(pairs: Sequence[str]) -> list[str]:
    """Return what addr2line says of one address: functions and places take turns."""
    places = [(_place(where), name) for name, where in zip(pairs[::2], pairs[1::2], strict=False)]
    return [f"{place} in {name}" for place, name in places if place]


def callback_place(name: str, maker: Sequence[Frame]) -> str:
    """Return ``node.cpp:24`` of a function or lambda, by the name that rclcpp gives a callback; of
    a ``std::bind``, or what was inlined, the line that makes its subscription, timer or service. ""
    without debug information, and for ROS's own. ``maker`` has the frames of that line."""
    return _function_place(maker[0][0], name) or _first_place(_lines_of(maker)) if maker else ""


def _first_place(lines: Sequence[str]) -> str:
    return lines[0].partition(" in ")[0] if lines else ""


@cache
def _function_place(module: str, name: str) -> str:
    if not _has_lines(module):
        return ""
    for line in _symbols(module):
        address, _, symbol = line.split(" ", 2)
        if symbol == name or symbol.startswith(name + _LAMBDA_CALL):
            return _first_place(_lines_of([(module, int(address, 16))])[-1:])
    return ""


@lru_cache(maxsize=8)
def _symbols(module: str) -> list[str]:
    words = ["nm", "-C", "--defined-only", module]
    return [line for line in _output(words).splitlines() if line[:1] != " "]


def _output(words: Sequence[str]) -> str:
    try:
        return subprocess.run(words, capture_output=True, text=True, check=False).stdout
    except OSError:  # no binutils
        return ""


def _place(where: str) -> str:
    """Return ``src/node.cpp:24``, "" for code of a library. Paths are relative to the working
    directory; those that lie elsewhere are file names."""
    file, _, number = where.partition(" (")[0].rpartition(":")
    path = Path(file)
    if not number.isdecimal() or not path.is_absolute() or _is_of_library(path):
        return ""
    here = Path.cwd()
    return f"{path.relative_to(here) if path.is_relative_to(here) else path.name}:{number}"


def _is_of_library(path: Path) -> bool:
    """Return whether a header belongs to the system, or was installed into a prefix."""
    prefixes = takewhile(bool, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    roots = ["/usr", *(str(Path(prefix, "include")) for prefix in prefixes)]
    return "site-packages" in path.parts or any(path.is_relative_to(root) for root in roots)
