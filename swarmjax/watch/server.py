"""Serves the page of a run to a browser on this machine.

The path of a request is never looked up on disk, so it cannot lead to a file. Only this machine can
connect. A foreign page may redirect its own host name to this address (DNS rebinding), but its
requests then carry that name as Host and are refused. Without rebinding, a foreign page cannot read
answers either, because no answer allows another origin.
"""

import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from swarmjax.config import ConfigError
from swarmjax.watch.live_page import LivePage

ADDRESS = "127.0.0.1"
RENEW_S = 5  # the browser loads the page again after this many seconds
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_SILENT_S = 10.0  # a connection that sends nothing for this long is closed


class Server(ThreadingHTTPServer):
    """A server that listens only on the loopback address."""

    daemon_threads = True

    def __init__(self, port: int, page: LivePage) -> None:
        """Opens the port; 0 means any free port.

        Raises:
          ConfigError: if the port is not available.
        """
        self.page = page
        try:
            super().__init__((ADDRESS, port), Answers)
        except OSError as error:
            raise ConfigError(
                f"port is {port}, which is not available ({error.strerror}): give another port, or "
                "0 for any free port."
            ) from None

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignores a browser that has closed the connection before it received its answer."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)  # pyright: ignore[reportArgumentType]

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{ADDRESS}:{self.server_port}/"

    @property
    def hosts(self) -> tuple[str, str]:
        """The values that a browser on this machine sends in the header Host."""
        return f"{ADDRESS}:{self.server_port}", f"localhost:{self.server_port}"


class Answers(BaseHTTPRequestHandler):
    """Answers the requests of one connection."""

    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]
    server_version, sys_version = "swarmjax", ""
    timeout = _SILENT_S

    def do_GET(self) -> None:  # the library calls this name, and refuses other HTTP methods
        """Answers a request with the page."""
        if self.headers.get_all("Host") not in [[host] for host in self.server.hosts]:
            self._send(HTTPStatus.MISDIRECTED_REQUEST, "text/plain", f"Open {self.server.url}\n")
        elif self.path.partition("?")[0] != "/":
            self._send(HTTPStatus.NOT_FOUND, "text/plain", "There is no such page.\n")
        else:
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page.html())

    def _send(self, status: HTTPStatus, kind: str, text: str) -> None:
        content = text.encode()
        self.send_response(status)
        about = {"Content-Type": kind, "Content-Length": str(len(content)), "Refresh": str(RENEW_S)}
        for name, value in (about | _HEADERS).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:  # the library's names of arguments
        """Logs nothing about requests."""
