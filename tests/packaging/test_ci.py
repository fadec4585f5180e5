"""The action for GitHub and the template for GitLab: their steps, run as a runner runs them."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import pytest
from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[2]
ACTION = YAML(typ="safe").load(ROOT / "action.yml")
TEMPLATE = YAML(typ="safe").load(ROOT / "ci" / "rsltrace.gitlab-ci.yml")[".rsltrace"]
_EXPRESSION = re.compile(r"\$\{\{ inputs\.([\w-]+) \}\}")
_CONDITIONS = {
    "": lambda inputs, failed: not failed,
    "always()": lambda inputs, failed: True,
    "inputs.package != ''": lambda inputs, failed: not failed and inputs["package"] != "",
    "always() && inputs.artifact != ''": lambda inputs, failed: inputs["artifact"] != "",
}

NODE = """
from rclpy.node import Node
from std_msgs.msg import Float64

class Talker(Node):
    def __init__(self):
        super().__init__("talker")
        self.publisher = self.create_publisher(Float64, "speed", 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.publisher.publish(Float64(data=SPEED))
"""
JOB = "nodes: [{node: 'talker:Talker'}]\nstop: {duration: 300ms}\n"


@dataclass
class Ran:
    """What the steps of a runner did."""

    status: int = 0
    output: str = ""
    uploaded: list[str] = field(default_factory=list)
    summary: str = ""


def bash(script: str, folder: Path, variables: dict[str, str]) -> tuple[int, str]:
    """Run a step as GitHub's runner does, in an environment with nothing of ours but programs."""
    path = folder.parent / "step.sh"
    path.write_text(script)
    programs = os.pathsep.join((str(Path(sys.executable).parent), "/usr/bin", "/bin"))
    done = subprocess.run(
        ["bash", "--noprofile", "--norc", "-eo", "pipefail", str(path)],
        cwd=folder,
        env={"PATH": programs, "HOME": str(folder.parent), **variables},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
    )
    return done.returncode, done.stdout


def run_action(folder: Path, **given: str) -> Ran:
    """Run the steps of the action with some inputs."""
    inputs = {name: str(one.get("default", "")) for name, one in ACTION["inputs"].items()}
    inputs |= {"package": ""} | {name.replace("_", "-"): text for name, text in given.items()}
    ran, summary = Ran(), folder.parent / "summary.md"

    def filled(text: str) -> str:
        return _EXPRESSION.sub(lambda match: inputs[match[1]], text)

    for step in ACTION["runs"]["steps"]:
        if not _CONDITIONS[step.get("if", "")](inputs, ran.status != 0):
            continue
        if "uses" in step:
            assert step["uses"].startswith("actions/upload-artifact@")
            kept = folder / filled(step["with"]["path"])
            ran.uploaded = sorted(str(p.relative_to(kept)) for p in kept.rglob("*") if p.is_file())
            continue
        assert "${{" not in step["run"], "what is given would be code there"
        variables = {name: filled(text) for name, text in step.get("env", {}).items()}
        status, output = bash(
            step["run"], folder, {**variables, "GITHUB_STEP_SUMMARY": str(summary)}
        )
        ran.status, ran.output = ran.status or status, ran.output + output
    ran.summary = summary.read_text() if summary.exists() else ""
    return ran


def run_gitlab(folder: Path, **variables: str) -> Ran:
    """Run the template's lines with some variables."""
    known = {**TEMPLATE["variables"], "RSLTRACE_PACKAGE": "", **variables}
    lines = [*TEMPLATE["before_script"], *TEMPLATE["script"]]
    status, output = bash("\n".join(lines), folder, known)
    return Ran(status, output)


def test_both_run_the_same_lines() -> None:
    (script,) = TEMPLATE["script"]
    assert [s["run"] for s in ACTION["runs"]["steps"] if "RSLTRACE_JOBS" in s.get("env", {})] == [
        script
    ]
    used = set(re.findall(r"\bRSLTRACE_[A-Z_]+", script))
    assert used == TEMPLATE["variables"].keys() - {"RSLTRACE_PACKAGE"}


def test_every_input_is_used_and_explained() -> None:
    text = (ROOT / "action.yml").read_text()
    document = (ROOT / "docs" / "ci.md").read_text()
    for name in ACTION["inputs"]:
        assert f"inputs.{name} " in text
        assert f"| `{name}` |" in document
    for name in TEMPLATE["variables"]:
        assert f"`{name}`" in document


def record(folder: Path, job: str, golden: str) -> None:
    target = folder / golden
    target.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "rsltrace", "record", job, "-o", str(target), "--quiet"]
    subprocess.run(command, cwd=folder, check=True, timeout=600, capture_output=True)


def change(folder: Path, speed: float) -> None:
    (folder / "talker.py").write_text(NODE.replace("SPEED", str(speed)))


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A repository with a job in a folder, and its golden trace."""
    pytest.importorskip("rclpy")
    folder = tmp_path / "repository"
    (folder / "robots" / "a").mkdir(parents=True)
    change(folder, 1.5)
    job = JOB + "search_path: [../..]\n"
    (folder / "robots" / "a" / "job.yaml").write_text(job)
    record(folder, "robots/a/job.yaml", "golden/robots/a/job.mcap")
    return folder


@pytest.mark.long
@pytest.mark.ros
def test_the_action_passes_fails_and_keeps_what_it_made(robot: Path) -> None:
    jobs = "robots/**/job.yaml"
    ran = run_action(robot, jobs=jobs)
    assert ran.status == 0, ran.output
    made = ["report.md", *(f"robots/a/job.{end}" for end in ("html", "mcap", "md", "xml"))]
    assert ran.uploaded == made
    assert "rsltrace: 1 jobs, 0 failed" in ran.output
    assert "identical" in ran.summary

    change(robot, 2.5)
    ran = run_action(robot, jobs=jobs)
    assert ran.status == 1
    assert ran.uploaded == made
    assert "::error " in ran.output
    assert "the runs diverge" in ran.summary
    suite = ElementTree.parse(robot / "rsltrace-out/robots/a/job.xml").getroot()
    assert [one.get("failures") for one in suite.iter("testsuite")] == ["1"]

    ran = run_action(robot, jobs=jobs, diff_options="--abs data=2 --ignore *.nothing")
    assert ran.status == 0, ran.output  # within tolerance

    (robot / "talker.py").write_text("raise RuntimeError('broken')\n")
    ran = run_action(robot, jobs=f"{jobs} other.yaml", artifact="")
    assert ran.status == 1
    assert ran.uploaded == []
    assert "rsltrace: 2 jobs, 2 failed" in ran.output
    assert "robots/a/job.yaml failed with exit status" in ran.summary

    ran = run_action(robot, jobs=jobs, history="runs/robot.jsonl", artifact="")
    change(robot, 1.5)
    ran = run_action(robot, jobs=jobs, history="runs/robot.jsonl", artifact="")
    lines = map(json.loads, (robot / "runs" / "robot.jsonl").read_text().splitlines())
    found = [(one["job"], one["verdict"], one["digest"] != "") for one in lines]
    job = "golden/robots/a/job.mcap"
    assert found == [(job, "error", False), (job, "passed", True)]


@pytest.mark.long
@pytest.mark.ros
def test_the_template_passes_and_fails(robot: Path) -> None:
    ran = run_gitlab(robot, RSLTRACE_JOBS="robots/a/job.yaml", RSLTRACE_OUTPUT="made here")
    assert ran.status == 0, ran.output
    assert (robot / "made here" / "robots" / "a" / "job.xml").is_file()
    ran = run_gitlab(robot, RSLTRACE_JOBS="robots/a/job.yaml", RSLTRACE_GOLDEN="nowhere")
    assert ran.status == 1
    said = "there is no nowhere/robots/a/job.mcap; make it with: rsltrace record robots/a/job.yaml"
    assert said in ran.output
    change(robot, 9.0)
    ran = run_gitlab(robot, RSLTRACE_JOBS="robots/a/job.yaml")
    assert ran.status == 1
    assert "data  1.5  |  9.0" in ran.output


def test_no_job_at_all_is_an_error(tmp_path: Path) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    for ran in (run_action(folder, jobs="*.yaml"), run_gitlab(folder, RSLTRACE_JOBS="*.yaml")):
        assert ran.status == 2
        assert "no job fits '*.yaml'" in ran.output
