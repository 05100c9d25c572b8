"""Sharpness, brightness, near-duplicates, and the advice that follows from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stages.base.text import listed
from stages.ingest.advice import about_capture
from stages.ingest.quality import measure, near_duplicates
from stages.scene import Photo
from stages.scene.capture import Face
from stages.scene.pictures import load_image
from tests.ingest.made_files import textured

SAMPLE = Path(__file__).parents[2] / "sample_captures/still_life/images/IMG_0012.jpg"


def photo(number: int = 0, **changes: Any) -> Photo:
    values: dict[str, Any] = {
        "name": f"{number}.jpg", "image": f"photos/{number}.jpg", "width": 1600, "height": 1200,
        "focal_px": None, "camera": "Maker X, 5.0 mm, 1600x1200", "sharpness": 7.0,
        "log2_luminance": -2.0, "exposure_ev": 10.0,
    }  # fmt: skip
    return Photo(**{**values, **changes})


def codes(photos: list[Photo]) -> dict[str, str]:
    warnings: dict[str, str] = {}
    about_capture(photos, warnings.__setitem__)
    return warnings


MANY = [photo(i) for i in range(24)]


def test_blur_of_any_direction_lowers_sharpness_and_contrast_does_not() -> None:
    picture = np.round(load_image(SAMPLE, 640, 480) * 255).astype(np.uint8)
    sharp = measure(picture).sharpness
    faded = np.clip(picture * 0.5 + 60, 0, 255).astype(np.uint8)
    assert measure(faded).sharpness == pytest.approx(sharp, rel=0.05)
    for kernel in (np.ones((1, 9)), np.ones((9, 1)), np.eye(7), np.ones((3, 3))):
        moved = cv2.filter2D(picture, -1, kernel / kernel.sum()).astype(np.uint8)
        assert measure(moved).sharpness < 0.6 * sharp


def test_brightness_is_the_logarithm_of_linear_light() -> None:
    """sRGB 188 is half the light of 255; black has a floor."""
    flat = np.full((60, 80, 3), 188, np.uint8)
    assert measure(flat).log2_luminance == pytest.approx(-1.0, abs=0.02)
    assert measure(flat * 0).log2_luminance == -14.0


def test_shots_from_one_spot_are_near_duplicates_and_steps_are_not() -> None:
    scene = cv2.GaussianBlur(textured(3, 880, 600), (0, 0), 2)
    noise = np.random.default_rng(0).normal(0, 3, (600, 800, 3))
    same = np.clip(scene[:, :800] * 0.9 + noise, 0, 255).astype(np.uint8)
    pictures = [scene[:, :800], textured(5, 800, 600), same, scene[:, 80:], scene[:, 1:801]]
    thumbnails = [measure(np.ascontiguousarray(picture)).thumbnail for picture in pictures]
    assert near_duplicates(thumbnails) == [(0, 2, 4)]


def test_a_slow_walk_is_not_one_group_because_each_is_like_the_one_before() -> None:
    scene = cv2.GaussianBlur(textured(3, 1000, 600), (0, 0), 2).astype(np.uint8)
    steps = [np.ascontiguousarray(scene[:, at : at + 800]) for at in range(0, 200, 2)]
    groups = near_duplicates([measure(picture).thumbnail for picture in steps])
    assert len(groups) > 5
    assert all(group == tuple(range(group[0], group[-1] + 1)) for group in groups)


def test_blank_pictures_are_measured_without_complaint() -> None:
    blank = measure(np.zeros((20, 30, 3), np.uint8))
    assert np.isfinite([blank.sharpness, blank.log2_luminance]).all()
    assert near_duplicates([blank.thumbnail, blank.thumbnail]) == []


def test_a_good_capture_gets_no_advice() -> None:
    assert codes(MANY) == {}


@pytest.mark.parametrize(
    ("changed", "code", "named"),
    [
        ({"sharpness": 3.0}, "ingest-blurred", "99.jpg"),
        ({"exposure_ev": 11.2}, "ingest-exposure-not-locked", "1.2 stops"),
        ({"log2_luminance": -8.0}, "ingest-dark", "99.jpg"),
        ({"camera": "Other Y, 5.0 mm, 1600x1200"}, "ingest-mixed-cameras", "1 x Other Y"),
        ({"camera": "Maker X, 9.0 mm, 1600x1200"}, "ingest-mixed-zooms", "1 x 9.0 mm"),
        ({"width": 1000}, "ingest-mixed-sizes", "1 x 1200 x 1000"),
        ({"width": 600, "height": 450}, "ingest-small", "99.jpg"),
    ],
)
def test_one_photograph_that_differs_is_reported(changed: dict, code: str, named: str) -> None:
    warnings = codes([*MANY, photo(99, **changed)])
    assert named in warnings.pop(code)
    assert set(warnings) <= {"ingest-mixed-sizes"}


def test_turning_the_camera_is_no_other_size() -> None:
    turned = [photo(50 + i, width=1200, height=1600) for i in range(3)]
    assert codes([*MANY, *turned]) == {}


def test_half_a_stop_is_no_change_of_exposure() -> None:
    assert codes([*MANY, photo(99, exposure_ev=10.5)]) == {}


def test_the_brightness_of_what_photographs_show_is_no_change_of_exposure() -> None:
    photos = [photo(i, exposure_ev=None, log2_luminance=-2.0 - 0.15 * i) for i in range(24)]
    assert codes(photos) == {}


def test_a_capture_that_is_soft_all_over_is_reported() -> None:
    assert set(codes([photo(i, sharpness=2.0) for i in range(24)])) == {"ingest-soft"}


def test_too_few_are_reported() -> None:
    assert set(codes([photo(i) for i in range(5)])) == {"ingest-few-photographs"}
    film = codes([photo(i, camera="video, 1920x1080 a.mp4") for i in range(8)])
    assert "8 different frames" in film["ingest-few-photographs"]
    assert "film on" in film["ingest-few-photographs"]


def test_twelve_panoramas_are_enough_for_a_room() -> None:
    face = Face("rig", "a.jpg", (1.0, 0.0, 0.0, 0.0))
    assert codes([photo(i, face=face) for i in range(12)]) == {}
    few = codes([photo(i, face=face) for i in range(11)])
    assert set(few) == {"ingest-few-photographs"}
    assert "11 usable 360-degree pictures. A room needs about 12" in few["ingest-few-photographs"]


def test_a_small_face_is_no_small_panorama() -> None:
    face = Face("rig", "a.jpg", (1.0, 0.0, 0.0, 0.0))
    assert codes([photo(i, face=face, width=592, height=592) for i in range(12)]) == {}


def test_nobody_is_told_to_take_a_frame_of_a_video_again() -> None:
    film = {"camera": "video, 1600x1200 a.mp4", "sharpness": 3.0}
    assert "ingest-blurred" not in codes([*MANY, photo(99, **film)])
    both = codes([*MANY, photo(98, sharpness=3.0), photo(99, **film)])
    assert "98.jpg. Take" in both["ingest-blurred"]


def test_long_lists_of_names_are_cut() -> None:
    assert listed([str(i) for i in range(11)]) == "0, 1, 2, 3, 4, 5, 6, 7 and 3 more"
