"""A job from several files: what wins, where paths start, and whose line a mistake is shown in."""

from __future__ import annotations

import sys
from pathlib import Path
from textwrap import dedent

import pytest

from rsltrace.errors import JobError
from rsltrace.job import Job, job_from_text, load_job, locate


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(name: str, text: str) -> None:
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(dedent(text), encoding="utf-8")


def message(name: str = "job.yaml", *overrides: str) -> str:
    with pytest.raises(JobError) as caught:
        load_job(name, overrides=overrides)
    return str(caught.value)


def names(job: Job) -> list[str | None]:
    return [node.name for node in job.nodes]


BASE = """\
    nodes:
      - node: robot:Ekf
        name: ekf
        parameters: {rate: 50.0, noise: {x: 1.0, y: 2.0}}
        parameter_files: [p.yaml]
      - {node: robot:Planner, name: planner}
    bags: [bag]
    stop: {duration: 60s, events: 10}
    seed: 3
    """


@pytest.fixture
def base() -> None:
    write("robot/base.yaml", BASE)
    write("robot/p.yaml", "")
    Path("robot/bag").mkdir()


@pytest.mark.usefixtures("base")
def test_a_job_extends_another() -> None:
    write(
        "sim/job.yaml",
        """\
        base: ../robot/base.yaml
        nodes:
          - name: ekf
            parameters: {noise.y: 5.0, gain: 1}
          - {node: extra:Monitor}
        stop: {duration: null, quiescence: 1s}
        """,
    )
    job = load_job("sim/job.yaml")
    assert names(job) == ["ekf", "planner", None]
    assert job.nodes[0].parameters == {"rate": 50.0, "noise.x": 1.0, "noise.y": 5.0, "gain": 1}
    assert job.nodes[0].node == "robot:Ekf"
    assert (job.stop.duration_ns, job.stop.events, job.stop.quiescence_ns) == (None, 10, 10**9)
    assert job.seed == 3


@pytest.mark.usefixtures("base")
def test_paths_start_in_the_folder_of_the_file_they_stand_in(folder: Path) -> None:
    write("sim/job.yaml", "{base: ../robot/base.yaml, seed: 4}")
    job = load_job("sim/job.yaml")
    assert job.resolve(job.bags[0].path) == folder / "robot" / "bag"
    assert job.resolve(job.nodes[0].parameter_files[0]) == folder / "robot" / "p.yaml"
    # The modules of either file are found, this file's first.
    assert [job.resolve(path) for path in job.search_path] == [folder / "sim", folder / "robot"]
    assert job.resolved()["bags"][0]["path"] == "../robot/bag"
    Path("sim/again.yaml").write_text(job.source_text, encoding="utf-8")
    again = load_job("sim/again.yaml")
    assert again.resolved() == job.resolved()
    assert job.source_text.startswith(
        "# The effective job of job.yaml\n#   with ../robot/base.yaml\n"
    )


@pytest.mark.usefixtures("base")
def test_a_node_of_the_base_can_be_taken_away() -> None:
    write("job.yaml", "{base: robot/base.yaml, nodes: [{name: planner, node: null}]}")
    assert names(load_job("job.yaml")) == ["ekf"]


@pytest.mark.usefixtures("base")
def test_nodes_and_bags_of_included_files_are_added() -> None:
    write("more.yaml", "{nodes: [{node: m:A, name: a}], seed: 9}")
    write("job.yaml", "{include: [robot/base.yaml, more.yaml], nodes: [{node: m:B, name: b}]}")
    job = load_job("job.yaml")
    assert names(job) == ["ekf", "planner", "a", "b"]
    assert job.seed == 9
    assert len(job.bags) == 1


def test_a_file_may_extend_and_include_at_once() -> None:
    write("base.yaml", "{nodes: [{node: m:A, name: a}], seed: 1}")
    write("more.yaml", "{nodes: [{node: m:B, name: b}], seed: 2, livelock_limit: 7}")
    write("job.yaml", "{base: base.yaml, include: more.yaml, nodes: [{name: a, namespace: /x}]}")
    job = load_job("job.yaml")
    assert [(n.name, n.namespace) for n in job.nodes] == [("a", "/x"), ("b", None)]
    assert (job.seed, job.livelock_limit) == (2, 7)


def test_a_mistake_in_an_included_file_is_shown_there() -> None:
    write("parts/more.yaml", "nodes:\n  - node: m:A\n    nmae: a\n")
    write("job.yaml", "include: parts/more.yaml\nseed: -1\n")
    assert message() == dedent(
        """\
        job.yaml:2:7: seed: must be at least 0, got -1
            2 | seed: -1
              |       ^
        parts/more.yaml:3:5: unknown key 'nmae' in nodes[0]; did you mean 'name'?
            3 |     nmae: a
              |     ^"""
    )
    assert load_job_ok_location() == "parts/fine.yaml:1:18"


def load_job_ok_location() -> str:
    write("parts/fine.yaml", "nodes: [ { node: m:A } ]")
    write("other.yaml", "include: parts/fine.yaml")
    return locate(load_job("other.yaml"), ("nodes", 0, "node"))


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (
            {"job.yaml": "base: a.yaml\n", "a.yaml": "base: b.yaml\n", "b.yaml": "base: a.yaml\n"},
            "b.yaml:1:7: base: a.yaml leads back to itself: no file can be made of itself\n"
            "    1 | base: a.yaml\n      |       ^",
        ),
        (
            {"job.yaml": "include: [nowhere.yaml]\n"},
            "job.yaml:1:11: include: nowhere.yaml: there is no such job file\n"
            "    1 | include: [nowhere.yaml]\n      |           ^",
        ),
        (
            {"job.yaml": "base: [a.yaml]\n"},
            "job.yaml:1:7: base: expected a path, got a list\n"
            "    1 | base: [a.yaml]\n      |       ^",
        ),
        (
            {"job.yaml": "base: a.yaml\nnodes: [{name: b}]\n", "a.yaml": "nodes: [{node: m:A}]"},
            "job.yaml:2:16: no node of the other files is named 'b', to be changed here: none of "
            "them has a name (a new node needs 'node:', one of several a 'namespace:')\n"
            "    2 | nodes: [{name: b}]\n      |                ^",
        ),
    ],
)
def test_what_cannot_be_put_together(files: dict[str, str], expected: str) -> None:
    for name, text in files.items():
        write(name, text)
    assert message() == expected


# --- $(...) ---------------------------------------------------------------------------------------


def test_values_are_filled_in(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setenv("RATE", "20.5")
    monkeypatch.delenv("MISSING", raising=False)
    write(
        "job.yaml",
        """\
        vars: {robot: husky, size: 3, where: src, full: "$(var robot)_$(var size)"}
        nodes:
          - node: m:N
            name: $(var full)
            parameters:
              rate: $(env RATE)
              text: "$(env RATE)"
              other: $(env MISSING 7)
              folder: $(dirname)/maps
              plain: \\$(dirname)
              share: $(find-pkg-share std_msgs)
              source: $(find-pkg-share not_built)/config
        search_path: [$(var where)]
        seed: $(var size)
        """,
    )
    write("src/group/not_built/package.xml", "<package><name>not_built</name></package>")
    job = load_job("job.yaml", overrides=["vars.size=4"])
    node = job.nodes[0]
    assert node.name == "husky_4"
    assert node.parameters == {
        "rate": 20.5,
        "text": "20.5",
        "other": 7,
        "folder": f"{folder}/maps",
        "plain": "$(dirname)",
        "share": str(Path(sys.prefix, "share", "std_msgs")),
        "source": f"{folder}/src/group/not_built/config",
    }
    assert job.seed == 4
    assert "$(" not in job.source_text.replace("plain: \\$(dirname)", "")


@pytest.mark.parametrize(
    ("value", "column", "expected"),
    [
        (
            "$(env NOT_SET_HERE)",
            7,
            "the environment variable NOT_SET_HERE is not set: set it, or "
            "give a default, $(env NOT_SET_HERE default)",
        ),
        (
            "'a$(evn HOME)'",
            9,
            "$(evn HOME) is no substitution; did you mean $(env NAME "
            "[default])? (for plain text write \\$( )",
        ),
        ("$(var robto)", 7, "there is no variable 'robto': did you mean 'robot'?"),
        ("$(var a)", 7, None),
        (
            "$(find-pkg-share no_such_package)",
            7,
            "there is no ROS package 'no_such_package' in "
            f"AMENT_PREFIX_PATH, {sys.prefix} or the search_path: install it, source the workspace "
            "that has it, or add its folder to search_path",
        ),
        (
            "$(env",
            7,
            "'$(env' has no closing parenthesis (a ',' or ': ' in it may have ended the value: "
            "quote it then)",
        ),
        ("$(dirname x)", 7, "expected $(dirname), got $(dirname x)"),
        (
            "$(command date)",
            7,
            "$(command date): a job does not run commands: put the result into "
            "an environment variable, $(env …)",
        ),
    ],
)
def test_what_cannot_be_filled_in(
    value: str, column: int, expected: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NOT_SET_HERE", raising=False)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    write("job.yaml", f"nodes: [{{node: m:N}}]\nseed: {value}\nvars: {{robot: x, a: $(var a)}}\n")
    text = message()
    if expected is None:
        assert "the variables refer to each other: a -> a" in text
    else:
        assert text.splitlines()[0] == f"job.yaml:2:{column}: {expected}"


# --- --set ----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("base")
def test_every_key_can_be_set(folder: Path) -> None:
    write("job.yaml", "{base: robot/base.yaml}")
    Path("other_bag").mkdir()
    job = load_job(
        "job.yaml",
        overrides=[
            "nodes.0.parameters.noise.x=7.5",
            "nodes.ekf.parameters.new.deep=[1, 2]",
            "nodes.planner.remappings./scan=/scan2",
            "nodes[1].on_exception=log",
            "nodes.+={node: m:New}",
            "bags.bag.start_offset=5ms",
            "bags.+=other_bag",
            "stop.topic=/done",
            "stop.topic.exit_code=data",
            "stop.events=null",
            "seed=null",
        ],
    )
    assert job.nodes[0].parameters == {
        "rate": 50.0,
        "noise.x": 7.5,
        "noise.y": 2.0,
        "new.deep": (1, 2),
    }
    assert job.nodes[1].remappings == {"/scan": "/scan2"}
    assert job.nodes[1].on_exception == "log"
    assert job.nodes[2].node == "m:New"
    assert job.bags[0].start_offset_ns == 5_000_000
    assert job.resolve(job.bags[1].path) == folder / "other_bag"
    assert job.stop.topic is not None
    assert job.stop.topic.exit_code == "data"
    assert (job.stop.events, job.seed) == (None, 0)


@pytest.mark.parametrize(
    ("entry", "name"),
    [
        ("node: m:TrackMonitor", "track_monitor"),
        ("node: m:TrackMonitor", "TrackMonitor"),
        ("script: job/test_compose.py", "test_compose"),
        ("module: wave", "wave"),
        ("main: m:run", "run"),
    ],
)
def test_an_entry_is_called_as_its_node_or_program(entry: str, name: str) -> None:
    text = f"nodes: [{{{entry}}}, {{node: m:Other}}]"
    job = job_from_text(
        text, "job.yaml", Path(__file__).parents[1], overrides=[f"nodes.{name}.parameters.rate=5"]
    )
    assert [node.parameters for node in job.nodes] == [{"rate": 5}, {}]


@pytest.mark.usefixtures("base")
@pytest.mark.parametrize(
    ("override", "column", "expected"),
    [
        ("seed=x", 6, "seed: expected an integer, got text 'x'"),
        ("sede=1", 1, "unknown key 'sede'; did you mean 'seed'?"),
        (
            "stop.duration=5parsec",
            15,
            "stop.duration: unknown unit 'parsec' in '5parsec'; units are ns, us, ms, s, min, h",
        ),
        ("nodes.5.name=a", 7, "nodes has no entry 5: it has 0 to 1, and + is a new one"),
        ("nodes.efk.name=a", 7, "nodes has no entry 'efk': did you mean 'ekf'?"),
        (
            "seed",
            5,
            "expected key=value, as in --set stop.duration=10s, --set nodes.0.parameters.rate=20.0",
        ),
        ("seed.x=1", 6, "seed is the number 3: there is nothing below it to set"),
        ("stop={duration: 1s", 19, None),
        ("timer_ties=null", 1, "no value is given, and timer_ties has none to take away"),
        ("stop.events=", 12, "there is no value after '=': null takes the key away"),
        (
            "record.topics.0=/a",
            15,
            "record.topics has no entries yet: write record.topics.+ for a new one",
        ),
        ("bags.0.path=nowhere", 13, "bags[0].path: 'nowhere': there is no such bag"),
    ],
)
def test_a_mistake_in_an_override_is_shown_in_it(
    override: str, column: int, expected: str | None
) -> None:
    write("job.yaml", "{base: robot/base.yaml}")
    text = message("job.yaml", override)
    first, line, caret = text.split("\n")
    if expected is not None:
        assert first == f"--set: {expected}"
    assert line == f"      | {override}"
    assert caret == f"      | {' ' * (column - 1)}^"


CHOICES = """\
nodes: [{node: m:N}]
delay:
  default: 5ms
  topics:
    /a: {constant: 1ms, drop: 0.1}
    /b: {lognormal: {mean: 5ms, sd: 2ms}}
    /c: {samples: {file: s.txt, unit: ms}, keep_order: false}
policy: rate_monotonic
"""


def test_another_distribution_or_policy_takes_the_place_of_the_bases() -> None:
    write("s.txt", "1")
    write("base.yaml", CHOICES)
    change = """\
        base: base.yaml
        delay:
          default: {drop: 0.2}
          topics:
            /a: {uniform: {min: 1ms, max: 2ms}}
            /b: {lognormal: {median: 5ms, sigma: 0.5}}
            /c: {samples: {values: [1ms]}}
        policy: {priority: [{node: /a, priority: 1}]}
        """
    write("job.yaml", change)
    overrides = [
        "delay.default.drop=0.2",
        "delay.topics./a.uniform={min: 1ms, max: 2ms}",
        "delay.topics./b.lognormal.median=5ms",
        "delay.topics./b.lognormal.sigma=0.5",
        "delay.topics./c.samples.values=[1ms]",
        "policy.priority=[{node: /a, priority: 1}]",
    ]
    for job in (load_job("job.yaml"), load_job("base.yaml", overrides=overrides)):
        resolved = job.resolved()
        delay, topics = resolved["delay"]["default"], resolved["delay"]["topics"]
        assert (delay["constant_ns"], delay["drop"]) == (5_000_000, 0.2)
        assert topics["/a"]["constant_ns"] is None
        assert topics["/a"]["uniform"] == {"min_ns": 1_000_000, "max_ns": 2_000_000}
        assert topics["/a"]["drop"] == 0.1
        assert topics["/b"]["lognormal"]["mean_ns"] is None
        assert topics["/c"]["samples"]["file"] is None
        assert topics["/c"]["keep_order"] is False
        assert resolved["policy"]["order"] is None


def test_keys_that_begin_with_x_hold_what_anchors_refer_to() -> None:
    text = """\
        x-common: &common {rate: 20.0}
        nodes:
          - node: m:N
            parameters: {<<: *common, gain: 1.0}
        """
    write("base.yaml", text)
    write("job.yaml", "base: base.yaml\nx-mine: 3\n")
    (node,) = load_job("job.yaml").nodes
    assert node.parameters == {"rate": 20.0, "gain": 1.0}
    assert "x-" not in load_job("job.yaml").to_yaml()
    write("job.yaml", "x_common: 3\nbase: base.yaml\n")
    assert "unknown key 'x_common'" in message()


def test_a_delay_of_one_topic_from_the_command_line() -> None:
    write("job.yaml", "{nodes: [{node: m:N}], delay: {topics: {/odom: 1ms}}}")
    overrides = ["delay.topics./scan.constant=5ms", "delay.topics./odom.drop=0.5"]
    resolved = load_job("job.yaml", overrides=overrides).resolved()["delay"]["topics"]
    assert resolved["/scan"]["constant_ns"] == 5_000_000
    assert (resolved["/odom"]["constant_ns"], resolved["/odom"]["drop"]) == (1_000_000, 0.5)
