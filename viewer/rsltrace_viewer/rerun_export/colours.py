"""Colours: by topic in one run; by run, with shades by topic, in two; neutral for lanes, so that
red and green are left to what differs and what agrees.

Blue and orange are told apart by people who do not see all colours, and on paper.
"""

from __future__ import annotations

_BY_TOPIC = (0x4FC3F7FF, 0xFFB74DFF, 0x81C784FF, 0xE57373FF, 0xBA68C8FF, 0xFFF176FF, 0xA1887FFF)
_BY_RUN = {
    "a": (0x4FA3FFFF, 0x1F6FEBFF, 0x9CCBFFFF, 0x5E7CE2FF),
    "b": (0xFF9D3BFF, 0xE06C00FF, 0xFFC98FFF, 0xC98A2BFF),
}


def colour(root: str, number: int) -> int:
    """Return the colour (0xRRGGBBAA) of topic or curve ``number`` in a run (``a``, ``b`` or "")."""
    shades = _BY_RUN.get(root, _BY_TOPIC)
    return shades[number % len(shades)]


_LANES = (0x5B7083FF, 0x8296A8FF, 0x46586AFF, 0x6C7F93FF, 0x9BAAB8FF)


def lane(number: int) -> int:
    """Return the colour (0xRRGGBBAA) of callback ``number`` of a node."""
    return _LANES[number % len(_LANES)]
