"""The viewer in a browser, for this machine only.

textual-serve starts the viewer once per page and carries its screen over a websocket. What it lacks
is added here: any page in the same browser could connect to the port, and its own page fetches a
font from somebody's server.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from aiohttp import web
from textual_serve.server import Server

HOST = "127.0.0.1"
_NAMES = (HOST, "localhost")


class LocalServer(Server):  # type: ignore[misc]  # textual-serve has no types
    """Serves one command at 127.0.0.1, to its own page only; that fetches nothing elsewhere."""

    def __init__(self, command: str, port: int) -> None:
        super().__init__(command, host=HOST, port=port, title="rsltrace view")
        self._hosts = {f"{name}:{port}" for name in _NAMES}
        own = " ".join(f"http://{host}" for host in sorted(self._hosts))
        sockets = own.replace("http:", "ws:")
        self._policy = (
            f"default-src {own} 'unsafe-inline' data: blob:; connect-src {own} {sockets}; "
            "frame-ancestors 'none'"
        )

    async def _make_app(self) -> web.Application:
        app: web.Application = await super()._make_app()
        app.middlewares.append(self._own_pages_only)
        app.on_response_prepare.append(self._say_policy)
        return app

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
