"""Hashing the data of arrays in place: equal numbers count as equal, -0.0 and NaN included."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import xxhash

_hash64: Callable[[Any], int] = xxhash.xxh3_64_intdigest


def array_hash(value: Any, seen: dict[str, dict[int, int]]) -> int:
    """Return the hash of an array's data, in which equal numbers count as equal.

    It is done in blocks, and ``seen`` remembers, by type, the canonical hash of a block by its
    plain one: what has not changed is read only once.
    """
    data = np.ascontiguousarray(value)
    dtype = data.dtype
    if dtype.kind not in "fc" or not data.size:
        return _hash64(data.view(np.uint8) if dtype.kind in "UMm" and data.size else data)
    parts = data.reshape(-1)
    if dtype.kind == "c":
        parts = parts.view(data.real.dtype)
    size = parts.itemsize
    if size > 8:  # long doubles have padding, which is never set
        with np.errstate(all="ignore"):
            high = parts.astype(np.float64)
            low = np.where(np.isfinite(high), parts - high, 0).astype(np.float64)
        return _hash64(struct.pack("<2Q", array_hash(high, seen), array_hash(low, seen)))
    kind = parts.dtype.str
    known = seen.get(kind)
    if known is None or len(known) > _SEEN_MAX:
        known = seen[kind] = {}
    count = _BLOCK_BYTES // size
    digests = []
    for start in range(0, len(parts), count):
        block = parts[start : start + count]
        plain = _hash64(block)
        digest = known.get(plain)
        if digest is None:
            # As it is, a block nearly always is in its canonical form.
            digest = _canonical_hash(block) if _has_several_forms(block, kind) else plain
            known[plain] = digest
        digests.append(digest)
    return digests[0] if len(digests) == 1 else _hash64(struct.pack(f"<{len(digests)}Q", *digests))


def _canonical_hash(block: Any) -> int:
    canonical = block.copy()
    canonical[canonical == 0.0] = 0.0
    canonical[np.isnan(canonical)] = np.nan
    return _hash64(canonical)


def _has_several_forms(parts: Any, kind: str) -> bool:
    """Return whether there is a -0.0 or a NaN among floats: two quick looks, rarely true."""
    smallest = float(_smallest(parts))
    if smallest > 0.0:
        return False
    if smallest != smallest:
        return True
    integers, lowest = _INTEGERS[kind]
    return int(_smallest(parts.view(integers))) == lowest


_INTEGERS = {
    f"{order}f{size}": (np.dtype(f"{order}i{size}"), -(1 << (8 * size - 1)))
    for order in "<>"
    for size in (2, 4, 8)
}
"""Integers as wide as floats, and the smallest of them: it has the bit pattern of -0.0."""

_smallest: Any = np.minimum.reduce
_BLOCK_BYTES = 256 << 10
_SEEN_MAX = 1 << 14
