"""Files of survey programs and phones that contradict themselves or hold what is not supported."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.cameras.camera_formats import files_of, read_cameras
from tests.cameras.drawn_surveys import arkit, opf, polycam, realityscan_xmp


def refused(path: Path) -> str:
    with pytest.raises(SplatError) as caught:
        read_cameras(path)
    assert caught.value.code == "cameras-unreadable"
    return caught.value.given


def replaced(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


@pytest.mark.parametrize(
    ("file", "before", "after", "why"),
    [
        (
            "calibrated-cameras.json",
            '"perspective"',
            '"spherical"',
            "type spherical is not supported",
        ),
        ("calibrated-cameras.json", '"sensor_id": 7', '"sensor_id": 8', "sensor 8 is not listed"),
        ("camera-list.json", "9223372036854775808", "5", "picture 9223372036854775808 is not"),
        ("input-cameras.json", '"id": 7', '"id": 8', "size of a sensor's pictures"),
        ("project.opf", '"camera-list.json"', '"../camera-list.json"', "which is outside"),
        ("project.opf", '"camera-list.json"', '"other.json"', "which is not there"),
        ("project.opf", '"calibration"', '"notes"', "it has 0 calibrations"),
        ("scene-reference-frame.json", "-408.0", "NaN", "not three numbers"),
    ],
)
def test_an_opf_project_that_does_not_agree_is_refused(
    tmp_path: Path, file: str, before: str, after: str, why: str
) -> None:
    path = opf(tmp_path)
    replaced(tmp_path / file, before, after)
    assert why in refused(path)


def test_opfs_fisheye_is_a_polynomial_of_the_angle(tmp_path: Path) -> None:
    """By Pix4D's description: theta in quarter turns, rho = theta + p2 theta^2 + p3 theta^3."""
    path = opf(tmp_path)
    calibrated = tmp_path / "calibrated-cameras.json"
    data = json.loads(calibrated.read_text())
    p2, p3, affine = 0.0152646, -0.161096, [300.0, 2.0, 0.0, 301.0]
    data["sensors"][0]["internals"] = {
        "type": "fisheye",
        "principal_point_px": [158, 122],
        "affine": affine,
        "polynomial": [0.0, 1.0, p2, p3],
    }
    calibrated.write_text(json.dumps(data))
    found = read_cameras(path)
    camera, lens = found.views[0].camera, found.lenses[0]
    at = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 2], (50, 3))
    across = np.hypot(at[:, 0], at[:, 1])
    theta = 2 / np.pi * np.arctan(across / at[:, 2])
    rho = (theta + p2 * theta**2 + p3 * theta**3)[:, None]
    wanted = rho * at[:, :2] / across[:, None] @ np.reshape(affine, (2, 2)).T + [158, 122]
    uv = at[:, :2] / at[:, 2:]
    pixels = lens.distort(uv) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    np.testing.assert_allclose(pixels, wanted, atol=1e-9)
    seen = (wanted - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    np.testing.assert_allclose(lens.undistort(seen), uv, atol=1e-6)


def test_a_folder_with_an_opf_project_is_enough(tmp_path: Path) -> None:
    opf(tmp_path)
    assert len(read_cameras(tmp_path).views) == 4
    assert "calibrated-cameras.json" in {path.name for path in files_of(tmp_path)}


def test_realityscans_division_model_is_refused(tmp_path: Path) -> None:
    folder = realityscan_xmp(tmp_path)
    replaced(folder / "p_0.xmp", '"brown3"', '"division"')
    assert "distortion model division is not supported" in refused(folder)


def test_realityscans_photograph_must_be_beside_its_metadata(tmp_path: Path) -> None:
    folder = realityscan_xmp(tmp_path)
    (folder / "p_1.png").unlink()
    assert "p_1.xmp" in refused(folder)


def test_metadata_of_other_programs_is_no_camera(tmp_path: Path) -> None:
    (tmp_path / "a.xmp").write_text('<x:xmpmeta xmlns:x="adobe:ns:meta/"/>')
    with pytest.raises(SplatError) as caught:
        read_cameras(tmp_path)
    assert caught.value.code == "cameras-unknown"


def test_odms_shots_are_refused_with_the_file_to_name_instead(tmp_path: Path) -> None:
    (tmp_path / "shots.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    with pytest.raises(SplatError) as caught:
        read_cameras(tmp_path / "shots.geojson")
    assert caught.value.code == "cameras-unknown"
    assert "opensfm/reconstruction.json" in caught.value.hint


@pytest.mark.parametrize(
    ("make", "file", "key"),
    [
        (arkit, "frame_00006.json", "cameraPoseARFrame"),
        (polycam, "keyframes/corrected_cameras/p_1.json", "t_13"),
    ],
)
def test_a_frame_that_lacks_something_is_named(
    tmp_path: Path, make: Callable[[Path], Path], file: str, key: str
) -> None:
    folder = make(tmp_path)
    data = json.loads((tmp_path / file).read_text())
    del data[key]
    (tmp_path / file).write_text(json.dumps(data))
    given = refused(folder)
    assert Path(file).name in given
    assert key in given


def test_polycams_own_cameras_are_used_where_none_are_corrected(tmp_path: Path) -> None:
    polycam(tmp_path)
    for path in (tmp_path / "keyframes" / "corrected_cameras").iterdir():
        path.unlink()
    found = read_cameras(tmp_path)
    assert found.folder.name == "images"
