"""The handle of ``rclpy.Context``: init arguments and shutdown.

A shutdown by a node that the job constructs ends the run; a main shuts down only itself. As in rcl,
entities of a context that is shut down can be destroyed, but hardly used.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

from greenlet import getcurrent

from rsltrace.adapters.rclpy.arguments import RosArguments
from rsltrace.adapters.rclpy.concurrency.runtime import RunEnded, Runtime
from rsltrace.adapters.rclpy.handles.destroyable import Handle
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.model.event import OutputKind

DEFAULT_DOMAIN = 2**64 - 1
_DOWN = (
    "the given context is not valid, either rcl_init() was not called or rcl_shutdown() was called."
)


class ContextHandle(Handle):
    """Stands in for ``_rclpy.Context``."""

    def __init__(
        self, real: Any, runtime: Runtime, arguments: Sequence[str], domain_id: int
    ) -> None:
        super().__init__()
        self._real = real
        self.runtime = runtime
        if not isinstance(arguments, list):
            raise TypeError("Context: incompatible constructor arguments: the first must be a list")
        for argument in arguments:
            str.encode(argument)  # raises what rclpy raises for invalid text
        self.program = runtime.programs.present
        self.arguments = RosArguments([*_only_ros(arguments), *self.program.ros_words])
        self._domain_id = 0 if domain_id == DEFAULT_DOMAIN else domain_id
        self.is_up = True
        self.program.contexts.append(self)

    def ok(self) -> bool:
        return self.is_up

    def get_domain_id(self) -> int:
        """Return the domain id; nothing in a simulation depends on it."""
        return self._domain_id

    def note_domains(self) -> None:
        """Note that domains do not separate the nodes of a program, if it has several."""
        domains = sorted({each.get_domain_id() for each in self.program.contexts if each.ok()})
        notes = self.runtime.domain.outcome.notes
        note = f"{self.program.name} has nodes in domains {domains}, which meet in a simulation"
        if len(domains) > 1 and note not in notes:
            notes.append(note)

    def shutdown(self) -> None:
        """Shut down. Within an event this ends the run once the event is over."""
        if not self.is_up:
            text = "failed to shutdown: rcl_shutdown already called on the given context"
            raise self._real.RCLError(text)
        self.end()
        runtime = self.runtime
        if self.program is not runtime.programs.host:
            runtime.dispatcher.note(OutputKind.SHUTDOWN, runtime.event.entity)
            return
        if runtime.event.node is not None and self is runtime.programs.main_context:
            runtime.dispatcher.note(OutputKind.SHUTDOWN, runtime.event.entity)
            name = runtime.event.node.fully_qualified_name
            runtime.loop.stop(Stop(f"{name} called rclpy.shutdown()"))

    def end(self) -> None:
        """Shut down as a signal does."""
        self.is_up = False
        graph = self.runtime.domain.graph
        for node in graph.nodes:
            if getattr(node, "context", None) is self:
                for publisher in graph.publishers_of(node):
                    refuse = getattr(publisher, "refuse", None)  # a bag's has none
                    if refuse is not None:
                        refuse(self._refuse)

    def _refuse(self, message: object) -> NoReturn:
        self._cut_off()
        raise self._real.RCLError("Failed to publish: publisher's context is invalid")

    def require(self, task: str) -> None:
        """Raise RCLError if the context is shut down, as rcl does for ``task``."""
        if not self.is_up:
            self._cut_off()
            raise self._real.RCLError(f"{task}: {_DOWN}")

    def _cut_off(self) -> None:
        """Raise ``RunEnded`` in callbacks and threads of a main while the run ends.

        The end of the run is no error of theirs. The main itself goes on, as it would natively.
        """
        runtime, main = self.runtime, self.program.stack
        if not runtime.ending.closing or main is None:
            return
        if runtime.dispatcher.in_callback() or main is not getcurrent():
            raise RunEnded


def _only_ros(arguments: Sequence[str]) -> list[str]:
    """Return the arguments between ``--ros-args`` and ``--``."""
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
