"""What runs in a process of the harness: pytest on one module, within a simulation or natively.

pytest itself runs as the program of a job, as any ``main()`` would: wherever a test spins, sleeps
or waits, simulated time passes.
"""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest


class Reporter:
    """A pytest plugin that writes down each step, and leaves out what it is told to."""

    def __init__(self, path: Path, without: list[str]) -> None:
        self._file = path.open("a", buffering=1)
        self._without = set(without)
        self._worst: dict[str, tuple[str, str, str]] = {}

    def say(self, **step: object) -> None:
        """Write one line."""
        self._file.write(json.dumps(step) + "\n")

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        self.say(step="collected", tests=[item.nodeid for item in items])
        items[:] = [item for item in items if item.nodeid not in self._without]

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._worst[nodeid] = ("passed", "", "")
        self.say(step="start", test=nodeid)

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            crash = getattr(report.longrepr, "reprcrash", None)
            reason = crash.message if crash is not None else str(report.longrepr)
            self._worst[report.nodeid] = (
                "failed", f"{report.when}: {reason.splitlines()[0][:300]}", report.longreprtext
            )  # fmt: skip
        elif report.skipped and self._worst[report.nodeid][0] == "passed":
            # unittest's expectedFailure is a skip to pytest; as a test it did what it should.
            verdict = "passed" if hasattr(report, "wasxfail") else "skipped"
            self._worst[report.nodeid] = (verdict, str(report.longrepr), "")

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        verdict, reason, text = self._worst[nodeid]
        self.say(step="end", test=nodeid, verdict=verdict, reason=reason, text=text)


def run_pytest(request: dict[str, Any], reporter: Reporter) -> None:
    """Run the module's tests."""
    arguments = [
        f"test/{request['module']}", "-q", "-c", "/dev/null", "--rootdir", request["folder"],
        "-p", "no:cacheprovider", "-p", "no:rsltrace", "-p", "no:launch_testing",
    ]  # fmt: skip
    if request["keyword"]:
        arguments += ["-k", request["keyword"]]
    pytest.main(arguments, plugins=[reporter])


def simulate(request: dict[str, Any], reporter: Reporter) -> None:
    """Run the module's tests as a job, in this process or in one of the run's."""
    from rsltrace import Job, NodeSpec
    from rsltrace.run import run

    folder = Path(request["folder"])
    clocks: dict[str, object] = {"source": "topic"}
    policy = None
    if request["where"] == "process":
        words = [json.dumps({**request, "where": "here"})]
        node = NodeSpec(script=Path(__file__), isolated=True, arguments=words)
    else:
        node = NodeSpec(main=partial(run_pytest, request, reporter))
        clocks["advances"] = True
        policy = "rclpy"
    job = Job(nodes=[node], base_dir=folder, start=1000.0, clocks=clocks, policy=policy)
    result = run(job, folder / f"{request['module']}.mcap", force=True)
    # Of interest if a test is under way: it waits for what never comes.
    reason = str(result.error) if result.error is not None else result.stop_reason
    reporter.say(step="run ended", reason=reason)


if __name__ == "__main__":
    wanted = json.loads(sys.argv[1])
    sys.path.insert(0, wanted["folder"])
    plugin = Reporter(Path(wanted["report"]), wanted["without"])
    (run_pytest if wanted["where"] == "here" else simulate)(wanted, plugin)
