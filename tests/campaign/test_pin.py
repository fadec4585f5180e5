"""``rsltrace record`` runs pinned, unless it is told not to."""

from __future__ import annotations

import ast
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import rsltrace.guard.pin as pin
from rsltrace.diff.causes.relevance import environment_settings
from rsltrace.search.perturb import can_fix_addresses
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

SHOW = (
    "log(' '.join([str(os.environ.get(n)) for n in "
    "('PYTHONHASHSEED', 'TZ', 'LC_ALL', 'OMP_NUM_THREADS', 'RSLTRACE_PINNED')] "
    "+ [str(sys.flags.hash_randomization), open('/proc/self/personality').read()]))"
)
OURS = {"PYTHONHASHSEED": "5", "TZ": "Asia/Kathmandu", "LC_ALL": "POSIX", "OMP_NUM_THREADS": "3"}


@pytest.fixture
def shown(
    rsltrace: Callable[..., Any], job: Callable[..., Path]
) -> Callable[..., tuple[list[str], str]]:
    def record(*words: str, more: str = "") -> tuple[list[str], str]:
        environment = {**os.environ, **OURS}
        done = rsltrace(
            "record", job(SHOW, more), "-o", "run.mcap", "--force", *words, env=environment
        )
        assert done.returncode == 0, done.stderr
        line = next(line for line in done.stderr.splitlines() if "] [n]: " in line)
        return line.partition("] [n]: ")[2].split(), done.stdout.split()[1]

    return record


def test_the_process_is_pinned_whatever_was_set(
    shown: Callable[..., tuple[list[str], str]], tmp_path: Path
) -> None:
    values, _ = shown()
    assert values[:6] == ["0", "UTC", "C.UTF-8", "1", "None", "0"]
    if can_fix_addresses():
        assert int(values[6], 16) & 0x0040000
    with Trace.open(tmp_path / "run.mcap") as trace:
        assert trace.environment["hash_seed"] == "0"
        assert "numerics" not in trace.environment, "no module of the job uses numbers"


PYTHON = {
    "PYTHONOPTIMIZE": "2",
    "PYTHONWARNINGS": "error::UserWarning",
    "PYTHONINTMAXSTRDIGITS": "640",
    "PYTHONDEVMODE": "1",
    "PYTHONASYNCIODEBUG": "1",
    "PYTHONNODEBUGRANGES": "1",
    "PYTHONUTF8": "1",
    "PYTHONIOENCODING": "latin-1",
}


def test_no_option_of_python_changes_what_nodes_do(
    rsltrace: Callable[..., Any], job: Callable[..., Path], tmp_path: Path
) -> None:
    path = job(
        "import warnings; assert warnings.warn('x') is None; "
        "log(f'{__debug__} {sys.flags} {sys.get_int_max_str_digits()} {sys.stdout.encoding}')"
    )
    options = []
    digests = set()
    for environment, words in (({}, ()), (PYTHON, ()), (PYTHON, ("--no-pin",))):
        done = rsltrace(
            "record", path, "-o", "run.mcap", "--force", *words, env={**os.environ, **environment}
        )
        digests.add(done.stdout.split()[1])
        with Trace.open(tmp_path / "run.mcap") as trace:
            options.append(trace.environment.get("python_options"))
    assert len(digests) == 2, "pinned, it is the same"
    assert options[:2] == [None, None]
    assert "-O2 -X dev" in options[2]
    assert "-W error::UserWarning" in options[2]


def test_libraries_are_looked_for_in_one_order(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[Mapping[str, str]] = []
    monkeypatch.setattr(pin, "_before", "")
    monkeypatch.setattr(pin, "fix_addresses", lambda fixed: False)
    monkeypatch.setattr(os, "execve", lambda file, words, environment: started.append(environment))
    monkeypatch.setenv("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "1")
    for folders in ("/site/ros_b.libs:/mine:/site/ros_a.libs", "/site/ros_a.libs:/mine"):
        monkeypatch.setenv("LD_LIBRARY_PATH", folders)
        pin.pin()
    monkeypatch.delenv("_ROS_WHEELS_BOOTSTRAP_COMPLETE")  # without wheels the order is the user's
    pin.pin()
    assert [one["LD_LIBRARY_PATH"] for one in started] == [
        "/mine:/site/ros_a.libs:/site/ros_b.libs",
        "/mine:/site/ros_a.libs",
        "/site/ros_a.libs:/mine",
    ]
    before = ast.literal_eval(started[0]["RSLTRACE_PINNED"])
    assert before["LD_LIBRARY_PATH"] == "/site/ros_b.libs:/mine:/site/ros_a.libs"


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("words", "more"),
    [(["--no-pin"], ""), ([], "guard: {pin: false}\n"), ([], "guard: false\n")],
)
def test_it_can_be_left_as_it_is(
    shown: Callable[..., tuple[list[str], str]], words: list[str], more: str
) -> None:
    values, _ = shown(*words, more=more)
    assert values[:5] == [*OURS.values(), "None"]
    assert values[6] == Path("/proc/self/personality").read_text().strip()


def test_of_a_job_that_uses_numbers_the_kernel_is_told(
    rsltrace: Callable[..., Any], job: Callable[..., Path], tmp_path: Path
) -> None:
    path = job("log('x')")
    code = (tmp_path / "verified.py").read_text()
    (tmp_path / "verified.py").write_text("from numpy.linalg import solve\n" + code)
    assert rsltrace("record", path, "-o", "run.mcap").returncode == 0
    with Trace.open(tmp_path / "run.mcap") as trace:
        numerics = trace.environment["numerics"].split(", ")
    assert "openblas" in numerics[1]
    fewer = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA", "NPY_DISABLE_CPU_FEATURES": "X86_V4"}
    rsltrace("record", path, "-o", "fewer.mcap", env={**os.environ, **fewer})
    with Trace.open(tmp_path / "run.mcap") as one, Trace.open(tmp_path / "fewer.mcap") as other:
        assert "X86_V4" not in other.environment["numerics"]
        if "X86_V4" in numerics[0]:
            settings = {setting.name for setting in environment_settings(one, other)}
            assert settings == {"math", "numerics"}, "they round and sort differently"


def test_a_node_cannot_pin_the_process(
    rsltrace: Callable[..., Any], job: Callable[..., Path]
) -> None:
    path = job("pass")
    path.write_text("nodes:\n  - {node: 'verified:N', guard: {pin: false}}\n")
    done = rsltrace("record", path)
    assert done.returncode == 2
    assert "job.yaml:2:" in done.stderr
    assert "write it in the job's own 'guard:'" in done.stderr
