"""Cameras find their photographs by name, and say which have none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.cameras.camera_file import CameraFile
from stages.cameras.lens import PINHOLE
from stages.scene import Camera, Capture, Photo, View, split_held_out
from stages.sfm.known.match_cameras import match_cameras


def capture(*names: str, size: tuple[int, int] = (640, 480)) -> Capture:
    photos = (Photo(n, f"photos/{n}", *size, None, "", 1.0, -2.0, None) for n in names)
    return Capture(Path(), tuple(photos))


def cameras(*names: str, roles: str = "", size: tuple[int, int] = (640, 480)) -> CameraFile:
    camera = Camera(*size, 500.0, 500.0, size[0] / 2, size[1] / 2, np.eye(4))
    words = {"r": "train", "t": "test", "v": "val"}
    views = tuple(
        View(name, name, camera, "", words[role] if role else "")
        for name, role in zip(names, roles or [""] * len(names), strict=True)
    )
    return CameraFile(views, Path(), (PINHOLE,) * len(views))


def names_of(
    found: CameraFile, photographs: Capture, split: bool = False, partial: bool = False
) -> list[str]:
    posed = match_cameras(found, photographs, split, partial, Report())
    return [one.photo.name for one in posed]


def refusal(found: CameraFile, photographs: Capture, **more: bool) -> SplatError:
    with pytest.raises(SplatError) as caught:
        names_of(found, photographs, **more)
    return caught.value


@pytest.mark.parametrize(
    "written",
    ["a.jpg", "./images/a", "images\\A.JPG", "C:\\work\\a.jpg", "../b/a.png", "/x/a.jpeg"],
)
def test_folders_suffixes_and_case_may_differ(written: str) -> None:
    assert names_of(cameras("b.jpg", written, "c"), capture("a.jpg", "b.jpg", "c.png")) == [
        "a.jpg",
        "b.jpg",
        "c.png",
    ]


def test_names_that_hold_points_are_whole() -> None:
    photographs = capture("1.2.png", "1.3.png", "1.4.png")
    assert len(names_of(cameras("x/1.2", "x/1.3", "x/1.4"), photographs)) == 3


def test_of_equal_names_the_folder_decides() -> None:
    photographs = capture("test/r_0.png", "train/r_0.png", "train/r_1.png")
    posed = match_cameras(
        cameras("./train/r_0", "./train/r_1", "./test/r_0", roles="rrt"),
        photographs,
        True,
        False,
        Report(),
    )
    assert [(one.photo.name, one.role) for one in posed] == [
        ("test/r_0.png", "test"),
        ("train/r_0.png", "train"),
        ("train/r_1.png", "train"),
    ]


def test_what_has_no_counterpart_is_named_and_left_out_on_request() -> None:
    found, photographs = cameras("a", "b", "c", "x", "y"), capture("a.jpg", "b.jpg", "c.jpg", "z.j")
    error = refusal(found, photographs)
    assert error.code == "cameras-without-photographs"
    assert "2 cameras of the file name photographs that are not there (x, y)" in error.given
    assert "1 photograph has no camera in the file (z.j)" in error.given
    assert "--allow-partial" in error.hint
    assert names_of(found, photographs, partial=True) == ["a.jpg", "b.jpg", "c.jpg"]
    assert refusal(cameras("a", "b", "c"), photographs).code == "cameras-missing"
    nothing = refusal(cameras("u", "v", "w"), photographs, partial=True)
    assert nothing.given.startswith("No photograph has a camera")


def test_two_cameras_of_one_photograph_are_refused() -> None:
    error = refusal(cameras("a.jpg", "other/a.jpg", "b"), capture("a.jpg", "b.jpg", "c.jpg"))
    assert error.code == "cameras-of-one-name"
    assert "a.jpg and other/a.jpg" in error.given


def test_a_name_of_two_photographs_is_refused() -> None:
    error = refusal(cameras("a", "b", "c"), capture("1/a.jpg", "2/a.jpg", "b.jpg", "c.jpg"))
    assert error.code == "cameras-ambiguous"
    assert "1/a.jpg, 2/a.jpg" in error.given


def test_cameras_are_scaled_with_their_photographs() -> None:
    found = cameras("a", "b", "c", size=(1280, 960))
    (first, *_) = match_cameras(found, capture("a", "b", "c"), False, False, Report())
    assert (first.camera.width, first.camera.fx, first.camera.cy) == (640, 250, 240)


def test_another_aspect_ratio_is_refused_and_a_rotated_one_explained() -> None:
    found = cameras("a", "b", "c")
    assert "cropped" in refusal(found, capture("a", "b", "c", size=(480, 480))).hint
    turned = refusal(found, capture("a", "b", "c", size=(480, 640)))
    assert turned.code == "cameras-other-shape"
    assert "EXIF" in turned.hint


def test_the_split_of_the_file_is_used_only_with_the_option() -> None:
    found, photographs = cameras("a", "b", "c", "d", roles="rrtv"), capture("a", "b", "c", "d")
    assert names_of(found, photographs) == ["a", "b", "c", "d"]
    assert names_of(found, photographs, split=True) == ["a", "b", "c"]
    assert refusal(cameras("a"), capture("a"), split=True).code == "cameras-without-split"


def test_what_a_split_leaves_out_may_lack_its_counterpart() -> None:
    found = cameras("train/a", "train/b", "test/c", "val/d", roles="rrtv")
    photographs = capture("train/a.png", "train/b.png", "test/c.png", "test/c_depth.png")
    report = Report()
    posed = match_cameras(found, photographs, True, False, report)
    assert sorted(one.role for one in posed) == ["test", "train", "train"]
    assert report.warnings == []
    lacking = cameras("a", "b", "c", "x", roles="rrtt")
    assert refusal(lacking, capture("a", "b", "c"), split=True).code.startswith("cameras-without")


def test_roles_decide_which_views_are_held_out() -> None:
    found = cameras(*"abcdefghij", roles="rrrrrrrtrt")
    training, judges = split_held_out(found.views)
    assert [view.name for view in judges] == ["h", "j"]
    assert [view.name for view in training] == list("abcdefgi")
