"""Undistorted pictures: each photograph keeps the name that ingest gave it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from stages.base.stage import Report
from stages.cameras.colmap import read_model
from stages.ingest.sources import picture_names
from stages.scene import Capture, Photo
from stages.scene.pictures import load_mask
from stages.sfm.finish import finish
from stages.sfm.reconstruction_files import load_reconstruction, save_reconstruction
from tests.sfm.synthetic import SIZE, orbit_model

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
    views = read_model(folder / "colmap" / "sparse" / "0")[0].views
    assert {view.name for view in views} == set(of_ingest.values())
    images = folder / "colmap" / "images"
    written = {p.relative_to(images).as_posix() for p in images.rglob("*") if p.is_file()}
    assert written == set(of_ingest.values())


def test_a_picture_has_the_format_of_its_suffix_and_the_content_of_its_photograph(
    tmp_path: Path,
) -> None:
    capture, folder = captured(tmp_path / "ingest"), tmp_path / "sfm"
    model = replace(orbit_model(4, 60), names=tuple(p.image for p in capture.photos))
    for number, view in enumerate(finish(model, capture, folder, Report()).views):
        path = folder / view.image
        with Image.open(path) as picture:
            assert picture.format == ("PNG" if path.suffix == ".png" else "JPEG")
        image = cv2.imread(str(path))
        assert image is not None
        assert np.abs(image.astype(int) - 50 * number).max() <= 2


def test_a_mask_is_undistorted_with_its_photograph_and_stored(tmp_path: Path) -> None:
    """The photographs are white where their masks are, so both must be undistorted alike."""
    capture, folder = captured(tmp_path / "ingest"), tmp_path / "sfm"
    photo = next(photo for photo in capture.photos if photo.image.endswith(".png"))
    drawn = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    drawn[SIZE[1] // 4 : -SIZE[1] // 4, : SIZE[0] // 3] = 255
    Image.fromarray(drawn).convert("RGB").save(capture.folder / photo.image)
    (capture.folder / "masks").mkdir()
    Image.fromarray(drawn).save(capture.folder / "masks" / "m.png")
    photos = tuple(
        replace(p, mask="masks/m.png", outside="ignore") if p == photo else p
        for p in capture.photos
    )
    model = orbit_model(4, 60)
    bent = model.camera_params.copy()
    bent[:, 3] = -0.08
    model = replace(model, names=tuple(p.image for p in photos), camera_params=bent)
    found = finish(model, replace(capture, photos=photos), folder, Report())
    save_reconstruction(folder, found)
    masked = {view.name: view for view in load_reconstruction(folder).views if view.mask}
    assert list(masked) == [photo.name]
    view = masked[photo.name]
    mask = load_mask(folder / view.mask, view.camera.width, view.camera.height, view.outside)
    image = cv2.imread(str(folder / view.image), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert set(np.unique(mask)) == {0, 255}
    assert np.mean((image > 127) != (mask > 0)) < 0.01
    assert 0.1 < np.mean(mask > 0) < 0.3
