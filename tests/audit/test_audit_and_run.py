"""What an audit says of a call is what the guard does about it in a run."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from rsltrace.guard.audit.audit import audit_path
from rsltrace.guard.rules import RULES, Treatment
from rsltrace.job import GuardSpec, Job, NodeSpec, StopSpec
from rsltrace.job.parts.guard import policy_of
from rsltrace.run import run
from rsltrace.trace.model.finding import GuardMode

pytestmark = pytest.mark.ros

CALLS = [
    "time.time()",
    "time.monotonic_ns()",
    "time.localtime()",
    "time.strftime('%H')",
    "datetime.datetime.now()",
    "datetime.datetime.today()",
    "datetime.date.today()",
    "numpy.datetime64('now')",
    "email.utils.formatdate()",
    "timeit.default_timer()",
    "os.times()",
    "random.random()",
    "random.Random()",
    "_random.Random()",
    "random.SystemRandom().random()",
    "numpy.random.rand()",
    "numpy.random.default_rng()",
    "numpy.random.RandomState()",
    "numpy.random.PCG64()",
    "os.urandom(3)",
    "uuid.uuid4()",
    "uuid.uuid1()",
    "secrets.token_hex(3)",
    "os.listdir('/')",
    "glob.glob('/*')",
    "list(pathlib.Path('/').iterdir())",
    "os.environ['PATH']",
    "os.environ.get('NOTHING')",
    "os.getenv('NOTHING')",
    "len(os.environ)",
    "os.getcwdb()",
    "os.getpid()",
    "tempfile.gettempdir()",
    "os.getloadavg()",
    "gc.get_objects()",
    "threading.get_native_id()",
    "os.cpu_count()",
    "pathlib.Path.home()",
    "os.path.getmtime('/')",
    "os.access('/', os.R_OK)",
    "subprocess.run(['true'])",
    "os.system('true')",
    "socket.getaddrinfo('127.0.0.1', 80)",
    "hash(object())",
    "sys.getrefcount(None)",
    "numpy.zeros(3).ctypes.data",
    "numpy.zeros(3).__array_interface__",
    "array.array('i').buffer_info()",
    "ctypes.CDLL(None).syscall(39)",
    "[one.inode() for one in sorted(os.scandir('/'), key=str)]",
    "os.lstat('/tmp').st_mtime",
    "f'{id(N)}'",
]
IMPORTS = (
    "import _random, array, ctypes, datetime, email.utils, gc, glob, numpy, os, pathlib, random, "
    "secrets, socket, subprocess, sys, tempfile, threading, time, timeit, uuid\n"
    "from rclpy.node import Node\n"
)


def test_the_guard_treats_each_call_as_the_audit_says(tmp_path: Path) -> None:
    code = IMPORTS + "".join(
        f"class N{n}(Node):\n"
        f"    def __init__(self):\n"
        f"        super().__init__('n{n}')\n"
        f"        self.create_timer(1.0, lambda: {call.replace('N)', 'self)')})\n"
        for n, call in enumerate(CALLS)
    )
    path = tmp_path / "audited_calls.py"
    path.write_text(code)
    said = {(one.line - 6) // 4: one for one in audit_path(path).found}
    assert sorted(said) == list(range(len(CALLS))), "one finding each"

    nodes = [NodeSpec(node=f"audited_calls:N{n}") for n in range(len(CALLS))]
    job = Job(nodes=nodes, search_path=[tmp_path], stop=StopSpec(duration="1s"))
    result = run(job, tmp_path / "run.mcap")
    assert result.exit_code == 0, result.error
    for n, call in enumerate(CALLS):
        met = [count for count in result.guarded if count.node == f"/n{n}"]
        if said[n].treatment is Treatment.VIRTUAL:
            assert any(one.mode is GuardMode.VIRTUAL for one in met), call
        else:
            assert said[n].treatment is Treatment.DETECTED, call
            assert any(one.source.value == said[n].kind and one.is_finding for one in met), call
    assert "audited_calls" not in sys.modules


def test_what_the_run_only_reports_is_not_promised_as_recorded() -> None:
    """Also where a job has all recorded that can be."""
    policy = policy_of(GuardSpec(environment="record", process="record", file="record"))
    for name in ("os.getpgid", "os.statvfs", "gc.get_objects"):
        assert RULES[name].treated(policy)[0] is Treatment.DETECTED, name
    assert RULES["os.uname"].treated(policy)[0] is Treatment.RECORDED
