"""The page as text: whole, self-contained, and true to the scene."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import formats
from stages.formats import html
from stages.page import document
from stages.page.cameras import PageCamera, as_plain, page_cameras
from stages.proof.checks import read_back
from stages.scene import Camera, Splats, look_at
from stages.viewer.site import site
from tests import scenes
from tests.viewer.pages import HOSTILE, Elements, views


def page_of(tmp_path: Path, splats: Splats, **more: Any) -> str:
    formats.write(tmp_path / "a.html", splats, **more)
    return (tmp_path / "a.html").read_text(encoding="utf-8")


def test_a_page_fetches_nothing_from_anywhere(tmp_path: Path) -> None:
    text = page_of(tmp_path, scenes.cloud(50), views=views())
    for tag, attrs in Elements(text).tags:
        for name in ("src", "href", "srcset", "action", "data", "poster"):
            assert not (attrs.get(name) or "").strip().startswith(("http", "//", ".", "/")), tag
    styles = "".join(re.findall(r"<style>(.*?)</style>", text, re.S))
    assert not re.search(r"@import|url\((?!['\"]?data:)", styles)
    ours = text.replace(document._asset("vendor", "supersplat-viewer.min.js"), "")
    assert not re.search(r"https?://", ours)
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    assert "default-src 'none'" in policy
    assert not re.search(r"https?:|\*", policy)


def test_a_page_holds_its_scripts_and_the_licence_of_what_is_not_ours(tmp_path: Path) -> None:
    text = page_of(tmp_path, scenes.cloud(5))
    assert "PlayCanvas Ltd." in text
    assert "Permission is hereby granted" in text
    assert "createViewer" in text
    assert "splatReady" in text
    assert text.endswith("</html>\n")


def test_a_page_says_how_many_splats_it_holds_and_holds_them(tmp_path: Path) -> None:
    splats = scenes.cloud(321)
    scene = Elements(page_of(tmp_path, splats, units="metres", views=views())).scene()
    assert (scene["count"], scene["units"], scene["title"]) == (321, "metres", "a")
    assert len(read_back(tmp_path / "a.html").splats) == 321
    np.testing.assert_array_equal(read_back(tmp_path / "a.html").splats.sh, splats.sh)


def test_many_chunks_are_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(html, "_CHUNK_BYTES", 999)
    splats = scenes.cloud(200)
    assert page_of(tmp_path, splats).count(document.CHUNK_START) > 10
    np.testing.assert_array_equal(formats.read(tmp_path / "a.html").means, splats.means)
    np.testing.assert_array_equal(read_back(tmp_path / "a.html").splats.means, splats.means)


@pytest.mark.parametrize("damage", ["a chunk less", "another letter", "not base64", "no end"])
def test_a_damaged_page_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    from stages.base.errors import SplatError

    monkeypatch.setattr(html, "_CHUNK_BYTES", 999)
    text = page_of(tmp_path, scenes.cloud(200))
    start = text.index(document.CHUNK_START, text.index(document.CHUNK_START) + 1)
    start += len(document.CHUNK_START)
    end = text.index(document.CHUNK_END, start)
    if damage == "a chunk less":
        text = text[: start - len(document.CHUNK_START)] + text[end + len(document.CHUNK_END) :]
    elif damage == "another letter":
        text = text[:start] + ("B" if text[start] == "A" else "A") + text[start + 1 :]
    elif damage == "not base64":
        text = text[:start] + "=" + text[start + 1 :]
    else:
        text = text[:end]
    (tmp_path / "a.html").write_text(text, encoding="utf-8")
    with pytest.raises(SplatError) as caught:
        formats.read(tmp_path / "a.html")
    assert caught.value.code == "splats-unreadable"


def test_names_cannot_break_out_of_the_page() -> None:
    splats = scenes.cloud(3)
    shots = [PageCamera(HOSTILE, scenes.camera())]
    text = document.head(document.scene_data(HOSTILE, splats, shots, units="arbitrary", source=""))
    elements = Elements(text)
    assert elements.scene()["shots"][0]["name"] == HOSTILE
    assert elements.scene()["title"] == HOSTILE
    assert sum(tag == "script" for tag, _ in elements.tags) == 2  # one of them is of failures


def test_every_eighth_camera_by_name_is_marked_as_held_out() -> None:
    shots = page_cameras(tuple(reversed(views(10))), scenes.cloud(3))
    assert [shot.name for shot in shots] == [f"{i}.jpg" for i in range(10)]
    assert [shot.name for shot in shots if shot.held_out] == ["0.jpg", "8.jpg"]


def test_splats_without_a_capture_are_seen_from_in_front() -> None:
    (shot,) = page_cameras((), scenes.cloud(20))
    plain = as_plain(shot, scenes.cloud(20).means)
    assert shot.camera.centre[2] < np.median(scenes.cloud(20).means[:, 2])
    assert np.isfinite(plain["position"] + plain["target"] + plain["rotation"]).all()


def rotated(quaternion: list[float], v: np.ndarray) -> np.ndarray:
    q, w = np.array(quaternion[:3]), quaternion[3]
    return v + 2 * np.cross(q, np.cross(q, v) + w * v)


@pytest.mark.parametrize("up", [(0, -1, 0), (0.3, -1, 0.2), (0, 1, 0)])
@pytest.mark.parametrize("eye", [(0, 0, -3), (2, -1, 1), (-0.5, 2, 3)])
def test_a_camera_in_the_viewers_world_looks_the_same_way(
    up: tuple[float, ...], eye: tuple[float, ...]
) -> None:
    """By hand: the viewer's world is ours turned about z; its camera is x right, y up, z back."""
    camera = scenes.camera(matrix=look_at(np.array(eye), np.zeros(3), np.array(up)))
    plain = as_plain(PageCamera("a", camera), np.zeros((1, 3)))
    right, down, forward = camera.world_to_camera[:3, :3]

    def turned(v: np.ndarray) -> np.ndarray:
        return v * [-1, -1, 1]

    np.testing.assert_allclose(plain["position"], turned(camera.centre), atol=1e-8)
    np.testing.assert_allclose(plain["target"], 0, atol=1e-8)
    axes = np.eye(3)
    np.testing.assert_allclose(rotated(plain["rotation"], axes[0]), turned(right), atol=1e-8)
    np.testing.assert_allclose(rotated(plain["rotation"], axes[1]), turned(-down), atol=1e-8)
    np.testing.assert_allclose(rotated(plain["rotation"], axes[2]), turned(-forward), atol=1e-8)


def test_photographs_are_served_by_number_and_only_from_their_folder(tmp_path: Path) -> None:
    folder = tmp_path / "sfm"
    (folder / "images").mkdir(parents=True)
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    (folder / "images" / "0.jpg").write_bytes(b"photograph")
    first, second, third, *_ = views()
    seen = (
        first,
        replace(second, image="../secret.jpg"),
        replace(third, image=str(tmp_path / "secret.jpg")),
    )
    items = site("a", scenes.cloud(4), tmp_path / "scene.ply", seen, folder)
    assert sorted(items) == ["/", "/photos/0.jpg", "/scene.ply"]
    assert items["/photos/0.jpg"].kind == "image/jpeg"
    page = items["/"].content
    assert isinstance(page, bytes)
    shots = Elements(page.decode()).scene()["shots"]
    assert [shot["photo"] for shot in shots] == ["photos/0.jpg", "", ""]


def test_a_camera_that_sees_nothing_still_has_an_orbit_target() -> None:
    away = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, look_at(np.zeros(3), np.array([0, 0, -1.0])))
    assert np.isfinite(as_plain(PageCamera("a", away), scenes.cloud(9).means)["target"]).all()
