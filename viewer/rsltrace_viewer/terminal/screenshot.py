"""A screen of the viewer as a picture (SVG) or text, drawn without a terminal."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from rsltrace_viewer.terminal.app import ViewerApp
    from rsltrace_viewer.terminal.recordings import RecordingApp

    Shown: TypeAlias = ViewerApp | RecordingApp

_FONT_FACE = re.compile(r"@font-face\s*\{[^}]*\}\s*")
_FONTS = 'font-family: "Fira Code", "DejaVu Sans Mono", Menlo, Consolas, monospace;'
_SETTLE_S = 30.0
_PAUSE_S = 0.03


def screen_of(app: Shown, size: tuple[int, int], keys: Sequence[str] = (), *, svg: bool) -> str:
    """Return what ``app`` shows on a screen of ``size`` cells after ``keys`` were pressed.

    Keys are named as Textual does (``down``, ``n``, ``slash``).
    """
    return asyncio.run(_screen_of(app, size, keys, svg=svg))


async def _screen_of(app: Shown, size: tuple[int, int], keys: Sequence[str], *, svg: bool) -> str:
    async with app.run_test(size=size, notifications=True) as pilot:
        await settle(app, pilot.pause)
        for key in keys:
            await pilot.press(key)
            await settle(app, pilot.pause)
        if svg:
            picture = app.export_screenshot(title=f"rsltrace view {app.session.title()}")
            # The picture must not fetch fonts from somebody's server when it is looked at.
            picture = _FONT_FACE.sub("", picture)
            return re.sub(r"font-family: Fira Code[^;]*;", _FONTS, picture)
        return text_of(app)


def text_of(app: Shown) -> str:
    """Return the screen as lines of text; none ends in spaces."""
    # Textual has pictures only; this is what it makes them of.
    strips = app.screen._compositor.render_strips(app.size)
    return "\n".join(strip.text.rstrip() for strip in strips) + "\n"


async def settle(app: Shown, pause: object) -> None:
    """Wait until nothing works in the background and the screen is drawn."""
    assert callable(pause)
    loop = asyncio.get_running_loop()
    end = loop.time() + _SETTLE_S
    quiet = 0
    while quiet < 2 and loop.time() < end and app._exception is None:
        await pause(_PAUSE_S)
        busy = app.busy or any(worker.is_running for worker in app.workers)
        quiet = 0 if busy else quiet + 1
