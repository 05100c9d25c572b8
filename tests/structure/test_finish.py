"""Undistorted pictures: each photograph keeps the name that ingest gave it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from stages.base.stage import Report
from stages.cameras.colmap import read_model
from stages.photos.find import picture_names
from stages.scene import Capture, Photo
from stages.structure.finish import finish
from tests.structure.synthetic import SIZE, orbit_model

# Two of them would share a name once they are JPEG; one is a PNG; one lies in a folder.
NAMES = ("photo.jpg", "photo.heic", "r_0.png", "day 1/Photo.JPG")


def captured(folder: Path) -> Capture:
    """Each photograph in a colour of its own."""
    photos = []
    for number, (name, image) in enumerate(picture_names(NAMES).items()):
        path = folder / image
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((SIZE[1], SIZE[0], 3), 50 * number, np.uint8)).save(path)
        photos.append(Photo(name, image, *SIZE, None, "camera", 1.0, -2.0, None))
    return Capture(folder, tuple(photos))


def test_a_photograph_has_one_name_in_every_folder(tmp_path: Path) -> None:
    capture, folder = captured(tmp_path / "ingest"), tmp_path / "sfm"
    model = replace(orbit_model(4, 60), names=tuple(p.image for p in capture.photos))
    found = finish(model, capture, folder, Report())
    assert found.units == "arbitrary"
    of_ingest = {photo.name: photo.image.removeprefix("photos/") for photo in capture.photos}
    assert of_ingest["photo.heic"] == "photo-2.jpg"
    assert of_ingest["r_0.png"] == "r_0.png"
    assert {v.name: v.image.removeprefix("colmap/images/") for v in found.views} == of_ingest
    assert set(read_model(folder / "colmap" / "sparse" / "0")[1].names) == set(of_ingest.values())
    images = folder / "colmap" / "images"
    written = {p.relative_to(images).as_posix() for p in images.rglob("*") if p.is_file()}
    assert written == set(of_ingest.values())


def test_a_picture_is_of_the_kind_that_its_name_says_and_of_its_photograph(tmp_path: Path) -> None:
    capture, folder = captured(tmp_path / "ingest"), tmp_path / "sfm"
    model = replace(orbit_model(4, 60), names=tuple(p.image for p in capture.photos))
    for number, view in enumerate(finish(model, capture, folder, Report()).views):
        path = folder / view.image
        with Image.open(path) as picture:
            assert picture.format == ("PNG" if path.suffix == ".png" else "JPEG")
        image = cv2.imread(str(path))
        assert image is not None
        assert np.abs(image.astype(int) - 50 * number).max() <= 2
