"""The hashes that make runs comparable: a chain over all events, a fold over their outputs.

    chain_0 = H(rest_0, seed 0)          chain_i = H(rest_i, seed chain_{i-1})

where ``rest_i`` is event i as packed by ``EVENT_REST`` (without the chain hash) and H is XXH3-64. A
chain hash covers the run up to its event: two traces agree up to event i exactly when their chain
hashes agree at i. An event's output hash folds its outputs:

    h = 0, then for each output in order: h = H(packed[OUTPUT_HASHED], seed h)

XXH3 is not cryptographic: it finds differences, but cannot stop somebody who wants runs to collide.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import xxhash

from rsltrace.trace.format import EVENT_REST, OUTPUT_HASHED
from rsltrace.trace.model.entity import Entity

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

hash64 = xxhash.xxh3_64_intdigest
"""``hash64(data: bytes, seed: int = 0) -> int``: XXH3-64. The library's own function without a
wrapper, since the loop calls it several times per event."""


def digest_text(chain_hash: int) -> str:
    """Return a run's digest: its last chain hash (0: no events) in hex."""
    return f"{chain_hash:016x}"


def identity_hash(entity: Entity) -> int:
    """Return the content hash of the output that made an entity."""
    identity = f"{entity.node}\0{int(entity.kind)}\0{entity.name}\0{entity.type}"
    return hash64(identity.encode())


def output_hash(packed_outputs: Iterable[bytes]) -> int:
    """Return the output hash of an event from its outputs, packed by ``OUTPUT``, in order."""
    folded = 0
    for packed in packed_outputs:
        folded = hash64(packed[OUTPUT_HASHED], folded)
    return folded


def verify_chain(events: npt.NDArray[np.void], previous: int = 0) -> int | None:
    """Check the chain hashes of consecutive events.

    ``events`` is EVENT_DTYPE, shape (n,); ``previous`` is the chain hash before the first (0 at the
    start). Returns the position of the first event whose chain hash is wrong, or None.
    """
    packed = events.tobytes()
    size = events.itemsize
    start_of_rest = size - EVENT_REST.size
    hashes: list[int] = events["chain_hash"].tolist()
    for position, chain_hash in enumerate(hashes):
        offset = position * size
        previous = hash64(packed[offset + start_of_rest : offset + size], previous)
        if previous != chain_hash:
            return position
    return None
