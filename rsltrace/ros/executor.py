"""The executor that nodes see: rclpy's Executor API, with the loop in place of ``spin``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rclpy.executors import Executor

from rsltrace.errors import UnsupportedError
from rsltrace.ros.tasks import Resume, create_task, is_coroutine_function

if TYPE_CHECKING:
    from rsltrace.ros.core import Core

_SPIN = (
    "spins an executor inside a simulation, where rsltrace's loop runs all callbacks. Let the "
    "callback return instead: use call_async with add_done_callback or await, or a timer"
)


class SimExecutor(Executor):  # type: ignore[misc]
    """The executor of a run. Adding a node to it is what makes the node's callbacks run."""

    def __init__(self, core: Core, context: Any) -> None:
        self._core = core
        self._sim_nodes: dict[Any, None] = {}
        super().__init__(context=context)

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Any:
        """Run a callback or coroutine right after the present event."""
        if type(callback) is Resume:
            callback(*args)
            return None
        if getattr(callback, "__func__", None) is _remove_pending_request():
            callback(*args)  # rclpy's own bookkeeping, not an event
            return None
        return create_task(self._core, callback, args, kwargs)

    def add_node(self, node: Any) -> bool:
        """Run a node's callbacks from now on."""
        if node in self._sim_nodes:
            return False
        self._sim_nodes[node] = None
        node.executor = self
        handle = node.handle
        handle.wrapper = node
        self._core.activate_node(handle)
        return True

    def remove_node(self, node: Any) -> None:
        """Stop running a node's callbacks."""
        if self._sim_nodes.pop(node, self) is None:
            self._core.deactivate_node(node.handle)

    def get_nodes(self) -> list[Any]:
        """Return the nodes in the order in which they were added."""
        return list(self._sim_nodes)

    def wake(self) -> None:
        """Do nothing: the loop sees every change at once."""

    def _refuse(self, *args: Any, **kwargs: Any) -> None:
        raise UnsupportedError(_SPIN)

    spin = _refuse
    spin_once = _refuse
    spin_until_future_complete = _refuse
    spin_once_until_future_complete = _refuse


def _remove_pending_request() -> Any:
    from rclpy.client import Client

    return Client.remove_pending_request


class WaitSetHandle:
    """Stands in for ``_rclpy.WaitSet``, by which other executors wait."""

    def __init__(self, *args: Any) -> None:
        raise UnsupportedError(_SPIN)


__all__ = ["SimExecutor", "WaitSetHandle", "is_coroutine_function"]
