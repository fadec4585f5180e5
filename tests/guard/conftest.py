"""Node modules of a test's own, recorded in this process; what they logged is what they saw."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

NODE = """
{imports}
from rclpy.node import Node
{module}

class N(Node):
    def __init__(self):
        super().__init__('n')
{init}
        self.create_timer(0.5, self.tick)
    def say(self, *values):
        import json
        self.get_logger().info(json.dumps(values, default=str))
    def tick(self):
{tick}
"""


def node_code(tick: str, *, imports: str = "", module: str = "", init: str = "pass") -> str:
    """Return a module with a node that runs ``tick`` twice a second."""

    def block(text: str) -> str:
        return "\n".join(" " * 8 + line for line in text.splitlines())

    return NODE.format(imports=imports, module=module, init=block(init), tick=block(tick))


@pytest.fixture
def said(tmp_path: Path) -> Callable[..., list[Any]]:
    """Record a job of nodes and return what they said with ``self.say``, in order."""
    from rsltrace.job import load_job
    from rsltrace.run import record
    from rsltrace.trace.reader import Trace

    def run(code: str, *, job: str = "nodes: [{node: 'm:N'}]", name: str = "run") -> list[Any]:
        (tmp_path / "m.py").write_text(code)
        (tmp_path / "job.yaml").write_text(f"{job}\nstop: {{duration: 1.2s}}\n")
        path = tmp_path / f"{name}.mcap"
        record(load_job(tmp_path / "job.yaml"), path, force=True)
        with Trace.open(path) as trace:
            texts = [trace.decode("/rosout", data).msg for *_, data in trace.messages("/rosout")]  # type: ignore[attr-defined]
        return [json.loads(text) for text in texts if text.startswith("[")]

    return run
