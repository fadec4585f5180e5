"""One name for a package and a function: ``rsltrace.diff(a, b)`` and ``rsltrace.diff.report``."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def make_callable(package: str, function: Callable[..., Any]) -> None:
    """Let the package of that name be called as ``function``; help shows its signature."""

    class CallablePackage(ModuleType):
        __call__ = staticmethod(function)

        @property
        def __signature__(self) -> inspect.Signature:
            return inspect.signature(function)

    sys.modules[package].__class__ = CallablePackage
