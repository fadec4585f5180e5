"""A main whose module calls ``rclpy.init()`` when it is imported.

The modules of mains are imported before the run, so that what is wrong with a job is said with its
line. They have no process by then, and so no context to initialize: such a module is imported by
its program, as ``python`` does it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class NeedsItsProcess(BaseException):
    """A module uses rclpy's contexts when it is imported. No ``Exception``: user code that catches
    those is not to take it for one of rclpy's."""


_without_process = False


@contextmanager
def before_its_process() -> Iterator[None]:
    """Import the module of a main before its program begins; rclpy's default context is none of
    the run's meanwhile.

    :raises NeedsItsProcess: if the module initializes a context, or asks for the default one.
    """
    global _without_process
    import rclpy.utilities

    values = vars(rclpy.utilities)
    context, values["g_default_context"] = values["g_default_context"], None
    _without_process = True
    try:
        yield
        has_asked = values["g_default_context"] is not None
    finally:
        _without_process = False
        values["g_default_context"] = context
    if has_asked:
        raise NeedsItsProcess


def check_process() -> None:
    """Raise ``NeedsItsProcess`` if what is going to be initialized has no process yet."""
    if _without_process:
        raise NeedsItsProcess
