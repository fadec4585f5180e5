"""The handle of ``rclpy.Context``: init arguments, and a shutdown.

That of a node which the job constructs ends the run; a main shuts down only itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rsltrace.doors.rclpy.arguments import InvalidArgumentsError, RosArguments
from rsltrace.doors.rclpy.boundary.destroyable import Destroyable
from rsltrace.loop.stop import Stop
from rsltrace.model.event import OutputKind

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core

DEFAULT_DOMAIN = 2**64 - 1


class ContextHandle(Destroyable):
    """Stands in for ``_rclpy.Context``."""

    def __init__(self, core: Core, arguments: Sequence[str], domain_id: int) -> None:
        super().__init__()
        self.core = core
        for argument in arguments:
            argument.encode()  # raises what rclpy raises for what is not text
        self.program = core.program
        self.program.contexts.append(self)
        self.arguments = RosArguments([*_only_ros(arguments), *self.program.ros_words])
        self._domain_id = 0 if domain_id == DEFAULT_DOMAIN else domain_id
        self._ok = True

    def ok(self) -> bool:
        """Return whether the context has not been shut down."""
        return self._ok

    def get_domain_id(self) -> int:
        """Return the domain id; nothing in a simulation depends on it."""
        return self._domain_id

    def shutdown(self) -> None:
        """Shut down. Within an event this ends the run once the event is over."""
        if not self._ok:
            raise RuntimeError("context has already been shut down")
        self._ok = False
        core = self.core
        if self.program is not core.host:
            core.note(OutputKind.SHUTDOWN, core.current_entity)
            return
        if core.current_node is not None and self is core.main_context:
            core.note(OutputKind.SHUTDOWN, core.current_entity)
            name = core.current_node.fully_qualified_name
            core.loop.stop(Stop(f"{name} called rclpy.shutdown()"))

    def end(self) -> None:
        """Shut down from outside, as a signal does."""
        self._ok = False


def _only_ros(arguments: Sequence[str]) -> list[str]:
    """Keep what stands between ``--ros-args`` and ``--`` (the program's own flags are not ours)."""
    kept: list[str] = []
    inside = False
    for argument in arguments:
        if argument == "--ros-args":
            inside = True
        if inside:
            kept.append(argument)
        if argument == "--":
            inside = False
    return kept


__all__ = ["ContextHandle", "InvalidArgumentsError"]
