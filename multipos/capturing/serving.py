"""The page: served from loopback by the standard library, and nobody else is let in.

`serve` serves it while a session runs, and `bind` takes a free port. ``GET /`` is the page, one
file; ``GET /state`` what there is to show; ``GET /events`` the same as a stream of server-sent
events, whole after each change and the live values in between; ``POST /undo``, ``/redo/LABEL``,
``/finish`` change the session and answer with the state.

A page of another site can make a browser send requests here, and a name that its owner points to
127.0.0.1 can make it read the answers. So every request must name this host, and, where the browser
says which page or site it is from, be from this one. No path of a request reaches the file system.
"""

import base64
import hashlib
import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TypeVar
from urllib.parse import unquote

from multipos.capturing.session import Session
from multipos.capturing.state import live_of, state_of
from multipos.errors import MultiposError, UsageError

Server = TypeVar("Server", bound=ThreadingHTTPServer)

LOOPBACK = "127.0.0.1"
_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)
_LARGEST_BODY = 1024  # bytes; nothing that is asked for has any
_CONNECTIONS = 48
_STREAMS = 16
_SLOWEST = 20.0  # [s] for a request to be said, or an answer taken
_OFTEN = 0.03  # [s] from one event to the next
_SILENCE = 1.0  # [s] after which a stream says that it lives
_LAST = 1.0  # [s] for streams to say that it is finished
_PATIENCE = 10.0  # [s] for the session to finish


@contextmanager
def serve(session: Session, port: int | None, *, default: int) -> Iterator[str]:
    """Serve a session while the block runs; yield the address of the page.

    Parameters
    ----------
    session : Session
    port : int or None
        None: the default, or any that is free.

    Raises
    ------
    MultiposError
        The port is taken.
    UsageError
        It is none.
    """
    server = bind(partial(_Server, session), port, default)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1})
    thread.start()
    try:
        yield f"http://{LOOPBACK}:{server.server_address[1]}/"
    finally:
        server.end()
        server.shutdown()
        thread.join()
        server.server_close()


def bind(make: Callable[[int], Server], port: int | None, default: int) -> Server:
    """Return the server that `make` opens at a port: where none is asked for any that is free.

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
        return make(default if port is None else port)
    except OSError as error:
        if port is None:
            return make(0)
        raise MultiposError(
            f"port {port} cannot be used: {error.strerror or error}; give another --port."
        ) from None


class QuietServer(ThreadingHTTPServer):
    """A server that a browser may leave at any time."""

    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing: a browser that leaves is no error."""


class QuietHandler(BaseHTTPRequestHandler):
    """A connection that writes nothing to stderr."""

    protocol_version = "HTTP/1.1"
    timeout = _SLOWEST

    def version_string(self) -> str:
        """Return how the server calls itself."""
        return "multipos"

    def log_message(self, format: str, *args: object) -> None:
        """Keep stderr for what the user must know."""

    def send_head(self, status: HTTPStatus, **headers: str) -> None:
        """Send the status and headers, which are written with underscores, and those of all."""
        self.send_response(status)
        shared = {"X_Content_Type_Options": "nosniff", "Referrer_Policy": "no-referrer"}
        for name, value in (headers | shared).items():
            self.send_header(name.replace("_", "-"), value)


class _Server(QuietServer):
    """The server, and what all its threads share."""

    def __init__(self, session: Session, port: int) -> None:
        super().__init__((LOOPBACK, port), _Handler)
        self.session = session
        page = _whole_page()
        self.page = page.encode()
        self.policy = _policy(page)
        self.connections = threading.BoundedSemaphore(_CONNECTIONS)
        self.streaming = 0
        self.ending = False
        self._made: dict[str, tuple[tuple[int, int], bytes]] = {}

    def end(self) -> None:
        """Let the streams say the last, and end."""
        with self.session.changed:
            self.ending = True
            self.session.changed.notify_all()
            self.session.changed.wait_for(lambda: not self.streaming, timeout=_LAST)

    def event(self, seen: int) -> bytes:
        """Return the next event of a stream that has seen a version; the session is held.

        It is made once for all streams.
        """
        session = self.session
        kind, of = ("live", live_of) if session.version == seen else ("state", state_of)
        now = session.version, session.ticks
        if kind not in self._made or self._made[kind][0] != now:
            text = f"event: {kind}\ndata: {json.dumps(of(session))}\n\n"
            self._made[kind] = now, text.encode()
        return self._made[kind][1]


def _whole_page() -> str:
    """Return the page with what it shares with that of `multipos page`."""
    folder = Path(__file__).parent
    page = (folder / "page.html").read_text(encoding="utf-8")
    style = (folder / "drawing.css").read_text(encoding="utf-8")
    script = (folder / "drawing.js").read_text(encoding="utf-8")
    return page.replace("/* drawing.css */", style).replace("// drawing.js", script)


def _policy(page: str) -> str:
    """Return the content policy: this page's own script and style, and this server."""

    def hashed(tag: str) -> str:
        (text,) = re.findall(rf"<{tag}(?: type=\"module\")?>(.*?)</{tag}>", page, re.DOTALL)
        return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()

    return (
        f"default-src 'none'; script-src 'sha256-{hashed('script')}'; "
        f"style-src 'sha256-{hashed('style')}'; connect-src 'self'; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'none'"
    )


class _Handler(QuietHandler):
    """One connection."""

    server: _Server

    def handle(self) -> None:
        if not self.server.connections.acquire(blocking=False):
            return
        try:
            super().handle()
        except (OSError, ValueError):
            self.close_connection = True
        finally:
            self.server.connections.release()

    def do_GET(self) -> None:
        if not self._is_let_in():
            return
        if self.path == "/":
            self._answer(self.server.page, "text/html; charset=utf-8")
        elif self.path == "/state":
            self._state()
        elif self.path == "/events":
            self._stream()
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is /, /state and /events")

    def do_POST(self) -> None:
        if not self._is_let_in():
            return
        session = self.server.session
        command, _, label = self.path[1:].partition("/")
        if self.path not in ("/undo", "/finish") and not (command == "redo" and label):
            self._refuse(HTTPStatus.NOT_FOUND, "there is /undo, /redo/LABEL and /finish")
            return
        with session.changed:
            if session.finished:
                self._refuse(HTTPStatus.CONFLICT, "the session is finished")
                return
            if command == "finish":
                session.asked_to_finish = True
                session.changed.notify_all()
                session.changed.wait_for(lambda: session.finished, timeout=_PATIENCE)
            elif command == "undo" and session.undo() is None:
                self._refuse(HTTPStatus.CONFLICT, "there is no pose to take back")
                return
            elif command == "redo" and not session.redo(unquote(label)):
                self._refuse(HTTPStatus.NOT_FOUND, "no such pose counts or was taken back")
                return
            session.changed.notify_all()
        self._state()

    def _is_let_in(self) -> bool:
        """Tell whether a request is for this host and from this page, and has a small body."""
        hosts = self.headers.get_all("Host") or []
        origins = self.headers.get_all("Origin") or []
        ours = len(hosts) == 1 and _HOST.fullmatch(hosts[0]) is not None
        ours &= self.headers.get("Sec-Fetch-Site", "none") in ("same-origin", "none")
        if not ours or any(origin.lower() != f"http://{hosts[0].lower()}" for origin in origins):
            self._refuse(HTTPStatus.FORBIDDEN, "only the page itself, on this machine, is let in")
            return False
        if self.headers.get("Transfer-Encoding"):
            self._refuse(HTTPStatus.LENGTH_REQUIRED, "state the length of the body")
            return False
        length = self.headers.get("Content-Length", "0")
        if not length.isdecimal() or int(length) > _LARGEST_BODY:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "no body is needed")
            return False
        self.rfile.read(int(length))
        return True

    def _state(self) -> None:
        with self.server.session.changed:
            text = json.dumps(state_of(self.server.session))
        self._answer(text.encode(), "application/json")

    def _refuse(self, status: HTTPStatus, text: str) -> None:
        self.close_connection = True
        self._answer(f"{text}\n".encode(), "text/plain; charset=utf-8", status)

    def _answer(self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._head(kind, status)
        self.send_header("Content-Length", str(len(body)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)

    def _head(self, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_head(
            status,
            Content_Type=kind,
            Content_Security_Policy=self.server.policy,
            Cross_Origin_Resource_Policy="same-origin",
            Cross_Origin_Opener_Policy="same-origin",
            Cache_Control="no-store",
        )

    def _stream(self) -> None:
        """Send events until the browser leaves, or the session has said its last."""
        server, session = self.server, self.server.session
        with session.changed:
            allowed = server.streaming < _STREAMS
            server.streaming += allowed
        if not allowed:
            self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages are open")
            return
        try:
            self.close_connection = True
            self._head("text/event-stream")
            self.send_header("Connection", "close")
            self.end_headers()
            self._send_events()
        finally:
            with session.changed:
                server.streaming -= 1
                session.changed.notify_all()

    def _send_events(self) -> None:
        server, session = self.server, self.server.session
        seen, ticks = -1, -1
        while True:
            with session.changed:
                session.changed.wait_for(
                    lambda: server.ending or (session.version, session.ticks) != (seen, ticks),  # noqa: B023
                    timeout=_SILENCE,
                )
                if (session.version, session.ticks) == (seen, ticks):
                    event = b": still here\n\n"
                else:
                    event = server.event(seen)
                    seen, ticks = session.version, session.ticks
                last = server.ending
            self.wfile.write(event)
            if last:
                return
            time.sleep(_OFTEN)
