"""Runs in one process are alike, byte by byte, whatever is loaded or remembered already."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rsltrace.guard.call_reports import reported_calls
from rsltrace.job import Job, NodeSpec
from rsltrace.run.process import search_path
from tests.guard.conftest import list_as_wheel

pytestmark = pytest.mark.ros

NODE = """
import mimetypes, os, platform, random, secrets, tempfile, zoneinfo
from rclpy.node import Node

class Cold(Node):
    def __init__(self, imports=True):
        super().__init__("cold")
        self.imports = imports
        self.create_timer(0.1, self.tick)

    def tick(self):
        if self.imports:
            import toolz
        said = [
            tempfile.mktemp(), secrets.token_hex(4), random.Random().random(), platform.node(),
            mimetypes.guess_type("a.png")[0], str(zoneinfo.ZoneInfo("Europe/Berlin")),
        ]
        self.get_logger().info(repr(said))

class Other(Node):
    def __init__(self):
        super().__init__("other")
        self.create_timer(0.05, lambda: self.get_logger().info(tempfile.mktemp()))
"""

READS = """
import os
from rclpy.node import Node

class Reader(Node):
    def __init__(self):
        super().__init__("reader")
        self.create_timer(0.1, lambda: os.environ.get("NOTHING"))
"""

LIBRARY_NAME = "toolz"
"""Of a library, of which this is another: it only draws when imported."""
LIBRARY = """
import os, random, secrets, time
DRAWN = (os.urandom(8), random.random(), random.Random().random(), secrets.token_hex(), time.time())
"""

RUNS = """
import hashlib, json, sys
from pathlib import Path
from rsltrace import Trace, load_job, record

def said(trace, name):
    records = [trace.decode("/rosout", data) for *_, data in trace.messages("/rosout")]
    return [one.msg for one in records if one.name == name]

found = []
for number, job in enumerate(sys.argv[1:]):
    path = Path(job).with_suffix(f".{number}.mcap")
    record(load_job(job), path)
    with Trace.open(path) as trace:
        calls = [[met.node, met.call, met.count] for met in trace.guarded]
        found.append({
            "bytes": hashlib.sha256(path.read_bytes()).hexdigest(),
            "calls": calls,
            "said": said(trace, "cold"),
        })
print(json.dumps(found))
"""

COLD = {"node": "cold:Cold"}
JOBS: dict[str, list[dict[str, Any]]] = {
    "cold": [COLD],
    "loaded": [{**COLD, "arguments": {"imports": False}}],
    "beside": [{"node": "cold:Other"}, COLD],
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Any]]]:
    """What came of each job, recorded in one fresh process: bytes, calls, what the node said."""
    pytest.importorskip("rclpy")
    folder = tmp_path_factory.mktemp("twice")
    installed = folder / "lib" / "site-packages"
    installed.mkdir(parents=True)
    (installed / f"{LIBRARY_NAME}.py").write_text(LIBRARY)
    list_as_wheel(installed, LIBRARY_NAME)
    (folder / "cold.py").write_text(NODE)
    for name, nodes in JOBS.items():
        job = {"nodes": nodes, "stop": {"duration": "0.35s"}, "guard": {"pin": False}}
        (folder / f"{name}.json").write_text(json.dumps(job))
    order = ["cold", "cold", "loaded", "beside", "cold"]
    done = subprocess.run(
        [sys.executable, "-c", RUNS, *(str(folder / f"{name}.json") for name in order)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(installed)},
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, list[dict[str, Any]]] = {}
    for name, result in zip(order, json.loads(done.stdout.splitlines()[-1]), strict=True):
        found.setdefault(name, []).append(result)
    return found


def test_the_first_run_of_a_process_and_later_ones_are_the_same(recorded: Any) -> None:
    first, second, third = recorded["cold"]
    assert len(set(first["said"])) == 3
    assert first["said"] == second["said"] == third["said"]
    assert first["calls"] == second["calls"] == third["calls"]
    assert ["/cold", "os.uname()", 3] in first["calls"], "the name of the machine, in every run"
    assert first["bytes"] == second["bytes"] == third["bytes"]


def test_what_a_library_draws_when_it_is_imported_is_not_the_nodes(recorded: Any) -> None:
    (loaded,) = recorded["loaded"]
    assert loaded["said"] == recorded["cold"][0]["said"]


def test_names_of_temporary_files_are_each_nodes_own(recorded: Any) -> None:
    (beside,) = recorded["beside"]
    assert beside["said"] == recorded["cold"][0]["said"]


def test_what_the_standard_library_remembers_is_put_back() -> None:
    import platform
    import tempfile

    from rsltrace.guard.install import installed

    names: Any = tempfile
    remembered: Any = platform
    platform.uname()
    before = tempfile.gettempdir(), names._get_candidate_names(), remembered._uname_cache
    finder = names._get_default_tempdir
    with installed():
        assert tempfile.tempdir is None
        assert remembered._uname_cache is None
        assert names._get_candidate_names() is not before[1]
        assert tempfile.gettempdir() == before[0]
        with installed():
            pass
        platform.uname()
    now = tempfile.tempdir, names._get_candidate_names(), remembered._uname_cache
    assert now[0] == before[0]
    assert now[1] is before[1]
    assert now[2] is before[2]
    assert names._get_default_tempdir is finder


def test_what_somebody_has_made_of_sockets_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    import socket

    from rsltrace.guard.install import installed

    def connect(self: object, address: object) -> None:
        raise AssertionError("no network in tests")

    monkeypatch.setattr(socket.socket, "connect", connect)
    members = dict(vars(socket.socket))
    with installed():
        assert socket.socket.connect is not connect
    assert dict(vars(socket.socket)) == members


def test_a_folder_for_temporary_files_that_somebody_chose_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import tempfile

    from rsltrace.guard.install import installed

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with installed():
        assert tempfile.gettempdir() == str(tmp_path)
    assert tempfile.tempdir == str(tmp_path)


@pytest.mark.long
def test_reads_of_the_environment_are_met_however_many_runs_there_were(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    from rsltrace import Job, NodeSpec, StopSpec, record
    from rsltrace.guard.install import installed

    kind = type(os.environ)
    for _ in range(600):  # Python 3.13 trusts what it has cached after 1000 changes of a class
        with reported_calls():
            assert not os.environ.get("NOTHING")
        assert not any(os.environ.get("NOTHING") for _ in range(3))
    (tmp_path / "cold.py").write_text(READS)
    job = Job(
        nodes=[NodeSpec(node="cold:Reader")],
        search_path=[tmp_path],
        stop=StopSpec(duration="0.2s"),
    )
    found = record(job, tmp_path / "run.mcap").guarded
    assert [(met.call, met.count) for met in found] == [("os.environ['NOTHING']", 2)]
    assert type(os.environ) is kind
    with pytest.raises(ZeroDivisionError), installed():
        raise ZeroDivisionError
    assert type(os.environ) is kind


OWN = """
import sys
from rsltrace import Trace, load_job, record

record(load_job(sys.argv[1]), sys.argv[2])
ours = sys.modules["rsltrace.simulation.middleware.events.dispatcher"]  # was loaded in the run
loader = type(ours.__loader__).__module__
assert loader != "rsltrace.guard.virtual.user_modules", "it is not user code"
with Trace.open(sys.argv[2]) as trace:
    assert list(trace.metadata("rsltrace:sources")) == ["cold"], trace.metadata("rsltrace:sources")
"""


def test_rsltrace_is_not_user_code_even_if_it_lies_in_the_search_path(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    import rsltrace

    (tmp_path / "cold.py").write_text(NODE)
    checkout = str(Path(rsltrace.__file__).parents[1])
    nodes = [{**COLD, "arguments": {"imports": False}}]
    job = {"nodes": nodes, "search_path": [".", checkout], "stop": {"duration": "0.2s"}}
    (tmp_path / "job.yaml").write_text(json.dumps(job))
    done = subprocess.run(
        [sys.executable, "-c", OWN, str(tmp_path / "job.yaml"), str(tmp_path / "run.mcap")],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr


def test_folders_that_were_packages_are_forgotten(tmp_path: Path) -> None:
    """A package without ``__init__.py`` has no file by which it is known."""
    (tmp_path / "only_a_folder" / "inner").mkdir(parents=True)
    job = Job(nodes=[NodeSpec(node="m:N")], search_path=[str(tmp_path)])
    with search_path(job):
        importlib.import_module("only_a_folder.inner")
        assert "only_a_folder.inner" in sys.modules
    assert not {"only_a_folder", "only_a_folder.inner"} & sys.modules.keys()
