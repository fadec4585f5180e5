"""The side of the harness that stays outside: copies, processes, outcomes.

What a process has to say comes as one JSON line per step of a test, written as it happens, so that
the test under way is known when a process dies.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

INSIDE = Path(__file__).with_name("inside.py")


@dataclass(frozen=True)
class Outcome:
    """How a test went. ``verdict`` is ``passed``, ``failed``, ``hung``, ``crashed``, ``skipped`` or
    ``excluded``; ``text`` is the traceback."""

    test: str
    verdict: str
    reason: str = ""
    text: str = ""

    @property
    def passed(self) -> bool:
        """Whether the test ran and passed."""
        return self.verdict == "passed"


def copy_tests(checkout: Path, target: Path) -> Path:
    """Copy the tests of a checkout to ``target``; return the folder that holds ``test``.

    Its ``__init__.py`` would load rclpy's extension from a build folder; ours is empty.
    """
    for candidate in (checkout / "rclpy" / "test", checkout / "test"):
        if (candidate / "test_node.py").is_file():
            shutil.copytree(candidate, target / "test")
            (target / "test" / "__init__.py").write_text("")
            return target
    raise SystemExit(f"{checkout} is no checkout of rclpy: there is no rclpy/test/test_node.py")


def module_names(folder: Path) -> list[str]:
    """Return the test modules of a copy, in order."""
    return sorted(path.name for path in (folder / "test").glob("test_*.py"))


def run_module(
    folder: Path,
    module: str,
    excluded: Mapping[str, str],
    *,
    where: str = "simulation",
    keyword: str = "",
    limit_s: float = 120,
) -> list[Outcome]:
    """Run the tests of a module and return their outcomes in order.

    ``where`` is the ``simulation``, a ``process`` of one, or ``here``: natively, over DDS.
    """
    done: dict[str, Outcome] = {}
    while True:
        news = _one_process(folder, module, [*done, *excluded], where, keyword, limit_s)
        for test in news.collected:
            if test not in done and test in excluded:
                done[test] = Outcome(test, "excluded", excluded[test])
        done.update(news.outcomes)
        if news.under_way is not None:
            done[news.under_way] = Outcome(news.under_way, news.how, news.reason, news.text)
            continue  # the rest of the module, in a new process
        for test in news.collected:
            done.setdefault(test, Outcome(test, "crashed", news.reason, news.text))
        if not news.collected:
            done[f"test/{module}"] = Outcome(f"test/{module}", "crashed", news.reason, news.text)
        order = {test: index for index, test in enumerate(news.collected)}
        return sorted(done.values(), key=lambda outcome: order.get(outcome.test, -1))


@dataclass
class _News:
    """What one process has reported."""

    collected: list[str]
    outcomes: dict[str, Outcome]
    under_way: str | None
    how: str
    reason: str
    text: str


def _one_process(
    folder: Path, module: str, without: list[str], where: str, keyword: str, limit_s: float
) -> _News:
    report = folder / f"{module}.jsonl"
    report.write_text("")
    request = {
        "module": module, "without": without, "keyword": keyword, "where": where,
        "report": str(report), "folder": str(folder),
    }  # fmt: skip
    environment = {
        **os.environ,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(1 + (os.getpid() + sum(module.encode())) % 100),
        "ROS_LOG_DIR": str(folder / "log"),
    }
    process = subprocess.Popen(
        [sys.executable, str(INSIDE), json.dumps(request)],
        cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, errors="replace",
    )  # fmt: skip
    try:
        output, _ = process.communicate(timeout=limit_s)
        how, reason = "crashed", f"the process ended with status {process.returncode}"
    except subprocess.TimeoutExpired:
        process.kill()
        output, _ = process.communicate()
        how, reason = "hung", f"not done after {limit_s:g} s of wall time"
    news = _News([], {}, None, how, reason, output[-6000:])
    for line in report.read_text().splitlines():
        step = json.loads(line)
        if step["step"] == "collected":
            news.collected = step["tests"]
        elif step["step"] == "start":
            news.under_way = step["test"]
        elif step["step"] == "end":
            news.outcomes[step["test"]] = Outcome(
                step["test"], step["verdict"], step["reason"], step["text"]
            )
            news.under_way = None
        elif step["step"] == "run ended" and news.under_way is not None:
            news.how, news.reason = "hung", step["reason"]
    return news
