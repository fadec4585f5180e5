"""The viewer in a browser, for this machine and this user only.

textual-serve starts the viewer once per page and carries its screen over a websocket. What it lacks
is added here: any page in the same browser, and any user of the machine, could connect to the port;
its own page fetches a font from somebody's server; and a viewer outlives a server that is killed.
"""

from __future__ import annotations

import os
import secrets
import threading
import time
from collections.abc import Awaitable, Callable

from aiohttp import web
from textual_serve.server import Server

HOST = "127.0.0.1"
SERVER = "RSLTRACE_SERVER"
"""The environment variable that tells a viewer the process id of its server."""
_NAMES = (HOST, "localhost")
_LOOK_EVERY_S = 0.5


def end_with_server() -> None:
    """End this process when the server that has started it is gone, if one has.

    Its input ends then, too, but a viewer does not notice that, and would spin for ever.
    """
    server = os.environ.get(SERVER, "")
    if server.isdecimal():
        threading.Thread(target=_watch, args=(int(server),), daemon=True).start()


def _watch(server: int) -> None:
    while os.getppid() == server:
        time.sleep(_LOOK_EVERY_S)
    os._exit(1)


class LocalServer(Server):  # type: ignore[misc]  # textual-serve has no types
    """Serves one command at 127.0.0.1, to its own page only; that fetches nothing elsewhere.

    ``address`` has a token in it, without which nothing is served.
    """

    def __init__(self, command: str, port: int) -> None:
        # No shell stays between the server and its viewers, which look whether it is still there.
        super().__init__(f"exec {command}", host=HOST, port=port, title="rsltrace view")
        os.environ[SERVER] = str(os.getpid())
        self._token = secrets.token_urlsafe(24)
        self.address = f"http://{HOST}:{port}/{self._token}/"
        self._hosts = {f"{name}:{port}" for name in _NAMES}
        own = " ".join(f"http://{host}" for host in sorted(self._hosts))
        sockets = own.replace("http:", "ws:")
        self._policy = (
            f"default-src {own} 'unsafe-inline' data: blob:; connect-src {own} {sockets}; "
            "frame-ancestors 'none'"
        )

    async def _make_app(self) -> web.Application:
        app = web.Application(middlewares=[self._own_pages_only])
        app.on_response_prepare.append(self._say_policy)
        app.add_subapp(f"/{self._token}", await super()._make_app())
        return app

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
