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


def list_as_wheel(site: Path, name: str, distribution: str = "", **more: str) -> None:
    """Write beside a module or package what pip writes of one that came as a wheel.

    ``more`` has the texts of further files (``direct_url``), and lines for the list of files
    (``record``).
    """
    info = site / f"{distribution or name}-1.0.dist-info"
    info.mkdir(parents=True)
    file = f"{name}.py" if (site / f"{name}.py").exists() else f"{name}/__init__.py"
    (info / "RECORD").write_text(f"{info.name}/INSTALLER,,\n{file},,\n{more.pop('record', '')}")
    (info / "INSTALLER").write_text(more.pop("installer", "pip") + "\n")
    for kind, text in more.items():
        (info / f"{kind}.json").write_text(text)


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
