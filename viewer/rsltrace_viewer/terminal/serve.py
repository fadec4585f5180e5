"""The viewer in a browser, for this machine and this user only.

textual-serve starts the viewer once per page and carries its screen over a websocket. What it lacks
is added here: any page in the same browser, and any user of the machine, could connect to the port;
its own page fetches a font from somebody's server and takes no key before a click; each page starts
one more viewer, of the size that it asks for; and what pages send is written to the terminal.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
from collections.abc import Awaitable, Callable
from typing import Any

from aiohttp import WSMsgType, web
from textual_serve.app_service import AppService
from textual_serve.server import Server

from rsltrace.terminal import tell

HOST = "127.0.0.1"
_NAMES = (HOST, "localhost")
_QUIT_S = 10.0
_PAGES_MAX = 12
_SIZE = (("width", 80), ("height", 24))
_SIDE_MAX = 1000
"""Columns or rows of a page; Textual keeps several objects for each cell."""
_TAKE_KEYS = """<script>
new MutationObserver((_, watch) => {
  if (!document.body.classList.contains("-first-byte")) return;
  watch.disconnect();
  document.querySelector("#terminal textarea")?.focus();
}).observe(document.documentElement, {subtree: true, attributeFilter: ["class"]});
</script></head>"""
_NO_MESSAGE = (ValueError, TypeError, KeyError, OverflowError, RecursionError)


class LocalServer(Server):  # type: ignore[misc]  # textual-serve has no types
    """Serves one command at 127.0.0.1, to its own page only; that fetches nothing elsewhere.

    ``address`` has a token in it, without which nothing is served.
    """

    def __init__(self, command: str, port: int) -> None:
        # No shell stays between the server and its viewers, which end with it.
        super().__init__(f"exec {command}", host=HOST, port=port, title="rsltrace view")
        self._token = secrets.token_urlsafe(24)
        self.address = f"http://{HOST}:{port}/{self._token}/"
        self._hosts = {f"{name}:{port}" for name in _NAMES}
        own = " ".join(f"http://{host}" for host in sorted(self._hosts))
        sockets = own.replace("http:", "ws:")
        self._pages = 0
        self._policy = (
            f"default-src {own} 'unsafe-inline' data: blob:; connect-src {own} {sockets}; "
            "frame-ancestors 'none'"
        )

    async def _make_app(self) -> web.Application:
        app = web.Application(middlewares=[self._own_pages_only])
        app.on_response_prepare.append(self._say_policy)
        app.add_subapp(f"/{self._token}", await super()._make_app())
        return app

    def initialize_logging(self) -> None:
        """Log nothing of what pages and strangers send: it is theirs, and the address a secret."""
        logging.getLogger("textual-serve").handlers = [_OneLine()]
        for name in ("textual-serve", "aiohttp.access", "aiohttp.server", "asyncio"):
            logging.getLogger(name).propagate = False
        for name in ("aiohttp.access", "aiohttp.server", "asyncio"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)

    async def handle_index(self, request: web.Request) -> web.Response:
        """Return the page, which takes keys as soon as it shows the viewer."""
        page = await super().handle_index(request)
        assert isinstance(page, web.Response)
        page.text = str(page.text).replace("</head>", _TAKE_KEYS)
        return page

    async def handle_websocket(self, request: web.Request) -> web.WebSocketResponse:
        """Start a viewer for a page, if there are not too many of them.

        :raises HTTPException: there are, or the size of its window is none.
        """
        try:
            size = {side: str(_side(request.query.get(side, cells))) for side, cells in _SIZE}
        except _NO_MESSAGE:
            raise web.HTTPBadRequest(text="no such size of a window") from None
        if self._pages >= _PAGES_MAX:
            raise web.HTTPServiceUnavailable(text=f"{_PAGES_MAX} pages are open: close one")
        self._pages += 1
        try:
            answer = await super().handle_websocket(
                request.clone(rel_url=request.rel_url.with_query(size))
            )
            assert isinstance(answer, web.WebSocketResponse)
            return answer
        finally:
            self._pages -= 1

    async def _process_messages(
        self, websocket: web.WebSocketResponse, app_service: AppService
    ) -> None:
        """Hand on what a page says, until it says what no page does."""
        try:
            async for message in websocket:
                if message.type is WSMsgType.TEXT:
                    await _hand_on(message.data, websocket, app_service)
        except _NO_MESSAGE:
            await websocket.close(code=1003, message=b"no message of the viewer's page")
        finally:
            asyncio.get_running_loop().call_later(_QUIT_S, _kill, app_service)

    async def on_startup(self, app: web.Application) -> None:
        """Say nothing: who started the server says where it is."""

    @web.middleware
    async def _own_pages_only(
        self,
        request: web.Request,
        handler: Callable[[web.Request], Awaitable[web.StreamResponse]],
    ) -> web.StreamResponse:
        origin = request.headers.get("Origin")
        if request.host not in self._hosts or (
            origin is not None and origin.removeprefix("http://") not in self._hosts
        ):
            raise web.HTTPForbidden(text="this viewer is for pages of this machine only")
        return await handler(request)

    async def _say_policy(self, request: web.Request, response: web.StreamResponse) -> None:
        response.headers["Content-Security-Policy"] = self._policy


async def _hand_on(text: str, websocket: web.WebSocketResponse, app_service: AppService) -> None:
    """Hand a page's message on to its viewer. Raises one of ``_NO_MESSAGE`` if it is none."""
    kind, *rest = json.loads(text)
    payload: Any = rest[0] if rest else None
    if kind == "stdin":
        await app_service.send_bytes(str.encode(payload, "utf-8", "replace"))
    elif kind == "resize":
        await app_service.set_terminal_size(_side(payload["width"]), _side(payload["height"]))
    elif kind == "ping":
        await websocket.send_json(["pong", payload])
    elif kind == "blur":
        await app_service.blur()
    elif kind == "focus":
        await app_service.focus()


def _side(cells: int | str) -> int:
    """Return a number of columns or rows that a viewer can have (a hidden window has none).

    Raises ValueError, TypeError or OverflowError if it is no number.
    """
    return min(max(int(cells), 1), _SIDE_MAX)


def _kill(app_service: AppService) -> None:
    """End a viewer that was asked to quit and still runs."""
    process = app_service._process
    if process is not None and process.returncode is None:
        process.kill()


class _OneLine(logging.Handler):
    """Tells what went wrong with a viewer in one line."""

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.ERROR:
            tell(f"rsltrace view: {record.getMessage()}")
