"""Rules of a job that fit nothing: each is named with its line, and what fits is not named."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

NODES = """
from rclpy.action import ActionClient, ActionServer
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

class Robot(Node):
    def __init__(self):
        super().__init__('robot', namespace='/r1')
        self.declare_parameter('rate', 10.0)
        self.create_service(Trigger, 'reset', lambda request, response: response)
        self.client = self.create_client(Trigger, '/r1/reset')
        self.server = ActionServer(self, Fibonacci, 'count', print)
        self.action = ActionClient(self, Fibonacci, 'count')
        options = QoSOverridingOptions.with_default_policies()
        self.create_publisher(UInt64, 'odom', 10, qos_overriding_options=options)
        self.create_subscription(UInt64, 'odom', print, 10)

class Free(Node):
    def __init__(self):
        super().__init__('free', allow_undeclared_parameters=True)

class Parent(Node):
    def __init__(self):
        super().__init__('parent')
        self.timer = self.create_timer(0.5, self.tick)

    def tick(self):
        self.timer.cancel()
        self.child = Node('child')  # gets no arguments: they are those of the job's nodes
        self.child.create_publisher(UInt64, 'toy', 10)

class Late(Node):
    def __init__(self):
        super().__init__('late')
        self.timer = self.create_timer(0.5, self.tick)

    def tick(self):
        self.timer.cancel()
        self.create_publisher(UInt64, 'late_topic', 10)
        self.create_service(Trigger, 'late_service', print)
"""

ALL = """\
nodes:
  - node: nodes_under_test:Talker
  - node: nodes_under_test:Listener
  - node: nodes_under_test:Robot
    parameters: {rate: 5.0, qos_overrides./r1/odom.publisher.depth: 3}
  - {node: nodes_under_test:Free, parameters: {anything: 1}}
  - node: nodes_under_test:Late
"""

USED = """\
stop: {duration: 3s, topic: /numbers/never}
delay:
  topics: {/numbers: 1ms, '/r1/*': 2ms, /rosout: 1ms, /r1/count/_action/feedback: 1ms}
  services: {/r1/reset: 1ms, /r1/count/_action/send_goal: 1ms, '*/late_service': 1ms}
  links:
    - {topic: /num*, from: /talker, to: /listener, constant: 3ms}
    - {topic: /r1/odom, to: /r1/robot, constant: 3ms}
  outages:
    - {node: /r1/*, from: 0s, to: 1s}
    - {topic: /late_topic, from: 3s, to: 4s}
clocks: [{node: /talker, offset: 1s}, {node: '*', drift: 5}]
execution:
  nodes: {/r1/*: 1ms}
  entities: [{node: /talker, entity: Talker.tick, constant: 1ms}]
executors: [{nodes: [/talker]}, {nodes: [/talker, /listener]}]
policy: {priority: [{node: /late, priority: 1}, {group_of: /numbers, priority: 2}]}
"""


def test_rules_that_have_something_to_do_are_not_named(record_job: Callable[..., Any]) -> None:
    yaml = ALL + USED.replace(", topic: /numbers/never", "")
    result = record_job(yaml, NODES, output=None)
    assert result.error is None
    assert result.notes == ()


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("/numbers: 1ms", "/nubmers: 1ms", "no topic fits '/nubmers'; did you mean '/numbers'?"),
        ("'/r1/*': 2ms", "'/r2/*': 2ms", "no topic fits '/r2/*' (there are /late_topic, /numbers"),
        ("'*/late_service'", "/late_servce", "no service fits '/late_servce'; did you mean '/l"),
        ("/r1/reset", "/reset", "no service fits '/reset'; did you mean '/r1/reset'?"),
        ("topic: /num*", "topic: /nm*", "no topic fits '/nm*'"),
        (
            "from: /talker",
            "from: /a",
            "no node that fits '/a' publishes '/num*' (there are /talker",
        ),
        ("/rosout: 1ms", "/r1/reset: 1ms", "'/r1/reset' fits services only: name it as such"),
        ("'*/late_service'", "/numbers", "'/numbers' fits topics only: name it as such"),
        ("to: /listener", "to: /talker", "no node that fits '/talker' subscribes '/num*'"),
        ("{node: /r1/*, from", "{node: /r2/*, from", "no node fits '/r2/*'"),
        ("from: 3s, to: 4s", "from: 1min, to: 2min", "this outage begins 60 s after the start, "),
        ("node: /talker, offset", "node: /talkr, offset", "no node fits '/talkr'; did you mean"),
        ("{node: /talker, offset: 1s}", "{node: '*', offset: 1s}", "every node that it fits has"),
        ("nodes: {/r1/*: 1ms}", "nodes: {/r2/*: 1ms}", "no node fits '/r2/*'"),
        ("Talker.tick", "Talker.tock", "no topic, service or timer's callback of '/talker' fits"),
        ("[/talker, /listener]", "[/talker]", "every node that it fits has an earlier entry"),
        ("group_of: /numbers", "group_of: /number", "no topic, service or timer's callback of"),
        ("{node: /late, p", "{node: /latest, p", "no node fits '/latest'; did you mean '/late'?"),
        ("/numbers/never", "/numbers/none", "no topic fits '/numbers/none'; did you mean"),
        (
            "{rate: 5.0",
            "{ratee: 5.0",
            "/r1/robot has not declared the parameter 'ratee', so it has ",
        ),
        ("publisher.depth", "publisher.depht", "/r1/robot has not declared the parameter 'qos_ov"),
    ],
)
def test_a_rule_that_fits_nothing_is_named(
    record_job: Callable[..., Any], old: str, new: str, message: str
) -> None:
    yaml = ALL + USED
    if old != "/numbers/never":
        yaml = yaml.replace(", topic: /numbers/never", "")
    assert yaml.count(old) == 1
    line = yaml[: yaml.index(old)].count("\n") + 1
    result = record_job(yaml.replace(old, new), NODES, output=None)
    assert result.error is None
    (note,) = result.notes
    place, _, told = note.partition(": ")
    assert place.rpartition(":")[0].endswith(f"job.yaml:{line}")
    assert told.startswith(message)


def test_parameters_of_a_node_of_a_main(record_job: Callable[..., Any]) -> None:
    code = """
import rclpy

def main():
    rclpy.init()
    rclpy.spin(Talker())
"""
    yaml = "nodes: [{main: nodes_under_test:main, parameters: {start_type_descriptions: false}}]\n"
    (note,) = record_job(yaml + "stop: {duration: 1s}\n", code, output=None).notes
    assert "/talker has not declared the parameter 'start_type_descriptions'" in note
    assert note.endswith("did you mean 'start_type_description_service'?")


@pytest.mark.long
def test_check_names_them_and_a_run_that_failed_does_not(
    command: Any, job_file: Callable[..., Path], record_job: Callable[..., Any]
) -> None:
    fails = """
class Failing(Node):
    def __init__(self):
        super().__init__('failing')
        raise ValueError('no')
"""
    bad = "nodes: [{node: nodes_under_test:Failing}]\nclocks: [{node: /x, offset: 1s}]\n"
    assert record_job(bad, fails, output=None).notes == ()
    yaml = "nodes: [{node: nodes_under_test:Talker}]\nclocks: [{node: /talkr, offset: 1s}]\n"
    job_file(yaml + "stop: {duration: 1s}\n")
    done = command("check", "job.yaml")
    assert done.returncode == 1
    assert done.stdout.endswith(
        "to look at:\n  job.yaml:2:17: no node fits '/talkr'; did you mean '/talker'?\n"
        "(what nodes create later, in callbacks, is not there yet)\n"
    )
    done = command("record", "job.yaml", "-o", "run.mcap")
    assert done.returncode == 0
    assert "note: job.yaml:2:17: no node fits '/talkr'; did you mean '/talker'?\n" in done.stderr


def test_check_waits_with_what_a_managed_node_declares_when_it_is_configured(
    command: Any, job_file: Callable[..., Path]
) -> None:
    code = """
import rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

class Arm(LifecycleNode):
    def __init__(self):
        super().__init__('arm')
        self.create_timer(0.5, self.trigger_configure).reset()

    def on_configure(self, state):
        self.declare_parameter('rate', 1.0)
        return TransitionCallbackReturn.SUCCESS
"""
    yaml = "nodes: [{node: nodes_under_test:Arm, parameters: {rate: 5.0, ratee: 5.0}}]\n"
    job_file(yaml + "stop: {duration: 700ms}\n", code)
    done = command("check", "job.yaml")
    assert "no problems found" in done.stdout
    done = command("record", "job.yaml", "-o", "run.mcap")
    (note,) = [line for line in done.stderr.splitlines() if "declared" in line]
    assert "/arm has not declared the parameter 'ratee', so it has no effect; did you" in note


def test_a_parameter_that_only_a_node_of_another_entry_declares_is_named(
    record_job: Callable[..., Any],
) -> None:
    yaml = """\
nodes:
  - {node: nodes_under_test:Talker, parameters: {rate: 5.0}}
  - {node: nodes_under_test:Robot, parameters: {rate: 5.0}}
  - {node: nodes_under_test:both, parameters: {rate: 5.0}}
stop: {duration: 1s}
"""
    code = """
def both():
    listener = Listener()
    listener.get_clock().sleep_for(rclpy.duration.Duration(seconds=0.1))
    robot = Node('second')
    robot.declare_parameter('rate', 1.0)
    assert robot.get_parameter('rate').value == 5.0
    return [listener, robot]
"""
    result = record_job(yaml, NODES + "import rclpy.duration\n" + code, output=None)
    assert result.error is None
    (note,) = result.notes
    assert "job.yaml:2:" in note
    assert "/talker has not declared the parameter 'rate', so it has no effect" in note


NAMES = """\
nodes:
  - node: nodes_under_test:Talker
    remappings: {numbers: /nums, /tf: tf}
  - node: nodes_under_test:Robot
    remappings:
      odom: /odometry
      rosservice://reset: /again
      robot:count: /counting
  - node: nodes_under_test:Late
    namespace: /ns
    remappings: {late_topic: /later}
ros_arguments: [-r, "late:late_service:=later_service", --remap, "__ns:=/everybody"]
record:
  topics: [/odometry, /later, '*/nobody', /counting/_action/send_goal]
  exclude: [/rosout, '*/image_raw']
delay: {file: delays.csv}
stop: {duration: 1s}
"""
TABLE = "topic,kind,delay,skew\n/nums,FIXED,5,\n/later,FIXED,1.5,\n"


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("", "", "", ""),
        ("job.yaml", "numbers: /n", "nubmers: /n", "nothing of /everybody/talker is called 'nub"),
        ("job.yaml", "/tf: tf", "/ft: tf", "nothing of /everybody/talker is called '/ft'"),
        ("job.yaml", "odom:", "odometry:", "nothing of /everybody/robot is called 'odometry', so"),
        ("job.yaml", "rosservice://", "rostopic://", "nothing of /everybody/robot is called 'rost"),
        ("job.yaml", "robot:count", "robt:count", "nothing of /everybody/robot is called 'robt:c"),
        ("job.yaml", "late_topic: /l", "ate_topic: /l", "nothing of /everybody/late is called 'a"),
        ("job.yaml", "late:late_s", "late:lat_s", "nothing of /everybody/talker, /everybody/robot"),
        ("job.yaml", "/later, ", "/latr, ", "no topic or service fits '/latr'; did you mean '/la"),
        ("job.yaml", "/rosout", "/camera/*", "no topic or service fits '/camera/*' (there are "),
        ("delays.csv", "/nums", "/numbers", "no topic is called '/numbers'; did you mean '/nums'?"),
    ],
)
def test_remappings_kept_topics_and_rows_of_a_delay_file(
    record_job: Callable[..., Any], tmp_path: Path, file: str, old: str, new: str, message: str
) -> None:
    texts = {"job.yaml": NAMES, "delays.csv": TABLE}
    line = 0
    if file:
        assert texts[file].count(old) == 1
        line = texts[file][: texts[file].index(old)].count("\n") + 1
        texts[file] = texts[file].replace(old, new)
    (tmp_path / "delays.csv").write_text(texts["delays.csv"])
    result = record_job(texts["job.yaml"], NODES, output=None)
    assert result.error is None
    if not file:
        assert result.notes == ()
        return
    (told,) = [
        told
        for note in result.notes
        for place, _, told in [note.partition(": ")]
        if re.search(rf"/{file}:{line}\b", place)
    ]  # what a topic was to be called is missing in other lines, too
    assert told.startswith(message)


@pytest.mark.long
@pytest.mark.parametrize(
    ("clock", "column", "shown"),
    [
        ("offset: -20ms", 34, "20 ms"),
        ("offset: 1s, jumps: [{at: 1s, by: 1s}, {at: 2s, by: -9s}]", 77, "5 s"),
        ("offset: 20ms, jumps: [{at: 1s, by: -1s}]", 0, ""),
    ],
)
def test_a_clock_that_would_show_times_before_0_is_named(
    record_job: Callable[..., Any], clock: str, column: int, shown: str
) -> None:
    yaml = "nodes: [{node: nodes_under_test:Talker}]\n"
    yaml += f"clocks: [{{node: /talker, {clock}}}]\nstop: {{duration: 3s}}\n"
    notes = record_job(yaml, output=None).notes
    assert len(notes) == bool(column)
    for note in notes:
        assert f"job.yaml:2:{column}: this clock would show times before 0, which ROS does " in note
        assert f"it shows 0 for {shown};" in note
    assert record_job(yaml + "start: 100s\n", output=None).notes == ()


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("rate:=5.0", ""),
        ("anything:=1", ""),  # /free takes what it is given
        ("talker:rate:=1", "/talker has not declared the parameter 'rate', so it has no effect"),
        ("free:rate:=1", ""),
        ("robot:rate:=1", "no node is called 'robot'; did you mean '/r1/robot'?"),
    ],
)
def test_parameters_of_ros_arguments(
    record_job: Callable[..., Any], word: str, message: str
) -> None:
    yaml = ALL + f"ros_arguments: [-p, '{word}']\nstop: {{duration: 1s}}\n"
    result = record_job(yaml, NODES, output=None)
    assert result.error is None
    assert len(result.notes) == bool(message), result.notes
    for note in result.notes:
        assert f"job.yaml:8:21: {message}" in note


@pytest.mark.long
def test_topics_to_keep_in_a_file_that_jobs_share_are_not_named(
    record_job: Callable[..., Any], tmp_path: Path
) -> None:
    (tmp_path / "common.yaml").write_text("record: {exclude: [/camera/*]}\n")
    yaml = "nodes: [{node: nodes_under_test:Talker}]\nstop: {duration: 1s}\n"
    assert record_job("include: common.yaml\n" + yaml, output=None).notes == ()
    (note,) = record_job(yaml + "record: {exclude: [/camera/*]}\n", output=None).notes
    assert "job.yaml:3:20: no topic or service fits '/camera/*'" in note


def test_what_is_remapped_for_no_node_of_the_job_is_named(record_job: Callable[..., Any]) -> None:
    yaml = "nodes: [{node: nodes_under_test:Parent}]\nros_arguments: [-r, 'toy:=/toys']\n"
    (note,) = record_job(yaml, NODES, output=None).notes
    assert "job.yaml:2:21: nothing of /parent is called 'toy', so nothing is remapped" in note


def test_a_remapping_that_several_nodes_share_is_used_if_one_uses_it(
    record_job: Callable[..., Any],
) -> None:
    yaml = """\
nodes:
  - {node: nodes_under_test:Talker, remappings: &all {numbers: /n, late_topic: /l, nobody: /x}}
  - {node: nodes_under_test:Listener, remappings: *all}
  - {node: nodes_under_test:Late, remappings: *all}
"""
    (note,) = record_job(yaml + "stop: {duration: 1s}\n", NODES, output=None).notes
    assert "job.yaml:2:92: nothing of /talker, /listener, /late is called 'nobody', so n" in note
