"""Base classes of the handles of publishers, subscriptions, timers, clients and services."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from rsltrace.adapters.rclpy.concurrency.callback_groups import exclusive_group, is_custom
from rsltrace.adapters.rclpy.concurrency.mailbox import Mailbox
from rsltrace.adapters.rclpy.concurrency.runtime import Runtime
from rsltrace.adapters.rclpy.handles.destroyable import Destroyable
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.simulation.middleware.entity import DomainEntity, Receiver, Runnable, callback_name

if TYPE_CHECKING:
    from typing_extensions import Self

Alarm = Callable[[], None]
"""Called whenever something arrives for an entity."""

EVENTS = ("_EventHandler__event", "_QoSEventHandler__event")
"""Where the waitable of a QoS event has its handle, from Iron on and before."""

_LISTS = ("subscriptions", "timers", "clients", "services", "guards", "waitables")


class EntityHandle(Destroyable, DomainEntity):
    """An entity of the middleware with its rclpy object, the ``wrapper``.

    rclpy creates the handle first, so the wrapper (which holds callback and callback group) is
    looked up in the node's lists when it is first needed. Timers and guard conditions are made
    without a node, and do not run until a node lists them.
    """

    dispatch: Callable[[], None]
    lists: str
    """Name of the rclpy Node attribute that lists the wrappers."""
    begins_active = False
    runtime: Runtime
    wrapper: Any
    own_group: bool
    """Whether its callback group is of a custom class."""
    _listed: tuple[Any, Any] | None
    """Node and wrapper, if another handle has come across them in its own search."""

    destroy = DomainEntity.destroy

    def __new__(cls, *_: object, **__: object) -> Self:
        # Set now, as CPython lets objects share the table of their attributes' names as long as
        # none of them gets a new attribute later.
        self = super().__new__(cls)
        self.wrapper = self._listed = None
        self.own_group = False
        return self

    def get_logger_name(self) -> str:
        assert self.node is not None
        return str(self.node.logger_name())

    def settle(self) -> bool:
        """Find owner and wrapper; return whether the owner is known."""
        self.find_wrapper()
        return self.node is not None

    def find_wrapper(self) -> Any:
        """Return the rclpy object around this handle, or None if its node is not being run."""
        if self.wrapper is None:
            found = self._listed
            if found is None or self.destroyed or found[0].wrapper is None:
                found = self._look()
            if found is not None:
                node, wrapper = found
                self.begin(wrapper, node)
        return self.wrapper

    def _look(self) -> tuple[Any, Any] | None:
        """Look for node and wrapper; note those of the other handles in the list, as a node may
        have thousands of timers."""
        for node in self._candidates():
            mine = None
            for handle, wrapper in self._listed_by(node.wrapper):
                handle._listed = node, wrapper
                if handle is self:
                    mine = wrapper
            if mine is not None:
                return node, mine
        return None

    def begin(self, wrapper: Any, node: Any) -> None:
        """Start to run: node and wrapper are known now."""
        self.wrapper = wrapper
        self.node = node
        self.own_group = is_custom(getattr(wrapper, "callback_group", None))
        self.active = True
        self.activate()

    def activate(self) -> None:
        """Put what has arrived so far into the loop."""

    def deactivate(self) -> None:
        """Stop running: the node was removed from its executor."""
        self.wrapper = self._listed = None
        self.active = False

    def _listed_by(self, node: Any) -> Iterator[tuple[Any, Any]]:
        """Yield an rclpy node's handles of this kind, each with its wrapper."""
        for wrapper in getattr(node, self.lists, ()):
            yield wrapper.handle, wrapper

    def _candidates(self) -> Iterator[Any]:
        """Yield the nodes that may list it, the likely ones first."""
        if self.node is not None:
            if self.node.wrapper is not None:
                yield self.node
            return
        nodes = self.runtime.domain.graph.nodes
        hint = self.runtime.event.node
        if isinstance(hint, NodeHandle) and hint.wrapper is not None and not hint.destroyed:
            yield hint
        for node in nodes:
            if node is not hint and isinstance(node, NodeHandle) and node.wrapper is not None:
                yield node

    def mailbox_keeps(self) -> bool:
        """Leave the callback to the user's executor, if one has the node; False if it runs now."""
        mailbox: Mailbox | None = self.node.mailbox if self.node is not None else None
        return mailbox is not None and mailbox.keeps(self)

    def trace_name(self) -> str:
        return callback_name(self.user_callback())

    def trace_group(self) -> str:
        group = getattr(self._wrapper_now(), "callback_group", None)
        return self.node.group_name(group) if isinstance(self.node, NodeHandle) else ""

    def user_callback(self) -> object:
        return getattr(self._wrapper_now(), "callback", None)

    def _wrapper_now(self) -> Any:
        wrapper = self.wrapper
        if wrapper is None and isinstance(self.node, NodeHandle) and self.node.made is not None:
            listed = self._listed_by(self.node.made)  # its constructor waits
            wrapper = next((one for handle, one in listed if handle is self), None)
        return wrapper

    def runnable(self) -> Runnable:
        node = self.node
        group = getattr(self.wrapper, "callback_group", None)
        return Runnable(
            self.kind.label.replace(" ", "_"),
            self.trace_name(),
            self.entity_id,
            node,
            exclusive_group(group),
            () if node is None or group is None else _names_in_group(node, group),
            self.period(),
            executor=node is None or node.mailbox is None,
            handed_over=node is not None and node.mailbox is not None,
        )


def _names_in_group(node: Any, group: Any) -> tuple[str, ...]:
    names = []
    for attribute in _LISTS:
        for wrapper in getattr(node.wrapper, attribute, ()):
            handle = getattr(wrapper, "handle", None)
            if getattr(wrapper, "callback_group", None) is group and handle is not None:
                names.append(handle.trace_name())
    return tuple(names)


class ReceiverHandle(EntityHandle, Receiver):
    """A handle with a queue of arrivals for its callback."""

    def awaken(self) -> None:
        self.find_wrapper()

    activate = Receiver.activate

    def may_run(self) -> bool:
        """Return whether to take an arrival now; if not, it is tried again later."""
        mailbox = self.node.mailbox
        if mailbox is not None and mailbox.keeps(self):
            return False
        wrapper = self.wrapper
        if not self.queue or wrapper is None or self.destroyed:
            return False
        group = wrapper.callback_group
        if getattr(group, "_active_entity", group) is None and not self.own_group:  # nearly always
            return True
        return not self.runtime.groups.must_wait(self, wrapper)

    def settle(self) -> bool:
        self.find_wrapper()
        return True
