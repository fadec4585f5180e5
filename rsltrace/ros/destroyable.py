"""The life of a handle as rclpy's ``Destroyable`` has it: destroyed when no ``with`` uses it."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing_extensions import Self

_invalid_handle: type[Exception] = RuntimeError


def set_invalid_handle(error: type[Exception]) -> None:
    """Tell which exception rclpy expects from a destroyed handle (its own ``InvalidHandle``)."""
    global _invalid_handle
    _invalid_handle = error


class Destroyable:
    """A handle that stays alive while a ``with`` block uses it."""

    def __init__(self) -> None:
        self._uses = 0
        self._destroyed = False

    def __enter__(self) -> Self:
        if self._destroyed:
            raise _invalid_handle("cannot use Destroyable because destruction was requested")
        self._uses += 1
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self._uses -= 1
        if self._destroyed and self._uses == 0:
            self._destroy()

    def destroy_when_not_in_use(self) -> None:
        """Destroy now, or when the last ``with`` block ends. A second call is an error."""
        if self._destroyed:
            raise _invalid_handle("cannot use Destroyable because destruction was requested")
        self._destroyed = True
        if self._uses == 0:
            self._destroy()

    @property
    def pointer(self) -> int:
        """A number that is unique among living handles (rclpy's wait sets compare these)."""
        return id(self)

    def _destroy(self) -> None:
        """Give back what the handle holds; called once."""
