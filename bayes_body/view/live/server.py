"""Serve the live page on this machine: the page itself, and the last second as JSON.

The server listens on the loopback address only. A page of another site could still send its requests there, under a name of its own that it lets
point to 127.0.0.1. So a request is answered only if its Host is a loopback name with this port. Nothing in a request changes anything.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import TYPE_CHECKING

from bayes_body.base.errors import input_error

if TYPE_CHECKING:
    from bayes_body.view.live.page import LivePage

ADDRESS = "127.0.0.1"
NAMES = (ADDRESS, "localhost", "[::1]")
STATE_PATH = "/state.json"
# The page's script and style are in it; it may ask only this server.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; base-uri 'none'; frame-ancestors 'none'"
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# Seconds after which a request that does not go on is dropped.
PATIENCE_S = 10


@contextmanager
def served(page: "LivePage", port: int = 0) -> Iterator[str]:
    """Serve a page in a thread; yield its address.

    Args:
        page: what is shown.
        port: 0 chooses a free one.

    Raises:
        InputError: the port cannot be used.
    """
    try:
        server = ThreadingHTTPServer((ADDRESS, port), _handler(page))
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise input_error("--port", f"{port} cannot be used ({reason})", "a free port", "name another, or leave the option out") from None
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, name="live page", daemon=True)
    thread.start()
    try:
        yield f"http://{ADDRESS}:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _handler(page: "LivePage") -> type[BaseHTTPRequestHandler]:
    html = files(__package__).joinpath("page.html").read_bytes()

    class Handler(BaseHTTPRequestHandler):
        timeout = PATIENCE_S
        server_version, sys_version = "bayes-body", ""

        def do_GET(self) -> None:
            """Answer with the page or its state."""
            port = self.connection.getsockname()[1]
            path = self.path.partition("?")[0]
            if self.headers.get("Host", "") not in {f"{name}:{port}" for name in NAMES}:
                self._answer(HTTPStatus.MISDIRECTED_REQUEST, "text/plain", b"This server answers only to this machine's own names.\n")
            elif path == "/":
                self._answer(HTTPStatus.OK, "text/html", html)
            elif path == STATE_PATH:
                self._answer(HTTPStatus.OK, "application/json", page.json().encode())
            else:
                self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"There is nothing here.\n")

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing: standard error belongs to the progress of the run."""

        def _answer(self, status: HTTPStatus, kind: str, content: bytes) -> None:
            self.send_response(status)
            for name, value in HEADERS.items():
                self.send_header(name, value)
            self.send_header("Content-Type", f"{kind}; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

    return Handler
