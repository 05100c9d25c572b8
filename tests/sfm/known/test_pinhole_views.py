"""The pinhole pictures of fisheye photographs show what their lens showed there, and no more."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.base.stage import Report
from stages.cameras.lens import Lens
from stages.scene import IGNORE, TRANSPARENT, Camera, Photo
from stages.scene.pictures import load_depth
from stages.scene.rotations import matrices_of
from stages.sfm.known.pinhole_views import PinholeView, write_pinhole_views
from stages.sfm.undistorted_images import (
    IMAGES,
    PosedPhoto,
    depth_file,
    mask_file,
    write_undistorted_images,
)
from tests.sfm.fisheyes import (
    EQUIDISTANT,
    LENS,
    camera,
    coded,
    photograph,
    picture,
    rays,
    shown,
)
from tests.tolerances import FISHEYE_DEPTH, FISHEYE_LEVELS

WIDE = camera(200, 200, 190)
RADIUS = 96


def written(
    folder: Path, photo: Photo, taken: Camera, lens: Lens
) -> tuple[list[PinholeView], Report]:
    report = Report()
    views = write_pinhole_views([PosedPhoto(photo, taken, lens)], folder, folder / "sfm", report)
    return views, report


def circular(taken: Camera, lens: Lens, radius: float = RADIUS) -> np.ndarray:
    """A photograph that is black beyond a circle."""
    x, y = np.meshgrid(np.arange(taken.width) + 0.5, np.arange(taken.height) + 0.5)
    inside = np.hypot(x - taken.cx, y - taken.cy) < radius
    return np.where(inside[..., None], coded(shown(taken, lens)), np.uint8(0))


def kept(folder: Path, view: PinholeView) -> np.ndarray:
    """[H, W] what the mask of a view keeps."""
    if not view.photo.mask:
        return np.ones((view.camera.height, view.camera.width), np.bool_)
    return np.asarray(picture(folder / "sfm" / mask_file(view.photo))[..., 0] > 0)


@pytest.mark.parametrize("lens", [EQUIDISTANT, LENS], ids=["equidistant", "distorted"])
def test_every_pixel_of_every_face_shows_its_direction_and_none_is_black(
    tmp_path: Path, lens: Lens
) -> None:
    photo = photograph(tmp_path, "a.png", circular(WIDE, lens))
    views, report = written(tmp_path, photo, WIDE, lens)
    assert [view.photo.name for view in views] == [
        f"a.png/{name}" for name in ("000+00", "090+00", "270+00", "000+90", "000-90")
    ]
    widest = 0.0
    for view in views:
        found = picture(tmp_path / "sfm" / IMAGES / view.photo.picture)
        inside, wanted = kept(tmp_path, view), rays(view)
        assert found.shape[:2] == inside.shape == (view.camera.height, view.camera.width)
        away = np.abs(found - (127.5 + 100.0 * wanted)).max(axis=-1)
        assert away[inside].max() < FISHEYE_LEVELS, view.photo.name
        widest = max(widest, float(np.arccos(wanted[inside][:, 2]).max()))
        assert view.photo.outside == ("" if inside.all() else IGNORE)
    pixels = RADIUS / WIDE.fx
    (edge,) = lens.directions(np.array([[pixels, 0.0]]))
    assert np.degrees(np.arccos(edge[2])) == pytest.approx(np.degrees(widest), abs=2.5)
    assert report.metrics["wide_fisheyes"] == 1
    assert report.warnings == []


def test_faces_have_one_centre_and_the_turns_that_they_are_described_with(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, :3] = matrices_of(np.array([0.8, 0.1, -0.5, 0.3]))
    pose[:3, 3] = 1.0, -2.0, 0.5
    taken = replace(WIDE, world_to_camera=pose)
    photo = photograph(tmp_path, "a.png", circular(WIDE, EQUIDISTANT))
    for view in written(tmp_path, photo, taken, EQUIDISTANT)[0]:
        assert view.photo.face is not None
        assert (view.photo.source, view.number) == ("a.png", 0)
        np.testing.assert_allclose(view.camera.centre, taken.centre, atol=1e-12)
        turn = matrices_of(np.array(view.photo.face.turn))
        np.testing.assert_allclose(turn @ pose[:3, :3], view.camera.world_to_camera[:3, :3])
        np.testing.assert_allclose(turn, view.rotation, atol=1e-12)


def test_an_ordinary_fisheye_keeps_the_bytes_of_one_pinhole_picture(tmp_path: Path) -> None:
    taken = camera(200, 150, 120)
    photo = photograph(tmp_path, "a.png", coded(shown(taken, LENS)))
    (view,), _ = written(tmp_path, photo, taken, LENS)
    assert view.photo == photo
    posed = [PosedPhoto(photo, taken, LENS)]
    (pinhole,), _ = write_undistorted_images(posed, tmp_path, tmp_path / "plain", Report())
    assert (view.camera.width, view.camera.cx) == (pinhole.width, pinhole.cx)
    here, there = (tmp_path / name / IMAGES / "a.png" for name in ("sfm", "plain"))
    assert here.read_bytes() == there.read_bytes()


def test_a_narrow_circle_is_masked_in_its_one_picture(tmp_path: Path) -> None:
    taken = camera(200, 200, 120)
    photo = photograph(tmp_path, "a.png", circular(taken, EQUIDISTANT, 100))
    (view,), report = written(tmp_path, photo, taken, EQUIDISTANT)
    assert (view.photo.name, view.photo.face, view.photo.outside) == ("a.png", None, IGNORE)
    inside, found = kept(tmp_path, view), picture(tmp_path / "sfm" / IMAGES / "a.png")
    assert 0.7 < inside.mean() < np.pi / 4
    away = np.abs(found - (127.5 + 100.0 * rays(view))).max(axis=-1)
    assert away[inside].max() < FISHEYE_LEVELS
    assert np.degrees(np.arccos(rays(view)[..., 2][inside])).max() < 60.0
    assert "wide_fisheyes" not in report.metrics


def test_what_lies_beyond_a_fold_is_masked_and_named(tmp_path: Path) -> None:
    lens = Lens("fisheye", (-1 / 9,))  # folds at 99 degrees
    taken = camera(200, 200, 160)
    photo = photograph(tmp_path, "a.png", np.full((200, 200, 3), 90, np.uint8))
    views, report = written(tmp_path, photo, taken, lens)
    assert [code for code, _ in report.warnings] == ["cameras-lens-folds"]
    assert "a.png" in report.warnings[0][1]
    for view in views:
        angle = np.arccos(rays(view)[..., 2])
        assert angle[kept(tmp_path, view)].max() <= np.sqrt(3) + 1e-6


@pytest.mark.parametrize("outside", [IGNORE, TRANSPARENT])
def test_a_mask_is_cut_with_its_photograph(tmp_path: Path, outside: str) -> None:
    """The left half of the photograph counts: of the face to the right nothing is left."""
    half = np.zeros((200, 200, 3), np.uint8)
    half[:, :100] = 255
    photograph(tmp_path, "m.png", half)
    more = {"mask": "photos/m.png", "outside": outside}
    photo = photograph(tmp_path, "a.png", circular(WIDE, EQUIDISTANT), **more)
    views, _ = written(tmp_path, photo, WIDE, EQUIDISTANT)
    names = [view.photo.name for view in views]
    assert "a.png/270+00" in names
    assert "a.png/090+00" not in names
    front = views[0]
    assert front.photo.outside == outside
    inside = kept(tmp_path, front)
    left = rays(front)[..., 0] < 0
    assert (inside == left).mean() > 0.99


def test_depth_along_the_axis_of_the_photograph_becomes_that_of_each_face(tmp_path: Path) -> None:
    """Inside a ball of 2 m around the camera."""
    axis = shown(WIDE, EQUIDISTANT)[..., 2]
    (tmp_path / "depth").mkdir()
    depth = np.where(np.nan_to_num(axis) > 0, 2.0 * axis, 0.0).astype(np.float32)
    np.save(tmp_path / "depth" / "a.npy", depth)
    photo = photograph(tmp_path, "a.png", circular(WIDE, EQUIDISTANT), depth="depth/a.npy")
    for view in written(tmp_path, photo, WIDE, EQUIDISTANT)[0]:
        found = load_depth(tmp_path / "sfm" / depth_file(view.photo))
        c = view.camera.resized(found.shape[1], found.shape[0])
        at = rays(replace(view, camera=c))
        wanted = 2.0 * (at @ view.rotation[2])
        near = at[..., 2] > np.cos(np.radians(60))
        if near.any():
            np.testing.assert_allclose(found[near], wanted[near], rtol=FISHEYE_DEPTH)
        assert (found[at[..., 2] <= 0] == 0).all()
