"""Each node has a colour of its own, the same everywhere; the pane that has the focus is marked."""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from textual.color import Color

from rsltrace.cli.output.graph_svg import graph_svg
from rsltrace.simulation.middleware.overview import GraphNode, GraphOverview
from rsltrace.trace.words.entities import NODE_COLOURS, node_colours

Drive = Callable[..., None]


def test_a_colour_follows_from_the_name_and_no_two_nodes_share_one_as_long_as_there_are_some() -> (
    None
):
    names = [f"/node_{number}" for number in range(len(NODE_COLOURS))]
    found = node_colours(names)
    assert found == node_colours(reversed(names))
    assert len(set(found.values())) == len(NODE_COLOURS)
    assert set(node_colours([*names, "/one_more"]).values()) == set(found.values())
    assert all(node_colours([name])[name] == node_colours([name, name])[name] for name in names)


@pytest.mark.parametrize("colours", [*zip(*NODE_COLOURS, strict=True)], ids=["dark", "light"])
def test_no_colour_means_that_runs_differ(colours: tuple[str, ...]) -> None:
    hues = [360 * colorsys.rgb_to_hls(*Color.parse(one).normalized)[0] for one in colours]
    assert all(175 < hue < 300 for hue in hues), "red, amber and green do"


@pytest.mark.parametrize("light", [False, True], ids=["dark", "light"])
def test_a_node_has_its_colour_in_the_list_the_lanes_the_overview_and_the_graph(
    made: Path, drive: Drive, light: bool
) -> None:
    async def steps(viewer: Any) -> None:
        app = viewer.app
        wanted = NODE_COLOURS[app.session.node_colours["/talker"]][light]
        for pane in (app.lanes, app.timeline):
            assert wanted in _colours_of("/talker", app, pane.region)
        await viewer.press("O")
        assert wanted in _colours_of("/talker", app, app.screen.region)

    drive(made, steps, light=light)
    nodes = tuple(GraphNode(name, "", ()) for name in ("/talker", "/listener"))
    number = node_colours(["/talker", "/listener"])["/talker"]
    assert f'class="node c{number}"' in graph_svg(GraphOverview(nodes, ()))


def _colours_of(word: str, app: Any, region: Any) -> list[str]:
    """Return the colours in which a word stands in a part of the screen."""
    lines = app.screen._compositor.render_strips(app.size)[region.y : region.bottom]
    return [
        style.color.name
        for strip in lines
        for text, style, _ in strip
        if word in text and style is not None
    ]


@pytest.mark.parametrize("size", [(80, 24), (120, 36)])
def test_the_pane_that_has_the_focus_is_marked(
    made: Path, drive: Drive, size: tuple[int, int]
) -> None:
    async def steps(viewer: Any) -> None:
        primary = Color.parse(viewer.app.theme_variables["primary"]).hex.lower()
        seen = []
        for _ in range(3):
            pane = viewer.app.focused
            seen.append(pane.id)
            marked = {
                viewer.app.screen.get_widget_at(x, y)[0].id
                for y, strip in enumerate(
                    viewer.app.screen._compositor.render_strips(viewer.app.size)
                )
                for x, style in _cells(strip)
                if style is not None and primary in (_hex(style.bgcolor), _hex(style.color))
            }
            assert marked == {pane.id}
            await viewer.press("tab")
        assert seen == ["timeline", "inspector", "lanes"]

    drive(made, steps, size=size)


def _cells(strip: Any) -> list[tuple[int, Any]]:
    found = []
    for text, style, _ in strip:
        found += [(len(found) + offset, style) for offset in range(len(text))]
    return found


def _hex(colour: Any) -> str:
    return "" if colour is None else str(colour.name)
