"""Serves a list of files to browsers on this machine, and nothing else.

What may be asked for is a dictionary of addresses; a path in a request is only ever looked up in
it, so there is nothing to climb out of. An address may also stand for an answer that is worked out
when it is asked for.
"""

from __future__ import annotations

import shutil
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
    """What an address gives. content: bytes, or the file that holds them."""

    content: bytes | Path
    kind: str

    def open(self) -> tuple[BinaryIO, int]:
        """(the bytes to read, how many)."""
        if isinstance(self.content, bytes):
            return BytesIO(self.content), len(self.content)
        return self.content.open("rb"), self.content.stat().st_size


Answer = Callable[[dict[str, str]], Item]
"""From the options of an address (what follows "?"). Raises ValueError for those that make no
sense."""


class LocalServer(ThreadingHTTPServer):
    """Listens on 127.0.0.1 only. items: by address, such as "/" or "/scene.ply"; answers are worked
    out in a thread of their own, for pages of this server alone. port: 0 for any that is free.
    Raises OSError if the port is taken."""

    daemon_threads = True

    def __init__(self, items: Mapping[str, Item | Answer], port: int = 0) -> None:
        self.items = dict(items)
        super().__init__((LOOPBACK, port), _Handler)

    @property
    def address(self) -> str:
        """Where a browser finds the page."""
        return f"http://{LOOPBACK}:{self.server_port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that hangs up in the middle is no news."""


class _Handler(BaseHTTPRequestHandler):
    server: LocalServer

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def _answer(self, *, with_body: bool) -> None:
        # A page elsewhere can point a name of its own at this machine; the name gives it away.
        host = self.headers.get("Host", "")
        if host not in (f"{name}:{self.server.server_port}" for name in (LOOPBACK, "localhost")):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        asked = urlsplit(self.path)
        item = self.server.items.get(asked.path)
        if item is not None and not isinstance(item, Item):
            # A page elsewhere cannot read the answer, but must not cause the work either.
            if self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
                self.send_error(HTTPStatus.FORBIDDEN)
                return
            try:
                item = item(dict(parse_qsl(asked.query)))
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
        """Requests are not for the terminal."""
