"""``rsltrace audit``: every kind of call is found wherever it hides, and little else is."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rsltrace.errors import JobError
from rsltrace.guard.audit.audit import AuditFinding, audit_job, audit_path
from rsltrace.job import load_job

ROOT = Path(__file__).parents[2]


@pytest.fixture
def found_in(tmp_path: Path) -> Callable[[str], list[AuditFinding]]:
    def audit(code: str) -> list[AuditFinding]:
        path = tmp_path / "node.py"
        path.write_text(code)
        result = audit_path(path)
        assert not result.troubles
        return list(result.found)

    return audit


def no_executables(target: str, where: str) -> str:
    raise AssertionError(target)


FOUND = [
    ("import time\ntime.time()", "time.time()", "virtual"),
    ("import time as t\nt.monotonic_ns()", "time.monotonic_ns()", "virtual"),
    ("from time import time as now\nnow()", "time.time()", "virtual"),
    ("from time import *\nperf_counter()", "time.perf_counter()", "virtual"),
    ("import time\ndef f(now=time.time):\n  return now()", "time.time()", "virtual"),
    ("import time\ndef f(*, now=time.time):\n  return 1", "time.time", "virtual"),
    ("import time\nclass A:\n  def f(self):\n    self.now = time.time", "time.time", "virtual"),
    (
        "import time\nclass A:\n  def f(self):\n    self.n = time.time\n  def g(self):\n"
        "    self.n()",
        "time.time()",
        "virtual",
    ),
    ("import time\ngetattr(time, 'time')()", "time.time()", "virtual"),
    ("import importlib\nt = importlib.import_module('time')\nt.time()", "time.time()", "virtual"),
    ("__import__('time').time()", "time.time()", "virtual"),
    ("from functools import partial\nimport time\npartial(time.time)", "time.time", "virtual"),
    ("try:\n  from time import monotonic as c\nexcept E:\n  c = None\nc()", "time.monotonic()",
     "virtual"),
    ("import time\nclass T:\n  import time\n  def f(self):\n    time.time()", "time.time()",
     "virtual"),
    ("import time\ntime.strftime('%H')", "time.strftime('%H')", "virtual"),
    ("import time\ntime.localtime(None)", "time.localtime(None)", "virtual"),
    ("import datetime\ndatetime.datetime.now()", "datetime.datetime.now()", "virtual"),
    ("from datetime import date as d\nd.today()", "datetime.date.today()", "virtual"),
    ("from datetime import datetime\nclass D(datetime): pass\nD.now()", "datetime.datetime.now()",
     "virtual"),
    ("from datetime import datetime\ndatetime.fromtimestamp(3)",
     "datetime.datetime.fromtimestamp()", "pinned"),
    ("import numpy as np\nnp.datetime64('now')", "numpy.datetime64('now')", "virtual"),
    ("db.execute(\"select datetime('now')\")", "SQLite: 'now'", "detected"),
    ("from time import sleep\nsleep(1)", "time.sleep()", "virtual"),
    ("import random\nrandom.gauss(0, 1)", "random.gauss()", "virtual"),
    ("import random\nrandom.Random()", "random.Random()", "virtual"),
    ("import random\nrandom.Random(None)", "random.Random()", "virtual"),
    ("import random\nrandom.seed()", "random.seed()", "virtual"),
    ("import random\nrandom.seed(3)\nrandom.Random()", "random.Random()", "virtual"),
    ("import secrets\nsecrets.token_hex(8)", "secrets.token_hex()", "virtual"),
    ("import os\nos.urandom(8)", "os.urandom()", "virtual"),
    ("from dataclasses import field\nimport uuid\nfield(default_factory=uuid.uuid4)", "uuid.uuid4",
     "virtual"),
    ("import numpy as np\nnp.random.rand(3)", "numpy.random.rand()", "virtual"),
    ("from numpy import random\nrandom.default_rng()", "numpy.random.default_rng()", "virtual"),
    ("import numpy\nnumpy.random.default_rng(seed=None)", "numpy.random.default_rng()", "virtual"),
    ("import torch\ntorch.randn(3)", "torch.randn()", "virtual"),
    ("import threading\nthreading.Thread(target=f)", "threading.Thread()", "virtual"),
    ("from threading import Thread\nclass W(Thread): pass", "class W(threading.Thread)", "virtual"),
    ("import concurrent.futures as c\nc.ThreadPoolExecutor()",
     "concurrent.futures.ThreadPoolExecutor()", "virtual"),
    ("import subprocess\nsubprocess.Popen(x)", "subprocess.Popen()", "detected"),
    ("import os\nos.system(x)", "os.system()", "detected"),
    ("import multiprocessing as mp\nmp.Process()", "multiprocessing.Process()", "detected"),
    ("import socket\nsocket.socket()", "socket.socket()", "detected"),
    ("import urllib.request\nurllib.request.urlopen(u)", "urllib.request.urlopen()", "detected"),
    ("import requests\nrequests.get(u)", "requests.get()", "detected"),
    ("input()", "input()", "virtual"),
    ("import sys\nsys.stdin.readline()", "sys.stdin.readline()", "virtual"),
    ("import os\nos.listdir('.')", "os.listdir()", "virtual"),
    ("import glob\nfor f in glob.glob('*'): f", "glob.glob()", "virtual"),
    ("for f in folder.iterdir(): f", "iterdir()", "virtual"),
    ("import os\nos.environ['HOME']", "os.environ['HOME']", "detected"),
    ("import os\nos.environ.get('X')", "os.environ['X']", "detected"),
    ("from os import environ as e\nif 'X' in e: f()", "os.environ", "detected"),
    ("import os\nos.getenv('X')", "os.getenv('X')", "detected"),
    ("from pathlib import Path\nPath.home()", "pathlib.Path.home()", "detected"),
    ("import os\nos.path.getmtime(f)", "os.path.getmtime()", "detected"),
    ("f'{x:n}'", "format 'n'", "pinned"),
    ("import locale\nlocale.setlocale(locale.LC_ALL, '')", "locale.setlocale()", "nothing"),
    ("class A:\n  def __del__(self): pass", "__del__()", "pinned"),
    ("import weakref\nweakref.ref(a, f)", "weakref.ref()", "pinned"),
    ("import gc\ngc.enable()", "gc.enable()", "nothing"),
    ("sorted(a, key=id)", "order by id()", "detected"),
    ("a.sort(key=lambda x: id(x))", "id()", "detected"),
    ("id(a) < b", "id()", "detected"),
    ("f'{id(a)}'", "id()", "detected"),
    ("import heapq\nheapq.heappush(h, (1, id(a), a))", "id()", "detected"),
    ("hash(name) % 7", "hash()", "detected"),
    ("for x in {'a', 'b'}: f(x)", "order of the set {'a', 'b'}", "virtual"),
    ("s = set()\nlist(s)", "order of the set s", "virtual"),
    ("s = frozenset(a) | b\ntuple(s)", "order of the set s", "virtual"),
    ("def f(s: set[str]):\n  return [x for x in s]", "order of the set s", "virtual"),
    ("from typing import Set\ndef f(s: 'Set[str]'):\n  return ','.join(s)", "order of the set s",
     "virtual"),
    ("class A:\n  def __init__(self):\n    self.s = set()\n  def f(self):\n    return sum(self.s)",
     "order of the set self.s", "virtual"),
    ("class A:\n  s: set = set()\n  def f(self):\n    return self.s.pop()",
     "order of the set self.s", "virtual"),
    ("f(*{g(), h()})", "order of the set {g(), h()}", "virtual"),
    ("def f(self):\n  a = self.get_clock().now()\n  g()\n  dt = self.get_clock().now() - a\n"
     "  return 1 / (dt.nanoseconds / 1e9)", "division by dt.nanoseconds / 1000000000.0", "virtual"),
    ("def f(clock):\n  a = clock.now().nanoseconds * 1e-9\n  b = clock.now().nanoseconds * 1e-9\n"
     "  return 3 // float(b - a)", "division by float(b - a)", "virtual"),
    ("next(iter(set(a)))", "order of the set set(a)", "virtual"),
    ("s = set(a)\ns = s - b\nlist(s)", "order of the set s", "virtual"),
    ("s = {T(), T()}\nsorted(s, key=f)", "order of the set s", "virtual"),
    ("s = {T(), T()}\nsorted(list(s), key=f)", "order of the set s", "virtual"),
    ("s = {T(), T()}\nmin(s, key=f)", "order of the set s", "virtual"),
    ("from heapq import nsmallest\ns = {T(), T()}\nnsmallest(2, s, key=f)", "order of the set s",
     "virtual"),
    ("from collections import Counter\ns = {T(), T()}\nCounter(s)", "order of the set s",
     "virtual"),
    ("import itertools as i\ns = {T(), T()}\ni.chain.from_iterable(s)", "order of the set s",
     "virtual"),
    ("s = {T(), T()}\ndict.fromkeys(s)", "order of the set s", "virtual"),
    ("s = {T(), T()}\nr = []\nr += s", "order of the set s", "virtual"),
    ("s = {T(), T()}\nr = []\nr[1:] = s", "order of the set s", "virtual"),
    ("s = {T(), T()}\na, b = s", "order of the set s", "virtual"),
    ("f(o.__hash__() % 8)", "__hash__()", "detected"),
    ("from rclpy.executors import Executor\nExecutor._take_timer = f",
     "rclpy.executors.Executor._take_timer", "detected"),
    ("import rclpy.executors as e\nsetattr(e.Executor, '_make_handler', f)",
     "rclpy.executors.Executor._make_handler", "detected"),
    ("from unittest import mock\nmock.patch('rclpy.executors.Executor._take_service')",
     "rclpy.executors.Executor._take_service", "detected"),
    ("from unittest import mock\nfrom rclpy import callback_groups as g\n"
     "mock.patch.object(g.ReentrantCallbackGroup, 'can_execute')",
     "rclpy.callback_groups.ReentrantCallbackGroup.can_execute", "detected"),
    ("from rclpy.executors import MultiThreadedExecutor\nclass A(MultiThreadedExecutor): pass\n"
     "class B(A):\n  def can_execute(self, entity): pass",
     "rclpy.executors.MultiThreadedExecutor.can_execute", "detected"),
]  # fmt: skip

NOT_FOUND = [
    "import rclpy.executors as e\ne.await_or_execute = f",
    "from rclpy.executors import Executor\nreal = getattr(Executor, '_take_timer')",
    "from rclpy.executors import Executor\nclass A(Executor):\n  def spin_once(self): pass",
    "from rclpy.callback_groups import ReentrantCallbackGroup as R\n"
    "class A(R):\n  def can_execute(self, entity): pass",
    # the time before this callback, another clock's, a difference that is guarded, a plain number
    "def f(self):\n  return 1 / (self.get_clock().now() - self.last).nanoseconds",
    "def f(self, a):\n  return 1 / (self.get_clock().now() - a).nanoseconds",
    "def f(self):\n  a = clock.now()\n  return 1 / max((clock.now() - a).nanoseconds, 1)",
    "def f(self):\n  a = clock.now()\n  return (clock.now() - a).nanoseconds / 1e9",
    "def f(time):\n  return time.time()",
    "import time\ntime.strftime('%H', stamp)",
    "import time\ntime.localtime(3)",
    "from datetime import datetime, timezone\ndatetime.fromtimestamp(3, timezone.utc)",
    "from datetime import datetime\ndatetime(2020, 1, 1)",
    "from datetime import datetime\nclass D(datetime):\n  def now(self): pass\nD.now()",
    "import numpy as np\nnp.datetime64('2020-01-01')",
    "import random\nrandom.Random(7).random()",
    "import random\nrandom.seed(7)\nrandom.random()",
    "import numpy as np\nnp.random.default_rng(7)\nnp.random.seed(3)\nnp.random.rand()",
    "import numpy as np\nnp.random.default_rng(*seeds)",
    "import threading\ndef f(t: threading.Thread) -> threading.Thread:\n  isinstance(t, "
    "threading.Thread)",
    "import threading\nlock = threading.Lock()",
    "import subprocess\ntry:\n  f()\nexcept subprocess.CalledProcessError: pass",
    "import os\nos.environ['X'] = '1'\ndel os.environ['X']\nos.environ.update(a)",
    "import os\nsorted(os.listdir('.'))\nlen(os.listdir('.'))",
    "from pathlib import Path\nsorted(p.name for p in Path('.').iterdir())",
    "import os\nos.path.join(a, b)",
    "f'{x:.3f} {y}'",
    "import weakref\nweakref.ref(a)",
    "seen[id(a)] = a\nid(a) == id(b)\nid(a) in seen",
    "class A:\n  def __hash__(self): return hash(self.name)",
    "for x in {1, 2, 3}: f(x)",
    "s = set(range(4))\nlist(s)",
    "def f(s: set[int]):\n  return list(s)",
    "s = set(a)\nsorted(s)\nlen(s)\nmax(s)\nx in s\nany(p(x) for x in s)\n{x + 1 for x in s}",
    "s = set(a)\nfor x in s: t.add(x)",
    "s = set(a)\nd = {*s, 1}\nfor x in sorted(s): f(x)",
    "s = {}\nfor x in s: f(x)",
    "s = set(a)\ns = sorted(s)\nfor x in s: f(x)",
    "class A(B):\n  def f(self):\n    self.p = self.p - 1\n    list(self.p)",
    "def f(a, b):\n  a = a | 1\n  b = b | a\n  a = b & a\n  list(a)\n  list(b)",
    "if __name__ == '__main__':\n  pass",
]


@pytest.mark.parametrize(("code", "call", "treatment"), FOUND, ids=[case[0] for case in FOUND])
def test_found(
    found_in: Callable[[str], list[AuditFinding]], code: str, call: str, treatment: str
) -> None:
    assert [(one.call, one.treatment.value) for one in found_in(code)] == [(call, treatment)]


@pytest.mark.parametrize(
    "line",
    ["text = text.replace(text, 'x')", "s = s | {text, 'x'}", "self.a = self.a.b(self.a)"],
)
def test_a_name_that_is_bound_to_itself_again_and_again(
    found_in: Callable[[str], list[AuditFinding]], line: str
) -> None:
    # Each way through these lines was looked at once: of 50 there is no end.
    lines = "".join(f"    {line}\n" for _ in range(50))
    code = f"class A:\n  def f(self, text, s):\n{lines}    text.now(s)\n    self.a.now(list(s))\n"
    assert found_in(code) == []


@pytest.mark.parametrize("code", NOT_FOUND)
def test_not_found(found_in: Callable[[str], list[AuditFinding]], code: str) -> None:
    assert found_in(code) == []


def test_line_and_column_are_those_of_an_editor(
    found_in: Callable[[str], list[AuditFinding]],
) -> None:
    (one,) = found_in("import time\n\nx = [1,\n     time.time()]\n")
    assert (one.line, one.column) == (4, 6)


def test_a_comment_allows_a_line_or_one_kind_of_call_on_it(
    found_in: Callable[[str], list[AuditFinding]],
) -> None:
    code = (
        "import os, time\n"
        "time.time()  # rsltrace: allow\n"
        "time.time()  # rsltrace: allow clock - a log line only\n"
        "time.time()  # rsltrace: allow random\n"
        "f(\n  os.urandom(3),\n  time.time(),  # rsltrace: allow clock, random\n)\n"
    )
    assert [(one.line, one.kind) for one in found_in(code)] == [(4, "clock"), (6, "random")]


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A job whose nodes lie in a package, with a helper, a library and files of nobody."""
    (tmp_path / "src/robot/parts").mkdir(parents=True)
    for name, code in {
        "__init__.py": "from robot.nodes import Ekf\n",
        "nodes.py": "from .parts.tools import stamp\nfrom . import late\nclass Ekf:\n"
        "    def tick(self):\n        return stamp()\n",
        "late.py": "def f():\n    import outside.deep\n",
        "parts/__init__.py": "",
        "parts/tools.py": "from time import time as stamp\n",
        "unused.py": "import time\ntime.time()\n",
    }.items():
        (tmp_path / "src/robot" / name).write_text(code)
    (tmp_path / "src/outside").mkdir()
    (tmp_path / "src/outside/deep.py").write_text("import random\nrandom.random()\n")
    job = tmp_path / "job.yaml"
    job.write_text("nodes: [{node: 'robot:Ekf'}]\nsearch_path: [src]\n")
    return job


def test_a_job_leads_to_its_modules_and_to_no_others(robot: Path) -> None:
    result = audit_job(load_job(robot), no_executables)
    places = [(one.path.name, one.line, one.call) for one in result.found]
    assert places == [("deep.py", 2, "random.random()"), ("nodes.py", 5, "time.time()")]
    assert not {name for name in sys.modules if name.split(".")[0] in ("robot", "outside")}


@pytest.mark.parametrize(
    ("guard", "treatments"),
    [
        ("false", ["nothing", "nothing"]),
        ("{clock: warn, random: error}", ["refused", "detected"]),
        ("{clock: record, random: {mode: virtual, allow: ['outside.*']}}", ["nothing", "recorded"]),
    ],
)
def test_what_is_done_is_what_the_job_says(robot: Path, guard: str, treatments: list[str]) -> None:
    robot.write_text(f"{robot.read_text()}guard: {guard}\n")
    result = audit_job(load_job(robot), no_executables)
    assert [one.treatment.value for one in result.found] == treatments


def test_a_node_has_its_own_guard(tmp_path: Path) -> None:
    (tmp_path / "helper.py").write_text("import time\ndef stamp():\n    return time.time()\n")
    (tmp_path / "two.py").write_text(
        "import time, helper\n"
        "LOADED = time.time()\n"
        "class A:\n    def tick(self):\n        return time.time(), helper.stamp()\n"
        "class B:\n    def tick(self):\n        return time.time(), helper.stamp()\n"
        "def shared():\n    return time.time()\n"
    )
    job = tmp_path / "job.yaml"
    job.write_text(
        "nodes:\n- {node: 'two:A', name: a, guard: {clock: error}}\n"
        "- {node: 'two:B', name: b, guard: {clock: allow}}\n"
        "search_path: [.]\nguard: {clock: record}\n"
    )
    done = {
        (one.path.name, one.line): (one.treatment.value, one.does)
        for one in audit_job(load_job(job), no_executables).found
    }
    assert done == {
        ("helper.py", 3): ("nothing", "node b says clock: allow (refused elsewhere)"),
        ("two.py", 2): ("recorded", "the job says clock: record"),
        ("two.py", 5): ("refused", "node a says clock: error"),
        ("two.py", 8): ("nothing", "node b says clock: allow"),
        ("two.py", 10): ("nothing", "node b says clock: allow (refused elsewhere)"),
    }
    job.write_text(job.read_text().replace("guard: {clock: record}", "guard: false"))
    assert {one.does for one in audit_job(load_job(job), no_executables).found} == {
        "the job has no guard"
    }


def test_a_module_that_is_not_there_is_trouble(robot: Path) -> None:
    robot.write_text("nodes: [{node: 'robot.nothing:Ekf'}]\nsearch_path: [src]\n")
    with pytest.raises(JobError, match=r"job.yaml:1:16: there is no module 'robot.nothing'"):
        audit_job(load_job(robot), no_executables)


def rsltrace(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rsltrace", "audit", *arguments]
    return subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, check=False, env={**os.environ}
    )


def test_the_command_says_where_what_and_what_instead(robot: Path) -> None:
    done = rsltrace("job.yaml", cwd=robot.parent)
    assert done.returncode == 1, done.stderr
    assert done.stdout.splitlines()[1] == (
        "src/robot/nodes.py:5:16: clock: time.time(); guard: virtual, shows simulated time; "
        "instead: self.get_clock().now()"
    )
    assert done.stdout.splitlines()[-1] == "2 findings in 6 files (guard: 2 virtual)"
    assert rsltrace("job.yaml", "--unguarded", cwd=robot.parent).returncode == 0


def test_annotations_and_json(robot: Path) -> None:
    done = rsltrace("src", "--format", "github", cwd=robot.parent)
    assert done.stdout.splitlines()[0].startswith(
        "::notice file=src/outside/deep.py,line=2,col=1,title=rsltrace random%3A random.random()::"
    )
    found = json.loads(rsltrace("src", "--json", cwd=robot.parent).stdout)
    assert [one["line"] for one in found["findings"]] == [2, 5, 2]


def test_what_is_not_python_is_trouble_and_the_rest_is_looked_at(robot: Path) -> None:
    (robot.parent / "src/broken.py").write_text("def f(:\n")
    done = rsltrace("src", cwd=robot.parent)
    assert done.returncode == 2
    assert "broken.py:1: not Python: invalid syntax" in done.stderr
    assert done.stdout.splitlines()[-1].startswith("3 findings")
    assert rsltrace("nowhere.py", cwd=robot.parent).returncode == 2


def test_the_examples_are_clean() -> None:
    for name in ("benchmark8", "ping_pong", "rslcpp_determinism", "sensor_fusion"):
        result = audit_job(load_job(ROOT / "examples" / name / "job.yaml"), no_executables)
        assert not result.found, name


def test_the_sample_with_a_bug_is_found() -> None:
    job = load_job(ROOT / "sample_traces/nondeterministic_callback/job.yaml")
    (one,) = audit_job(job, no_executables).found
    assert (one.kind, one.line) == ("order", 67)
