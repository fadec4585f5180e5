"""The declared and the unused parameters of a run's nodes."""

from __future__ import annotations

import sys

from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.middleware.graph import Graph


@dataclass(frozen=True, slots=True)
class Parameters:
    """The declared parameters of a node, and given ones that it did not declare (``unused``).

    ``entry_key``: the job's entry that made it, or empty. ``unconfigured``: a managed node before
    its configuration, when it declares its parameters.
    """

    entry_key: str
    declared: tuple[str, ...]
    unused: tuple[str, ...]
    unconfigured: bool = False


def parameters_of(graph: Graph) -> dict[str, Parameters]:
    """Return the parameters of the nodes, without nodes that allow undeclared ones."""
    found = {}
    for handle in graph.nodes:
        if not isinstance(handle, NodeHandle):
            continue
        node = handle.wrapper
        if node is None or node._allow_undeclared_parameters:
            continue
        declared = tuple(node._parameters)
        unused = tuple(name for name in node._parameter_overrides if name not in node._parameters)
        found[handle.key] = Parameters(handle.entry_key, declared, unused, _is_unconfigured(node))
    return found


def _is_unconfigured(node: object) -> bool:
    """Return whether a node is a managed one in its first state."""
    lifecycle = sys.modules.get("rclpy.lifecycle")
    if lifecycle is None or not isinstance(node, lifecycle.LifecycleNodeMixin):
        return False
    machine = getattr(node, "_state_machine", None)  # there unless it was made without
    return machine is not None and bool(machine.current_state[1] == "unconfigured")
