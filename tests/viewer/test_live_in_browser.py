"""The page of a training in a real browser: what the trainer draws, from where the visitor is."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages.evaluate.image_metrics import psnr
from stages.page.cameras import page_cameras
from stages.raster.draw import render
from stages.run.pipeline import Pipeline
from stages.scene import Camera, Splats
from stages.scene.framing import median_depth
from stages.viewer.live_page import LivePage
from stages.viewer.server import LocalServer
from tests import processes, sample
from tests.tolerances import LIVE_PICTURE_DB
from tests.viewer.browser import Browser
from tests.viewer.screenshots import WORSE_DB, coloured_scene, views, wrong_versions

WAIT_S = 60.0
SETTLED = "const p = splatLive.picture; p && p.sharp && p.version === splatLive.version"


def ours(splats: Splats, camera: Camera) -> np.ndarray:
    """By the reference: the kernels are the worker's."""
    return np.clip(render(splats, camera, backend="reference").image, 0, 1)


class Worker(threading.Thread):
    """Trains nothing, but offers pictures of its splats as training does."""

    def __init__(self, page: LivePage) -> None:
        super().__init__(daemon=True)
        self.page, self.splats, self.stop = page, coloured_scene(), threading.Event()

    def run(self) -> None:
        step = 0
        while not self.stop.wait(0.002):
            step += 1
            self.page.progressed("training", step, 10**6, {"splats": 10, "loss": 0.5})
            self.page.frames.offer(self.draw, step)

    def draw(self, camera: Camera) -> np.ndarray:
        return np.rint(np.clip(render(self.splats, camera).image, 0, 1) * 255).astype(np.uint8)


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[Worker]:
    for view in views():
        picture = ours(coloured_scene(), view.camera)
        Image.fromarray(np.uint8(picture * 255)).save(tmp_path / view.image)
    splats = coloured_scene()
    page = LivePage("test", views(), page_cameras(views(), splats), splats.means, tmp_path)
    working = Worker(page)
    server = LocalServer(page.items)
    serving = threading.Thread(target=server.serve_forever)
    for thread in (working, serving):
        thread.start()
    working.address = server.address  # type: ignore[attr-defined]
    yield working
    working.stop.set()
    server.shutdown()
    server.server_close()
    for thread in (working, serving):
        thread.join()


def until(browser: Browser, script: str) -> Any:
    """Waits until the script's last expression is true."""
    deadline = time.monotonic() + WAIT_S
    while not (value := browser.run(f"{{ {script} }}")):
        state = browser.run("[splatLive.state, splatLive.picture, splatLive.version]")
        assert time.monotonic() < deadline, (script, state, browser.said)
        time.sleep(0.05)
    return value


def bare(browser: Browser, address: str) -> None:
    """The page with nothing before the picture."""
    browser.open("about:blank")  # the page before asks no more
    browser.requests.clear()
    browser.open(address)
    browser.run(
        "{ const style = document.createElement('style');"
        "style.textContent = '#panel, #message { display: none !important }';"
        "document.head.append(style); }"
    )


def shown(browser: Browser) -> tuple[np.ndarray, np.ndarray]:
    """(what is on the screen, world_to_camera that it is drawn from), once all is at rest."""
    until(browser, SETTLED)
    rows = np.array(browser.run("splatLive.picture.place"), np.float64).reshape(3, 4)
    return browser.picture(), np.vstack([rows, [0, 0, 0, 1]])


def mouse(browser: Browser, *path: tuple[int, int], button: str = "left") -> None:
    held = {"left": 1, "right": 2}[button]
    for number, (x, y) in enumerate(path):
        kind = "mouseMoved" if number else "mousePressed"
        where: dict[str, Any] = {"x": x, "y": y, "button": button, "buttons": held, "clickCount": 1}
        browser.call("Input.dispatchMouseEvent", type=kind, **where)
    x, y = path[-1]
    where = {"x": x, "y": y, "button": button, "buttons": 0, "clickCount": 1}
    browser.call("Input.dispatchMouseEvent", type="mouseReleased", **where)


def seen_at(matrix: np.ndarray, camera: Camera, point: np.ndarray) -> np.ndarray:
    """[2] pixels."""
    x, y, z = matrix[:3, :3] @ point + matrix[:3, 3]
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


def test_its_keys_are_those_of_the_finished_page(browser: Browser, worker: Any) -> None:
    bare(browser, worker.address)
    number = "document.getElementById('shot').selectedIndex"
    assert browser.run(number) == 0
    for key, expected in ((".", 1), (".", 2), (",", 1), ("ArrowRight", 1), ("b", 1)):
        browser.run(
            f"document.body.dispatchEvent(new KeyboardEvent('keydown', {{key: {key!r},"
            " bubbles: true}))"
        )
        assert browser.run(number) == expected, key


def test_the_page_shows_what_is_trained_from_every_camera(browser: Browser, worker: Any) -> None:
    bare(browser, worker.address)
    for view in views():
        until(browser, f"splatLive.shot.name === {view.name!r}")
        picture, matrix = shown(browser)
        np.testing.assert_allclose(matrix, view.camera.world_to_camera, atol=1e-12)
        right = psnr(picture, ours(coloured_scene(), view.camera))
        assert right > LIVE_PICTURE_DB, view.name
        for name, wrong in wrong_versions(picture).items():
            worse = psnr(wrong, ours(coloured_scene(), view.camera))
            assert worse < right - WORSE_DB, (view.name, name)
        browser.run("document.getElementById('next').click()")
    assert not [a for a in browser.requests if not a.startswith((worker.address, "data:"))]


def test_dragging_turns_the_scene_with_the_pointer(browser: Browser, worker: Any) -> None:
    bare(browser, worker.address)
    _, before = shown(browser)
    camera = views()[0].camera
    depth = median_depth(camera, coloured_scene().means)
    pivot = camera.centre + depth * camera.forward
    near = pivot - 0.2 * depth * camera.forward
    mouse(browser, (150, 120), (165, 125), (190, 140))
    picture, matrix = shown(browser)
    moved = replace(camera, world_to_camera=matrix)
    assert psnr(picture, ours(coloured_scene(), moved)) > LIVE_PICTURE_DB
    assert psnr(picture, ours(coloured_scene(), camera)) < LIVE_PICTURE_DB - WORSE_DB
    np.testing.assert_allclose(
        seen_at(matrix, camera, pivot), seen_at(before, camera, pivot), atol=1e-6
    )
    assert (seen_at(matrix, camera, near) > seen_at(before, camera, near) + 1).all()


def test_right_dragging_moves_the_scene_and_the_wheel_zooms(browser: Browser, worker: Any) -> None:
    bare(browser, worker.address)
    _, before = shown(browser)
    camera = views()[0].camera
    pivot = camera.centre + median_depth(camera, coloured_scene().means) * camera.forward
    mouse(browser, (150, 120), (170, 110), button="right")
    _, matrix = shown(browser)
    travelled = seen_at(matrix, camera, pivot) - seen_at(before, camera, pivot)
    np.testing.assert_allclose(travelled, [20, -10], atol=1e-6)
    browser.call("Input.dispatchMouseEvent", type="mouseWheel", x=150, y=120, deltaX=0, deltaY=-50)
    until(browser, "splatLive.version >= 3")
    _, closer = shown(browser)
    depths = [(m[:3, :3] @ pivot + m[:3, 3])[2] for m in (matrix, closer)]
    assert depths[1] == pytest.approx(depths[0] * np.exp(-0.2))


@pytest.fixture
def touched(browser: Browser) -> Iterator[Browser]:
    browser.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=3)
    yield browser
    browser.call("Emulation.setTouchEmulationEnabled", enabled=False)


def fingers(browser: Browser, kind: str, *places: tuple[int, int]) -> None:
    points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(places)]
    browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    # A page reports motion once a frame.
    frame = "requestAnimationFrame(() => requestAnimationFrame(done))"
    browser.run(f"new Promise(done => {frame})")


def test_two_fingers_zoom_and_move_and_do_not_turn(touched: Browser, worker: Any) -> None:
    bare(touched, worker.address)
    _, before = shown(touched)
    camera = views()[0].camera
    pivot = camera.centre + median_depth(camera, coloured_scene().means) * camera.forward
    fingers(touched, "touchStart", (140, 120))
    fingers(touched, "touchStart", (140, 120), (180, 120))
    for out in range(4, 21, 4):
        fingers(touched, "touchMove", (140 - out, 120), (180 + out, 120))
    _, closer = shown(touched)
    for step in range(1, 6):
        x, y = 3 * step, 120 - 2 * step
        fingers(touched, "touchMove", (120 + x, y), (200 + x, y))
    _, aside = shown(touched)
    fingers(touched, "touchEnd")
    fingers(touched, "touchStart", (150, 120))
    fingers(touched, "touchMove", (190, 120))
    fingers(touched, "touchEnd")
    _, turned = shown(touched)

    def degrees(one: np.ndarray, other: np.ndarray) -> float:
        cosine = (np.trace(one[:3, :3] @ other[:3, :3].T) - 1) / 2
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))

    depths = [(m[:3, :3] @ pivot + m[:3, 3])[2] for m in (before, closer)]
    assert depths[1] == pytest.approx(depths[0] / 2, rel=1e-6)
    travelled = seen_at(aside, camera, pivot) - seen_at(closer, camera, pivot)
    np.testing.assert_allclose(travelled, [15, -10], atol=0.5)
    assert degrees(before, closer) < 1
    assert degrees(before, aside) < 1
    assert degrees(aside, turned) > 5


def test_the_picture_follows_training_and_the_end_is_shown(browser: Browser, worker: Any) -> None:
    bare(browser, worker.address)
    picture, _ = shown(browser)
    worker.splats = replace(worker.splats, sh=-worker.splats.sh)
    step = browser.run("splatLive.picture.step")
    until(browser, f"splatLive.picture.step > {step + 1}")
    time.sleep(0.2)  # for the screen
    camera = views()[0].camera
    now = browser.picture()
    assert psnr(now, picture) < LIVE_PICTURE_DB - WORSE_DB
    assert psnr(now, ours(worker.splats, camera)) > LIVE_PICTURE_DB
    worker.stop.set()
    worker.join()
    worker.page.frames.offer_last(worker.draw, 1_000_000)
    worker.page.ended("finished")
    until(browser, "splatLive.picture.step === 1000000 && splatLive.state.end")
    message = browser.run("document.getElementById('message').textContent")
    assert "Training has finished" in message
    deadline = time.monotonic() + WAIT_S
    while not worker.page.end_delivered:
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.slow
def test_at_rest_pictures_are_requested_seldom(browser: Browser, worker: Any) -> None:
    bare(browser, worker.address)
    shown(browser)
    browser.requests.clear()
    time.sleep(3)
    browser.run("0")  # takes in what was requested
    assert sum("/picture" in address for address in browser.requests) <= 4


@contextmanager
def watched(folder: Path, *words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """(`splat WORDS --view --json`, the address of its page)."""
    environment = {**os.environ, "DISPLAY": "", "WAYLAND_DISPLAY": "", "BROWSER": ""}
    command = processes.splat(*words, "--view", "--json")
    with processes.running(command, cwd=folder, env=environment) as process:
        event: dict[str, Any] = {"event": ""}
        while event["event"] != "view":
            event = json.loads(processes.line_of(process))
        yield process, event["address"]


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(os.name != "posix", reason="sends the signal of Ctrl-C")
def test_a_training_is_watched_stopped_and_watched_to_its_end(
    browser: Browser, sample_run: Path, tmp_path: Path
) -> None:
    """A run whose photographs have been placed before; training itself begins anew."""
    sample.copied(sample_run, tmp_path)
    with watched(tmp_path, *sample.process_words("--steps", "1500")) as (process, address):
        bare(browser, address)
        until(browser, SETTLED)
        early, step = browser.picture(), browser.run("splatLive.picture.step")
        until(browser, f"splatLive.picture.step > {step + 100}")
        time.sleep(0.2)  # for the screen
        assert psnr(browser.picture(), early) < LIVE_PICTURE_DB
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
        assert process.returncode == 130
        until(browser, "splatLive.state.end === 'stopped'")

    run = Pipeline(tmp_path / "run")
    seen = run.load("sfm")
    view = sorted(seen.views, key=lambda v: v.name)[0]
    with watched(tmp_path, "train", "run") as (process, address):
        browser.resize((view.camera.width, view.camera.height))
        bare(browser, address)
        process.communicate(timeout=300)
        assert process.returncode == 0
    until(browser, "splatLive.picture && splatLive.picture.step === 1500")
    assert browser.run("splatLive.state.end") == "finished"
    right = ours(run.load("train").splats, view.camera)
    assert psnr(browser.picture(), right) > LIVE_PICTURE_DB
    manifest = run.manifest("train")
    assert manifest is not None
    assert "view" not in manifest.settings
    assert 0 < manifest.metrics["resumed_from_step"] < 1500
    assert not [a for a in browser.requests if not a.startswith((address, "data:"))]
