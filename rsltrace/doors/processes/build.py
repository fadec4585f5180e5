"""The library that processes are started with: built on first use, against the ROS that is here.

What is built lies in the user's cache, by the sources, the compiler and the versions of ROS.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rsltrace.errors import SetupError
from rsltrace.workspace.cache import cached_folder, key_of

SOURCES = Path(__file__).parent / "native"
_NAME = "librmw_rsltrace.so"
_STUB = "librsltrace_python_symbols.so"
_DIGEST = "digest"
_HEADERS = ("rmw/rmw/rmw.h", "rcl/rcl/rcl.h", "fastcdr/Cdr.h")
_LIBRARIES = ("rmw", "rcutils", "fastcdr", "rosidl_runtime_c")
_PACKAGES = "rmw, rcl and rmw-fastrtps-cpp"
_ERROR_LINES = 12


@dataclass(frozen=True, slots=True)
class Ros:
    """A ROS installation to build against: its headers and libraries, and where else libraries
    are that these need."""

    prefix: Path
    libraries: tuple[Path, ...]

    @property
    def include(self) -> tuple[Path, ...]:
        """The folders that a compiler looks into."""
        root = self.prefix / "include"
        return (root, *sorted(path for path in root.iterdir() if path.is_dir()))


def find_ros() -> Ros:
    """Return the ROS that is sourced, or the one that is installed in this environment.

    :raises SetupError: if there is none with headers.
    """
    listed = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    for prefix in (Path(folder) for folder in [*listed, sys.prefix] if folder):
        include = prefix / "include"
        if all(
            (include / name).exists() or (include / "fastcdr" / name).exists() for name in _HEADERS
        ):
            more = sorted(Path(sys.prefix).glob("lib/python*/site-packages/ros_*.libs"))
            return Ros(prefix, (prefix / "lib", *more))
    raise SetupError(
        f"processes need ROS 2 with its headers ({_HEADERS[0]}), which is neither sourced nor in "
        f"{sys.prefix}: install it (pip install 'rsltrace[ros]', or apt install ros-jazzy-rcl "
        "ros-jazzy-rmw-fastrtps-cpp, and source it)"
    )


def find_compiler() -> list[str]:
    """Return the command of the C++ compiler.

    :raises SetupError: if there is none, or not the one that is named in ``CXX``.
    """
    given = os.environ.get("CXX", "")
    try:
        named = shlex.split(given)
    except ValueError as error:
        raise SetupError(f"CXX={given!r} is no command: {error}") from error
    for command in (named, ["g++"], ["clang++"]):
        if command and shutil.which(command[0]):
            return command
        if command and command is named:
            raise SetupError(f"CXX={given!r}: there is no program {command[0]!r}")
    raise SetupError(
        "processes need a C++ compiler, once, to build the library that they are started with: "
        "install g++ (apt install g++), or name one in CXX"
    )


@dataclass(frozen=True, slots=True)
class Library:
    """What is preloaded into processes. ``python_symbols`` stands in for what libraries of ROS
    want from Python, in programs that have none."""

    path: Path
    python_symbols: Path
    ros: Ros


def library(told: Callable[[str], None], extra: Sequence[str] = ()) -> Library:
    """Return the library; it is built if it has not been, and ``told`` is given one line then.

    :raises SetupError: if a compiler or headers are missing, or the compiler refuses the sources.
    """
    ros, compiler = find_ros(), find_compiler()
    sources = sorted(SOURCES.glob("*.[ch]*"))
    version = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False)
    name = key_of(
        [
            " ".join([*compiler, *extra]),
            version.stdout,
            str(ros.prefix),
            platform.machine(),
            *_stamps(ros),
            *(part for path in sources for part in (path.name, path.read_bytes())),
        ]
    )

    def make(folder: Path) -> None:
        told(
            f"building the library that processes run with (once; 15 to 30 seconds): "
            f"{compiler[0]}, {ros.prefix}"
        )
        cpp = [str(path) for path in sources if path.suffix == ".cpp"]
        include = [f"-I{path}" for path in ros.include]
        link = [f"-l{name}" for name in _LIBRARIES]
        _compile(
            [
                *compiler,
                *_options(),
                *extra,
                *cpp,
                "-o",
                str(folder / _NAME),
                *include,
                f"-L{ros.prefix / 'lib'}",
                f"-Wl,-rpath,{ros.prefix / 'lib'}",
                *link,
                "-ldl",
            ]
        )
        stub = str(SOURCES / "python_symbols" / "symbols.cpp")
        _compile([*compiler, *_options(), stub, "-o", str(folder / _STUB)])
        (folder / _DIGEST).write_text(_digest(folder))

    folder = cached_folder("processes", name, make)
    if not _is_whole(folder):
        shutil.rmtree(folder, ignore_errors=True)
        folder = cached_folder("processes", name, make)
    return Library(folder / _NAME, folder / _STUB, ros)


def _digest(folder: Path) -> str:
    return key_of((folder / name).read_bytes() for name in (_NAME, _STUB))


def _is_whole(folder: Path) -> bool:
    """Return whether a folder of the cache has what was built: the dynamic linker leaves out a
    library that is cut off, and the process would run outside of the run."""
    try:
        return (folder / _DIGEST).read_text() == _digest(folder)
    except OSError:
        return False


def _options() -> list[str]:
    return ["-std=c++17", "-O2", "-g1", "-fPIC", "-shared", "-fvisibility=hidden", "-pthread"]


def _stamps(ros: Ros) -> list[str]:
    """Return what changes when ROS is installed anew."""
    files = [ros.prefix / "lib" / f"lib{name}.so" for name in (*_LIBRARIES, "rcl")]
    return [f"{path.stat().st_size} {path.stat().st_mtime_ns}" for path in files if path.exists()]


def _compile(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line] or (
            done.stderr.splitlines()
        )
        lines = lines or [f"exit status {done.returncode}"]
        shown = "\n".join(f"  {line}" for line in lines[:_ERROR_LINES])
        raise SetupError(
            f"{command[0]} cannot build the library that processes run with against the headers of "
            f"{_PACKAGES}:\n{shown}"
        )


__all__ = ["Library", "Ros", "find_compiler", "find_ros", "library"]
