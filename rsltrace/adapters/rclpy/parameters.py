"""The parameters of the nodes of a run: those they have declared, and those they were given."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.simulation.middleware.graph import Graph


@dataclass(frozen=True, slots=True)
class Parameters:
    """The parameters of a node: those it has declared, and those it was given besides.

    ``entry_key`` is the key of the job's entry that made the node, empty if none did.
    ``unconfigured``: a managed node that nobody has configured yet, which is when such a node
    declares its parameters.
    """

    entry_key: str
    declared: tuple[str, ...]
    unused: tuple[str, ...]
    unconfigured: bool = False


def parameters_of(graph: Graph) -> dict[str, Parameters]:
    """Return the parameters of the nodes there are now. Who allows undeclared ones uses all."""
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
    """Say whether a node is a managed one in the state in which such nodes begin."""
    lifecycle = sys.modules.get("rclpy.lifecycle")
    if lifecycle is None or not isinstance(node, lifecycle.LifecycleNodeMixin):
        return False
    machine = getattr(node, "_state_machine", None)  # there unless it was made without
    return machine is not None and bool(machine.current_state[1] == "unconfigured")
