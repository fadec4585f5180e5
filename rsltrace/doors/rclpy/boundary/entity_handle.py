"""What publishers, subscriptions, timers, clients, services and guard conditions have in common."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from rsltrace.doors.rclpy.boundary.callback_groups import must_wait
from rsltrace.doors.rclpy.boundary.destroyable import Destroyable
from rsltrace.model.entity import Entity, EntityKind

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.node import NodeHandle
    from rsltrace.doors.rclpy.core import Core


class EntityHandle(Destroyable):
    """A handle that has an id in the trace and, once rclpy has made it, a wrapper object.

    rclpy creates the handle first and wraps it afterwards, so the wrapper (which holds callback
    and callback group) is looked up in the node's lists when it is first needed. Timers and guard
    conditions are made without a node; until one lists them they do not run.
    """

    kind: EntityKind
    lists: str
    """Name of the rclpy Node attribute that lists the wrappers."""
    announced = True
    """Whether the trace is told of the entity when it is created."""

    def __init__(self, core: Core, node: NodeHandle | None) -> None:
        super().__init__()
        self.core = core
        self.node = node
        self.entity_id = core.new_entity_id()
        self.created_ns = core.loop.now_ns
        self.wrapper: Any = None
        core.pending.append(self)

    def get_logger_name(self) -> str:
        """Return the node's logger name."""
        assert self.node is not None
        return self.node.logger_name()

    def settle(self) -> bool:
        """Find owner and wrapper; return whether the owner is known."""
        self.find_wrapper()
        return self.node is not None

    def find_wrapper(self) -> Any:
        """Return the rclpy object around this handle, or None if its node is not being run."""
        if self.wrapper is None:
            for node in self._candidates():
                for wrapper in getattr(node.wrapper, self.lists):
                    if wrapper.handle is self:
                        self.wrapper = wrapper
                        self.node = node
                        self.activate()
                        return wrapper
        return self.wrapper

    def activate(self) -> None:
        """Start to run, or to deliver what has arrived: owner and callback are known now."""

    def deactivate(self) -> None:
        """Stop running: the node was taken from its executor."""
        self.wrapper = None

    def _candidates(self) -> list[NodeHandle]:
        if self.node is not None:
            return [self.node] if self.node.wrapper is not None else []
        nodes = self.core.graph.nodes
        hint = self.core.current_node
        ordered = [n for n in nodes if n is hint] + [n for n in nodes if n is not hint]
        return [n for n in ordered if n.wrapper is not None]

    def entity(self) -> Entity:
        """Return the entity as the trace describes it."""
        return Entity(
            id=self.entity_id,
            node=self.node.entity_id if self.node is not None else 0,
            kind=self.kind,
            name=self.trace_name(),
            type=self.trace_type(),
            created_ns=self.created_ns,
            detail=self.trace_detail(),
        )

    def trace_name(self) -> str:
        """Return the topic, service or callback name."""
        return callback_name(getattr(self.wrapper, "callback", None))

    def trace_type(self) -> str:
        """Return the interface type, or an empty string."""
        return ""

    def trace_detail(self) -> dict[str, object]:
        """Return what only this kind of entity has."""
        return {}

    def describe(self) -> str:
        """Name the entity for people: ``/listener: subscription /chatter``."""
        node = self.node.fully_qualified_name if self.node is not None else "(no node)"
        return f"{node}: {self.kind.label} {self.trace_name()}"


class Receiver(EntityHandle):
    """A handle with a queue of what has arrived for its callback.

    One entry in the loop's ready queue stands for one arrival, so arrivals of all entities run in
    the order in which they came. An arrival that the queue has dropped leaves an entry behind that
    finds nothing to do.
    """

    queue: deque[Any]
    origin = slice(1, 4)
    """Where an arrival says what it is: publishing event, which of its outputs, content hash."""

    def deliver(self, arrival: Any) -> None:
        """Queue an arrival; it is dispatched once the node is being run."""
        if self.arrived(arrival) is not None:
            self.core.loop.ready.append(self)

    def arrived(self, arrival: Any) -> Receiver | None:
        """Queue an arrival; return this receiver if it is ready for it now."""
        self.queue.append(arrival)
        if self.wrapper is not None:
            return self
        self.find_wrapper()
        return None

    def activate(self) -> None:
        self.core.loop.ready.extend([self] * len(self.queue))

    def may_run(self) -> bool:
        """Return whether to take an arrival now; if the callback group is busy, try again later."""
        mailbox = self.node.mailbox  # type: ignore[union-attr]  # a receiver is made by a node
        if mailbox is not None and mailbox.keeps(self):
            return False
        wrapper = self.wrapper
        if not self.queue or wrapper is None or self.destroyed:
            return False
        group = wrapper.callback_group
        if getattr(group, "_active_entity", group) is None:  # nearly always
            return True
        return not must_wait(self.core, self, wrapper)

    def settle(self) -> bool:
        self.find_wrapper()
        return True

    def dispatch(self) -> None:
        """Take the oldest arrival and run the callback with it."""
        raise AssertionError("every receiver says how")


def callback_name(callback: Any) -> str:
    """Name a callback as in ``Talker.on_timer``; never with an address in it."""
    if callback is None:
        return ""
    if isinstance(callback, partial):
        return f"partial({callback_name(callback.func)})"
    with suppress(Exception):  # a callable object may answer anything: a mock does
        name = callback.__qualname__
        if isinstance(name, str):
            return name
    return type(callback).__qualname__
