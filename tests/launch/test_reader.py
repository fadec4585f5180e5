"""XML and YAML launch files without ROS's launch: what they mean, and what is wrong with them."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import pytest

from rsltrace.adapters.launch.api.parameters import parameters_for
from rsltrace.adapters.launch.model import LaunchedNode, LaunchResult
from rsltrace.adapters.launch.specs import node_specs as specs_of
from rsltrace.errors import JobError
from rsltrace.job import NodeSpec
from rsltrace.job.parts.launch import StartAfterSpec
from rsltrace.run.plans.executables import why_not_runnable


def node_specs(launched: LaunchResult, *, skip_unsupported: bool) -> list[NodeSpec]:
    return specs_of(launched, skip_unsupported=skip_unsupported, why_not=why_not_runnable)


FILES = Path(__file__).parent / "files"
XML = (FILES / "everything.launch.xml").read_text(encoding="utf-8")
YAML = (FILES / "everything.launch.yaml").read_text(encoding="utf-8")
BOTH = pytest.mark.parametrize(("text", "name"), [(XML, "a.launch.xml"), (YAML, "a.launch.yaml")])


@BOTH
def test_everything_at_once(read: Any, prefix: Path, text: str, name: str) -> None:
    launched = read(text, name)
    talk, listen = launched.nodes
    assert talk == LaunchedNode(
        where=talk.where,
        package="demo",
        executable="talker",
        name="talk",
        namespace="/husky_sim",
        parameters=(
            {"shared": 7},
            {"rate": 2.5},
            {"text": "12"},
            {"nested.list": [1, 2], "nested.flag": True},
        ),
        remappings=(("tf", "/tf_all"), ("chatter", "/chat")),
        arguments=("--loud", "two words"),
        number=talk.number,
    )
    assert (listen.name, listen.namespace) == (None, "/abs")
    assert talk.where.startswith(f"{name}:1")
    assert listen.where.startswith(f"{name}:")
    assert [str(a) for a in launched.arguments.values()] == [
        "robot (default 'husky', which one)",
        "use_camera (default 'true')",
    ]
    (spec, _) = node_specs(launched, skip_unsupported=False)
    assert spec == NodeSpec(
        executable="demo/talker",
        name="talk",
        namespace="/husky_sim",
        parameters={
            "shared": 7,
            "rate": 2.5,
            "text": "12",
            "nested.list": [1, 2],
            "nested.flag": True,
        },
        remappings={"tf": "/tf_all", "chatter": "/chat"},
        arguments=["--loud", "two words"],
        origin=talk.where,
    )


@BOTH
def test_arguments_and_conditions(
    read: Any, write: Any, prefix: Path, text: str, name: str
) -> None:
    write("/**: {ros__parameters: {z: 1}}", "extra.yaml")
    launched = read(text, name, robot="jackal", use_camera="false")
    assert [node.name for node in launched.nodes] == ["talk", "last"]
    assert launched.nodes[0].namespace == "/jackal_sim"
    last = node_specs(launched, skip_unsupported=False)[-1]
    assert (last.namespace, last.parameters) == ("/given", {"shared": 7, "a.b": 3})
    assert last.remappings == {"tf": "/tf_all", "x": "y"}
    assert [Path(file).name for file in last.parameter_files] == ["extra.yaml"]


def test_groups_keep_their_values_to_themselves(read: Any) -> None:
    launched = read(
        """<launch>
          <let name="a" value="1"/><set_env name="RSLTRACE_T" value="out"/>
          <group>
            <let name="a" value="2"/><set_env name="RSLTRACE_T" value="in"/>
            <push-ros-namespace namespace="n"/>
            <group><push_ros_namespace namespace="m"/>
              <node pkg="p" exec="e" name="x$(var a)$(env RSLTRACE_T)"/></group>
          </group>
          <node pkg="p" exec="e" name="y$(var a)$(env RSLTRACE_T)"/>
          <group scoped="false"><let name="a" value="3"/></group>
          <node pkg="p" exec="e" name="z$(var a)" namespace="rel"/>
          <group forwarding="false"><keep name="b" value="$(var a)"/>
            <node pkg="p" exec="e" name="w$(var b)$(var a none)"/></group>
        </launch>"""
    )
    assert [(node.name, node.namespace) for node in launched.nodes] == [
        ("x2in", "/n/m"),
        ("y1out", None),
        ("z3", "/rel"),
        ("w3none", None),
    ]
    assert [note.split(":", 3)[3][:33] for note in launched.ignored] == [
        " environment variable RSLTRACE_T:"
    ] * 2


def test_includes(read: Any, write: Any) -> None:
    write(
        "launch:\n"
        "  - arg: {name: who}\n"
        "  - node: {pkg: p, exec: e, name: $(var who), namespace: $(filename)}\n",
        "sub/inner.launch.yaml",
    )
    write("<launch><node pkg='p' exec='$(dirname)' name='$(var who)'/></launch>", "sub/b.xml")
    launched = read(
        """<launch>
          <push_ros_namespace namespace="base"/>
          <include file="sub/inner.launch.yaml"><arg name="who" value="me"/></include>
          <include file="$(dirname)/sub/b.xml"/>
          <node pkg="p" exec="$(filename)"/>
        </launch>"""
    )
    assert [node.name for node in launched.nodes] == ["me", "me", None]
    assert launched.nodes[1].executable.endswith("/sub")
    assert launched.nodes[2].executable.endswith("/a.launch.xml")
    assert "who" in launched.arguments


def test_parameter_files_and_values_in_their_order(read: Any, prefix: Path) -> None:
    launched = read(
        """<launch>
          <node pkg="demo" exec="talker" name="camera" namespace="front">
            <param name="rate" value="1.0"/>
            <param name="exposure.time" value="1"/>
            <param name="own" value="1"/>
            <param from="$(find-pkg-share demo)/config/demo.yaml"/>
            <param name="word" value="last"/>
          </node>
          <node pkg="demo" exec="talker" name="other">
            <param name="exposure.time" value="1"/>
            <param from="$(find-pkg-share demo)/config/demo.yaml"/>
          </node>
        </launch>"""
    )
    camera, other = node_specs(launched, skip_unsupported=False)
    # What the file gives again afterwards is the file's.
    assert camera.parameters == {"own": 1, "word": "last"}
    assert other.parameters == {"exposure.time": 1}
    assert [Path(p).name for p in camera.parameter_files] == ["demo.yaml"]


def test_parameter_files_with_substitutions(read: Any, write: Any) -> None:
    write("talk: {ros__parameters: {a: $(var n), b: {c: '$(env HOME)'}}}\n", "p.yaml")
    launched = read(
        """<launch><let name="n" value="5"/>
          <node pkg="p" exec="e" name="talk"><param from="p.yaml" allow_substs="true"/></node>
        </launch>"""
    )
    import os

    assert launched.nodes[0].parameters == ({"a": 5, "b.c": os.environ["HOME"]},)


def test_components_in_python(read: Any) -> None:
    launched = read(
        """<launch>
          <node_container pkg="rclcpp_components" exec="component_container" name="c" namespace="">
            <composable_node pkg="demo" plugin="demo.nodes.Talker" name="t" namespace="n">
              <param name="rate" value="5"/>
              <extra_arg name="use_intra_process_comms" value="true"/>
            </composable_node>
            <composable_node pkg="demo" plugin="demo::Filter" if="false"/>
          </node_container>
          <load_composable_node target="c">
            <composable_node pkg="demo" plugin="demo.nodes:Listener"/>
          </load_composable_node>
        </launch>"""
    )
    talker, listener = node_specs(launched, skip_unsupported=False)
    assert (talker.node, talker.name, talker.namespace) == ("demo.nodes:Talker", "t", "/n")
    assert talker.parameters == {"rate": 5}
    assert listener.node == "demo.nodes:Listener"


UNSUPPORTED = """<launch>
  <node pkg="demo" exec="compiled"/>
  <node pkg="demo" exec="script"/>
  <node pkg="demo" exec="taker"/>
  <node pkg="no_such_package" exec="x" name="n"/>
  <node exec="./program"/>
  <executable cmd="rviz2 -d x"/>
  <timer period="5.0"><node pkg="demo" exec="talker"/></timer>
  <shutdown/>
  <load_composable_node target="c"><composable_node pkg="d" plugin="d::T"/></load_composable_node>
  <node pkg="demo" exec="talker" name="fine" launch-prefix="gdb"><env name="A" value="b"/></node>
</launch>"""


def test_what_cannot_be_simulated_is_listed_with_the_reason(
    read: Any, prefix: Path, write: Any
) -> None:
    with pytest.raises(JobError) as info:
        node_specs(read(UNSUPPORTED), skip_unsupported=False)
    assert str(info.value).splitlines() == [
        "not all of the launch file can be simulated; --skip-unsupported (skip_unsupported: true "
        "in a job) leaves this out:",
        "  a.launch.xml:2:3: demo/compiled: demo/compiled is a program for another machine",
        "  a.launch.xml:3:3: demo/script: demo/script is a script for /bin/sh (script): rsltrace "
        "runs Python nodes only; leave it out, or feed the graph what it publishes from a bag",
        "  a.launch.xml:4:3: demo/taker: package 'demo' has no executable 'taker'; did you mean "
        "'talker'? It has compiled, listener, script, talker",
        "  a.launch.xml:5:3: no_such_package/x (n): there is no package 'no_such_package': install "
        "it for this Python (pip install), add its sources to search_path, or source the "
        "workspace it is built in",
        "  a.launch.xml:6:3: process './program': it belongs to no package",
        "  a.launch.xml:7:3: process 'rviz2 -d x': other programs do not run in a simulation",
        "  a.launch.xml:9:3: shutdown: a run ends by the job's stop: conditions",
        "  a.launch.xml:10:36: d/d::T: it is a C++ component, and its container /c is not there",
    ]
    launched = read(UNSUPPORTED)
    timed, fine = node_specs(launched, skip_unsupported=True)
    assert timed.start_after == StartAfterSpec.after(5_000_000_000)
    assert (fine.name, fine.start_after) == ("fine", None)
    assert len(launched.unsupported) == 8
    assert launched.ignored == [
        "a.launch.xml:11:3: launch-prefix, env A: it runs in the process of rsltrace"
    ]


TIMERS = [
    """<launch>
      <arg name="wait" default="2.5"/>
      <timer period="$(var wait)">
        <node pkg="demo" exec="talker" name="a"/>
        <group><push_ros_namespace namespace="n"/>
          <ros_timer period="0.25"><node pkg="demo" exec="talker" name="b"/></ros_timer>
        </group>
        <include file="more.launch.xml"/>
      </timer>
      <timer period="1" if="false"><node pkg="demo" exec="talker" name="c"/></timer>
      <node pkg="demo" exec="talker" name="d"/>
    </launch>""",
    """launch:
      - arg: {name: wait, default: "2.5"}
      - timer:
          period: $(var wait)
          children:
            - node: {pkg: demo, exec: talker, name: a}
            - group:
                - push_ros_namespace: {namespace: n}
                - ros_timer:
                    period: 0.25
                    children: [node: {pkg: demo, exec: talker, name: b}]
            - include: {file: more.launch.xml}
      - timer: {period: 1.0, if: "false", children: [node: {pkg: demo, exec: talker, name: c}]}
      - node: {pkg: demo, exec: talker, name: d}
    """,
]


@pytest.mark.parametrize("text", TIMERS, ids=["xml", "yaml"])
def test_timers_start_nodes_later(read: Any, prefix: Path, write: Any, text: str) -> None:
    more = '<launch><node pkg="demo" exec="talker" name="e"/></launch>'
    write(more, "more.launch.xml")
    name = "a.launch.xml" if text.startswith("<") else "a.launch.yaml"
    made = node_specs(read(text, name), skip_unsupported=False)
    assert [(one.name, one.start_after and one.start_after.delay_ns) for one in made] == [
        ("a", 2_500_000_000),
        ("b", 2_750_000_000),
        ("e", 2_500_000_000),
        ("d", None),
    ]


BROKEN = [
    ("<launch><timer/></launch>", "a.launch.xml:1:9: <timer> needs the attribute 'period'"),
    (
        "<launch><timer period='soon'/></launch>",
        "a.launch.xml:1:16: the period of a timer is a number of seconds, not 'soon'",
    ),
    ("<launch><timer period='-1'/></launch>", "a number of seconds, not '-1'"),
    ("<launch><nod/></launch>", "a.launch.xml:1:9: unknown action <nod>; did you mean <node>?"),
    ("<launch>\n <node/></launch>", "a.launch.xml:2:2: <node> needs the attribute 'exec'"),
    (
        "<launch>\n <node pkg='p' exec='e'\n  nmae='x'/></launch>",
        "a.launch.xml:3:3: unknown attribute 'nmae' in <node>; did you mean 'name'?",
    ),
    (
        "<launch><node pkg='p' exec='e'><parm name='a' value='1'/></node></launch>",
        "unknown element 'parm' in <node>; did you mean 'param'?",
    ),
    ("<launch><node pkg='p'", "a.launch.xml:1:9: not XML: unclosed token"),
    ("<launch>", "not XML: no element found"),
    ("<robot/>", "a launch file begins with <launch>, not with <robot>"),
    ("<launch>text</launch>", "text 'text' between elements means nothing"),
    (
        "<!DOCTYPE launch [<!ENTITY a 'b'>]><launch>&a;</launch>",
        "a launch file has no <!DOCTYPE>",
    ),
    (
        "<launch><arg name='map' description='the map'/></launch>",
        "a.launch.xml:1:9: the launch argument 'map' (the map) is required: give map:=…",
    ),
    (
        "<launch><arg name='a' default='x'><choice value='y'/></arg></launch>",
        "the launch argument 'a' is 'x', which is none of 'y'",
    ),
    (
        "<launch><let name='a' value='$(var b)'/></launch>",
        "a.launch.xml:1:23: $(var b): there is no launch argument 'b'",
    ),
    (
        "<launch><let name='a' value='$(env RSLTRACE_NOT_SET)'/></launch>",
        "$(env RSLTRACE_NOT_SET): the environment variable RSLTRACE_NOT_SET is not set",
    ),
    ("<launch><let name='a' value='$(vra b)'/></launch>", "did you mean $(var …)?"),
    ("<launch><let name='a' value='$(var b'/></launch>", "has no closing parenthesis"),
    ("<launch><let name='a' value='$(command ls)'/></launch>", "runs no commands"),
    (
        "<launch><let name='a' value='$(eval __import__)'/></launch>",
        "there is no '__import__' here",
    ),
    ("<launch><group if='maybe'/></launch>", "expected true, 1, false or 0, got 'maybe'"),
    ("<launch><group if='1' unless='0'/></launch>", "give either 'if' or 'unless', not both"),
    (
        "<launch><include file='b.xml'/></launch>",
        "a.launch.xml:1:18: there is no launch file b.xml",
    ),
    (
        "<launch><include file='a.launch.xml'/></launch>",
        "launch files include each other: a.launch.xml",
    ),
    (
        "<launch><include file='$(find-pkg-share no_such)/x.xml'/></launch>",
        "there is no ROS package 'no_such'",
    ),
    (
        "<launch><node pkg='p' exec='e'><param from='none.yaml'/></node></launch>",
        "there is no parameter file none.yaml",
    ),
    (
        "<launch><node pkg='p' exec='e'><param name='a'/></node></launch>",
        "a parameter has either a value or parameters within it",
    ),
    (
        "<launch><node pkg='p' exec='e'><param name='a' value='x' type='int'/></node></launch>",
        "expected int, got 'x'",
    ),
    (
        "<launch><node pkg='p' exec='e'><param name='a' value='x' type='integer'/></node></launch>",
        "unknown type 'integer'",
    ),
    ("<launch><node pkg='p' exec='e' args=\"'\"/></launch>", "args: No closing quotation"),
]


@pytest.mark.parametrize(("text", "message"), BROKEN)
def test_mistakes_are_shown_at_their_place(read: Any, text: str, message: str) -> None:
    with pytest.raises(JobError) as info:
        specs_of(read(text), skip_unsupported=False, why_not=lambda package, executable: None)
    assert message in str(info.value)
    assert str(info.value).startswith("a.launch.xml")


def test_files_that_include_each_other_are_all_named(read: Any, write: Any) -> None:
    write("<launch><include file='a.launch.xml'/></launch>", "b.launch.xml")
    with pytest.raises(JobError, match=r"include each other: a\.launch\.xml, b\.launch\.xml"):
        read("<launch><include file='b.launch.xml'/></launch>")


def test_a_parameter_file_that_is_not_yaml_says_where(write: Any) -> None:
    path = str(write("/**:\n  ros__parameters:\n    speed: [1, 2\n", "p.yaml"))
    with pytest.raises(JobError, match=r"p\.yaml: not YAML: expected ',' or '\]'.* in line 4"):
        parameters_for(path, "/robot")


BROKEN_YAML = [
    ("launch: 5", "a.yaml:1:9: 'launch' takes a mapping"),
    ("lunch: []", "a YAML launch file has one key, 'launch'"),
    ("launch:\n  - node: {pkg: p, exec: e}\n    name: x\n", "a.yaml:2:5: an action is a mapping"),
    ("launch:\n  - node: {pkg: p, exce: e}\n", "a.yaml:2:20: unknown attribute 'exce'"),
    (
        "launch:\n  - node: {pkg: p, exec: $(var x)}\n",
        "a.yaml:2:20: $(var x): there is no launch argument",
    ),
    ("launch: [", "not YAML"),
    ("", "the file is empty"),
]


@pytest.mark.parametrize(("text", "message"), BROKEN_YAML)
def test_mistakes_in_yaml(read: Any, text: str, message: str) -> None:
    with pytest.raises(JobError) as info:
        read(text, "a.yaml")
    assert message in str(info.value)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("-q x", "unknown ROS argument -q x"),
        ("-p", "the ROS argument -p has no value"),
        ("-r nothing", "unknown ROS argument -r nothing"),
        ("--params-file none.yaml", "there is no parameter file none.yaml"),
    ],
)
def test_mistakes_in_ros_arguments(read: Any, prefix: Path, words: str, message: str) -> None:
    launched = read(f"<launch><node pkg='demo' exec='talker' ros_args='{words}'/></launch>")
    with pytest.raises(JobError, match=rf"a\.launch\.xml:1:9: {message}"):
        node_specs(launched, skip_unsupported=False)


def test_a_bad_name_is_told_at_its_node(read: Any, prefix: Path) -> None:
    launched = read("<launch><node pkg='demo' exec='talker' name='a b'/></launch>")
    with pytest.raises(JobError, match=r"a\.launch\.xml:1:9: name: 'a b' is not a node name"):
        node_specs(launched, skip_unsupported=False)


def test_the_document_names_all_that_is_read() -> None:
    from rsltrace.adapters.launch.frontend import ACTIONS
    from rsltrace.adapters.launch.substitution import SUBSTITUTIONS

    text = (Path(__file__).parents[2] / "docs" / "launch.md").read_text(encoding="utf-8")
    silent = {"push-ros-namespace", "reset_env", "set_use_sim_time", "set_ros_log_dir", "log",
              "log_info", "executable", "shutdown"}  # fmt: skip
    for action in set(ACTIONS) - silent:
        assert f"`{action}`" in text, action
    for name in set(SUBSTITUTIONS) - {"optenv"}:
        assert f"`$({name})`" in text or f"`$({name} …)`" in text, name


def test_the_file_of_an_include_does_not_depend_on_its_arguments(read: Any, write: Any) -> None:
    for name in "ab":
        write(f'<launch><node pkg="demo" exec="from_{name}"/></launch>', f"{name}.launch.xml")
    launched = read(
        '<launch><arg name="robot" default="a"/><include file="$(var robot).launch.xml">'
        '<arg name="robot" value="b"/></include></launch>',
        "whole.launch.xml",
    )
    assert [node.executable for node in launched.nodes] == ["from_a"]


def test_a_pipe_is_no_content(read: Any, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(JobError, match="a named pipe, not a regular file"):
        read(f'<launch><let name="a" value="$(file-content {tmp_path}/pipe)"/></launch>')


def test_a_parameter_file_in_the_folder_of_temporary_ones_is_one_as_any(
    read: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "rate.yaml").write_text("talker: {ros__parameters: {rate: 1.5}}\n")
    launched = read(
        '<launch><node pkg="demo" exec="talker"><param from="rate.yaml"/></node></launch>'
    )
    (node,) = launched.nodes
    assert [str(one.path) for one in node.parameters] == [str(tmp_path / "rate.yaml")]


def test_what_a_process_is_not_given_has_its_name_in_the_file(read: Any) -> None:
    launched = read('<launch><node pkg="demo" exec="a" launch-prefix="gdb"/><executable/></launch>')
    assert launched.nodes[0].surroundings.without == ("launch-prefix",)
    assert launched.nodes[1].title == "a process"
