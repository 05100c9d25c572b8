"""What the server gives, to whom, and what it keeps to itself."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from stages.viewer.server import MOST_CONNECTIONS, Item, LocalServer
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


@pytest.mark.parametrize("prefix", ["", "/", "/wrong", "/" + 22 * "A"])
def test_whoever_does_not_know_the_token_gets_nothing(server: LocalServer, prefix: str) -> None:
    """Another user of this machine, and a page elsewhere whose name resolves to this machine."""
    host = f"127.0.0.1:{server.server_port}"
    for path in ("/", "/scene.ply"):
        for name in (host, "evil.example"):
            request = f"GET {prefix}{path} HTTP/1.0\r\nHost: {name}\r\n\r\n"
            with socket.create_connection(("127.0.0.1", server.server_port), timeout=10) as client:
                client.sendall(request.encode())
                answer = client.makefile("rb").read()
            assert answer.split()[1] == b"404"
            assert b"doctype html>" not in answer.split(b"\r\n\r\n")[0]
            assert server.root[1:].encode() not in answer


def test_each_server_has_a_token_of_its_own() -> None:
    with LocalServer({}) as one, LocalServer({}) as other:
        assert one.root != other.root
        assert len(one.root) > 20


def test_only_this_machine_is_listened_to(server: LocalServer) -> None:
    assert server.server_address[0] == "127.0.0.1"
    assert server.address == f"http://127.0.0.1:{server.server_port}{server.root}/"


def test_idle_connections_are_bounded_in_number_and_time(
    server: LocalServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.viewer.server._Handler.timeout", 1.0)
    before = threading.active_count()
    idle = []
    for _ in range(300):
        idle.append(socket.create_connection(("127.0.0.1", server.server_port), timeout=10))
        assert threading.active_count() - before <= MOST_CONNECTIONS
    assert all(client.recv(1) == b"" for client in idle)  # closed by the server
    for client in idle:
        client.close()
    assert ask(server, "/")[0] == 200


def test_a_request_that_comes_byte_by_byte_does_not_keep_others_out(
    server: LocalServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.viewer.server.TIMEOUT_S", 1.5)
    address = ("127.0.0.1", server.server_port)
    slow = [socket.create_connection(address, timeout=10) for _ in range(MOST_CONNECTIONS)]
    for _ in range(20):  # 4 s, of which none passes without a byte
        for client in slow:
            with suppress(OSError):
                client.sendall(b"G")
        time.sleep(0.2)
    assert ask(server, "/")[0] == 200
    for client in slow:
        client.close()


def test_a_port_that_is_taken_is_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(OSError, match="in use"):
            LocalServer({}, taken.getsockname()[1])
