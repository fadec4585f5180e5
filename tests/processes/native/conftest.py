"""The part of the library that stands before libc, with a loop of the tests' own, and programs."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from rsltrace.adapters.processes.build import SOURCES as LIBRARY
from rsltrace.adapters.processes.build import find_compiler
from rsltrace.errors import SetupError

SOURCES = Path(__file__).parent
OURS = (
    "real scheduler pthread_lives pthread_locks pthread_waits futex clocks entropy processors "
    "stacks outside calls files polling timer_files writing fortified temporary_names c11_threads "
    "system_calls"
).split()
_WARNINGS = ("-Wall", "-Wextra", "-Werror")


@dataclass(frozen=True)
class Ran:
    """What a program printed, and how it ended."""

    out: str
    err: str
    status: int


@dataclass(frozen=True)
class Programs:
    """Compiled programs, and the library that they run with if they are not to run natively."""

    folder: Path

    def run(
        self,
        name: str,
        *words: str,
        native: bool = False,
        before: Sequence[str] = (),
        given: str = "",
        timeout_s: float = 300,
        **environment: str,
    ) -> Ran:
        """Run one, behind the words ``before``; ``given`` comes to its standard input.

        :raises subprocess.TimeoutExpired: if it takes longer than ``timeout_s``.
        """
        library = {"LD_PRELOAD": str(self.folder / "libtry.so"), "RSLTRACE_LONE": "1"}
        if native:
            library = {}
        pairs = [f"{key}={value}" for key, value in (library | environment).items()]
        done = subprocess.run(
            [*before, "env", *pairs, str(self.folder / name), *words],
            input=given,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )
        return Ran(done.stdout, done.stderr, done.returncode)


def _compile(compiler: list[str], words: Sequence[str]) -> None:
    subprocess.run([*compiler, *_WARNINGS, "-pthread", "-g", *words], check=True)


@pytest.fixture(scope="session")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Programs:
    """Everything here, compiled."""
    try:
        compiler = find_compiler()
    except SetupError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("native")
    parts = [*(LIBRARY / f"{name}.cpp" for name in OURS), SOURCES / "lone_loop.cpp"]
    options = ["-std=c++17", "-O2", "-fPIC", "-fvisibility=hidden", f"-iquote{LIBRARY}", "-c"]

    def compile_part(part: Path) -> str:
        target = str(folder / f"{part.stem}.o")
        _compile(compiler, [*options, str(part), "-o", target])
        return target

    def compile_program(name: str) -> None:
        words = ["-std=c++20", "-O1", "-rdynamic", "-U_FORTIFY_SOURCE", "-D_FORTIFY_SOURCE=2"]
        linked = [f"-L{folder}", f"-Wl,-rpath,{folder}", "-learly"] if name == "early" else []
        _compile(
            compiler, [*words, str(SOURCES / f"{name}.cpp"), "-o", str(folder / name), *linked]
        )

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = list(pool.map(compile_part, parts))
        early = ["-shared", "-fPIC", "-DLIBRARY", str(SOURCES / "early.cpp")]
        _compile(compiler, [*early, "-o", str(folder / "libearly.so")])
        names = ("random_threads", "corner_cases", "early", "layout", "machine")
        list(pool.map(compile_program, names))
    _compile(compiler, ["-shared", *objects, "-o", str(folder / "libtry.so"), "-ldl"])
    return Programs(folder)


Corner = Callable[..., Ran]


@pytest.fixture(scope="session")
def corner(programs: Programs) -> Corner:
    """Run a corner case by its name."""

    def run(name: str, *, native: bool = False, given: str = "", **environment: str) -> Ran:
        return programs.run("corner_cases", name, native=native, given=given, **environment)

    return run
