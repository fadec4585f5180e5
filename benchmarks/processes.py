"""What a callback of a process costs: C and Python, recorded, beside the same natively over DDS.

    python benchmarks/processes.py [--callbacks 20000] [--rounds 5]

Each callback is that of a timer and publishes a number. Figures are CPU time of both sides per
callback, the best of all rounds, in µs; what a run costs before its first callback is taken off,
and stands beside it per process. Natively a timer without period runs as fast as it can.

Last, the time that passes for two processes that each compute for some milliseconds when a message
arrives: one by one, and at the same time (``parallel: true``).
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from rsltrace.adapters.processes.build import find_compiler, find_ros, library

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "tests" / "processes" / "counter.c"
_LIBRARIES = (
    "rcl", "rcutils", "rcl_yaml_param_parser", "rosidl_runtime_c", "tracetools",
    "std_msgs__rosidl_typesupport_c", "std_msgs__rosidl_generator_c",
)  # fmt: skip
_MAX_US = 15.0
SCRIPT = """
import sys
import rclpy
from rclpy.node import Node
from std_msgs.msg import UInt64

class Counter(Node):
    def __init__(self):
        super().__init__('counter')
        self.count, self.last = 0, int(sys.argv[2])
        self.publisher = self.create_publisher(UInt64, 'count', 10)
        self.create_timer(float(sys.argv[1]) / 1000, self.tick)

    def tick(self):
        self.count += 1
        self.publisher.publish(UInt64(data=self.count))
        if self.count == self.last:
            raise SystemExit

rclpy.init()
rclpy.spin(Counter())
"""
HEAVY = """
import sys
import rclpy
from rclpy.node import Node
from std_msgs.msg import UInt64

class Heavy(Node):
    def __init__(self, hears, says):
        super().__init__(says)
        self.publisher = self.create_publisher(UInt64, says, 10)
        self.create_subscription(UInt64, hears, self.on_number, 10)

    def on_number(self, number):
        self.publisher.publish(UInt64(data=sum(range(300_000))))

rclpy.init()
rclpy.spin(Heavy(*sys.argv[1:]))
"""
HEAVY_JOB = """
parallel: {parallel}
nodes:
  - {{script: counter.py, arguments: ['100', '300']}}
  - {{script: heavy.py, isolated: true, arguments: [count, a]}}
  - {{script: heavy.py, isolated: true, arguments: [count, b]}}
"""
JOB = """
nodes:
  - {entry}
    arguments: ['{period}', '{count}']
stop: {{duration: 1000s}}
"""


def _compile(folder: Path) -> Path:
    ros = find_ros()
    link = [f"-l{name}" for name in _LIBRARIES]
    words = ["-O2", "-x", "c", str(SOURCE), "-x", "none", "-o", str(folder / "counter")]
    words += [*(f"-I{path}" for path in ros.include), f"-L{ros.prefix / 'lib'}", *link]
    words.append("-Wl,--unresolved-symbols=ignore-in-shared-libs")
    subprocess.run([*find_compiler(), *words], check=True)
    return folder / "counter"


def _cpu_s(command: list[str], folder: Path, environment: dict[str, str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        command, cwd=folder, env=environment, check=True, stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _recorded(folder: Path, entry: str, count: int) -> float:
    job = folder / "job.yaml"
    job.write_text(JOB.format(entry=entry, period=1, count=count))
    command = [sys.executable, "-m", "rsltrace", "record", job.name, "-o", "t.mcap", "--force"]
    return _cpu_s(command, folder, dict(os.environ))


def _two_heavy_s(folder: Path, parallel: str) -> float:
    job = folder / "heavy.yaml"
    job.write_text(HEAVY_JOB.format(parallel=parallel))
    (folder / "heavy.py").write_text(HEAVY)
    command = [sys.executable, "-m", "rsltrace", "record", job.name, "-o", "t.mcap", "--force"]
    began_s = time.perf_counter()
    _cpu_s(command, folder, dict(os.environ))
    return time.perf_counter() - began_s


def _native(folder: Path, command: list[str], count: int) -> float:
    built = library(lambda text: None)
    around = dict(os.environ)
    around["LD_LIBRARY_PATH"] = os.pathsep.join(map(str, built.ros.libraries))
    if command[0] != sys.executable:
        around["LD_PRELOAD"] = str(built.path.with_name("librsltrace_python_symbols.so"))
    return _cpu_s([*command, "0", str(count)], folder, around)


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--callbacks", type=int, default=20_000)
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = _compile(folder)
        (folder / "counter.py").write_text(SCRIPT)
        ways: dict[str, Callable[[int], float]] = {
            "C, native": lambda n: _native(folder, [str(program)], n),
            "C, recorded": lambda n: _recorded(folder, f"program: {program}", n),
            "Python, native": lambda n: _native(folder, [sys.executable, "counter.py"], n),
            "Python process, recorded": lambda n: _recorded(
                folder, "script: counter.py\n    isolated: true", n
            ),
            "Python in rsltrace, recorded": lambda n: _recorded(folder, "script: counter.py", n),
        }
        few: dict[str, float] = dict.fromkeys(ways, 1e9)
        many: dict[str, float] = dict.fromkeys(ways, 1e9)
        for _ in range(given.rounds):
            for way, run in ways.items():
                few[way] = min(few[way], run(6))
                many[way] = min(many[way], run(given.callbacks))
        heavy_s = {
            parallel: min(_two_heavy_s(folder, parallel) for _ in range(given.rounds))
            for parallel in ("false", "true")
        }
    print(f"{'':30} {'µs per callback':>16} {'start, s of CPU':>16}")
    for way in ways:
        each_us = (many[way] - few[way]) / (given.callbacks - 6) * 1e6
        met = "reached" if each_us <= _MAX_US else "missed"
        limit = f"   at most {_MAX_US:.0f}: {met}" if way == "C, recorded" else ""
        print(f"{way:30} {each_us:16.1f} {few[way]:16.2f}{limit}")
    one_by_one_s, together_s = heavy_s["false"], heavy_s["true"]
    print(
        f"two heavy processes: {one_by_one_s:.2f} s one by one, {together_s:.2f} s at the same "
        f"time: {one_by_one_s / together_s:.2f} times as fast"
    )


if __name__ == "__main__":
    main()
