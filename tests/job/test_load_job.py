"""A job file loads as written, and every mistake in one is shown where it was made.

The messages are compared whole: they are what a person reads, so a change of one is a decision.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import pytest

import rsltrace.errors
from rsltrace.errors import JobError
from rsltrace.job import BagSpec, Job, NodeSpec, RecordSpec, StopSpec, TopicStop, load_job

ROOT = Path(rsltrace.errors.__file__).parents[1]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Run in an empty folder, so that messages name ``job.yaml`` alone."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def load(text: str) -> Job:
    Path("job.yaml").write_text(dedent(text), encoding="utf-8")
    return load_job("job.yaml")


def message(text: str) -> str:
    with pytest.raises(JobError) as caught:
        load(text)
    assert str(caught.value).startswith(f"{caught.value.where}: ")
    return str(caught.value)


def shown(text: str) -> str:
    return dedent(text).strip("\n")


def test_every_key_of_a_job_file_is_read(folder: Path) -> None:
    (folder / "src").mkdir()
    (folder / "bag").mkdir()
    (folder / "params.yaml").write_text("", encoding="utf-8")
    job = load(
        """\
        nodes:
          - node: my_nodes:Talker
            name: talker
            namespace: /robot1
            parameters: {rate: 10.0, gains: [1.0, 2.0], nested: {a: 1}}
            parameter_files: [params.yaml]
            remappings: {chatter: /robot1/chatter}
            arguments: {size: 3, ratio: 0.5, deep: [{x: null}]}
        search_path: [., src]
        start: 10s
        construct_time: 0s
        stop:
          duration: 100s
          time: 110s
          events: 100000
          topic: {name: /done, exit_code: data}
          function: my_nodes:finished
          quiescence: 2s
        seed: 7
        timer_ties: heap
        livelock_limit: 5
        bags:
          - path: bag
            topics: [/imu/*]
            exclude: [/tf]
            start_offset: 5s
          - bag
        record:
          payloads: false
          topics: ["/a*"]
          exclude: [/camera/*]
        """
    )
    assert job.with_values(given_text=None) == Job(
        nodes=[
            NodeSpec(
                node="my_nodes:Talker",
                name="talker",
                namespace="/robot1",
                parameters={"rate": 10.0, "gains": (1.0, 2.0), "nested.a": 1},
                parameter_files=("params.yaml",),
                remappings={"chatter": "/robot1/chatter"},
                arguments={"size": 3, "ratio": 0.5, "deep": [{"x": None}]},
            )
        ],
        search_path=(".", "src"),
        start_ns=10_000_000_000,
        construct_time_ns=0,
        stop=StopSpec(
            duration_ns=100_000_000_000,
            time_ns=110_000_000_000,
            events=100_000,
            topic=TopicStop(name="/done", exit_code="data"),
            function="my_nodes:finished",
            quiescence_ns=2_000_000_000,
        ),
        seed=7,
        timer_ties="heap",
        livelock_limit=5,
        bags=[
            BagSpec(
                path="bag", topics=("/imu/*",), exclude=("/tf",), start_offset_ns=5_000_000_000
            ),
            BagSpec(path="bag"),
        ],
        record=RecordSpec(payloads=False, topics=("/a*",), exclude=("/camera/*",)),
        base_dir=folder,
        source_name="job.yaml",
    )
    assert type(job.nodes[0].arguments["ratio"]) is float
    assert job.base_dir == folder
    assert job.resolve("src") == folder / "src"


def test_what_is_left_out_has_its_documented_default() -> None:
    job = load("nodes: [{node: m:N}]")
    assert (job.start_ns, job.construct_time_ns) == (None, None)
    assert (job.seed, job.timer_ties, job.livelock_limit) == (0, "creation", 100_000)
    assert (job.search_path, job.bags, job.stop) == ((".",), (), StopSpec())
    assert job.record == RecordSpec(payloads=True, topics=("*",), exclude=())
    assert job.source_text == "nodes: [{node: m:N}]"


def test_a_topic_as_text_is_short_for_its_name() -> None:
    job = load("{nodes: [{node: m:N}], stop: {topic: /done}}")
    assert job.stop.topic == TopicStop(name="/done")


def test_paths_are_relative_to_the_job_file_not_to_the_current_folder(folder: Path) -> None:
    (folder / "jobs").mkdir()
    (folder / "jobs" / "p.yaml").touch()
    (folder / "jobs" / "job.yaml").write_text(
        "nodes: [{node: m:N, parameter_files: [p.yaml]}]", encoding="utf-8"
    )
    job = load_job("jobs/job.yaml")
    assert job.resolve("p.yaml") == folder / "jobs" / "p.yaml"


def test_anchors_and_merge_keys_work() -> None:
    job = load(
        """\
        nodes:
          - &base
            node: m:N
            name: one
            parameters: &p {a: 1}
          - {<<: *base, name: two}
          - {<<: [{name: three}, *base], parameters: {<<: *p, b: 2}}
        """
    )
    assert [node.name for node in job.nodes] == ["one", "two", "three"]
    assert job.nodes[2].parameters == {"b": 2, "a": 1}


def test_a_byte_order_mark_and_windows_line_ends_are_fine() -> None:
    Path("job.yaml").write_bytes(b"\xef\xbb\xbfnodes:\r\n  - node: m:N\r\nseed: x\r\n")
    with pytest.raises(JobError) as caught:
        load_job("job.yaml")
    assert caught.value.where == "job.yaml:3:7"


def test_loading_imports_no_ros_no_numpy_and_no_user_code(folder: Path) -> None:
    (folder / "user_nodes.py").write_text("raise SystemExit('imported')", encoding="utf-8")
    (folder / "job.yaml").write_text("nodes: [{node: user_nodes:N}]", encoding="utf-8")
    code = (
        f"import sys; sys.path[:0] = ['.', {str(ROOT)!r}]\n"
        "from rsltrace.job import load_job\n"
        "load_job('job.yaml').resolved()\n"
        "bad = {'rclpy', 'numpy', 'rosbags', 'mcap', 'user_nodes'} & set(sys.modules)\n"
        "sys.exit(', '.join(sorted(bad)) or 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=folder)


def test_times_are_read_without_pydantic() -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n"
        "from rsltrace.job.values.times import parse_time\n"
        "sys.exit('pydantic' in sys.modules or parse_time('5ms') != 5_000_000)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# --- files that are no jobs -----------------------------------------------------------------------


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(JobError) as caught:
        load_job("nowhere/job.yaml")
    assert str(caught.value) == "nowhere/job.yaml: there is no such job file"
    (tmp_path / "robot.yaml").touch()
    with pytest.raises(JobError) as caught:
        load_job(tmp_path / "robot.yml")
    assert str(caught.value).endswith(f"; did you mean '{tmp_path}/robot.yaml'?")
    with pytest.raises(JobError) as caught:
        load_job("nowhere/run.mcap")
    assert str(caught.value) == "nowhere/run.mcap: there is no such trace"


def test_a_folder(folder: Path) -> None:
    (folder / "jobs").mkdir()
    with pytest.raises(JobError) as caught:
        load_job("jobs")
    assert str(caught.value) == "jobs: this is a folder; name a job file"
    (folder / "jobs" / "job.yaml").touch()
    with pytest.raises(JobError) as caught:
        load_job("jobs")
    assert str(caught.value) == "jobs: this is a folder; name the job file in it: jobs/job.yaml"


def test_not_utf8() -> None:
    Path("job.yaml").write_bytes("nodes:\n  - node: mü:N\n".encode("latin-1"))
    with pytest.raises(JobError) as caught:
        load_job("job.yaml")
    assert str(caught.value) == (
        "job.yaml:2:12: not UTF-8: byte 0xfc; save the file as UTF-8 text\n"
        "    2 |   - node: m\ufffd:N\n"
        "      |            ^"
    )
    Path("job.yaml").write_bytes("seed: 7\n".encode("utf-16"))
    with pytest.raises(JobError) as caught:
        load_job("job.yaml")
    assert str(caught.value) == "job.yaml: this is UTF-16; save the file as UTF-8 text"


@pytest.mark.parametrize("text", ["", "# only a comment\n", "---\n"])
def test_an_empty_file(text: str) -> None:
    assert message(text) == (
        "job.yaml: the job file is empty: it needs at least 'nodes:' or 'bags:'"
    )


def test_a_file_too_large_to_be_a_job() -> None:
    Path("job.yaml").write_bytes(b" " * ((1 << 20) + 1))
    with pytest.raises(JobError, match="larger than 1 MiB: this is not a job file"):
        load_job("job.yaml")


def test_a_line_too_long_for_a_job() -> None:
    """A comment of 3 MB kept the parser busy for more than twenty seconds."""
    Path("job.yaml").write_bytes(b"nodes: []\n#" + b"x" * (256 << 10))
    with pytest.raises(JobError, match=r"job\.yaml:2: a line of more than 256 KiB: this is not"):
        load_job("job.yaml")


GOLDEN = {
    "a list": (
        """\
        - node: my_nodes:Talker
        """,
        """
        job.yaml:1:1: a job is a mapping (nodes: ..., stop: ...)
            1 | - node: my_nodes:Talker
              | ^
        """,
    ),
    "syntax": (
        """\
        nodes:
          - node: my_nodes:Talker
           name: talker
        """,
        """
        job.yaml:3:4: not YAML: check the indentation: this does not line up with what is above (expected <block end>, but found '<block mapping start>', while parsing a block collection that began in line 2)
            3 |    name: talker
              |    ^
        """,  # noqa: E501
    ),
    "a colon in a text": (
        "nodes:\n  - node: m:N\n    name: a: b\n",
        """
        job.yaml:3:12: not YAML: check the indentation, or quote a text with ': ' in it (mapping values are not allowed here)
            3 |     name: a: b
              |            ^
        """,  # noqa: E501
    ),
    "quotes in quotes": (
        'nodes: [{node: m:N}]\nchecks:\n  - never: "/a: data > "a""\n',
        """
        job.yaml:3:25: not YAML: put a text that has quotes in it in single quotes: '…' (expected <block end>, but found '<scalar>')
            3 |   - never: "/a: data > "a""
              |                         ^
        """,  # noqa: E501
    ),
    "unclosed quote": (
        'nodes: [{node: "m:N}]\nseed: 1\n',
        """
        job.yaml:1:16: not YAML: a quote is not closed (found unexpected end of stream, while scanning a quoted scalar that begins here)
            1 | nodes: [{node: "m:N}]
              |                ^
        """,  # noqa: E501
    ),
    "unclosed bracket": (
        """\
        nodes: [{node: my_nodes:Talker}
        seed: 3
        """,
        """
        job.yaml:1:8: not YAML: a bracket is not closed, or a comma is missing (expected ',' or ']', but got '<scalar>' in line 2, while parsing a flow sequence that begins here)
            1 | nodes: [{node: my_nodes:Talker}
              |        ^
        """,  # noqa: E501
    ),
    "tab": (
        "nodes:\n\t- node: m:N\n",
        """
        job.yaml:2:1: not YAML: indent with spaces, not tabs (found character '\\t' that cannot start any token)
            2 | \t- node: m:N
              | ^
        """,  # noqa: E501
    ),
    "control character": (
        "nodes:\n  - node: m:\x01N\n",
        """
        job.yaml:2:13: special characters are not allowed: '\\x01'
            2 |   - node: m:\ufffdN
              |             ^
        """,
    ),
    "two documents": (
        "nodes: [{node: m:N}]\n---\nseed: 1\n",
        """
        job.yaml:2:1: not YAML: a job file holds one document, without '---' in between (but found another document, expected a single document in the stream that began in line 1)
            2 | ---
              | ^
        """,  # noqa: E501
    ),
    "duplicate key": (
        """\
        nodes:
          - node: my_nodes:Talker
            name: a
            name: b
        """,
        """
        job.yaml:4:5: the key 'name' is given twice, first in line 3
            4 |     name: b
              |     ^
        """,
    ),
    "tag": (
        "nodes: [{node: !!python/name:os.system m:N}]\n",
        """
        job.yaml:1:16: the YAML tag !!python/name:os.system has no meaning in a job: quote a text that begins with '!'
            1 | nodes: [{node: !!python/name:os.system m:N}]
              |                ^
        """,  # noqa: E501
    ),
    "undefined alias": (
        "nodes: *all\n",
        """
        job.yaml:1:8: not YAML: quote a text that begins with '*' (found undefined alias 'all')
            1 | nodes: *all
              |        ^
        """,
    ),
    "alias of itself": (
        "nodes: &all [*all]\n",
        """
        job.yaml:1:8: an alias refers to a value that contains it
            1 | nodes: &all [*all]
              |        ^
        """,
    ),
    "unknown key in a node": (
        """\
        nodes:
          - node: my_nodes:Talker
            parametrs: {rate: 10.0}
        """,
        """
        job.yaml:3:5: unknown key 'parametrs' in nodes[0]; did you mean 'parameters'?
            3 |     parametrs: {rate: 10.0}
              |     ^
        """,
    ),
    "unknown key, nothing near": (
        """\
        nodes: [{node: m:N}]
        stop: {foo: 1}
        """,
        """
        job.yaml:2:8: unknown key 'foo' in stop; valid keys are duration, time, timeout, events, topic, function, quiescence, size
            2 | stop: {foo: 1}
              |        ^
        """,  # noqa: E501
    ),
    "unknown key at the top": (
        "nodes: [{node: m:N}]\nnode: 1\n",
        """
        job.yaml:2:1: unknown key 'node'; did you mean 'nodes'?
            2 | node: 1
              | ^
        """,
    ),
    "names from Python are not keys": (
        "nodes: [{node: m:N}]\nbase_dir: /\nstop: {duration_ns: 5}\n",
        """
        job.yaml:2:1: unknown key 'base_dir'; did you mean 'base'?
            2 | base_dir: /
              | ^
        job.yaml:3:8: unknown key 'duration_ns' in stop; did you mean 'duration'?
            3 | stop: {duration_ns: 5}
              |        ^
        """,
    ),
    "node missing": (
        """\
        nodes:
          - name: talker
        """,
        """
        job.yaml:2:5: nodes[0]: missing key: give one of 'node', 'main', 'executable', 'script', 'module', 'program' and 'component'
            2 |   - name: talker
              |     ^
        """,  # noqa: E501
    ),
    "two kinds of entry at once, and arguments of the wrong kind": (
        """\
        nodes:
          - node: m:N
            main: m:main
          - main: m:main
            arguments: {rate: 1}
          - node: m:N
            arguments: [--rate, 1]
          - executable: talker
        """,
        """
        job.yaml:3:5: nodes[0]: 'node' says what to run already: give only one of 'node', 'main', 'executable', 'script', 'module', 'program' and 'component'
            3 |     main: m:main
              |     ^
        job.yaml:5:16: nodes[1].arguments: 'main' takes a list of command-line words: arguments: [--rate, 10]
            5 |     arguments: {rate: 1}
              |                ^
        job.yaml:7:16: nodes[2].arguments: a node takes arguments by name (a mapping); a list of command-line words is for 'main', 'executable', 'script', 'module', 'program'
            7 |     arguments: [--rate, 1]
              |                ^
        job.yaml:8:17: nodes[3].executable: expected package/executable (as ros2 run has them), got 'talker'
            8 |   - executable: talker
              |                 ^
        """,  # noqa: E501
    ),
    "nothing to run": (
        "seed: 1\n",
        """
        job.yaml:1:1: a job needs at least one node (nodes:), launch file (launch:) or bag (bags:)
            1 | seed: 1
              | ^
        """,
    ),
    "no nodes in the list": (
        "seed: 1\nnodes: []\n",
        """
        job.yaml:2:8: nodes: a job needs at least one node (nodes:), launch file (launch:) or bag (bags:)
            2 | nodes: []
              |        ^
        """,  # noqa: E501
    ),
    "nodes without a value": (
        "seed: 1\nnodes:\n\nbags:\n",
        """
        job.yaml:2:1: nodes: no value is given: give one, or leave the key out
            2 | nodes:
              | ^
        job.yaml:4:1: bags: no value is given: give one, or leave the key out
            4 | bags:
              | ^
        """,
    ),
    "a node as text": (
        "nodes: [my_nodes:Talker]\n",
        """
        job.yaml:1:9: nodes[0]: expected a mapping, got text 'my_nodes:Talker'; its keys are node, main, executable, script, module, program, component, container, extra_arguments, isolated, environment, working_directory, respawn, instant_sleep, intra_process, required, name, namespace, parameters, parameter_files, remappings, arguments, on_exception, guard, start_after, stdin; write {node: my_nodes:Talker}
            1 | nodes: [my_nodes:Talker]
              |         ^
        """,  # noqa: E501
    ),
    "wrong types": (
        """\
        nodes: [{node: m:N}]
        seed: true
        livelock_limit: 0
        timer_ties: stack
        stop: 10s
        record: {payloads: "yes"}
        """,
        """
        job.yaml:2:7: seed: expected an integer, got true
            2 | seed: true
              |       ^
        job.yaml:3:17: livelock_limit: must be at least 1, got 0
            3 | livelock_limit: 0
              |                 ^
        job.yaml:4:13: timer_ties: expected creation or heap, got text 'stack'
            4 | timer_ties: stack
              |             ^
        job.yaml:5:7: stop: expected a mapping, got text '10s'; its keys are duration, time, timeout, events, topic, function, quiescence, size; write {duration: 10s}
            5 | stop: 10s
              |       ^
        job.yaml:6:20: record.payloads: expected true or false, got text 'yes'; write true
            6 | record: {payloads: "yes"}
              |                    ^
        """,  # noqa: E501
    ),
    "a float for an integer": (
        "nodes: [{node: m:N}]\nstop: {events: 1e5}\n",
        """
        job.yaml:2:16: stop.events: expected an integer, got the number 1e5; write 100000
            2 | stop: {events: 1e5}
              |                ^
        """,
    ),
    "a negative seed": (
        "nodes: [{node: m:N}]\nseed: -1\n",
        """
        job.yaml:2:7: seed: must be at least 0, got -1
            2 | seed: -1
              |       ^
        """,
    ),
    "times": (
        """\
        nodes: [{node: m:N}]
        start: -1
        construct_time: ten
        stop:
          duration: 1.0000000001
          time: "10"
          quiescence: 0s
        """,
        """
        job.yaml:2:8: start: a time must not be negative, got -1
            2 | start: -1
              |        ^
        job.yaml:3:17: construct_time: expected a time: seconds as a number, or a number with a unit (ns, us, ms, s, min, h), got 'ten'
            3 | construct_time: ten
              |                 ^
        job.yaml:5:13: stop.duration: 1.0000000001 is finer than a nanosecond, the resolution of simulated time
            5 |   duration: 1.0000000001
              |             ^
        job.yaml:6:9: stop.time: '10' has no unit: write '10s' for seconds
            6 |   time: "10"
              |         ^
        job.yaml:7:15: stop.quiescence: must be more than 0
            7 |   quiescence: 0s
              |               ^
        """,  # noqa: E501
    ),
    "times out of order": (
        """\
        nodes: [{node: m:N}]
        start: 10s
        construct_time: 11s
        stop: {time: 9.5}
        """,
        """
        job.yaml:3:17: construct_time: 11s is after the start (10s): nodes are constructed before the run starts
            3 | construct_time: 11s
              |                 ^
        job.yaml:4:14: stop.time: 9.5s is before the start (10s): it is a simulated time; 'duration' counts from the start
            4 | stop: {time: 9.5}
              |              ^
        """,  # noqa: E501
    ),
    "names": (
        """\
        nodes:
          - node: my_nodes.Talker
            name: 2nd
            namespace: robot
          - node: m:N
            namespace: /a//b
            remappings: {chatter: "a b", "/*": x, __ns: /x}
            arguments: {not-a-name: 1}
        stop:
          topic: {name: done, exit_code: data.}
          function: finished
        """,
        """
        job.yaml:2:11: nodes[0].node: expected module:Class or module:function, got 'my_nodes.Talker'; write my_nodes:Talker
            2 |   - node: my_nodes.Talker
              |           ^
        job.yaml:3:11: nodes[0].name: '2nd' is not a node name: use letters, digits and '_', not starting with a digit
            3 |     name: 2nd
              |           ^
        job.yaml:4:16: nodes[0].namespace: a namespace starts with '/': write '/robot'
            4 |     namespace: robot
              |                ^
        job.yaml:6:16: nodes[1].namespace: '/a//b' is not a namespace: parts of letters, digits and '_', none starting with a digit, after one '/' each and with none at the end
            6 |     namespace: /a//b
              |                ^
        job.yaml:7:27: nodes[1].remappings.chatter: rcl cannot remap to 'a b': write a topic or service name such as chatter, /robot/chatter or ~/chatter (no wildcards, no '__', no '/' at the end)
            7 |     remappings: {chatter: "a b", "/*": x, __ns: /x}
              |                           ^
        job.yaml:7:34: nodes[1].remappings: rcl cannot remap '/*': write a topic or service name such as chatter, /robot/chatter or ~/chatter (no wildcards, no '__')
            7 |     remappings: {chatter: "a b", "/*": x, __ns: /x}
              |                                  ^
        job.yaml:7:43: nodes[1].remappings: __ns is not a topic or service: use the node's 'namespace:' instead
            7 |     remappings: {chatter: "a b", "/*": x, __ns: /x}
              |                                           ^
        job.yaml:8:17: nodes[1].arguments: 'not-a-name' cannot be the name of an argument
            8 |     arguments: {not-a-name: 1}
              |                 ^
        job.yaml:10:17: stop.topic.name: a topic is named in full, from '/': write '/done'
           10 |   topic: {name: done, exit_code: data.}
              |                 ^
        job.yaml:10:34: stop.topic.exit_code: 'data.' is not a field: write its name, or a path such as status.code
           10 |   topic: {name: done, exit_code: data.}
              |                                  ^
        job.yaml:11:13: stop.function: expected module:Class or module:function, got 'finished'
           11 |   function: finished
              |             ^
        """,  # noqa: E501
    ),
    "parameters": (
        """\
        nodes:
          - node: m:N
            parameters:
              gains: [1.0, 2]
              flags: [true, 1]
              big: 9223372036854775808
              nested: {a: , b: [[1]]}
              nested.a: 1
              3: x
              a..b: 1
              words: [a, null]
              pairs: [{a: 1}]
        """,
        """
        job.yaml:4:20: nodes[0].parameters.gains[1]: element 1 is an integer, element 0 is a float: rcl takes lists of one type; write the integers with a decimal point
            4 |       gains: [1.0, 2]
              |                    ^
        job.yaml:5:21: nodes[0].parameters.flags[1]: element 1 is an integer, element 0 is a bool: rcl takes lists of one type
            5 |       flags: [true, 1]
              |                     ^
        job.yaml:6:12: nodes[0].parameters.big: 9223372036854775808 does not fit a ROS integer (64 bits, signed)
            6 |       big: 9223372036854775808
              |            ^
        job.yaml:7:16: nodes[0].parameters.nested.a: no value is given, and a ROS parameter cannot be null
            7 |       nested: {a: , b: [[1]]}
              |                ^
        job.yaml:7:25: nodes[0].parameters.nested.b[0]: a ROS parameter is true or false, a number, text, or a list of these; got a list
            7 |       nested: {a: , b: [[1]]}
              |                         ^
        job.yaml:9:7: nodes[0].parameters: a parameter's name is text, got the number 3
            9 |       3: x
              |       ^
        job.yaml:10:7: nodes[0].parameters: 'a..b' is not a parameter name: a part before or after a '.' is empty
           10 |       a..b: 1
              |       ^
        job.yaml:11:18: nodes[0].parameters.words[1]: no value is given, and a ROS parameter cannot be null
           11 |       words: [a, null]
              |                  ^
        job.yaml:12:15: nodes[0].parameters.pairs[0]: a ROS parameter is true or false, a number, text, or a list of these; got a mapping
           12 |       pairs: [{a: 1}]
              |               ^
        """,  # noqa: E501
    ),
    "a parameter given twice": (
        """\
        nodes:
          - node: m:N
            parameters: {a.b: 1, a: {b: 2}}
        """,
        """
        job.yaml:3:30: nodes[0].parameters.a: the parameter 'a.b' is given twice
            3 |     parameters: {a.b: 1, a: {b: 2}}
              |                              ^
        """,
    ),
    "a parameter file pasted in": (
        """\
        nodes:
          - node: m:N
            parameters: {"/**": {ros__parameters: {a: 1}}}
        """,
        """
        job.yaml:3:26: nodes[0].parameters./**: this looks like a ROS parameter file: list it in parameter_files, or put the values directly below 'parameters'
            3 |     parameters: {"/**": {ros__parameters: {a: 1}}}
              |                          ^
        """,  # noqa: E501
    ),
    "two nodes of one name": (
        """\
        nodes:
          - {node: m:N, name: a, namespace: /x}
          - {node: m:N, name: a}
          - node: m:M
            namespace: /x
            name: a
        """,
        """
        job.yaml:6:11: nodes[2].name: /x/a is already the name of nodes[0]: give one of them another name or namespace
            6 |     name: a
              |           ^
        """,  # noqa: E501
    ),
    "paths": (
        """\
        nodes:
          - node: m:N
            parameter_files: [job.yaml, params.yaml, .]
        search_path: [., src, job.yaml]
        bags: [gone, {path: gone2}]
        """,
        """
        job.yaml:3:33: nodes[0].parameter_files[1]: 'params.yaml': there is no such parameter file
            3 |     parameter_files: [job.yaml, params.yaml, .]
              |                                 ^
        job.yaml:3:46: nodes[0].parameter_files[2]: '.': is not a file
            3 |     parameter_files: [job.yaml, params.yaml, .]
              |                                              ^
        job.yaml:4:18: search_path[1]: 'src': there is no such folder
            4 | search_path: [., src, job.yaml]
              |                  ^
        job.yaml:4:23: search_path[2]: 'job.yaml': is not a folder
            4 | search_path: [., src, job.yaml]
              |                       ^
        job.yaml:5:8: bags[0].path: 'gone': there is no such bag
            5 | bags: [gone, {path: gone2}]
              |        ^
        job.yaml:5:21: bags[1].path: 'gone2': there is no such bag
            5 | bags: [gone, {path: gone2}]
              |                     ^
        """,
    ),
    "globs": (
        """\
        bags: [{path: ., topics: [imu, ""]}, {path: ., topics: []}]
        record: {topics: [], exclude: /tf}
        """,
        """
        job.yaml:1:27: bags[0].topics[0]: topic names start with '/': write '/imu' (or '*imu')
            1 | bags: [{path: ., topics: [imu, ""]}, {path: ., topics: []}]
              |                           ^
        job.yaml:1:32: bags[0].topics[1]: an empty pattern matches no topic: write the name of one, or a glob
            1 | bags: [{path: ., topics: [imu, ""]}, {path: ., topics: []}]
              |                                ^
        job.yaml:1:56: bags[1].topics: an empty list would play nothing: leave the key out to play all topics
            1 | bags: [{path: ., topics: [imu, ""]}, {path: ., topics: []}]
              |                                                        ^
        job.yaml:2:18: record.topics: an empty list would keep no payload: write 'payloads: false' for that
            2 | record: {topics: [], exclude: /tf}
              |                  ^
        job.yaml:2:31: record.exclude: expected a list, got text '/tf'; write [/tf]
            2 | record: {topics: [], exclude: /tf}
              |                               ^
        """,  # noqa: E501
    ),
}


@pytest.mark.parametrize("name", GOLDEN)
def test_mistakes_are_shown_where_they_were_made(name: str) -> None:
    text, expected = GOLDEN[name]
    assert message(text) == shown(expected)


def test_a_long_line_is_shown_around_the_mistake() -> None:
    text = "nodes: [{node: m:N, arguments: {text: " + "x" * 500 + "}}, {node: bad}]\n"
    lines = message(text).splitlines()
    assert lines[0].endswith("expected module:Class or module:function, got 'bad'")
    assert len(lines[1]) <= 110
    column = lines[2].index("^")
    assert lines[1][column : column + 3] == "bad"


def test_aliases_cannot_blow_up_a_small_file() -> None:
    rows = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    for level in range(1, 9):
        rows.append(f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]")
    assert "repeat more than 10000 values" in message("\n".join(rows))


def test_a_file_has_a_largest_number_of_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsltrace.job.reading.yaml_source.VALUES_MAX", 50)
    assert message(f"seed: [{'1, ' * 60}]").startswith("job.yaml:1:")
    assert "more than 50 values" in message(f"seed: [{'1, ' * 60}]")


def test_deep_nesting_is_an_error_not_a_crash() -> None:
    text = "\n".join(" " * depth + "a:" for depth in range(1000))
    assert message(text) == "job.yaml: the values are nested too deeply"


def test_text_in_place_of_a_node_is_shown_as_one(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    for text, key in (("robot:Ekf", "node"), ("demo_nodes_py/talker", "executable")):
        path.write_text(f"nodes: [{text}]\n")
        with pytest.raises(JobError, match=rf"job.yaml:1:9: .*; write {{{key}: {text}}}"):
            load_job(path)
