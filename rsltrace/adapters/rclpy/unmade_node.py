"""Nodes whose constructor never came to rclpy's own, so that they are none."""

from __future__ import annotations

import sys
from typing import Any


def is_unmade(value: object) -> bool:
    """Return whether a value is of a class of nodes, and ``Node.__init__`` has not run on it."""
    module = sys.modules.get("rclpy.node")
    return module is not None and isinstance(value, module.Node) and not hasattr(value, "handle")


def constructor_of(node: object) -> str:
    """Return the name of a node's class, and where its constructor is."""
    kind: Any = type(node)
    code = getattr(kind.__init__, "__code__", None)
    place = f" ({code.co_filename}:{code.co_firstlineno})" if code is not None else ""
    return f"{kind.__qualname__}{place}"
