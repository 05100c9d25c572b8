"""The page of a training that goes on: what its addresses give, to whom, and at whose cost."""

from __future__ import annotations

import base64
import io
import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest
from PIL import Image

from stages.page.cameras import PageCamera, page_cameras
from stages.scene import Camera
from stages.viewer.live_page import SIDES, LivePage
from stages.viewer.server import LocalServer
from tests import scenes
from tests.viewer.asking import ask
from tests.viewer.pages import HOSTILE, Elements, views

SHOTS = page_cameras(views(), scenes.cloud(20))


def place_of(camera: Camera) -> str:
    return ",".join(map(str, camera.world_to_camera[:3].ravel()))


def picture_at(shot: object = 0, side: object = 32, place: str | None = None) -> str:
    where = place_of(SHOTS[0].camera) if place is None else place
    return "/picture?" + urlencode({"shot": shot, "side": side, "place": where})


class Trainer(threading.Thread):
    """Offers pictures whose colour says how wide they are; large ones are noise, which makes large
    files. longest_s: how long an offer kept it."""

    def __init__(self, page: LivePage) -> None:
        super().__init__(daemon=True)
        self.page, self.stop, self.longest_s, self.steps = page, threading.Event(), 0.0, 0

    def run(self) -> None:
        while not self.stop.wait(0.001):
            self.steps += 1
            self.page.progressed("training", self.steps, 10**6, {"splats": 5, "loss": float("nan")})
            start = time.monotonic()
            self.page.frames.offer(self.draw, self.steps)
            self.longest_s = max(self.longest_s, time.monotonic() - start)

    def draw(self, camera: Camera) -> np.ndarray:
        shape = (camera.height, camera.width, 3)
        if camera.width > 255:
            return np.random.default_rng(0).integers(0, 256, shape, np.uint8)
        return np.full(shape, camera.width, np.uint8)


@pytest.fixture
def page() -> LivePage:
    return LivePage("run", views(), SHOTS, scenes.cloud(20).means)


@pytest.fixture
def server(page: LivePage) -> Iterator[LocalServer]:
    with LocalServer(page.items) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


@pytest.fixture
def trainer(page: LivePage) -> Iterator[Trainer]:
    working = Trainer(page)
    working.start()
    yield working
    working.stop.set()
    working.join()


def test_a_picture_is_drawn_by_the_trainer_for_the_camera_asked_for(
    server: LocalServer, trainer: Trainer
) -> None:
    status, body, headers = ask(server, picture_at(side=32))
    assert (status, headers["Content-Type"]) == (200, "application/json")
    kind, _, text = json.loads(body)["jpeg"].partition(",")
    assert kind == "data:image/jpeg;base64"
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(text))), np.int64)
    assert pixels.shape[1:] == (32, 3)
    assert abs(pixels - 32).max() <= 1


def test_the_state_holds_no_number_that_json_lacks(server: LocalServer, trainer: Trainer) -> None:
    while trainer.steps < 3:
        time.sleep(0.001)
    state = json.loads(ask(server, "/state")[1])
    assert state["phase"] == "training"
    assert state["done"] >= 2
    assert state["left_s"] > 0
    assert state["numbers"] == {"splats": 5}
    assert state["drawing_share"] == 0


def test_browsers_that_do_not_read_their_response_delay_nobody(
    server: LocalServer, trainer: Trainer
) -> None:
    """Each is sent megabytes and takes none."""
    stuck = []
    for _ in range(3):
        client = socket.socket()
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        client.connect(("127.0.0.1", server.server_port))
        client.sendall(f"GET {server.root}{picture_at(side=SIDES[1])} HTTP/1.0\r\n\r\n".encode())
        stuck.append(client)
    before = trainer.steps
    assert ask(server, picture_at())[0] == 200
    while trainer.steps < before + 50:
        time.sleep(0.001)
    assert trainer.longest_s < 5
    for client in stuck:
        client.close()


def test_requests_that_make_no_sense_are_refused_undrawn(
    page: LivePage, server: LocalServer
) -> None:
    for address in (
        "/picture",
        picture_at(shot=-1),
        picture_at(shot=len(SHOTS)),
        picture_at(shot="x"),
        picture_at(side=0),
        picture_at(side=10**9),
        picture_at(place="1,2,3"),
        picture_at(place=",".join(["nan"] * 12)),
        picture_at(place=",".join(["0"] * 12)),
        picture_at(place="2,0,0,0,0,2,0,0,0,0,2,0"),
    ):
        assert ask(server, address)[0] == 400, address
    assert not page.frames.is_watched()


def test_without_the_token_the_trainer_draws_nothing(page: LivePage, server: LocalServer) -> None:
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=10) as client:
        client.sendall(f"GET {picture_at()} HTTP/1.0\r\n\r\n".encode())
        assert client.recv(100).split()[1] == b"404"
    assert not page.frames.is_watched()


def test_the_end_is_sent_and_its_delivery_recorded(page: LivePage, server: LocalServer) -> None:
    page.progressed("training", 7, 10, {})
    page.ended("stopped")
    assert not page.end_delivered
    state = json.loads(ask(server, "/state")[1])
    assert (state["end"], state["done"]) == ("stopped", 7)
    assert json.loads(ask(server, picture_at())[1]) == {}
    assert page.end_delivered


def test_time_left_counts_from_where_training_was_resumed() -> None:
    page = LivePage("run", views(), SHOTS, scenes.cloud(20).means)
    page.progressed("compiling kernels", 0, 1000, {})
    page.progressed("training", 900, 1000, {})
    time.sleep(0.02)
    page.progressed("training", 901, 1000, {})
    answer: Any = page.items["/state"]
    state = json.loads(answer({}).content)
    assert state["left_s"] == pytest.approx(99 * state["spent_s"])


def test_the_page_fetches_nothing_from_elsewhere_and_names_cannot_break_out() -> None:
    page = LivePage(HOSTILE, (), [PageCamera(HOSTILE, scenes.camera())], scenes.cloud(3).means)
    text = page.items["/"].content.decode()  # type: ignore[union-attr]
    elements = Elements(text)
    assert elements.scene()["shots"][0]["name"] == HOSTILE
    assert sum(tag == "script" for tag, _ in elements.tags) == 3
    assert not re.search(r"https?://", text)
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    assert "default-src 'none'" in policy


def test_a_run_folder_whose_name_is_no_utf_8_has_a_page() -> None:
    page = LivePage("caf\udce9", (), SHOTS, scenes.cloud(3).means)
    assert "<title>caf\\xe9</title>" in page.items["/"].content.decode()  # type: ignore[union-attr]


def test_photographs_come_only_from_their_folder(tmp_path: Path) -> None:
    (tmp_path / "sfm" / "images").mkdir(parents=True)
    (tmp_path / "sfm" / "images" / "0.jpg").write_bytes(b"photograph")
    page = LivePage("run", views(), SHOTS, scenes.cloud(20).means, tmp_path / "sfm")
    assert sorted(page.items) == ["/", "/photos/0.jpg", "/picture", "/state"]
