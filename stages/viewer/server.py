"""Serves a list of files to browsers on this machine, and nothing else.

A request's path is only looked up in a dictionary of addresses, so that no request can reach
another file. An address may also stand for a function that computes the response.
"""

from __future__ import annotations

import os
import shutil
import sys
import webbrowser
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import parse_qsl, urlsplit

LOOPBACK = "127.0.0.1"


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
    """Listens on 127.0.0.1 only.

    Args:
        items: the responses by address, such as "/" or "/scene.ply". Functions are called in a
            thread of each request, and only for pages of this server.
        port: 0 for any that is free.

    Raises OSError if the port is taken.
    """

    daemon_threads = True

    def __init__(self, items: Mapping[str, Item | Response], port: int = 0) -> None:
        self.items = dict(items)
        super().__init__((LOOPBACK, port), _Handler)

    @property
    def address(self) -> str:
        """The URL of the page."""
        return f"http://{LOOPBACK}:{self.server_port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing when a browser closes the connection early."""


class _Handler(BaseHTTPRequestHandler):
    server: LocalServer

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def _answer(self, *, with_body: bool) -> None:
        # Against DNS rebinding: another site's name may resolve to this machine.
        host = self.headers.get("Host", "")
        if host not in (f"{name}:{self.server.server_port}" for name in (LOOPBACK, "localhost")):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        url = urlsplit(self.path)
        item = self.server.items.get(url.path)
        if item is not None and not isinstance(item, Item):
            # Another site's page could not read the response, but must not cause the work either.
            if self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
                self.send_error(HTTPStatus.FORBIDDEN)
                return
            try:
                item = item(dict(parse_qsl(url.query)))
            except ValueError:
                self.send_error(HTTPStatus.BAD_REQUEST)
                return
        try:
            source, size = item.open() if item is not None else (None, 0)
        except OSError:
            source, size = None, 0
        if source is None or item is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        with source:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", item.kind)
            self.send_header("Content-Length", str(size))
            self.send_header("Cache-Control", "no-store")
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
