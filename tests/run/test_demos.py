"""Programs that know nothing of rsltrace do in a simulation what they do over DDS.

The packages under ``tests/demos`` are run both ways: each program natively as a process, and all of
them together as the executables of a job. Every program logs what it does, and the census logs who
offers which topic and service.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import demo_packages as demos
import pytest

import rsltrace
from rsltrace.search.perturb import LOAD, Perturbation, perturbation, record_perturbed
from tests.tiers import cases

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(
        importlib.util.find_spec("test_msgs") is None, reason="needs ROS 2's test_msgs"
    ),
]

RUNS = cases(3, 10)


@pytest.fixture(scope="module")
def prefix(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demos.install_demos(tmp_path_factory.mktemp("demos"))


def job_text(prefix: Path, *programs: tuple[str, ...]) -> str:
    lines = ["nodes:"]
    for name, *arguments in programs:
        entry = f"executable: {demos.package_of(name)}/{name}, arguments: [{', '.join(arguments)}]"
        lines.append(f"  - {{{entry}}}")
    return "\n".join([*lines, f"search_path: [{prefix}]", "stop: {duration: 30s}", ""])


def record(job: Path, output: Path) -> None:
    """Record with the command, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", "record", str(job), "-o", str(output), "--quiet"],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr


def logs_of(path: Path) -> dict[str, list[str]]:
    logs: defaultdict[str, list[str]] = defaultdict(list)
    with rsltrace.Trace.open(path) as trace:
        for _, _, data in trace.messages("/rosout"):
            record = trace.decode("/rosout", data)
            logs[record.name].append(record.msg)
    return dict(logs)


def everybody(prefix: Path, folder: Path) -> Path:
    """Write the job of all servers and clients."""
    job = folder / "demos.yaml"
    job.write_text(job_text(prefix, *((name,) for name in (*demos.SERVERS, *demos.CLIENTS))))
    return job


@pytest.mark.native
@pytest.mark.usefixtures("own_domain")
def test_programs_do_what_they_do_over_dds(prefix: Path, tmp_path: Path) -> None:
    # Over DDS the census was taken before the clients came; so here.
    census = tmp_path / "census.yaml"
    census.write_text(job_text(prefix, *((name,) for name in demos.SERVERS), demos.CENSUS))
    record(census, tmp_path / "census.mcap")
    record(everybody(prefix, tmp_path), tmp_path / "demos.mcap")
    ours = logs_of(tmp_path / "demos.mcap")
    ours["census"] = logs_of(tmp_path / "census.mcap")["census"]
    for number in range(4):
        natively = demos.run_natively(prefix, tmp_path / f"native{number}")
        if ours == natively:  # or a goal was over before a busy machine took it back
            break
    assert ours == natively
    # The comparison is worth something: everybody has said what it is there for.
    silent = {"adder"}
    assert set(ours) == {*demos.SERVERS, *demos.CLIENTS, "census"} - silent
    assert ours["listener"][-1] == "141 letters"
    assert ours["fibonacci_client"][-1] == "9: canceled []"
    assert "camera serves /camera/change_state lifecycle_msgs/srv/ChangeState" in ours["census"]


@pytest.mark.long
@pytest.mark.repeated
def test_one_digest_whatever_surrounds_the_run(prefix: Path, tmp_path: Path) -> None:
    job = everybody(prefix, tmp_path)

    def perturbed(number: int) -> tuple[str, int]:
        values = perturbation(number).values
        around = Perturbation(number, {k: v for k, v in values.items() if k != LOAD})
        recorded = record_perturbed(around, [str(job)], tmp_path)
        assert recorded.digest, recorded.failure
        return recorded.digest, recorded.events

    with ThreadPoolExecutor(max_workers=2) as pool:
        digests = set(pool.map(perturbed, range(RUNS)))
    assert len(digests) == 1, digests
