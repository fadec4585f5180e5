"""What is usual costs: mains that spin, logs, goals, images, short commands, small files.

    python benchmarks/usual.py                 everything, about a quarter of an hour
    python benchmarks/usual.py --only logs     cases whose name contains "logs"
    python benchmarks/usual.py --scale 0.2     a fifth of everything, for a first look
    python benchmarks/usual.py --markdown      the table of docs/performance.md
    python benchmarks/usual.py --json          the same figures for a machine

Beside each case stands the same natively, where there is such a thing (rclpy over DDS, mains in
processes of their own, a script without rsltrace), and a floor, where one can be said: the same
callbacks in a bare loop of Python, or a copy, a hash and a write of the same bytes.

Every measurement is a process of its own, and the repetitions go round all cases, so that a busy
minute of the machine does not hit one case alone. Compared are the best CPU times, of all threads
and processes that take part: others who use the machine only ever add to them. Loading modules is
in no figure but those of commands.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter, process_time, sleep
from typing import Any

import usual_nodes
from bare import run_bare
from graphs import (
    BENCHMARKS,
    DISCOVERY_S_MAX,
    EVENTS_PER_CALL,
    EVENTS_PER_GOAL,
    GRAPHS,
    WARM_UP_S,
    Graph,
    run_native,
    run_rsltrace,
)
from throughput import child_environment
from usual_graphs import usual_graphs

WORKER_S_MAX = 300
WAYS = ("bare", "native", "plain", "recorded")
HEADS = ("bare Python", "rclpy over DDS", "rsltrace", "recorded")
NATIVE_S = 2.0
IMAGES = 60
SMALL_EVENTS = 40_000

Figures = dict[str, Any]
Way = Callable[[float, Path], Figures]
"""Takes the scale and a folder; returns ``units`` and ``cpu_s`` (or ``bytes``), or ``problem``."""


@dataclass
class Case:
    """Something usual, and how it is measured in which way; figures are per unit.

    ``most`` is the most it should be when recorded: a figure in µs (or bytes), or how many times
    that of the case ``of``.
    """

    name: str
    title: str
    unit: str
    ways: dict[str, Way]
    most: float | None = None
    of: str = ""
    found: dict[str, list[float]] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)

    @property
    def best(self) -> dict[str, float]:
        """The best figure of each way that was measured."""
        return {way: min(values) for way, values in self.found.items() if values}


# -- ways to measure -------------------------------------------------------------------------------


def bare(graph: Graph, scale: float, folder: Path) -> Figures:
    """Run the callbacks of a graph in a bare loop."""
    assert graph.make_native is not None
    found = run_bare(graph.make_native, graph.native_args, int(200_000 * scale))
    return {"units": found["callbacks"], "cpu_s": found["cpu_s"]}


def callbacks_of(node: Any) -> int:
    """Return what a node has counted."""
    return int(node.callbacks)


def native(
    graph: Graph, scale: float, folder: Path, *, count: Callable[[Any], int] = callbacks_of
) -> Figures:
    """Run a graph on the fastest of rclpy's executors over DDS; ``count`` says what counts."""
    found = run_native(graph, "events_executor", max(0.5, NATIVE_S * scale), count=count)
    return {"units": found["callbacks"], "cpu_s": found["cpu_s"]}


def simulated(
    graph: Graph,
    count: int,
    record: bool,
    scale: float,
    folder: Path,
    *,
    delayed: bool = False,
    units: int = 0,
) -> Figures:
    """Run a graph under rsltrace: ``count`` is what its job is asked for, ``units`` how many units
    that makes (0: count events)."""
    runs = []
    for _ in range(2):
        # Its memory serves the next file: a hypervisor may have to find other memory first.
        (folder / "run.mcap").unlink(missing_ok=True)
        asked = max(1, int(count * scale))
        runs.append(run_rsltrace(graph, asked, folder, record=record, delayed=delayed))
    per = int(units * scale) if units else runs[0]["callbacks"]
    return {"units": per, "cpu_s": min(run["cpu_s"] for run in runs)}


def run_main(name: str, arguments: list[str]) -> None:
    """Be a native process: run a main, and tell what was counted for each line on stdin."""
    module, function = name.split(":")
    sys.argv = [name, *arguments]

    def tell() -> None:
        from rclpy.node import Node

        nodes: list[Any] = []
        for _ in sys.stdin:
            nodes = nodes or [item for item in gc.get_objects() if isinstance(item, Node)]
            counts = [node.callbacks for node in nodes if hasattr(node, "callbacks")]
            figures = {"count": sum(counts), "counts": bool(counts), "cpu_s": process_time()}
            print(json.dumps(figures), flush=True)
        os._exit(0)

    threading.Thread(target=tell, daemon=True).start()
    sys.path.insert(0, str(BENCHMARKS.parent / "examples" / "ping_pong"))
    getattr(__import__(module), function)()


def native_mains(mains: list[list[str]], scale: float, folder: Path) -> Figures:
    """Run mains as processes of their own over DDS, and count what they count for some seconds."""
    command = [sys.executable, __file__, "--main"]
    processes = [
        subprocess.Popen([*command, *main], stdin=-1, stdout=-1, stderr=-3, text=True)
        for main in mains
    ]

    def ask() -> tuple[int, float]:
        told = []
        for process in processes:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write("\n")
            process.stdin.flush()
            told.append(json.loads(process.stdout.readline()))
        return sum(one["count"] for one in told), sum(one["cpu_s"] for one in told)

    try:
        given_up = perf_counter() + DISCOVERY_S_MAX
        while ask()[0] < 2:
            if perf_counter() > given_up:
                return {"problem": "the mains did not find each other over DDS"}
            sleep(0.2)
        sleep(WARM_UP_S)
        count, cpu_s = ask()
        sleep(max(0.5, NATIVE_S * scale))
        end_count, end_cpu_s = ask()
        return {"units": end_count - count, "cpu_s": end_cpu_s - cpu_s}
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def command_cpu(command: list[str], folder: Path) -> float:
    """Return the CPU seconds of a command and of all that it starts."""
    process = subprocess.Popen(command, cwd=folder, stdout=-3, stderr=subprocess.PIPE)
    assert process.stderr is not None
    said = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)}: {said.decode().strip()}")
    return usage.ru_utime + usage.ru_stime


def small_trace(folder: Path) -> list[str]:
    """Write a job of one small node and its trace; return how rsltrace is called."""
    rsltrace = [sys.executable, "-m", "rsltrace"]
    job = {
        "nodes": [{"node": "usual_nodes:Idle"}],
        "search_path": [str(BENCHMARKS)],
        "stop": {"duration": "1s"},
    }
    (folder / "job.yaml").write_text(json.dumps(job))
    for name in ("a.mcap", "b.mcap"):
        command_cpu([*rsltrace, "record", "job.yaml", "-o", name, "-q"], folder)
    return rsltrace


def one_command(words: list[str], scale: float, folder: Path) -> Figures:
    """Measure a command of rsltrace on the trace of one small node."""
    rsltrace = small_trace(folder)
    return {"units": 1, "cpu_s": min(command_cpu([*rsltrace, *words], folder) for _ in range(3))}


def first_screen(scale: float, folder: Path) -> Figures:
    """Measure the CPU time of the viewer until its first screen is there."""
    import re

    from view import Terminal

    small_trace(folder)
    times = []
    for _ in range(3):
        terminal = Terminal(folder / "a.mcap")
        terminal.wait_for(re.compile(b"/beat|idle"))
        fields = Path(f"/proc/{terminal.pid}/stat").read_text().rpartition(")")[2].split()
        times.append((int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"))
        terminal.drain()
        terminal.quit()
    return {"units": 1, "cpu_s": min(times)}


SCRIPT = """
import sys
sys.path.insert(0, {folder!r})
import rclpy
from usual_nodes import Idle
rclpy.init()
node = Idle()
rclpy.spin_once(node)
node.destroy_node()
rclpy.shutdown()
"""


def native_script(scale: float, folder: Path) -> Figures:
    """Measure a script with one small node over DDS, from its start to its end."""
    (folder / "script.py").write_text(SCRIPT.format(folder=str(BENCHMARKS)))
    times = [command_cpu([sys.executable, "script.py"], folder) for _ in range(3)]
    return {"units": 1, "cpu_s": min(times)}


def bare_script(scale: float, folder: Path) -> Figures:
    """Measure what importing rclpy takes."""
    return {
        "units": 1,
        "cpu_s": min(command_cpu([sys.executable, "-c", "import rclpy"], folder) for _ in range(3)),
    }


def bare_images(scale: float, folder: Path) -> Figures:
    """Copy an image for its file and for two listeners, hash it, write it."""
    from xxhash import xxh3_64_intdigest

    data = usual_nodes.image().data
    count = max(5, int(IMAGES * scale))
    times = []
    for _ in range(2):
        with (folder / "images").open("wb", buffering=0) as file:
            start = process_time()
            for _ in range(count):
                wire = data.tobytes()
                xxh3_64_intdigest(wire)
                file.write(wire)
                for _ in range(2):
                    data[:]
            times.append(process_time() - start)
    return {"units": count, "cpu_s": min(times)}


def file_bytes(graph: Graph, scale: float, folder: Path) -> Figures:
    """Return the bytes of a trace beyond what its messages take in a bag of the mcap package."""
    events = max(5_000, int(SMALL_EVENTS * scale))
    found = run_rsltrace(graph, events, folder, record=True)
    payloads = payload_bytes(folder / "run.mcap", folder / "payloads.mcap")
    return {"units": found["callbacks"], "bytes": found["bytes"] - payloads}


def payload_bytes(trace: Path, output: Path) -> int:
    """Write the messages of ROS topics of a trace to a file of their own; return its size."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    with trace.open("rb") as stream, output.open("wb") as target:
        writer = Writer(target, compression=CompressionType.ZSTD)
        writer.start()
        ids: dict[int, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            if channel.topic.startswith("/rsltrace/"):
                continue
            if channel.id not in ids:
                assert schema is not None
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(channel.topic, "cdr", known)
            writer.add_message(
                ids[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
        writer.finish()
    return output.stat().st_size


# -- the cases -------------------------------------------------------------------------------------


BURST = ["--ros-args", "-p", "messages:=0", "-p", "burst:=true", "-p", "period:=0.1"]


def both(graph: Graph, count: int, **more: Any) -> dict[str, Way]:
    """Return the ways of a graph under rsltrace."""
    return {
        "plain": partial(simulated, graph, count, False, **more),
        "recorded": partial(simulated, graph, count, True, **more),
    }


def all_cases() -> list[Case]:
    """Return every case in the order of the table."""
    here = usual_graphs()
    pings, eight, many = GRAPHS["ping_pong"], GRAPHS["graph8"], GRAPHS["graph200"]
    callback, events = "callback", 60_000
    logs, goals, images = 20_000, 2_000, IMAGES

    def goals_done(node: Any) -> int:
        return int(getattr(node, "goals", 0)) * EVENTS_PER_GOAL

    def shown(node: Any) -> int:
        return int(node.callbacks) if node.get_name() == "left" else 0

    def over_dds(graph: Graph) -> dict[str, Way]:
        return {"bare": partial(bare, graph), "native": partial(native, graph)}

    def as_processes(*mains: list[str]) -> dict[str, Way]:
        return {"native": partial(native_mains, list(mains))}

    def commands() -> list[Case]:
        record = ["record", "job.yaml", "-o", "new.mcap", "--force", "-q"]
        return [
            Case(
                "record",
                "record of one small node",
                "command",
                {
                    "bare": bare_script,
                    "native": native_script,
                    "recorded": partial(one_command, record),
                },
                600_000,
            ),
            *(
                Case(
                    words[0],
                    f"{words[0]} of its trace",
                    "command",
                    {"recorded": partial(one_command, words)},
                    200_000,
                )
                for words in (["diff", "a.mcap", "b.mcap"], ["info", "a.mcap"], ["cat", "a.mcap"])
            ),
            Case(
                "view",
                "first screen of its trace",
                "command",
                {"recorded": first_screen},
                500_000,
            ),
        ]

    return [
        Case("nodes", "ping-pong of two nodes", callback, over_dds(pings) | both(pings, events)),
        Case("graph8", "graph of 8 nodes", callback, over_dds(eight) | both(eight, events)),
        Case("graph200", "graph of 200 nodes", callback, both(many, 4 * events)),
        Case(
            "mains",
            "ping-pong of mains that spin",
            callback,
            as_processes(["usual_nodes:ping", *BURST], ["usual_nodes:pong"])
            | both(GRAPHS["mains"], events),
            1.5,
            "nodes",
        ),
        Case(
            "once",
            "same, by spin_once",
            callback,
            as_processes(["usual_nodes:ping_once", *BURST], ["usual_nodes:pong_once"])
            | both(here["once"], events // 2),
        ),
        Case(
            "calls",
            "blocking calls of a main",
            f"call, {EVENTS_PER_CALL} events",
            as_processes(["usual_nodes:call"], ["usual_nodes:serve"])
            | both(here["calls"], 10_000, units=10_000),
        ),
        Case(
            "until",
            "same, by spin_until_future_complete",
            "call",
            as_processes(["usual_nodes:call_and_spin"], ["usual_nodes:serve"])
            | both(here["until"], 10_000, units=10_000),
        ),
        Case(
            "logs",
            "log records",
            "record",
            {"native": partial(native, here["logs"])} | both(here["logs"], logs, units=logs),
            60,
        ),
        Case(
            "parameters",
            "set a parameter, with a check",
            "set",
            {"native": partial(native, here["sets"])} | both(here["sets"], logs, units=logs),
        ),
        Case(
            "goals",
            "goals with 3 feedbacks, one after the other",
            f"event, {EVENTS_PER_GOAL} a goal",
            {"native": partial(native, here["goals"], count=goals_done)}
            | both(here["goals"], goals),
            50,
        ),
        *(
            Case(
                f"{graph.name}_delayed",
                f"{graph.title}, a delay on every link",
                callback,
                both(graph, count, delayed=True),
                1.3,
                name,
            )
            for graph, count, name in (
                (pings, events, "nodes"),
                (eight, events, "graph8"),
                (many, 4 * events, "graph200"),
            )
        ),
        Case(
            "images",
            "image of 6 MB to two subscriptions",
            "image",
            {
                "bare": bare_images,
                "native": partial(native, here["images"], count=shown),
                **both(here["images"], images, units=images),
            },
            usual_nodes.IMAGE_BYTES / 1000,  # 1 GB/s
        ),
        *commands(),
        Case(
            "files",
            "file of small messages, beyond a bag's",
            "bytes of an event",
            {"recorded": partial(file_bytes, here["small"])},
            35,
        ),
    ]


# -- measuring and telling -------------------------------------------------------------------------


def measure(case: Case, way: str, scale: float) -> None:
    """Measure a case in one way once more, in a fresh interpreter."""
    with tempfile.TemporaryDirectory(prefix="rsltrace-usual-") as folder:
        command = [sys.executable, __file__, "--worker", case.name, way, str(scale), folder]
        try:
            done = subprocess.run(
                command,
                env=child_environment(Path(folder)) | {"PYTHONHASHSEED": "0"},
                capture_output=True,
                text=True,
                timeout=WORKER_S_MAX,
            )
        except subprocess.TimeoutExpired:
            case.problems[way] = f"no result after {WORKER_S_MAX} s"
            return
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    last = done.stderr.strip().splitlines()[-1:] or ["no output"]
    figures = json.loads(lines[-1]) if lines else {"problem": f"{done.returncode}: {last[0]}"}
    if "problem" in figures:
        case.problems[way] = figures["problem"]
        return
    total = figures["bytes"] if "bytes" in figures else figures["cpu_s"] * 1e6
    case.found.setdefault(way, []).append(total / figures["units"])


def shown_figure(case: Case, value: float) -> str:
    """Return a figure with its unit."""
    if case.name == "files":
        return f"{value:.1f} B"
    if value < 1000:
        return f"{value:.1f} µs"
    return f"{value / 1000:.1f} ms"


def verdict(case: Case, cases: dict[str, Case]) -> tuple[str, str]:
    """Return how much at most it should be, and what of that is so."""
    value = case.best.get("recorded")
    if case.most is None or value is None:
        return "", ""
    most, said = case.most, shown_figure(case, case.most)
    if case.of:
        base = cases[case.of].best.get("recorded") if case.of in cases else None
        if base is None:
            return f"{case.most} x {case.of}", ""
        value, said = value / base, f"{case.most} x {case.of}"
        return said, f"{value:.2f}, {'reached' if value <= most else 'missed'}"
    return said, "reached" if value <= most else "missed"


def rows(cases: list[Case]) -> list[list[str]]:
    """Return the table: a row for each case."""
    by_name = {case.name: case for case in cases}
    table = []
    for case in cases:
        best = case.best
        figures = [shown_figure(case, best[way]) if way in best else "" for way in WAYS]
        times = ""
        if "native" in best and "recorded" in best:
            times = f"{best['native'] / best['recorded']:.1f}"
        aim, met = verdict(case, by_name)
        name = f"`{case.name}`"
        table.append([case.title, case.unit, *figures, times, aim, met, name])
    return table


def tell(cases: list[Case], markdown: bool) -> None:
    """Print the table."""
    heads = ["what", "per", *HEADS, "native / recorded", "at most", "", "`--only`"]
    table = [heads, *rows(cases)]
    widths = [max(len(row[column]) for row in table) for column in range(len(heads))]
    between = " | " if markdown else "  "
    for number, row in enumerate(table):
        cells = [
            cell.rjust(width) if 2 <= column <= 6 else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        line = between.join(cells).rstrip()
        print(f"| {between.join(cells)} |" if markdown else line)
        if not number:
            dashes = ["-" * width for width in widths]
            print(f"| {' | '.join(dashes)} |" if markdown else "  ".join(dashes))
    for case in cases:
        for way, problem in case.problems.items():
            print(f"{case.name}, {way}: {problem}", file=sys.stderr)


def main() -> int:
    """Measure and print. Returns the exit status: 1 if a way of rsltrace failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--repeat", type=int, default=3, help="how often each is measured")
    parser.add_argument("--scale", type=float, default=1.0, help="how much of everything (1: all)")
    parser.add_argument("--only", action="append", help="cases whose name contains this")
    parser.add_argument("--way", action="append", choices=WAYS, help="measure only these ways")
    parser.add_argument("--markdown", action="store_true", help="print the table as Markdown")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--worker", nargs=4, help=argparse.SUPPRESS)
    parser.add_argument("--main", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.main:
        run_main(options.main[0], options.main[1:])
        return 0
    cases = all_cases()
    if options.worker:
        name, way, scale, folder = options.worker
        case = next(case for case in cases if case.name == name)
        print(json.dumps(case.ways[way](float(scale), Path(folder))), flush=True)
        sys.stderr.flush()
        os._exit(0)  # DDS's threads may linger
    if options.only:
        cases = [case for case in cases if any(part in case.name for part in options.only)]
    if not cases or options.repeat < 1 or not options.scale > 0:
        print("\n".join(case.name for case in all_cases()))
        return 2
    for turn in range(options.repeat):
        for case in cases:
            for way in WAYS:
                if way in case.ways and (not options.way or way in options.way):
                    print(f"{turn + 1} {case.name} {way}", file=sys.stderr, flush=True)
                    measure(case, way, options.scale)
    if options.json:
        print(json.dumps([{"case": c.name, "unit": c.unit, **c.best} for c in cases], indent=2))
    else:
        tell(cases, options.markdown)
    return int(any({"plain", "recorded"} & case.problems.keys() for case in cases))


if __name__ == "__main__":
    sys.exit(main())
