"""The graph of a job as a picture: nodes and what connects them, from left to right.

The layers, their order and the routes of the edges are fast-sugiyama's (no Graphviz needed); boxes,
arrows and text are drawn here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from itertools import pairwise
from math import atan2, cos, hypot, sin
from typing import Literal
from xml.sax.saxutils import escape

from rsltrace.errors import SetupError
from rsltrace.simulation.middleware.overview import GraphEnd, GraphLink, GraphOverview
from rsltrace.trace.model.texts import printable
from rsltrace.trace.words.entities import NODE_COLOURS, node_colours

_CHARACTER = 7.3
_ROW = 54.0
_BOX_HEIGHT = 28.0
_GAP = 70.0
_MARGIN = 24.0
_BACK, _CORNER = 14.0, 8.0
"""How far from the boxes an arrow goes back, and how round its corners are."""

_STYLE = """\
text { font: 12px ui-monospace, "DejaVu Sans Mono", monospace; fill: #1f2328; }
.small { font-size: 10px; fill: #57606a; }
.node rect { fill: #ddf4ff; stroke: #0969da; }
.topic rect { fill: #ffffff; stroke: #8c959f; }
.service rect { fill: #fff8c5; stroke: #9a6700; }
.action rect { fill: #fbefff; stroke: #8250df; }
.edge { fill: none; stroke: #57606a; stroke-width: 1.3; }
.back { stroke: #8c959f; }
.apart { stroke: #cf222e; stroke-dasharray: 5 4; stroke-width: 1.6; }
.lonely rect { stroke-dasharray: 3 3; }
""" + "".join(
    f".c{number} rect {{ stroke: {light}; stroke-width: 2; }}\n"
    for number, (_, light) in enumerate(NODE_COLOURS)
)


@dataclass
class _Box:
    """A node or a link: what is written in it, and where its middle is."""

    label: str
    kind: str
    title: str
    lonely: bool = False
    colour: int | None = None
    """Of a node, its place in ``NODE_COLOURS``."""
    x: float = 0.0
    y: float = 0.0

    @property
    def width(self) -> float:
        return len(self.label) * _CHARACTER + 22


@dataclass
class _Edge:
    """An arrow between boxes. ``incompatible`` names the policies for which it never connects.
    ``back`` goes against the direction of the picture: it runs around the boxes, so that no arrow
    seems to have a head at either end, or to come from a box that it passes."""

    source: int
    target: int
    back: bool = False
    incompatible: str = ""
    through: list[tuple[float, float]] = field(default_factory=list)


def graph_svg(overview: GraphOverview, *, in_page: bool = False) -> str:
    """Return the picture of a graph, the same for the same graph; ``in_page`` leaves colours and
    background to the page around it.

    :raises SetupError: if the library that lays it out is not installed.
    """
    boxes, edges = _boxes_and_edges(overview)
    if edges:
        _lay_out(boxes, edges)
    _place_alone(boxes, edges)
    colours = node_colours(box.label for box in boxes if box.kind == "node")
    for box in boxes:
        box.colour = colours[box.label] if box.kind == "node" else None
    return "\n".join(_svg(boxes, edges, in_page)) + "\n"


def _boxes_and_edges(overview: GraphOverview) -> tuple[list[_Box], list[_Edge]]:
    boxes = [_Box(node.name, "node", node.type) for node in overview.nodes]
    number = {node.name: index for index, node in enumerate(overview.nodes)}
    edges: list[_Edge] = []
    for link in overview.links:
        here = len(boxes)
        lonely = not link.senders or not link.receivers
        boxes.append(_Box(link.name, link.kind, link.type, lonely))
        senders = _numbers(link.senders, number, boxes)
        receivers = _numbers(link.receivers, number, boxes)
        for sender in senders:
            edges.append(
                _Edge(sender, here, incompatible=_incompatible(link, boxes[sender].label, 0))
            )
        edges += [
            _Edge(
                here, receiver, receiver in senders, _incompatible(link, boxes[receiver].label, 1)
            )
            for receiver in receivers
        ]
    return boxes, edges


def _numbers(ends: tuple[GraphEnd, ...], number: dict[str, int], boxes: list[_Box]) -> list[int]:
    found: dict[int, None] = {}
    for end in ends:
        name = end.node
        if name not in number:  # the bag player, or a node that is gone
            number[name] = len(boxes)
            boxes.append(_Box(name, "node", ""))
        found[number[name]] = None
    return list(found)


def _incompatible(link: GraphLink, name: str, side: Literal[0, 1]) -> str:
    """Return the policies by which a node connects with nobody at the other end."""
    pairs = [pair for pair in link.incompatible if pair[side].node == name]
    others = {end.node for end in (link.senders if side else link.receivers)}
    partners = {(receiver if side == 0 else sender).node for sender, receiver, _ in pairs}
    if others and partners >= others:
        return ", ".join(dict.fromkeys(pair[2] for pair in pairs))
    return ""


def _lay_out(boxes: list[_Box], edges: list[_Edge]) -> None:
    if find_spec("fast_sugiyama") is None:
        raise SetupError(
            "drawing a graph needs fast-sugiyama, which comes with rsltrace for Python 3.11 or "
            "newer: pip install fast-sugiyama"
        )
    from fast_sugiyama import from_edges

    # Its vertices are the boxes in order of use, so that equal graphs give equal pictures.
    pairs = [(edge.source, edge.target) for edge in edges if not edge.back]
    above = 0.0
    placed: dict[int, tuple[float, float]] = {}
    for positions, _, height, layout_edges in from_edges(pairs, vertex_spacing=_ROW):
        points = {vertex: (height - y, x) for vertex, (x, y) in positions}
        top = min(y for _, y in points.values())
        bottom = max(y for _, y in points.values())
        points = {vertex: (x, y - top + above) for vertex, (x, y) in points.items()}
        above += bottom - top + _ROW * 1.5
        placed.update((v, p) for v, p in points.items() if 0 <= v < len(boxes))
        _route(edges, points, layout_edges or [], len(boxes))
    layers = sorted({x for x, _ in placed.values()})
    left = _columns(boxes, placed, layers)
    for vertex, (x, y) in placed.items():
        boxes[vertex].x, boxes[vertex].y = left[x], y
    for edge in edges:
        edge.through = [(left.get(x, x), y) for x, y in edge.through]
        edge.back = boxes[edge.target].x <= boxes[edge.source].x


def _columns(
    boxes: list[_Box], placed: dict[int, tuple[float, float]], layers: list[float]
) -> dict[float, float]:
    """Return the middle of each layer: as wide as its widest box."""
    middles, at = {}, 0.0
    for layer in layers:
        width = max(boxes[v].width for v, (x, _) in placed.items() if x == layer)
        middles[layer] = at + width / 2
        at += width + _GAP
    return middles


def _route(
    edges: list[_Edge],
    points: dict[int, tuple[float, float]],
    pieces: list[tuple[int, int]],
    real: int,
) -> None:
    """Let long edges go through the dummy vertices that the layout gave them."""
    following: dict[int, list[int]] = {}
    for source, target in pieces:
        following.setdefault(source, []).append(target)
    for edge in edges:
        for step in following.get(edge.source, []):
            chain: list[int] = []
            while step >= real and len(chain) < len(points):
                chain.append(step)
                step = following.get(step, [edge.target])[0]
            if step == edge.target:
                edge.through = [points[vertex] for vertex in chain]
                break


def _place_alone(boxes: list[_Box], edges: list[_Edge]) -> None:
    """Put what is connected with nothing into rows below the rest."""
    connected = {end for edge in edges for end in (edge.source, edge.target)}
    bottom = max((boxes[i].y for i in connected), default=-_ROW)
    right = max((boxes[i].x + boxes[i].width / 2 for i in connected), default=0.0)
    x, y = 0.0, bottom + _ROW * 1.2
    for index, box in enumerate(boxes):
        if index in connected:
            continue
        if x and x + box.width > max(right, 800.0):
            x, y = 0.0, y + _ROW
        box.x, box.y = x + box.width / 2, y
        x += box.width + 30


def _ways_back(
    boxes: list[_Box], edges: list[_Edge], bottom: float
) -> dict[int, tuple[float, float, float]]:
    """Return where edges go back, by number: right of the column of their source, below all boxes,
    left of the column of their target."""
    ways: dict[int, tuple[float, float, float]] = {}
    for number, edge in enumerate(edges):
        if edge.back:
            source, target = boxes[edge.source].x, boxes[edge.target].x
            right = max(box.x + box.width / 2 for box in boxes if box.x == source) + _BACK
            left = min(box.x - box.width / 2 for box in boxes if box.x == target) - 1.5 * _BACK
            ways[number] = right, bottom + _BACK * len(ways), left
    return ways


def _svg(boxes: list[_Box], edges: list[_Edge], in_page: bool) -> Iterator[str]:
    points = [(x, y) for edge in edges for x, y in edge.through]
    left = min([box.x - box.width / 2 for box in boxes] + [x for x, _ in points], default=0.0)
    right = max([box.x + box.width / 2 for box in boxes] + [x for x, _ in points], default=0.0)
    rows = [box.y for box in boxes] + [y for _, y in points]
    top, bottom = min(rows, default=0.0) - _BOX_HEIGHT, max(rows, default=0.0) + _BOX_HEIGHT
    ways = _ways_back(boxes, edges, bottom)
    bottom = max([bottom, *(below for _, below, _ in ways.values())])
    width, height = right - left + 2 * _MARGIN, bottom - top + 2 * _MARGIN
    yield (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
        f'viewBox="{left - _MARGIN:.1f} {top - _MARGIN:.1f} {width:.1f} {height:.1f}">'
    )
    if not in_page:
        yield f"<style>{_STYLE}</style>"
    yield (
        '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto"><path d="M0 0 L8 4 L0 8 z" fill="#57606a"/>'
        "</marker></defs>"
    )
    if not in_page:
        yield (
            f'<rect x="{left - _MARGIN:.1f}" y="{top - _MARGIN:.1f}" width="{width:.1f}" '
            f'height="{height:.1f}" fill="#ffffff"/>'
        )
    for number, edge in enumerate(edges):
        yield _path(boxes[edge.source], boxes[edge.target], edge, ways.get(number))
    for box in boxes:
        yield _drawn(box)
    yield "</svg>"


def _path(source: _Box, target: _Box, edge: _Edge, way: tuple[float, float, float] | None) -> str:
    """``way`` is what ``_around`` gets, of an edge that goes back."""
    path = _straight(source, target, edge) if way is None else _around(source, target, *way)
    style = "edge" if way is None else "edge back"
    style += " apart" if edge.incompatible else ""
    title = (
        f"<title>does not connect: {escape(edge.incompatible)}</title>" if edge.incompatible else ""
    )
    return f'<path class="{style}" d="{path}" marker-end="url(#head)">{title}</path>'


def _around(source: _Box, target: _Box, right: float, below: float, left: float) -> str:
    """Return a way back: out of the right of one box, ``below`` all, into the left of another."""
    turns = [(right, source.y), (right, below), (left, below), (left, target.y)]
    at = (source.x + source.width / 2, source.y)
    end = (target.x - (target.width / 2 + 2), target.y)
    path = f"M{at[0]:.1f} {at[1]:.1f}"
    for (x, y), after in zip(turns, [*turns[1:], end], strict=True):
        before, behind = _towards((x, y), at), _towards((x, y), after)
        path += f" L{before} Q{x:.1f} {y:.1f} {behind}"
        at = (x, y)
    return f"{path} L{end[0]:.1f} {end[1]:.1f}"


def _towards(corner: tuple[float, float], other: tuple[float, float]) -> str:
    """Return the point near a corner where its rounding begins, on the way from another."""
    size = min(hypot(other[0] - corner[0], other[1] - corner[1]) / 2, _CORNER)
    angle = atan2(other[1] - corner[1], other[0] - corner[0])
    return f"{corner[0] + size * cos(angle):.1f} {corner[1] + size * sin(angle):.1f}"


def _straight(source: _Box, target: _Box, edge: _Edge) -> str:
    points = [(source.x, source.y), *edge.through, (target.x, target.y)]
    points[0] = (source.x + source.width / 2, source.y)
    points[-1] = (target.x - (target.width / 2 + 2), target.y)
    path = f"M{points[0][0]:.1f} {points[0][1]:.1f}"
    for (ax, ay), (bx, by) in pairwise(points):
        bend = (bx - ax) / 2
        path += f" C{ax + bend:.1f} {ay:.1f} {bx - bend:.1f} {by:.1f} {bx:.1f} {by:.1f}"
    return path


def _drawn(box: _Box) -> str:
    width, x, y = box.width, box.x - box.width / 2, box.y - _BOX_HEIGHT / 2
    radius = 6 if box.kind == "node" else _BOX_HEIGHT / 2
    lonely = " lonely" if box.lonely else ""
    colour = "" if box.colour is None else f" c{box.colour}"
    label, title = escape(printable(box.label)), escape(printable(box.title))
    return (
        f'<g class="{box.kind}{lonely}{colour}"><title>{title}</title>'
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{_BOX_HEIGHT:.0f}" '
        f'rx="{radius:.0f}"/><text x="{box.x:.1f}" y="{box.y + 4:.1f}" '
        f'text-anchor="middle">{label}</text></g>'
    )
