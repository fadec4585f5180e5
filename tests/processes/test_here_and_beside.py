"""Programs say the same in rsltrace's process and in processes of their own: every example, and all
mains of ``tests/demos``."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.reader import Trace

pytestmark = [
    pytest.mark.ros,
    pytest.mark.long,
    pytest.mark.skipif(
        importlib.util.find_spec("test_msgs") is None, reason="needs ROS 2's test_msgs"
    ),
]

ROOT = Path(__file__).parents[2]
SPIN = Path(__file__).with_name("spin_node.py")
_GOAL_IDS = re.compile(r"^/[^/]+/_action/")

Said = dict[str, list[Any]]


def _said(job: dict[str, Any], folder: Path, name: str) -> Said:
    """Run a job; return what was published on each topic, and logged by each node, with stamps.

    Of what actions publish only the stamps: the ids of goals are chance, drawn elsewhere.
    """
    (folder / f"{name}.yaml").write_text(yaml.safe_dump(job, sort_keys=False))
    result = run(load_job(folder / f"{name}.yaml"), folder / f"{name}.mcap")
    assert result.error is None
    said: defaultdict[str, list[Any]] = defaultdict(list)
    with Trace.open(folder / f"{name}.mcap") as trace:
        for topic in {channel.topic for channel in trace.channels.values()}:
            for stamp, _, data in trace.messages(topic):
                if topic == "/rosout":
                    record: Any = trace.decode(topic, data)
                    said[f"log of {record.name}"].append((stamp, record.msg))
                elif topic.startswith("/") and not topic.startswith("/rsltrace/"):
                    content = b"" if _GOAL_IDS.match(topic) else bytes(data)
                    said[topic].append((stamp, content))
    return said


def _compare(job: dict[str, Any], folder: Path) -> Said:
    here = _said(job, folder, "here")
    for node in job["nodes"]:
        node["isolated"] = True
    beside = _said(job, folder, "beside")
    assert {topic: len(said) for topic, said in here.items()} == {
        topic: len(said) for topic, said in beside.items()
    }
    assert not [topic for topic, said in here.items() if said != beside[topic]]
    return here


HUSKY = ROOT.parent / "shared" / "data" / "husky_outdoor"


def _example(name: str) -> dict[str, Any]:
    """Return the job of an example, its nodes as scripts; less of what is much."""
    job: dict[str, Any] = yaml.safe_load((ROOT / "examples" / name).read_text())
    for node in job["nodes"]:
        arguments = node.pop("arguments", {})
        if "groups" in arguments:
            arguments["groups"] = 8
        if "messages" in node.get("parameters", {}):
            node["parameters"]["messages"] = 1000
        node["script"] = str(SPIN)
        node["arguments"] = [node.pop("node"), json.dumps(arguments)]
    for bag in job.get("bags", []):
        bag["path"] = str(HUSKY)
    return job | {"search_path": [str((ROOT / "examples" / name).parent)]}


@pytest.mark.parametrize(
    ("example", "seconds", "topics"),
    [
        ("ping_pong/job.yaml", 0.2, {"/ping", "/pong"}),
        ("ping_pong/job_burst.yaml", 0.2, {"/ping", "/pong"}),
        ("rslcpp_determinism/job.yaml", 3.0, {"/t1", "/t2", "/t3", "/t4", "/t5"}),
        (
            "sensor_fusion/job.yaml",
            1.5,
            {"/imu/data", "/odometry/filtered", "/cmd_vel", "log of planner"},
        ),
        pytest.param(
            "sensor_fusion/job_husky.yaml",
            20.0,
            {"/fix", "/path", "log of ekf"},
            marks=pytest.mark.skipif(not HUSKY.exists(), reason="needs the bag of the Husky"),
        ),
        ("benchmark8/job.yaml", 0.1, {"/g0/imu", "/g0/plan"}),
        ("benchmark8/job_200_nodes.yaml", 0.003, {"/g0/imu", "/g7/imu"}),
        ("wall/job.yaml", 3.0, {"/range", "/speed", "/load"}),
    ],
)
def test_examples(
    compiled: object, tmp_path: Path, example: str, seconds: float, topics: set[str]
) -> None:
    job = _example(example) | {"stop": {"duration": seconds}}
    assert topics <= set(_compare(job, tmp_path))


def test_all_mains_of_the_demos(
    compiled: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tests" / "run"))
    monkeypatch.delitem(sys.modules, "demo_packages", raising=False)
    import demo_packages as demos

    prefix = demos.install_demos(tmp_path)
    names = (*demos.SERVERS, *demos.CLIENTS)
    job = {
        "nodes": [{"executable": f"{demos.package_of(name)}/{name}"} for name in names],
        "search_path": [str(prefix)],
        "stop": {"duration": 10.0},
    }
    said = _compare(job, tmp_path)
    assert said["log of listener"][-1][1] == "141 letters"
    assert {f"log of {name}" for name in names if name != "adder"} <= set(said)
