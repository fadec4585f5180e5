"""What the guard costs where its sources are not used: nothing, counted rather than timed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rsltrace.guard.virtual.set_order import LISTS_READ_SETS

pytestmark = pytest.mark.ros

EXAMPLE = Path(__file__).parents[2] / "examples" / "benchmark8"

COUNT = """
import json, os, sys
from collections import Counter
from rsltrace import load_job, record
from rsltrace.guard.virtual import set_order
from rsltrace.guard.redirect import copy_of

GUARD = os.path.dirname(set_order.__file__)
events, calls = Counter(), Counter()

def profile(frame, event, argument):
    if event == "call" and frame.f_code.co_filename.startswith(GUARD):
        calls[os.path.basename(frame.f_code.co_filename) + ":" + frame.f_code.co_name] += 1

def hook(event, arguments):
    if counting:
        events[event] += 1

counting = False
sys.addaudithook(hook)
found = []
for job in sys.argv[1:]:
    events.clear()
    calls.clear()
    counting = True
    result = record(load_job(job), job + ".mcap", force=True)
    counting = False
    sys.setprofile(profile)
    record(load_job(job), job + ".mcap", force=True)
    sys.setprofile(None)
    found.append({"callbacks": result.events, "events": events.copy(), "calls": calls.copy()})
print(json.dumps(found))
"""


@pytest.mark.long
def test_a_callback_that_does_nothing_nasty_costs_nothing(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    jobs = []
    # The first one warms up. At the first 32 outputs of a callback there is a look at its line.
    for number, duration in enumerate(("5ms", "50ms", "150ms")):
        job: dict[str, Any] = {
            "nodes": [{"node": "benchmark8:make_nodes", "arguments": {"period": 0.001}}],
            "search_path": [str(EXAMPLE)],
            "stop": {"duration": duration},
        }
        path = tmp_path / f"{number}.json"
        path.write_text(json.dumps(job))
        jobs.append(str(path))
    done = subprocess.run(
        [sys.executable, "-c", COUNT, *jobs],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    _, short, long = json.loads(done.stdout.splitlines()[-1])
    assert long["callbacks"] - short["callbacks"] > 1000

    def more(what: str) -> dict[str, int]:
        # A segment of the trace more or less may be written.
        return {
            name: count - short[what].get(name, 0)
            for name, count in long[what].items()
            if count - short[what].get(name, 0) > 20
        }

    assert more("events") == {}, "audit hooks are told of it"
    calls = more("calls")
    if LISTS_READ_SETS:  # who makes a list is asked whether it is one of a set
        assert calls.pop("set_order.py:make", 0) < long["callbacks"] - short["callbacks"]
    assert calls == {}
