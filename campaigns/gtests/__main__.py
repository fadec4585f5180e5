"""Run gtest executables natively and in rsltrace, and name each test that differs.

    python campaigns/gtests FOLDER [-k PART] [--timeout 60]

FOLDER has the executables, at any depth, as a build of rclcpp's tests leaves them. Each runs as a
whole; a test that did not pass in that run has a run of its own.
The exit status is 0 if every test that passes natively passes in rsltrace, or is in ``known.py``.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from known import KNOWN

PASSED = "passed"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for, and print each difference and the counts."""
    parser = argparse.ArgumentParser(prog="gtests", description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="has the executables, at any depth")
    parser.add_argument("-k", dest="part", default="", help="only what has this in its name")
    parser.add_argument("--timeout", type=float, default=120, help="wall seconds for a process")
    options = parser.parse_args(arguments)
    total = native = both = known = failed = 0
    for program in executables(options.folder, options.part):
        with tempfile.TemporaryDirectory(prefix="gtests_") as temporary:
            folder = Path(temporary)
            tests = _names(_results(folder, [str(program), "--gtest_list_tests"], options.timeout))
            here = verdicts(folder, program, tests, options.timeout, simulated=False)
            passing = [test for test in tests if here[test] == PASSED]
            there = verdicts(folder, program, passing, options.timeout, simulated=True)
        total, native = total + len(tests), native + len(passing)
        alike = sum(there[test] == PASSED for test in passing)
        both += alike
        print(f"{program.name}: {len(passing)} of {len(tests)} natively, {alike} in rsltrace")
        for test in passing:
            if there[test] == PASSED:
                continue
            reason = reason_for(f"{program.name} {test}")
            known, failed = known + bool(reason), failed + (not reason)
            print(
                f"  {test}: {there[test]}" + (f" (known: {reason})" if reason else ""), flush=True
            )
    print(
        f"{total} tests: {native} pass natively, {both} of these in rsltrace; {known} are known "
        f"to differ, {failed} are not"
    )
    return 1 if failed or not native else 0


def executables(folder: Path, part: str) -> list[Path]:
    """Return the gtest executables of a folder, in order."""
    return [
        path
        for path in sorted(folder.rglob("test_*"))
        if path.is_file() and os.access(path, os.X_OK) and not path.suffix and part in path.name
    ]


def verdicts(
    folder: Path, program: Path, tests: Sequence[str], limit_s: float, *, simulated: bool
) -> dict[str, str]:
    """Return how each test went: ``passed``, or what it said."""

    def run(which: str) -> dict[str, str]:
        command = [str(program), f"--gtest_filter={which}"]
        found = _results(folder, command, limit_s, simulated=simulated)
        if isinstance(found, str):
            return dict.fromkeys(which.split(":"), found)
        return {f"{suite}.{one['name']}": _verdict(one) for suite, one in _each(found)}

    went = run(":".join(tests)) if tests else {}
    for test in tests:
        if went.get(test) != PASSED:
            went[test] = run(test).get(test, "did not run")
    return went


def reason_for(name: str) -> str:
    """Return why a test is known to differ, "" if it is not."""
    return next((why for which, why in KNOWN.items() if fnmatch.fnmatch(name, which)), "")


def _results(
    folder: Path, command: Sequence[str], limit_s: float, *, simulated: bool = False
) -> dict[str, Any] | str:
    """Run a command of gtest; return what it reports, or how it ended without a report."""
    report = folder / "report.json"
    report.unlink(missing_ok=True)
    command = [*command, f"--gtest_output=json:{report}"]
    if simulated:
        node = {"program": command[0], "arguments": command[1:], "required": True}
        job = {"nodes": [node], "clocks": {"source": "topic"}, "stop": {"duration": "1h"}}
        (folder / "job.yaml").write_text(json.dumps(job))
        words = ["record", str(folder / "job.yaml"), "-o", str(folder / "run.mcap"), "--force"]
        command = [sys.executable, "-m", "rsltrace", *words]
    environment = {
        **os.environ,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_LOG_DIR": str(folder / "log"),
    }
    try:
        ended = subprocess.run(
            command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, timeout=limit_s,
            capture_output=True, text=True, errors="replace", check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"not done after {limit_s:g} s of wall time"
    if report.exists():
        found: dict[str, Any] = json.loads(report.read_text())
        return found
    said = [line for line in ended.stderr.splitlines() if line.startswith("rsltrace: error")]
    return said[0] if said else f"ended with status {ended.returncode}"


def _each(found: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for suite in found["testsuites"]:
        for one in suite["testsuite"]:
            yield suite["name"], one


def _names(found: dict[str, Any] | str) -> list[str]:
    if isinstance(found, str):
        return []
    return [f"{suite}.{one['name']}" for suite, one in _each(found)]


def _verdict(one: dict[str, Any]) -> str:
    if "failures" in one:
        return " ".join(one["failures"][0]["failure"].split())[:300]
    return PASSED if one["result"] == "COMPLETED" else one["result"].lower()


if __name__ == "__main__":
    sys.exit(main())
