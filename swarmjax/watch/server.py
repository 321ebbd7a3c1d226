"""Answers a browser on this machine: the page, what it shows, its figures and its replay.

Nothing is read from disk for an answer, so no path leads to a file. Only this machine can connect.
A page elsewhere whose name is made to lead here (DNS rebinding) sends its own name as Host and is
refused; it cannot read answers otherwise, since none allows another origin.
"""

import json
import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from swarmjax.config import ConfigError
from swarmjax.watch import page
from swarmjax.watch.view import Views

ADDRESS = "127.0.0.1"
_HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_TIMEOUT_S = 10.0  # for which a connection may say nothing


class Server(ThreadingHTTPServer):
    """Listens on the loopback alone."""

    daemon_threads = True

    def __init__(self, port: int, views: Views) -> None:
        """Takes the port; 0 is any that is free.

        Raises:
          ConfigError: if it cannot be had.
        """
        self.views, self.page = views, page.page(views.run)
        try:
            super().__init__((ADDRESS, port), Answers)
        except OSError as error:
            raise ConfigError(
                f"port is {port}, which cannot be had ({error.strerror}): give another, or 0 for "
                "any that is free."
            ) from None

    def handle_error(self, request: object, client_address: object) -> None:
        """Says nothing of a browser that has gone before it had its answer."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)  # pyright: ignore[reportArgumentType]

    @property
    def url(self) -> str:
        """Of the page."""
        return f"http://{ADDRESS}:{self.server_port}/"

    @property
    def hosts(self) -> tuple[str, str]:
        """What a browser on this machine sends as Host."""
        return f"{ADDRESS}:{self.server_port}", f"localhost:{self.server_port}"


class Answers(BaseHTTPRequestHandler):
    """Answers one connection."""

    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]
    server_version, sys_version = "swarmjax", ""
    timeout = _TIMEOUT_S

    def do_GET(self) -> None:  # as the library calls it
        """Answers with what there is under a path."""
        if self._is_foreign():
            return
        found = self._find(self.path.partition("?")[0])
        if found is None:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", b"There is no such page.\n")
            return
        kind, content, frames = found
        self._send(HTTPStatus.OK, kind, content, {"Content-Security-Policy": frames})

    def _find(self, path: str) -> tuple[str, bytes, str] | None:
        """Finds the type, the content and who may frame it; None if there is none."""
        views = self.server.views
        html, unframed = "text/html; charset=utf-8", "frame-ancestors 'none'"
        if path == "/":
            return html, self.server.page.encode(), unframed
        if path == "/state.json":
            return "application/json", json.dumps(views.state()).encode(), unframed
        if path == "/replay.html" and views.replayed.newest is not None:
            return html, views.replayed.newest.page.encode(), "frame-ancestors 'self'"
        name = path.removeprefix("/figures/").removesuffix(".png")
        if path == f"/figures/{name}.png" and name in views.drawn.figures:
            return "image/png", views.drawn.figures[name], unframed
        return None

    def _refuse(self) -> None:
        """Refuses what would change something."""
        if not self._is_foreign():
            text = b"This page is to be read: GET alone.\n"
            self._send(HTTPStatus.METHOD_NOT_ALLOWED, "text/plain", text, {"Allow": "GET"})

    do_HEAD = do_POST = do_PUT = do_PATCH = do_DELETE = do_OPTIONS = do_TRACE = _refuse  # noqa: N815
    do_CONNECT = _refuse  # noqa: N815

    def _is_foreign(self) -> bool:
        """Refuses a request that was meant for another host; tells whether it did."""
        if self.headers.get_all("Host") in [[host] for host in self.server.hosts]:
            return False
        self._send(
            HTTPStatus.MISDIRECTED_REQUEST, "text/plain", f"Open {self.server.url}\n".encode()
        )
        return True

    def _send(
        self, status: HTTPStatus, kind: str, content: bytes, more: dict[str, str] | None = None
    ) -> None:
        self.send_response(status)
        sent = {"Content-Type": kind, "Content-Length": str(len(content)), **_HEADERS}
        for name, value in (sent | (more or {})).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:  # as the library has it
        """Says nothing of requests."""
