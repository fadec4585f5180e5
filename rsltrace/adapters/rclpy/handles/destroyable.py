"""Base classes of handles, like rclpy's ``Destroyable``.

rclpy puts a ``with handle:`` around every use so that C memory is not freed meanwhile. Here is no C
memory: a handle is destroyed at once, and using it afterwards raises what rclpy expects.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NoReturn

from rsltrace.errors import UnsupportedError

if TYPE_CHECKING:
    from typing_extensions import Self

_invalid_handle: type[Exception] = RuntimeError


def set_invalid_handle(error: type[Exception]) -> None:
    """Set the exception that a destroyed handle raises: rclpy's own ``InvalidHandle``."""
    global _invalid_handle
    _invalid_handle = error


class Destroyable:
    """A handle that can be used in ``with`` until it is destroyed."""

    destroyed: bool
    """Set by ``destroy`` only."""
    destroy: Callable[[], None]
    """Destroys the handle; calling it again does nothing."""

    def __enter__(self) -> Self:
        if self.destroyed:
            raise _invalid_handle("cannot use Destroyable because destruction was requested")
        return self

    def __exit__(self, exc_type: object, exc: object, tb: object) -> None:
        pass

    def destroy_when_not_in_use(self) -> None:
        self.destroy()

    @property
    def pointer(self) -> int:
        """A number that is unique among living handles (rclpy's wait sets compare these)."""
        return id(self)

    def set_on_new_message_callback(self, callback: object) -> NoReturn:
        """Refuse rclpy's experimental nodes on asyncio, which take what arrives by themselves."""
        raise UnsupportedError(
            "rclpy's experimental AsyncNode and AsyncioExecutor cannot be simulated yet: use "
            "rclpy.node.Node; its callbacks may be coroutines, and mains may run asyncio loops"
        )

    set_on_new_request_callback = set_on_new_response_callback = set_on_new_message_callback
    set_on_reset_callback = set_on_new_message_callback


class Handle(Destroyable):
    """A handle that is no entity of the middleware: a clock, a context, a goal."""

    def __init__(self) -> None:
        self.destroyed = False

    def destroy(self) -> None:
        if not self.destroyed:
            self.destroyed = True
            self._destroy()

    def _destroy(self) -> None:
        """Release what the handle holds; called once."""
