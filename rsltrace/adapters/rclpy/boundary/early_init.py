"""Mains whose module calls ``rclpy.init()`` at import.

The modules of mains are imported before the run, so that errors in a job name its line. They have
no simulated process then, and so no context to initialize: such a module is imported again by its
program.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class NeedsItsProcess(BaseException):
    """A module uses rclpy's contexts at import. No ``Exception``, so that user code does not catch
    it."""


_without_process = False


@contextmanager
def before_its_process() -> Iterator[None]:
    """Import the module of a main before its program begins.

    :raises NeedsItsProcess: if the module initializes a context, or uses the default one.
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
    """Raise ``NeedsItsProcess`` if there is no simulated process to initialize yet."""
    if _without_process:
        raise NeedsItsProcess
