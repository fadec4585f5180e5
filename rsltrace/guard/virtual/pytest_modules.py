"""Our calls in test modules, too: those that pytest compiles itself when it runs in a node.

Its import hook comes before all others, and keeps what it compiled in a cache of its own. While a
run lasts that cache is neither read nor written: plain pytest shall not find our calls there.
"""

from __future__ import annotations

import ast
import sys
from contextlib import ExitStack
from typing import Any

from rsltrace.guard.callers import is_user_file
from rsltrace.guard.virtual.user_modules import rewrite

REWRITES = "_pytest.assertion.rewrite"
"""The module of pytest that compiles test modules."""


def rewritten_in_pytest(stack: ExitStack) -> None:
    """Put our calls into what pytest compiles from now on, until ``stack`` ends."""
    module: Any = sys.modules[REWRITES]
    names = ("rewrite_asserts", "_read_pyc", "_write_pyc")
    if not all(hasattr(module, name) for name in names):
        return  # a pytest that does it otherwise
    real = module.rewrite_asserts

    def rewrite_asserts(tree: ast.Module, source: bytes, path: Any = None, *more: Any) -> None:
        real(tree, source, path, *more)
        if path is None or is_user_file(str(path)):
            rewrite(tree)

    instead = (rewrite_asserts, lambda *what: None, lambda *what: False)
    for name, function in zip(names, instead, strict=True):
        stack.callback(setattr, module, name, getattr(module, name))
        setattr(module, name, function)


__all__ = ["REWRITES", "rewritten_in_pytest"]
