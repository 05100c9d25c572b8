"""`splat view`: from the command to the page and back to the shell."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
import webbrowser
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from splatcli.app import app
from splatcli.commands import view
from splatcli.commands.view import one_signal_stops
from stages import formats
from stages.viewer import server
from tests import processes
from tests.formats.truth import many_splats
from tests.processes import line_of, python, running

DEAF = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
os.execv(sys.executable, [sys.executable, "-m", "splatcli", *sys.argv[1:]])
"""


@pytest.mark.parametrize("words", ["--camera nope", "--title A", "--background #ffffff"])
def test_options_of_a_page_that_is_written_are_refused_without_it(splat, words: str) -> None:
    result = splat("view", "scene.ply", *words.split())
    assert result.exit_code == 2
    assert "option-alone" in result.stderr


def test_a_page_that_is_written_says_the_units_of_its_file(splat, tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(20), units="metres")
    assert splat("view", "a.ply", "--save", "client.html").exit_code == 0
    assert formats.units_of(tmp_path / "client.html") == "metres"


@pytest.mark.parametrize(("factor", "warned"), [(1.0, False), (1e-6, True)])
def test_a_scene_too_small_for_the_page_is_told(
    splat, tmp_path: Path, factor: float, warned: bool
) -> None:
    scene = many_splats(20)
    scene.log_scales[:] = np.log(0.1 * factor)
    formats.write(tmp_path / "a.ply", scene)
    result = splat("view", "a.ply", "--save", "client.html")
    assert result.exit_code == 0
    assert ("(view-blurred)" in result.stderr) == warned
    assert ("--scale 1e4" in result.stderr) == warned


def test_a_page_is_not_written_onto_what_is_read_or_what_an_asset_needs(
    splat, tmp_path: Path
) -> None:
    formats.write(tmp_path / "a.html", many_splats(20))
    formats.write(tmp_path / "lod" / "lod-meta.json", many_splats(20))
    for source, page, code in (
        ("a.html", "a.html", "target-is-source"),
        ("lod/lod-meta.json", "lod/lod-meta.html", "view-page"),
    ):
        before = (tmp_path / page).read_bytes()
        result = splat("view", source, "--save", page)
        assert (result.exit_code, code in result.stderr) == (2, True)
        assert (tmp_path / page).read_bytes() == before


@pytest.mark.skipif(os.name != "posix", reason="sends the signal of Ctrl-C")
@pytest.mark.parametrize(
    ("suffix", "stop"),
    [("splat", signal.SIGINT), ("glb", signal.SIGTERM), ("html", signal.SIGHUP)],
)
def test_a_file_is_served_until_ctrl_c(tmp_path: Path, suffix: str, stop: signal.Signals) -> None:
    path = tmp_path / f"thing.{suffix}"
    formats.write(path, many_splats(7))
    before = sorted(entry.name for entry in tmp_path.iterdir())
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONUNBUFFERED": "1"}
    errors = tmp_path.parent / f"{tmp_path.name}.err"
    command = processes.splat("view", str(path), "--no-open")
    with errors.open("w") as told, running(command, stderr=told, env=environment) as it:
        address = line_of(it).strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{22}/", address)
        page = urllib.request.urlopen(address, timeout=20).read().decode()
        content = urllib.request.urlopen(address + "scene.ply", timeout=20).read()
        point = address + "point?at=1,-2.5,3&box=0,-2.5,0,1,2,3"
        urllib.request.urlopen(point, timeout=20)
        printed = [line_of(it).strip() for _ in range(2)]
        for wrong in ("", "?at=1,2", "?at=1,2,nan", "?at=1,2,3&box=1"):
            with pytest.raises(urllib.error.HTTPError):
                urllib.request.urlopen(address + "point" + wrong, timeout=20)
        it.send_signal(stop)
        assert it.wait(timeout=20) == 0
    assert printed == ["x,y,z = 1,-2.5,3", "--crop box:0,-2.5,0,1,2,3"]
    said = errors.read_text()
    assert f"<title>thing.{suffix}</title>" in page
    assert '"count": 7' in page
    assert b"element vertex 7\n" in content
    assert "Traceback" not in said
    assert sorted(entry.name for entry in tmp_path.iterdir()) == before


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_a_server_in_the_background_ignores_ctrl_c_and_ends_on_sigterm(
    tmp_path: Path,
) -> None:
    """A shell starts what it puts into the background with Ctrl-C ignored: that is for others."""
    formats.write(tmp_path / "a.ply", many_splats(7))
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    command = python(DEAF, "view", str(tmp_path / "a.ply"), "--no-open")
    with running(command, env=environment) as it:
        address = line_of(it).strip()
        it.send_signal(signal.SIGINT)
        assert urllib.request.urlopen(address, timeout=20).status == 200
        it.send_signal(signal.SIGTERM)
        assert it.wait(timeout=20) == 0


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_many_signals_leave_no_temporary_folder(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(7))
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONUNBUFFERED": "1"}
    with running(
        processes.splat("view", str(tmp_path / "a.ply"), "--no-open"), env=environment
    ) as it:
        line_of(it)
        assert len(list(tmp_path.iterdir())) == 2
        deadline = time.monotonic() + 20
        while it.poll() is None and time.monotonic() < deadline:
            it.send_signal(signal.SIGTERM)
            time.sleep(0.001)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_the_copy_of_a_view_that_was_killed_is_removed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[str]] = []
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    formats.write(tmp_path / "a.ply", many_splats(7))

    def served(*_: object) -> None:
        seen.append([path.name for path in (tmp_path / "temporary").iterdir()])
        if len(seen) == 1:  # as after a kill: the folder of a process that is no more
            left = tmp_path / "temporary" / seen[0][0]
            dead = subprocess.run(
                [sys.executable, "-c", "import os; print(os.getpid())"],
                capture_output=True,
                text=True,
                check=True,
            ).stdout.strip()
            shutil.copytree(left, left.with_name(left.name.replace(str(os.getpid()), dead)))

    monkeypatch.setattr(view, "_serve", served)
    for _ in range(2):
        assert CliRunner().invoke(app, ["view", str(tmp_path / "a.ply")]).exit_code == 0
    assert [len(names) for names in seen] == [1, 1]
    assert not list((tmp_path / "temporary").iterdir())


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_the_first_signal_stops_and_the_next_do_not_interrupt_what_is_removed() -> None:
    removed = False

    def stopped_three_times() -> None:
        nonlocal removed
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
                signal.raise_signal(number)
            removed = True

    with one_signal_stops(), pytest.raises(KeyboardInterrupt):
        stopped_three_times()
    assert removed
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_missing_file_is_reported(splat, tmp_path: Path) -> None:
    result = splat("view", "nowhere.ply", "--no-open")
    assert result.exit_code == 3
    assert "nowhere.ply does not exist" in result.stderr


def test_a_file_without_splats_is_reported(splat, tmp_path: Path) -> None:
    formats.write(tmp_path / "none.ply", many_splats(4).take(slice(0)))
    result = splat("view", "none.ply", "--no-open")
    assert result.exit_code == 3
    assert "none.ply holds no splat" in result.stderr


def test_a_port_in_use_is_reported(splat, tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(4))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        result = splat("view", "a.ply", "--no-open", "--port", port)
    assert result.exit_code == 2
    assert f"Port {port}" in result.stderr
    assert "Leave --port away" in result.stderr


@pytest.mark.parametrize("words", [("train",), ("process",)])
def test_a_training_that_is_finished_is_not_watched(splat, words: tuple[str, ...]) -> None:
    splat("process", "photos")
    result = splat(*words, "--view")
    assert result.exit_code == 0
    assert "there is nothing to watch" in result.stderr
    assert "splat view" in result.stderr
    assert "http://" not in result.stderr


def test_only_what_trains_can_be_watched(splat) -> None:
    assert splat("prune", "--view").exit_code == 2


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="others always have a screen")
def test_no_browser_is_tried_without_a_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []

    def note(address: str) -> bool:
        opened.append(address)
        return True

    monkeypatch.setattr(webbrowser, "open", note)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    assert not server.open_in_browser("http://127.0.0.1:1/")
    monkeypatch.setenv("DISPLAY", ":0")
    assert server.open_in_browser("http://127.0.0.1:2/")
    assert opened == ["http://127.0.0.1:2/"]
