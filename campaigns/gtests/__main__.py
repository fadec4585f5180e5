"""Run gtest executables natively and in rsltrace, and name each test that differs.

    python campaigns/gtests FOLDER [-k PART] [--timeout 60]

FOLDER has the executables, at any depth, as a build of rclcpp's tests leaves them. Each runs as a
whole; a test that crashes or hangs ends the process, and the rest runs in a new one. One that
failed has a run of its own.
The exit status is 0 if every test that passes natively passes in rsltrace, or is in ``known.py``.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from known import KNOWN

PASSED = "passed"
_HUNG = "not done after"
_STEP = re.compile(r"^\[ +(RUN|OK|FAILED|SKIPPED) +\] ([\w/.]+)(?:, where .*)?(?: \(\d+ ms\))?$")


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
            tests = names(_run(folder, [str(program), "--gtest_list_tests"], options.timeout)[0])
            here = verdicts(folder, program, tests, options.timeout, simulated=False)
            passing = [test for test in tests if here[test] == PASSED]
            there = verdicts(folder, program, passing, options.timeout, simulated=True)
        total, native = total + len(tests), native + len(passing)
        alike = sum(there[test] == PASSED for test in passing)
        both += alike
        print(
            f"{program.name}: {len(passing)} of {len(tests)} natively, {alike} in rsltrace",
            flush=True,
        )
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


def names(listed: str) -> list[str]:
    """Return the tests that ``--gtest_list_tests`` lists, without those that are disabled."""
    found, suite = [], ""
    for line in listed.splitlines():
        name = line.partition("#")[0].rstrip()
        if not name.startswith("  "):
            suite = name
        elif suite.endswith(".") and "DISABLED_" not in suite + name:
            found.append(suite + name.strip())
    return found


def verdicts(
    folder: Path, program: Path, tests: Sequence[str], limit_s: float, *, simulated: bool
) -> dict[str, str]:
    """Return how each test went: ``passed``, or what it said."""

    def run(which: Sequence[str]) -> dict[str, str]:
        command = [str(program), f"--gtest_filter={':'.join(which)}"]
        return _went(*_run(folder, command, limit_s, simulated=simulated))

    went: dict[str, str] = {}
    left = list(tests)
    while left:
        found = run(left)
        went.update(found or dict.fromkeys(left, "did not run"))
        left = [test for test in left if test not in went]
    for test in tests:
        if went[test] != PASSED and len(tests) > 1 and not went[test].startswith(_HUNG):
            went.update(run([test]))
    return went


def reason_for(name: str) -> str:
    """Return why a test is known to differ, "" if it is not."""
    return next((why for which, why in KNOWN.items() if fnmatch.fnmatch(name, which)), "")


def _run(
    folder: Path, command: Sequence[str], limit_s: float, *, simulated: bool = False
) -> tuple[str, str]:
    """Run a command of gtest; return what it printed, and how it ended."""
    if simulated:
        node = {"program": command[0], "arguments": command[1:], "required": True}
        node["intra_process"] = True  # some tests are of it
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
    with (folder / "said").open("w+") as said, (folder / "errors").open("w+") as errors:
        process = subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=errors,
        )
        try:
            how = f"ended with status {process.wait(limit_s)}"
        except subprocess.TimeoutExpired:
            process.terminate()
            process.wait()
            how = f"{_HUNG} {limit_s:g} s of wall time"
        said.seek(0)
        errors.seek(0)
        why = [line for line in errors if line.startswith("rsltrace: error")]
        return said.read(), why[0].strip() if why else how


def _went(printed: str, how: str) -> dict[str, str]:
    """Return how each test went that was begun."""
    went: dict[str, str] = {}
    begun, text = "", ""
    for line in printed.splitlines():
        step = _STEP.match(line)
        if step is None:
            text += f" {line.strip()}" if len(text) < 300 else ""
        elif step[1] == "RUN":
            begun, text = step[2], ""
        elif step[2] == begun:
            went[begun] = PASSED if step[1] == "OK" else f"{step[1].lower()}:{text}"
            begun = ""
    return {**went, begun: f"{how}:{text}"} if begun else went


if __name__ == "__main__":
    sys.exit(main())
