"""Record a job in a process with a perturbed environment.

Everything that may silently differ between runs and machines is made to differ: a job whose
digest stays the same does not depend on it.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from rsltrace.adapters.workspace.cache import same_place
from rsltrace.child_processes import Done, Processes, how_ended, rsltrace_command
from rsltrace.guard.pin import MEMORY_NOISE, THREAD_VARIABLES
from rsltrace.trace.format import METADATA_STATES

HASH_SEED = "hash seed"
FOLDER = "working directory"
LOCALE = "locale"
TIME_ZONE = "time zone"
HEAP = "allocation noise"
ADDRESSES = "address space"
LOAD = "CPU load"
THREAD_COUNT = "thread counts"
KERNEL = "BLAS core type"
CORE_TYPE = "OPENBLAS_CORETYPE"
KINDS = (HASH_SEED, FOLDER, LOCALE, TIME_ZONE, HEAP, ADDRESSES, LOAD, THREAD_COUNT, KERNEL)

_LOCALES = ("C", "C.UTF-8", "de_DE.UTF-8", "tr_TR.UTF-8", "POSIX", "ja_JP.UTF-8")
_ZONES = ("UTC", "Asia/Kathmandu", "America/St_Johns", "Pacific/Apia", "XYZ+5:17")
_KERNELS = {"sse3": "Nehalem", "avx": "Sandybridge", "avx2": "Haswell", "avx512f": "SkylakeX"}
"""By a flag of the processor, the oldest core type of OpenBLAS that uses it."""

_RESULT_MAX = 1 << 20
"""How far from the end of what a run has printed its result can begin."""

# Fills the heap first, so that fresh memory is never zero and addresses differ.
_NOISE = """
import random as r
g = r.Random({seed})
n = [bytes([g.randrange(1, 256)]) * g.randrange(8, 5000) for _ in range(g.randrange(500, 4000))]
o = [object() for _ in range(g.randrange(20000))]
del n[::2], o[::3], g, r
"""

# Keeps a CPU busy for as long as the parent process lives.
_BUSY = """
import os
parent = os.getppid()
while os.getppid() == parent:
    for _ in range(1000000):
        pass
"""


@dataclass(frozen=True, slots=True)
class Perturbation:
    """The perturbed environment of one process; ``values`` has a text for each perturbed kind."""

    number: int
    values: Mapping[str, str]
    alone: str = ""
    """The only perturbed kind, for a run with just one."""

    def only(self, kind: str) -> Perturbation:
        """Return the same with only one kind perturbed."""
        return Perturbation(self.number, {kind: self.values[kind]}, kind)

    def __str__(self) -> str:
        if not self.values:
            return "nothing perturbed"
        return ", ".join(f"{kind} {value}".rstrip() for kind, value in self.values.items())


@dataclass(frozen=True, slots=True)
class PerturbedRun:
    """The result of one run.

    ``digest`` is empty if the process did not finish a trace. ``failure`` says what went wrong, if
    anything did; ``errors`` is its stderr. ``states`` are the samples of nodes' states that its
    trace has, as JSON.
    """

    perturbation: Perturbation
    path: Path
    digest: str
    events: int
    exit_code: int
    failure: str
    errors: str
    states: str = ""

    @property
    def outcome(self) -> tuple[str, int]:
        """What must be the same in every run."""
        return self.digest, self.exit_code

    @property
    def kept(self) -> tuple[str, int, str]:
        """The same, and what the nodes kept."""
        return *self.outcome, self.states


def perturbation(number: int, seed: int = 0) -> Perturbation:
    """Return the perturbation of run ``number``; run 0 has none.

    Hash seed and address space are fixed where they are not perturbed, so that a difference has a
    cause.
    """
    if number == 0:
        return Perturbation(0, {})
    chance = random.Random(f"{seed} {number}")
    values = {
        HASH_SEED: str(chance.randrange(2**32)),
        FOLDER: "x" * chance.randrange(1, 60),
        LOCALE: chance.choice(_LOCALES),
        TIME_ZONE: chance.choice(_ZONES),
        HEAP: str(chance.randrange(2**32)),
        LOAD: chance.choice(("one more process, nice 5", "one more process")),
        THREAD_COUNT: str(chance.choice((1, 2, 3, 4, 8))),
    }
    if can_fix_addresses():
        values[ADDRESSES] = "random"
    kernels = core_types()
    if len(kernels) > 1 and not os.environ.get(CORE_TYPE):  # unless the user has chosen one
        values[KERNEL] = chance.choice(kernels)
    return Perturbation(number, values)


def core_types() -> tuple[str, ...]:
    """Return the core types of OpenBLAS that this processor can be."""
    try:
        after = Path("/proc/cpuinfo").read_text().split("flags", 1)[1]
        flags = set(after.split("\n", 1)[0].split())
    except (OSError, IndexError):
        return ()
    return tuple(kernel for flag, kernel in _KERNELS.items() if flag in flags | {"sse3"})


@lru_cache
def can_fix_addresses() -> bool:
    """Return whether a process can start with fixed addresses; containers may forbid it."""
    setarch = shutil.which("setarch")
    if setarch is None:
        return False
    done = subprocess.run([setarch, "-R", "true"], capture_output=True, check=False)
    return done.returncode == 0


def record_perturbed(
    around: Perturbation,
    arguments: Sequence[str],
    folder: Path,
    *,
    path: Path | None = None,
    processes: Processes | None = None,
    timeout_s: float | None = None,
) -> PerturbedRun:
    """Record in a perturbed process; ``arguments`` are those of ``record``, paths absolute.

    The trace goes to ``path``, or to a new file in ``folder``.
    """
    path = path or folder / f"{_name(around)}.mcap"
    words = record_words([*arguments, "--sample-states"], path)
    done = run_in(around, words, folder, processes=processes, timeout_s=timeout_s)
    found = perturbed_run(around, path, done)
    return replace(found, states=_states_in(found.path)) if found.digest else found


def _states_in(path: Path) -> str:
    from rsltrace.trace.reader import Trace  # which loads numpy

    with Trace.open(path) as trace:
        return trace.metadata(METADATA_STATES).get("samples", "")


def run_in(
    around: Perturbation,
    words: Sequence[str],
    folder: Path,
    *,
    processes: Processes | None = None,
    timeout_s: float | None = None,
) -> Done:
    """Run ``rsltrace`` in a perturbed process. Paths in ``words`` are absolute."""
    values = around.values
    cwd = _working_folder(folder / f"{_name(around)}.cwd", values.get(FOLDER))
    home = folder / f"{_name(around)}.home"
    home.mkdir(exist_ok=True)
    noise = _NOISE.format(seed=values[HEAP]) if HEAP in values else ""
    command = rsltrace_command(words, before=noise)
    if "nice" in values.get(LOAD, "") and shutil.which("nice"):
        command = ["nice", "-n", "5", *command]
    if ADDRESSES not in values and can_fix_addresses():
        command = ["setarch", "-R", *command]
    started = processes or Processes()
    load = started.beside([sys.executable, "-c", _BUSY]) if LOAD in values else nullcontext()
    with load:
        return started.run(command, cwd=cwd, env=_environment(values, home), timeout_s=timeout_s)


def _working_folder(place: Path, name: str | None) -> Path:
    """Make a working directory in ``place`` in which the same relative paths work.

    The entries of the real one and of its parent are linked; new files of a run stay here.
    """
    here = Path.cwd()
    cwd = place / (name or here.name or "here")
    cwd.mkdir(parents=True, exist_ok=True)
    for folder, mirror in ((here, cwd), (here.parent, place)):
        with suppress(PermissionError):
            for entry in folder.iterdir():
                with suppress(FileExistsError):
                    (mirror / entry.name).symlink_to(entry)
    return cwd


def _name(around: Perturbation) -> str:
    return "-".join(("run", str(around.number), *around.alone.split()))


def record_words(arguments: Sequence[str], path: Path) -> list[str]:
    """Return the words of a command whose output ``perturbed_run`` reads."""
    return ["record", *arguments, "-o", str(path), "--force", "--quiet", "--json"]


def perturbed_run(around: Perturbation, path: Path, done: Done) -> PerturbedRun:
    """Return the result of a run, from what its process has printed."""
    result = _result_in(done.output)
    try:
        digest, events = str(result["digest"]), int(result["events"])
        failure = str(result["error"] or "")
        path = Path(result["path"])  # an existing trace stays if the run cannot start
    except (ValueError, KeyError, TypeError):
        digest, events, failure = "", 0, ""
    if done.timed_out:
        digest, failure = "", "it took too long and was killed (see --timeout)"
    elif done.exit_code < 0:
        digest, failure = "", f"it {how_ended(done.exit_code)}"
    elif not digest and not failure:
        failure = f"it ended with exit status {done.exit_code} and no trace"
    return PerturbedRun(around, path, digest, events, done.exit_code, failure, done.errors)


def _result_in(output: str) -> dict[str, Any]:
    """Return the JSON object that ``record --json`` has printed. It may be in the middle of a line:
    nodes print to stdout, too."""
    end = output[-_RESULT_MAX:]
    for found in reversed(list(re.finditer(r'\{"', end))):
        try:
            value, _ = json.JSONDecoder().raw_decode(end, found.start())
        except ValueError:
            continue
        if "digest" in value and "events" in value:
            return dict(value)
    return {}


def _environment(values: Mapping[str, str], home: Path) -> dict[str, str]:
    env = {**os.environ, **same_place()}
    env["PYTHONHASHSEED"] = values.get(HASH_SEED, "0")
    if FOLDER in values:
        env["HOME"] = str(home)
    if LOCALE in values:
        env.update(LC_ALL=values[LOCALE], LANG=values[LOCALE])
    if TIME_ZONE in values:
        env["TZ"] = values[TIME_ZONE]
    if HEAP in values:
        env["PADDING"] = "p" * (int(values[HEAP]) % 4000)
    if HEAP in values or ADDRESSES in values:
        env[MEMORY_NOISE] = f"{values.get(HEAP, '0')}:{int(ADDRESSES in values)}"
    if THREAD_COUNT in values:
        env.update(dict.fromkeys(THREAD_VARIABLES, values[THREAD_COUNT]))
    if KERNEL in values:
        env[CORE_TYPE] = values[KERNEL]
    return env
