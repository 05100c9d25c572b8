"""`--view`: the listener between the pipeline and the page."""

from __future__ import annotations

import json
import re
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stages.scene import Camera
from stages.viewer import live_training
from tests.small_scene import small_scene

TRAIN, PRUNE = (SimpleNamespace(name=name) for name in ("train", "prune"))


@pytest.fixture
def said() -> list[str]:
    """The addresses that were announced, and the warnings."""
    return []


@pytest.fixture
def watcher(tmp_path: Path, said: list[str]) -> live_training.LiveTraining:
    scene = small_scene(tmp_path, views=3)
    outputs = {"sfm": scene.reconstruction, "seed": scene.splats}
    pipeline: Any = SimpleNamespace(load=outputs.__getitem__, run_folder=tmp_path / "run")
    return live_training.LiveTraining(pipeline, said.append, said.append)


def get(address: str) -> Any:
    return json.loads(urllib.request.urlopen(address, timeout=20).read())


def draw(camera: Camera) -> np.ndarray:
    return np.zeros((camera.height, camera.width, 3), np.uint8)


def test_training_is_served_from_its_start_to_the_end_of_the_run(watcher, said) -> None:
    watcher.started(PRUNE, 5, "has not run yet", False)
    assert said == []
    watcher.started(TRAIN, 4, "has not run yet", False)
    (address,) = re.findall(r"http://127\.0\.0\.1:\d+/[\w-]+/", said[0])
    assert b"<title>run</title>" in urllib.request.urlopen(address, timeout=20).read()
    watcher.progressed(TRAIN, "training", 1, 2, {"splats": 250})
    watcher.progressed(PRUNE, "pruning", 1, 9, {})
    assert get(address + "state")["total"] == 2
    answers: list[Any] = []
    place = "1,0,0,0,0,1,0,0,0,0,1,4"
    asking = threading.Thread(
        target=lambda: answers.append(get(f"{address}picture?shot=0&side=64&place={place}"))
    )
    asking.start()
    while asking.is_alive():
        watcher.drawable(TRAIN, draw)
        time.sleep(0.001)
    assert answers[0]["step"] == 1
    watcher.progressed(TRAIN, "training", 2, 2, {"splats": 250})
    watcher.drawable(TRAIN, draw)
    watcher.finished(TRAIN, 4, SimpleNamespace())
    watcher.finished(PRUNE, 5, SimpleNamespace())
    assert get(address + "state")["end"] == "finished"
    assert get(f"{address}picture?shot=0&side=64&place={place}")["step"] == 2
    watcher.ended()
    with pytest.raises(urllib.error.URLError):
        get(address + "state")


def test_each_of_two_open_pages_sees_the_end(watcher, said) -> None:
    watcher.started(TRAIN, 4, "has not run yet", False)
    address = said[0]
    watcher.progressed(TRAIN, "training", 1, 1, {})
    seen: list[str] = []

    def follow(delay_s: float) -> None:
        time.sleep(delay_s)
        try:
            while not (end := get(address + "state")["end"]):
                time.sleep(0.5)
            get(f"{address}picture?shot=0&side=64&place=1,0,0,0,0,1,0,0,0,0,1,4")
        except OSError:
            end = "no answer"
        seen.append(end)

    pages = [threading.Thread(target=follow, args=(delay_s,)) for delay_s in (0.0, 0.25)]
    for page in pages:
        page.start()
    time.sleep(0.4)
    watcher.finished(TRAIN, 4, SimpleNamespace())
    watcher.ended()
    for page in pages:
        page.join()
    assert seen == ["finished", "finished"]


def test_pages_that_saw_the_end_long_ago_are_not_waited_for(
    watcher, said, monkeypatch: pytest.MonkeyPatch
) -> None:
    watcher.started(TRAIN, 4, "has not run yet", False)
    watcher.progressed(TRAIN, "training", 1, 1, {})
    watcher.finished(TRAIN, 4, SimpleNamespace())
    get(said[0] + "state")
    get(f"{said[0]}picture?shot=0&side=64&place=1,0,0,0,0,1,0,0,0,0,1,4")
    watcher._page.ended_at -= 60
    monkeypatch.setattr(time, "sleep", lambda s: pytest.fail("waited"))
    watcher.ended()


def test_a_run_that_ends_early_says_so_and_waits_only_for_an_open_page(
    watcher, said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "sleep", lambda s: pytest.fail("waited"))
    watcher.started(TRAIN, 4, "has not run yet", False)
    watcher.progressed(TRAIN, "training", 1, 2, {})
    watcher.drawable(TRAIN, lambda camera: pytest.fail("drawn"))
    ends: list[str] = []
    monkeypatch.setattr(watcher._page, "ended", ends.append)
    watcher.ended()
    assert ends == ["stopped"]


def test_a_run_that_never_trains_serves_nothing(watcher, said) -> None:
    watcher.drawable(TRAIN, draw)
    watcher.progressed(TRAIN, "training", 1, 2, {})
    watcher.ended()
    assert said == []
