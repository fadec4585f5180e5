"""The graphs that only ``usual.py`` has, as rclpy nodes and as jobs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import usual_nodes
from graphs import BENCHMARKS, EXAMPLES, Graph

PING_DONE = "/ping_pong/done"
CALL_DONE = "/caller/done"


def job_of(nodes: list[dict[str, Any]], stop: dict[str, Any]) -> Callable[[int], dict[str, Any]]:
    """Return what makes a job of nodes; functions among its values are called with the count."""

    def filled(value: Any, count: int) -> Any:
        if isinstance(value, dict):
            return {key: filled(item, count) for key, item in value.items()}
        return value(count) if callable(value) else value

    def job(count: int) -> dict[str, Any]:
        return {
            "nodes": [filled(node, count) for node in nodes],
            "search_path": [str(BENCHMARKS), str(EXAMPLES / "ping_pong")],
            "livelock_limit": 20 * (count + 1000),
            "stop": filled(stop, count),
        }

    return job


def mains(*names: str, done: str) -> Callable[[int], dict[str, Any]]:
    """Return what makes a job of mains; the first is told how much to do, and says when it has."""
    first: dict[str, Any] = {"main": f"usual_nodes:{names[0]}"}
    if names[0].startswith("ping"):
        first["parameters"] = {"messages": lambda count: max(1, count // 2), "burst": True}
    else:
        first["parameters"] = {"calls": lambda count: count}
    others = [{"main": name} for name in names[1:]]
    return job_of([first, *others], {"topic": {"name": done, "exit_code": "data"}})


def for_ms(per_ms: float) -> dict[str, Any]:
    """Return the stop condition of a job that does so much in each millisecond."""
    return {"duration": lambda count: f"{max(1, int(count / per_ms))}ms"}


def usual_graphs() -> dict[str, Graph]:
    """Return the graphs by name."""
    make = usual_nodes
    period = {"parameters": {"period": 0.001}}
    images = [
        {"node": "usual_nodes:Camera", **period},
        {"node": "usual_nodes:Display", "arguments": {"name": "left"}},
        {"node": "usual_nodes:Display", "arguments": {"name": "right"}},
    ]
    goals = [
        {"node": "usual_nodes:GoalAsker", "parameters": {"goals": lambda count: count}},
        {"node": "usual_nodes:Worker"},
    ]
    asked = {"topic": {"name": "/asker/done", "exit_code": "data"}}
    logs = job_of([{"node": "usual_nodes:Logger", **period}], for_ms(make.EACH))
    sets = job_of([{"node": "usual_nodes:Setter", **period}], for_ms(make.EACH))
    numbers = job_of([{"node": "usual_nodes:Counter"}], for_ms(2))
    once = mains("ping_once", "usual_nodes:pong_once", done=PING_DONE)
    graphs = (
        Graph("once", "", (), None, once),
        Graph("calls", "", (), None, mains("call", "usual_nodes:serve", done=CALL_DONE)),
        Graph("until", "", (), None, mains("call_and_spin", "usual_nodes:serve", done=CALL_DONE)),
        Graph("logs", "", (), make.log_nodes, logs),
        Graph("sets", "", (), make.set_nodes, sets),
        Graph("goals", "", (), make.goal_nodes, job_of(goals, asked)),
        Graph("images", "", (), make.image_nodes, job_of(images, for_ms(1))),
        Graph("small", "", (), None, numbers),
    )
    return {graph.name: graph for graph in graphs}
