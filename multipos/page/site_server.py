"""The site on this machine: served from memory on loopback, with the policies it asks for."""

import mimetypes
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

from multipos.errors import MultiposError, UsageError
from multipos.page.site import Site

LOOPBACK = "127.0.0.1"
PORT = 8036
_TYPES = {
    ".js": "text/javascript",
    ".mjs": "text/javascript",
    ".wasm": "application/wasm",
    ".webmanifest": "application/manifest+json",
}


@contextmanager
def open_server(site: Site, port: int | None) -> Iterator[ThreadingHTTPServer]:
    """Yield a server of a site, whose `serve_forever` serves it, and close it at the end.

    Parameters
    ----------
    site : Site
    port : int or None
        None: the default, or any that is free.

    Raises
    ------
    MultiposError
        The port is taken.
    UsageError
        It is none.
    """
    if port is not None and not 0 <= port < 1 << 16:
        raise UsageError(f"--port must be from 0 (any that is free) to 65535, got {port}.")
    try:
        server = _Server(site, PORT if port is None else port)
    except OSError as error:
        if port is not None:
            raise MultiposError(
                f"port {port} cannot be used: {error.strerror or error}; give another --port."
            ) from None
        server = _Server(site, 0)
    try:
        yield server
    finally:
        server.server_close()


class _Server(ThreadingHTTPServer):
    """The server, and the site that all its threads share."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, site: Site, port: int) -> None:
        super().__init__((LOOPBACK, port), _Handler)
        self.site = site

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing: a browser that leaves is no error."""


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: _Server
    protocol_version = "HTTP/1.1"
    timeout = 20.0  # [s] for a request to be said

    def version_string(self) -> str:
        return "multipos"

    def log_message(self, format: str, *args: object) -> None:
        """Keep stderr for what the user must know."""

    def do_GET(self) -> None:
        self._answer(with_content=True)

    def do_HEAD(self) -> None:
        self._answer(with_content=False)

    def _answer(self, *, with_content: bool) -> None:
        name = unquote(urlsplit(self.path).path).removeprefix("/") or "index.html"
        content = self.server.site.files.get(name)
        status = HTTPStatus.NOT_FOUND if content is None else HTTPStatus.OK
        body = b"there is no such file\n" if content is None else content
        self.send_response(status)
        for header, value in (
            ("Content-Type", _type(name if content is not None else "")),
            ("Content-Length", str(len(body))),
            ("Content-Security-Policy", self._policy(name)),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
            ("Cache-Control", "no-cache"),
        ):
            self.send_header(header, value)
        self.end_headers()
        if with_content:
            self.wfile.write(body)

    def _policy(self, name: str) -> str:
        """Return the policy that goes with a file: both workers have that of the worker."""
        kind = "worker" if name in ("worker.js", "sw.js") else "page"
        return self.server.site.policies[kind]


def _type(name: str) -> str:
    suffix = f".{name.rpartition('.')[2]}"
    return _TYPES.get(suffix) or mimetypes.guess_type(name)[0] or "text/plain; charset=utf-8"
