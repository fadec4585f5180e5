"""``torch.compile`` reads the code that runs, our calls included: it may take them for nothing.

It would follow them into the guard, and could go no further where a set of texts is gone through.
In a graph sets are in the order that Python gives them, which is that of all pinned processes.
"""

from __future__ import annotations

import sys
from typing import Any

from rsltrace.guard.virtual.clocks import numpy_now
from rsltrace.guard.virtual.object_hashes import hash_method
from rsltrace.guard.virtual.set_order import ordered

COMPILES = "torch._dynamo"
"""The module of torch that reads code."""


def _as_it_is(thing: Any) -> Any:
    return thing


def _hash_method(owner: Any) -> Any:
    return owner.__hash__


def _call(function: Any, text: str, *more: Any) -> Any:
    return function(text, *more)


_MEANT = {
    ordered: _as_it_is,
    hash_method: _hash_method,
    numpy_now: _call,
}
_known: list[object] = []


def plain_in_graphs() -> None:
    """Let torch, whose compiler is loaded, see plain Python where modules call the guard."""
    substitute = getattr(sys.modules[COMPILES], "substitute_in_graph", None)
    if substitute is None or substitute in _known:
        return  # a torch that does it otherwise; or it is told already, and for good
    _known.append(substitute)
    for function, meant in _MEANT.items():
        substitute(function)(meant)


__all__ = ["COMPILES", "plain_in_graphs"]
