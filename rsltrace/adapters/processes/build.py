"""The library that processes are started with: built on first use, against the ROS that is here.

What is built lies in the user's cache, by the sources, the compiler and the versions of ROS.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import signal
import stat
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from rsltrace.adapters.processes.adapter import ProcessProgram
from rsltrace.adapters.workspace.cache import cached_folder, key_of
from rsltrace.child_processes import kill_group
from rsltrace.errors import SetupError
from rsltrace.fast_dataclass import dataclass
from rsltrace.guard.pin import MEMORY_NOISE
from rsltrace.job.reading.substitute import installed_prefixes

SOURCES = Path(__file__).parent / "native"
OBSERVER = (
    *(Path(__file__).parent / "observer" / name for name in ("observer.cpp", "hash64.h")),
    *(SOURCES / name for name in ("qos.h", "typesupport.cpp", "typesupport.h", "wire.h")),
)
"""The sources of the library that observes processes of native runs."""
_STUB_SOURCE = SOURCES / "python_symbols" / "symbols.cpp"
_NAME = "librmw_rsltrace.so"
_STUB = "librsltrace_python_symbols.so"
PRELOADED = (_NAME, _STUB)
"""What processes load of rsltrace."""
_DIGEST = "digest"
_HEADERS = ("rmw/rmw/rmw.h", "rcl/rcl/rcl.h", "fastcdr/Cdr.h")
_LIBRARIES = ("rmw", "rcutils", "fastcdr", "rosidl_runtime_c")
_PACKAGES = "rmw, rcl and rmw-fastrtps-cpp"
_ERROR_LINES = 12


@dataclass(frozen=True, slots=True)
class RosInstallation:
    """A ROS installation to build against: its headers and libraries, and where else libraries
    are that these need."""

    prefix: Path
    libraries: tuple[Path, ...]

    @property
    def include(self) -> tuple[Path, ...]:
        """The folders that a compiler looks into."""
        root = self.prefix / "include"
        return (root, *sorted(path for path in root.iterdir() if path.is_dir()))


def find_ros() -> RosInstallation:
    """Return the ROS that is sourced, or the one that is installed in this environment.

    :raises SetupError: if there is none with headers.
    """
    for prefix in installed_prefixes():
        include = prefix / "include"
        if all(
            (include / name).exists() or (include / "fastcdr" / name).exists() for name in _HEADERS
        ):
            more = sorted(Path(sys.prefix).glob("lib/python*/site-packages/ros_*.libs"))
            return RosInstallation(prefix, (prefix / "lib", *more))
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
class PreloadLibrary:
    """What is preloaded into processes."""

    path: Path
    ros: RosInstallation


def library(
    note: Callable[[str], None], extra: Sequence[str] = (), sources: Sequence[Path] = ()
) -> PreloadLibrary:
    """Return the library; it is built if it has not been, and ``note`` is given one line then.
    ``sources`` are those of another one.

    :raises SetupError: if a compiler or headers are missing, or the compiler refuses the sources.
    """
    ros, compiler = find_ros(), find_compiler()
    sources = sources or sorted(SOURCES.glob("*.[ch]*"))
    command = [*compiler, *_options(), *extra]
    version = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False)
    name = key_of(
        [
            " ".join(command),
            version.stdout,
            str(ros.prefix),
            platform.machine(),
            *_stamps(ros),
            *(part for path in (*sources, _STUB_SOURCE) for part in (path.name, path.read_bytes())),
        ]
    )

    def make(folder: Path) -> None:
        note(
            f"building the library that processes run with (once; 10 to 30 seconds): "
            f"{compiler[0]}, {ros.prefix}"
        )
        _build(command, ros, sources, folder)
        (folder / _DIGEST).write_text(_digest(folder))

    folder = cached_folder("processes", name, make)
    if not _is_whole(folder):
        shutil.rmtree(folder, ignore_errors=True)
        folder = cached_folder("processes", name, make)
    return PreloadLibrary(folder / _NAME, ros)


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
    return ["-std=c++17", "-O2", "-g1", "-fPIC", "-fvisibility=hidden", "-pthread"]


def _stamps(ros: RosInstallation) -> list[str]:
    """Return what changes when ROS is installed anew."""
    files = [ros.prefix / "lib" / f"lib{name}.so" for name in (*_LIBRARIES, "rcl")]
    return [f"{path.stat().st_size} {path.stat().st_mtime_ns}" for path in files if path.exists()]


def _build(
    compiler: list[str], ros: RosInstallation, sources: Sequence[Path], folder: Path
) -> None:
    """Build the library and the stub in a folder, as many sources at a time as there are cores."""
    include = [f"-I{path}" for path in ros.include]
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        objects = {path: f"{scratch}/{path.stem}.o" for path in sources if path.suffix == ".cpp"}
        stub = [*compiler, "-shared", str(_STUB_SOURCE), "-o", str(folder / _STUB)]
        _run(
            [
                [*stub, f"-Wl,-soname,{_STUB}"],
                *([*compiler, "-c", str(path), "-o", to, *include] for path, to in objects.items()),
            ]
        )
        where = ros.prefix / "lib"
        link = [f"-L{where}", f"-Wl,-rpath,{where}:$ORIGIN"]
        link += [*(f"-l{name}" for name in _LIBRARIES), "-ldl"]
        link += ["-Wl,--no-as-needed", str(folder / _STUB)]
        _run([[*compiler, "-shared", *objects.values(), "-o", str(folder / _NAME), *link]])


def _run(commands: Iterable[list[str]]) -> None:
    """Run compilers beside each other. None of them outlives this, however it ends.

    :raises SetupError: if one fails.
    """
    waiting = list(commands)
    name = waiting[0][0]
    running: list[subprocess.Popen[str]] = []
    try:
        while waiting or running:
            while waiting and len(running) < len(os.sched_getaffinity(0)):
                with _uninterrupted():
                    running.append(_started(waiting.pop(0)))
            said = running[0].communicate()[1]
            _check(name, running.pop(0).returncode, said)
    finally:
        for one in running:
            kill_group(one.pid)
            one.communicate()


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Let nothing come between the start of a process and the note of it.

    A mask of signals would not do: the thread of a numerical library takes them, and Python raises
    in the main thread all the same.
    """
    came: list[int] = []
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if callable(signal.getsignal(number)):
                before[number] = signal.signal(number, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for each in came:
            signal.raise_signal(each)


def _started(command: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def _check(name: str, status: int, said: str) -> None:
    if not status:
        return
    lines = [line for line in said.splitlines() if "error" in line] or said.splitlines()
    lines = lines or [f"exit status {status}"]
    shown = "\n".join(f"  {line}" for line in lines[:_ERROR_LINES])
    raise SetupError(
        f"{name} cannot build the library that processes run with against the headers of "
        f"{_PACKAGES}:\n{shown}"
    )


# From a file to a command line: what runs it, and the environment it needs.

_ELF = b"\x7fELF"
_ELF_HEAD = struct.Struct("<32xQ14xHH6x")
"""Of its 64 bytes: where the program headers are, their size and number."""
_PT_INTERP = struct.pack("<I", 3)
_PATH_BYTES = 512
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
    library: PreloadLibrary,
    *,
    surroundings: Mapping[str, str],
    environment: Mapping[str, str],
    folder: Path | None,
    search_path: Sequence[str] = (),
    prefixes: Sequence[str] = (),
    pinned: bool = True,
    instant_sleep: bool = False,
    intra_process: bool = False,
) -> ProcessProgram:
    """Return a command as a process of the run: with variables of ``surroundings`` but for those of
    ``environment``.

    Python finds modules in ``search_path``, and the ament index packages in ``prefixes``.
    Python's output is not buffered: a process may be killed at any time.
    """
    path = Path(command[0])
    with path.open("rb") as file:
        is_native = b"libpython" not in file.read() and is_compiled(path)
    libraries = [str(place) for place in library.ros.libraries]
    around = {**surroundings, _UNBUFFERED: "1", **environment}
    # The loader keeps the path before all else is in memory: its length would show in addresses.
    preloaded = str(library.path).rjust(_PATH_BYTES, "/")
    around["LD_PRELOAD"] = os.pathsep.join([preloaded, *_listed(around, "LD_PRELOAD")])
    if search_path:
        around["PYTHONPATH"] = os.pathsep.join([*search_path, *_listed(around, "PYTHONPATH")])
    if prefixes:  # what is built comes first
        found = [*_listed(around, "AMENT_PREFIX_PATH"), *prefixes]
        around["AMENT_PREFIX_PATH"] = os.pathsep.join(found)
    known = [*libraries, *_listed(around, "LD_LIBRARY_PATH")]
    around["LD_LIBRARY_PATH"] = os.pathsep.join([*known, *_not_in(known, around)])
    words, fixed = list(command), True if pinned else None
    noise, _, random = around.pop(MEMORY_NOISE, "0:0").partition(":")
    fragments = 0
    if is_native:  # Python depends on addresses as the run's own process does
        fixed, fragments = fixed if random == "0" else False, int(noise)
        if path.is_absolute():  # rcl keeps copies in the heap
            words[0] = words[0].rjust(_PATH_BYTES, "/")
    return ProcessProgram(words, around, folder, fixed, fragments, instant_sleep, intra_process)


def _not_in(known: Sequence[str], environment: Mapping[str, str]) -> list[str]:
    """Return where prefixes that are sourced have libraries that nobody would look for."""
    prefixes = os.pathsep.join(_listed(environment, "AMENT_PREFIX_PATH")).split(os.pathsep)
    places = [Path(prefix) / "lib" for prefix in prefixes if prefix]
    folders = os.pathsep.join(known).split(os.pathsep)
    return [str(one) for one in places if str(one) not in folders and any(one.glob("lib*.so"))]


def _listed(environment: Mapping[str, str], name: str) -> list[str]:
    value = environment.get(name, "")
    return [value] if value else []
