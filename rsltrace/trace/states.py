"""The recorded state of a node after an event, from the changes until then."""

from __future__ import annotations

import base64
import binascii
import json
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.trace.cdr import unpack_detail
from rsltrace.trace.format import TOPIC_STATES
from rsltrace.trace.reader import Trace

BLOCK_BYTES = 4096
ARRAY_BYTES_MAX = 1 << 32

StateValue = str | npt.NDArray[Any]


def state_after(trace: Trace, node: int, event: int) -> dict[str, StateValue]:
    """Return a node's state by path (``estimator.P``) after an event; empty if not recorded.

    :raises TraceError: if the recorded changes are invalid.
    """
    attributes: dict[str, dict[str, StateValue]] = {}
    try:
        for _, _, data in trace.messages(TOPIC_STATES):
            at, owner, text = unpack_detail(data)
            if at > event:
                break
            if owner == node:
                for name, leaves in json.loads(text).items():
                    before = attributes.pop(name, {})
                    if leaves is not None:
                        attributes[name] = {
                            path: _leaf(leaf, before.get(path)) for path, leaf in leaves.items()
                        }
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise TraceError(f"a state in {trace.name} cannot be read: {error}") from error
    return {path: leaf for leaves in attributes.values() for path, leaf in leaves.items()}


def _leaf(leaf: Any, before: StateValue | None) -> StateValue:
    if not isinstance(leaf, dict):
        return str(leaf)
    dtype, shape = np.dtype(str(leaf["dtype"])), tuple(map(int, leaf["shape"]))
    count = int(np.prod(shape, dtype=object)) if shape else 1
    if dtype.hasobject or not 0 <= count * dtype.itemsize <= ARRAY_BYTES_MAX:
        raise ValueError(f"an array of {shape} {dtype}")
    size = count * dtype.itemsize
    if isinstance(before, np.ndarray) and before.nbytes == size:
        data = bytearray(before.tobytes())
    elif len(leaf["blocks"]) * BLOCK_BYTES >= size:
        data = bytearray(size)
    else:
        raise ValueError(f"an array of {size} bytes, of which there are fewer")
    for number, block in leaf["blocks"].items():
        try:
            piece = base64.b64decode(block, validate=True)
        except binascii.Error as error:
            raise ValueError(str(error)) from error
        at = int(number) * BLOCK_BYTES
        if at < 0 or at + len(piece) > len(data):
            raise ValueError("a block lies outside of its array")
        data[at : at + len(piece)] = piece
    return np.frombuffer(bytes(data), dtype=dtype).reshape(shape)
