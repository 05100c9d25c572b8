"""The sample capture: what its truth file says is what its photographs show."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from sample_captures import make
from sample_captures.render import Lens, Light, photograph
from stages.run.manifest import json_value
from stages.scene import Reconstruction
from stages.scene.rotations import similarity
from stages.sfm import stage as sfm
from stages.sfm.settings import SfmSettings

CAPTURE = Path(__file__).parents[1] / "sample_captures" / "still_life"
IMAGES = sorted((CAPTURE / "images").iterdir())


@pytest.fixture(scope="module")
def truth() -> dict[str, Any]:
    return json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))


def seen(points: NDArray, matrix: NDArray, camera: dict[str, float]) -> NDArray[np.bool_]:
    """[N] whether points project into the photograph (occlusion aside)."""
    x, y, z = matrix[:3, :3] @ points.T + matrix[:3, 3:]
    bend = 1 + camera["k"] * (x**2 + y**2) / z**2
    u = camera["f"] * bend * x / z + camera["cx"]
    v = camera["f"] * bend * y / z + camera["cy"]
    return (z > 0) & (u > 0) & (u < camera["width"]) & (v > 0) & (v < camera["height"])


def test_the_photographs_are_small_and_carry_exif(truth: dict[str, Any]) -> None:
    assert [photo["name"] for photo in truth["photos"]] == [path.name for path in IMAGES]
    assert sum(path.stat().st_size for path in IMAGES) < 4_000_000
    for path in IMAGES:
        with Image.open(path) as image:
            assert image.size == (640, 480)
            details = image.getexif().get_ifd(0x8769)
            assert (details[0xA405], float(details[0x829A])) == (34, 1 / 60)


def test_the_script_still_makes_the_cameras_of_the_truth_file(truth: dict[str, Any]) -> None:
    stored = np.array([photo["world_to_camera"] for photo in truth["photos"]])
    np.testing.assert_allclose(np.array(make.poses()), stored, atol=1e-8)


def test_poses_are_rigid_and_every_point_is_in_some_photograph(truth: dict[str, Any]) -> None:
    points = np.array(truth["points"])
    views = []
    for photo in truth["photos"]:
        matrix = np.array(photo["world_to_camera"])
        np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-7)
        assert np.linalg.det(matrix[:3, :3]) > 0
        views.append(seen(points, matrix, truth["camera"]))
    counts = np.sum(views, axis=0)
    assert counts.min() >= 1
    assert np.median(counts) >= 8, "photographs overlap"


@pytest.mark.slow
def test_a_rendering_from_the_truth_looks_like_the_photograph() -> None:
    """A coarse rendering: other OpenCV versions letter differently, so only the gist counts."""
    lens = Lens(160, 120, make.LENS.focal_px / 4, make.LENS.k)
    picture = photograph(list(make.scene()), Light(), lens, make.poses()[11])
    with Image.open(IMAGES[11]) as image:
        photo = cv2.resize(np.asarray(image), (160, 120), interpolation=cv2.INTER_AREA)
    difference = np.abs(picture.astype(float) - photo)
    assert 0.1 < difference.mean() < 6


@pytest.fixture
def reconstruction(sample_run: Path) -> Reconstruction:
    """Of the whole capture, with the settings that everyone has."""
    settings = json.loads((sample_run / "run" / "2-sfm" / "manifest.json").read_text())["settings"]
    assert settings == json_value(asdict(SfmSettings()))
    return sfm.load(sample_run / "run" / "2-sfm")


@pytest.mark.slow
def test_structure_from_motion_finds_the_true_cameras(
    reconstruction: Reconstruction, truth: dict[str, Any]
) -> None:
    """Small but not zero: an error of zero would mean that the truth leaked into the result."""
    assert len(reconstruction.views) == 24
    true = {photo["name"]: np.array(photo["world_to_camera"]) for photo in truth["photos"]}
    found_centres = np.array([view.camera.centre for view in reconstruction.views])
    matrices = [true[view.name] for view in reconstruction.views]
    true_centres = np.array([-m[:3, :3].T @ m[:3, 3] for m in matrices])
    scale, rotation, shift = similarity(found_centres, true_centres)
    distances = np.linalg.norm(scale * found_centres @ rotation.T + shift - true_centres, axis=1)
    assert 1e-5 < distances.mean() < 2e-3
    assert distances.max() < 5e-3
    degrees = []
    for view, matrix in zip(reconstruction.views, matrices, strict=True):
        turn = matrix[:3, :3] @ rotation @ view.camera.world_to_camera[:3, :3].T
        degrees.append(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    assert 1e-4 < np.mean(degrees) < 0.08
    assert np.max(degrees) < 0.2


@pytest.mark.slow
def test_structure_from_motion_finds_the_true_lens_and_up(
    reconstruction: Reconstruction, truth: dict[str, Any]
) -> None:
    """The views are undistorted; their focal length is kept or a little less."""
    for view in reconstruction.views:
        ratio = view.camera.fx * 640 / view.camera.width / truth["camera"]["f"]
        assert 0.9 < ratio < 1.1
        assert view.camera.fx == pytest.approx(view.camera.fy, rel=0.02)
    assert reconstruction.levelled
    true_down = {p["name"]: np.array(p["world_to_camera"])[:3, 1] for p in truth["photos"]}
    for view in reconstruction.views:
        found_down = view.camera.world_to_camera[:3, 1]
        assert np.degrees(np.arccos(found_down @ true_down[view.name])) < 1.5


@pytest.mark.slow
def test_sparse_points_lie_on_the_true_surfaces(
    reconstruction: Reconstruction, truth: dict[str, Any]
) -> None:
    true = {photo["name"]: np.array(photo["world_to_camera"]) for photo in truth["photos"]}
    found = np.array([view.camera.centre for view in reconstruction.views])
    matrices = [true[view.name] for view in reconstruction.views]
    wanted = np.array([-m[:3, :3].T @ m[:3, 3] for m in matrices])
    scale, rotation, shift = similarity(found, wanted)
    points = scale * reconstruction.points @ rotation.T + shift
    errors = distance_to_surface(points)
    assert 1e-5 < np.median(errors) < 3e-3
    assert np.mean(errors < 0.02) > 0.9


def distance_to_surface(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N] about how far points are from the nearest surface, metres: |f| / |grad f| of each."""
    nearest = np.full(len(points), np.inf)
    for shape in make.scene():
        matrix = shape.to_local().astype(np.float64)
        local = (points - np.array(shape.centre)) @ matrix.T
        if shape.kind == "ellipsoid":
            radius = np.linalg.norm(local, axis=1)
            distance = np.abs(radius - 1) * min(shape.half)
        else:
            half = np.array(shape.half)
            beyond = (np.abs(local) - 1) * half
            if shape.kind == "cylinder":
                around = (np.hypot(local[:, 0], local[:, 2]) - 1) * half[0]
                beyond = np.stack([around, beyond[:, 1]], axis=1)
            outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
            distance = np.abs(outside + np.minimum(beyond.max(axis=1), 0))
        nearest = np.minimum(nearest, distance)
    return nearest
