"""Undistortion: exact inverses, no black borders, straight lines."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.structure.undistortion import distort, maps, pinhole_for, undistort, undistorted_px

SIZE = np.array([640, 480])


def params(k: float, focal: float = 500.0) -> np.ndarray:
    return np.array([focal, 320.0, 240.0, k])


@given(
    st.floats(-0.2, 0.5),
    st.floats(-0.8, 0.8),
    st.floats(-0.8, 0.8),
)
def test_undistort_is_the_inverse_of_distort(k: float, u: float, v: float) -> None:
    uv = np.array([[u, v]])
    assert np.allclose(undistort(distort(uv, k), k), uv, atol=1e-9)


def test_radii_that_no_lens_of_this_model_shows_are_nan() -> None:
    assert np.isnan(undistort(np.array([[3.0, 0.0]]), -0.3)).all()


def test_without_distortion_the_picture_stays_as_it_is() -> None:
    pinhole = pinhole_for(SIZE, params(0.0))
    assert (pinhole.width, pinhole.height, pinhole.cx, pinhole.cy) == (640, 480, 320, 240)
    x, y = maps(pinhole, params(0.0))
    assert np.allclose(x[0], np.arange(640), atol=1e-4)
    assert np.allclose(y[:, 0], np.arange(480), atol=1e-4)


@pytest.mark.parametrize("k", [-0.3, -0.1, -0.01, 0.01, 0.1, 0.5, 1.0])
def test_every_pixel_of_the_new_picture_lies_in_the_photograph(k: float) -> None:
    pinhole = pinhole_for(SIZE, params(k))
    x, y = maps(pinhole, params(k))
    assert x.shape == (pinhole.height, pinhole.width)
    # Half a pixel beyond the outer centres is still inside the outer pixels.
    assert x.min() > -0.52
    assert x.max() < 639.52
    assert y.min() > -0.52
    assert y.max() < 479.52


@pytest.mark.parametrize("k", [-0.1, 0.1])
def test_the_new_picture_is_the_largest_that_fits(k: float) -> None:
    pinhole = pinhole_for(SIZE, params(k))
    x, y = maps(pinhole, params(k))
    assert min(x[:, 0].min(), 639 - x[:, -1].max()) < 1.0
    assert min(y[0].min(), 479 - y[-1].max()) < 1.0


def test_keypoints_move_with_the_pixels() -> None:
    k = -0.08
    pinhole = pinhole_for(SIZE, params(k))
    x, y = maps(pinhole, params(k))
    row, column = 37, 512
    there = np.array([[x[row, column], y[row, column]]], np.float64) + 0.5
    moved = undistorted_px(there, params(k), pinhole)
    assert np.allclose(moved, [[column + 0.5, row + 0.5]], atol=1e-3)


@pytest.mark.parametrize("k", [-5.0, 20.0, -0.9])
def test_absurd_lenses_still_give_a_picture(k: float) -> None:
    pinhole = pinhole_for(SIZE, params(k))
    assert 100 < pinhole.width < 2000
    assert 80 < pinhole.height < 2000
    assert np.isfinite(maps(pinhole, params(k))[0]).all()
