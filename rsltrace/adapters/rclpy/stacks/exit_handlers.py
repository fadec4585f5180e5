"""What a main registers with ``atexit`` runs when that main ends, not when rsltrace does."""

from __future__ import annotations

import atexit
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rsltrace.adapters.rclpy.stacks.program import Handler, Program
from rsltrace.adapters.rclpy.stacks.runners import Stacks
from rsltrace.adapters.rclpy.stacks.simulated_sleep import simulated_stacks


@contextmanager
def own_exit_handlers(stacks: Stacks) -> Iterator[None]:
    """Keep the exit handlers of mains apart from the process's within the ``with`` block."""
    real_register, real_unregister = atexit.register, atexit.unregister

    def of_main() -> list[Handler] | None:
        if simulated_stacks() is stacks and not stacks.programs.is_hosted:
            return stacks.programs.present.exit_handlers
        return None

    def register(function: Any, /, *args: Any, **kwargs: Any) -> Any:
        handlers = of_main()
        if handlers is None:
            return real_register(function, *args, **kwargs)
        handlers.append((function, args, kwargs))
        return function

    def unregister(function: Any, /) -> None:
        handlers = of_main()
        if handlers is None:
            real_unregister(function)
        else:
            handlers[:] = [handler for handler in handlers if handler[0] != function]

    atexit.register, atexit.unregister = register, unregister
    try:
        yield
    finally:
        atexit.register, atexit.unregister = real_register, real_unregister


def run_exit_handlers(program: Program) -> None:
    """Run what a main has registered, the last first, as Python does."""
    while program.exit_handlers:
        function, args, kwargs = program.exit_handlers.pop()
        function(*args, **kwargs)
