"""The site on this machine: served from memory on loopback, with the policies it asks for."""

import mimetypes
from functools import partial
from http import HTTPStatus
from urllib.parse import unquote, urlsplit

from multipos.capturing.serving import LOOPBACK, QuietHandler, QuietServer, bind
from multipos.page.site import Site

PORT = 8036
_TYPES = {
    ".js": "text/javascript",
    ".mjs": "text/javascript",
    ".wasm": "application/wasm",
    ".webmanifest": "application/manifest+json",
}


def open_server(site: Site, port: int | None) -> QuietServer:
    """Return a server of a site, which `serve_forever` serves and ``with`` closes.

    Raises
    ------
    MultiposError, UsageError
        As in `multipos.capturing.serving.bind`.
    """
    return bind(partial(_Server, site), port, PORT)


class _Server(QuietServer):
    """The server, and the site that all its threads share."""

    def __init__(self, site: Site, port: int) -> None:
        super().__init__((LOOPBACK, port), _Handler)
        self.site = site


class _Handler(QuietHandler):
    """One connection."""

    server: _Server

    def do_GET(self) -> None:  # noqa: N802
        self._answer(with_content=True)

    def do_HEAD(self) -> None:  # noqa: N802
        self._answer(with_content=False)

    def _answer(self, *, with_content: bool) -> None:
        name = unquote(urlsplit(self.path).path).removeprefix("/") or "index.html"
        content = self.server.site.files.get(name)
        status = HTTPStatus.NOT_FOUND if content is None else HTTPStatus.OK
        body = b"there is no such file\n" if content is None else content
        self.send_head(
            status,
            Content_Type=_type(name if content is not None else ""),
            Content_Length=str(len(body)),
            Content_Security_Policy=self._policy(name),
            Cache_Control="no-cache",
        )
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
