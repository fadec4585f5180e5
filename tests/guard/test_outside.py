"""GuardMode ``record``: what came from outside is in the trace, and a re-run gets it again."""

from __future__ import annotations

import http.server
import json
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import GuardError, JobError, TraceError
from rsltrace.guard import waiting
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.finding import GuardMode
from rsltrace.trace.reader import Trace
from tests.guard.conftest import node_code

pytestmark = pytest.mark.ros


@pytest.fixture
def go(tmp_path: Path) -> Callable[..., Any]:
    """Write and record a job of node ``m:N``; its result."""

    def record(
        code: str, guard: str, name: str, replay: Path | None = None, entry: str = "node: 'm:N'"
    ) -> Any:
        (tmp_path / "m.py").write_text(code)
        (tmp_path / "job.yaml").write_text(
            f"nodes: [{{{entry}}}]\nstop: {{duration: 1.2s}}\nguard: {guard}\n"
        )
        job = load_job(tmp_path / "job.yaml")
        return run(job, tmp_path / f"{name}.mcap", force=True, replay=replay)

    return record


@pytest.mark.long
def test_real_clocks_and_real_chance_are_given_again(go: Callable[..., Any]) -> None:
    code = node_code(
        "self.say(time.time(), time.monotonic_ns(), str(datetime.now()), time.strftime('%c'),\n"
        "    random.random(), os.urandom(4).hex(), str(uuid.uuid4()), np.random.rand(),\n"
        "    np.random.default_rng().random(), random.Random().random(), AT_IMPORT)",
        imports="import os, random, time, uuid\nimport numpy as np\nfrom datetime import datetime",
        module="AT_IMPORT = time.time()",
    )
    guard = "{clock: record, random: record}"
    first, second = go(code, guard, "first"), go(code, guard, "second")
    assert first.error is None
    assert first.digest != second.digest
    again = go(code, guard, "again", replay=first.path)
    assert again.digest == first.digest
    assert again.path.read_bytes() == first.path.read_bytes()
    assert go(code, guard, "once more", replay=again.path).digest == first.digest


@pytest.mark.long
def test_each_real_clock_is_itself_when_it_is_recorded(go: Callable[..., Any]) -> None:
    code = node_code(
        "near = lambda a, b: abs(a - b) < 100\n"
        "good = [near(time.clock_gettime(time.CLOCK_MONOTONIC), time.monotonic()),\n"
        "    near(time.clock_gettime_ns(time.CLOCK_REALTIME) / 1e9, time.time()),\n"
        "    near(time.clock_gettime(time.CLOCK_PROCESS_CPUTIME_ID), time.process_time())]\n"
        "assert all(good), good",
        imports="import time",
    )
    first = go(code, "{clock: record}", "first")
    assert first.error is None
    assert go(code, "{clock: record}", "again", replay=first.path).digest == first.digest


@pytest.mark.long
def test_a_measured_duration_is_given_again(go: Callable[..., Any]) -> None:
    code = node_code(
        "start = time.perf_counter()\nsum(range(1000))\nself.say(time.perf_counter() - start)",
        imports="import time",
    )
    first = go(code, "{clock: record}", "first")
    assert go(code, "{clock: record}", "again", replay=first.path).digest == first.digest
    with Trace.open(first.path) as trace:
        assert {f.mode for found in trace.findings.values() for f in found} == {GuardMode.RECORD}


@pytest.mark.long
def test_who_reads_code_asks_nothing_of_the_file_system(
    go: Callable[..., Any], tmp_path: Path
) -> None:
    """Python's and ROS's own modules look at source files, which is no finding; users are told."""
    asks = (
        "inspect.getsourcefile(type(self)); traceback.extract_stack(); self.get_logger().info('x')"
    )
    imports = "import inspect, os, traceback"
    found: list[list[str]] = []
    for number, code in enumerate((asks, "os.path.exists(__file__)")):
        go(node_code(code, imports=imports), "{file: warn}", f"code{number}")
        with Trace.open(tmp_path / f"code{number}.mcap") as trace:
            found.append([f.call for each in trace.findings.values() for f in each])
    assert found[0] == []
    assert [call.partition("(")[0] for call in found[1]] == ["os.stat"] * len(found[1]) != []


def test_files_and_environment_are_given_again(
    go: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "config.txt"
    code = node_code(
        f"path = {str(config)!r}\n"
        "def lines():\n    with open(path, encoding='latin-1') as f: return f.readlines()\n"
        "self.say(lines(), list(open(path, 'rb').read()),\n"
        "    pathlib.Path(path).read_text('latin-1'),\n"
        "    os.path.getsize(path), os.path.exists(path + '.not'), os.environ.get('SHIFT'))\n"
        "try: open(path + '.not')\n"
        "except FileNotFoundError as error: self.say(error.errno)",
        imports="import os, pathlib",
    )
    guard = "{file: record, environment: record}"
    config.write_bytes("grün\r\n2".encode("latin-1"))
    monkeypatch.setenv("SHIFT", "7")
    first = go(code, guard, "first")
    assert first.error is None
    config.write_bytes(b"other")
    (tmp_path / "config.txt.not").touch()
    monkeypatch.delenv("SHIFT")
    assert go(code, guard, "other").digest != first.digest
    again = go(code, guard, "again", replay=first.path)
    assert again.digest == first.digest
    config.unlink()
    assert go(code, guard, "again", replay=first.path).digest == first.digest
    assert not os.path.exists(config)


class Counting(http.server.BaseHTTPRequestHandler):
    count = 0

    def do_GET(self) -> None:
        Counting.count += 1
        body = f"answer {Counting.count}".encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *arguments: object) -> None:
        pass


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[http.server.HTTPServer]:
    monkeypatch.setenv("no_proxy", "*")
    monkeypatch.setattr(Counting, "count", 0)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Counting) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.mark.long
def test_an_http_answer_is_given_again_without_the_server(
    go: Callable[..., Any], server: http.server.HTTPServer
) -> None:
    url = f"http://127.0.0.1:{server.server_address[1]}/x"
    code = node_code(
        f"self.say(urllib.request.urlopen({url!r}, timeout=200).read().decode())",
        imports="import urllib.request",
    )
    first = go(code, "{socket: record}", "first")
    assert first.error is None
    asked = Counting.count
    assert asked == 2
    again = go(code, "{socket: record}", "again", replay=first.path)
    assert again.error is None
    assert again.digest == first.digest
    assert Counting.count == asked, "nobody was asked"
    assert go(code, "{socket: record}", "other").digest != first.digest


@pytest.mark.long
def test_a_refused_connection_is_given_again(go: Callable[..., Any]) -> None:
    code = node_code(
        "try: socket.create_connection(('127.0.0.1', 1), timeout=200)\n"
        "except OSError as error: self.say(type(error).__name__, error.errno)",
        imports="import socket",
    )
    first = go(code, "{socket: record}", "first")
    again = go(code, "{socket: record}", "again", replay=first.path)
    assert first.error is None
    assert again.digest == first.digest


@pytest.mark.long
def test_a_run_that_asks_for_more_is_told_so(go: Callable[..., Any]) -> None:
    code = node_code("self.say(time.time())", imports="import time")
    first = go(code, "{clock: record}", "first")
    more = node_code("self.say(time.time() + time.time())", imports="import time")
    again = go(more, "{clock: record}", "again", replay=first.path)
    assert isinstance(again.error, GuardError)
    assert "has no further answer to time.time() of /n" in str(again.error)


@pytest.mark.long
def test_a_replay_needs_a_trace_and_a_guard(go: Callable[..., Any], tmp_path: Path) -> None:
    code = node_code("pass")
    (tmp_path / "no.mcap").write_text("no")
    with pytest.raises(TraceError, match="not a trace"):
        go(code, "{}", "again", replay=tmp_path / "no.mcap")
    with pytest.raises(JobError, match="guard: false"):
        go(code, "false", "again", replay=tmp_path / "no.mcap")


ONCE = "if vars(self).setdefault('done', False): return\nself.done = True\n"
PROCESSES = """
def one():
    return subprocess.run(['date', '+%N'], capture_output=True, text=True).stdout
def piped():
    code = 'rev; date +%N; exit 3'
    done = subprocess.run(['sh', '-c', code], input=b'abc', capture_output=True)
    return done.stdout.decode(), done.returncode
def lines():
    with subprocess.Popen('date +%N; sleep 0.02; date +%N >&2; date +%N', shell=True, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        return process.pid, [line for line in process.stdout], process.wait()
def missing():
    try: subprocess.run(['/no/such/program'])
    except FileNotFoundError as error: return str(error)
def impatient():
    try: subprocess.run('date +%N; exec sleep 60', shell=True, capture_output=True, timeout=0.3)
    except subprocess.TimeoutExpired as error: return (error.stdout or b'').decode()
def waiting():
    process = subprocess.Popen(['sleep', '60'])
    try: process.wait(0.1)
    except subprocess.TimeoutExpired: process.terminate()
    return process.wait(timeout=300)
def shells():
    with os.popen('date +%N') as lines:
        return lines.read(), os.system(
        f'touch {MARKER}; exit $((1$(date +%N | tail -c 3) % 100))')
"""
IN_ASYNCIO = """
async def talk():
    process = await asyncio.create_subprocess_exec('sh', '-c', 'rev; date +%N; exit 3',
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE)
    out, _ = await process.communicate(b'abc')
    return process.pid, out.decode(), process.returncode
def looped():
    return asyncio.run(talk())
"""


def test_the_output_of_processes_is_given_again_without_starting_any(
    go: Callable[..., Any], tmp_path: Path
) -> None:
    marker = tmp_path / "marker"
    code = node_code(
        f"{ONCE}self.say(one(), piped(), lines(), missing(), impatient(), waiting(), shells(),\n"
        "    looped())",
        imports="import asyncio, os, subprocess, sys",
        module=f"MARKER = {str(marker)!r}{PROCESSES}{IN_ASYNCIO}",
    )
    first = go(code, "{process: record}", "first")
    assert first.error is None
    assert go(code, "{process: record}", "other").digest != first.digest
    marker.unlink()
    again = go(code, "{process: record}", "again", replay=first.path)
    assert not marker.exists(), "nothing was started"
    assert again.error is None
    assert again.digest == first.digest


ASIDE = """
def talk(node):
    process = subprocess.Popen(
        f'date +%N; until [ -e {MARKER} ]; do sleep 0.01; done; date +%N; exit 3',
        shell=True, stdout=subprocess.PIPE)
    node.say(node.ticks, process.stdout.readline().decode())
    node.say(node.ticks, process.stdout.readline().decode())
    process.stdout.close()
    node.say(node.ticks, process.wait(), time.time())
    process = subprocess.Popen(['sleep', '60'])
    start = time.time()
    try: process.wait(0.1)
    except subprocess.TimeoutExpired: node.say(node.ticks, time.time() - start)
    process.kill()
    process.wait()
def tick(node):
    node.ticks += 1
    if node.ticks == 5: open(MARKER, 'w').close()
"""


@pytest.mark.long
def test_a_thread_that_waits_for_a_process_lets_time_pass(
    go: Callable[..., Any], tmp_path: Path
) -> None:
    marker = tmp_path / "marker"
    code = node_code(
        "pass",
        imports="import subprocess, threading, time",
        module=f"MARKER = {str(marker)!r}{ASIDE}",
        init="self.ticks = 0\nself.create_timer(0.01, lambda: tick(self))\n"
        "threading.Thread(target=talk, args=(self,)).start()",
    )
    first = go(code, "{process: record}", "first")
    assert first.error is None
    marker.unlink()
    again = go(code, "{process: record}", "again", replay=first.path)
    assert again.digest == first.digest
    with Trace.open(first.path) as trace:
        texts = [trace.decode("/rosout", data).msg for *_, data in trace.messages("/rosout")]  # type: ignore[attr-defined]
    said = [json.loads(text) for text in texts]
    assert len(said) == 4
    assert said[2][0] >= 5, "others went on"
    assert said[3][1] == pytest.approx(0.1, abs=1e-4)


@pytest.mark.long
def test_an_asyncio_loop_waits_for_a_process_that_is_not_recorded(go: Callable[..., Any]) -> None:
    code = node_code(
        f"{ONCE}self.say(looped())", imports="import asyncio, subprocess", module=IN_ASYNCIO
    )
    result = go(code, "{process: allow}", "first")
    assert result.error is None
    with Trace.open(result.path) as trace:
        texts = [trace.decode("/rosout", data).msg for *_, data in trace.messages("/rosout")]  # type: ignore[attr-defined]
    assert len(texts) == 1
    assert "cba" in texts[0]


OF_A_PROGRAM = """
COMMAND = f'sleep $(cat {PACE}); echo done'
def ask(node):
    subprocess.run(COMMAND, shell=True, stdout=subprocess.DEVNULL)
    said = [subprocess.check_output(COMMAND, shell=True, text=True)]
    closed = f'{COMMAND}; exec >&- 2>&-; {COMMAND}'
    said.append(subprocess.run(closed, shell=True, capture_output=True, timeout=700).returncode)
    with subprocess.Popen(['sh', '-c', COMMAND + '; exit 3']) as process: pass
    said.append(process.returncode)
    said.append(subprocess.Popen(COMMAND + ' >&2; exit 4', shell=True).wait(timeout=700))
    node.say(*said, node.ticks, time.time())
def tick(node):
    node.ticks += 1
def main():
    rclpy.init()
    node = N()
    ask(node)
    rclpy.spin(node)
"""


@pytest.mark.long
@pytest.mark.parametrize("mode", ["warn", "record"])
def test_a_program_that_ends_soon_takes_no_simulated_time(
    go: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    monkeypatch.setattr(waiting, "_PROGRAM_S", 600.0)  # what is soon on a machine that stands still
    pace = tmp_path / "pace"
    code = node_code(
        "pass",
        imports="import rclpy, subprocess, threading, time",
        module=f"PACE = {str(pace)!r}{OF_A_PROGRAM}",
        init="self.ticks = 0\nself.create_timer(0.01, lambda: tick(self))\n"
        "threading.Thread(target=ask, args=(self,)).start()",
    )
    pace.write_text("0")
    quick = go(code, f"{{process: {mode}}}", "quick", entry="main: 'm:main'")
    pace.write_text("0.08")
    slow = go(code, f"{{process: {mode}}}", "slow", entry="main: 'm:main'")
    assert quick.error is None
    assert quick.digest == slow.digest
    with Trace.open(slow.path) as trace:
        texts = [trace.decode("/rosout", data).msg for *_, data in trace.messages("/rosout")]  # type: ignore[attr-defined]
    said = [json.loads(text) for text in texts]
    assert [one[:5] for one in said] == [["done\n", 1, 3, 4, 0]] * 2
    assert all(one[5] < 1e-5 for one in said), "two looks at the clock at one instant"
