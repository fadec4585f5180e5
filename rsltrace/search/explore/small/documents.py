"""What is written beside a failing run: a README for people, and a test for pytest."""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace.search.explore.small.reduction import Reduced
from rsltrace.search.explore.trial import TrialResult
from rsltrace.trace.model.printable import printable
from rsltrace.trace.model.stamp import format_seconds

_TEST = '''"""The run in this folder fails as it did when it was found: {why}

Once the bug is mended the run is another one, and this test has done its work.
"""

import json
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent


def test_the_run_fails_bit_for_bit(tmp_path):
    words = ["record", str(FOLDER / "job.yaml"), "--json", "-o", str(tmp_path / "run.mcap")]
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", *words], capture_output=True, text=True
    )
    assert done.stdout, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["digest"] == "{digest}"
    assert done.returncode != 0
'''


def test_module(failing: TrialResult) -> str:
    """Return a test that runs the job of its folder."""
    return _TEST.format(why=_one_line(failing).replace('"', "'"), digest=failing.digest)


def readme(reduced: Reduced, failing: TrialResult, passing: TrialResult | None) -> str:
    """Return what the folder is, how to see it fail, and what the failure needs."""
    return "\n".join(_lines(reduced, failing, passing)) + "\n"


def _lines(reduced: Reduced, failing: TrialResult, passing: TrialResult | None) -> Iterator[str]:
    yield "# A run that fails"
    yield ""
    assert failing.failure is not None
    yield from (f"    {printable(line)}" for line in failing.failure.text.splitlines())
    yield ""
    yield "```sh"
    yield "rsltrace record job.yaml -o again.mcap"
    yield f"# digest {failing.digest}  events {failing.events}"
    if failing.failure.event is not None:
        yield f"rsltrace view failing.mcap --at {failing.failure.event}"
        yield f"rsltrace debug failing.mcap  # then: goto {failing.failure.event}"
    if passing is not None:
        yield "rsltrace diff failing.mcap passing.mcap"
    yield "```"
    yield ""
    yield "What this run needs to fail, beside the job it was found with:"
    yield ""
    needed = list(_needed(reduced))
    yield from needed or ["- nothing: the job fails as it is"]
    yield ""
    if not reduced.is_minimal:
        yield f"(There may be less to it: {reduced.runs} runs were made to find out, no more.)"
    else:
        yield f"None of it can be left out alone ({reduced.runs} runs were made to find out)."
    yield ""
    if passing is not None:
        yield f"`passing.mcap` is the nearest run that passes: {printable(reduced.passing_words)}."
        yield "`diff.txt` says where the two diverge."
    else:
        yield "No run with one part less passes, so there is no `passing.mcap`."
    yield ""
    yield "`test_reproduces.py` is a test for pytest. The folder can be moved together with the"
    yield "sources that `job.yaml` names."


def _needed(reduced: Reduced) -> Iterator[str]:
    parts = reduced.parts
    if parts.seed is not None:
        yield f"- seed {parts.seed}"
    for name, value in parts.settings:
        yield f"- {printable(f'{name} = {value}')}"
    for one, names in zip(parts.departures or (), reduced.chosen, strict=True):
        what = f": {printable(names)}" if names else ""
        yield f"- another order at choice {one['choice']} (number {one['run']} in line){what}"
    for fault in parts.faults or ():
        words = ", ".join(f"{key}: {value}" for key, value in fault.items())
        yield f"- the fault {{{printable(words)}}}"
    if parts.until_ns is not None:
        yield f"- it may end at {format_seconds(parts.until_ns)} s"
    if reduced.left_out:
        yield f"- it needs no {printable(', '.join(reduced.left_out))}"


def _one_line(result: TrialResult) -> str:
    assert result.failure is not None
    return printable(result.failure.text.splitlines()[0]).rstrip(".") + "."
