"""LiDAR odometry, simulated and native: how many different errors do equal runs have?

    python benchmarks/lidar_odometry.py --simulated 100 --native 20 --to out/lidar

records ``examples/lidar_odometry`` that often, simulated and natively, each without and with busy
processes beside it, and prints the table; ``errors.svg`` in the folder shows errors and ways. The
simulated runs differ in hash seed, addresses, number of processors and environment. Runs are kept
as lines of ``runs.jsonl`` (their traces are not), to which another call adds what is missing.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "lidar_odometry"
ERRORS = ("absolute error", "relative error", "lost sweeps")
KINDS = (("simulated", False), ("simulated", True), ("native", False), ("native", True))
BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: sum(range(100000))"
Run = dict[str, Any]


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Keep processors busy; whoever is beside them gets less."""
    started = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def run_once(kind: str, number: int, job: Path) -> Run:
    """Record the job once, in surroundings that are those of no other run."""
    chance = random.Random(number)
    allowed = sorted(os.sched_getaffinity(0))
    processors = chance.sample(allowed, chance.randint(1, len(allowed)))
    env = {**os.environ, "PYTHONHASHSEED": str(number), "PADDING": "x" * chance.randrange(4000)}
    with tempfile.TemporaryDirectory() as folder:
        trace = Path(folder) / "run.mcap"
        words = ["-m", "rsltrace", "record", str(job), "-o", str(trace), "--json", "-q"]
        native = ["--native"] if kind == "native" else []
        done = subprocess.run(
            [sys.executable, *words, *native],
            env=env,
            preexec_fn=None if native else partial(os.sched_setaffinity, 0, processors),
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
        )
        if done.returncode:
            raise SystemExit(f"run {number} ({kind}) ended with {done.returncode}:\n{done.stderr}")
        result = json.loads(done.stdout)
        values = {name: one["value"] for name, one in result["metrics"].items()}
        return {
            "kind": kind,
            "digest": result.get("digest"),
            **{name: values[name] for name in ERRORS},
            "ways": ways(trace) if native or number == 0 else [],
        }


def ways(path: Path) -> list[list[list[float]]]:
    """Return the truth and the estimate laid on it, in metres from above."""
    from lidar_demo.evaluation import trajectories

    from rsltrace import Trace

    with Trace.open(path) as trace:
        both = trajectories(trace) or ()
        return [one.positions_xyz[:, :2].round(4).tolist() for one in both]


def table(runs: list[Run]) -> str:
    """Return the table of the runs, in Markdown."""
    lines = [
        "| runs | CPU load | different errors | absolute error, mm: least, median, greatest "
        "| relative error, mm | sweeps lost | digests |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, loaded in KINDS:
        those = [run for run in runs if (run["kind"], run["loaded"]) == (kind, loaded)]
        if those:
            lines.append(_row(f"{len(those)} {kind}", "yes" if loaded else "no", those))
    return "\n".join(lines)


def _row(name: str, load: str, runs: list[Run]) -> str:
    errors, relative, lost = (_known(run[name] for run in runs) for name in ERRORS)
    digests = len(set(_known(run["digest"] for run in runs)))
    cells = (
        *(name, load, len(set(errors))),
        ", ".join(f"{of(errors):.4f}" for of in (min, median, max)) if errors else "–",
        f"{min(relative):.4f} to {max(relative):.4f}" if relative else "–",
        f"{min(lost):.0f} to {max(lost):.0f}",
        digests or "–",
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def _known(values: Iterable[Any]) -> list[Any]:
    """Return values without those that a run does not have: a digest, or the error over a metre of
    an odometry that has lost its way."""
    return [value for value in values if value is not None]


def draw(runs: list[Run], path: Path) -> None:
    """Draw the errors of all runs, and the ways."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "rsltrace"
    from matplotlib import pyplot as plt
    from matplotlib.ticker import LogLocator, NullLocator, ScalarFormatter

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    colours = {"native": "#d95f02", "simulated": "#1f4e9c"}
    for at, (kind, loaded) in enumerate(KINDS):
        those = [run for run in runs if (run["kind"], run["loaded"]) == (kind, loaded)]
        spread = [at + 0.5 * (i / max(1, len(those) - 1) - 0.5) for i in range(len(those))]
        left.plot(spread, [run[ERRORS[0]] or math.nan for run in those], ".", color=colours[kind])
    left.set_xticks(range(4), [f"{k}\n{'CPU load' if load else 'no load'}" for k, load in KINDS])
    left.set_ylabel("absolute pose error of a run, mm")
    left.set_yscale("log")
    left.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    left.yaxis.set_major_formatter(ScalarFormatter())
    left.yaxis.set_minor_locator(NullLocator())
    for kind, width in (("native", 0.6), ("simulated", 1.6)):
        for run in (run for run in runs if run["kind"] == kind and run["ways"]):
            right.plot(*zip(*run["ways"][1], strict=True), color=colours[kind], lw=width)
        right.plot([], [], color=colours[kind], label=kind)
    longest = max(runs, key=lambda run: len(run["ways"] and run["ways"][0]))
    right.plot(*zip(*longest["ways"][0], strict=True), "k--", lw=1, label="truth")
    right.set_aspect("equal")
    right.set_xlabel("x, m")
    right.set_ylabel("y, m")
    right.legend()
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Record what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--simulated", type=int, default=100, help="half of them under load")
    parser.add_argument("--native", type=int, default=20, help="without load, and as many with it")
    parser.add_argument("--load", type=int, default=2 * (os.cpu_count() or 1))
    parser.add_argument("--job", type=Path, default=EXAMPLE / "job.yaml")
    parser.add_argument("--to", type=Path, default=Path("out/lidar"), metavar="FOLDER")
    options = parser.parse_args()
    sys.path.insert(0, str(EXAMPLE))
    options.to.mkdir(parents=True, exist_ok=True)
    kept = options.to / "runs.jsonl"
    runs: list[Run] = []
    if kept.exists():
        runs = [json.loads(line) for line in kept.read_text().splitlines()]
    wanted = {"simulated": options.simulated // 2, "native": options.native}
    for kind, loaded in KINDS:
        have = sum((run["kind"], run["loaded"]) == (kind, loaded) for run in runs)
        with busy(options.load if loaded else 0), kept.open("a") as file:
            for number in range(have, wanted[kind]):
                run = run_once(kind, number + 1000 * loaded, options.job)
                runs.append({**run, "loaded": loaded})
                file.write(json.dumps(runs[-1]) + "\n")
                file.flush()
    draw(runs, options.to / "errors.svg")
    print(table(runs))


if __name__ == "__main__":
    main()
