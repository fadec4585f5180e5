"""A web server that serves ranges of files and counts: for tests and for benchmarks."""

from __future__ import annotations

import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


class RangeServer:
    """Serves a folder. ``requests`` has the range of each request, ``sent`` counts bytes.

    ``ranges`` can be switched off, as some servers do; a ``broken`` server fails for every range.
    """

    def __init__(self, folder: Path) -> None:
        self.requests: list[str] = []
        self.sent = 0
        self.ranges = True
        self.broken = False
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *args: object) -> None:
                pass

            def do_HEAD(self) -> None:  # the base class asks for the name
                self._answer(send=False)

            def do_GET(self) -> None:
                self._answer(send=True)

            def _answer(self, *, send: bool) -> None:
                asked = self.headers.get("Range", "")
                outer.requests.append(asked)
                path = folder / self.path.lstrip("/")
                found = path.is_file()
                first, end = 0, path.stat().st_size if found else 0
                wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", asked)
                status = 200 if found else 404
                if wanted and outer.broken:
                    status, end = 500, 0
                elif wanted and outer.ranges and found:
                    first, end, status = int(wanted[1]), min(int(wanted[2]) + 1, end), 206
                self.send_response(status)
                self.send_header("Content-Length", str(end - first))
                self.end_headers()
                if send and end > first:
                    with path.open("rb") as file:
                        file.seek(first)
                        outer.sent += self.wfile.write(file.read(end - first))

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()
        self.address = f"http://127.0.0.1:{self._server.server_port}"

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
