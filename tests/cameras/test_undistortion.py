"""Undistortion: exact inverses, no black borders, straight lines."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.cameras.lens import PINHOLE, Lens
from stages.cameras.undistortion import (
    SimpleRadial,
    remap_tables,
    undistorted_camera,
    undistorted_px,
    visible_share,
)
from stages.scene import Camera


def simple_radial(k: float) -> Lens:
    """COLMAP's SIMPLE_RADIAL."""
    return SimpleRadial(radial=(k,))


TAKEN = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, np.eye(4))
CAMERA = Camera(640, 480, 500.0, 510.0, 330.0, 235.0, np.eye(4))
LENSES = {
    "barrel": Lens(radial=(-0.2, 0.03)),
    "pincushion": Lens(radial=(0.15,), tangential=(0.01, -0.005)),
    "fisheye": Lens("fisheye", (0.02, -0.01)),
    "division": Lens("division", parameters=(-0.2,)),
}


@given(
    st.floats(-0.2, 0.5),
    st.floats(-0.8, 0.8),
    st.floats(-0.8, 0.8),
)
def test_undistort_is_the_inverse_of_distort(k: float, u: float, v: float) -> None:
    uv = np.array([[u, v]])
    assert np.allclose(simple_radial(k).undistort(simple_radial(k).distort(uv)), uv, atol=1e-9)


def test_radii_that_no_lens_of_this_model_shows_are_nan() -> None:
    assert np.isnan(simple_radial(-0.3).undistort(np.array([[3.0, 0.0]]))).all()


def test_without_distortion_the_picture_stays_as_it_is() -> None:
    pinhole = undistorted_camera(TAKEN, simple_radial(0.0))
    assert (pinhole.width, pinhole.height, pinhole.cx, pinhole.cy) == (640, 480, 320, 240)
    x, y = remap_tables(TAKEN, simple_radial(0.0), pinhole)
    assert np.allclose(x[0], np.arange(640), atol=1e-4)
    assert np.allclose(y[:, 0], np.arange(480), atol=1e-4)


@pytest.mark.parametrize("k", [-0.3, -0.1, -0.01, 0.01, 0.1, 0.5, 1.0])
def test_every_pixel_of_the_new_picture_lies_in_the_photograph(k: float) -> None:
    pinhole = undistorted_camera(TAKEN, simple_radial(k))
    x, y = remap_tables(TAKEN, simple_radial(k), pinhole)
    assert x.shape == (pinhole.height, pinhole.width)
    # Half a pixel beyond the outer centres is still inside the outer pixels.
    assert x.min() > -0.52
    assert x.max() < 639.52
    assert y.min() > -0.52
    assert y.max() < 479.52


@pytest.mark.parametrize("k", [-0.1, 0.1])
def test_the_new_picture_is_the_largest_that_fits(k: float) -> None:
    pinhole = undistorted_camera(TAKEN, simple_radial(k))
    x, y = remap_tables(TAKEN, simple_radial(k), pinhole)
    assert min(x[:, 0].min(), 639 - x[:, -1].max()) < 1.0
    assert min(y[0].min(), 479 - y[-1].max()) < 1.0


def test_keypoints_move_with_the_pixels() -> None:
    k = -0.08
    pinhole = undistorted_camera(TAKEN, simple_radial(k))
    x, y = remap_tables(TAKEN, simple_radial(k), pinhole)
    row, column = 37, 512
    there = np.array([[x[row, column], y[row, column]]], np.float64) + 0.5
    moved = undistorted_px(there, TAKEN, simple_radial(k), pinhole)
    assert np.allclose(moved, [[column + 0.5, row + 0.5]], atol=1e-3)


@pytest.mark.parametrize("k", [-5.0, 20.0, -0.9])
def test_absurd_lenses_still_give_a_picture(k: float) -> None:
    pinhole = undistorted_camera(TAKEN, simple_radial(k))
    assert 100 < pinhole.width < 2000
    assert 80 < pinhole.height < 2000
    assert np.isfinite(remap_tables(TAKEN, simple_radial(k), pinhole)[0]).all()


def test_a_lens_without_distortion_changes_nothing() -> None:
    assert undistorted_camera(CAMERA, PINHOLE) == CAMERA
    assert visible_share(CAMERA, PINHOLE, CAMERA) == 1.0


@pytest.mark.parametrize("name", LENSES)
def test_points_lie_where_the_pinhole_camera_projects_them_and_no_border_is_black(
    name: str,
) -> None:
    """Discs drawn by the lens into a white photograph, found again by the pinhole camera."""
    lens = LENSES[name]
    pinhole = undistorted_camera(CAMERA, lens)
    assert 0.5 < visible_share(CAMERA, lens, pinhole) <= 1.0
    random = np.random.default_rng(0)
    uv = random.uniform(-0.35, 0.35, (30, 2))
    picture = np.full((480, 640), 255, np.uint8)
    for x, y in lens.distort(uv) * (500, 510) + (330, 235):
        cv2.circle(picture, (int(x), int(y)), 3, 90, -1)
    x, y = remap_tables(CAMERA, lens, pinhole)
    straight = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderValue=0)
    assert straight.shape == (pinhole.height, pinhole.width)
    px = np.floor(uv * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)).astype(int)
    inside = pinhole.shows(px)
    assert inside.mean() > 0.9
    assert (straight[px[inside, 1], px[inside, 0]] == 90).all()
    assert straight[1:-1, 1:-1].min() >= 89  # 0 would be beyond the photograph


def test_what_a_wide_fisheye_loses_is_stated() -> None:
    """180 degrees across: a pinhole picture keeps 60 to either side at most."""
    wide = Camera(1000, 1000, 1000 / np.pi, 1000 / np.pi, 500.0, 500.0, np.eye(4))
    pinhole = undistorted_camera(wide, Lens("fisheye"))
    assert pinhole.width / 2 / pinhole.fx <= np.tan(np.radians(60.1))
    assert 0.2 < visible_share(wide, Lens("fisheye"), pinhole) < 0.8
