"""A colour for each node: the same in list, lanes and graph, and in runs of the same nodes."""

from __future__ import annotations

from collections.abc import Iterable
from zlib import crc32

NODE_COLOURS = (
    ("#76e2e3", "#086869"),
    ("#b4cffe", "#2855ad"),
    ("#ebb9f7", "#7e388e"),
    ("#cfc5fe", "#6044a6"),
    ("#719def", "#032e84"),
    ("#2eabe1", "#063d54"),
    ("#c282d0", "#570c66"),
    ("#a28ee8", "#3f1c7c"),
)
"""For a dark and for a light background. Red, amber and green are left out: they mean that runs
differ."""


def node_colours(names: Iterable[str]) -> dict[str, int]:
    """Return the colour of each node, its place in ``NODE_COLOURS``.

    It follows from the name; of two nodes with the same one, the later name takes the next that is
    free.
    """
    count, found, used = len(NODE_COLOURS), dict[str, int](), set[int]()
    for name in sorted(set(names)):
        wanted = crc32(name.encode(errors="replace")) % count
        order = [*range(wanted, count), *range(wanted)]
        found[name] = next((one for one in order if one not in used), wanted)
        used.add(found[name])
    return found
