"""Compiled executables and components of launch files: processes, containers, what they load."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.adapters.launch.expand import read_in_child_process
from rsltrace.adapters.launch.model import LaunchResult
from rsltrace.adapters.launch.specs import node_specs
from rsltrace.errors import JobError
from rsltrace.job import NodeSpec
from rsltrace.job.parts.process import RespawnSpec

XML = """<launch>
  <set_env name="SHARED" value="1"/>
  <node pkg="demo" exec="driver" name="driver" cwd="/data" respawn="true" respawn_delay="0.5"
        respawn_max_retries="3" launch-prefix="gdb" on_exit="shutdown" args="--rate 10">
    <env name="OWN" value="2"/>
    <param name="rate" value="5"/>
  </node>
  <node_container pkg="rclcpp_components" exec="component_container" name="c" namespace="cam">
    <composable_node pkg="demo" plugin="demo::Fast" name="fast" namespace="n">
      <param name="gain" value="3"/>
      <remap from="in" to="out"/>
      <extra_arg name="use_intra_process_comms" value="true"/>
    </composable_node>
    <composable_node pkg="demo" plugin="demo.nodes.Filter" name="here"/>
  </node_container>
  <load_composable_node target="/cam/c">
    <composable_node pkg="demo" plugin="demo::Slow"/>
  </load_composable_node>
  <load_composable_node target="nobody">
    <composable_node pkg="demo" plugin="demo::Lost"/>
  </load_composable_node>
</launch>"""

PYTHON = """
from launch import LaunchDescription
from launch.actions import SetEnvironmentVariable, Shutdown
from launch_ros.actions import ComposableNodeContainer, LoadComposableNodes, Node
from launch_ros.descriptions import ComposableNode


def generate_launch_description():
    container = ComposableNodeContainer(
        package="rclcpp_components", executable="component_container", name="c", namespace="cam",
        composable_node_descriptions=[
            ComposableNode(
                package="demo", plugin="demo::Fast", name="fast", namespace="n",
                parameters=[{"gain": 3}], remappings=[("in", "out")],
                extra_arguments=[{"use_intra_process_comms": True}],
            ),
            ComposableNode(package="demo", plugin="demo.nodes.Filter", name="here"),
        ],
    )
    return LaunchDescription([
        SetEnvironmentVariable("SHARED", "1"),
        Node(package="demo", executable="driver", name="driver", cwd="/data", respawn=True,
             respawn_delay=0.5, respawn_max_retries=3, prefix="gdb", on_exit=Shutdown(),
             arguments=["--rate", "10"], additional_env={"OWN": "2"}, parameters=[{"rate": 5}]),
        container,
        LoadComposableNodes(
            target_container=container,
            composable_node_descriptions=[ComposableNode(package="demo", plugin="demo::Slow")]),
        LoadComposableNodes(
            target_container="nobody",
            composable_node_descriptions=[ComposableNode(package="demo", plugin="demo::Lost")]),
    ])
"""


PROGRAMS = """<launch>
  <arg name="who" default="two words"/>
  <executable cmd="./greet.sh $(var who) 'to you'" cwd="$(dirname)" name="greeter" respawn="true"
              respawn_max_retries="2"><env name="OWN" value="2"/></executable>
  <executable cmd="echo a ; echo b" shell="true" on_exit="shutdown"/>
  <timer period="2"><executable cmd="no_such_program -x"/></timer>
  <executable cmd="echo left out" if="false"/>
</launch>"""

PYTHON_PROGRAMS = """
from launch import LaunchDescription
from launch.actions import *
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration, ThisLaunchFileDir


def generate_launch_description():
    last = ExecuteProcess(cmd=["echo a", "; echo b"], shell=True)
    return LaunchDescription([
        DeclareLaunchArgument("who", default_value="two"),
        ExecuteProcess(cmd=["./greet.sh", LaunchConfiguration("who"), "words", "to you"],
                       cwd=ThisLaunchFileDir(), name="greeter", additional_env={"OWN": "2"},
                       respawn=True, respawn_max_retries=2),
        last,
        RegisterEventHandler(OnProcessExit(target_action=last, on_exit=[Shutdown()])),
        TimerAction(period=2.0, actions=[ExecuteProcess(cmd=["no_such_program", "-x"])]),
        ExecuteProcess(cmd=["echo", "left", "out"], condition=IfCondition("false")),
    ])
"""


def _specs(launched: LaunchResult, *, compiled: bool = True) -> list[NodeSpec]:
    def why_not(package: str, name: str) -> str | None:
        return None if compiled or package == "demo" else "it is not installed"

    return node_specs(
        launched,
        skip_unsupported=True,
        why_not=why_not,
        is_process=lambda package, name: compiled and bool(name),
    )


@pytest.fixture(params=["xml", "python"])
def launched(request: Any, read: Any, write: Callable[..., Path]) -> LaunchResult:
    """The same launch file in two languages."""
    if request.param == "xml":
        return read(XML)  # type: ignore[no-any-return]
    return read_in_child_process(write(PYTHON, "a.launch.py"), {}, [])


def test_compiled_nodes_are_processes_with_all_that_is_said_of_them(launched: LaunchResult) -> None:
    driver = _specs(launched)[0]
    assert (driver.executable, driver.arguments) == ("demo/driver", ("--rate", "10"))
    assert (driver.parameters, driver.working_directory) == ({"rate": 5}, "/data")
    assert driver.environment == {"SHARED": "1", "OWN": "2"}
    assert driver.respawn == RespawnSpec(delay="500ms", times=3)  # type: ignore[arg-type]
    assert driver.required
    assert "SHARED" not in os.environ
    (said,) = [text for text in launched.ignored if "processes are started" in text]
    assert "prefix: processes are started as they are" in said


def test_containers_load_the_components_that_are_no_python(launched: LaunchResult) -> None:
    _, container, fast, here, slow = _specs(launched)
    assert container.executable == "rclcpp_components/component_container"
    assert (container.name, container.namespace) == ("c", "/cam")
    assert (fast.component, fast.container) == ("demo/demo::Fast", "/cam/c")
    assert (fast.name, fast.namespace) == ("fast", "/n")
    assert (fast.parameters, fast.remappings) == ({"gain": 3}, {"in": "out"})
    assert fast.extra_arguments == {"use_intra_process_comms": True}
    assert (here.node, here.name, here.container) == ("demo.nodes:Filter", "here", None)
    assert (slow.component, slow.container, slow.name) == ("demo/demo::Slow", "/cam/c", None)
    (lost,) = [item for item in launched.unsupported if "Lost" in item.what]
    assert lost.why == "it is a C++ component, and its container /nobody is not there"


def test_without_the_container_only_its_python_components_run(launched: LaunchResult) -> None:
    driver, here = _specs(launched, compiled=False)
    assert (driver.environment, driver.respawn, driver.required) == ({}, None, True)
    assert here.node == "demo.nodes:Filter"
    whys = {item.what: item.why for item in launched.unsupported}
    assert whys["rclcpp_components/component_container (c)"] == "it is not installed"
    assert whys["demo/demo::Fast (fast)"].endswith("its container /cam/c is not there")
    (said,) = [text for text in launched.ignored if "in the process of rsltrace" in text]
    assert "cwd" in said
    assert "prefix" in said


def test_a_container_without_components_runs_if_it_can(read: Any) -> None:
    text = (
        "<launch><node pkg='demo' exec='x'/><node_container pkg='rclcpp_components' "
        "exec='component_container_mt' name='c' namespace=''/></launch>"
    )
    assert len(_specs(read(text))) == 2
    launched = read(text)
    assert (len(_specs(launched, compiled=False)), launched.unsupported) == (1, [])


@pytest.mark.parametrize("language", ["xml", "python"])
def test_other_programs_are_entries_of_native_runs(
    language: str, read: Any, write: Callable[..., Path], tmp_path: Path
) -> None:
    def launched() -> LaunchResult:
        if language == "xml":
            return read(PROGRAMS)  # type: ignore[no-any-return]
        return read_in_child_process(write(PYTHON_PROGRAMS, "a.launch.py"), {}, [])

    program = tmp_path / "greet.sh"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    found = launched()
    greet, shell = node_specs(
        found, skip_unsupported=True, why_not=lambda package, name: None, native=True
    )
    assert (greet.program, greet.arguments) == (str(program), ("two", "words", "to you"))
    assert (greet.working_directory, greet.environment) == (str(tmp_path), {"OWN": "2"})
    assert greet.respawn == RespawnSpec(times=2)
    assert not greet.required
    assert (shell.program, shell.required) == ("/bin/sh", True)
    assert shell.arguments[0] == "-c"
    assert shell.arguments[1].split() == ["echo", "a", ";", "echo", "b"]
    (missing,) = found.unsupported
    assert str(missing).endswith(
        "process 'no_such_program -x': there is no program no_such_program"
    )
    with pytest.raises(JobError, match="not all of the launch file can be run; "):
        node_specs(launched(), skip_unsupported=False, why_not=lambda *_: None, native=True)
    found = launched()
    assert _specs(found) == []
    assert {one.why for one in found.unsupported} == {"other programs do not run in a simulation"}
