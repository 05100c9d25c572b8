"""Straight pictures of bent ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stages.cameras.lens import PINHOLE, Lens
from stages.scene import Camera
from stages.structure.lenses import maps, straightened

CAMERA = Camera(640, 480, 500.0, 510.0, 330.0, 235.0, np.eye(4))
LENSES = {
    "barrel": Lens(radial=(-0.2, 0.03)),
    "pincushion": Lens(radial=(0.15,), tangential=(0.01, -0.005)),
    "fisheye": Lens("fisheye", (0.02, -0.01)),
    "division": Lens("division", own=(-0.2,)),
}


def test_a_straight_lens_changes_nothing() -> None:
    pinhole, share = straightened(CAMERA, PINHOLE)
    assert (pinhole, share) == (CAMERA, 1.0)


@pytest.mark.parametrize("name", LENSES)
def test_points_lie_where_the_pinhole_says_and_no_border_is_black(name: str) -> None:
    """Discs drawn by the lens into a white photograph, found again by the pinhole camera."""
    lens = LENSES[name]
    pinhole, share = straightened(CAMERA, lens)
    assert 0.5 < share <= 1.0
    random = np.random.default_rng(0)
    uv = random.uniform(-0.35, 0.35, (30, 2))
    picture = np.full((480, 640), 255, np.uint8)
    for x, y in lens.distort(uv) * (500, 510) + (330, 235):
        cv2.circle(picture, (int(x), int(y)), 3, 90, -1)
    x, y = maps(CAMERA, lens, pinhole)
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
    pinhole, share = straightened(wide, Lens("fisheye"))
    assert pinhole.width / 2 / pinhole.fx <= np.tan(np.radians(60.1))
    assert 0.2 < share < 0.8
