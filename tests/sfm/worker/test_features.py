"""Features lie where they are, in COLMAP's coordinates, and are the same however they are found."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.sfm.worker import features
from stages.sfm.worker.job import Features
from tests.sfm.worker import sample_jobs as jobs


def blob(width: int, height: int, x: float, y: float, sigma: float) -> np.ndarray:
    """[H, W] uint8: a soft bright spot at (x, y), pixel centres at +0.5."""
    u, v = np.meshgrid(np.arange(width) + 0.5 - x, np.arange(height) + 0.5 - y)
    return np.rint(40 + 180 * np.exp(-(u**2 + v**2) / (2 * sigma**2))).astype(np.uint8)


def found_in(picture: np.ndarray, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    path = folder / "é.png"
    cv2.imencode(".png", picture)[1].tofile(path)
    return features.sift_features(path, 1000, 0.0045)


@pytest.mark.parametrize("sigma", [1.5, 4.0, 9.0])
@pytest.mark.parametrize("place", [(100.5, 80.5), (100.8, 81.2), (101.0, 81.0)])
def test_a_blob_is_found_where_it_is(
    sigma: float, place: tuple[float, float], tmp_path: Path
) -> None:
    keypoints, _ = found_in(blob(260, 200, *place, sigma), tmp_path)
    nearest = np.abs(keypoints[:, :2] - place).max(axis=1).min()
    assert nearest < 0.04  # half a pixel, and a quarter, are what goes wrong


def test_keypoints_of_large_photographs_are_in_their_own_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(features, "LARGEST_SIDE", 260)
    keypoints, _ = found_in(blob(780, 600, 300.5, 240.5, 24.0), tmp_path)
    best = keypoints[np.abs(keypoints[:, :2] - (300.5, 240.5)).max(axis=1).argmin()]
    assert np.abs(best[:2] - (300.5, 240.5)).max() < 0.2
    assert best[2] == pytest.approx(24 / 2 ** (1 / 6), rel=0.15)  # where DoG answers most


def test_a_rotated_picture_has_rotated_features(tmp_path: Path) -> None:
    """Turned clockwise, as seen: (x, y) comes to (height - y, x), and angles grow, from x to y."""
    picture = cv2.imread(str(jobs.SAMPLE / "IMG_0001.jpg"), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    upright, _ = found_in(picture, tmp_path)
    turned, _ = found_in(np.ascontiguousarray(np.rot90(picture, -1)), tmp_path)
    wanted = upright.copy()
    wanted[:, 0], wanted[:, 1] = picture.shape[0] - upright[:, 1], upright[:, 0]
    wanted[:, 3] = (upright[:, 3] + np.pi / 2) % (2 * np.pi)
    far = np.abs(wanted[:, None] - turned[None]) / (0.1, 0.1, 0.1, 0.05)
    assert np.mean(far.max(axis=2).min(axis=1) < 1) > 0.8


def test_descriptors_are_roots_of_histograms_and_the_largest_come_first() -> None:
    keypoints, descriptors = features.sift_features(jobs.SAMPLE / "IMG_0001.jpg", 500, 0.0045)
    assert len(keypoints) == len(descriptors) == 500
    assert descriptors.dtype == np.uint8
    lengths = np.linalg.norm(descriptors.astype(float), axis=1)
    assert np.median(lengths) == pytest.approx(512, abs=2)
    assert (np.diff(keypoints[:, 2]) <= 0).all()


def test_a_blank_picture_has_no_features(tmp_path: Path) -> None:
    keypoints, descriptors = found_in(np.full((60, 80), 128, np.uint8), tmp_path)
    assert (keypoints.shape, descriptors.shape) == ((0, 4), (0, 128))


def rows(database: Path) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(database)) as connection:
        return [
            row
            for table in ("keypoints", "descriptors", "images", "cameras")
            for row in connection.execute(f"SELECT * FROM {table} ORDER BY 1")
        ]


def test_any_number_of_threads_and_a_new_start_give_the_same(tmp_path: Path) -> None:
    project = jobs.sample_project(tmp_path, photographs=5)
    jobs.work(Features(project, jobs.SIFT))
    wanted = rows(project.database)
    (tmp_path / "other").mkdir()
    other = replace(project, database=tmp_path / "other" / "base.db", threads=3)
    jobs.work(Features(other, jobs.SIFT))
    assert rows(other.database) == wanted
    with closing(sqlite3.connect(other.database)) as connection:
        for table in ("keypoints", "descriptors"):
            connection.execute(f"DELETE FROM {table} WHERE image_id IN (2, 5)")
        connection.execute("UPDATE keypoints SET rows = 7 WHERE image_id = 1")
        connection.commit()
    jobs.work(Features(other, jobs.SIFT))
    again = rows(other.database)
    assert again[0][1] == 7, "what is there is kept"
    assert again[1:] == wanted[1:]


def test_nothing_is_found_where_a_mask_is_black(tmp_path: Path) -> None:
    picture = np.maximum(blob(260, 200, 60.5, 80.5, 4.0), blob(260, 200, 180.5, 80.5, 4.0))
    mask = np.zeros_like(picture)
    mask[:, 130:] = 255
    for name, pixels in (("a.png", picture), ("mask.png", mask)):
        cv2.imencode(".png", pixels)[1].tofile(tmp_path / name)
    everywhere, _ = features.sift_features(tmp_path / "a.png", 1000, 0.0045)
    keypoints, _ = features.sift_features(tmp_path / "a.png", 1000, 0.0045, tmp_path / "mask.png")
    assert everywhere[:, 0].min() < 65
    assert len(keypoints)
    assert keypoints[:, 0].min() > 130
