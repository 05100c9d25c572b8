"""Every lens against COLMAP's own projection."""

from __future__ import annotations

import numpy as np
import pytest

from stages.cameras.colmap_records import _MODELS, _optics
from stages.cameras.lens import Lens

FISHEYES = {
    "equidistant": Lens("fisheye"),
    "radial": Lens("fisheye", (-0.03, 0.004, -0.0005)),
    "prism": Lens("prism fisheye", (-0.02,), tangential=(1e-3, -2e-3), prism=(1e-3, 0, 2e-3, 0)),
    "polynomial": Lens("polynomial fisheye", parameters=(0.01, -0.05)),
}
_LARGE = {"omega": 0.9, "alpha": 0.6, "beta": 1.2}


@pytest.mark.parametrize("model", [name for name, _ in _MODELS.values()])
def test_a_lens_shows_directions_where_colmap_does_and_can_be_undone(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    random = np.random.default_rng(0)
    camera = pycolmap.Camera.create_from_model_name(1, model, 500, 640, 480)
    names = camera.params_info.split(", ")
    params = np.array(camera.params)
    for i, name in enumerate(names):
        if name not in ("f", "fx", "fy", "cx", "cy"):
            params[i] = _LARGE.get(name, random.uniform(-0.03, 0.03))
    camera.params = params
    uv = random.uniform(-0.5, 0.5, (200, 2))
    wanted = camera.img_from_cam(np.hstack([uv, np.ones((200, 1))]))
    (_, _, fx, fy, cx, cy), lens = _optics(model, 640, 480, tuple(params))
    seen = lens.distort(uv)
    np.testing.assert_allclose(seen * (fx, fy) + (cx, cy), wanted, rtol=0, atol=1e-9)
    np.testing.assert_allclose(lens.undistort(seen), uv, rtol=0, atol=1e-9)
    assert lens.distorts == (model not in ("SIMPLE_PINHOLE", "PINHOLE"))


def test_a_skewed_lens_can_be_undone() -> None:
    lens = Lens(radial=(0.05,), tangential=(0.01, -0.01), skew=0.1)
    uv = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 2))
    seen = lens.distort(uv)
    straight = Lens(radial=(0.05,), tangential=(0.01, -0.01)).distort(uv)
    np.testing.assert_allclose(seen - straight, straight[:, 1:] * (0.1, 0.0), atol=1e-12)
    np.testing.assert_allclose(lens.undistort(seen), uv, atol=1e-9)
    assert Lens(skew=0.1).distorts


def test_what_a_lens_cannot_show_is_nowhere() -> None:
    """By hand: r (1 - r^2 / 3) is largest at r = 1, where it is 2/3."""
    lens = Lens(radial=(-1 / 3,))
    edge = lens.undistort(np.array([[0.66, 0.0], [0.67, 0.0], [0.0, 3.0]]))
    assert edge[0, 0] < 1.0
    assert np.isnan(edge[1:]).all()


def test_a_fisheye_sees_no_farther_than_a_pinhole_can() -> None:
    found = Lens("fisheye").undistort(np.array([[np.pi / 4, 0.0], [1.6, 0.0]]))
    np.testing.assert_allclose(found[0], [1.0, 0.0], atol=1e-12)
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize("kind", ["perspective", "fisheye"])
def test_the_optical_axis_stays(kind: str) -> None:
    lens = Lens(kind, (0.1, 0.2))
    np.testing.assert_array_equal(lens.distort(np.zeros((1, 2))), [[0, 0]])
    np.testing.assert_array_equal(lens.undistort(np.zeros((1, 2))), [[0, 0]])


@pytest.mark.parametrize("name", FISHEYES)
def test_a_fisheye_shows_directions_beside_and_behind_the_camera(name: str) -> None:
    lens = FISHEYES[name]
    random = np.random.default_rng(0)
    angle, turn = random.uniform(0, np.radians(115), 300), random.uniform(0, 2 * np.pi, 300)
    across = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * np.sin(angle)[:, None]
    rays = np.column_stack([across, np.cos(angle)])
    seen = lens.project(3.0 * rays)
    np.testing.assert_allclose(lens.directions(seen), rays, atol=1e-9)
    front = angle < 1.4
    flat = rays[front, :2] / rays[front, 2:]
    np.testing.assert_allclose(seen[front], lens.distort(flat), atol=1e-12)
    np.testing.assert_allclose(lens.undistort(seen[front]), flat, rtol=1e-9, atol=1e-9)
    assert lens.widest_angle() > np.radians(115)


def test_the_angle_at_which_a_fisheye_folds() -> None:
    """By hand: a (1 - a^2 / 3) is largest at a = 1."""
    lens = Lens("fisheye", (-1 / 3,))
    assert lens.widest_angle() == pytest.approx(1.0, abs=0.01)
    assert lens.widest_angle() < 1.0
    assert np.isnan(lens.directions(np.array([[0.67, 0.0]]))).all()
    assert Lens("fisheye").widest_angle() == pytest.approx(3.1)
