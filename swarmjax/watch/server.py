"""Serves the page, its data, its figures and its replay to a browser on this machine.

No request reads from disk, so no path leads to a file. Only this machine can connect. A foreign
page may redirect its own name to this address (DNS rebinding), but its requests carry that name as
Host and are refused. Without rebinding it cannot read answers either, since no answer allows
another origin.
"""

import json
import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from swarmjax.config import ConfigError
from swarmjax.pages import builder
from swarmjax.watch.view import Views

ADDRESS = "127.0.0.1"
# The page may load only from its own server: the requests of its script, and the replay's frame.
_SOURCES = {"img-src": "'self' data:", "connect-src": "'self'", "frame-src": "'self'"}
_HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_SILENT_S = 10.0  # a connection that sends nothing for this long is closed


class Server(ThreadingHTTPServer):
    """Listens only on the loopback."""

    daemon_threads = True

    def __init__(self, port: int, views: Views) -> None:
        """Opens the port; 0 means any free port.

        Raises:
          ConfigError: if the port is not available.
        """
        self.views = views
        self.page = builder.render(
            "watch/watch.html",
            styles=(builder.STYLE, "watch/watch.css"),
            script=builder.read("watch/watch.js"),
            sources=_SOURCES,
            title=f"Watching {views.run}",
        )
        try:
            super().__init__((ADDRESS, port), Answers)
        except OSError as error:
            raise ConfigError(
                f"port is {port}, which is not available ({error.strerror}): give another, or 0 "
                "for any free port."
            ) from None

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignores a browser that has closed the connection before it received its answer."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)  # pyright: ignore[reportArgumentType]

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{ADDRESS}:{self.server_port}/"

    @property
    def hosts(self) -> tuple[str, str]:
        """Values that a browser on this machine sends as Host."""
        return f"{ADDRESS}:{self.server_port}", f"localhost:{self.server_port}"


class Answers(BaseHTTPRequestHandler):
    """Answers one connection."""

    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]
    server_version, sys_version = "swarmjax", ""
    timeout = _SILENT_S

    def do_GET(self) -> None:  # the name that the library calls; it refuses other methods
        """Answers with the content at a path."""
        if self.headers.get_all("Host") not in [[host] for host in self.server.hosts]:
            text = f"Open {self.server.url}\n".encode()
            self._send(HTTPStatus.MISDIRECTED_REQUEST, "text/plain", text)
            return
        answer = self._find(self.path.partition("?")[0])
        if answer is None:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", b"There is no such page.\n")
            return
        self._send(HTTPStatus.OK, *answer)

    def _find(self, path: str) -> tuple[Any, ...] | None:
        """Returns type, content and perhaps framing policy of a page; None if there is none."""
        views = self.server.views
        html = "text/html; charset=utf-8"
        if path == "/":
            return html, self.server.page.encode()
        if path == "/state.json":
            return "application/json", json.dumps(views.state()).encode()
        if path == "/replay.html" and views.replay:
            return html, views.replay.encode(), "frame-ancestors 'self'"
        figures = {f"/figures/{name}.png": png for name, png in views.figures.items()}
        return ("image/png", figures[path]) if path in figures else None

    def _send(
        self, status: HTTPStatus, kind: str, content: bytes, framing: str = "frame-ancestors 'none'"
    ) -> None:
        self.send_response(status)
        about = {"Content-Type": kind, "Content-Length": str(len(content))}
        for name, value in (about | _HEADERS | {"Content-Security-Policy": framing}).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:  # the library's names of arguments
        """Logs nothing about requests."""
