"""What the server gives, to whom, and what it keeps to itself."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from stages.viewer.server import Item, LocalServer
from tests.viewer.asking import ask


@pytest.fixture
def server(tmp_path: Path) -> Iterator[LocalServer]:
    (tmp_path / "scene.ply").write_bytes(b"ply")
    (tmp_path / "secret.txt").write_text("secret")
    items = {
        "/": Item(b"<!doctype html>", "text/html; charset=utf-8"),
        "/scene.ply": Item(tmp_path / "scene.ply", "application/octet-stream"),
        "/gone.jpg": Item(tmp_path / "gone.jpg", "image/jpeg"),
    }
    with LocalServer(items) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def test_what_is_listed_is_served_with_its_kind(server: LocalServer) -> None:
    status, body, headers = ask(server, "/?camera=a.jpg&bare")
    assert (status, body) == (200, b"<!doctype html>")
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert ask(server, "/scene.ply")[:2] == (200, b"ply")
    status, body, headers = ask(server, "/scene.ply", "HEAD")
    assert (status, body, headers["Content-Length"]) == (200, b"", "3")


@pytest.mark.parametrize(
    "path",
    [
        "/secret.txt",
        "/../secret.txt",
        "/photos/../secret.txt",
        "/%2e%2e/secret.txt",
        "/..%2fsecret.txt",
        "/scene.ply/../secret.txt",
        "/./scene.ply",
        "/etc/passwd",
        "//etc/passwd",
        "/SCENE.PLY",
        "/scene.ply%00",
        "/gone.jpg",
        "scene.ply",
    ],
)
def test_nothing_else_is(server: LocalServer, path: str) -> None:
    status, body, _ = ask(server, path)
    assert status == 404
    assert b"secret" not in body.replace(b"secret.txt", b"")


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS"])
def test_nothing_can_be_changed(server: LocalServer, method: str) -> None:
    assert ask(server, "/scene.ply", method)[0] == 501


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "10.0.0.1:80"])
def test_a_page_elsewhere_with_a_name_for_this_machine_gets_nothing(
    server: LocalServer, host: str
) -> None:
    assert ask(server, "/", host=host)[0] == 403


def test_this_machine_may_call_itself_localhost(server: LocalServer) -> None:
    assert ask(server, "/", host=f"localhost:{server.server_port}")[0] == 200


def test_only_this_machine_is_listened_to(server: LocalServer) -> None:
    assert server.server_address[0] == "127.0.0.1"
    assert server.address == f"http://127.0.0.1:{server.server_port}/"


def test_a_port_that_is_taken_is_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(OSError, match="in use"):
            LocalServer({}, taken.getsockname()[1])
