"""Serves a list of files to browsers of this user on this machine, and nothing else.

Every address starts with a random token, so that neither another user of the machine nor another
site's page can request anything. A request's path is only looked up in a dictionary of addresses,
so that no request can reach another file. An address may also stand for a function that computes
the response.
"""

from __future__ import annotations

import os
import secrets
import shutil
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import parse_qsl

LOOPBACK = "127.0.0.1"
MOST_CONNECTIONS = 64  # each has a thread; a browser opens six at a time
TIMEOUT_S = 20.0  # for a client to send its whole request, or to take 64 kB of the response
ANSWER_S = 600.0  # for a client to take the whole response


@dataclass(frozen=True)
class Item:
    """A response. content: bytes, or the file that holds them. kind: the MIME type."""

    content: bytes | Path
    kind: str

    def open(self) -> tuple[BinaryIO, int]:
        """(the bytes to read, how many)."""
        if isinstance(self.content, bytes):
            return BytesIO(self.content), len(self.content)
        return self.content.open("rb"), self.content.stat().st_size


Response = Callable[[dict[str, str]], Item]
"""Computes a response from the query of a request. Raises ValueError for a query that it does not
accept."""


class LocalServer(ThreadingHTTPServer):
    """Listens on 127.0.0.1 only. A connection beyond `MOST_CONNECTIONS` is closed.

    Args:
        items: the responses by address behind the token, such as "/" or "/scene.ply". Functions
            are called in a thread of each request.
        port: 0 for any that is free.

    Raises OSError if the port is taken.
    """

    daemon_threads = True

    def __init__(self, items: Mapping[str, Item | Response], port: int = 0) -> None:
        self.root = f"/{secrets.token_urlsafe(16)}"
        self.items = {self.root + address: item for address, item in items.items()}
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        self.ends: dict[Any, float] = {}  # when each connection is ended, by `time.monotonic`
        super().__init__((LOOPBACK, port), _Handler)

    @property
    def address(self) -> str:
        """The URL of the page."""
        return f"http://{LOOPBACK}:{self.server_port}{self.root}/"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread of its own, if one is free."""
        if self._free.acquire(blocking=False):
            self.ends[request] = time.monotonic() + TIMEOUT_S
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer, and free the thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            del self.ends[request]
            self._free.release()

    def service_actions(self) -> None:
        """End the connections of clients that take too long: one that sends a byte now and then
        would keep its thread for ever. The server calls this twice a second."""
        now = time.monotonic()
        for request, end in list(self.ends.items()):
            if now > end:
                with suppress(OSError):  # it ended by itself
                    request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing when a browser closes the connection early."""


class _Handler(BaseHTTPRequestHandler):
    server: LocalServer
    timeout = TIMEOUT_S

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def _answer(self, *, with_body: bool) -> None:
        self.server.ends[self.connection] = time.monotonic() + ANSWER_S
        path, _, query = self.path.partition("?")
        try:
            item = self.server.items[path]
            if not isinstance(item, Item):
                item = item(dict(parse_qsl(query)))
            source, size = item.open()
        except (KeyError, OSError):
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        except ValueError:
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        with source:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", item.kind)
            self.send_header("Content-Length", str(size))
            self.send_header("Cache-Control", "no-store")
            self.send_header("Referrer-Policy", "no-referrer")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            if with_body:
                shutil.copyfileobj(source, self.wfile)

    def log_message(self, format: str, *args: Any) -> None:
        """Print no requests."""


def open_in_browser(address: str) -> bool:
    """Open the address in a browser; whether one was started. On Linux without a display none is
    tried: a browser in the terminal cannot show the page and would block the command."""
    has_display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    if sys.platform.startswith("linux") and not has_display:
        return False
    return webbrowser.open(address)
