"""Recording a job in a process of its own whose surroundings are unlike those of any other.

Whatever may differ from run to run and machine to machine without anybody noticing is made to
differ: a job whose digest stays the same does not depend on it.
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rsltrace.guard.pin import MARK, THREADS

HASH_SEED = "hash seed"
FOLDER = "working directory"
LOCALE = "locale"
TIME_ZONE = "time zone"
HEAP = "allocation noise"
ADDRESSES = "address space"
LOAD = "CPU load"
THREAD_COUNT = "thread counts"
KERNEL = "BLAS core type"
KINDS = (
    HASH_SEED,
    FOLDER,
    LOCALE,
    TIME_ZONE,
    HEAP,
    ADDRESSES,
    LOAD,
    THREAD_COUNT,
    KERNEL,
)

_LOCALES = ("C", "C.UTF-8", "de_DE.UTF-8", "tr_TR.UTF-8", "POSIX", "ja_JP.UTF-8")
_ZONES = ("UTC", "Asia/Kathmandu", "America/St_Johns", "Pacific/Apia", "XYZ+5:17")
_KERNELS = {"sse3": "Nehalem", "avx": "Sandybridge", "avx2": "Haswell", "avx512f": "SkylakeX"}
"""By a flag of the processor, the oldest core type of OpenBLAS that uses it."""

# What a process does to its heap before anything else, so that fresh memory is never zero and
# addresses are others.
_NOISE = """
import random as r, runpy, sys
g = r.Random(int(sys.argv.pop(1)))
n = [bytes([g.randrange(1, 256)]) * g.randrange(8, 5000) for _ in range(g.randrange(500, 4000))]
o = [object() for _ in range(g.randrange(20000))]
del n[::2], o[::3], g, r
sys.argv = ['rsltrace'] + sys.argv[1:]
runpy.run_module('rsltrace', run_name='__main__')
"""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """How one process is set up; ``values`` has a text for every kind that is perturbed."""

    number: int
    values: Mapping[str, str]

    def only(self, kind: str) -> Surroundings:
        """Return these surroundings with nothing but one kind perturbed."""
        return Surroundings(self.number, {kind: self.values[kind]})

    def __str__(self) -> str:
        return ", ".join(f"{kind} {value}".rstrip() for kind, value in self.values.items())


@dataclass(frozen=True, slots=True)
class Recorded:
    """What came of one run: its trace (if there is one), digest, exit status, and what it said."""

    surroundings: Surroundings
    path: Path
    digest: str
    exit_code: int
    errors: str


def surroundings(number: int, seed: int = 0) -> Surroundings:
    """Return the surroundings of run ``number``; run 0 has nothing perturbed.

    What differs between any two processes (hash seed, address space) is fixed where it is not
    perturbed, so that a difference has a cause.
    """
    if number == 0:
        return Surroundings(0, {})
    chance = random.Random(f"{seed} {number}")
    values = {
        HASH_SEED: str(chance.randrange(2**32)),
        FOLDER: "x" * chance.randrange(1, 60),
        LOCALE: chance.choice(_LOCALES),
        TIME_ZONE: chance.choice(_ZONES),
        HEAP: str(chance.randrange(2**32)),
        ADDRESSES: "random",
        LOAD: chance.choice(("one more process, nice 5", "one more process")),
        THREAD_COUNT: str(chance.choice((1, 2, 3, 4, 8))),
    }
    kernels = core_types()
    if len(kernels) > 1:
        values[KERNEL] = chance.choice(kernels)
    return Surroundings(number, values)


def core_types() -> tuple[str, ...]:
    """Return the core types of OpenBLAS that this processor can be."""
    try:
        after = Path("/proc/cpuinfo").read_text().split("flags", 1)[1]
        flags = set(after.split("\n", 1)[0].split())
    except (OSError, IndexError):
        return ()
    return tuple(kernel for flag, kernel in _KERNELS.items() if flag in flags | {"sse3"})


def record_in(
    around: Surroundings, job: Path, folder: Path, arguments: Iterable[str] = ()
) -> Recorded:
    """Record a job in a process with these surroundings; the trace goes below ``folder``."""
    values = around.values
    name = f"{around.number}-{len(values)}-{next(iter(values), 'plain').replace(' ', '_')}"
    cwd = folder / f"{name}.cwd" / values.get(FOLDER, ".")
    cwd.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.mcap"
    command = [sys.executable]
    command += ["-c", _NOISE, values[HEAP]] if HEAP in values else ["-m", "rsltrace"]
    command += ["record", str(job), "-o", str(path), "--force", "--quiet", *arguments]
    if "nice" in values.get(LOAD, "") and shutil.which("nice"):
        command = ["nice", "-n", "5", *command]
    if ADDRESSES not in values and shutil.which("setarch"):
        command = ["setarch", "-R", *command]
    with _load(LOAD in values):
        done = subprocess.run(
            command,
            cwd=cwd,
            env=_environment(values, cwd),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="backslashreplace",
            check=False,
        )
    last = done.stdout.strip().splitlines()[-1:] or [""]
    digest = last[0].split()[1] if last[0].startswith("digest ") else ""
    return Recorded(around, path, digest, done.returncode, done.stderr)


def _environment(values: Mapping[str, str], cwd: Path) -> dict[str, str]:
    env = {name: value for name, value in os.environ.items() if name != MARK}
    env["PYTHONHASHSEED"] = values.get(HASH_SEED, "0")
    if FOLDER in values:
        env["HOME"] = str(cwd)
    if LOCALE in values:
        env.update(LC_ALL=values[LOCALE], LANG=values[LOCALE])
    if TIME_ZONE in values:
        env["TZ"] = values[TIME_ZONE]
    if HEAP in values:
        env["PADDING"] = "p" * (int(values[HEAP]) % 4000)
    if THREAD_COUNT in values:
        env.update(dict.fromkeys(THREADS, values[THREAD_COUNT]))
    if KERNEL in values:
        env["OPENBLAS_CORETYPE"] = values[KERNEL]
    return env


@contextmanager
def _load(wanted: bool) -> Iterator[None]:
    if not wanted:
        yield
        return
    load = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        load.kill()
        load.wait()
