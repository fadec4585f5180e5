"""What a person sees: golden screens, readable colours in both themes.

``UPDATE_GOLDEN=1 pytest tests/viewer/test_viewer_screens.py`` rewrites them; look at their diff.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Drive = Callable[..., None]
Golden = Callable[[str, str], None]

SIZES = [(80, 24), (120, 36), (200, 60)]
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
}
SCREENS_OF_TWO: dict[str, list[str]] = {"divergence": [], "report": ["v"], "plot_of_two": ["p"]}


def _keys(keys: list[str]) -> list[str]:
    return keys


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("name", [name for name in SCREENS if name != "palette"])
def test_screens_of_one_trace(
    made: Path, drive: Drive, golden: Golden, name: str, size: tuple[int, int]
) -> None:
    async def steps(viewer: Any) -> None:
        await viewer.press(*SCREENS[name])
        golden(f"{name}_{size[0]}x{size[1]}.txt", viewer.text)

    drive(made, steps, size=size)


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("name", list(SCREENS_OF_TWO))
def test_screens_of_two_traces(
    pair: tuple[Path, Path],
    drive: Drive,
    golden: Golden,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    size: tuple[int, int],
) -> None:
    monkeypatch.chdir(pair[0].parent)  # the report names the files as they were given

    async def steps(viewer: Any) -> None:
        await viewer.press(*SCREENS_OF_TWO[name])
        golden(f"{name}_{size[0]}x{size[1]}.txt", viewer.text)

    drive((Path(pair[0].name), Path(pair[1].name)), steps, size=size)


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
