"""What a person sees: golden screens in every size and theme, readable colours in both themes.

A screen is its text at 80x24 and 120x36, the largest at 200x60; of a few there is a map of the
styles of its cells, too (NAME_THEME_80x24.txt): a letter each, with a legend.

``pytest --update-golden tests/viewer/test_viewer_screens.py`` rewrites them; look at their diff.
"""

from __future__ import annotations

import string
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.cells import cell_len

Drive = Callable[..., None]
Golden = Callable[[str, str], None]

SCREENS: dict[str, list[str]] = {
    "start": [],
    "event": ["j", "j", "j"],
    "zoomed": ["j", "j", "j", *["plus"] * 12],
    "exception": ["x"],
    "filter": ["F", *"kind", "colon", *"srv", "enter"],
    "asking": ["F", *"kin"],
    "help": ["question_mark"],
    "plot": ["p"],
    "palette": ["ctrl+p"],
    "overview": ["O"],
}
SCREENS_OF_TWO: dict[str, list[str]] = {"divergence": [], "report": ["v"], "plot_of_two": ["p"]}


NAMES = [*SCREENS, *SCREENS_OF_TWO]
SIZED = [(name, (120, 36)) for name in NAMES] + [("start", (200, 60)), ("divergence", (200, 60))]
SIZE_IDS = [f"{name}-{width}x{height}" for name, (width, height) in SIZED]
STYLED = ("event", "exception", "filter", "divergence", "plot_of_two")
THEMED = [(name, light) for name in NAMES for light in (False, True) if not light or name in STYLED]
THEME_IDS = [f"{name}-{'light' if light else 'dark'}" for name, light in THEMED]


@pytest.fixture
def shown(
    made: Path, pair: tuple[Path, Path], drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., None]:
    """``shown(name, check, size, light)`` calls ``check`` with the viewer at a screen."""

    def show(name: str, check: Callable[[Any], None], size: tuple[int, int], light: bool) -> None:
        async def steps(viewer: Any) -> None:
            await viewer.press(*(SCREENS | SCREENS_OF_TWO)[name])
            check(viewer)

        monkeypatch.chdir(pair[0].parent)  # the report names the files as they were given
        two = (Path(pair[0].name), Path(pair[1].name))
        drive(two if name in SCREENS_OF_TWO else made, steps, size=size, light=light)

    return show


@pytest.mark.few(3)
@pytest.mark.parametrize(("name", "size"), SIZED, ids=SIZE_IDS)
def test_text_of_larger_screens(
    shown: Callable[..., None], golden: Golden, name: str, size: tuple[int, int]
) -> None:
    def check(viewer: Any) -> None:
        golden(f"{name}_{size[0]}x{size[1]}.txt", viewer.text)

    shown(name, check, size, light=False)


@pytest.mark.few(3)
@pytest.mark.parametrize(("name", "light"), THEMED, ids=THEME_IDS)
def test_text_and_styles_of_screens(
    shown: Callable[..., None], golden: Golden, name: str, light: bool
) -> None:
    def check(viewer: Any) -> None:
        golden(f"{name}_80x24.txt", viewer.text)  # no theme changes what it says
        if name in STYLED:
            golden(f"{name}_{'light' if light else 'dark'}_80x24.txt", _styles(viewer.app))

    shown(name, check, (80, 24), light)


def _styles(app: Any) -> str:
    """Return the styles of the cells of a screen as a map, and a legend."""
    legend: dict[str, str] = {}
    lines = []
    for strip in app.screen._compositor.render_strips(app.size):
        line = ""
        for text, style, _ in strip:
            letter = legend.setdefault(_look(style), _LETTERS[len(legend)])
            line += letter * cell_len(text)
        lines.append(line)
    return "\n".join([*lines, "", *(f"{letter} {look}" for look, letter in legend.items()), ""])


_LETTERS = string.ascii_letters + string.digits


def _look(style: Any) -> str:
    if style is None:
        return "plain"
    marks = " ".join(name for name in _MARKS if getattr(style, name))
    colours = " on ".join(c.name if c else "default" for c in (style.color, style.bgcolor))
    return f"{colours} {marks}".strip()


_MARKS = ("bold", "dim", "italic", "underline", "reverse")


@pytest.mark.few(1)
@pytest.mark.parametrize("light", [False, True], ids=["dark", "light"])
def test_all_text_stands_out_from_its_background(
    pair: tuple[Path, Path], drive: Drive, light: bool
) -> None:
    async def steps(viewer: Any) -> None:
        for keys in ([], ["n"], ["tab"], ["question_mark"], ["escape", "v"], ["escape", "p"]):
            await viewer.press(*keys)
            for strip in viewer.app.screen._compositor.render_strips(viewer.app.size):
                for text, style, _ in strip:
                    if not text.strip() or style is None or _is_graphic(text.strip()):
                        continue
                    ratio = _contrast(style)
                    assert ratio is None or ratio >= 3.0, (keys, text, str(style), ratio)

    drive(pair, steps, light=light)


def _is_graphic(text: str) -> bool:
    """Borders, bars and scrollbars may be faint."""
    return all("─" <= c <= "⣿" for c in text)


def _contrast(style: Any) -> float | None:
    """Return the contrast ratio of WCAG of a style's colours."""
    if style.color is None or style.bgcolor is None or style.color.triplet is None:
        return None
    if style.bgcolor.triplet is None:
        return None
    one, other = (_luminance(c.triplet) for c in (style.color, style.bgcolor))
    return (max(one, other) + 0.05) / (min(one, other) + 0.05)


def _luminance(triplet: Any) -> float:
    parts = [value / 255 for value in triplet]
    linear = [p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
