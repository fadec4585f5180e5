"""What is said of two jobs that differ: keys as ``--set`` takes them, lines of the file, values."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.diff.causes.job_settings import job_settings
from rsltrace.diff.sentences.values import setting_name
from rsltrace.job import Job, load_job

JOB = """\
# a robot
nodes:
  - node: m:Ekf
    name: ekf
    parameters: {rate: 50.0, frame: odom}
  - node: m:Planner
delay:
  topics:
    /scan: {normal: {mean: 5ms, sd: 2ms}, drop: 0.05}
stop: {duration: 20s}
"""


@dataclass
class Recorded:
    """What a trace keeps of its job."""

    job_text: str
    job: dict[str, str]
    name: str = "run.mcap"


def recorded(folder: Path, text: str = JOB, *overrides: str) -> Recorded:
    path = folder / "robot.yaml"
    path.write_text(text)
    return of_job(load_job(path, overrides=overrides))


def of_job(job: Job) -> Recorded:
    resolved = json.dumps(job.resolved(), sort_keys=True)
    return Recorded(job.source_text, {"name": "robot.yaml", "resolved": resolved})


def told(a: Recorded, b: Recorded) -> dict[str, tuple[str | None, str | None]]:
    found: dict[str, tuple[str | None, str | None]] = {}
    for setting in job_settings(a, b):  # type: ignore[arg-type]
        assert setting_name(setting) not in found
        found[setting_name(setting)] = (setting.a, setting.b)
    return found


@pytest.mark.parametrize(("a", "b"), [("1", "1.0"), ("1", "true"), ("0.0", "-0.0"), (".nan", None)])
def test_values_that_python_takes_for_the_same(tmp_path: Path, a: str, b: str | None) -> None:
    runs = [recorded(tmp_path, JOB.replace("50.0", value)) for value in (a, b or a)]
    assert len(told(runs[0], runs[1])) == (b is not None)


def test_what_may_be_one_file_comes_last(tmp_path: Path) -> None:
    job = "nodes:\n  - node: m:Ekf\n    parameter_files: [{}]\n    parameters: {{rate: {}}}\n"
    jobs = tmp_path / "jobs"
    for name in ("config/p.yaml", "jobs/src/bot/config/p.yaml", "jobs/src/bot/config/q.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("/**: {ros__parameters: {size: 1}}\n")
    a = recorded(jobs, job.format("../config/p.yaml", 50.0))
    elsewhere = recorded(jobs, job.format("src/bot/config/p.yaml", 20.0))
    other = recorded(jobs, job.format("src/bot/config/q.yaml", 20.0))
    assert [one.key for one in job_settings(a, elsewhere)] == [  # type: ignore[arg-type]
        "nodes.0.parameters.rate",
        "nodes.0.parameter_files.0",
    ]
    assert job_settings(a, other)[0].key == "nodes.0.parameter_files.0"  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("seed=7", {"job: seed": ("0", "7")}),
        (
            "delay.topics./scan.drop=0.06",
            {"robot.yaml:9: delay.topics./scan.drop": ("0.05", "0.06")},
        ),
        (
            "delay.topics./scan.normal.sd=2500us",
            {"robot.yaml:9: delay.topics./scan.normal.sd": ("2 ms", "2.5 ms")},
        ),
        (
            "nodes.ekf.parameters.rate=20.0",
            {"robot.yaml:5: nodes.ekf.parameters.rate": ("50.0", "20.0")},
        ),
        (
            "nodes.1.parameters.size=3",
            {"robot.yaml:6: nodes.1.parameters.size": (None, "3")},
        ),
        (
            "stop.duration=20.000000001s",
            {"robot.yaml:10: stop.duration": ("20 s", "20.000000001 s")},
        ),
        (
            "nodes.ekf.parameters.frame='50.0'",
            {"robot.yaml:5: nodes.ekf.parameters.frame": ("odom", '"50.0"')},
        ),
        ("stop.events=9", {"robot.yaml:10: stop.events": (None, "9")}),
    ],
)
def test_an_override_is_one_setting(
    tmp_path: Path, override: str, said: dict[str, tuple[str | None, str | None]]
) -> None:
    a, b = recorded(tmp_path), recorded(tmp_path, JOB, override)
    assert told(a, b) == said
    assert told(b, a) == {key: values[::-1] for key, values in said.items()}
    # The keys are those of the option: given again, they make the other job of the first one.
    for key, (_, value) in said.items():
        name = key.rpartition(": ")[2]
        text = (value or "").replace(" ", "")
        assert told(recorded(tmp_path, JOB, f"{name}={text}"), b) == {}


def test_another_layout_of_the_same_job_is_no_difference(tmp_path: Path) -> None:
    other = JOB.replace("5ms", "0.005s").replace("# a robot\n", "\n\n") + "seed: 0\n"
    assert told(recorded(tmp_path), recorded(tmp_path, other)) == {}


def test_a_node_more_is_one_setting(tmp_path: Path) -> None:
    text = JOB.replace("nodes:\n", "nodes:\n  - {node: m:Camera, name: camera}\n")
    ((key, (a, b)),) = told(recorded(tmp_path), recorded(tmp_path, text)).items()
    assert key == "robot.yaml:3: nodes.camera"
    assert a is None
    assert json.loads(b or "") == {"name": "camera", "node": "m:Camera", "on_exception": "stop"}


def test_entries_that_changed_places_keep_their_settings(tmp_path: Path) -> None:
    first, second = (
        "  - node: m:Planner\n",
        JOB[JOB.index("  - node: m:Ekf") :].partition("  - node: m:P")[0],
    )
    swapped = JOB.replace(second + first, first + second)
    assert told(recorded(tmp_path), recorded(tmp_path, swapped)) == {
        "robot.yaml:2: nodes": ("ekf, m:Planner", "m:Planner, ekf")
    }
    told_of_both = told(recorded(tmp_path), recorded(tmp_path, swapped.replace("50.0", "20.0")))
    assert told_of_both["robot.yaml:5: nodes.ekf.parameters.rate"] == ("50.0", "20.0")
    assert len(told_of_both) == 2


def test_the_order_is_that_of_the_file(tmp_path: Path) -> None:
    options = ("stop.duration=3s", "seed=2", "nodes.ekf.parameters.frame=map")
    found = list(told(recorded(tmp_path), recorded(tmp_path, JOB, *options)))
    assert [key.partition(":")[2].partition(":")[0] for key in found] == ["5", "10", " seed"]


def test_a_key_that_only_one_version_knows_is_no_difference(tmp_path: Path) -> None:
    a, b = recorded(tmp_path), recorded(tmp_path)
    later = {**json.loads(b.job["resolved"]), "of_a_later_version": {"mode": "virtual"}}
    b.job["resolved"] = json.dumps(later)
    assert told(a, b) == {}
    b.job_text += "of_a_later_version: {mode: virtual}\n"
    assert told(a, b) == {
        f"robot.yaml:{b.job_text.count(chr(10))}: of_a_later_version": (None, '{"mode": "virtual"}')
    }


@pytest.mark.parametrize("resolved", ["", "{", "[]", "{}"])
def test_without_a_resolved_job_lines_are_compared(tmp_path: Path, resolved: str) -> None:
    a, b = recorded(tmp_path), recorded(tmp_path, JOB.replace("0.05", "0.06"))
    b.job["resolved"] = resolved
    ((key, (line_a, line_b)),) = told(a, b).items()
    assert key == "robot.yaml:9"
    assert line_a is not None
    assert line_b == line_a.replace("0.05", "0.06")


def test_lines_of_a_job_that_was_put_together_are_those_of_the_file_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    a = recorded(tmp_path, JOB, "stop.duration=3s")
    b = recorded(tmp_path, JOB.replace("0.05", "0.06"), "stop.duration=3s")
    before = told(a, b)
    ((place, values),) = before.items()
    assert place.startswith("robot.yaml:9: ")
    (tmp_path / "robot.yaml").write_text(JOB.replace("0.05", "0.07"))
    ((key, _),) = told(a, b).items()
    assert key == place.replace("robot.yaml:9", "job"), "it says neither of the values"
    (tmp_path / "robot.yaml").unlink()
    assert told(a, b) == {key: values}


def test_a_job_file_below_the_working_directory_goes_by_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("arm", "base"):
        Path(folder).mkdir()
    a, b = recorded(Path("arm")), recorded(Path("base"), JOB.replace("0.05", "0.06"))
    a.name, b.name = "arm/run.mcap", "base/run.mcap"
    assert list(told(a, b)) == ["arm/robot.yaml:9: delay.topics./scan.drop"]
    (tmp_path / "arm/robot.yaml").write_text(JOB.replace("0.05", "0.5"))
    assert list(told(a, b)) == ["robot.yaml:9: delay.topics./scan.drop"], "another job by now"


@pytest.mark.parametrize("text", ["", "a: [", "- 1\n- 2\n", "\x00", "&a [*a]", "nodes: 3\n"])
def test_a_damaged_job_file_has_no_lines(tmp_path: Path, text: str) -> None:
    a, b = recorded(tmp_path), recorded(tmp_path, JOB, "seed=7")
    a.job_text = text
    assert told(a, b) == {"job: seed": ("0", "7")}


NAMES = st.sampled_from(["rate", "frame", "/scan", "x_ns", "a.b", "0", "name"])
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-3, 3)
    | st.floats(width=16, allow_nan=False)
    | st.text(max_size=2),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=8,
)


@given(a=st.dictionaries(NAMES, VALUES, min_size=1), b=st.dictionaries(NAMES, VALUES, min_size=1))
def test_whatever_differs_is_told_and_nothing_else(a: Any, b: Any) -> None:
    """In values that their author chose; of the others, null is the same as absent."""
    sides = [
        Recorded("", {"resolved": json.dumps({"nodes": [{"parameters": values}]})})
        for values in (a, b)
    ]
    same = json.dumps(a, sort_keys=True) == json.dumps(b, sort_keys=True)
    found = job_settings(*sides)  # type: ignore[arg-type]
    assert bool(found) is not same
    assert all(setting.a != setting.b for setting in found)
    assert job_settings(sides[0], sides[0]) == ()  # type: ignore[arg-type]


@pytest.mark.parametrize("at", [0, 1])
def test_an_entry_that_is_added_is_not_taken_for_the_one_that_is_like_it(
    tmp_path: Path, at: int
) -> None:
    entry = "  - {{main: 'm:main', namespace: {}, parameters: {{gain: {}}}}}\n"
    a = recorded(tmp_path, "nodes:\n" + entry.format("/own", 1.0))
    entries = [entry.format("/own", 2.0)]
    entries.insert(at, entry.format("/new", 1.0))
    b = recorded(tmp_path, "nodes:\n" + "".join(entries))
    assert told(a, b).keys() == {
        "robot.yaml:2: nodes.0.parameters.gain",
        f"robot.yaml:{2 + at}: nodes.{at}",
    }
